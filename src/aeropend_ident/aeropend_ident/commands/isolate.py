# SPDX-License-Identifier: Apache-2.0
"""The command `isolate`: which effects a recording would show and tell apart, said before it is made."""

from __future__ import annotations

import argparse
import json
import math
import os
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table

from aeropend_ident.diagnosis import typed_json
from aeropend_ident.diagnosis.experiment_design import EXPERIMENTS
from aeropend_ident.diagnosis.isolation.isolate import Isolation, Sensor, isolate
from aeropend_ident.diagnosis.isolation.planned import PlanError, like, planned
from aeropend_ident.diagnosis.report import isolation as page
from aeropend_ident.diagnosis.report.number_format import plain_quantity
from aeropend_ident.interrupt import interrupts_wait
from aeropend_ident.result_folder import ensure_new, write_page
from aeropend_ident.signals.from_bag import signals_of
from aeropend_ident.signals.signals import CHANNELS
from aeropend_sim.cli.command import EXIT_CODES, Parser, as_seed, between, entry_point, given, own
from aeropend_sim.cli.progress import progress
from aeropend_sim.model import effect_file, excitation_file
from aeropend_sim.model.effects import CATALOGUE, DEFINED
from aeropend_sim.model.excitation import KINDS, LONGEST, Excitation
from aeropend_sim.model.parameters import PRESETS, load
from aeropend_sim.untrusted import printable
from aeropend_sim.wording import enumerated

EXAMPLES = f"""examples:
  isolate                                             half a minute of random steps, all channels
  isolate --model my_rig.yaml --duration 60           a rig of your own, and a longer recording
  isolate --channels theta v_a                        only the angle and the voltage are measured
  isolate --channels theta                            the angle and the command alone
  isolate --experiment 7                              a signal that `diagnose` proposes, 1 to {len(EXPERIMENTS)}
  isolate --signal experiment.yaml                    a signal that `design` wrote
  isolate my_bag --model my_rig.yaml                  the duty, the channels and the noise of a recording
  isolate --effects my_effects.yaml --forms           effects by formula, and other forms of effects, too
  isolate --size coulomb_friction=0.05                pairs at another size than the usual one
  isolate --html pairs.html                           the matrix of pairs as a page
  isolate --json > isolation.json                     for a program

A size is the distance from the value at which the effect is absent. `not at all` means not up to ten usual sizes.

{EXIT_CODES}"""

LENGTH = 30.0
"""[s] Length of a signal if none is given (choice)."""

USUAL = 1.5
"""Factor on a smallest size from which a sensor matters (choice: less is hardly worth a sensor)."""


@entry_point("isolate")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    arguments = own(arguments)
    options = parse(arguments)
    further = effect_file.load_all(options.effects)
    model = load(options.model)
    sizes = sizes_of(options.size)
    html = Path(options.html) if options.html else None
    if html is not None:
        ensure_new(html, "--html", overwrite=options.overwrite)
    with progress("reading") as show:
        if options.bag:
            signals = signals_of(options.bag, options.namespace, model)
            recorded = partial(like, model, signals)
            channels = options.channels or [c for c in CHANNELS if signals.has(c)]
        else:
            recorded = partial(planned, model, _signal(options).series())
            channels = options.channels or list(CHANNELS)
        with interrupts_wait():
            found = isolate(model, recorded, channels, further, sizes, forms=options.forms,
                            sensors=not options.no_sensors, jobs=options.jobs,
                            progress=lambda what, share: show(share, what))
    if html is not None:
        write_page(html, page.render(found, shlex.join(["isolate", *arguments])))
    if options.json:
        print(json.dumps(typed_json.to_json(found), indent=1, ensure_ascii=False))
    else:
        print_tables(found)
    if html is not None:
        print(printable(str(html)), file=sys.stderr)
    return 0


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line; exits with code 2 and one line if it is wrong."""
    parser = Parser(prog="isolate", epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
                    description="Say before a recording is made which effects `diagnose` would see in it, from which "
                                "size on, and which it could not tell apart.")
    parser.add_argument("bag", nargs="?", metavar="BAG",
                        help="a recording whose duty, channels and noise are taken; without it, a planned signal")
    parser.add_argument("--model", default="bench", metavar="PRESET|FILE",
                        help=f"nominal model: {' or '.join(PRESETS)}, or a model file (default: bench)")
    parser.add_argument("--namespace", metavar="NS", help="namespace of the rig, if the bag has several")
    parser.add_argument("--channels", nargs="+", choices=list(CHANNELS), metavar="CHANNEL",
                        help=f"what is measured besides the command: some of {', '.join(CHANNELS)} (default: all, or "
                             "those of the bag)")
    parser.add_argument("--kind", choices=list(KINDS),
                        help="kind of the signal, as in `excite`; default latin_hypercube")
    parser.add_argument("--experiment", type=int, choices=range(1, len(EXPERIMENTS) + 1), metavar="N",
                        help=f"number of a signal that `diagnose` proposes, 1 to {len(EXPERIMENTS)}: "
                             + ", ".join(f"{k} {e.kind}" for k, e in enumerate(EXPERIMENTS, 1)))
    parser.add_argument("--signal", metavar="FILE", help="a signal that `design` wrote, or parameters of `excite`")
    parser.add_argument("--duration", type=between(5.0, LONGEST, "a time", "s"), metavar="S",
                        help=f"length of the signal, s; default {LENGTH:g}, or that of --signal")
    parser.add_argument("--duty-max", type=between(0.0, 1.0, "a duty"), metavar="X",
                        help="greatest duty of the signal; default that of `excite`")
    parser.add_argument("--seed", type=as_seed, help="seed of the signal; default 0")
    parser.add_argument("--effects", action="append", default=[], metavar="FILE",
                        help="effect file: effects by formula that are looked at too; may be given several times")
    parser.add_argument("--forms", action="store_true", help="list other forms of the effects too: twice the time")
    parser.add_argument("--size", action="append", default=[], metavar="EFFECT=X",
                        help="size at which an effect is told from others, in its unit (default: its usual size); may "
                             "be given several times")
    parser.add_argument("--no-sensors", action="store_true", help="do not try other sets of channels")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N",
                        help="processes (default: one a core)")
    parser.add_argument("--json", action="store_true", help="print everything as JSON instead of tables")
    parser.add_argument("--html", metavar="FILE", help="write a page with the matrix of pairs")
    parser.add_argument("--overwrite", action="store_true", help="replace the file of --html")
    options = parser.parse_args(arguments)
    if options.experiment and options.signal:
        parser.error("--experiment and --signal are two signals: give one")
    for source, told, idle in (("bag", "a bag has its own duty", ("experiment", "signal", "duration", "seed")),
                               ("experiment", "--experiment is a signal", ()),
                               ("signal", "--signal is a signal", ("seed",))):
        if getattr(options, source) and (words := given(options, ("kind", "duty_max", *idle))):
            parser.error(f"{told}: leave {enumerated(words)} out")
    if options.namespace and not options.bag:
        parser.error("--namespace tells the rigs of a recording apart: name a BAG, or leave it out")
    if options.jobs < 1:
        parser.error(f"--jobs {options.jobs}: give 1 or more")
    return options


def _signal(options: argparse.Namespace) -> Excitation:
    if options.signal:
        signal = excitation_file.load(options.signal)
        return signal if options.duration is None else replace(signal, duration=options.duration)
    seconds = LENGTH if options.duration is None else options.duration
    if options.experiment:
        return replace(EXPERIMENTS[options.experiment - 1], duration=seconds, seed=options.seed or 0)
    signal = Excitation(options.kind or "latin_hypercube", seconds, options.seed or 0)
    top = options.duty_max
    if top is None:
        return signal
    return replace(signal, duty_max=top, duty=min(signal.duty, top),
                   sequence=tuple(min(x, top) for x in signal.sequence))


def sizes_of(texts: Sequence[str]) -> dict[str, float]:
    """Effect -> size, of arguments `EFFECT=X`.

    Args:
        texts: the arguments.

    Raises:
        PlanError: no such effect, or no size.
    """
    return dict(map(_size, texts))


def _size(text: str) -> tuple[str, float]:
    """The effect and the size of an argument `EFFECT=X`."""
    effect, _, number = text.partition("=")
    try:
        size = float(number)
    except ValueError:
        size = math.nan
    if effect not in DEFINED or DEFINED[effect].form_of:
        raise PlanError(f"--size {text}: '{effect}' is no effect; give one of {', '.join(CATALOGUE)}, or of an effect "
                        "file")
    if not size > 0.0 or math.isinf(size):
        raise PlanError(f"--size {text}: give a number above 0, as --size {effect}="
                        f"{abs(DEFINED[effect].parameters[DEFINED[effect].size].default):g}")
    return effect, size


def print_tables(found: Isolation) -> None:
    """Print what a recording would show."""
    console = Console(highlight=False)
    if not console.is_terminal:
        console = Console(highlight=False, width=10_000)
    console.print(printable(f"a recording of {found.seconds:.0f} s of {', '.join(found.channels)}; model {found.model};"
                            " each size with a probability of one half"), markup=False, soft_wrap=True)
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in ("effect", "place"):
        table.add_column(heading)
    for heading in ("seen from", "named from", "usual"):
        table.add_column(heading, justify="right")
    table.add_column("not told from, where it is just seen", overflow="fold")
    for e in found.effects:
        sizes = ("not at all" if x is None else plain_quantity(x, e.unit, 2) for x in (e.seen, e.named))
        table.add_row(e.effect, e.place, *sizes, plain_quantity(e.usual, e.unit, 2), ", ".join(e.rivals))
    console.print(table)
    for line in lines(found):
        console.print(printable(line), markup=False, soft_wrap=True)


def lines(found: Isolation) -> list[str]:
    """What is said below the table: pairs that are not told apart, what the equations say, sensors."""
    said = []
    unit = {e.effect: e.unit for e in found.effects}
    for a in found.at_size:
        if a.rivals:
            said.append(f"not told apart: {a.effect} of {plain_quantity(a.size, unit[a.effect], 2)} from "
                        + ", ".join(f"{r} ({100.0 * p:.0f} %)" for r, p in a.rivals.items()))
        elif not a.seen:
            said.append(f"not seen: {a.effect} of {plain_quantity(a.size, unit[a.effect], 2)}")
    if not said:
        said.append("all effects of the given (else usual) sizes are seen, and told from all others")
    if blind := [e for e, s in found.structural.items() if not s.detectable]:
        said.append(f"the equations alone do not let these be seen: {', '.join(blind)}")
    for place in dict.fromkeys(s.equation for s in found.structural.values()):
        alike = [e for e, s in found.structural.items() if s.equation == place and s.detectable]
        if len(alike) > 1:
            said.append(f"in one equation ({place}), so told apart by their form alone: {', '.join(alike)}")
    return [*said, *map(_of_sensor, found.sensors)]


def _of_sensor(s: Sensor) -> str:
    known = {e: f for e, f in s.factor.items() if f is not None and f > 0.0}
    worth = sorted((e for e, f in known.items() if max(f, 1.0 / f) > USUAL), key=lambda e: -abs(math.log(known[e])))
    lost, won = [e for e, f in s.factor.items() if f is None], [e for e, f in s.factor.items() if f == 0.0]
    parts = [f"smallest sizes {', '.join(f'{e} ×{known[e]:.2g}' for e in worth)}"] if worth else []
    parts += [f"no longer seen: {', '.join(lost)}"] if lost else []
    parts += [f"seen only then: {', '.join(won)}"] if won else []
    spared = f"no size changes by more than a factor {USUAL:g}: it {'is not needed' if s.added else 'can be spared'}"
    return f"{'with' if s.added else 'without'} {s.channel}: {'; '.join(parts) or spared}"


if __name__ == "__main__":
    sys.exit(main())
