# SPDX-License-Identifier: Apache-2.0
"""The command `design`: an experiment that shows most of what is asked, within the limits of a rig."""

from __future__ import annotations

import argparse
import json
import math
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table

from aeropend_ident.commands.isolate import sizes_of
from aeropend_ident.design import page
from aeropend_ident.design.design import LENGTH, Designed, design
from aeropend_ident.design.goals import NOTHING, Answer, Goal, Numbers, any_effect, between
from aeropend_ident.design.limits import Limits
from aeropend_ident.design.responses import Rows, asked
from aeropend_ident.diagnosis import document, typed_json
from aeropend_ident.diagnosis.isolation.planned import PlanError, planned
from aeropend_ident.diagnosis.left_open import Open, as_refitted, left_open
from aeropend_ident.diagnosis.report.number_format import plain, plain_quantity
from aeropend_ident.interrupt import interrupts_wait
from aeropend_ident.result_folder import ensure_new, write_page
from aeropend_ident.signals.from_bag import signals_of
from aeropend_ident.signals.signals import CHANNELS
from aeropend_sim.cli.command import EXIT_CODES, Parser, as_seed, called, entry_point, own
from aeropend_sim.cli.command import between as within
from aeropend_sim.cli.progress import progress
from aeropend_sim.model import effect_file, excitation_file
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import MODEL_NAMES, PRESETS, load
from aeropend_sim.untrusted import printable

EXAMPLES = f"""examples:
  design                                              20 s that show any effect, and tell it from the others
  design --separate thrust_lag encoder_lag            tell two effects apart
  design --separate cable_torque angle_offset --shortest    the same in as short a time as possible
  design --verdict my_diagnosis                       tell apart what a verdict could not
  design --fix k_thrust J_m                           make numbers of the model better known
  design --theta -0.5 1.0 --current 2 --duty-rate 1   limits that hold for every rig within the uncertainty
  design my_bag --model my_rig.yaml                   channels and noise of a recording
  design --html experiment.html                       a page with the picture

The signal is written as a parameter file of excite. Limits hold for all rigs whose numbers are up to 5 % off, with any
of the effects, until the arm has fallen back after the end.

{EXIT_CODES}"""

SHORTEST, LONGEST = 5.0, 120.0
"""[s] Lengths that may be asked for.

Choice: a diagnosis needs some seconds, and the search of a longer signal takes long."""

MOST_TIME = 600.0
"""[s] Time of motion that is still proposed (choice)."""

UNITS = {"theta": "rad", "omega": "rad/s", "i_a": "A"}


@entry_point("design")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    arguments = own(arguments)
    options = parse(arguments)
    further = effect_file.load_all(options.effects)
    limits = limits_of(options)
    out = Path(options.out)
    html = Path(options.html) if options.html else None
    ensure_new(out, "--out", overwrite=options.overwrite)
    if html is not None:
        ensure_new(html, "--html", overwrite=options.overwrite)
    model, sizes, open_ = load(options.model), sizes_of(options.size), Open((), {}, 0.0)
    if options.verdict:
        found = document.read(Path(options.verdict) / "diagnosis.json")
        model, open_ = as_refitted(model, found), left_open(found)
        sizes = {**open_.sizes, **sizes}
    with progress("reading") as show:
        if options.bag:
            signals = signals_of(options.bag, options.namespace, model)
        else:
            signals = planned(model, Excitation(duration=10.0).series(), options.channels or tuple(CHANNELS))
        effects = asked(model, further, sizes)
        with interrupts_wait():
            rows = Rows(model, signals, effects)
            best = design(rows, _goal(options, rows, open_, list(effects)), limits,
                          None if options.shortest else options.duration, tries=options.tries, seed=options.seed,
                          jobs=options.jobs, progress=lambda what, share: show(share, what))
    command = shlex.join(["design", *arguments])
    excitation_file.save(best.excitation, out, f"Written by: {command}\n{'; '.join(reach_lines(best))}")
    if html is not None:
        write_page(html, page.render(best, rows, command, out.name))
    if options.json:
        print(json.dumps(typed_json.to_json(best), indent=1, ensure_ascii=False))
    else:
        print_tables(best)
        print(printable(f"{out}: play it with {called('excite', 'aeropend_control')} --ros-args --params-file "
                        f"{shlex.quote(str(out))}"))
    return 0


def _goal(options: argparse.Namespace, rows: Rows, open_: Open, names: Sequence[str]) -> Goal:
    """What the experiment is for."""
    if options.fix:
        return Numbers(rows, options.fix)
    chosen = options.separate or open_.names
    if wrong := [n for n in chosen if n not in names]:
        raise PlanError(f"'{printable(wrong[0])}' is no effect that can be told from others here; give some of "
                        f"{', '.join(rows.effects)}, or parameter_mismatch:K_t")
    return between(rows, chosen) if chosen else any_effect(rows, list(rows.effects))


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line; exits with code 2 and one line if it is wrong."""
    parser = Parser(prog="design", epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
                    description="Design an experiment: the duty signal that shows most of what is asked, within limits "
                                "that every rig within the uncertainty of the model keeps.")
    parser.add_argument("bag", nargs="?", metavar="BAG", help="a recording whose channels and noise are taken")
    parser.add_argument("--model", default="bench", metavar="PRESET|FILE",
                        help=f"nominal model: {' or '.join(PRESETS)}, or a model file (default: bench)")
    parser.add_argument("--namespace", metavar="NS", help="namespace of the rig, if the bag has several")
    parser.add_argument("--channels", nargs="+", choices=list(CHANNELS), metavar="CHANNEL",
                        help=f"what is measured besides the command: some of {', '.join(CHANNELS)} (default: all)")
    goal = parser.add_mutually_exclusive_group()
    goal.add_argument("--separate", nargs="+", metavar="EFFECT", help="effects to be told apart (default: any effect)")
    goal.add_argument("--fix", nargs="+", choices=list(MODEL_NAMES), metavar="NUMBER",
                      help="numbers of the model that should become better known")
    goal.add_argument("--verdict", metavar="DIR", help="results of `diagnose`: what it could not tell apart")
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--duration", type=within(SHORTEST, LONGEST, "a time", "s"), default=LENGTH, metavar="S",
                        help=f"length, s; default {LENGTH:g}")
    length.add_argument("--shortest", action="store_true",
                        help="the shortest length with which all that is asked is told apart")
    add_limits(parser)
    parser.add_argument("--size", action="append", default=[], metavar="EFFECT=X",
                        help="size of an effect, in its unit (default: its usual size); may be given several times")
    parser.add_argument("--effects", action="append", default=[], metavar="FILE",
                        help="effect file: effects by formula that are looked at too; may be given several times")
    parser.add_argument("--tries", type=int, metavar="N",
                        help="signals that are tried (default: as many as take about a minute on two cores)")
    parser.add_argument("--seed", type=as_seed, default=0, help="seed of the search; default 0")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N",
                        help="processes (default: one a core)")
    parser.add_argument("--out", default="experiment.yaml", metavar="FILE",
                        help="file of the signal; default experiment.yaml")
    parser.add_argument("--html", metavar="FILE", help="write a page with the picture")
    parser.add_argument("--overwrite", action="store_true", help="replace files that are there")
    parser.add_argument("--json", action="store_true", help="print everything as JSON instead of a table")
    options = parser.parse_args(arguments)
    if options.bag and options.channels:
        parser.error("a bag has its own channels: leave --channels out")
    if options.namespace and not options.bag:
        parser.error("--namespace tells the rigs of a recording apart: name a BAG, or leave it out")
    if options.jobs < 1:
        parser.error(f"--jobs {options.jobs}: give 1 or more")
    if options.tries is not None and options.tries < 1:
        parser.error(f"--tries {options.tries}: give 1 or more")
    return options


def add_limits(parser: argparse.ArgumentParser) -> None:
    """Add the options of limits to a command line.

    Args:
        parser: of the command.
    """
    default = Limits()
    parser.add_argument("--theta", nargs=2, type=within(-10.0, 10.0, "an angle", "rad"), default=list(default.theta),
                        metavar=("MIN", "MAX"), help="limits of the angle, rad; default ±π/2")
    parser.add_argument("--speed", type=within(0.0, 1e5, "a speed", "rad/s"), default=math.inf, metavar="X",
                        help="limit of the rotor's speed, rad/s")
    parser.add_argument("--current", type=within(0.0, 1e4, "a current", "A"), default=math.inf, metavar="X",
                        help="limit of the current, A")
    parser.add_argument("--duty", nargs=2, type=within(-1.0, 1.0, "a duty"), default=list(default.duty),
                        metavar=("MIN", "MAX"), help="limits of the duty; default {:g} {:g}".format(*default.duty))
    parser.add_argument("--duty-rate", type=within(0.0, 1e3, "a rate", "1/s"), default=0.0, metavar="X",
                        help="limit of the duty's rate, 1/s; default 0: it may jump")


def limits_of(options: argparse.Namespace) -> Limits:
    """The limits that a command line gives.

    Args:
        options: with those of `add_limits`.

    Raises:
        LimitError: they make no sense.
    """
    return Limits((options.theta[0], options.theta[1]), options.speed, options.current,
                  (options.duty[0], options.duty[1]), options.duty_rate)


def reach_lines(best: Designed) -> Iterator[str]:
    """What each channel with a limit reaches at most on any rig within the uncertainty, and what is left."""
    for channel, (low, high) in best.limits.ranges.items():
        least, greatest = best.reach[channel]
        if math.isfinite(high):
            unit = UNITS[channel]
            left = min(high - greatest, least - low)
            reach = f"{plain(least, 2)} to {plain_quantity(greatest, unit, 2)}"
            yield (f"{channel}: at most {reach} on any rig within 5 %, {plain_quantity(left, unit, 2)} from its limit")


def print_tables(best: Designed) -> None:
    """Print what an experiment shows."""
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=10_000)
    x = best.excitation
    lines = [f"{x.duration:g} s of {len(x.holds)} holds, duty {min(x.sequence):g} to {max(x.sequence):g}",
             *reach_lines(best), f"limits kept by {best.draws} of {best.draws} drawn rigs"]
    for line in lines:
        console.print(printable(line), markup=False, soft_wrap=True)
    numbers = all(not a.rival for a in best.answers)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("number" if numbers else "effect")
    if not numbers:
        table.add_column("closest rival")
    table.add_column("better known, factor" if numbers else "apart, standard deviations", justify="right")
    table.add_column(f"best signal of diagnose ({best.best_before})", justify="right")
    table.add_column("enough", justify="right")
    before = {a.of: a for a in best.answers_before}
    for a in sorted(best.answers, key=lambda a: a.reached):
        rival = "nothing" if a.rival == NOTHING else a.rival
        was = plain(before[a.of].value, 2) if a.of in before else "-"
        table.add_row(a.of, *([] if numbers else [rival]), plain(a.value, 2), was, plain(a.wanted, 2))
    console.print(table)
    if short := [a for a in best.answers if a.reached < 1.0]:
        console.print(printable(f"not enough for: {', '.join(a.of for a in short)}. {_what_helps(best, short)}"),
                      markup=False, soft_wrap=True)


def _what_helps(best: Designed, short: Sequence[Answer]) -> str:
    """What to do about effects that a signal does not show well enough."""
    others = "larger limits or another channel may help"
    needed = best.excitation.duration / max(min(a.reached for a in short), 1e-9) ** 2  # grows with the square root
    if needed > MOST_TIME:
        return f"A longer time does not help; {others}."
    return f"About {plain(needed, 2)} s of such signals are needed in all, in one recording or in several; {others}."


if __name__ == "__main__":
    sys.exit(main())
