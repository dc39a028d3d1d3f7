# SPDX-License-Identifier: Apache-2.0
"""`make real DATA=folder`: diagnose recordings of real rigs, beside a grey box that is fitted by hand.

The folder holds the tables of the rigs and a file `rigs.csv`, with a line for each recording: name; rig (recordings of
one rig have the same); file; the options of `import` that say what its columns are; what is known of it. The marks
between the cells are semicolons. Example:

    name;rig;file;options;known
    monday;mine;monday.csv;--time t:s --theta angle:deg --duty pwm:%;the pivot is dry

`make real ARGS="--drawn 20 --seed 5"` draws rigs that might lie on a desk instead; see `drawn_rigs`.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import shlex
import shutil
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.commands import import_table
from aeropend_ident.diagnosis.diagnosis import Diagnosis, diagnose
from aeropend_ident.diagnosis.document import CANNOT_TELL
from aeropend_ident.diagnosis.results import Results, document
from aeropend_ident.signals.from_bag import signals_of
from aeropend_ident.signals.signals import Signals
from aeropend_ident.tables.table import TableError
from aeropend_ident.testing import bags
from aeropend_sim.model.parameters import load
from evaluation.blind.page import markdown
from evaluation.real import drawn_rigs, grey_box

FLAT = -1e5
"""[%] Fit below which the angle counts as flat: no model has a fit there (choice)."""

COLUMNS = ("name", "rig", "file", "options", "known")


@dataclass(frozen=True)
class Rig:
    """A line of `rigs.csv`."""

    name: str
    rig: str
    file: str
    options: str
    known: str


@dataclass(frozen=True)
class Row:
    """What a recording gave.

    Attributes:
        name: of the recording.
        rig: of which it is.
        known: of it.
        fitted: [%] fit of the free run on the fitted part: of the nominal model, the augmented one, the grey box.
        unseen: [%] the same on the part that nothing was fitted to.
        verdict: effects claimed with their shares, or why there is no verdict.
        effects: ids of the effects claimed.
        seconds: that the diagnosis took.
        own: ids of effects that the identified nominal model holds.
    """

    name: str
    rig: str
    known: str
    fitted: tuple[float, ...]
    unseen: tuple[float, ...]
    verdict: str
    effects: tuple[str, ...]
    seconds: float
    own: tuple[str, ...] = ()


def rigs_of(folder: Path) -> list[Rig]:
    """The lines of `rigs.csv`.

    Raises:
        SystemExit: the file cannot be used; one line says why.
    """
    path = folder / "rigs.csv"
    try:
        with path.open(encoding="utf-8", newline="") as file:
            lines = list(csv.DictReader(file, delimiter=";"))
    except (OSError, UnicodeDecodeError) as error:
        raise SystemExit(f"real: {path}: cannot be read: {error}") from None
    missing = [c for c in COLUMNS if lines and c not in lines[0]]
    if missing or not lines:
        raise SystemExit(f"real: {path}: needs a first line {';'.join(COLUMNS)} and a line for each recording")
    return [Rig(*((line[c] or "").strip() for c in COLUMNS)) for line in lines]


def row(rig: Rig, folder: Path, out: Path, *, peer: bool, jobs: int) -> Row:
    """Import a table, diagnose it, and fit the grey box to it."""
    def signals() -> Signals:
        bag = out / "bags" / rig.name
        words = [str(folder / rig.file), str(bag), *shlex.split(rig.options)]
        import_table.run(import_table.parse(words), words)
        return signals_of(bag, None, load("bench"), fit_nominal=True)

    return judged(rig, signals, out, peer=peer, jobs=jobs)


def drawn_row(seed: int, k: int, out: Path, *, peer: bool, jobs: int) -> Row:
    """Diagnose a drawn rig, and fit the grey box to it."""
    d = drawn_rigs.draw(np.random.default_rng([seed, k]))
    known = ", ".join(f"{n} {v:.3g}" if isinstance(v, float) else f"{n} {v}" for n, v in d.about.items())
    print(known, flush=True)

    def signals() -> Signals:
        bag = out / "bags" / f"drawn-{k}"
        nothing = np.full(len(d.duty), np.nan)
        bags.write(bag, {"theta": d.theta, "omega": nothing, "i_a": nothing, "v_a": nothing, "duty": d.duty},
                   round(d.period * 1e9))
        return signals_of(bag, None, load("bench"), fit_nominal=True)

    return judged(Rig(f"drawn-{k}", f"drawn-{k}", "", "", known), signals, out, peer=peer, jobs=jobs)


def judged(rig: Rig, of: Callable[[], Signals], out: Path, *, peer: bool, jobs: int) -> Row:
    """Diagnose a recording, and fit the grey box to it."""
    none = Row(rig.name, rig.rig, rig.known, (), (), "", (), 0.0)
    started, model = time.monotonic(), load("bench")
    try:
        signals = of()
        started = time.monotonic()
        found = diagnose(model, [signals], jobs, fit_nominal=True)
    except (RecordingError, TableError) as error:
        return Row(**{**vars(none), "verdict": f"refused: {error}", "seconds": time.monotonic() - started})
    seconds = time.monotonic() - started
    results = Results.of(found, document(found, [rig.name], "bench", seconds), shlex.join(["diagnose", rig.name]))
    results.write(out / rig.name, overwrite=True)
    print("\n".join(results.lines))
    runs = [found.before[0]["theta"], found.after[0]["theta"]]
    if peer and signals.driven:
        runs.append(grey_box.fit(np.arange(len(signals)) * signals.period, signals.theta, signals.duty,
                                 signals.train).theta)
    fitted, unseen = _fits(runs, signals)
    which = found.conclusions.which
    return Row(rig.name, rig.rig, rig.known, fitted, unseen, _said(found), tuple(which.effects), seconds,
               tuple(found.model.effects))


def _fits(runs: Sequence[np.ndarray], signals: Signals) -> tuple[tuple[float, ...], tuple[float, ...]]:
    n = signals.train
    return (tuple(grey_box.fit_percent(run[:n], signals.theta[:n]) for run in runs),
            tuple(grey_box.fit_percent(run[n:], signals.theta[n:]) for run in runs))


def _said(found: Diagnosis) -> str:
    which = found.conclusions.which
    shares = {c.effect: c.share for c in which.candidates if c.share is not None}
    claimed = [f"{e} ({100.0 * shares[e].value:.0f} %)" if e in shares else e for e in which.effects]
    text = ", ".join(claimed) or which.verdict
    return text if which.verdict != "unknown" or not claimed else f"unknown beside {text}"


def contradicted(rows: Sequence[Row]) -> dict[str, list[str]]:
    """Name -> effects claimed that another recording of the same rig shows neither as a claim nor in its own model.

    A recording that cannot tell contradicts nothing.
    """
    out = {}
    for r in rows:
        others = [{*o.effects, *o.own} for o in rows if o.rig == r.rig and o is not r and o.fitted
                  and o.verdict != CANNOT_TELL]
        out[r.name] = [e for e in r.effects if others and not all(e in o for o in others)]
    return out


def table(rows: Sequence[Row]) -> list[str]:
    """The rows as a Markdown table."""
    lines = [["recording", "fitted part: nominal, augmented, grey box", "unseen part", "verdict", "own model holds",
              "time"]]
    contradictions = contradicted(rows)
    for r in rows:
        said = r.verdict + (f"; not in another recording: {', '.join(contradictions[r.name])}"
                            if contradictions[r.name] else "")
        lines.append([r.name, _percents(r.fitted), _percents(r.unseen), said, ", ".join(r.own),
                      f"{r.seconds:.1f} s"])
    return markdown(lines)


def _percents(fits: Sequence[float]) -> str:
    return ", ".join(f"{f:.0f} %" if f > FLAT else "at rest" for f in fits)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the table; returns the exit code."""
    parser = argparse.ArgumentParser(prog="real", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="folder with rigs.csv")
    parser.add_argument("--drawn", type=int, metavar="N", help="so many drawn rigs in place of the folder")
    parser.add_argument("--seed", type=int, default=1, help="of the drawn rigs (default: 1)")
    parser.add_argument("--out", type=Path, default=Path("real_results"), help="folder for the verdicts")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="these recordings")
    parser.add_argument("--no-peer", action="store_true", help="do not fit the grey box")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="threads")
    options = parser.parse_args(arguments)
    if (options.data is None) == (options.drawn is None):
        parser.error("give a folder with rigs.csv (DATA=folder), or --drawn N")
    chosen = [] if options.data is None else [
        r for r in rigs_of(options.data) if not options.only or r.name in options.only]
    options.out.mkdir(exist_ok=True)
    (options.out / ".gitignore").write_text("*\n", encoding="utf-8")
    shutil.rmtree(options.out / "bags", ignore_errors=True)
    rows = []
    for rig in chosen:
        print(f"== {rig.name}: {rig.known}", flush=True)
        rows.append(row(rig, options.data, options.out, peer=not options.no_peer, jobs=options.jobs))
        print(table(rows[-1:])[-1], flush=True)
    for k in range(options.drawn or 0):
        rows.append(drawn_row(options.seed, k, options.out, peer=not options.no_peer, jobs=options.jobs))
        print(table(rows[-1:])[-1], flush=True)
    print("\n".join(["", *table(rows)]))
    made: Mapping[str, object] = {"rows": [asdict(r) for r in rows]}
    (options.out / "results.json").write_text(json.dumps(made, indent=1), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
