# SPDX-License-Identifier: Apache-2.0
"""Experiments by design, on rigs of the blind check's own plant: limits, pairs of effects, and one after another.

- Limits: signals are designed for drawn limits, and rigs are drawn that play them.
- Pairs: an effect and one of its closest rivals, at a size for which the best signal of `diagnose` needs 40 s by
  prediction; how long is the shortest designed signal, and does a diagnosis of its recording tell them apart?
- One after another: a rig with one unknown effect is investigated. Beside it, the blind check's own recording of the
  same rig.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.design.design import LENGTH, Designed, design, proposed
from aeropend_ident.design.exchange import Exchange
from aeropend_ident.design.goals import APART, NOTHING, Separate, any_effect, between
from aeropend_ident.design.investigation import Investigation
from aeropend_ident.design.limits import Limits, Ranges
from aeropend_ident.design.responses import Rows, asked
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.isolation.planned import planned
from aeropend_ident.diagnosis.results import document
from aeropend_ident.signals.signals import Signals, from_arrays
from aeropend_sim.model.effects import DEFINED, RANDOM
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import Model, load
from evaluation.blind import cases, folder, page, plant, score

Array = NDArray[np.float64]

LIMITS = Limits(theta=(-1.0, 1.2))
"""Limits of all experiments but those of the first part (choice: a bench whose arm may go up to the horizontal)."""

TRIES = 200
"""Signals that are tried for a design (choice: a third of the usual number, since hundreds are designed)."""

DRAWN = 500
"""Rigs that play each signal of the first part (choice: 10,000 in all for 20 signals)."""

BEFORE = 40.0
"""[s] Time that the best signal of `diagnose` needs for a pair, by prediction (choice: the target is half of it)."""

MOST = 120.0
"""[s] Motion of one rig at most (choice: the default of `investigate`)."""

CLOSEST = 3
"""Rivals of an effect from which one is drawn (choice: what a person would have to tell apart)."""

EFFECTS = tuple(e for e in plant.EFFECTS if e not in RANDOM)
"""Effects that a signal may be designed for: not those of chance."""


@dataclass(frozen=True)
class Moved:
    """What a rig did: its parameters, states, voltage and duty; see `plant.states`."""

    p: Array
    y: Array
    v: Array
    duty: Array

    @property
    def reach(self) -> Ranges:
        """What the true states reached."""
        states = {"theta": plant.S.theta, "omega": plant.S.omega, "i_a": plant.S.i}
        return {c: (float(self.y[:, j].min()), float(self.y[:, j].max())) for c, j in states.items()}

    def recorded(self, model: Model, rng: np.random.Generator) -> Signals:
        """The recording of it."""
        columns = plant.measured(self.p, self.y, self.v, model.sensing, rng)
        return from_arrays({**columns, "duty": self.duty}, plant.PERIOD, model.sensing)


@dataclass(frozen=True)
class Rig:
    """A rig of the independent plant.

    Attributes:
        numbers: true ones.
        effects: effect -> its true parameters.
    """

    numbers: Mapping[str, float]
    effects: Mapping[str, Mapping[str, float]]

    def moved(self, model: Model, duty: Array) -> Moved:
        """What it does under a signal."""
        p = plant.packed(self.numbers, model.sensing["angle_filter_tau"], self.effects, {}, 0)
        return Moved(p, *plant.states(p, duty, np.zeros(0)))


def drawn_rig(model: Model, effects: Mapping[str, Mapping[str, float]], rng: np.random.Generator) -> Rig:
    """A rig whose numbers are off by up to 5 %."""
    return Rig({n: model.model[n] * (1.0 + rng.uniform(-cases.OFF, cases.OFF)) for n in plant.NUMBERS}, effects)


def of_size(effect: str, share: float) -> dict[str, float]:
    """The parameters of an effect with a share of its usual size."""
    parameters = DEFINED[effect].parameters
    values = {n: p.default for n, p in parameters.items() if not p.refines}
    size = parameters[DEFINED[effect].size]
    return {**values, DEFINED[effect].size: size.neutral + share * (size.default - size.neutral)}


def template(model: Model) -> Signals:
    """A planned recording of all channels."""
    return planned(model, Excitation(duration=10.0).series())


# ---- limits


def crossed(k: int, seed: int) -> tuple[int, float]:
    """Design a signal within drawn limits; the number of drawn rigs that cross one, and the room that is stated."""
    model, rng = load(folder.MODEL), np.random.default_rng([seed, 1, k])
    limits = Limits((-rng.uniform(0.3, 1.0), rng.uniform(0.4, 1.3)), rng.uniform(120.0, 250.0), rng.uniform(0.8, 3.0),
                    (0.0, rng.uniform(0.4, 1.0)), float(rng.choice([0.0, rng.uniform(0.5, 5.0)])))
    rows = Rows(model, template(model), asked(model))
    names = [str(e) for e in rng.choice(EFFECTS, 2, replace=False)]
    goal = any_effect(rows, list(rows.effects)) if k % 2 else between(rows, names)
    found = design(rows, goal, limits, float(rng.choice([8.0, 15.0, 20.0])), tries=TRIES, seed=k)
    duty = np.concatenate([found.excitation.series(), np.zeros(round(3.0 / plant.PERIOD))])
    beyond = 0
    for _ in range(DRAWN):
        e = str(rng.choice([*EFFECTS, ""]))
        rig = drawn_rig(model, {e: of_size(e, rng.uniform(0.0, 1.0))} if e else {}, rng)
        beyond += limits.crossed(rig.moved(model, duty).reach)
    return beyond, -limits.excess(found.reach)


# ---- pairs


@dataclass(frozen=True)
class Pair:
    """What was found of a pair.

    Attributes:
        effect, rival: the pair; the rig has the first.
        seconds: [s] of the shortest designed signal; infinite: none of the lengths is enough.
        named: whether the diagnosis of a recording names the effect and not the rival beside it: with the designed
            signal, with the best of `diagnose` of the same length, and of 40 s.
    """

    effect: str
    rival: str
    seconds: float
    named: tuple[bool, bool, bool]


def pair(k: int, names: tuple[str, str], seed: int) -> Pair | None:
    """Design a signal for a pair; None: no size within ten usual ones needs 40 s."""
    effect, rival = names
    model, rng = load(folder.MODEL), np.random.default_rng([seed, 2, k])
    signals = template(model)

    def problem(share: float) -> tuple[Rows, Separate]:
        rows = Rows(model, signals, asked(model, sizes={effect: share * abs(usual)}))
        return rows, Separate(rows, [(effect, rival), (effect, NOTHING)])

    size = DEFINED[effect].parameters[DEFINED[effect].size]
    usual = size.default - size.neutral
    low, high = math.log(1e-3), math.log(10.0)
    for _ in range(7):  # the size for which the best of `diagnose` needs 40 s
        middle = 0.5 * (low + high)
        _, best = best_before(*problem(math.exp(middle)), BEFORE)
        low, high = (low, middle) if best >= APART else (middle, high)
    if high > math.log(10.0) - 0.1:
        return None
    rows, goal = problem(math.exp(high))
    found = design(rows, goal, LIMITS, tries=TRIES, seed=k)
    enough = all(a.reached >= 1.0 for a in found.answers)
    length = found.excitation.duration
    rig = drawn_rig(model, {effect: of_size(effect, math.exp(high))}, rng)
    played = (found.excitation, best_before(rows, goal, length)[0], best_before(rows, goal, BEFORE)[0])
    named = tuple(_named(rig, model, x, rng, names) for x in played)
    return Pair(effect, rival, length if enough else math.inf, named)  # type: ignore[arg-type]


def closest(model: Model) -> dict[str, list[str]]:
    """Effect -> the rivals from which it differs least in half a minute of random steps."""
    rows = Rows(model, template(model), asked(model))
    all_ = any_effect(rows, list(rows.effects)).distances(rows.under(Excitation(duration=30.0).series()).products)
    return {e: sorted((r for x, r in all_ if x == e and r != NOTHING), key=lambda r, e=e: all_[e, r])[:CLOSEST]
            for e in EFFECTS}


def best_before(rows: Rows, goal: Separate, seconds: float) -> tuple[Excitation, float]:
    """The best signal of `diagnose`, within the limits, and its smallest distance."""
    begun = Exchange(rows, goal, LIMITS).begin(proposed(seconds, LIMITS))
    best = max(begun.values(), key=lambda t: t.score)
    return best.holds.excitation, min(a.value for a in best.answers)


def _named(rig: Rig, model: Model, signal: Excitation, rng: np.random.Generator, names: tuple[str, str]) -> bool:
    """Whether the diagnosis of a recording names the first of two effects, and not the other beside it."""
    try:
        which = diagnose(model, [rig.moved(model, signal.series()).recorded(model, rng)]).conclusions.which
    except RecordingError:  # a constant duty
        return False
    return which.verdict == names[0] and not any(set(names) <= set(p) for p in which.not_separable)


# ---- one after another


@dataclass(frozen=True)
class Investigated:
    """What was found of one rig.

    Attributes:
        effect: that it has.
        sure: whether the verdict is sure.
        verdict: at the end.
        moved: [s] motion.
        plain: the verdict of 70 s as in the blind check, and whether a rival was left.
        plain_sure: whether that verdict was sure.
        crossed: whether a limit was crossed.
    """

    effect: str
    sure: bool
    verdict: str
    moved: float
    plain: str
    plain_sure: bool
    crossed: bool


def investigated(k: int, effect: str, seed: int, first: Designed) -> Investigated:
    """Investigate a rig that has one effect of 1.5 to 10 floors, and diagnose the blind check's recording of it.

    Args:
        k: number of the rig.
        effect: that it has.
        seed: of the check.
        first: the first experiment, which is the same for all rigs: it is designed for the nominal model.
    """
    model = load(folder.MODEL)
    case, columns = cases.draw(f"s{k:03d}", "single", [effect], "table", model.model, model.sensing,
                               seed * 100_003 + k)
    plain = diagnose(model, [from_arrays(columns, plant.PERIOD, model.sensing)]).conclusions.which
    rig = Rig(case.numbers, {effect: case.effects[0]["parameters"]})  # type: ignore[dict-item]
    rng = np.random.default_rng([seed, 3, k])
    inquiry = Investigation(model, template(model), LIMITS, MOST, tries=TRIES, first=first)
    beyond, verdict = False, ""
    while (proposal := inquiry.next()) is not None:
        moved = rig.moved(model, proposal.designed.excitation.series())
        beyond |= LIMITS.crossed(moved.reach)
        found = inquiry.add(moved.recorded(model, rng),
                            lambda d: document(d, ["bag"] * len(inquiry.recordings), folder.MODEL, 0.0))
        verdict = found.conclusions.which.verdict
    return Investigated(effect, inquiry.sure, verdict, inquiry.moved, plain.verdict, not plain.not_separable, beyond)


def figures(limits: list[tuple[int, float]], pairs: list[Pair], rigs: list[Investigated]) -> list[score.Figure]:
    """The figures of all three parts."""
    sure = [r for r in rigs if r.sure]
    share = score.share
    return [
        score.Figure(f"limits: rigs of {DRAWN * len(limits)} that cross one", float(sum(n for n, _ in limits)),
                     count=DRAWN * len(limits), at_most=0.0, share=False),
        score.median("limits: room that is left to the nearest, on the worst rig, as a share of the limit",
                     [room for _, room in limits], is_share=True),
        score.median("pairs: length of the designed signal, s", [p.seconds for p in pairs], at_most=0.5 * BEFORE),
        share("pairs: in half the time or less, by prediction", [p.seconds <= 0.5 * BEFORE for p in pairs]),
        share("pairs: told apart by a diagnosis, designed signal", [p.named[0] for p in pairs]),
        share("pairs: the best signal of diagnose, of the same length", [p.named[1] for p in pairs]),
        share("pairs: the best signal of diagnose, 40 s", [p.named[2] for p in pairs]),
        score.median("cold start: motion until the verdict is sure, s", [r.moved if r.sure else math.inf for r in rigs],
                     at_most=30.0),
        share("cold start: verdict is sure in the end", [r.sure for r in rigs]),
        share("cold start: a sure verdict is right", [r.verdict == r.effect for r in sure]),
        share("cold start: right effect first", [r.verdict == r.effect for r in rigs]),
        share("70 s as in the blind check: right effect first", [r.plain == r.effect for r in rigs]),
        share("70 s as in the blind check: no rival left", [r.plain_sure for r in rigs]),
        share("cold start: a limit was crossed", [r.crossed for r in rigs], at_most=0.0),
    ]


def report(count: int, seed: int, duration: float, jobs: int) -> list[score.Figure]:
    """Run all three parts and print the figures.

    Args:
        count: pairs, and rigs that are investigated; a third as many signals are played by rigs that are drawn.
        seed: of the check.
        duration: not used: each experiment has its own.
        jobs: processes.
    """
    del duration
    rng = np.random.default_rng([seed, 0])
    model = load(folder.MODEL)
    limits = folder.each("limits", range(max(count // 3, 1)), lambda k, _: crossed(k, seed), jobs)
    effects = [str(e) for _ in range(count // len(EFFECTS) + 1) for e in rng.permutation(EFFECTS)][:count]
    couples = [(e, str(rng.choice(closest(model)[e]))) for e in effects]
    pairs = [p for p in folder.each("pairs", couples, lambda k, names: pair(k, names, seed), jobs) if p is not None]
    for p in pairs:
        print(f"{p.effect:22} {p.rival:22} {p.seconds:5.0f} s  told apart: {p.named}")
    rows = Rows(model, template(model), asked(model))
    first = design(rows, any_effect(rows, list(rows.effects)), LIMITS, LENGTH, jobs=jobs)
    rigs = folder.each("one after another", effects, lambda k, e: investigated(k, e, seed, first), jobs)
    for r in rigs:
        print(f"{r.effect:22} {r.moved:4.0f} s  {'sure' if r.sure else '-   '}  {r.verdict:22} "
              f"70 s: {r.plain} {'' if r.plain_sure else '(a rival left)'}")
    return page.printed(figures(limits, pairs, rigs))
