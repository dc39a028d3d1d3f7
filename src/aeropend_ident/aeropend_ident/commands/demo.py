# SPDX-License-Identifier: Apache-2.0
"""The main job from end to end: a plant with a hidden effect, a recording of it, and its diagnosis.

The plant, the excitation, the recorder and the diagnosis are separate processes. The hidden effect is drawn at random
and written to a file that only the plant reads.
"""

from __future__ import annotations

import argparse
import math
import signal
import subprocess
import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import numpy as np
from rich.console import Console

from aeropend_ident.commands.programs import MODULES, ProgramError, environment, made, process, record_excited
from aeropend_ident.diagnosis import document
from aeropend_ident.diagnosis.document import DiagnosisDocument
from aeropend_sim.cli.command import Parser, as_seed, entry_point
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import Model, load, save

NUMBER_ERROR = 0.03
"""Each number of the plant is off from the model by up to this share (choice: no model's numbers are exact)."""


def numbers_off(model: Model, rng: np.random.Generator) -> dict[str, float]:
    """The numbers of a rig that are those of a model only nearly: each is off by up to `NUMBER_ERROR`, by chance.

    Args:
        model: the model.
        rng: draws how far each is off.
    """
    return {k: v * (1.0 + NUMBER_ERROR * rng.uniform(-1.0, 1.0)) for k, v in model.model.items()}


def draw(effect: str | None, seed: int | None) -> tuple[str, Model]:
    """A rig: `bench` with numbers a little off and one effect of the catalogue, both by chance.

    Args:
        effect: pins the effect's id, or `none`.
        seed: pins all chance.

    Returns:
        The effect's id and the rig's model.
    """
    rng = np.random.default_rng(seed)
    bench = load("bench")
    numbers = numbers_off(bench, rng)
    drawn = effect or str(rng.choice(list(CATALOGUE)))
    effects = {}
    if drawn != "none":
        entry = CATALOGUE[drawn]
        effects[drawn] = {k: p.default for k, p in entry.parameters.items()}
        p = entry.parameters[entry.size]
        effects[drawn][entry.size] = p.neutral + (p.default - p.neutral) * float(rng.uniform(0.8, 1.5))
    return drawn, Model("rig", numbers, bench.sensing, effects)


def measure(folder: Path, rig: Path, duration: float, seed: int, console: Console) -> Path:
    """Run the plant, excite it and record it, for `duration` seconds; returns the recording."""
    bag, own, log = folder / "recording", environment(), folder / "plant.log"
    with process("plant", "--ros-args", "--params-file", str(rig), "-p", f"seed:={seed}", environment=own,
                 log=log) as plant:
        record_excited(bag, ["-p", f"duration:={duration}", "-p", f"seed:={seed}"], duration, environment=own,
                       others={"plant": plant}, console=console)
    return bag


def diagnose(folder: Path, bag: Path) -> DiagnosisDocument:
    """Run `diagnose` on the recording; returns its document."""
    result = subprocess.run([sys.executable, "-m", MODULES["diagnose"], str(bag), "--out", str(folder / "diagnosis")],
                            check=False)
    if result.returncode:
        raise ProgramError(f"diagnose ended with {result.returncode}")
    return document.read(folder / "diagnosis" / "diagnosis.json")


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(prog="demo", description=__doc__.splitlines()[0],
                    epilog="examples:\n  demo\n  demo --effect coulomb_friction\n\n"
                           "exit codes: 0 right verdict, 1 wrong verdict, 2 it could not run, 130 interrupted",
                    formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--effect", choices=[*CATALOGUE, "none"], metavar="ID",
                        help="pin the hidden effect: " + ", ".join([*CATALOGUE, "none"]))
    parser.add_argument("--duration", type=float, default=60.0, metavar="S", help="seconds to record (default: 60)")
    parser.add_argument("--seed", type=as_seed, help="pin all chance (default: a new draw each time)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for everything (default: demo-results/<time>)")
    options = parser.parse_args(arguments)
    if not (math.isfinite(options.duration) and 10.0 <= options.duration <= 600.0):
        parser.error(f"--duration {options.duration:g}: give 10 to 600 seconds")
    return options


@entry_point("demo", "interrupted; every process was stopped")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the demo; returns the exit code."""
    options = _parse(arguments)
    console = Console(stderr=True)
    folder = options.out or Path("demo-results") / datetime.now().strftime("%Y%m%d-%H%M%S")
    signal.signal(signal.SIGTERM, lambda *_: (_ for _ in ()).throw(KeyboardInterrupt()))
    made(folder)
    drawn, rig = draw(options.effect, options.seed)
    save(rig, folder / "rig.yaml", "the rig of the demo, hidden from diagnose")
    seed = options.seed if options.seed is not None else int(np.random.default_rng().integers(1000))
    print(f"A rig whose flaw is hidden runs for {options.duration:g} s and is recorded; results go to {folder}")
    bag = measure(folder, folder / "rig.yaml", options.duration, seed, console)
    found = diagnose(folder, bag)
    right = found.which.verdict == drawn
    truth = ", ".join(f"{k} = {v:.4g}" for p in rig.effects.values() for k, v in p.items())
    hidden = f"{drawn} ({truth})" if truth else drawn
    print(f"hidden in the plant: {hidden}: the verdict is {'right' if right else 'WRONG'}")
    print("next: make live runs the model beside a rig that changes while you look (docs/guide/live.md)")
    return 0 if right else 1


if __name__ == "__main__":
    sys.exit(main())
