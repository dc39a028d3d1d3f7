# SPDX-License-Identifier: Apache-2.0
"""How time and memory of `diagnose` grow: with the length of a recording, their number, and the catalogue."""

import math
import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import numpy as np

from aeropend_ident.testing.bags import write
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import Model, load, save
from aeropend_sim.model.rig import record
from evaluation.benchmarks import measure
from evaluation.benchmarks.bags import EFFECT, LIMIT_S, Run, diagnosed, rig_with
from evaluation.benchmarks.measure import Figure, NotMeasuredError, Spread, Target
from evaluation.benchmarks.nodes import PERIOD_NS

THREE = (EFFECT, "rotor_friction", "supply_drift")
"""An effect in each part of the chain: each part is searched."""

LINEAR = 1.1
"""Exponent up to which growth counts as linear: some iterations more or less are chance."""

def made(path: Path, model: Model, seconds: float, seed: int = 0) -> Path:
    """Write a recording of a simulated rig."""
    duty = Excitation(duration=seconds, seed=seed).series().astype(np.float32).astype(float)
    rig, _ = record(model, duty, seed)
    write(path, {**rig, "duty": duty}, PERIOD_NS)
    return path


def narrowed(path: Path, effects: Iterable[str]) -> Path:
    """A model file with which `diagnose` considers these effects only: it takes all others as known to be absent."""
    absent = {id_: {name: p.neutral if name == e.size else p.default for name, p in e.parameters.items()}
              for id_, e in CATALOGUE.items() if id_ not in set(effects)}
    save(load("bench").with_effects(absent), path)
    return path


def exponent(x: Sequence[float], seconds: Sequence[float]) -> float:
    """Slope between the last two points in logarithms: how it would go on from there."""
    return math.log(seconds[-1] / seconds[-2]) / math.log(x[-1] / x[-2])


def told(x: float, run: Run) -> str:
    """A point of a curve, for people."""
    return f"{x:g}: {run.cpu:.1f} s, {run.peak / 1e6:.0f} MB" if run.cpu < math.inf else f"{x:g}: > {LIMIT_S:.0f} s"


def begun() -> float:
    """CPU time of what every run has to do first, s."""
    return diagnosed("no such recording", code=2).cpu


def curve(name: str, unit: str, points: Sequence[float], run: Callable[[float], Run], start: float
          ) -> tuple[Figure, dict[float, Run]]:
    """Measure the points of a curve, and the exponent at its end; a point not done in time ends it.

    Args:
        name: of what grows.
        unit: of the points.
        points: at which it is measured.
        run: measures one.
        start: s CPU that do not count.
    """
    about = measure.load()
    runs: dict[float, Run] = {}
    for x in points:
        runs[x] = run(x)
        if runs[x].cpu == math.inf:
            break
    found = [(x, one.cpu - start) for x, one in runs.items() if x > 0.0]
    if len(found) < 2:
        raise NotMeasuredError(f"diagnose with {name} {points[0]:g}: not done within {LIMIT_S:.0f} s")
    slope = exponent(*zip(*found, strict=True)) if found[-1][1] < math.inf else math.inf
    note = f"{unit}: CPU time and peak memory: " + "; ".join(told(x, one) for x, one in runs.items())
    last = [x for x, _ in found][-2:]
    return Figure(f"diagnose: growth of time with {name}, exponent from {last[0]:,g} to {last[1]:,g}", "-",
                  Spread.of(slope), Target(LINEAR),
                  details={"start_s": start, **{f"{x:g}": one._asdict() for x, one in runs.items()}}, note=note,
                  load=about, main=True), runs


def length(quick: bool) -> list[Figure]:
    """Recordings of 10 s to 1 h."""
    with tempfile.TemporaryDirectory(prefix="aeropend_bench_") as folder:
        def run(seconds: float) -> Run:
            bag = made(Path(folder) / f"{seconds:g}", rig_with(EFFECT), seconds)
            return diagnosed(bag, "--out", f"{bag}_out")

        about = measure.load()
        lengths = (10.0, 60.0, 300.0) if quick else (10.0, 60.0, 600.0, 3600.0)
        slope, runs = curve("the length of a recording", "s", lengths, run, begun())
    seconds, longest = list(runs.items())[-1]
    return [slope,
            Figure(f"diagnose on a recording of {seconds:,.0f} s: peak memory", "GB", Spread.of(longest.peak / 1e9),
                   Target(2.0), load=about, main=True),
            Figure(f"diagnose on a recording of {seconds:,.0f} s: time", "s", Spread.of(longest.seconds),
                   details=longest._asdict(), load=about)]


def recordings(quick: bool) -> list[Figure]:
    """1 to 100 recordings of one rig, fitted together."""
    counts = (1, 3, 10) if quick else (1, 3, 10, 30, 100)
    with tempfile.TemporaryDirectory(prefix="aeropend_bench_") as folder:
        bags = [made(Path(folder) / f"bag{k}", rig_with(EFFECT), 10.0, seed=k) for k in range(counts[-1])]
        slope, _ = curve("the number of recordings", "recordings of 10 s", counts,
                         lambda count: diagnosed(*bags[:int(count)], "--out", Path(folder) / f"out{count}"), begun())
    return [slope]


def effects(quick: bool) -> list[Figure]:
    """From none to all effects of the catalogue as hypotheses; three of them are present."""
    order = [*THREE, *(id_ for id_ in CATALOGUE if id_ not in THREE)]
    counts = (0, 1, 6, len(order)) if quick else (0, 1, 6, 12, len(order))
    with tempfile.TemporaryDirectory(prefix="aeropend_bench_") as folder:
        bag = made(Path(folder) / "bag", rig_with(*THREE), 60.0)

        def run(count: float) -> Run:
            model = narrowed(Path(folder) / f"{count}.yaml", order[:int(count)])
            return diagnosed(bag, "--model", model, "--out", Path(folder) / f"out{count}")

        slope, _ = curve("the catalogue", "effects considered, 60 s", counts, run, begun())
    return [slope]
