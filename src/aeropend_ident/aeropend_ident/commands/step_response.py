# SPDX-License-Identifier: Apache-2.0
"""The command that describes the step responses in a recording; what a step response is, aeropend_control knows.

A reference counts from the first sample recorded after it, until the next.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console

from aeropend_control.analysis import step_report
from aeropend_control.analysis.step_response import StepError, step_responses
from aeropend_control.laws.registry import LAWS
from aeropend_ident.bags.mending import named
from aeropend_ident.bags.recording import Recording, read
from aeropend_ident.result_folder import OutputError
from aeropend_ident.signals import mistakes
from aeropend_sim.cli.command import EXIT_CODES, Parser, entry_point
from aeropend_sim.untrusted import printable
from aeropend_sim.wording import counted

SHORTEST_S = 1.0
"""A last step held for less is left out: recordings end at any time."""

FOLLOWS = 0.1
"""Median distance from the references, over that of what the law controls, below which another reading follows them
(choice: radians and radians per second differ by more)."""

EXAMPLES = f"""\
examples:
  step_response my_bag
  step_response my_bag --law cascade --plot steps.svg

{EXIT_CODES}"""


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line; exits with 2 and one line where it is wrong."""
    parser = Parser(
        prog="step_response", epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Print t_r, t_p, t_s, M_p and the steady-state error of every step of the reference in a "
                    "recording, beside what they may be at most.")
    parser.add_argument("bag", metavar="BAG", help="a rosbag2 folder, or a bare .mcap or .db3 file")
    parser.add_argument("--law", choices=LAWS, default="feedback_linearization",
                        help="the controller that ran: says what was controlled, and its limits; default %(default)s")
    parser.add_argument("--namespace", help="the rig, when the recording holds several")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="draw reference, response and duty into an SVG file")
    parser.add_argument("--overwrite", action="store_true", help="replace FILE if it is there")
    options = parser.parse_args(arguments)
    if options.plot is not None and options.plot.exists() and not options.overwrite:
        parser.error(f"{options.plot} exists: give another --plot, or --overwrite")
    return options


def columns(recording: Recording, law: str) -> tuple[step_report.Array, dict[str, step_report.Array]]:
    """Time (M,) and columns (M,) from the first reference on, on a grid.

    Args:
        recording: with references.
        law: a key of `LAWS`; references out of its range, which it refuses, do not count.

    Raises:
        StepError: no reference, or no response to it.
    """
    kind = LAWS[law]
    low, high = kind.reference_limits
    taken = (recording.reference >= low) & (recording.reference <= high)
    at, levels = recording.reference_ns[taken], recording.reference[taken]
    if not len(at):
        raise StepError(f"{recording.path} holds no reference for {law} ({low:g} to {high:g} {kind.reference_unit})"
                        f"{_why(recording.reference)}")
    number = np.searchsorted(at, recording.received_ns, side="right")
    used = number > 0
    if not used.any() or not np.isfinite(getattr(recording, kind.measures)[used]).any():
        raise StepError(f"{recording.path} holds no {kind.measures} after the first reference")
    read_ = {name: getattr(recording, name)[used] for name in ("theta", "omega", "i_a", "v_a", "duty")}
    try:
        time, grid, _ = step_report.on_grid(recording.t[used], read_, recording.period)
    except StepError as error:
        raise StepError(f"{recording.path}: {error}") from None
    before = np.searchsorted(recording.t[used], time + 0.5 * recording.period) - 1
    grid["reference"] = levels[number[used] - 1][before]
    last = int(np.flatnonzero(np.diff(grid["reference"], prepend=np.nan))[-1])
    if last > 0 and time[-1] - time[last] < SHORTEST_S:
        time, grid = time[:last], {name: values[:last] for name, values in grid.items()}
    return time, grid


def _why(reference: step_report.Array) -> str:
    """What is to be done where no reference (L,) counts."""
    known = reference[np.isfinite(reference)]
    if not len(reference):
        return ": record the topic reference while the controller gets its steps (step_test)"
    if not len(known):
        return f": all {len(reference)} references are NaN or infinite; correct the program that publishes them"
    return (f": its references go from {known.min():.4g} to {known.max():.4g}; give the --law that ran, or publish "
            "them in its unit")


def remarks(recording: Recording, law: str) -> list[str]:
    """What to know of the references and the angle of a recording: what is left out, and what looks mistaken."""
    kind = LAWS[law]
    low, high = kind.reference_limits
    out = []
    left = recording.reference[~((recording.reference >= low) & (recording.reference <= high))]
    if len(left):
        first = f"{left[0]:.4g}" if np.isfinite(left[0]) else "NaN or infinite"
        out.append(f"{counted(len(left), 'reference')} beyond {low:g} to {high:g} {kind.reference_unit} left out, as "
                   f"the controller refuses it (first {first})")
    likely = mistakes.without_model(recording.theta, recording.duty, recording.i_a, recording.v_a)
    return out + [named(mistakes.said([one]), recording.path) for one in likely]


def other_law(grid: dict[str, step_report.Array], law: str) -> list[str]:
    """What to know where the references fit another measured variable than that of the law.

    Args:
        grid: columns (M,) on a grid.
        law: a key of `LAWS`.
    """
    mine = LAWS[law].measures
    off = {kind.measures: float(np.nanmedian(np.abs(grid[kind.measures] - grid["reference"])))
           for kind in LAWS.values() if np.isfinite(grid[kind.measures]).any()}
    return [f"{measured} follows these references, {mine} does not: give --law {' or '.join(laws)}, if that ran"
            for measured in off if off[measured] < FOLLOWS * off[mine]
            and (laws := [name for name, kind in LAWS.items() if kind.measures == measured])]


def run(options: argparse.Namespace) -> None:
    """Read, describe, print, draw.

    Raises:
        RecordingError, StepError: the recording cannot be used.
        OutputError: the drawing cannot be written.
    """
    kind = LAWS[options.law]
    recording = read(options.bag, options.namespace)
    time, grid = columns(recording, options.law)
    y = grid[kind.measures]
    try:
        described = step_responses(time, y, grid["reference"])
    except StepError as error:
        raise StepError(f"{recording.path}: {error}") from None
    if options.plot is not None:
        drawing = step_report.draw(time, grid["reference"], y, grid["duty"], recording.path,
                                   f"{kind.measures} / {kind.reference_unit}")
        try:
            options.plot.write_text(drawing, encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{options.plot} cannot be written: {error.strerror}") from None
    console = Console(width=None if sys.stdout.isatty() else 120)
    for note in (*recording.notes, *remarks(recording, options.law), *other_law(grid, options.law)):
        print(printable(f"note: {note}"))
    console.print(step_report.table({options.law: described}, {options.law: kind.reference_unit}))


@entry_point("step_response")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    run(parse(arguments))
    return 0


if __name__ == "__main__":
    sys.exit(main())
