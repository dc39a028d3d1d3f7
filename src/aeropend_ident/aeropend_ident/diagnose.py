# SPDX-License-Identifier: Apache-2.0
"""The command `diagnose`: recordings in, verdict out.

Exit code 0 with a verdict, 2 with one line on standard error when the input cannot be used.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shlex
import shutil
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NoReturn

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from aeropend_ident import recording
from aeropend_ident.gap import report
from aeropend_ident.gap.diagnosis import Diagnosis, diagnose
from aeropend_ident.gap.signals import Signals, from_recording
from aeropend_sim.effects import CATALOGUE, PARAMETER_MISMATCH
from aeropend_sim.parameters import PARAMETERS, PRESETS, Model, ModelError, load, save

FORMAT = 1
FILES = ("diagnosis.json", "report.html", "augmented.yaml")

EXAMPLES = """examples:
  diagnose my_bag                                compare a recording with the preset 'bench'
  diagnose monday tuesday --model rig.yaml       several recordings of one rig, fitted together
  diagnose my_bag --out verdict --jobs 2         choose the folder and the number of threads
  plant --ros-args --params-file verdict/augmented.yaml      run the model with what was found

exit codes: 0 a verdict was written, 2 the input cannot be used (one line says why), 130 interrupted"""


class OutputError(ValueError):
    """The results cannot be written; the message is one line for a person."""


class Parser(argparse.ArgumentParser):
    """Says what is wrong with a command line in one line."""

    def error(self, message: str) -> NoReturn:
        """End with exit code 2."""
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line; exits with 2 and one line where it is wrong."""
    parser = Parser(
        prog="diagnose", epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Compare recordings of a rig with its model: where they part, which effect the model is missing, "
                    "and how far the gap closes once it is added.")
    parser.add_argument("bags", nargs="+", metavar="BAG", help="a recording (folder, .mcap or .db3) of one rig")
    parser.add_argument("--model", default="bench", metavar="PRESET|FILE",
                        help=f"nominal model: {' or '.join(PRESETS)}, or a model file (default: bench)")
    parser.add_argument("--out", metavar="DIR", help="folder for the results (default: diagnosis_<name of the bag>)")
    parser.add_argument("--namespace", metavar="NS", help="namespace of the rig, when a bag holds several")
    parser.add_argument("--held-out", type=_share, default=0.3, metavar="SHARE",
                        help="share at the end of each recording kept for testing (default: 0.3)")
    parser.add_argument("--jobs", type=_jobs, default=os.cpu_count() or 1, metavar="N",
                        help="threads (default: one a core)")
    parser.add_argument("--fit-nominal", action="store_true",
                        help="the model's numbers are only a guess: fit them within a factor of three first")
    parser.add_argument("--overwrite", action="store_true", help="replace results that are in the folder already")
    return parser.parse_args(arguments)


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.05 <= value <= 0.8:
        raise argparse.ArgumentTypeError(f"'{text}' is not a share between 0.05 and 0.8")
    return value


def _jobs(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number of threads from 1 on")
    return int(text)


def document(diagnosis: Diagnosis, bags: Sequence[str], model: str, seconds: float) -> dict[str, object]:
    """The content of `diagnosis.json` (contract section 5)."""
    signals = diagnosis.signals
    duration = sum(len(s) * s.period for s in signals)
    train = sum(s.train * s.period for s in signals)
    return {"format": FORMAT, "bags": list(bags), "model": model, "duration_s": round(duration, 3),
            "samples": sum(len(s) for s in signals), "train_s": [0.0, round(train, 3)],
            "held_out_s": [round(train, 3), round(duration, 3)], **diagnosis.body,
            "notes": [note for s in signals for note in s.notes], "seconds": round(seconds, 2)}


def verdict_lines(body: Mapping[str, object]) -> list[str]:
    """The verdict in a few lines for the terminal."""
    which, where, shrink = body["which"], body["where"], body["shrink"]
    assert isinstance(which, dict)
    assert isinstance(where, dict)
    assert isinstance(shrink, dict)
    lines = []
    if which["verdict"] == "none":
        lines.append("verdict: none. The model explains the recording once its numbers are refitted.")
    elif which["verdict"] == "unknown":
        lines.append(f"verdict: unknown. Something in the {where['place']} that the catalogue does not explain: "
                     + "; ".join(which["unexplained"]) + ".")
    else:
        lines.append(f"verdict: {' and '.join(which['effects'])} ({where['place']})")
    found = {c["effect"]: c for c in reversed(which["candidates"])}
    lines += [f"  {effect}: {describe(found[effect])}" for effect in which["effects"]]
    lines += [f"  not separable from this recording: {' and '.join(pair)}" for pair in which["not_separable"]]
    if which["next_experiment"]:
        lines.append(f"  next: {experiment(which['next_experiment'])}")
    gap, after, bottom = (100.0 * shrink[k] for k in ("gap", "gap_after", "floor"))
    line = f"gap on held-out data: {gap:.1f} % of the signals' spread, {after:.1f} % with the augmented model"
    if shrink["closed"] is None:
        lines.append(f"{line}, floor {bottom:.1f} %: nothing to close")
    else:
        interval = "" if shrink["low"] is None else f" ({100 * shrink['low']:.0f} to {100 * shrink['high']:.0f} %)"
        lines.append(f"{line}, floor {bottom:.1f} %: {100 * shrink['closed']:.0f} %{interval} of what can close")
    return lines


def experiment(advice: Mapping[str, object]) -> str:
    """The advised experiment as a command."""
    parameters = advice["excite"]
    assert isinstance(parameters, dict)
    command = "excite --ros-args " + " ".join(f"-p {k}:={v}" for k, v in parameters.items())
    return f"{command} ({advice['why']})" if parameters else str(advice["why"])


def describe(candidate: Mapping[str, object]) -> str:
    """A candidate's parameters with units and 95 % intervals."""
    parameters = candidate["parameters"]
    assert isinstance(parameters, dict)
    texts = []
    for name, p in parameters.items():
        if candidate["effect"] == PARAMETER_MISMATCH:
            unit = PARAMETERS[f"model.{name}"].unit
        else:
            unit = CATALOGUE[str(candidate["effect"])].parameters[name].unit
        texts.append(f"{name} = {p['value']:.4g} ({p['low']:.4g} to {p['high']:.4g}) {unit}")
    return ", ".join(texts)


def write(out: Path, files: Mapping[str, str], augmented: Model, comment: str, *, overwrite: bool) -> None:
    """Write all results, or none.

    Raises:
        OutputError: the folder cannot be made or written, or holds results already.
    """
    taken = [name for name in FILES if (out / name).exists()]
    if taken and not overwrite:
        raise OutputError(f"{out}: holds {taken[0]} already; give another --out, or --overwrite to replace it")
    made = not out.exists()
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=out, prefix=".writing_") as place:
            for name, text in files.items():
                (Path(place) / name).write_text(text, encoding="utf-8")
            save(augmented, Path(place) / "augmented.yaml", comment)
            for name in FILES:
                (Path(place) / name).replace(out / name)
    except OSError as error:
        if made:
            shutil.rmtree(out, ignore_errors=True)
        raise OutputError(f"{out}: the results cannot be written: {error.strerror}; "
                          "give another folder with --out or make room") from None


def run(options: argparse.Namespace, command: str, console: Console) -> Diagnosis:
    """Diagnose and write the results.

    Raises:
        RecordingError, ModelError, OutputError: the input or the output cannot be used.
    """
    started = time.monotonic()
    out = Path(options.out or f"diagnosis_{Path(options.bags[0]).stem}")
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: is a file; --out takes a folder")
    if not options.overwrite and (taken := [name for name in FILES if (out / name).exists()]):
        raise OutputError(f"{out}: holds {taken[0]} already; give another --out, or --overwrite to replace it")
    model = load(options.model)
    signals: list[Signals] = []
    with Progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), console=console,
                  transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("reading", total=1.0)
        signals += [from_recording(recording.read(bag, options.namespace), model.sensing, options.held_out)
                    for bag in options.bags]
        result = diagnose(model, signals, options.jobs, fit_nominal=options.fit_nominal,
                          progress=lambda what, share: bar.update(task, description=what, completed=share))
    body = document(result, options.bags, options.model, time.monotonic() - started)
    lines = [f"note: {note}" for s in signals for note in s.notes] + verdict_lines(body)
    files = {"diagnosis.json": json.dumps(body, indent=1, allow_nan=False) + "\n",
             "report.html": report.render(result, body, command)}
    write(out, files, result.augmented, f"{command}\n" + "\n".join(lines), overwrite=options.overwrite)
    print("\n".join(lines))
    print(f"{out / 'report.html'}   {out / 'augmented.yaml'}   {body['seconds']} s")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    if "--ros-args" in arguments:  # as a node it takes no ROS arguments, but ros2 run may pass some
        arguments = arguments[: arguments.index("--ros-args")]
    options = parse(arguments)
    try:
        run(options, shlex.join(["diagnose", *arguments]), Console(stderr=True))
    except (recording.RecordingError, ModelError, OutputError) as error:
        print(f"diagnose: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("diagnose: interrupted, nothing written", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
