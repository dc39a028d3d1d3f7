# SPDX-License-Identifier: Apache-2.0
"""Run a rig in a controlled and recorded loop for long, then with faults: `make soak` (ARGS="--minutes 5 --seed 3").

Half of the time goes to steady work beside a program that wants a core: with the plant, then with the bridge and the
emulated board. The other half goes to faults, all of them in an order drawn from the seed, then again; every one gets
its turn, however short the time. Prints what was promised and whether it was kept, and writes it as JSON to
soak-results/.
"""

import argparse
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path
from types import FrameType
from typing import Any

from rclpy.signals import uninstall_signal_handlers
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from aeropend_sim.cli.command import Parser
from evaluation import results
from evaluation.soak.faults import FAULTS
from evaluation.soak.stand import RIGS, BrokenError, Clock, Promise, Stand
from evaluation.soak.steady import Growth, busy, steady
from evaluation.support.graph import Graph, isolate

RESULTS = results.ROOT / "soak-results"
MINUTES = 30.0
EXAMPLES = """examples:
  make soak
  make soak ARGS="--minutes 5 --seed 3"
  make soak ARGS="--minutes 2 --faults kill stop clock"
  make soak ARGS=--docs                the table of the last full run goes into docs/results/soak.md

exit codes: 0 every promise was kept, 1 one was broken, 2 a wrong command line, or no results for the
page, 130 interrupted"""

Say = Callable[[str], None]


def steadily(graph: Graph, folder: Path, seconds: float, seed: int, show: Say
             ) -> tuple[list[Promise], dict[str, object]]:
    """Run the steady half; returns the promises, and by rig how the memory of each process grew."""
    promises: list[Promise] = []
    growths: dict[str, object] = {}
    for rig in RIGS:
        stand = Stand(graph, rig, _folder(folder, "steady", rig), seed)
        with suppress(BrokenError), stand, busy():
            growth: dict[str, Growth] = steady(stand, seconds / len(RIGS), show)
            growths[rig] = {name: asdict(one) for name, one in growth.items()}
            stand.close()
        promises += stand.promises
        shutil.rmtree(folder / f"steady_{rig}")
    return promises, growths


def faulty(graph: Graph, folder: Path, seconds: float, seed: int, names: list[str], show: Say) -> list[Promise]:
    """Run faults, each on each of its rigs once, and on until the time is over; returns the promises."""
    chance, clock = random.Random(seed), Clock(folder)
    promises: list[Promise] = []
    end, turn = time.monotonic() + seconds, 0
    while turn == 0 or time.monotonic() < end:
        for rig in chance.sample(RIGS, len(RIGS)):
            waiting = [name for name in chance.sample(names, len(names)) if rig in FAULTS[name].rigs]
            while waiting and (turn == 0 or time.monotonic() < end):
                # what was broken is thrown away, and the next fault finds a stand in order
                turn_folder = _folder(folder, f"{len(promises)}", rig)
                promises += _faults(graph, rig, turn_folder, chance.randrange(2**32), clock, waiting,
                                    lambda turn=turn: turn == 0 or time.monotonic() < end, show)
        turn += 1
    return promises


def _faults(graph: Graph, rig: str, folder: Path, seed: int, clock: Clock, waiting: list[str],
            goes_on: Callable[[], bool], show: Say) -> list[Promise]:
    """Take faults off the list until one breaks what the others stand on."""
    clock.set(0.0)
    there = len(waiting)
    stand = Stand(graph, rig, folder, seed, clock)
    stand.part = "start"
    with suppress(BrokenError), stand, busy():
        stand.follows()
        while waiting and goes_on():
            stand.part = waiting.pop(0)
            show(f"{rig}: {stand.part}")
            FAULTS[stand.part].run(stand)
            stand.follows("the loop goes on")
        stand.close()
    if len(waiting) == there:  # it never started: no fault can be tried
        waiting.clear()
    shutil.rmtree(folder)
    return stand.promises


def _folder(parent: Path, *names: str) -> Path:
    folder = parent / "_".join(names)
    folder.mkdir()
    return folder


def lines(promises: list[Promise]) -> list[Promise]:
    """What was kept, in a line a promise of the steady half and a line a fault."""
    found: list[Promise] = []
    for part in dict.fromkeys(one.part for one in promises):
        for rig in RIGS:
            ours = [one for one in promises if (one.part, one.rig) == (part, rig)]
            if part in FAULTS and ours:
                ours = [_sum(FAULTS[part].promise, part, rig, ours)]
            elif part in ("start", "end") and ours:
                ours = [_sum("a loop starts" if part == "start" else "Ctrl-C ends all: duty 0, exit code 0, whole bags",
                             part, rig, ours)]
            found += ours
    return found


def _sum(what: str, part: str, rig: str, ours: list[Promise]) -> Promise:
    """Many promises in one: how often, or what was broken."""
    broken = [f"{one.what}: {one.found}" for one in ours if not one.held]
    return Promise(part, rig, what, not broken, "; ".join(broken) or f"{len(ours)} checks")


def table(promises: list[Promise]) -> Table:
    """What was kept, for people at a terminal."""
    shown = Table("part", "rig", "promise", "kept", "found", show_lines=True)
    for one in lines(promises):
        shown.add_row(one.part, one.rig, escape(one.what), "[green]yes" if one.held else "[red]NO", escape(one.found))
    return shown


def readme(document: Mapping[str, Any]) -> str:
    """What was kept as Markdown, and on which machine, when and of what it was tried."""
    rows = ["| part | rig | promise | kept | found |", "| --- | --- | --- | --- | --- |"]
    for one in lines([Promise(**row) for row in document["promises"]]):
        cells = (one.part.replace("_", " "), one.rig, one.what, "yes" if one.held else "**no**", one.found)
        rows.append("| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |")
    of, broken = document["machine"], len(document["broken"])
    said = (f"{document['minutes']:g} minutes with seed {document['seed']} on {of['cpu']}, {of['cores']} cores, Python "
            f"{of['python']}, {document['date'][:10]}, commit {of['commit']}, load {document['load_before'][0]:.1f} at "
            f"the start: {len(document['promises'])} checks, {f'{broken} broken' if broken else 'all kept'}.")
    return "\n".join([*rows, "", said])


def main() -> int:
    """Run what the command line asks for."""
    parser = Parser(prog="soak", description=(__doc__ or "").partition("\n")[0], epilog=EXAMPLES,
                    formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=MINUTES, help=f"how long in all, default {MINUTES:g}")
    parser.add_argument("--seed", type=int, default=1, help="of the order of faults and all that is drawn, default 1")
    parser.add_argument("--faults", nargs="*", default=["all"], metavar="FAULT",
                        help="only those that have this in their names; none: steady work only. "
                        + ", ".join(FAULTS))
    results.offer_page(parser, "soak")
    options = parser.parse_args()
    if options.page is not None:
        try:
            results.show(options.page, "soak", results.full(RESULTS), readme)
        except ValueError as error:
            parser.error(str(error))
        return 0
    if not 0.1 <= options.minutes <= 1e5:
        parser.error("--minutes: give 0.1 or more")
    wanted = [] if options.faults == ["all"] else options.faults
    names = [name for name in FAULTS if options.faults == ["all"] or any(word in name for word in wanted)]
    for word in wanted:
        if not any(word in name for name in FAULTS):
            parser.error(f"--faults: no {word} among {', '.join(FAULTS)}")
    for number in signal.SIGINT, signal.SIGTERM:
        signal.signal(number, _interrupt)
    isolate()
    console = Console(width=None if sys.stdout.isatty() else 160)
    begun, load = time.monotonic(), os.getloadavg()
    seconds = 60.0 * options.minutes
    with tempfile.TemporaryDirectory(prefix="aeropend_soak_") as name, console.status("") as status:

        def show(text: str) -> None:
            status.update(escape(f"{time.monotonic() - begun:5.0f} s  {text}"))

        def say(text: str) -> None:
            console.print(f"[dim]{time.monotonic() - begun:5.0f} s  {escape(text)}")
            show(text)

        graph = Graph()
        uninstall_signal_handlers()
        try:
            say("steady work")
            promises, growth = steadily(graph, Path(name), seconds / 2.0 if names else seconds, options.seed, show)
            if names:
                promises += faulty(graph, Path(name), seconds - (time.monotonic() - begun), options.seed, names, say)
        finally:
            graph.close()
    broken = [one for one in promises if not one.held]
    document = {
        "format": 1, "date": datetime.now(timezone.utc).isoformat(timespec="seconds"), "minutes": options.minutes,
        "full": options.minutes >= MINUTES and len(names) == len(FAULTS),
        "seed": options.seed, "faults": names, "seconds": round(time.monotonic() - begun, 1),
        "machine": results.machine(("ros-jazzy-rclpy", "rosbags", "numpy")),
        "load_before": load, "load_after": os.getloadavg(), "growth": growth,
        "promises": [asdict(one) for one in promises], "broken": [asdict(one) for one in broken],
    }
    path = results.write(document, RESULTS)
    console.print(table(promises))
    console.print(f"{len(promises)} checks in {document['seconds']:.0f} s, "
                  + (f"[red]{len(broken)} broken" if broken else "[green]all kept")
                  + f"[/]. Written to {path} and latest.json beside it.")
    return 1 if broken else 0


def _interrupt(_number: int, _frame: FrameType | None) -> None:
    """End once, and let nothing disturb the ending of the processes."""
    for number in signal.SIGINT, signal.SIGTERM:
        signal.signal(number, signal.SIG_IGN)
    raise KeyboardInterrupt


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
