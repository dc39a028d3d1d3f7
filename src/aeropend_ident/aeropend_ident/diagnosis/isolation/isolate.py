# SPDX-License-Identifier: Apache-2.0
"""What a recording would show, before it is made: the smallest size of each effect, pairs, and sensors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from threadpoolctl import threadpool_limits

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.document import WouldShow
from aeropend_ident.diagnosis.isolation import structure
from aeropend_ident.diagnosis.isolation.judge import Judge, Truth
from aeropend_ident.diagnosis.isolation.planned import like
from aeropend_ident.diagnosis.isolation.sizes import Smallest, smallest
from aeropend_ident.diagnosis.policy import CALIBRATED, MATERIAL_SHARE
from aeropend_ident.diagnosis.search.hypotheses import Hypothesis, hypotheses, other_forms
from aeropend_ident.estimation.parallel import parallel
from aeropend_ident.signals.signals import CHANNELS, Signals
from aeropend_sim.model.effects import DEFINED, RANDOM
from aeropend_sim.model.parameters import Model

Progress = Callable[[str, float], None]
"""Called with the present step and the share (0 to 1) of the work that is done."""


@dataclass(frozen=True)
class EffectShown:
    """What a recording would show of an effect.

    Attributes:
        effect: its id.
        form_of: the effect of which it is another form; "" for one of the catalogue.
        place: of the chain.
        size: name of the parameter that is its size.
        unit: of the size.
        usual: usual size, as a distance from the neutral one.
        seen: smallest distance with which the verdict would not be `none` (probability one half); null: not at all.
        named: smallest distance with which it would name the effect and no rival; null: not at all.
        rivals: rival that is not ruled out at the size seen -> its probability.
    """

    effect: str
    form_of: str
    place: str
    size: str
    unit: str
    usual: float
    seen: float | None
    named: float | None
    rivals: Mapping[str, float]


@dataclass(frozen=True)
class AtSize:
    """What a recording would say of an effect of a given size.

    Attributes:
        effect: its id.
        size: as a distance from the neutral one.
        seen: whether the verdict would not be `none`.
        rivals: rival that would not be ruled out, or be named instead -> its probability.
    """

    effect: str
    size: float
    seen: bool
    rivals: Mapping[str, float]


@dataclass(frozen=True)
class Sensor:
    """What another set of channels would change.

    Attributes:
        channel: that is added, or spared.
        added: whether it is added.
        factor: effect -> factor on the smallest size seen; null: it is no longer seen; 0: it is seen only now.
    """

    channel: str
    added: bool
    factor: Mapping[str, float | None]


@dataclass(frozen=True)
class Structural:
    """What the equations alone say of an effect.

    Attributes:
        equation: that it makes wrong.
        detectable: whether that equation can be checked at all.
        isolable_from: effects from which it is isolable.
    """

    equation: str
    detectable: bool
    isolable_from: tuple[str, ...]


@dataclass(frozen=True)
class Isolation:
    """What a planned recording would show.

    Attributes:
        model: name of the nominal model.
        channels: that are measured.
        seconds: [s] length.
        noise: channel -> standard deviation of a reading, in the channel's unit.
        effects: smallest sizes.
        at_size: effects of a given size.
        sensors: other sets of channels.
        structural: effect -> what the equations alone say.
    """

    model: str
    channels: tuple[str, ...]
    seconds: float
    noise: Mapping[str, float]
    effects: tuple[EffectShown, ...]
    at_size: tuple[AtSize, ...]
    sensors: tuple[Sensor, ...]
    structural: Mapping[str, Structural]


def judge_of(model: Model, signals: Signals, further: Sequence[str] = (), material: float = MATERIAL_SHARE, *,
             rivals: bool = True) -> Judge:
    """The judge of a planned recording.

    Args:
        model: the nominal model.
        signals: the planned recording, of a rig that is like it.
        further: ids of effects of effect files.
        material: share of the gap from which an effect is claimed.
        rivals: whether effects are told from rivals: parameters that are far off, and other forms, count only then.
    """
    chains = CutChains(model, [signals])
    chains.further = tuple(further)
    every = hypotheses(model, further, mismatches=rivals)
    if not rivals:
        return Judge(chains, [h for h in every if not DEFINED[h.effect].form_of], material)
    return Judge(chains, [*every, *(form for h in every for form in other_forms(h, chains))], material)


def isolate(model: Model, recorded: Callable[[Sequence[str]], Signals], channels: Sequence[str],
            further: Sequence[str] = (), sizes: Mapping[str, float] | None = None, *, forms: bool = False,
            sensors: bool = True, material: float = MATERIAL_SHARE, jobs: int = 1,
            progress: Progress = lambda *_: None) -> Isolation:
    """Say what a planned recording would show.

    Args:
        model: the nominal model.
        recorded: channels -> the planned recording with them, of a rig that is like the model (`planned`).
        channels: that are measured.
        further: ids of effects of effect files.
        sizes: effect -> size at which pairs are told apart, as a distance from the neutral one; else the usual size.
        forms: whether the smallest sizes of other forms of effects are computed too.
        sensors: whether other sets of channels are tried.
        material: share of the gap from which an effect is claimed.
        jobs: processes; the result does not depend on them.
        progress: called as the work goes on.

    Raises:
        PlanError, RecordingError: the experiment cannot be planned.
    """
    with threadpool_limits(1):
        signals = recorded(channels)
        there = tuple(c for c in CHANNELS if signals.has(c))
        progress("linearising the model", 0.0)
        judge = judge_of(model, signals, further, material)
        truths = [judge.truth(h) for h in judge.hypotheses
                  if not h.parameter and (forms or not DEFINED[h.effect].form_of)]
        progress("computing the smallest sizes", 0.2)
        _ = judge.rivals  # once, for all processes
        found = parallel(jobs, partial(smallest, judge), truths)
        main = [t for t in truths if not DEFINED[t.hypothesis.effect].form_of]
        seen = {t.hypothesis.effect: s.seen for t, s in zip(truths, found, strict=True)}
        progress("telling pairs apart", 0.6)
        at_size = parallel(jobs, lambda t: _at_size(judge, t, seen[t.hypothesis.effect], sizes or {}), main)
        progress("trying other sensors", 0.7)
        tried = [c for c in CHANNELS if c != "theta"] if sensors else []
        others = parallel(jobs, lambda c: _sensor(model, recorded, there, c, further, material, seen), tried)
        progress("done", 1.0)
    return Isolation(model.name, there, len(signals) * signals.period, {c: signals.sigma[c] for c in there},
                     tuple(_shown(t, s) for t, s in zip(truths, found, strict=True)), tuple(at_size), tuple(others),
                     _structural([t.hypothesis.effect for t in main], there))


def _shown(truth: Truth, found: Smallest) -> EffectShown:
    effect = DEFINED[truth.hypothesis.effect]
    return EffectShown(effect.id, effect.form_of, effect.place, effect.size, truth.unit, abs(truth.usual), found.seen,
                       found.named, found.rivals)


def would_show(model: Model, recordings: Sequence[Signals], further: Sequence[str] = (),
               material: float = MATERIAL_SHARE, jobs: int = 1) -> tuple[WouldShow, ...]:
    """The smallest size of each effect that the longest of some recordings would show.

    Args:
        model: the nominal model of a calibrated rig.
        recordings: of the rig.
        further: ids of effects of effect files.
        material: share of the gap from which an effect is claimed.
        jobs: processes.
    """
    s = max(recordings, key=len)
    judge = judge_of(model, like(model, s), further, material, rivals=False)

    def one(h: Hypothesis) -> WouldShow:
        truth = judge.truth(h)
        return WouldShow(h.effect, h.place, truth.unit, abs(truth.usual),
                         smallest(judge, truth, name=False, quickly=True).seen)

    with threadpool_limits(1):
        return tuple(parallel(jobs, one, judge.hypotheses))


def _at_size(judge: Judge, truth: Truth, seen: float | None, sizes: Mapping[str, float]) -> AtSize:
    effect = truth.hypothesis.effect
    size = sizes.get(effect, abs(truth.usual))
    if seen is None or size < seen or effect in RANDOM:
        return AtSize(effect, size, seen is not None and size >= seen, {})
    left = {n: p for n, p in judge.probabilities(truth, size).items()
            if n != truth.hypothesis.family and p > CALIBRATED.undecided}
    return AtSize(effect, size, True, left)


def _sensor(model: Model, recorded: Callable[[Sequence[str]], Signals], channels: Sequence[str], channel: str,
            further: Sequence[str], material: float, seen: Mapping[str, float | None]) -> Sensor:
    """The factor on the smallest size of each effect of the catalogue, with a channel more or less."""
    added = channel not in channels
    other = [c for c in CHANNELS if (c in channels) != (c == channel)]
    judge = judge_of(model, recorded(other), further, material, rivals=False)
    factor: dict[str, float | None] = {}
    for h in judge.hypotheses:
        now, before = smallest(judge, judge.truth(h), name=False).seen, seen[h.effect]
        if now is None and before is None:
            continue
        factor[h.effect] = None if now is None else 0.0 if before is None else now / before
    return Sensor(channel, added, factor)


def _structural(effects: Sequence[str], channels: Sequence[str]) -> dict[str, Structural]:
    of = structure.equations(channels)
    wrong = {e: structure.equation_of(e) for e in effects}
    found = structure.isolable(of, wrong)
    return {e: Structural(wrong[e], "" in found[e], tuple(g for g in effects if g in found[e])) for e in effects}
