# SPDX-License-Identifier: Apache-2.0
"""How far verdicts depend on each decision threshold: diagnose recordings with each one at 70 % and at 130 %.

python -m evaluation.sensitivity                  about an hour on two cores; goes on where it was stopped
python -m evaluation.sensitivity --minutes 20     what 20 minutes allow, the thresholds of the search first
python -m evaluation.sensitivity --only search.   thresholds whose name holds this
python -m evaluation.sensitivity --list           every threshold with its origin; diagnoses nothing
python -m evaluation.sensitivity --docs           write docs/results/thresholds.md from what was measured
"""

from __future__ import annotations

import argparse
import hashlib
import inspect
import json
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed

from evaluation import results
from evaluation.sensitivity import page, reads, recordings
from evaluation.sensitivity.changed import changed, new_constant
from evaluation.sensitivity.thresholds import Threshold, modules, thresholds

RESULTS = results.ROOT / "sensitivity-results"
PAGE = results.ROOT / "docs" / "results" / "thresholds.md"

FIRST = ("policy.", "search.search.", "search.selection.", "search.hypotheses.", "search.unknown_effect.",
         "search.gust.", "search.speed_spikes.", "joint_fit.", "search.", "pwm_timing.", "priors.", "noise.", "pulses.",
         "outliers.", "free_decay.", "signals.signals.", "statistics.", "nominal_fit.", "chain.", "regions.",
         "conclude.", "estimation.", "from_bag.", "grid.")
"""Parts of names of thresholds, in the order in which they are measured; the rest comes last."""

@dataclass(frozen=True)
class Task:
    """A change of a threshold, and the recordings that are still to be diagnosed with it.

    Attributes:
        threshold: that is changed.
        factor: on its value.
        full: recordings that it acts on from the beginning.
        late: recordings that it acts on from the identified nominal model on.
        considered: these, and those that it cannot act on.
    """

    threshold: Threshold
    factor: float
    full: list[str]
    late: list[str]
    considered: list[str]


def unchanged(folder: Path, jobs: int) -> dict[str, Any]:
    """Make the recordings and diagnose them with unchanged thresholds, once for each source of the diagnosis.

    If another source gives other verdicts, the results with changed thresholds are out of date, and are removed.
    """
    kept, source = folder / "unchanged.json", digest()
    old: dict[str, Any] = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {"recordings": {}}
    if old.get("source") == source:
        return old

    def one(name: str) -> tuple[str, dict[str, Any]]:
        recordings.make(folder, name)
        verdict = recordings.diagnosed(folder, name, keep=True)
        with reads.watched() as seen:
            recordings.diagnosed(folder, name)
        return name, {"verdict": verdict, "lines": {part: sorted(lines) for part, lines in seen.items()}}

    folder.mkdir(parents=True, exist_ok=True)
    (folder / ".gitignore").write_text("*\n", encoding="utf-8")
    rows = dict(Parallel(jobs)(delayed(one)(name) for name in recordings.NAMES))
    body: dict[str, Any] = {"commit": results.first_line("git", "rev-parse", "--short", "HEAD"),
                            "date": date.today().isoformat(), "source": source, "recordings": rows}
    if any(row["verdict"] != rows[name]["verdict"] for name, row in old["recordings"].items()):
        (folder / "varied.jsonl").unlink(missing_ok=True)
    kept.write_text(json.dumps(body), encoding="utf-8")
    return body


def digest() -> str:
    """Of the source of the diagnosis: numbers of lines hold for one source only."""
    return hashlib.sha256("".join(inspect.getsource(m) for m in modules()).encode()).hexdigest()


def tasks(found: list[Threshold], rows: Mapping[str, Any], have: page.Rows) -> Iterator[Task]:
    """What is still to be diagnosed, the most important first."""
    lines = {name: {part: {tuple(line) for line in row["lines"][part]} for part in row["lines"]}
             for name, row in rows.items()}
    for threshold in sorted(found, key=_rank):
        if page.not_varied(threshold):
            continue
        read = reads.lines_of(threshold)
        for factor in page.FACTORS:
            done = have.get((threshold.id, factor), {"considered": ()})["considered"]
            left = [n for n in rows if n not in done]
            late = [n for n in left if not recordings.is_calibrated(n) and read & lines[n][reads.AFTER]
                    and not read & lines[n][reads.BEFORE]]
            full = [n for n in left if n not in late and read & (lines[n][reads.BEFORE] | lines[n][reads.AFTER])]
            if left:
                yield Task(threshold, factor, full, late, left)


def _rank(threshold: Threshold) -> int:
    return next((k for k, part in enumerate(FIRST) if part in f"{threshold.id}."), len(FIRST))


def varied(folder: Path, task: Task, deadline: float) -> dict[str, Any] | None:
    """The verdicts with one changed threshold; None: the time was up before."""
    if time.time() > deadline:
        return None
    t, value = task.threshold, task.threshold.scaled(task.factor)
    with changed(t.module, t.constant, new_constant(t, value)):
        verdicts = {name: recordings.diagnosed(folder, name, kept=name in task.late) for name in task.full + task.late}
    return {"threshold": t.id, "of": t.value, "factor": task.factor, "value": value, "considered": task.considered,
            "verdicts": verdicts}


def measured(folder: Path) -> dict[tuple[str, float], dict[str, Any]]:
    """The results so far, by threshold and factor; those of other values are left out."""
    path = folder / "varied.jsonl"
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []
    now = {(t.id, factor): [t.value, t.scaled(factor)] for t in thresholds() for factor in page.FACTORS}
    found: dict[tuple[str, float], dict[str, Any]] = {}
    for row in rows:
        key = row["threshold"], row["factor"]
        if now.get(key) == [row["of"], row["value"]]:
            entry = found.setdefault(key, {"considered": [], "verdicts": {}})
            entry["considered"] += row["considered"]
            entry["verdicts"] |= row["verdicts"]
    return found


def run(folder: Path, jobs: int, minutes: float, only: str) -> None:
    """Diagnose with each threshold changed, and append each result to a file as it comes."""
    rows = unchanged(folder, jobs)["recordings"]
    deadline = time.time() + 60.0 * minutes
    left = [t for t in tasks(thresholds(), rows, measured(folder)) if only in t.threshold.id]
    print(f"{len(left)} changes of thresholds to diagnose, {sum(len(t.full) + len(t.late) for t in left)} diagnoses")
    with (folder / "varied.jsonl").open("a", encoding="utf-8") as out:
        for row in Parallel(jobs, return_as="generator_unordered", batch_size=1)(
                delayed(varied)(folder, task, deadline) for task in left):
            if row is not None:
                out.write(json.dumps(row) + "\n")
                out.flush()


def main() -> None:
    """Measure, list, or write the page."""
    parser = argparse.ArgumentParser(prog="sensitivity", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of recordings and results")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--minutes", type=float, default=600.0, help="time after which no further change is begun")
    parser.add_argument("--only", default="", help="thresholds whose name holds this")
    parser.add_argument("--list", action="store_true", help="list every threshold with its origin")
    parser.add_argument("--docs", action="store_true", help=f"write {PAGE.relative_to(results.ROOT)}")
    options = parser.parse_args()
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if options.list:
        for t in thresholds():
            print(f"{t.id} = {t.value:g}{f' {t.unit}' if t.unit else ''}: {', '.join(t.origins) or 'NO ORIGIN'}")
    elif options.docs:
        before = json.loads((options.out / "unchanged.json").read_text(encoding="utf-8"))
        PAGE.write_text(page.page(thresholds(), before, measured(options.out)), encoding="utf-8")
    else:
        run(options.out, options.jobs, options.minutes, options.only)


if __name__ == "__main__":
    main()
