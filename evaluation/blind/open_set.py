# SPDX-License-Identifier: Apache-2.0
"""The open set: effects that the catalogue does not hold. Are they called unknown, does the learned term close them?

Half of the rigs have an effect of `plant.OUTSIDE`; other forms of effects hold two of these, which count apart. The
others have an effect of the catalogue, which the diagnosis is not given: a real unknown, but for those that another
effect, or a parameter, imitates.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.signals.signals import from_arrays
from aeropend_sim.model.parameters import load
from evaluation.blind import cases, folder, page, plant, score

IMITATED = {
    "bridge_drop": "k0", "current_gain": "K_t", "thrust_lag": "encoder_lag", "encoder_lag": "thrust_lag",
    "angle_offset": "cable_torque", "cable_torque": "angle_offset", "thrust_exponent": "ground_effect",
    "ground_effect": "thrust_exponent", "encoder_eccentricity": "angle_offset", "command_delay": "",
}
"""Effect of the catalogue -> another effect, or a parameter of the model, that gives nearly the same.

A delay is no curve: it cannot be learned. These effects are drawn too, but count in no figure."""

CHANCE = ("gust", "speed_spikes")
"""Effects that are not fitted, and cannot be left out."""


@dataclass(frozen=True)
class Answer:
    """What was said of one rig.

    Attributes:
        effect: that the rig has.
        place: where it acts.
        outside: whether the catalogue never holds it.
        verdict: given.
        said: place that was said.
        learned: whether a term was learned.
        closed: share of the closable gap that closes.
        formula: gap with the first formula over that with the learned term.
        seconds: taken.
    """

    effect: str
    place: str
    outside: bool
    verdict: str
    said: str
    learned: bool
    closed: float | None
    formula: float | None
    seconds: float


def plan(count: int, seed: int) -> list[str]:
    """The effect of each rig: every one as often as any other of its half."""
    rng = np.random.default_rng([seed, 21])
    outside, inside = list(plant.OUTSIDE), [e for e in plant.EFFECTS if e not in CHANCE]
    halves = []
    for ids in (outside, inside):
        order = [e for _ in range(count // len(ids) + 1) for e in rng.permutation(ids)]
        halves.append([str(e) for e in order[:count // 2]])
    return [e for pair in zip(*halves, strict=True) for e in pair]


def answer(k: int, effect: str, seed: int, duration: float) -> Answer:
    """Draw a rig, record it, and diagnose it without the effect."""
    nominal, outside = load(folder.MODEL), effect in plant.OUTSIDE
    kind = "outside" if outside else "single"
    case, columns = cases.draw(f"r{k:03d}", kind, [effect], "table", nominal.model, nominal.sensing,
                               seed * 100_003 + k, duration)
    started = time.perf_counter()
    found = diagnose(nominal, [from_arrays(columns, plant.PERIOD, nominal.sensing)], 1,
                     left_out=() if outside else (effect,)).conclusions
    unknown, after = found.which.unknown, found.closure.gap_after
    formulas = unknown.formulas if unknown is not None else ()
    formula = next((f.gap_after / after for f in formulas if f.gap_after is not None), None)
    return Answer(effect, str(case.effects[0]["place"]), outside, found.which.verdict, found.where.place,
                  unknown is not None and bool(unknown.id), found.closure.closed, formula,
                  time.perf_counter() - started)


def figures(found: list[Answer]) -> list[score.Figure]:
    """The figures of the open set."""
    held = [a for a in found if a.effect in plant.HELD]
    found = [a for a in found if a.effect not in plant.HELD]
    real = [a for a in found if a.outside or a.effect not in IMITATED]
    unknown = [a for a in real if a.verdict == "unknown"]
    closed = [a.closed for a in unknown if a.closed is not None]
    formulas = [a.formula for a in unknown if a.formula is not None]
    share = score.share
    return [
        share("outside of the catalogue: called unknown", [a.verdict == "unknown" for a in found if a.outside],
              at_least=0.97),
        share("held by another form of an effect: that effect first",
              [a.verdict == plant.HELD[a.effect] for a in held]),
        share("left out of the catalogue, and not imitated: called unknown",
              [a.verdict == "unknown" for a in real if not a.outside], at_least=0.97),
        share("called unknown: right place", [a.said == a.place for a in unknown], at_least=0.9),
        share("called unknown: a term was learned", [a.learned for a in unknown]),
        score.median("called unknown: gap closed on held-out data, median", closed, at_least=0.8),
        score.Figure("called unknown: the same, worst decile", float(np.quantile(closed, 0.1)) if closed else None,
                     count=len(closed), at_least=0.4),
        share("called unknown, a term learned: a formula leaves at most 1.1 times its gap",
              [f <= 1.1 for f in formulas]),
        score.median("seconds, median", [a.seconds for a in (*found, *held)], at_most=6.0),
    ]


def report(count: int, seed: int, duration: float, jobs: int) -> list[score.Figure]:
    """Draw, diagnose and score; prints a line a rig, and the figures."""
    found: list[Answer] = folder.each("diagnosing", plan(count, seed),
                                      lambda k, effect: answer(k, effect, seed, duration), jobs)
    for a in found:
        closed = page.closed(a.closed)
        print(f"{'outside' if a.outside else 'left out'} {a.effect:20} {a.place:10} -> {a.verdict:18} ({a.said}); "
              f"{'learned; ' * a.learned}{closed}{'' if a.formula is None else f', formula {a.formula:.2f}'}; "
              f"{a.seconds:.1f} s")
    return page.printed(figures(found))
