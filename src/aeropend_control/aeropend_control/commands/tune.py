# SPDX-License-Identifier: Apache-2.0
"""Calculate the gains of a law for a model and requirements, and show the stability margins and step responses."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping, Sequence

from rich import box
from rich.console import Console
from rich.table import Table

from aeropend_control.analysis import closed_loop
from aeropend_control.analysis.margins import MarginError, Margins, margins
from aeropend_control.analysis.step_response import StepError, StepResponse, step_responses
from aeropend_control.laws.registry import LAWS, GainError, LawKind, Requirements, TuningError
from aeropend_sim.cli.command import EXIT_CODES, Parser, entry_point, given
from aeropend_sim.cli.progress import Show, nothing, progress
from aeropend_sim.model.parameters import Model, load
from aeropend_sim.wording import enumerated

LEVELS = {"theta": (0.2, 0.4, 0.7), "omega": (60.0, 99.5, 140.0)}
"""[rad], [rad/s] Steps from rest that are simulated, and operating points of the margins; 99.5 rad/s is the thesis'
950 RPM, the others are choices."""

HOLD = 5.0
"""[s] Time for which a step is simulated (choice)."""

SMOOTHING = {"theta": 0.06, "omega": 0.0}
"""[s] Smoothing of a step response, by what is measured; a simulated speed needs none (choices)."""

EXAMPLES = f"""examples:
  tune feedback_linearization
  tune small_signal --model verdict/augmented.yaml --t-s 2
  tune cascade --gains thesis

{EXIT_CODES}"""


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line; exits with code 2 and one line if it is wrong."""
    parser = Parser(prog="tune", description=__doc__, epilog=EXAMPLES,
                    formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("law", choices=list(LAWS), metavar="LAW", help=f"one of {', '.join(LAWS)}")
    parser.add_argument("--model", default="bench", metavar="PRESET|FILE",
                        help="preset (bench, thesis) or model file (default: bench)")
    parser.add_argument("--gains", metavar="PRESET", help="show a set of gains instead of tuning: thesis")
    for name, unit in (("t_r", "s"), ("t_p", "s"), ("t_s", "s"), ("M_p", "share")):
        parser.add_argument("--" + name.lower().replace("_", "-"), dest=name, type=float, metavar=unit.upper(),
                            help=f"greatest {name}, {unit} (default: the thesis' requirement)")
    return parser.parse_args(arguments)


def chosen_gains(kind: LawKind, model: Model, options: argparse.Namespace) -> dict[str, float]:
    """Gains by the options of the command line.

    Args:
        kind: the law.
        model: the model of the rig.
        options: of the command line.

    Raises:
        GainError: there is no such preset, or a preset and a requirement are given.
        TuningError: a requirement cannot be met, or has no influence.
    """
    if options.gains is not None:
        if options.gains not in kind.presets:
            raise GainError(f"no gains '{options.gains}'; give one of {', '.join(kind.presets)}")
        if words := given(options, Requirements._fields):
            raise GainError(f"--gains {options.gains} is shown as it is: leave {enumerated(words)} out")
        return dict(kind.presets[options.gains])
    if idle := given(options, [name for name in Requirements._fields if name not in kind.uses]):
        raise TuningError(f"{options.law} is tuned by {enumerated([*kind.uses])} alone: leave {enumerated(idle)} out")
    wanted = {name: getattr(options, name) for name in kind.uses if getattr(options, name) is not None}
    return kind.tune(model, kind.requirements._replace(**wanted))


def gains_table(kind: LawKind, gains: Mapping[str, float]) -> Table:
    """Table with a row for each gain (values by name)."""
    out = Table(box=box.SIMPLE)
    for name in ("gain", "value", "unit", "meaning"):
        out.add_column(name, justify="right" if name == "value" else "left")
    for name, gain in kind.parameters.items():
        out.add_row(name, f"{gains[name]:.5g}", gain.unit, gain.description)
    return out


def responses_table(law: str, model: Model, gains: Mapping[str, float], show: Show = nothing) -> Table:
    """Table with a row for each level: the simulated response to a step from rest, and the margins at the level.

    Args:
        law: its name in `LAWS`.
        model: the model of the rig.
        gains: by name.
        show: gets the share that is done.
    """
    kind = LAWS[law]
    out = Table(box=box.SIMPLE)
    headings = (f"step to / {kind.reference_unit}", "t_r / s", "t_p / s", "t_s / s", "M_p / %", "gain margin",
                "phase margin / °", "delay margin / ms", "crossover / rad/s")
    for heading in headings:
        out.add_column(heading, justify="right")
    levels = LEVELS[kind.measures]
    for number, level in enumerate(levels):
        show(number / len(levels))
        out.add_row(f"{level:g}", *_response(kind, model, gains, level), *_margins(law, model, gains, level))
    return out


def _response(kind: LawKind, model: Model, gains: Mapping[str, float], level: float) -> list[str]:
    run = closed_loop.predict(kind.make(model, gains), model, closed_loop.staircase([level], HOLD))
    try:
        s: StepResponse = step_responses(run.time, run.truth[kind.measures], run.reference,
                                         SMOOTHING[kind.measures])[0]
    except StepError:
        return ["-"] * 4
    return [_number(s.rise_time, 3), _number(s.peak_time, 3), _number(s.settling_time, 2), f"{100.0 * s.overshoot:.1f}"]


def _margins(law: str, model: Model, gains: Mapping[str, float], level: float) -> list[str]:
    try:
        m: Margins = margins(model, law, gains, level)
    except MarginError:
        return ["does not rest", "-", "-", "-"]
    return [_number(m.gain, 2), _number(math.degrees(m.phase), 0), _number(1e3 * m.delay, 0), _number(m.crossover, 1)]


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-" if math.isnan(value) else "any"


@entry_point("tune")
def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code."""
    options = parse(arguments)
    kind = LAWS[options.law]
    model = load(options.model)
    gains = chosen_gains(kind, model, options)
    console = Console(width=130)
    console.print(f"{options.law} on {model.name}: {kind.summary}")
    console.print(gains_table(kind, gains))
    with progress("simulating steps and margins") as show:
        responses = responses_table(options.law, model, gains, show)
    console.print(responses)
    return 0


if __name__ == "__main__":
    sys.exit(main())
