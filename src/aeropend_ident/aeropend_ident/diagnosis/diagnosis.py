# SPDX-License-Identifier: Apache-2.0
"""The diagnosis of one rig, step by step; docs/method.md explains the steps.

identify the nominal model (uncalibrated rigs) -> cut the chain -> search effects -> detect gust and false captures ->
judge whether an effect is unknown -> fit all jointly -> measure the gap -> conclude.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.diagnosis import gap_share, regions, typed_json
from aeropend_ident.diagnosis.chain import static_map
from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.counted_chains import CountedChains
from aeropend_ident.diagnosis.chain.driven_rig import DrivenRig, fit_driven_rig, fit_own, without_findings
from aeropend_ident.diagnosis.chain.free_run import free_run
from aeropend_ident.diagnosis.chain.hanging import mounted
from aeropend_ident.diagnosis.chain.known import Known
from aeropend_ident.diagnosis.chain.nominal_fit import fit_nominal_model
from aeropend_ident.diagnosis.chain.pwm_timing import with_pwm_timing
from aeropend_ident.diagnosis.chain.values import (
    CHANNELS_OF,
    of_rig,
    own_sensing,
    with_values,
)
from aeropend_ident.diagnosis.conclude import conclusions
from aeropend_ident.diagnosis.document import (
    Conclusions,
)
from aeropend_ident.diagnosis.free_run_gap import gap
from aeropend_ident.diagnosis.gap_share import Part
from aeropend_ident.diagnosis.joint_fit import JointFit
from aeropend_ident.diagnosis.measured import (
    Found,
    Gaps,
    Measured,
    Progress,
    Settings,
    Statistical,
    fit_and_measure,
    measured,
    parts_of,
)
from aeropend_ident.diagnosis.policy import MATERIAL_SHARE, angle_only, policy_of
from aeropend_ident.diagnosis.search import gust, onset, speed_spikes, unknown_effect
from aeropend_ident.diagnosis.search.alike import with_simpler
from aeropend_ident.diagnosis.search.findings import Findings
from aeropend_ident.diagnosis.search.learned_term import Learned, learn
from aeropend_ident.diagnosis.search.search import search, taken_out, trifling_gap, unsearched
from aeropend_ident.diagnosis.search.unknown_effect import UnknownEffect
from aeropend_ident.estimation.deadline import passed
from aeropend_ident.estimation.parameter import key
from aeropend_ident.signals.signals import Signals
from aeropend_sim.model import effect_file
from aeropend_sim.model.parameters import Model

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

    Raises:
        RecordingError: the recordings cannot be used, or the model runs away under their duty.
    """
    deadline = None if seconds is None else time.monotonic() + seconds
    with threadpool_limits(1):  # the matrices are narrow: threads of the linear algebra would slow each other down
        policy = policy_of(recordings, fit_nominal=fit_nominal)
        rig: DrivenRig | None = None
        if fit_nominal:
            progress("identifying the nominal model", 0.0)
            if any(s.both_ways for s in recordings):
                model = replace(model, model={**model.model, "reverse": 1.0})
            recordings = mounted(model, recordings)
        likely: dict[str, float] = {}
        if policy.wide_search and angle_only(recordings):
            rig = fit_driven_rig(model, recordings, deadline, jobs)
            without, likely = without_findings(rig, model, recordings, material)
            model = replace(without, name=f"{model.name}, identified")
        elif fit_nominal:
            model, recordings = fit_nominal_model(model, recordings, deadline)
        if policy.calibrated:
            _refuse_divergence(model, recordings)
        kind = CutChains if policy.calibrated else CountedChains
        chains = with_pwm_timing(kind(model, recordings, policy))
        if rig is not None:
            chains.state, chains.plain, chains.notes = rig.state, rig.plain, rig.notes
            chains.likely, chains.with_likely = likely, replace(rig.model, name=model.name)
        chains.known, chains.further, chains.left_out = known, tuple(further), tuple(left_out)
        return _diagnose(chains, Settings(jobs, material, deadline), progress)


def _refuse_divergence(model: Model, recordings: Sequence[Signals]) -> None:
    """Refuse a nominal model whose free run leaves all that can be read.

    Raises:
        RecordingError: it does.
    """
    if any(gap(free_run(model, s), s, 0, len(s)).diverges for s in recordings):
        raise RecordingError(f"the model {model.name} runs away under the duty that was recorded, so that nothing can "
                             "be compared: check its numbers (doctor), or let them be identified (--fit-nominal)")


def _diagnose(fitted: CutChains, settings: Settings, progress: Progress) -> Diagnosis:
    """The steps after the chain is cut; `fitted`: the chains whose training part parameters are fitted to."""
    found = _find(fitted, settings, progress)
    found, joint, gaps = fit_and_measure(fitted, found, progress)
    if _changes_later(gaps):
        return _diagnose(_fitted_further(fitted), settings, progress)
    closed = [stage for stage in found.stages if gaps.after.within(gaps.floors, CHANNELS_OF[stage])]
    if found.unknown is not None and found.unknown.stage in closed:
        found = _judged(found, closed)
    now = _without_harmful(fitted, found, joint, gaps, settings, progress)
    if not (_confirms(now, fitted.likely) or passed(settings.deadline)):  # what is not confirmed stays in the model
        again = fitted.anew(fitted.recordings, fitted.with_likely)
        again.likely = {}
        again.notes = (*again.notes, *(note for note in found.recordings[0].notes if note == CUT_SHORT))
        return _diagnose(again, settings, progress)
    now = _among_imperfections(fitted, now, settings, progress)
    if now.found.unknown is not None and not _repeats(now.parts, settings.material):
        known = replace(now.found, unknown=None)
        now = now._replace(found=known, parts=parts_of(known, now.joint, now.gaps, settings))
    if _may_approximate(now):
        alone = _with_learned_term(fitted, _unknown_alone(fitted, now, settings, progress), settings, progress)
        if alone.shows_approximation(now, settings.material):
            now = alone
        elif alone.found.learned is not None:
            effect_file.forget(alone.found.learned.id)
    if now.found.learned is None:
        now = _with_learned_term(fitted, now, settings, progress)
    found, joint, gaps, _ = now
    model, chains = found.chains.model, found.chains
    nominal = model if chains.policy.calibrated else with_values(model, of_rig(gaps.base))
    progress("done", 1.0)
    measured = model if chains.policy.calibrated else replace(model, sensing=own_sensing(model, found.recordings))
    return Diagnosis(nominal, _augmented(measured, joint.values_of_rig, found.statistical), found.recordings,
                     gaps.runs_before, gaps.runs_after, conclusions(now, settings), found.misfit)


def _confirms(now: Measured, likely: Mapping[str, float]) -> bool:
    """Whether the effects that the rig was identified with were found."""
    found = {h.family for f in now.joint.findings.values() for h in f.effects}
    return {key(name).owner for name in likely} <= found


def _changes_later(gaps: Gaps) -> bool:
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


def _without_harmful(fitted: CutChains, found: Found, joint: JointFit, gaps: Gaps, settings: Settings,
                     progress: Progress) -> Measured:
    """Take out the effects that make the gap larger on data that no fit has used.

    These have a negative part, or the others leave less without them, or the run diverges with them. A part may be one
    of the whole recording: so the held-out gap must not grow by a material amount. Doubtful effects are tried, too:
    what is left without them may be an unknown effect. One at a time, the most harmful first: of effects that stand in
    for each other, one may be needed.
    """
    tried: set[str] = set()
    parts = parts_of(found, joint, gaps, settings)

    def worse() -> bool:
        return gaps.after.diverges or (gap_share.squared(gaps.after) - gap_share.squared(gaps.before)
                                       > settings.material * gap_share.whole(parts))

    def closes(p: Part) -> float:
        return min(p.amount, p.unique) if p.amount >= settings.material * gap_share.whole(parts) else p.amount

    def harmful() -> list[Part]:
        every, doubtful = worse(), gap_share.doubtful(parts)
        return [p for p in parts if p.name not in tried and (every or closes(p) < 0.0 or p.name in doubtful)]

    while some := harmful():
        name = min(some, key=closes).name
        tried.add(name)  # a nominal parameter may take its part over only against what is known of it
        without = fit_and_measure(fitted, _without(found, name), progress)
        less = without[2].after.total
        if less < gaps.after.total if gaps.after.diverges else less <= gaps.after.total:
            found, joint, gaps = without
            parts = parts_of(found, joint, gaps, settings)
    return Measured(found, joint, gaps, parts)


def _among_imperfections(fitted: CutChains, now: Measured, settings: Settings, progress: Progress) -> Measured:
    """The simplest effects that close as much of the gap, if the rig has small imperfections beside them.

    The further parameters of an effect then describe some of these, with much evidence and for little of the gap.
    """
    share = gap_share.shares(now.parts)
    large = {name for name, s in share.items() if s.value >= settings.material}
    if len(share.keys() - large) < gap_share.SEVERAL:
        return now
    stages = {b: with_simpler(now.found.chains, f, large) for b, f in now.found.stages.items()}
    if all(f is now.found.stages[b] for b, f in stages.items()):
        return now
    simpler = measured(fitted, replace(now.found, stages=stages), settings, progress)
    return now if simpler.gaps.after.diverges or now.closes_more(simpler, settings.material) else simpler


def _with_learned_term(fitted: CutChains, now: Measured, settings: Settings, progress: Progress) -> Measured:
    """Learn the term that the unknown effect adds, if that is the verdict; nothing changes where it does not help."""
    found, joint, _, parts = now
    unknown = found.unknown
    if unknown is None or (gap_share.headline(parts, gap_share.shares(parts), settings.material).verdict
                           != gap_share.UNKNOWN):
        return now
    if passed(settings.deadline):
        return now._replace(found=replace(found, recordings=[s.noted(NOT_LEARNED) for s in found.recordings]))
    progress("learning the missing term", 0.92)
    terms = learn(found.chains, joint.findings[unknown.stage], settings.jobs)
    tried = [measured(fitted, _with_term(found, unknown, learned), settings, progress) for learned in terms]
    best = min((one for one in tried if one.closes_more(now, settings.material)),
               key=lambda one: gap_share.squared(one.gaps.after), default=now)
    for learned in terms:
        if learned is not best.found.learned:
            effect_file.forget(learned.id)
    return best


def _with_term(found: Found, unknown: UnknownEffect, learned: Learned) -> Found:
    """The findings with a learned term, at its place, in place of the unknown effect."""
    return replace(found, stages={**found.stages, unknown.stage: learned.findings}, learned=learned,
                   unknown=replace(unknown, term=replace(unknown.term, place=learned.place)))


def _without(found: Found, name: str) -> Found:
    """The findings without an effect; what is left without it decides again whether it is random, or unknown."""
    stages = dict(found.stages)
    for stage, f in found.stages.items():
        for selection in (s for s in f.found if s[0].hypothesis.name == name):
            stages[stage] = taken_out(found.chains, f, selection)
    detected = gust.detect(found.chains, stages["arm"])
    stages["arm"] = detected.arm
    return _judged(replace(found, stages=stages, statistical=replace(found.statistical, gust=detected.gust)))


def _repeats(parts: Sequence[Part], material: float) -> bool:
    """Whether a material share of the gap repeats that no effect explains: only then an effect may be missing."""
    share = gap_share.shares(parts)
    return gap_share.UNKNOWN in share and share[gap_share.UNKNOWN].value >= material


def _may_approximate(now: Measured) -> bool:
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


def _unknown_alone(fitted: CutChains, now: Measured, settings: Settings, progress: Progress) -> Measured:
    """The same without the effects of the stage in which an unknown one is."""
    assert now.found.unknown is not None
    stage = now.found.unknown.stage
    stages = {**now.found.stages, stage: now.found.stages[stage].nothing()}
    return measured(fitted, replace(now.found, stages=stages), settings, progress)


def _find(fitted: CutChains, settings: Settings, progress: Progress) -> Found:
    """Search effects, detect those that only statistics show, and judge whether one is unknown."""
    chains, recordings = fitted, fitted.recordings
    nominal = stages = unsearched(fitted) if fitted.policy.driven else {}
    trifle = trifling_gap(fitted, stages)
    if fitted.policy.wide_search:
        left = stages["arm"].base.residuals
        if fitted.likely:  # the model was identified with dry friction, which the search has still to find
            left = fit_own(with_values(fitted.model, fitted.likely), recordings).residuals
        if failed := static_map.why_not_identified(recordings, left):
            return Found(fitted, stages, Statistical(None, None), None, regions.largest_misfit(fitted, stages),
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
    if not passed(deadline):
        stages = {b: with_simpler(chains, f) for b, f in stages.items()}
    recordings = [replace(s, window=c.window).noted(*fitted.notes)
                  for s, c in zip(recordings, chains.recordings, strict=True)]
    if any(f.cut_short for f in stages.values()):
        recordings = [s.noted(CUT_SHORT) for s in recordings]
    progress("testing for random effects", 0.7)
    spikes = speed_spikes.detect(recordings)
    if spikes is None:
        recordings = [s.noted(*speed_spikes.left_out(s)) for s in recordings]
    # what was not tried may look like chance
    detected = gust.GustDetection(None, stages["arm"]) if passed(deadline) else gust.detect(chains, stages["arm"])
    stages = {**stages, "arm": detected.arm}
    misfit = regions.largest_misfit(chains, stages)
    return _judged(Found(chains, stages, Statistical(detected.gust, spikes), None, misfit, recordings,
                         onset=begun))


def _judged(found: Found, closed: Collection[str] = ()) -> Found:
    """The findings, with what they leave judged: whether it is an unknown effect.

    Args:
        found: the findings.
        closed: stages in which the joint fit has closed the gap.
    """
    detected = found.statistical
    return replace(found, unknown=unknown_effect.judge(
        found.chains, found.stages, gust=detected.gust is not None, spikes=detected.spikes is not None, closed=closed))


def _augmented(model: Model, values: Mapping[str, float], statistical: Statistical) -> Model:
    """The model with all that was found, ready for the plant node."""
    extra = {n: v for found in statistical.found for n, v in found.fit.values.items()}
    m = with_values(model, {**of_rig(values), **extra})
    return Model(f"{model.name}, augmented", m.model, m.sensing, m.effects)
