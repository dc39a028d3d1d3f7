# SPDX-License-Identifier: Apache-2.0
"""Measure speed, each figure beside its peer in the same run: `make bench`, or `make bench ARGS=--quick`.

Prints a table and writes it as JSON to bench-results/. Ratios are compared with the last full run of the same machine.
`--docs` measures nothing: it writes the last full run, with the figures measured again since, into
docs/results/bench.md.
"""

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from aeropend_sim.cli.command import Parser
from evaluation import results
from evaluation.benchmarks import (
    bags,
    control,
    estimation,
    export,
    growth,
    hardware,
    history,
    identification,
    nodes,
    readme,
    simulation,
)
from evaluation.benchmarks.measure import Figure, NotMeasuredError, Spread, load, number
from evaluation.support.graph import isolate

RESULTS = results.ROOT / "bench-results"
FIGURES: dict[str, Callable[[bool], list[Figure]]] = {
    "nominal": simulation.nominal,
    "effects": simulation.all_effects,
    "batch": simulation.batch,
    "compile": simulation.compiling,
    "export": export.speed,
    "read": bags.reading,
    "diagnose": bags.diagnosing,
    "diagnose-unknown": bags.unknown,
    "growth-length": growth.length,
    "growth-bags": growth.recordings,
    "growth-effects": growth.effects,
    "sparse-exact": identification.exact,
    "sparse-noise": identification.noise,
    "sparse-rig": identification.chain,
    "sparse-lorenz": identification.study,
    "sparse-speed": identification.speed,
    "optimiser": estimation.optimiser,
    "sparse-fit": identification.fitting,
    "plant": nodes.plant,
    "record": nodes.record,
    "emulator": hardware.emulator,
    "bridge": hardware.bridge,
    "frames": hardware.frames,
    "control": control.loop,
}
PACKAGES = ("numpy", "numba", "llvmlite", "scipy", "rosbags", "pysindy", "ros-jazzy-rclpy")
EXAMPLES = """examples:
  make bench ARGS=--quick
  make bench ARGS="--only plant record"
  make bench ARGS=--docs               the table of the last full run goes into docs/results/bench.md

exit codes: 0 every target is met, 1 one is missed or could not be measured, 2 a wrong command line, or no results for
the page, 3 every target is met but a ratio is over 20 % worse than in the last full run, 130 interrupted"""

QUIET = 0.5
"""Load average below which the machine counts as idle."""


def cell(spread: Spread | None, unit: str) -> str:
    """Median and quartiles."""
    if spread is None:
        return ""
    text = number(spread.median, unit)
    return text if spread.repeats == 1 else f"{text}\n[{number(spread.q1, '')} .. {number(spread.q3, '')}]"


def table(figures: list[Figure]) -> Table:
    """The figures for people."""
    shown = Table("figure", "ours", "peer", "measured", "ratio", "target", "", "load", show_lines=True)
    for one in figures:
        mark = {True: "[green]met", False: "[red]MISSED", None: ""}[one.met]
        name = one.name if not one.note else f"{one.name}\n[dim]{one.note}"
        shown.add_row(name, cell(one.ours, one.unit), one.peer_name, cell(one.peer, one.unit), cell(one.ratio, ""),
                      "" if one.target is None else str(one.target), mark, f"{one.load:.1f}")
    return shown


def measured(names: list[str], quick: bool, console: Console) -> dict[str, object]:
    """Measure, show, and return what is to be written."""
    figures: list[Figure] = []
    missing: list[str] = []
    start, load_before = time.monotonic(), load()
    if load_before > QUIET:
        console.print(f"The machine is busy (load {load_before:.1f}): what runs in several processes or threads will "
                      "look slower than it is.")
    with console.status("") as status:
        for name in names:
            status.update(f"measuring {name}")
            console.print(f"[dim]{time.monotonic() - start:4.0f} s  {name} ...")
            try:
                figures += FIGURES[name](quick)
            except NotMeasuredError as error:
                missing.append(f"{name}: not measured: {error}")
                console.print(missing[-1], style="yellow", markup=False)
    if figures:
        console.print(table(figures))
    return {
        "format": 1, "names": names, "date": datetime.now(timezone.utc).isoformat(timespec="seconds"), "quick": quick,
        "full": not quick and set(names) == set(FIGURES), "seconds": round(time.monotonic() - start, 1),
        "machine": results.machine(PACKAGES) | {"gcc": results.first_line("gcc", "--version")},
        "load_before": load_before,
        "figures": [{**asdict(one), "target": one.target and str(one.target), "met": one.met} for one in figures],
        "not_measured": missing, "missed": [one.name for one in figures if one.met is False],
    }


def main(arguments: list[str] | None = None, folder: Path = RESULTS) -> int:
    """Measure what the command line asks for."""
    parser = Parser(prog="bench", description=(__doc__ or "").partition("\n")[0], epilog=EXAMPLES,
                    formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="shorter and with fewer repeats: a fifth of the time")
    parser.add_argument("--only", nargs="+", choices=FIGURES, metavar="FIGURE", default=list(FIGURES),
                        help=f"measure only these: {', '.join(FIGURES)}")
    results.offer_page(parser, "bench")
    options = parser.parse_args(arguments)
    if options.page is not None:
        try:
            results.show(options.page, "bench", history.renewed(folder), readme.table)
        except ValueError as error:
            parser.error(str(error))
        return 0
    console = Console(width=None if sys.stdout.isatty() else 160)
    isolate()
    document: dict[str, Any] = measured(options.only, options.quick, console)
    then = results.full(folder, document["machine"])
    worse = history.worse(document, then) if then else []
    path = results.write({**document, "compared_with": then and then["date"], "worse": worse}, folder)
    console.print(f"Median \\[quartiles]; ratio: ours over peer. Written to {path} and latest.json beside it.")
    if then and worse:
        console.print(f"[yellow]{len(worse)} ratios are over {100 * history.WORSE:.0f} % worse than on {then['date']}:")
        console.print("\n".join(f"  {line}" for line in worse), f"\n  meanwhile: {history.changed(document, then)}",
                      markup=False, sep="")
    missed, missing = document["missed"], document["not_measured"]
    if missed:
        console.print(f"[red]{len(missed)} of {sum(one['met'] is not None for one in document['figures'])} targets "
                      "missed: " + "; ".join(missed))
    if missing:
        console.print(f"[yellow]{len(missing)} could not be measured: see above")
    return 1 if missed or missing else 3 if worse else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
