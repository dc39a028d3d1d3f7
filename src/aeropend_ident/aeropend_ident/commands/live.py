# SPDX-License-Identifier: Apache-2.0
"""A rig that changes while it runs, and `watch` that tells when, where and why: plant, controller, watch and its page.

An effect is drawn and switched on at a random instant. It is written to a file that only the plant reads.
"""

from __future__ import annotations

import argparse
import math
import os
import random
import signal
import time
import webbrowser
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from datetime import datetime
from pathlib import Path
from subprocess import Popen

import numpy as np
from rclpy.context import Context
from rclpy.node import Node
from std_msgs.msg import Float64

from aeropend_ident.commands.demo import numbers_off
from aeropend_ident.commands.programs import check, environment, made, process
from aeropend_sim.cli.command import Parser, as_seed, entry_point
from aeropend_sim.model import effect_file
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import Model, load, save
from aeropend_sim.ros import interface
from aeropend_sim.ros.transport import without_shared_memory

LEARNED_S = 80.0
"""[s] After the start before which the effect does not begin: `watch` learns the rig first."""

SPREAD_S = 60.0
"""[s] Within which it then begins (choice: nobody can guess when, and nobody waits for long)."""

HOLD_S = (2.0, 5.0)
"""[s] Time between two references (choice)."""

REPEAT_S = 0.2
"""[s] Time between two messages of the same reference (choice: a controller that has just started gets it soon)."""

ANGLES = (0.1, 0.6)
"""[rad] References (choice: between hanging and horizontal)."""

SIZE = (1.0, 2.0)
"""Size of the effect, in usual sizes (choice)."""

SWITCHED = ("supply_sag", "rotor_friction", "axial_inflow", "ground_effect", "coulomb_friction", "quadratic_drag",
            "cable_torque", "angle_offset", "encoder_eccentricity", "current_gain", "current_offset", "voltage_offset")
"""Effects whose law may be multiplied by a step in time."""

SINCE = "begins"


def definition(effect: str, since: float, rng: np.random.Generator) -> dict[str, object]:
    """An effect by formula that is an effect of the catalogue from an instant on.

    Args:
        effect: id, one of `SWITCHED`.
        since: [s] time of the plant at which it begins.
        rng: draws its size.
    """
    e = CATALOGUE[effect]
    parameters: dict[str, dict[str, object]] = {}
    for name, p in e.parameters.items():
        value = p.neutral + (p.default - p.neutral) * float(rng.uniform(*SIZE)) if name == e.size else p.default
        parameters[name] = {"unit": p.unit, "default": value, "low": p.low, "high": p.high, "neutral": p.neutral}
    parameters[SINCE] = {"unit": "s", "default": since, "low": 0.0, "high": 1e6}
    made: dict[str, object] = {"place": e.place, "physics": f"{e.physics}, from an instant on",
                               "term": f"({e.law}) * step(t - {SINCE})", "parameters": parameters}
    return {**made, **({"reading": e.reading} if e.reading else {}), **({"sticks": True} if e.sticks else {})}


def draw(folder: Path, effect: str | None, since: float | None, seed: int | None) -> tuple[str, float]:
    """Draw the rig and write `rig.yaml`, with the effect in it.

    Returns:
        The effect and the instant [s] at which it begins, in the time of the plant.
    """
    rng = np.random.default_rng(seed)
    bench = load("bench")
    numbers = numbers_off(bench, rng)
    drawn = effect or str(rng.choice(SWITCHED))
    at = LEARNED_S + SPREAD_S * float(rng.random()) if since is None else since
    name = f"late_{drawn}"
    effect_file.save({name: definition(drawn, at, rng)}, folder / "effect.yaml")
    (defined,) = effect_file.load(folder / "effect.yaml").values()
    own = {name: {k: p.default for k, p in defined.parameters.items()}}
    save(Model("rig", numbers, bench.sensing, own), folder / "rig.yaml", "the rig, hidden from watch")
    return drawn, at


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(prog="live", description=__doc__.splitlines()[0],
                    epilog="examples:\n  live\n  live --effect coulomb_friction --no-browser\n\n"
                           "exit codes: 0 ended by Ctrl-C or --seconds, 2 it could not run",
                    formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--effect", choices=SWITCHED, metavar="ID", help="pin the effect: " + ", ".join(SWITCHED))
    parser.add_argument("--since", type=float, metavar="S", help="pin the instant, seconds after the start")
    parser.add_argument("--seconds", type=float, default=math.inf, metavar="S", help="end after this time")
    parser.add_argument("--seed", type=as_seed, help="pin all chance (default: a new draw each time)")
    parser.add_argument("--port", type=int, default=8080, help="port of the page (default: 8080)")
    parser.add_argument("--no-browser", action="store_true", help="do not open the page")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for everything (default: live-results/<time>)")
    options = parser.parse_args(arguments)
    if options.since is not None and not 0.0 <= options.since <= 1e6:
        parser.error(f"--since {options.since:g}: give 0 to 1e6 seconds")
    if not 1 <= options.port <= 65535:
        parser.error(f"--port {options.port}: give 1 to 65535")
    return options


@entry_point("live", "ended; every process was stopped")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run it until Ctrl-C; returns the exit code."""
    options = _parse(arguments)
    folder = options.out or Path("live-results") / datetime.now().strftime("%Y%m%d-%H%M%S")
    signal.signal(signal.SIGTERM, lambda *_: (_ for _ in ()).throw(KeyboardInterrupt()))
    made(folder)
    drawn, since = draw(folder, options.effect, options.since, options.seed)
    own = environment()
    os.environ.update(own)
    page = f"http://127.0.0.1:{options.port}"
    print(f"A rig runs, and an effect begins {LEARNED_S:.0f} to {LEARNED_S + SPREAD_S:.0f} s after its start. The page"
          f" of watch is at {page}\nCtrl-C ends it and tells what was hidden; all is in {folder}", flush=True)
    chance = random.Random(options.seed)
    with ExitStack() as stack:
        running = {}
        for name, args in (
            ("plant", ["--ros-args", "--params-file", str(folder / "rig.yaml")]),
            ("controller", ["feedback_linearization"]),
            ("watch", ["--ros-args", "-p", "page:=true", "-p", f"page_port:={options.port}", "-p",
                       f"bags:={folder / 'alarms'}", "-p", "diagnose:=true"]),
        ):
            log = folder / f"{name}.log"
            running[name] = stack.enter_context(process(name, *args, environment=own, log=log)), log
        try:
            _drive(folder, running, chance, options, page)
        finally:
            said = (folder / "watch.log").read_text(encoding="utf-8").splitlines()
            told = [line for line in said if "parted" in line or "diagnose says" in line]
            print("\n".join(["", *told, f"hidden in the plant: {drawn}, from {since:.1f} s after its start"]))
    return 0


def _drive(folder: Path, running: Mapping[str, tuple[Popen[str], Path]], chance: random.Random,
           options: argparse.Namespace, page: str) -> None:
    """Send references until the time is over."""
    begun = time.monotonic()
    opened, until, angle = options.no_browser, begun, 0.0
    with _references() as send:
        while (now := time.monotonic()) < begun + options.seconds:
            for name, (child, log) in running.items():
                check(name, child, log)
            if not opened and "page: " in (folder / "watch.log").read_text(encoding="utf-8"):
                webbrowser.open(page)
                opened = True
            if now >= until:
                until, angle = now + chance.uniform(*HOLD_S), chance.uniform(*ANGLES)
            send(angle)
            time.sleep(REPEAT_S)


@contextmanager
def _references() -> Iterator[Callable[[float], None]]:
    """A function that publishes a reference."""
    without_shared_memory()
    context = Context()
    context.init()
    try:
        node = Node("references", context=context, use_global_arguments=False, start_parameter_services=False)
        publisher = node.create_publisher(Float64, interface.REFERENCE, interface.QOS)
        yield lambda angle: publisher.publish(Float64(data=angle))
        node.destroy_node()
    finally:
        context.try_shutdown()


if __name__ == "__main__":
    import sys

    sys.exit(main())
