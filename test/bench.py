# SPDX-License-Identifier: Apache-2.0
"""Measure speed, each figure beside its peer in the same run: `make bench`, or `make bench ARGS=--quick`.

Prints a table and writes it as JSON to bench-results/. Exit code 0 when every target is met, 1 when one is missed or
could not be measured, 2 for a wrong command line.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from benchmarks import bags, control, hardware, identification, nodes, simulation
from benchmarks.measure import Figure, NotMeasuredError, Spread, load
from graph import isolate
from rich.console import Console
from rich.table import Table

from aeropend_sim.command import Parser

RESULTS = Path(__file__).resolve().parent.parent / "bench-results"
FIGURES: dict[str, Callable[[bool], list[Figure]]] = {
    "nominal": simulation.nominal,
    "effects": simulation.all_effects,
    "batch": simulation.batch,
    "compile": simulation.compiling,
    "read": bags.reading,
    "diagnose": bags.diagnosing,
    "sparse-exact": identification.exact,
    "sparse-noise": identification.noise,
    "sparse-rig": identification.chain,
    "sparse-lorenz": identification.study,
    "sparse-speed": identification.speed,
    "plant": nodes.plant,
    "record": nodes.record,
    "bridge": hardware.bridge,
    "frames": hardware.frames,
    "control": control.loop,
}
PACKAGES = ("numpy", "numba", "llvmlite", "scipy", "rosbags", "ros-jazzy-rclpy")
EXAMPLES = """examples:
  make bench ARGS=--quick
  make bench ARGS="--only plant record"

exit codes: 0 every target is met, 1 one is missed or could not be measured, 2 a wrong command line, 130 interrupted"""

QUIET = 0.5
"""Load average below which the machine counts as idle."""


def machine() -> dict[str, object]:
    """What the figures depend on."""

    def first_line(*command: str) -> str:
        try:
            return subprocess.run(command, capture_output=True, text=True, check=True, cwd=RESULTS.parent
                                  ).stdout.partition("\n")[0]
        except (OSError, subprocess.CalledProcessError):
            return "unknown"

    def installed(package: str) -> str:
        try:
            return version(package)
        except PackageNotFoundError:
            return "unknown"

    cpu = [line.partition(":")[2].strip() for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
           if line.startswith("model name")]
    return {"cpu": cpu[0] if cpu else platform.machine(), "cores": os.cpu_count(), "kernel": platform.release(),
            "python": platform.python_version(), **{package: installed(package) for package in PACKAGES},
            "gcc": first_line("gcc", "--version"), "commit": first_line("git", "describe", "--always", "--dirty")}


def number(value: float, unit: str) -> str:
    """A number and its unit, short."""
    text = f"{value:,.0f}" if abs(value) >= 1000.0 or value == 0.0 else f"{value:.3g}"
    return f"{text} {unit}".rstrip(" -")


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


def write(document: dict[str, object], folder: Path) -> Path:
    """Write the results twice, under their date and as latest.json; returns the former."""
    folder.mkdir(exist_ok=True)
    (folder / ".gitignore").write_text("*\n", encoding="utf-8")
    path = folder / f"{datetime.now().astimezone():%Y-%m-%d-%H-%M-%S}.json"
    for one in path, folder / "latest.json":
        one.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return path


def main() -> int:
    """Measure what the command line asks for."""
    parser = Parser(prog="bench", description=(__doc__ or "").partition("\n")[0], epilog=EXAMPLES,
                    formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="shorter and with fewer repeats: 3 minutes, not 25")
    parser.add_argument("--only", nargs="+", choices=FIGURES, metavar="FIGURE", default=list(FIGURES),
                        help=f"measure only these: {', '.join(FIGURES)}")
    options = parser.parse_args()
    console = Console(width=None if sys.stdout.isatty() else 160)
    isolate()
    figures: list[Figure] = []
    missing: list[str] = []
    start, load_before = time.monotonic(), load()
    if load_before > QUIET:
        console.print(f"The machine is busy (load {load_before:.1f}): what runs in several processes or threads will "
                      "look slower than it is.")
    with console.status("") as status:
        for name in options.only:
            status.update(f"measuring {name}")
            console.print(f"[dim]{time.monotonic() - start:4.0f} s  {name} ...")
            try:
                figures += FIGURES[name](options.quick)
            except NotMeasuredError as error:
                missing.append(f"{name}: not measured: {error}")
                console.print(missing[-1], style="yellow", markup=False)
    missed = [one.name for one in figures if one.met is False]
    document = {
        "format": 1, "date": datetime.now(timezone.utc).isoformat(timespec="seconds"), "quick": options.quick,
        "seconds": round(time.monotonic() - start, 1), "machine": machine(), "load_before": load_before,
        "figures": [{**asdict(one), "target": one.target and str(one.target), "met": one.met} for one in figures],
        "not_measured": missing, "missed": missed,
    }
    path = write(document, RESULTS)
    if figures:
        console.print(table(figures))
    console.print(f"Median \\[quartiles]; ratio of times, ours over peer. Written to {path} and latest.json beside it.")
    if missed:
        console.print(f"[red]{len(missed)} of {sum(one.met is not None for one in figures)} targets missed: "
                      + "; ".join(missed))
    if missing:
        console.print(f"[yellow]{len(missing)} could not be measured: see above")
    return 1 if missed or missing else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
