# SPDX-License-Identifier: Apache-2.0
"""The command `investigate`: experiments on a running rig, one after another, until the verdict is sure.

The excitation and the recorder are separate processes. The excitation sends duty 0 at its end, however it ends, so that
the motor is off between experiments.
"""

from __future__ import annotations

import argparse
import os
import shlex
import signal
import sys
import time
from collections.abc import Sequence
from datetime import datetime
from functools import partial
from pathlib import Path

from rclpy.context import Context
from rclpy.node import Node
from rich.console import Console

from aeropend_ident.commands.design import add_limits, limits_of, reach_lines
from aeropend_ident.commands.programs import ProgramError, made, record_excited
from aeropend_ident.design import page
from aeropend_ident.design.design import LENGTH
from aeropend_ident.design.investigation import Investigation, Proposal
from aeropend_ident.diagnosis.diagnosis import Diagnosis
from aeropend_ident.diagnosis.document import DiagnosisDocument
from aeropend_ident.diagnosis.isolation.planned import planned
from aeropend_ident.diagnosis.results import Results, document, verdict_lines
from aeropend_ident.interrupt import interrupts_wait
from aeropend_ident.result_folder import write_page
from aeropend_ident.signals.from_bag import signals_of
from aeropend_ident.signals.signals import CHANNELS
from aeropend_sim.cli.command import Parser, between, called, entry_point, own
from aeropend_sim.cli.progress import Show, progress
from aeropend_sim.errors import UserError
from aeropend_sim.model import effect_file, excitation_file
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import PRESETS, load
from aeropend_sim.ros import interface
from aeropend_sim.untrusted import printable

NOT_SURE = 1
"""Exit code if the verdict is not sure (convention: 1 is the answer no)."""

PATIENCE = 10.0
"""[s] Time in which a running rig is found (choice: discovery takes about a second)."""

SETTLED = 3.0
"""[s] Time in which all publishers are known, after a subscriber is (choice: discovery takes about a second)."""

OFF = "interrupted; the motor is off"
"""The line after Ctrl-C."""

LOOK = 0.1
"""[s] Time between two looks at the graph (choice)."""

EXAMPLES = """examples:
  investigate --model my_rig.yaml --theta -0.6 1.0 --current 2       ask before each experiment
  investigate --yes --most 60                                        do not ask; at most a minute of motion
  plant --ros-args -p effects.thrust_lag.tau:=0.03 & investigate --yes      a simulated rig
  investigate --ros-args -r __ns:=/rig1                              the rig in a namespace

A plant or a bridge must run, and no controller. Ctrl-C stops the motor.

exit codes: 0 the verdict is sure, 1 it is not (the last line says why), 2 it could not run, 130 interrupted"""


@entry_point("investigate", OFF)
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    arguments, ros = own(given), given[len(own(given)):]
    options = parse(arguments)
    signal.signal(signal.SIGTERM, lambda *_: (_ for _ in ()).throw(KeyboardInterrupt()))
    if not options.yes and not sys.stdin.isatty():
        raise ProgramError("it asks before each experiment, and there is no terminal: give --yes if nobody need agree")
    further, limits, model = effect_file.load_all(options.effects), limits_of(options), load(options.model)
    console, command = Console(stderr=True), shlex.join(["investigate", *arguments])
    wait_for_rig(ros)
    folder = Path(options.out or f"investigation_{datetime.now():%Y%m%d-%H%M%S}")
    made(folder)
    signals = planned(model, Excitation(duration=10.0).series(), options.channels or tuple(CHANNELS))
    inquiry = Investigation(model, signals, limits, options.most, further=further, jobs=options.jobs,
                            tries=options.tries)
    bags: list[str] = []
    judged = 0
    started = time.monotonic()

    def diagnosed(found: Diagnosis) -> DiagnosisDocument:
        return document(found, bags, options.model, time.monotonic() - started)

    try:
        while True:
            with progress("designing") as show, interrupts_wait():
                proposal = inquiry.next(partial(_shown, show))
            if proposal is None:
                break
            place = folder / str(len(bags) + 1)
            place.mkdir()
            announce(proposal, place, command)
            if not options.yes and not agreed():
                inquiry.ended = "The experiment was refused."
                break
            wait_for_rig(ros)  # since the last time the rig may have ended, or somebody may have begun to drive it
            bag = place / "recording"
            record_excited(bag, ["--params-file", str(place / "experiment.yaml")],
                           proposal.designed.excitation.duration, environment={**os.environ, "PYTHONUNBUFFERED": "1"},
                           console=console, namespace=ros[1:])
            with progress("reading") as show:
                read = signals_of(bag, None, model)
                bags.append(str(bag))
                with interrupts_wait():
                    found = inquiry.add(read, diagnosed, partial(_shown, show))
            results = Results.of(found, diagnosed(found), command)
            results.write(folder / "verdict", overwrite=True)  # the next experiment may fail
            judged = len(bags)
            print("\n".join(map(printable, verdict_lines(results.document, advice=False))), flush=True)
    except UserError as error:
        raise ProgramError(f"{error}{_left(folder, bags, judged, options)}") from error
    except KeyboardInterrupt:
        raise KeyboardInterrupt(printable(f"{OFF}{_left(folder, bags, judged, options)}")) from None
    if judged:
        print(printable(f"{folder / 'verdict' / 'report.html'}   {folder / 'verdict' / 'augmented.yaml'}"))
    print(printable(f"{len(bags)} experiments, {inquiry.moved:.0f} s of motion. {inquiry.ended}"))
    return 0 if inquiry.sure else NOT_SURE


def _left(folder: Path, bags: Sequence[str], judged: int, options: argparse.Namespace) -> str:
    """What an inquiry that is broken off leaves, for the end of its line."""
    done = f"; {folder / 'verdict'} has the verdict so far" if judged else ""
    if len(bags) > judged:
        words = [*bags, "--model", options.model, *(word for file in options.effects for word in ("--effects", file))]
        done += f"; diagnose what is recorded: {called('diagnose', 'aeropend_ident')} {shlex.join(words)}"
    return done


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Read the command line; exits with code 2 and one line if it is wrong."""
    parser = Parser(prog="investigate", epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
                    description="Excite a running rig, record and diagnose it, design the next experiment, and so on "
                                "until the verdict is sure or more would not help.")
    parser.add_argument("--model", default="bench", metavar="PRESET|FILE",
                        help=f"nominal model: {' or '.join(PRESETS)}, or a model file (default: bench)")
    parser.add_argument("--channels", nargs="+", choices=list(CHANNELS), metavar="CHANNEL",
                        help=f"what the rig measures: some of {', '.join(CHANNELS)} (default: all)")
    add_limits(parser)
    parser.add_argument("--most", type=between(LENGTH, 3600.0, "a time", "s"), default=120.0, metavar="S",
                        help="motion in all, s; default 120")
    parser.add_argument("--effects", action="append", default=[], metavar="FILE",
                        help="effect file: effects by formula that are tried too; may be given several times")
    parser.add_argument("--yes", action="store_true", help="do not ask before an experiment")
    parser.add_argument("--tries", type=int, metavar="N",
                        help="signals that are tried for an experiment (default: as many as take about a minute)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, metavar="N",
                        help="processes (default: one a core)")
    parser.add_argument("--out", metavar="DIR", help="new folder for everything (default: investigation_<time>)")
    options = parser.parse_args(arguments)
    if options.jobs < 1:
        parser.error(f"--jobs {options.jobs}: give 1 or more")
    if options.tries is not None and options.tries < 1:
        parser.error(f"--tries {options.tries}: give 1 or more")
    return options


def wait_for_rig(ros: Sequence[str]) -> None:
    """Wait until a plant or a bridge listens to the duty, and make sure that nobody else drives it.

    Args:
        ros: ROS arguments, which may name the namespace.

    Raises:
        ProgramError: no rig runs, or a controller does.
    """
    context = Context()
    context.init(args=list(ros))
    try:
        node = Node("investigate", context=context)
        topic = node.resolve_topic_name(interface.DUTY_COMMAND)
        end = time.monotonic() + PATIENCE
        while not node.count_subscribers(topic) and time.monotonic() < end:
            time.sleep(LOOK)
        if not node.count_subscribers(topic):
            raise ProgramError(f"no rig listens to {topic}: start a plant or a bridge first")
        end = time.monotonic() + SETTLED  # who drives it may be discovered after who listens
        while not node.count_publishers(topic) and time.monotonic() < end:
            time.sleep(LOOK)
        if node.count_publishers(topic):
            raise ProgramError(f"something drives the rig on {topic} already: stop the controller or the excitation "
                               "first")
    finally:
        context.try_shutdown()


def announce(proposal: Proposal, place: Path, command: str) -> None:
    """Write the files of the next experiment, and say what comes.

    Args:
        proposal: the experiment.
        place: its folder.
        command: the command line that led here.
    """
    best = proposal.designed
    excitation_file.save(best.excitation, place / "experiment.yaml", f"{command}: to {proposal.why}")
    write_page(place / "experiment.html", page.render(best, proposal.rows, command, "experiment.yaml"))
    x = best.excitation
    print(printable(f"experiment {place.name}: {x.duration:g} s, to {proposal.why}"))
    for line in (f"duty {min(x.sequence):g} to {max(x.sequence):g}", *reach_lines(best)):
        print(printable(f"  {line}"))
    print(printable(f"  {place / 'experiment.html'}"), flush=True)


def _shown(show: Show, what: str, share: float) -> None:
    """Show the progress of a design or of a diagnosis."""
    show(share, what)


def agreed() -> bool:
    """Whether a person agrees to the experiment."""
    try:
        return input("play it? [y/N] ").strip().lower() in ("y", "yes")
    except EOFError:
        return False


if __name__ == "__main__":
    sys.exit(main())
