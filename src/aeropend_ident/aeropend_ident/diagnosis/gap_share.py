# SPDX-License-Identifier: Apache-2.0
"""The share of each finding in the squared gap: what comes back of it when the finding is taken out of the model."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.values import PLACE_OF_CHANNEL
from aeropend_ident.diagnosis.document import Interval
from aeropend_ident.diagnosis.free_run_gap import RESAMPLES, Gap, HeldOut
from aeropend_ident.diagnosis.joint_fit import JointFit
from aeropend_ident.diagnosis.search.findings import RankedHypothesis
from aeropend_ident.diagnosis.search.free_curves import Repeatable
from aeropend_ident.diagnosis.search.hypotheses import Hypothesis

Array = NDArray[np.float64]

UNKNOWN = "unknown"
"""Name of the part that an effect outside of the catalogue makes."""

LEAST_DRAWN = 1e-3
"""Gap of a resample, relative to the whole, below which its shares mean nothing (choice)."""

LARGEST_UNSURE = 1e3
"""Relative standard deviation of a size that is zero (choice: its share is then anything, but finite)."""

CAPTURES = "speed_spikes"
"""Name of the part that false captures make."""

SHARED = 0.5
"""Standard deviation of the cosine between the part of an effect and a rest: what no finding explains, or what another
form of the effect would explain.

Measured: on 71 effects of 60 simulated rigs with ten imperfections each (seed 5006) intervals with it hold 93 % of the
true shares, without it 72 %. Where nothing is left unexplained, it changes nothing."""

SURELY = 1.0 / 3.0
"""Part of a material share above which the whole 95 % interval of a further effect must lie to be claimed.

Choice: its best estimate is material, and it is surely there."""

SEVERAL = 2
"""Effects of less than a material share from which a rig has small imperfections (choice: more than one by chance)."""

MOSTLY_OPEN = 0.5
"""Share of the gap above which what the effects found leave is the verdict (derived: it is more than all of them)."""


@dataclass(frozen=True)
class Part:
    """A part of the gap.

    Attributes:
        name: of the hypothesis that makes it; `UNKNOWN`; "" for what stays unexplained at a place.
        place: of the chain.
        amount: squared gap, in units of the spread squared.
        windows: (W,) the same over each window of the bootstrap.
        unsure: relative standard deviation of the size of the effect, its other parameters held.
        ends: least and most that it may be, as effects stand in for each other.
        unique: what comes back without it although the other effects are fitted again: no other effect closes that;
            inf where that is not asked.
        instead_of: name of an effect that it stands in for: either of the two closes what both do; "": of none.
    """

    name: str
    place: str
    amount: float
    windows: Array
    unsure: float = 0.0
    ends: tuple[float, float] = (math.inf, -math.inf)
    unique: float = math.inf
    instead_of: str = ""


@dataclass(frozen=True)
class Headline:
    """The verdict by the parts of the gap.

    Attributes:
        verdict: id of an effect, "unknown" or "none".
        place: of the chain.
        effects: ids of the effects claimed, the largest share first.
        small: ids of effects that were found but make less than a material share.
        claimed: names of the hypotheses claimed.
    """

    verdict: str
    place: str
    effects: list[str]
    small: list[str]
    claimed: set[str]


def parts_of_effects(joint: JointFit, held_out: HeldOut, before: Gap, material: float, jobs: int = 1) -> list[Part]:
    """The part of each effect that was fitted.

    An effect that is taken out of all leaves a gap; one that alone is put in closes a gap. Where effects of a stage
    stand in for each other, the first is too small and the second too large: the part is the mean of both (of two
    effects their value of L. Shapley, 1953). Parts are scaled so that their sum is what comes back without all of them.
    The ends of a part are the least and the most of these two, and of what the effect alone closes without those of
    other stages too.

    Effects may cancel each other, so that without one of them more is open than without all of its stage. Then their
    sizes are hardly determined one by one, and the other effects are fitted again for both values.

    The nominal model is one without effects. So without all of them no more is open than it leaves.

    In a calibrated rig without small imperfections the evidence tells effects apart that close the same of the gap. No
    unique part is asked of them.

    Args:
        joint: the joint fit.
        held_out: measures gaps.
        before: gap of the nominal model, measured likewise.
        material: share of the gap that is material.
        jobs: processes.
    """
    stages = [f.effects for f in joint.findings.values() if f.effects]
    if not stages:
        return []
    after = held_out.gap_of(joint.values)
    every = [h for effects in stages for h in effects]
    subsets = {_names(gone): gone for effects in stages for h in effects
               for gone in ([h], _but(effects, h), effects, _but(every, h), every) if gone}
    # these fits hold no prior: what an earlier verdict knows may exclude that another effect closes it
    tried = every if joint.chains.known is None else []
    joint.fit_without([*((gone, False) for gone in subsets.values()), *(([h], True) for h in tried)], jobs)
    gaps = {frozenset(): after, **{names: held_out.gap_of(joint.without(gone)) for names, gone in subsets.items()}}

    def gap(effects: Sequence[Hypothesis]) -> Gap:
        return gaps[_names(effects)]

    gaps[_names(every)] = min(gaps[_names(every)], before, key=squared)
    again = {h.name: gap(every) if len(every) == 1 else held_out.gap_of(joint.without([h], others=True)) for h in tried}

    # the numbers of an uncalibrated rig may be wrong as a whole: what curves explain then speaks against all effects
    form = SHARED if joint.chains.policy.calibrated else 1.0

    def part(effect: Hypothesis, effects: Sequence[Hypothesis]) -> Part:
        unsure = min(joint.unsure(effect, form), LARGEST_UNSURE)
        last, first, alone = (_coming_back(effect.name, effect.place, gap(without), gap(with_), unsure)
                              for without, with_ in (([effect], []), (effects, _but(effects, effect)),
                                                     (every, _but(every, effect))))
        unique = math.inf
        if effect.name in again:
            unique = squared(again[effect.name]) - squared(after)
            if squared(gap([effect])) > squared(gap(effects)):
                last = alone = _coming_back(effect.name, effect.place, again[effect.name], after, unsure)
                with_ = held_out.gap_of(joint.without(_but(effects, effect), others=True))
                first = _coming_back(effect.name, effect.place, gap(effects), with_, unsure)
        amounts = [p.amount for p in (last, first, alone)]
        return replace(last, amount=0.5 * (last.amount + first.amount), windows=0.5 * (last.windows + first.windows),
                       ends=(min(amounts), max(amounts)), unique=unique)

    parts = [p for effects in stages for p in _adding_up(
        [part(h, effects) for h in effects], squared(gap(effects)) - squared(after))]
    least = material * (squared(gap(every)) - after.total_floor(held_out.floors()) ** 2)
    named = {h.name: h for h in every}
    told = joint.chains.policy.calibrated and sum(p.amount < least for p in parts) < SEVERAL
    parts = _without_stand_ins(parts, named, joint, held_out, least, jobs, parameters_alone=told)
    return [replace(p, unique=math.inf) if told and 0.0 <= p.unique < least and not named[p.name].parameter else p
            for p in parts]


def _without_stand_ins(parts: Sequence[Part], effects: Mapping[str, Hypothesis], joint: JointFit, held_out: HeldOut,
                       least: float, jobs: int, *, parameters_alone: bool) -> list[Part]:
    """What is unique to each part once effects that stand in for others are left out.

    Of two effects that stand in for each other neither is unique. A parameter that is off is left out before an effect,
    which is likelier; else the one without which the smaller gap is left. The other is judged anew. Either closes what
    both do, so either may have the part of both.

    Args:
        parts: of the effects.
        effects: by name.
        joint: the joint fit.
        held_out: measures gaps.
        least: amount that is material.
        jobs: processes.
        parameters_alone: whether only parameters that are off are left out.
    """
    judged, left_out = {p.name: p for p in parts}, list[Hypothesis]()
    while True:
        open_ = [p for p in judged.values() if p.amount >= least > p.unique and effects[p.name] not in left_out]
        if len(open_) < 2 or (parameters_alone and not any(effects[p.name].parameter for p in open_)):
            return list(judged.values())
        out = min(open_, key=lambda p: (not effects[p.name].parameter, p.unique)).name
        left_out.append(effects[out])
        gone = {p.name: [*left_out, effects[p.name]] for p in open_ if p.name != out}
        joint.fit_without([(left_out, True), *((each, True) for each in gone.values())], jobs)
        without = squared(held_out.gap_of(joint.without(left_out, others=True)))
        for name, each in gone.items():
            one = held_out.gap_of(joint.without(each, others=True))
            judged[name] = replace(judged[name], unique=squared(one) - without)
        other = max(gone, key=lambda name: judged[name].unique)
        if judged[other].unique >= least:
            both = judged[out].amount + judged[other].amount
            for name in (out, other):
                low, high = judged[name].ends
                judged[name] = replace(judged[name], ends=(min(low, both), max(high, both)))
            judged[out] = replace(judged[out], instead_of=other)


def _names(effects: Sequence[Hypothesis]) -> frozenset[str]:
    return frozenset(h.name for h in effects)


def _but(effects: Sequence[Hypothesis], one: Hypothesis) -> list[Hypothesis]:
    return [h for h in effects if h is not one]


def _adding_up(parts: Sequence[Part], together: float) -> list[Part]:
    """The parts of effects of a stage, scaled to what they close together; a negative one is no part of it."""
    total = sum(max(p.amount, 0.0) for p in parts)
    factor = together / total if total > 0.0 and together > 0.0 else 1.0
    return [replace(p, amount=factor * p.amount, windows=factor * p.windows) if p.amount > 0.0 else p for p in parts]


def part_of_several(effects: Sequence[Hypothesis], joint: JointFit, held_out: HeldOut, place: str) -> Part:
    """The part that effects make together which only approximate an unknown one.

    Args:
        effects: of a stage.
        joint: the joint fit.
        held_out: measures gaps.
        place: of the unknown effect.
    """
    return _coming_back(UNKNOWN, place, held_out.gap_of(joint.without(effects)), held_out.gap_of(joint.values))


def _coming_back(name: str, place: str, without: Gap, after: Gap, unsure: float = 0.0) -> Part:
    """The part that comes back without some effects."""
    return Part(name, place, squared(without) - squared(after), _windows(without) - _windows(after), unsure)


def unexplained(after: Gap, floors: Mapping[str, float], random: RankedHypothesis | None, unknown: Repeatable | None
                ) -> list[Part]:
    """What the augmented model leaves above the floor, by the place whose misfit each channel shows first.

    Args:
        after: gap of the augmented model.
        floors: channel -> floor.
        random: `gust`, if it was detected: what the angle keeps is its part.
        unknown: place of an unknown effect, if there is one, and the share of the rest that repeats: that is its part.
    """
    parts: list[Part] = []
    for j, (channel, rms) in enumerate(after.rms.items()):
        floor = (floors[channel] / after.spread[channel]) ** 2
        amount = ((rms / after.spread[channel]) ** 2 - floor) / len(after.rms)
        windows = (after.windows[:, j] - floor) / len(after.rms)
        if random is not None and channel == "theta":
            parts.append(Part(random.hypothesis.name, random.hypothesis.place, max(amount, 0.0), windows))
        elif amount > 0.0:
            share = 0.0 if unknown is None else unknown.share
            if unknown is not None:
                parts.append(Part(UNKNOWN, unknown.place, share * amount, share * windows))
            parts.append(Part("", PLACE_OF_CHANNEL[channel], (1.0 - share) * amount, (1.0 - share) * windows))
    together = [p for p in parts if p.name == UNKNOWN]
    if unknown is None:
        return parts
    none = np.zeros(len(after.windows))
    return [*(p for p in parts if p.name != UNKNOWN),
            Part(UNKNOWN, unknown.place, sum(p.amount for p in together), sum((p.windows for p in together), none))]


def part_of_spikes(spikes: RankedHypothesis, with_: Gap, without: Gap) -> Part:
    """The part of false captures: the gap of the nominal model with and without them."""
    h = spikes.hypothesis
    part = _coming_back(h.name, h.place, with_, without)
    return replace(part, amount=max(part.amount, 0.0))


def shares(parts: Sequence[Part], *, shared: float = SHARED, ends: bool = True, seed: int = 0) -> dict[str, Interval]:
    """Name -> share of the gap, with a 95 % interval.

    The interval holds the scatter over time (block bootstrap, H. Künsch, 1989) and the uncertainty of the size. It also
    holds what is unexplained: its direction is unknown, so that some of it may belong to each effect, or some of the
    effect to it. False captures have the whole gap that they make: those that are known are left out of the gap of all
    others. It reaches to the ends of a part.

    Args:
        parts: of the gap.
        shared: as `SHARED`; 0 leaves out what is unexplained.
        ends: whether the intervals reach to the ends of the parts.
        seed: of the bootstrap.
    """
    captures = {p.name: Interval(1.0, 1.0, 1.0) for p in parts if p.name == CAPTURES and p.amount > 0.0}
    total = whole(parts)
    parts = [p for p in parts if p.name != CAPTURES]
    if total <= 0.0:
        return captures
    rng = np.random.default_rng(seed)
    # parts that were measured on the same windows are drawn together
    picks = {n: rng.integers(0, n, (RESAMPLES, n)) if n > 1 else np.zeros((RESAMPLES, 1), dtype=np.intp)
             for n in dict.fromkeys(len(p.windows) for p in parts)}
    # a size of the other sign closes nothing
    size = [np.maximum(1.0 + p.unsure * rng.standard_normal(RESAMPLES), 0.0) for p in parts]
    drawn = np.array([p.windows[picks[len(p.windows)]].mean(axis=1) * x**2 for p, x in zip(parts, size, strict=True)])
    drawn /= np.maximum(np.maximum(drawn, 0.0).sum(axis=0), total * LEAST_DRAWN)
    rest = np.sqrt(sum((np.maximum(d, 0.0) for p, d in zip(parts, drawn, strict=True) if p.name in ("", UNKNOWN)),
                       np.zeros(RESAMPLES)))
    for p, d in zip(parts, drawn, strict=True):
        if p.name not in ("", UNKNOWN):
            mixed = np.maximum(np.sqrt(np.maximum(d, 0.0)) + shared * rest * rng.standard_normal(RESAMPLES), 0.0) ** 2
            d[:] = np.where(d > 0.0, mixed, d)
    drawn = np.clip(drawn, -1.0, 1.0)
    found = captures
    for p, low, high in zip(parts, *np.percentile(drawn, [2.5, 97.5], axis=1), strict=True):
        if p.name:
            share = p.amount / total
            least, most = (end / total for end in p.ends) if ends else (share, share)
            found[p.name] = Interval(share, max(min(float(low), share, least), -1.0),
                                     min(max(float(high), share, most), 1.0))
    return found


def whole(parts: Sequence[Part]) -> float:
    """The sum of the parts of the gap, without that of false captures."""
    return sum(max(p.amount, 0.0) for p in parts if p.name != CAPTURES)


def headline(parts: Sequence[Part], share: Mapping[str, Interval], material: float) -> Headline:
    """The verdict: the finding with the largest part of the gap.

    Args:
        parts: of the gap.
        share: of `shares`.
        material: share from which a finding is claimed, if the intervals of the share and of the size exclude 0, and if
            no other effect could close as much of it: a material share must come back without it. Of effects that
            stand in for each other so far that none does, the largest is claimed. A further effect must also surely
            be there.
    """
    named = sorted((p for p in parts if p.name), key=lambda p: -p.amount)
    nothing = _may_be_nothing(parts)
    likely = [p for p in named if p.name in share and share[p.name].value >= material
              and (p.name == UNKNOWN or p.name not in nothing)]
    least = material * whole(parts)
    likely = [p for p in likely if p.name == UNKNOWN or p.unique >= least] or likely[:1]
    sure = shares(parts, ends=False) if len(likely) > 1 else {}
    claimed = [p for p in likely if p is likely[0] or p.name == UNKNOWN or sure[p.name].low >= SURELY * material]
    effects = _ids(p for p in claimed if p.name != UNKNOWN)
    small = [e for e in _ids(p for p in named if p not in claimed and p.name != UNKNOWN) if e not in effects]
    names = {p.name for p in claimed}
    unknown = next((p for p in claimed if p.name == UNKNOWN), None)
    if unknown is not None and (claimed[0] is unknown or not effects or share[UNKNOWN].value > MOSTLY_OPEN):
        return Headline(UNKNOWN, unknown.place, effects, small, names)
    if not effects:
        return Headline("none", "none", [], small, names)
    first = next(p for p in claimed if p.name != UNKNOWN)
    return Headline(effects[0], first.place, effects, small, names)


def doubtful(parts: Sequence[Part]) -> set[str]:
    """Names of the effects that may close nothing, where most of the gap stays unexplained.

    Another effect may be there: an effect of an unsure size must not hide it.

    Args:
        parts: of the gap.
    """
    open_ = sum(p.amount for p in parts if not p.name)
    if open_ <= MOSTLY_OPEN * whole(parts):
        return set()
    return _may_be_nothing(parts) & {p.name for p in parts if p.unsure > 0.0}


def _may_be_nothing(parts: Sequence[Part]) -> set[str]:
    """Names of the parts whose share may be 0, by its scatter over time and the uncertainty of the size."""
    return {name for name, s in shares(parts, shared=0.0, ends=False).items() if s.low <= 0.0}


def why_unsure(share: Mapping[str, Interval], material: float) -> str:
    """Why no effect is claimed although some have a material share of the gap; "" if none has.

    Args:
        share: of `shares`.
        material: share from which an effect is claimed.
    """
    found = {name: s for name, s in share.items() if name != UNKNOWN and s.value >= material}
    if not found:
        return ""
    name = max(found, key=lambda n: found[n].value)
    return (f"no effect brings the model surely closer to the unseen part: the likeliest, {name}, has "
            f"{found[name].value:.0%} ({found[name].low:.0%} to {found[name].high:.0%}) of the squared gap; a "
            "recording with more motion in its last third, or several recordings, help most")


def share_of_places(parts: Sequence[Part], otherwise: Callable[[], Sequence[Part]]) -> list[tuple[str, float]]:
    """Place and squared gap of each part; `otherwise` gives them if there is none."""
    open_ = [p for p in parts if p.amount > 0.0] or otherwise()
    return [(p.place, max(p.amount, 0.0)) for p in open_]


def _ids(parts: Iterable[Part]) -> list[str]:
    return list(dict.fromkeys(p.name.partition(":")[0] for p in parts))


def squared(gap: Gap) -> float:
    """The squared gap; a run that diverges counts as a constant, whose gap is 1."""
    return 1.0 if gap.diverges else gap.total**2


def _windows(gap: Gap) -> Array:
    return np.ones(len(gap.windows)) if gap.diverges else np.asarray(gap.windows.mean(axis=1))
