# SPDX-License-Identifier: Apache-2.0
"""The sizes that `isolate` predicts, beside those that `diagnose` measures.

    python -m evaluation.isolate --seed 90210                   64 recordings of 25 s
    python -m evaluation.isolate --effects brush_drop gust      only these effects
    python -m evaluation.isolate --docs                         write the table of the last run into its page

Effects are drawn by size around the predicted ones, in rigs of the independent plant whose numbers are up to 5 % off.
Each recording is diagnosed. Whether the effect is seen, and whether it is named, are probits of the log of its size;
their 50 % points are compared with the predictions. A run that was interrupted goes on.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr
from threadpoolctl import threadpool_limits

from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.isolation.isolate import judge_of
from aeropend_ident.diagnosis.isolation.judge import Judge, Truth
from aeropend_ident.diagnosis.isolation.planned import planned
from aeropend_ident.diagnosis.isolation.sizes import smallest
from aeropend_ident.signals.signals import CHANNELS, from_arrays
from aeropend_sim.model.effects import DEFINED
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import Model, load
from evaluation import results
from evaluation.blind import cases, page, plant

Array = NDArray[np.float64]

EFFECTS = ("supply_sag", "brush_drop", "rotor_friction", "thrust_lag", "ground_effect", "coulomb_friction",
           "cable_torque", "angle_offset")
"""Effects of all places of the chain, some of which imitate each other (choice)."""

BEYOND = 2.2
"""Factor beyond the predicted sizes to which sizes are drawn (choice: the probit then has both its ends)."""

NEAR = 1.3
"""Factor within which a measured size is as predicted (target)."""

WIDTHS = np.geomspace(0.05, 1.0, 20)
"""Standard deviations of the log of the size over which a probit is searched (choice)."""

INSIDE = 1.92
"""Log likelihood below the largest up to which a size is in its 95 % interval (derived: chi-square, one degree)."""


def recorded(effect: str, values: Mapping[str, float], duty: Array, seed: int, model: Model) -> dict[str, Array]:
    """Channels and duty of a rig of the independent plant with an effect, numbers up to 5 % off."""
    rng = np.random.default_rng(seed)
    numbers = {n: model.model[n] * (1.0 + rng.uniform(-cases.OFF, cases.OFF)) for n in plant.NUMBERS}
    p = plant.packed(numbers, model.sensing["angle_filter_tau"], {effect: values}, {}, 0)
    gusts = cases.gusts_of({"effect": effect, "parameters": values, "draw": seed}, len(duty), other=False)
    y, v, applied = plant.states(p, duty, gusts)
    return {**plant.measured(p, y, v, model.sensing, rng), "duty": applied}


def parameters(truth: Truth, size: float) -> dict[str, float]:
    """The parameters of an effect that the plant takes."""
    effect = DEFINED[truth.hypothesis.effect]
    return {n.partition(".")[2]: v for n, v in truth.values(size).items()
            if not effect.parameters[n.partition(".")[2]].refines}


def make(options: argparse.Namespace) -> None:
    """Predict, record and diagnose; each row is written as it comes."""
    model = load("bench")
    duty = Excitation("latin_hypercube", options.duration, options.seed, duty_max=0.55).series()
    out: Path = options.out
    out.mkdir(parents=True, exist_ok=True)
    (out / ".gitignore").write_text("*\n", encoding="utf-8")
    rows = out / "rows.jsonl"
    known = [json.loads(line) for line in rows.read_text(encoding="utf-8").splitlines()] if rows.exists() else []
    done = {(r["effect"], r["k"]) for r in known}
    judge = judge_of(model, planned(model, duty, tuple(CHANNELS)))
    truths = {h.effect: judge.truth(h) for h in judge.hypotheses if not h.parameter and h.effect in options.effects}
    with threadpool_limits(1):
        said = {e: smallest(judge, t) for e, t in truths.items()}
    order = [(k, e) for k in range(options.count) for e in options.effects]
    for k, e in order:
        seen = said[e].seen
        if (e, k) in done or seen is None:
            continue
        named = said[e].named or seen
        rng = np.random.default_rng([options.seed, k, list(plant.EFFECTS).index(e)])
        low, high = math.log(seen / BEYOND), math.log(max(named, seen) * BEYOND)
        size = math.exp(low + (high - low) * ((k * 0.618034 + rng.uniform(0.0, 0.1)) % 1.0))
        columns = recorded(e, parameters(truths[e], size), duty, int(rng.integers(2**31)), model)
        which = diagnose(model, [from_arrays(columns, plant.PERIOD, model.sensing)], options.jobs).conclusions.which
        row = {"effect": e, "k": k, "size": size, "unit": truths[e].unit, "seen": seen, "named": said[e].named,
               "separable": _separable(judge, truths[e], size), "verdict": which.verdict,
               "effects": list(which.effects), "not_separable": [list(pair) for pair in which.not_separable]}
        with rows.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        print(f"{e:18} {size / seen:5.2f} of the size seen: {which.verdict}", flush=True)
    run = {"date": f"{datetime.now().astimezone():%Y-%m-%d}", "machine": results.machine(), "seed": options.seed,
           "count": sum(1 for _ in rows.open(encoding="utf-8")), "duration": options.duration}
    (out / "run.json").write_text(json.dumps(run) + "\n", encoding="utf-8")


def _separable(judge: Judge, truth: Truth, size: float) -> bool:
    return judge.rivals_of(truth, size) == {}


def probit(sizes: Sequence[float], hits: Sequence[bool]) -> tuple[float, float, float]:
    """The size at which a probability is one half, with its 95 % interval by the profile likelihood.

    Args:
        sizes: of each trial.
        hits: whether it succeeded.
    """
    x, y = np.log(sizes), np.where(hits, 1.0, -1.0)
    grid = np.linspace(x.min() - 0.5, x.max() + 0.5, 400)
    z = y[None, None, :] * (x[None, None, :] - grid[:, None, None]) / WIDTHS[None, :, None]
    profile = log_ndtr(z).sum(axis=2).max(axis=1)
    near = grid[profile > profile.max() - INSIDE]
    best = grid[profile > profile.max() - 0.05]  # a step has a flat top
    return float(np.exp(best.mean())), float(np.exp(near.min())), float(np.exp(near.max()))


def score(out: Path) -> str:
    """The table of a run, and its figures."""
    rows: list[dict[str, Any]] = [json.loads(line) for line in (out / "rows.jsonl").read_text("utf-8").splitlines()]
    run = json.loads((out / "run.json").read_text(encoding="utf-8"))
    table = [["effect", "", "predicted", "measured", "95 %", "measured / predicted", "of"]]
    ratios: dict[str, list[float]] = {"seen": [], "named": []}
    for e in dict.fromkeys(r["effect"] for r in rows):
        mine = [r for r in rows if r["effect"] == e]
        hits = {"seen": [r["verdict"] != "none" for r in mine],
                "named": [r["verdict"] == e and not any(e in pair for pair in r["not_separable"]) for r in mine]}
        for what, hit in hits.items():
            said = mine[0][what]
            size, low, high = probit([r["size"] for r in mine], hit)
            ratio = size / said if said else math.nan
            ratios[what].append(ratio)
            table.append([e, what, f"{said:.3g} {mine[0]['unit']}" if said else "not at all", f"{size:.3g}",
                          f"{low:.3g} to {high:.3g}", f"{ratio:.2f}", str(len(mine))])
    above = [r for r in rows if r["verdict"] != "none"]
    alone = [r["verdict"] == r["effect"] and not any(r["effect"] in pair for pair in r["not_separable"]) for r in above]
    right = [a == r["separable"] for a, r in zip(alone, above, strict=True)]
    not_alone = [not a for a, r in zip(alone, above, strict=True) if not r["separable"]]
    lines = [f"{what}: {sum(max(x, 1.0 / x) <= NEAR for x in each)} of {len(each)} within a factor {NEAR} (target 90 %)"
             for what, each in ratios.items()]
    lines += [f"separable or not, where the verdict is not `none`: {sum(right)} of {len(right)} as predicted",
              f"predicted not separable, and so: {sum(not_alone)} of {len(not_alone)} (target 95 %)"]
    machine = run["machine"]
    return "\n".join([*page.markdown(table), "", *(f"- {line}" for line in lines), "",
                      (f"Measured on {run['date']}: {run['count']} recordings of {run['duration']:g} s, seed "
                       f"{run['seed']}, commit {machine['commit']}, {machine['cpu']}, Python {machine['python']}.")])


def main() -> None:
    """Run the evaluation, or write its table."""
    parser = argparse.ArgumentParser(prog="isolate", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=90210)
    parser.add_argument("--count", type=int, default=8, help="recordings of each effect (default 8)")
    parser.add_argument("--duration", type=float, default=25.0, help="s of each recording (default 25)")
    parser.add_argument("--effects", nargs="+", default=list(EFFECTS), choices=list(plant.EFFECTS), metavar="EFFECT")
    parser.add_argument("--jobs", type=int, default=1, help="threads of a diagnosis (default 1)")
    parser.add_argument("--out", type=Path, default=Path("isolate-results"))
    parser.add_argument("--docs", action="store_true", help="run nothing, write the table of the last run")
    options = parser.parse_args()
    if not options.docs:
        make(options)
        print(score(options.out))
        return
    file = results.ROOT / "docs" / "results" / "isolate.md"
    file.write_text(results.put(file.read_text(encoding="utf-8"), "isolate", score(options.out)), encoding="utf-8")


if __name__ == "__main__":
    main()
