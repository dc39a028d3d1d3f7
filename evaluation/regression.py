# SPDX-License-Identifier: Apache-2.0
"""Compare the results of two trees for the same recordings: which numbers did a change of the code change?

    python -m evaluation.regression inputs FOLDER            make the recordings (once)
    python -m evaluation.regression run FOLDER NAME          results of this tree, in FOLDER/NAME
    python -m evaluation.regression compare FOLDER OLD NEW   every number that differs (--rtol 0: to the bit)

The recordings: 30 of calibrated rigs, 12 of uncalibrated driven rigs, 12 free decays and 5 sets of several recordings
are diagnosed; 6 are identified; beside them the control table and a run of the plant with all effects.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed

from aeropend_ident.bags import recording
from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.commands import identify
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.document import to_json
from aeropend_ident.diagnosis.results import document
from aeropend_ident.signals.from_bag import from_recording, signals_of
from aeropend_ident.testing import bags, rigs
from aeropend_sim.model import rig
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import SAMPLE_PERIOD, load
from evaluation import control_table
from evaluation.blind import __main__ as blind
from evaluation.blind import cases, plant, uncalibrated

SEED = 60_2026
CALIBRATED, DRIVEN, DECAYS = 30, 12, 12
ONE_RIG = {"p": ("coulomb_friction", {}), "q": ("brush_drop", {}), "r": ("", {}), "s": ("thrust_lag", {"tau": 0.2}),
           "t": ("quadratic_drag", {})}
"""Effects of rigs that are recorded several times; the last two with angle and command alone."""
SETS = {"calibrated": [("p0", "p1"), ("q0", "q1", "q2"), ("r0", "r1")], "uncalibrated": [("s0", "s1"), ("t0", "t1")]}
"""Recordings that are fitted together."""
TEXTS = {"notes", "why", "unexplained"}
"""Keys of sentences for people, which are not compared."""
IDENTIFIED = [("c000", "weak"), ("c001", "sindy"), ("c002", "discrepancy-weak"), ("c003", "discrepancy-sindy"),
              ("c006", "weak"), ("c009", "weak")]


def inputs(folder: Path, jobs: int) -> None:
    """Make the recordings."""
    nominal = load("bench")
    place = folder / "recordings"
    place.mkdir(parents=True)

    def calibrated(k: int, row: tuple[str, list[str], str, bool]) -> None:
        kind, effects, form, closed = row
        _, columns = cases.draw(f"c{k:03d}", kind, effects, form, nominal.model, nominal.sensing, SEED + k, 40.0,
                                closed_loop=closed)
        bags.write(place / f"c{k:03d}", columns, round(plant.PERIOD * 1e9))

    def driven(k: int, effect: str) -> None:
        _, columns, period = uncalibrated.driven(f"u{k:03d}", effect, "table", nominal.model,
                                            nominal.sensing["angle_filter_tau"], SEED + 100 + k, 40.0)
        bags.write(place / f"u{k:03d}", columns, round(period * 1e9))

    def decay(k: int, damping: str) -> None:
        _, columns, period = uncalibrated.decay(f"d{k:03d}", damping, nominal.model, SEED + 200 + k)
        bags.write(place / f"d{k:03d}", columns, round(period * 1e9))

    def repeated(letter: str, k: int) -> None:
        effect, parameters = ONE_RIG[letter]
        duty = rigs.steps(25.0, 10 * ord(letter) + k)
        columns, _ = rig.record(rigs.drawn_rig(ord(letter), {effect: parameters} if effect else {}), duty, k)
        columns = {**{c: columns[c] for c in ("theta", "omega", "i_a", "v_a")}, "duty": duty}
        if letter in "st":
            columns |= {c: np.full(len(duty), np.nan) for c in ("omega", "i_a", "v_a")}
        bags.write(place / f"{letter}{k}", columns, round(SAMPLE_PERIOD * 1e9))

    for letter, k in {(name[0], int(name[1:])) for sets in SETS.values() for names in sets for name in names}:
        repeated(letter, k)
    effects = ["", "", *np.random.default_rng(SEED).permutation(uncalibrated.SHOWS)[:DRIVEN - 2].tolist()]
    Parallel(jobs)([*(delayed(calibrated)(k, row) for k, row in enumerate(blind.plan(CALIBRATED, SEED))),
                    *(delayed(driven)(k, e) for k, e in enumerate(effects)),
                    *(delayed(decay)(k, uncalibrated.DAMPING[k % 3]) for k in range(DECAYS))])


def diagnosed(folder: Path, names: tuple[str, ...], *, fit_nominal: bool) -> dict[str, Any]:
    """The content of `diagnosis.json`, and the augmented model."""
    model = load("bench")
    paths = [folder / "recordings" / name for name in names]
    try:
        if fit_nominal:
            signals = [signals_of(p, None, model, fit_nominal=True) for p in paths]
        else:
            signals = [from_recording(recording.read(str(p)), model.sensing) for p in paths]
        found = diagnose(model, signals, 1, fit_nominal=fit_nominal)
    except RecordingError as error:
        return {"error": str(error).replace(str(folder), "")}
    body = to_json(document(found, list(names), "bench", 0.0))
    after = found.augmented
    sums = [{c: float(np.nansum(x * np.cos(np.arange(len(x))))) for c, x in run.items()}
            for run in (*found.before, *found.after)]
    return {**body, "augmented": {"model": after.model, "sensing": after.sensing, "effects": after.effects},
            "free_runs": sums}


def identified(folder: Path, name: str, method: str) -> dict[str, Any]:
    """The content of `identified.json`."""
    with tempfile.TemporaryDirectory() as out, redirect_stdout(StringIO()), redirect_stderr(StringIO()) as said:
        code = identify.main([str(folder / "recordings" / name), "--method", method, "--model", "bench", "--out",
                              f"{out}/here"])
        if code:
            return {"error": said.getvalue().replace(str(folder), "")}
        body = json.loads((Path(out) / "here" / "identified.json").read_text())
    return {k: v for k, v in body.items() if k not in ("seconds", "bag")}


def whole_plant() -> dict[str, Any]:
    """70 s of the plant with every effect on."""
    model = load("bench").with_effects(
        {e: {n: p.default for n, p in effect.parameters.items()} for e, effect in CATALOGUE.items()})
    read, truth = rig.record(model, cases.duty_signal(np.random.default_rng(SEED), 70.0), seed=1)
    out: dict[str, Any] = {}
    for name, x in [*read.items(), *((f"true {n}", x) for n, x in truth.items())]:
        out[name] = {"sha256": hashlib.sha256(x.tobytes()).hexdigest(), "rms": float(np.sqrt(np.nanmean(x * x))),
                     "last": float(x[-1])}
    return out


def controlled(law: str) -> dict[str, Any]:
    """The row of each effect of the control table."""
    return {e: {"without": control_table.figures(law, control_table.BENCH, control_table.models(e, False)[0]),
                "with": control_table.figures(law, control_table.models(e, False)[1],
                                              control_table.models(e, False)[0])}
            for e in control_table.EFFECTS}


def run(folder: Path, name: str, jobs: int, only: list[str]) -> None:
    """Write the results of this tree, one file each."""
    out = folder / name
    out.mkdir(parents=True, exist_ok=True)
    tasks: dict[str, Callable[[], dict[str, Any]]] = {}

    def add(task: str, function: Callable[..., dict[str, Any]], *args: Any, **options: Any) -> None:
        if not only or any(task.startswith(o) for o in only):
            tasks[task] = lambda: function(*args, **options)

    add("plant", whole_plant)
    for law in control_table.LAWS:
        add(f"control_{law}", controlled, law)
    for row in IDENTIFIED:
        add(f"identify_{'_'.join(row)}", identified, folder, *row)
    for kind, sets in SETS.items():
        for names in sets:
            add(f"set_{kind}_{'_'.join(names)}", diagnosed, folder, names, fit_nominal=kind == "uncalibrated")
    for path in sorted((folder / "recordings").glob("[cud]*")):
        add(path.name, diagnosed, folder, (path.name,), fit_nominal=not path.name.startswith("c"))

    def one(task: str) -> None:
        (out / f"{task}.json").write_text(json.dumps(tasks[task](), indent=1))

    Parallel(jobs)(delayed(one)(task) for task in tasks)


def differences(old: Any, new: Any, rtol: float, path: str = "") -> Iterator[str]:
    """Each place where two documents differ by more than a relative `rtol`, as a line."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys([*old, *new]):
            if key not in old or key not in new:
                yield f"{path}/{key}: only in the {'old' if key in old else 'new'} results"
            elif key not in TEXTS and not (key == "sha256" and rtol > 0.0):
                yield from differences(old[key], new[key], rtol, f"{path}/{key}")
    elif isinstance(old, list) and isinstance(new, list):
        if len(old) != len(new):
            yield f"{path}: {len(old)} entries, now {len(new)}"
        for k, (a, b) in enumerate(zip(old, new)):
            yield from differences(a, b, rtol, f"{path}/{k}")
    elif isinstance(old, float) and isinstance(new, float):
        if not (old == new or math.isclose(old, new, rel_tol=rtol) or (math.isnan(old) and math.isnan(new))):
            yield f"{path}: {old!r}, now {new!r} ({abs(new - old) / max(abs(old), 1e-300):.1e} relative)"
    elif old != new:
        yield f"{path}: {old!r}, now {new!r}"


def compare(folder: Path, old: str, new: str, rtol: float, most: int) -> int:
    """Print what differs; returns how many of the results do."""
    names = sorted(p.name for p in (folder / new).glob("*.json"))
    missing = sorted({p.name for p in (folder / old).glob("*.json")} - set(names))
    differ = 0
    for name in names:
        before, after = (json.loads((folder / tree / name).read_text()) for tree in (old, new))
        lines = list(differences(before, after, rtol))
        differ += bool(lines)
        for line in lines[:most]:
            print(f"{name}{line}")
        if len(lines) > most:
            print(f"{name}: {len(lines) - most} more")
    print(f"{len(names)} results compared, {differ} differ" + (f", {len(missing)} not run" if missing else ""))
    return differ


def main() -> int:
    """The command; returns its exit code: 1 if results differ."""
    parser = argparse.ArgumentParser(prog="regression", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    for name, operands in (("inputs", ()), ("run", ("name",)), ("compare", ("old", "new"))):
        sub = commands.add_parser(name)
        sub.add_argument("folder", type=Path)
        for operand in operands:
            sub.add_argument(operand)
        if name == "compare":
            sub.add_argument("--rtol", type=float, default=0.0, help="relative difference that passes (default 0)")
            sub.add_argument("--most", type=int, default=5, help="lines a result (default 5)")
        else:
            sub.add_argument("--jobs", type=int, default=2)
        if name == "run":
            sub.add_argument("--only", nargs="*", default=[], help="results whose names begin so")
    options = parser.parse_args()
    folder = options.folder.resolve()
    if options.command == "inputs":
        inputs(folder, options.jobs)
    elif options.command == "run":
        run(folder, options.name, options.jobs, options.only)
    else:
        return 1 if compare(folder, options.old, options.new, options.rtol, options.most) else 0
    return 0


if __name__ == "__main__":
    sys.exit(main())
