# SPDX-License-Identifier: Apache-2.0
"""Measure `watch` without ROS: python -m evaluation.live [--docs].

Each recording is given to the `Watcher` in batches as the node does, much faster than in real time. Rigs whose effect
begins come from the independent plant; hours without a change from the plant of the package, which is fast enough, and
with many imperfections from the independent plant. The seeds are not those with which the detector was made.
"""

from __future__ import annotations

import argparse
import math
import pickle
import sys
import time
import tracemalloc
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.live import false_alarms
from aeropend_ident.live.companion_model import Samples
from aeropend_ident.live.intake import Batch
from aeropend_ident.live.ring import AFTER_S, BEFORE_S
from aeropend_ident.live.watcher import Watcher
from aeropend_ident.signals.signals import from_arrays
from aeropend_sim.model.parameters import load
from evaluation.blind.folder import each
from evaluation.blind.plant import PERIOD
from evaluation.blind.score import wilson
from evaluation.live import rigs
from evaluation.results import put

SEED = 20_000
"""First seed of what is measured (choice: the detector was made with others)."""

BATCH = 25
"""Samples in a batch, as of the node."""

NAMED_WITHIN = 20.0
"""[s] After the alarm or the begin within which the effect must be named."""

KINDS = ("nominal", "messy", "resting")
"""Kinds of rigs in which an effect begins: the last is nominal, in a loop that rests for long between references."""

PAGE = Path(__file__).parents[2] / "docs" / "results" / "live.md"


@dataclass(frozen=True)
class Told:
    """What was told of one recording.

    Attributes:
        delay: [s] from the begin to the alarm; below 0: a false alarm before; inf: none.
        onset: [s] instant told minus the true one.
        within: whether the interval told holds the true instant, within half a second.
        place: told.
        effect: told, the most probable at the end.
        levels: largest evidence of each ten seconds without a change.
        load: CPU time over rig time.
        changed: effects that the residuals speak for.
        diagnosed: verdict of `diagnose` on the bag of the alarm; "": not asked.
    """

    delay: float
    onset: float
    within: bool
    place: str
    effect: str
    levels: list[float]
    load: float
    changed: tuple[str, ...] = ()
    diagnosed: str = ""

    @property
    def named(self) -> str:
        """The effect that `diagnose` names, if it has changed; else that of the alarm."""
        return self.diagnosed if self.diagnosed in self.changed else self.effect


def watched(samples: Samples, since: float, watcher: Watcher | None = None) -> Told:
    """Give a recording to a watcher."""
    w = watcher or Watcher(load("bench"))
    d = w.detector
    n = len(samples.theta)
    alarm, levels, highest, block = math.inf, [], -math.inf, 0
    begun = time.process_time()
    with threadpool_limits(1):
        for k in range(0, n - BATCH + 1, BATCH):
            s = slice(k, k + BATCH)
            batch = Batch(np.round(np.arange(k, k + BATCH) * PERIOD * 1e9).astype(np.int64),
                          Samples(*(x[s] for x in samples)), "start" if k == 0 else "")
            _, found = w.step(batch)
            if d.learned > 0.0 and d.alarm is None and d.time < since:
                highest = max(highest, d.statistic)
                if int(d.time / 10.0) != block:
                    block = int(d.time / 10.0)
                    levels.append(highest)
                    highest = -math.inf
            if found is not None and math.isinf(alarm):
                alarm = d.time
            if alarm < since:
                break
    load_ = (time.process_time() - begun) / max(d.time, 1e-9)
    if w.alarm is None:
        return Told(math.inf, math.nan, False, "", "", levels, load_)
    best = d.findings[0]
    places: dict[str, float] = {}
    for f in d.findings:
        places[f.place] = places.get(f.place, 0.0) + f.probability
    low, high = w.alarm.within
    return Told(alarm - since, w.alarm.since - since, low - 0.5 < since < high + 0.5,
                max(places, key=lambda p: places[p]), best.hypothesis, levels, load_,
                tuple(f.hypothesis for f in d.findings if w.changed(f.hypothesis)))


def case_of(k: int, seed: int, keep: Path | None, kind: str) -> rigs.Case:
    """The k-th recording in which an effect begins, in turn over effects and controllers; a kept one is read.

    Args:
        k: number of the recording.
        seed: of the first one.
        keep: folder that keeps them.
        kind: of `KINDS`.
    """
    names = rigs.LOOPS if kind == "resting" else rigs.CONTROLLERS
    rep, i = divmod(k, len(rigs.BEGINNING))
    name = names[(rep * 5 + i * 3 + seed) % len(names)]
    number = seed + 100 * rep + i
    kept = keep / f"{kind}-{number}.pkl" if keep else None
    if kept and kept.exists():
        return pickle.loads(kept.read_bytes())  # type: ignore[no-any-return]
    case = rigs.draw(rigs.BEGINNING[i], name, number, imperfect=kind == "messy",
                     holds=rigs.RESTS if kind == "resting" else rigs.HOLDS)
    if kept:
        kept.write_bytes(pickle.dumps(case))
    return case


def diagnosed(samples: Samples, alarm: float) -> str:
    """Verdict of `diagnose` on the bag that `watch` writes at an alarm [s], as far as the recording goes."""
    model = load("bench")
    part = slice(max(round((alarm - BEFORE_S) / PERIOD), 0), round((alarm + AFTER_S) / PERIOD))
    signals = from_arrays({name: x[part] for name, x in samples._asdict().items()}, PERIOD, model.sensing)
    return diagnose(model, [signals], 1).conclusions.which.verdict


def changes(kind: str, count: int, seed: int, keep: Path | None, jobs: int, *, ask: bool
            ) -> list[tuple[rigs.Case, Told]]:
    """Recordings in which an effect begins, without their samples, and what was told of each.

    Args:
        kind: of `KINDS`.
        count: of the recordings.
        seed: of the first one.
        keep: folder that keeps them.
        jobs: processes.
        ask: whether to diagnose the bag of each alarm.
    """

    def one(_: int, k: int) -> tuple[rigs.Case, Told]:
        case = case_of(k, seed, keep, kind)
        told = watched(case.samples, case.since)
        if ask and 0.0 < told.delay < math.inf:
            told = replace(told, diagnosed=diagnosed(case.samples, case.since + told.delay))
        return replace(case, samples=Samples(*([np.zeros(0)] * 5))), told

    return each(kind, range(count), one, jobs)


def share(hits: int, of: int) -> str:
    """A share with its 95 % interval (Wilson)."""
    if of == 0:
        return "none"
    low, high = wilson(hits, of)
    return f"{100 * hits / of:.0f} % ({100 * low:.0f} to {100 * high:.0f}) of {of}"


def detection(all_: Sequence[tuple[rigs.Case, Told]]) -> list[tuple[str, str, str]]:
    """Rows of the table on recordings in which an effect of two floors or more in the loop begins."""
    shown = [(c, t) for c, t in all_ if c.shown >= rigs.FLOORS[0]]
    late = np.array([t.delay for _, t in shown])
    found = [(c, t) for c, t in shown if math.isfinite(t.delay) and t.delay > 0.0]
    p95 = float(np.sort(np.where(late > 0.0, late, np.inf))[max(math.ceil(0.95 * len(late)) - 1, 0)])
    median = float(np.median(np.where(late > 0.0, late, np.inf)))
    return [
        ("time to the alarm, median", "2 s", f"{median:.2f} s"),
        ("time to the alarm, 95 %", "8 s", f"{p95:.2f} s" if math.isfinite(p95) else "more than 5 % gave no alarm"),
        ("alarm within 8 s", "95 %", share(int(((late > 0.0) & (late < 8.0)).sum()), len(shown))),
        ("alarm before the begin", "0", share(int((late < 0.0).sum()), len(shown))),
        ("instant within 0.5 s", "-", share(sum(abs(t.onset) < 0.5 for _, t in found), len(found))),
        ("the interval of the instant holds it, within 0.5 s", "95 %",
         share(sum(t.within for _, t in found), len(found))),
        ("instant, median error", "0.5 s", f"{np.median([abs(t.onset) for _, t in found]):.2f} s"),
        ("right place", "95 %", share(sum(t.place == c.place for c, t in found), len(found))),
        ("right effect", "90 %", share(sum(t.effect == c.effect for c, t in found), len(found))),
        *([("right effect, by `diagnose` of the bag", "-",
            share(sum(t.diagnosed == c.effect for c, t in found), len(found))),
           ("right effect, by `diagnose` if it names one that has changed, else by the alarm", "90 %",
            share(sum(t.named == c.effect for c, t in found), len(found)))] if any(t.diagnosed for _, t in found)
          else []),
        ("of effects that make less than 2 floors in the loop: alarm", "-",
         share(sum(math.isfinite(t.delay) for c, t in all_ if c.shown < rigs.FLOORS[0]),
               sum(c.shown < rigs.FLOORS[0] for c, _ in all_))),
    ]


def quiet_hours(hours: float, seed: int, jobs: int, *, messy: bool, show: bool) -> tuple[int, float, list[float]]:
    """False alarms, hours, and the largest evidence of each ten seconds, over all controllers.

    Args:
        hours: without a change.
        seed: of the first recording.
        jobs: processes.
        messy: whether the rigs have many small imperfections.
        show: whether to print each recording.
    """
    names = rigs.CONTROLLERS
    length = 600.0 if messy else 1800.0

    def one(_: int, k: int) -> Told:
        name = names[k % len(names)]
        return watched(rigs.messy(name, seed + k, length) if messy
                       else rigs.quiet(name, seed + k, length, off=0.05), math.inf)

    told = each("messy hours" if messy else "hours", range(max(round(hours * 3600.0 / length), 1)), one, jobs)
    for k, t in enumerate(told if show else ()):
        print(f"{'messy ' * messy}hours, {names[k % len(names)]}-{seed + k}: largest evidence "
              f"{max(t.levels, default=0.0):.1f}, {t.effect or 'no alarm'}", flush=True)
    return sum(t.delay == -math.inf for t in told), len(told) * length / 3600.0, [x for t in told for x in t.levels]


def growth(hours: float) -> float:
    """MiB by which the memory of Python and numpy grows while a watcher sees hours, after the first half hour."""
    w = Watcher(load("bench"))
    samples = rigs.quiet("feedback_linearization", SEED, 1800.0, off=0.03)
    watched(samples, math.inf, w)
    tracemalloc.start()
    first = tracemalloc.get_traced_memory()[0]
    for _ in range(max(round(2.0 * hours) - 1, 1)):
        watched(samples, math.inf, w)
    now = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    return (now - first) / 2**20


def main(arguments: Sequence[str] | None = None) -> int:
    """Run it; returns the exit code."""
    parser = argparse.ArgumentParser(prog="evaluation.live", description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=3 * len(rigs.BEGINNING), help="recordings with an effect")
    parser.add_argument("--messy", type=int, default=len(rigs.BEGINNING), help="the same on messy rigs")
    parser.add_argument("--resting", type=int, default=len(rigs.BEGINNING), help="the same in loops that rest for long")
    parser.add_argument("--hours", type=float, default=24.0, help="hours of nominal rigs without a change")
    parser.add_argument("--messy-hours", type=float, default=4.0, help="hours of messy rigs without a change")
    parser.add_argument("--memory-hours", type=float, default=2.0, help="hours over which the memory is watched")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--keep", type=Path, help="folder that keeps the recordings")
    parser.add_argument("--diagnose", action="store_true", help="diagnose the bag of each alarm, too")
    parser.add_argument("--each", action="store_true", help="print each recording")
    parser.add_argument("--docs", action="store_true", help=f"write the table into {PAGE.name}")
    options = parser.parse_args(arguments)
    if options.keep:
        options.keep.mkdir(parents=True, exist_ok=True)
    rows: list[tuple[str, str, str, str]] = []
    for k, (kind, count) in enumerate(zip(KINDS, (options.count, options.messy, options.resting), strict=True)):
        all_ = changes(kind, count, options.seed + 10_000 * k, options.keep, options.jobs, ask=options.diagnose)
        if options.each:
            for c, t in all_:
                print(f"{kind} {c.name}: {c.shown:.1f} floors, after {t.delay:.2f} s, instant {t.onset:+.2f} s, "
                      f"{t.place}, {t.effect}{', ' * bool(t.diagnosed)}{t.diagnosed}", flush=True)
        if all_:
            rows += [(kind, *row) for row in detection(all_)]
            rows.append((kind, "CPU of detector and model", "-",
                         f"{100 * np.median([t.load for _, t in all_]):.1f} % of a core"))
    for kind, hours, imperfect in (("nominal", options.hours, False), ("messy", options.messy_hours, True)):
        if hours > 0.0:
            alarms, total, levels = quiet_hours(hours, options.seed + 100_000, options.jobs, messy=imperfect,
                                                show=options.each)
            rows.append((kind, "false alarms", "1 in 24 h", f"{alarms} in {total:.1f} h"))
            rows.append((kind, "largest evidence without a change", "-", f"{max(levels, default=0.0):.1f}"))
    if options.memory_hours > 0.0:
        rows.append(("nominal", "growth of memory over 24 h of the rig", "5 MiB",
                     f"{growth(options.memory_hours) * 24.0 / options.memory_hours:.2f} MiB"))
    table = ["| rigs | figure | target | measured |", "| --- | --- | --- | --- |"]
    table += [f"| {' | '.join(row)} |" for row in rows]
    table += ["", f"Seed {options.seed}; limit {false_alarms.limit(24.0):.1f} for one false alarm in 24 h."]
    print("\n".join(table))
    if options.docs:
        PAGE.write_text(put(PAGE.read_text(encoding="utf-8"), "live-figures", "\n".join(table)), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
