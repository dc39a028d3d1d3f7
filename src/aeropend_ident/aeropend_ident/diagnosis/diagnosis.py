# SPDX-License-Identifier: Apache-2.0
"""The diagnosis of one rig, step by step; docs/method.md explains the steps.

identify the nominal model (uncalibrated rigs) -> cut the chain -> search effects -> detect gust and false captures ->
judge whether an effect is unknown -> fit all jointly -> measure the gap -> conclude.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from aeropend_ident.diagnosis import conclude, gap_share, regions, since, typed_json
from aeropend_ident.diagnosis.chain import static_map
from aeropend_ident.diagnosis.chain.cached_chain import CachedChains
from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.driven_rig import fit_driven_rig, fit_own, without_findings
from aeropend_ident.diagnosis.chain.hanging import mounted
from aeropend_ident.diagnosis.chain.known import Known
from aeropend_ident.diagnosis.chain.nominal_fit import fit_nominal_model
from aeropend_ident.diagnosis.chain.pwm_timing import with_pwm_timing
from aeropend_ident.diagnosis.chain.values import (
    CHANNELS_OF,
    PLACE_OF_PARAMETER,
    neutral,
    of_rig,
    own_sensing,
    with_values,
)
from aeropend_ident.diagnosis.conclude import Statistical
from aeropend_ident.diagnosis.document import (
    CANNOT_TELL,
    Channel,
    Closure,
    Conclusions,
    Curve,
    Formula,
    GapBudget,
    Residual,
    Where,
    Which,
)
from aeropend_ident.diagnosis.document import UnknownEffect as DrawnEffect
from aeropend_ident.diagnosis.experiment_design import EXPERIMENTS, experiments_within
from aeropend_ident.diagnosis.free_run_gap import Gap, HeldOut, closure, gap
from aeropend_ident.diagnosis.gap_budget import Repeats, budget
from aeropend_ident.diagnosis.gap_share import Part
from aeropend_ident.diagnosis.joint_fit import JointFit, fit_jointly
from aeropend_ident.diagnosis.policy import GOOD_ENOUGH, MATERIAL_SHARE, angle_only, policy_of
from aeropend_ident.diagnosis.search import gust, onset, speed_spikes, unknown_effect
from aeropend_ident.diagnosis.search.findings import Findings
from aeropend_ident.diagnosis.search.formula_fit import fitted_formulas
from aeropend_ident.diagnosis.search.free_curves import MissingTerm, Repeatable
from aeropend_ident.diagnosis.search.learned_term import Learned, learn
from aeropend_ident.diagnosis.search.onset import Onset
from aeropend_ident.diagnosis.search.search import refit, search, trifling_gap, unsearched
from aeropend_ident.diagnosis.search.unknown_effect import ONE_TERM, UnknownEffect
from aeropend_ident.estimation.map_fit import passed
from aeropend_ident.estimation.parameter import key
from aeropend_ident.signals.signals import CHANNELS, Signals
from aeropend_ident.signals.statistics import rms
from aeropend_sim.model import effect_file
from aeropend_sim.model.effects import DEFINED, family
from aeropend_sim.model.parameters import Model
from aeropend_sim.wording import times

Array = NDArray[np.float64]

CUT_SHORT = ("the search was cut short to bound its time: an effect beside the first, or a rival close to it, may have "
             "been missed; --seconds says how long it may take")

NOT_LEARNED = "the missing term was not learned, to bound the time: with more --seconds it is"


CHANGED = 1.5
"""RMS early in the held-out part over that in the fitted part above which the rig changes there (choice)."""

FURTHEST = 0.9
"""Share of such a recording that is fitted (choice: two thirds of what is usually held out)."""


@dataclass(frozen=True)
class Diagnosis:
    """The result of a diagnosis.

    Attributes:
        model: the nominal model; the identified one for an uncalibrated rig.
        augmented: with refitted parameters and the effects found.
        signals: the recordings.
        before: channel -> (N,) free-run readings of the nominal model, one a recording.
        after: the same of the augmented model.
        conclusions: what they show.
        misfit: of the nominal structure where it fits worst.
    """

    model: Model
    augmented: Model
    signals: Sequence[Signals]
    before: Sequence[Mapping[str, Array]]
    after: Sequence[Mapping[str, Array]]
    conclusions: Conclusions
    misfit: regions.Misfit

    @property
    def body(self) -> dict[str, Any]:
        """The conclusions as in `diagnosis.json`."""
        return typed_json.to_json(self.conclusions)


Progress = Callable[[str, float], None]
"""Called with the present step and the share (0 to 1) of the work that is done."""


def diagnose(model: Model, recordings: Sequence[Signals], jobs: int = 1, progress: Progress = lambda *_: None, *,
             fit_nominal: bool = False, material: float = MATERIAL_SHARE, seconds: float | None = None,
             known: Known | None = None, further: Sequence[str] = (),
             left_out: Sequence[str] = ()) -> Diagnosis:
    """Find where a model and a rig differ, which effect causes it, and how far the gap closes.

    Args:
        model: the nominal model, with effects that are known to be there.
        recordings: one or more of one rig.
        jobs: processes; the result does not depend on them.
        progress: called as the work goes on.
        fit_nominal: whether the rig is uncalibrated: its parameters are known to a factor of three at best.
        material: share of the gap from which an effect is claimed.
        seconds: [s] that identification and search may take; what has begun is brought to an end. None: a budget of
            simulations bounds the search where it may be long.
        known: what earlier verdicts of the rig know of the model; the verdict is then what has changed.
        further: ids of effects of effect files that are tried beside those of the catalogue.
        left_out: ids of fitted effects that are not tried; not of those that only statistics show.
    """
    deadline = None if seconds is None else time.monotonic() + seconds
    with threadpool_limits(1):  # the matrices are narrow: threads of the linear algebra would slow each other down
        policy = policy_of(recordings, fit_nominal=fit_nominal)
        likely: dict[str, float] = {}
        plain = None
        notes: tuple[str, ...] = ()
        if fit_nominal:
            progress("identifying the nominal model", 0.0)
            if any(s.both_ways for s in recordings):
                model = replace(model, model={**model.model, "reverse": 1.0})
            recordings = mounted(model, recordings)
        if policy.wide_search and angle_only(recordings):
            rig = fit_driven_rig(model, recordings, deadline)
            found, likely = without_findings(rig.model, model, recordings, material)
            model, plain, notes = replace(found, name=f"{model.name}, identified"), rig.plain, rig.notes
        elif fit_nominal:
            model, recordings = fit_nominal_model(model, recordings, deadline)
        kind = CutChains if policy.calibrated else CachedChains
        chains = with_pwm_timing(kind(model, recordings, policy))
        chains.likely, chains.plain, chains.notes, chains.known = likely, plain, notes, known
        chains.further, chains.left_out = tuple(further), tuple(left_out)
        return _diagnose(chains, Settings(jobs, material, deadline), progress)


@dataclass(frozen=True)
class Settings:
    """What a person may set.

    Attributes:
        jobs: processes.
        material: share of the gap from which an effect is claimed.
        deadline: [s] of `time.monotonic` after which nothing more is looked for; None: a budget of simulations bounds
            the search where it may be long.
    """

    jobs: int = 1
    material: float = MATERIAL_SHARE
    deadline: float | None = None


@dataclass(frozen=True)
class _Findings:
    """What the search and the detectors found.

    Attributes:
        chains: cut, with the inputs that the search has set.
        stages: stage -> what was found.
        statistical: effects that were detected by their statistics.
        unknown: an effect that the catalogue does not hold.
        misfit: of the nominal structure where it fits worst.
        recordings: with the notes of the search.
        failed: why the nominal model could not be identified; "" if it was.
        onset: when the effects begin or end; None: they act all the time.
        learned: the term that is learned in place of the unknown effect.
    """

    chains: CutChains
    stages: Mapping[str, Findings]
    statistical: Statistical
    unknown: UnknownEffect | None
    misfit: regions.Misfit
    recordings: Sequence[Signals]
    failed: str = ""
    onset: Onset | None = None
    learned: Learned | None = None


@dataclass(frozen=True)
class _Gaps:
    """The gap before and after, with everything that measures it.

    Attributes:
        held_out: measures gaps.
        base: values of the nominal model by name, with the initial states.
        runs_before: free runs of the nominal model, one a recording.
        runs_after: the same of the augmented model.
        before: gap of the nominal model.
        after: gap of the augmented model.
        floors: channel -> floor.
        repeats: how much of the rest of each stage repeats.
    """

    held_out: HeldOut
    base: Mapping[str, float]
    runs_before: Sequence[Mapping[str, Array]]
    runs_after: Sequence[Mapping[str, Array]]
    before: Gap
    after: Gap
    floors: Mapping[str, float]
    repeats: Repeats

    @cached_property
    def fitted(self) -> Gap:
        """The gap of the augmented model on the fitted parts."""
        return self.held_out.fitted().gap(self.runs_after)

    def fits(self, channel: str) -> tuple[float, float]:
        """Fit of the augmented model's free run, on the fitted parts and on the held-out ones."""
        there, here = self.fitted, self.after
        return 1.0 - there.rms[channel] / there.spread[channel], 1.0 - here.rms[channel] / here.spread[channel]

    def budget(self, *, gust: bool, jobs: int) -> GapBudget | None:
        """What could be closed of the gap, measured where the arm moves."""
        moving = self.held_out.in_motion()
        return budget(moving.gap(self.runs_before), moving.gap(self.runs_after), self.floors, self.repeats, gust=gust,
                      jobs=jobs)


class _Measured(NamedTuple):
    """Findings, fitted jointly, with the gap that they leave and its parts."""

    found: _Findings
    joint: JointFit
    gaps: _Gaps
    parts: list[Part]

    @property
    def open_(self) -> float:
        """The squared gap that effects close, or leave and could be closed."""
        return sum(max(p.amount, 0.0) for p in self.parts)

    @property
    def excess(self) -> float:
        """What is left of the squared gap above the floor."""
        after = self.gaps.after
        return max(gap_share.squared(after) - after.total_floor(self.gaps.floors)**2, 0.0)

    def closes_more(self, other: _Measured, material: float) -> bool:
        """Whether this leaves less than other findings, by a material share of what is open."""
        less = gap_share.squared(other.gaps.after) - gap_share.squared(self.gaps.after)
        return less > material * other.open_

    def shows_approximation(self, known: _Measured, material: float) -> bool:
        """Whether this, with one unknown term, leaves so little that known effects only approximate that term."""
        return self.closes_more(known, material) and known.excess > ONE_TERM * self.excess


def _diagnose(fitted: CutChains, settings: Settings, progress: Progress) -> Diagnosis:
    """The steps after the chain is cut; `fitted`: the chains whose training part parameters are fitted to."""
    found = _find(fitted, settings, progress)
    progress("fitting all jointly", 0.75)
    found, joint, gaps = _fit_and_measure(fitted, found, progress)
    if found.unknown is None and _changes_later(gaps):  # an unknown effect may show elsewhere in what follows
        return _diagnose(_fitted_further(fitted), settings, progress)
    closed = [stage for stage in found.stages if gaps.after.within(gaps.floors, CHANNELS_OF[stage])]
    if found.unknown is not None and found.unknown.stage in closed:
        found = _judged(found, closed)
    now = _without_harmful(fitted, found, joint, gaps, settings, progress)
    if now.found.unknown is not None and not _repeats(now.parts, settings.material):
        known = replace(now.found, unknown=None)
        now = now._replace(found=known, parts=_parts(known, now.joint, now.gaps, settings))
    if _may_approximate(now):
        alone = _with_learned_term(fitted, _unknown_alone(fitted, now, settings, progress), settings, progress)
        if alone.shows_approximation(now, settings.material):
            now = alone
        elif alone.found.learned is not None:
            effect_file.forget(alone.found.learned.id)
    if now.found.learned is None:
        now = _with_learned_term(fitted, now, settings, progress)
    found, joint, gaps, parts = now
    conclusions = _conclude(found, joint, gaps, parts, settings)
    model, chains = found.chains.model, found.chains
    nominal = model if chains.policy.calibrated else with_values(model, of_rig(gaps.base))
    progress("done", 1.0)
    measured = model if chains.policy.calibrated else replace(model, sensing=own_sensing(model, found.recordings))
    return Diagnosis(nominal, _augmented(measured, joint.values_of_rig, found.statistical), found.recordings,
                     gaps.runs_before, gaps.runs_after, conclusions, found.misfit)


def _changes_later(gaps: _Gaps) -> bool:
    """Whether the rig changes early in the held-out part: what was fitted then says nothing of the change."""
    s = gaps.held_out.recordings[0]
    further = _further(s)
    if len(gaps.held_out.recordings) > 1 or not gaps.held_out.chains.policy.calibrated or s.train >= further:
        return False
    there = gap(gaps.runs_after[0], s, s.train, further, s.false_speed)
    return any(rms > CHANGED * max(gaps.fitted.rms[c], gaps.floors[c])
               for c, rms in there.rms.items() if c in gaps.fitted.rms)


def _fitted_further(fitted: CutChains) -> CutChains:
    """The chains of a recording that is fitted further."""
    (s,) = fitted.recordings
    further = _further(s)
    note = (f"after {s.train * s.period:.1f} s the rig behaves otherwise than before: the fit goes on up to "
            f"{further * s.period:.1f} s, only the rest is held out")
    return fitted.anew([replace(s, train=further).noted(note)])


def _further(s: Signals) -> int:
    return round(FURTHEST * len(s))


def _fit_and_measure(fitted: CutChains, found: _Findings, progress: Progress) -> tuple[_Findings, JointFit, _Gaps]:
    """Fit all that was found jointly, and measure the gap before and after; the findings are those still claimed."""
    progress("fitting all jointly", 0.75)
    joint = fit_jointly(found.chains, found.stages, gust=found.statistical.gust is not None)
    found = replace(found, stages=joint.findings)
    progress("measuring the gap", 0.9)
    return found, joint, _measure(fitted, found, joint)


def _without_harmful(fitted: CutChains, found: _Findings, joint: JointFit, gaps: _Gaps, settings: Settings,
                     progress: Progress) -> _Measured:
    """Take out the effects that make the gap larger on data that no fit has used.

    These have a negative part, or the others leave less without them. One at a time, the most harmful first: of effects
    that stand in for each other, one may be needed.
    """
    needed: set[str] = set()
    parts = _parts(found, joint, gaps, settings)

    def closes(p: Part) -> float:
        return min(p.amount, p.unique) if p.amount >= settings.material * gap_share.whole(parts) else p.amount

    while harmful := [p for p in parts if closes(p) < 0.0 and p.name not in needed]:
        name = min(harmful, key=closes).name
        without = _fit_and_measure(fitted, _without(found, name), progress)
        if not without[2].after.total <= gaps.after.total:
            needed.add(name)  # nominal numbers could take its part over only against what is known of them
            continue
        found, joint, gaps = without
        parts = _parts(found, joint, gaps, settings)
    return _Measured(found, joint, gaps, parts)


def _with_learned_term(fitted: CutChains, now: _Measured, settings: Settings, progress: Progress) -> _Measured:
    """Learn the term that the unknown effect adds, if that is the verdict; nothing changes where it does not help."""
    found, joint, _, parts = now
    unknown = found.unknown
    if unknown is None or (gap_share.headline(parts, gap_share.shares(parts), settings.material).verdict
                           != gap_share.UNKNOWN):
        return now
    if passed(settings.deadline):
        return now._replace(found=replace(found, recordings=[s.noted(NOT_LEARNED) for s in found.recordings]))
    progress("learning the missing term", 0.92)
    learned = learn(found.chains, joint.findings[unknown.stage], unknown.term.place, settings.jobs)
    if learned is None:
        return now
    stages = {**found.stages, unknown.stage: learned.findings}
    placed = replace(unknown, term=replace(unknown.term, place=learned.place))
    measured = _fit_and_measure(fitted, replace(found, stages=stages, unknown=placed, learned=learned), progress)
    closer = _Measured(*measured, _parts(*measured, settings))
    if not closer.closes_more(now, settings.material):
        effect_file.forget(learned.id)
        return now
    return closer


def _without(found: _Findings, name: str) -> _Findings:
    """The findings without an effect; what is left without it decides again whether it is random, or unknown."""
    stages = dict(found.stages)
    for stage, f in found.stages.items():
        kept = tuple(s for s in f.found if s[0].hypothesis.name != name)
        if len(kept) < len(f.found):
            final = refit(found.chains, stage, [s[0].hypothesis for s in kept], f.final.values)
            stages[stage] = replace(f, found=kept, final=final)
    detected = gust.detect(found.chains, stages["arm"])
    stages["arm"] = detected.arm
    return _judged(replace(found, stages=stages, statistical=replace(found.statistical, gust=detected.gust)))


def _repeats(parts: Sequence[Part], material: float) -> bool:
    """Whether a material share of the gap repeats that no effect explains: only then an effect may be missing."""
    share = gap_share.shares(parts)
    return gap_share.UNKNOWN in share and share[gap_share.UNKNOWN].value >= material


def _may_approximate(now: _Measured) -> bool:
    """Whether effects found may only approximate an unknown one whose part of the gap, theirs included, is largest."""
    unknown = now.found.unknown
    if unknown is None or not unknown.instead:
        return False
    effects, parts = now.joint.findings[unknown.stage].effects, now.parts
    if not effects:
        return False
    theirs = gap_share.part_of_several(effects, now.joint, now.gaps.held_out.in_motion(), unknown.term.place)
    names = {h.name for h in effects}
    rest = sum(p.amount for p in parts if p.name == gap_share.UNKNOWN)
    others = [p.amount for p in parts if p.name and p.name not in {*names, gap_share.UNKNOWN}]
    return theirs.amount + rest > max(others, default=0.0)


def _unknown_alone(fitted: CutChains, now: _Measured, settings: Settings, progress: Progress) -> _Measured:
    """The same without the effects of the stage in which an unknown one is."""
    assert now.found.unknown is not None
    stage = now.found.unknown.stage
    stages = {**now.found.stages, stage: now.found.stages[stage].nothing()}
    measured = _fit_and_measure(fitted, replace(now.found, stages=stages), progress)
    return _Measured(*measured, _parts(*measured, settings))


def _find(fitted: CutChains, settings: Settings, progress: Progress) -> _Findings:
    """Search effects, detect those that only statistics show, and judge whether one is unknown."""
    chains, recordings = fitted, fitted.recordings
    nominal = stages = unsearched(fitted) if fitted.policy.driven else {}
    trifle = trifling_gap(fitted, stages)
    if fitted.policy.wide_search:
        left = stages["arm"].base.residuals
        if fitted.likely:  # the model was identified with dry friction, which the search has still to find
            left = fit_own(with_values(fitted.model, fitted.likely), recordings).residuals
        if failed := static_map.why_not_identified(recordings, left):
            return _Findings(fitted, stages, Statistical(None, None), None, regions.largest_misfit(fitted, stages),
                             recordings, failed)
    if not fitted.policy.driven:  # a decay has few swings: effects are selected on all of them
        chains = CutChains(fitted.model, [replace(s, train=len(s)) for s in recordings], fitted.policy)
        chains.further, chains.left_out = fitted.further, fitted.left_out
    deadline = settings.deadline

    def searched(chains: CutChains, nominal: Mapping[str, Findings] | None = None) -> dict[str, Findings]:
        return search(chains, settings.jobs,
                      lambda stage, share: progress(f"searching effects of the {stage}", 0.7 * share), deadline,
                      trifle, nominal)

    stages, begun = searched(chains, nominal), None
    if not passed(deadline):
        chains, stages, begun = onset.search_within_windows(chains, stages, searched)
    recordings = [replace(s, window=c.window).noted(*fitted.notes)
                  for s, c in zip(recordings, chains.recordings, strict=True)]
    if any(f.cut_short for f in stages.values()):
        recordings = [s.noted(CUT_SHORT) for s in recordings]
    progress("testing for random effects", 0.7)
    spikes = speed_spikes.detect(recordings)
    if spikes is None:
        recordings = [s.noted(*speed_spikes.left_out(s)) for s in recordings]
    detected = gust.detect(chains, stages["arm"])
    stages = {**stages, "arm": detected.arm}
    misfit = regions.largest_misfit(chains, stages)
    return _judged(_Findings(chains, stages, Statistical(detected.gust, spikes), None, misfit, recordings,
                             onset=begun))


def _judged(found: _Findings, closed: Collection[str] = ()) -> _Findings:
    """The findings, with what they leave judged: whether it is an unknown effect.

    Args:
        found: the findings.
        closed: stages in which the joint fit has closed the gap.
    """
    detected = found.statistical
    return replace(found, unknown=unknown_effect.judge(
        found.chains, found.stages, gust=detected.gust is not None, spikes=detected.spikes is not None, closed=closed))


def _measure(fitted: CutChains, found: _Findings, joint: JointFit) -> _Gaps:
    """The gap on held-out data before and after."""
    chains, model = found.chains, found.chains.model
    # the identified parameters of an uncalibrated rig, and unknown ones of a variant, are its nominal model
    unknown = {n for s in chains.recordings for n in s.variant.unknown}
    base = {n: v for f in found.stages.values() for n, v in f.base.values.items()
            if key(n).is_initial or not chains.policy.calibrated or key(n).plain in unknown}
    values: Mapping[str, float] = joint.values
    if not chains.policy.driven:  # what was selected on the whole decay is fitted again to its training part
        base = refit(fitted, "arm", [], base).values
        values = refit(fitted, "arm", found.stages["arm"].effects, values).values
    held_out = HeldOut(chains, model, found.recordings, spikes=found.statistical.spikes is not None)
    before, after = held_out.runs(base), held_out.runs(values)
    return _Gaps(held_out, base, before, after, held_out.gap(before, known=False), held_out.gap(after),
                 held_out.floors(), Repeats(chains, values))


def _conclude(found: _Findings, joint: JointFit, gaps: _Gaps, parts: Sequence[Part], settings: Settings
              ) -> Conclusions:
    """What the findings, the joint fit and the gaps show."""
    chains, stages, unknown = found.chains, joint.findings, found.unknown
    calibrated = chains.policy.calibrated
    share = gap_share.shares(parts)
    head = gap_share.headline(parts, share, settings.material)
    failed = found.failed or _why_untried(stages, head.verdict) or _why_not_predicted(chains, gaps)
    if head.verdict == "none" and not calibrated:
        failed = failed or gap_share.why_unsure(share, settings.material)
    if failed:
        head = gap_share.Headline(CANNOT_TELL, "none", [], [], set())
    candidates = tuple(c for c in conclude.candidates(joint, found.statistical, gaps.held_out, gaps.after.total,
                                                      head.claimed, share, found.onset)
                       if found.learned is None or c.effect != found.learned.id)
    unlearned = {} if found.learned is None else {found.learned.without.stage: found.learned.without}
    left = _left({**stages, **unlearned}, gust=found.statistical.gust is not None)
    reasons = [f"{c} is off by {times(x)} a reading's noise" for c, x in left.items() if x > GOOD_ENOUGH]
    reasons = [failed] if failed else reasons
    undecided = conclude.not_separable(chains, stages)
    tried = EXPERIMENTS if calibrated else experiments_within(max(s.largest_duty for s in found.recordings))
    rows = conclude.parameter_rows(chains, joint)
    closed, low, high = closure(gaps.before, gaps.after, gaps.floors)
    places = gap_share.share_of_places(parts, lambda: _parts_of_parameters(joint, gaps))
    return Conclusions(
        channels={c: Channel(CHANNELS[c], gaps.before.rms[c], gaps.floors[c], gaps.after.rms[c], *gaps.fits(c))
                  for c in CHANNELS if all(c in g.rms for g in (gaps.before, gaps.after, gaps.fitted))},
        where=Where(head.place, regions.shares(places), tuple(regions.regions(found.misfit))),
        which=Which(family(head.verdict), _families(head.effects), candidates, rows,
                    {channel: Residual(check.rms[channel], check.white[channel], check.dependence)
                     for check in joint.checks.values() for channel in check.rms},
                    tuple(reasons), None if unknown is None else _drawn(unknown.term, found.learned, joint, gaps,
                                                                          settings),
                    tuple(conclude.names(a, b) for a, b in undecided),
                    conclude.next_experiment(chains.model, found.recordings[0], undecided,
                                             _unlearned(joint.values_of_rig, found.learned), tried, settings.jobs),
                    _families(head.small), conclude.sets(stages)),
        closure=Closure(gaps.before.total, gaps.after.total, gaps.before.total_floor(gaps.floors), closed, low, high,
                        budget=gaps.budget(gust=found.statistical.gust is not None, jobs=settings.jobs)),
        identified=None if calibrated else conclude.identified_model(chains, joint, rows),
        variants=conclude.variants(chains, joint) or None,
        since=None if chains.known is None else since.changes(
            chains.known, joint, found.statistical, head.claimed),
        estimates=None if failed else since.estimates(joint, found.statistical))


def _unlearned(values: Mapping[str, float], learned: Learned | None) -> dict[str, float]:
    """The values without those of a learned term: no experiment is designed for its many numbers."""
    return {n: v for n, v in values.items() if learned is None or key(n).owner != learned.id}


def _families(ids: Sequence[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(family(id_) for id_ in ids))


def _why_untried(stages: Mapping[str, Findings], verdict: str) -> str:
    """Why neither "none" nor "unknown" can be said: no effect of some stage was tried; "" if they were."""
    untried = [stage for stage, f in stages.items() if f.cut_short and not f.found and not f.rivals]
    if not untried or verdict not in ("none", gap_share.UNKNOWN):
        return ""
    return f"the time was up before any effect of the {' and of the '.join(untried)} was tried: give more --seconds"


def _why_not_predicted(chains: CutChains, gaps: _Gaps) -> str:
    """Why a model that was identified predicts nothing that it was not fitted to; "" if it predicts something."""
    if not chains.policy.wide_search or "theta" not in gaps.after.rms:
        return ""
    fitted, unseen = gaps.fits("theta")
    if unseen >= 0.0:
        return ""
    return ("the model that was identified does not predict the rig: on the unseen part its free run is off by "
            f"{times(1.0 - unseen)} as much as a constant angle, on the part that was fitted by {times(1.0 - fitted)}; "
            "a longer recording whose last third repeats angles and duties of the part before helps most")


def _drawn(term: MissingTerm, learned: Learned | None, joint: JointFit, gaps: _Gaps, settings: Settings
           ) -> DrawnEffect:
    """The unknown effect by the curves of the term that was learned; by free curves if none was."""
    if learned is None:
        return DrawnEffect(term.place, tuple(
            Curve(c.variable, c.unit, tuple(c.knot.tolist()), tuple(c.value.tolist())) for c in term.curves))
    share = gap_share.shares(_parts_of_effects(joint, gaps, settings))
    curves = tuple(Curve(f"{c.form.of}{FACTORS[c.form.factor]}", c.form.value_unit, tuple(c.knot.tolist()),
                         tuple(learned.values_of(c, joint.values))) for c in learned.curves)
    fitted = fitted_formulas(gaps.held_out.chains, learned, joint.values, joint.sd, settings.jobs)
    formulas = tuple(Formula(f.id, DEFINED[f.id].term, {n: p.default for n, p in DEFINED[f.id].parameters.items()},
                             _gap_with(f.values, learned, joint, gaps)) for f in fitted)
    return DrawnEffect(learned.place, curves, learned.id, share.get(learned.id), formulas)


def _gap_with(values: Mapping[str, float], learned: Learned, joint: JointFit, gaps: _Gaps) -> float | None:
    """The gap with a formula in place of the learned term; None if the model diverges."""
    others = {n: v for n, v in joint.values.items() if key(n).owner != learned.id}
    after = gaps.held_out.gap_of({**others, **values}).total
    return after if math.isfinite(after) else None


FACTORS = {"": "", "thrust": " (share of the thrust)", "theta_dot": " (damping)", "i_a": " (resistance)"}
"""What the values of a curve are that is multiplied by a quantity."""


def _parts(found: _Findings, joint: JointFit, gaps: _Gaps, settings: Settings) -> list[Part]:
    """The parts of the gap: of each effect, and of what stays unexplained."""
    held_out, statistical = gaps.held_out.in_motion(), found.statistical
    parts = _parts_of_effects(joint, gaps, settings)
    unknown = None
    if found.unknown is not None:
        # of a calibrated rig the noise is known: what exceeds it is missing in the model, though it may not repeat
        share = 1.0 if found.chains.policy.calibrated else gaps.repeats.of_stage(found.unknown.stage).share
        unknown = Repeatable(found.unknown.term.place, share)
    parts += gap_share.unexplained(held_out.gap(gaps.runs_after), gaps.floors, statistical.gust, unknown)
    if (learned := found.learned) is not None:  # what it closes, and what it leaves, is of the unknown effect
        its = [p for p in parts if p.name in (learned.id, gap_share.UNKNOWN)]
        one = Part(gap_share.UNKNOWN, learned.place, sum(max(p.amount, 0.0) for p in its),
                   np.sum([p.windows for p in its], axis=0))
        parts = [*(p for p in parts if all(p is not q for q in its)), one]
    if statistical.spikes is not None:  # they are few: the held-out part may hold none
        whole = gaps.held_out.everywhere()
        parts.append(gap_share.part_of_spikes(statistical.spikes, whole.gap(gaps.runs_before, known=False),
                                              whole.gap(gaps.runs_before)))
    return parts


def _parts_of_effects(joint: JointFit, gaps: _Gaps, settings: Settings) -> list[Part]:
    """The part of each effect, measured where the arm moves."""
    moving = gaps.held_out.in_motion()
    return gap_share.parts_of_effects(joint, moving, moving.gap(gaps.runs_before), settings.material, settings.jobs)


def _parts_of_parameters(joint: JointFit, gaps: _Gaps) -> list[Part]:
    """The part of each place in the gap that nominal parameters leave."""
    held_out = gaps.held_out
    parts = []
    for place in dict.fromkeys(PLACE_OF_PARAMETER.values()):
        back = {n: neutral(held_out.model, n) for n in joint.values if PLACE_OF_PARAMETER.get(n) == place}
        parts.append(Part("", place, held_out.gap_of({**joint.values, **back}).total ** 2 - gaps.after.total**2,
                          np.zeros(0)))
    return parts


def _left(findings: Mapping[str, Findings], *, gust: bool) -> dict[str, float]:
    """Channel -> RMS of the residual that is left in its stage, in units of a reading's noise."""
    left: dict[str, float] = {}
    for stage, f in findings.items():
        for channel, r in f.final.residuals.items():
            if not (gust and stage == "arm"):
                name = key(channel).name
                left[name] = max(left.get(name, 0.0), rms(r))
    return left


def _augmented(model: Model, values: Mapping[str, float], statistical: Statistical) -> Model:
    """The model with all that was found, ready for the plant node."""
    extra = {n: v for found in statistical.found for n, v in found.fit.values.items()}
    m = with_values(model, {**of_rig(values), **extra})
    return Model(f"{model.name}, augmented", m.model, m.sensing, m.effects)
