# SPDX-License-Identifier: Apache-2.0
"""The diagnosis of one rig, step by step; docs/method.md explains the steps.

identify the nominal model (uncalibrated rigs) -> cut the chain -> search effects -> detect gust and false captures ->
judge whether an effect is unknown -> fit all jointly -> measure the gap -> conclude.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from aeropend_ident.diagnosis import conclude, regions, typed_json
from aeropend_ident.diagnosis.chain.cached_chain import CachedChains
from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.nominal_fit import fit_nominal_model
from aeropend_ident.diagnosis.chain.pwm_timing import with_pwm_timing
from aeropend_ident.diagnosis.chain.values import PLACE_OF_CHANNEL, PLACE_OF_PARAMETER, neutral, of_rig, with_values
from aeropend_ident.diagnosis.conclude import Statistical
from aeropend_ident.diagnosis.document import (
    Channel,
    Closure,
    Conclusions,
    Curve,
    Residual,
    UnknownEffect,
    Where,
    Which,
)
from aeropend_ident.diagnosis.experiment_design import EXPERIMENTS, experiments_within
from aeropend_ident.diagnosis.free_run_gap import Gap, HeldOut, closure
from aeropend_ident.diagnosis.joint_fit import JointFit, fit_jointly
from aeropend_ident.diagnosis.policy import GOOD_ENOUGH, policy_of
from aeropend_ident.diagnosis.search import gust, speed_spikes, unknown_effect
from aeropend_ident.diagnosis.search.findings import Findings
from aeropend_ident.diagnosis.search.search import refit, search
from aeropend_ident.estimation.parameter import key
from aeropend_ident.signals.signals import CHANNELS, Signals
from aeropend_ident.signals.statistics import rms
from aeropend_sim.model.parameters import Model

Array = NDArray[np.float64]

CUT_SHORT = ("the search was cut short to bound its time: an effect beside the first, or a rival close to it, may have "
             "been missed")


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
             fit_nominal: bool = False) -> Diagnosis:
    """Find where a model and a rig differ, which effect causes it, and how far the gap closes.

    Args:
        model: the nominal model, with effects that are known to be there.
        recordings: one or more of one rig.
        jobs: threads; the result does not depend on them.
        progress: called as the work goes on.
        fit_nominal: whether the rig is uncalibrated: its parameters are known to a factor of three at best.
    """
    with threadpool_limits(1):  # the matrices are narrow: threads of the linear algebra would slow each other down
        if fit_nominal:
            progress("identifying the nominal model", 0.0)
            model, recordings = fit_nominal_model(model, recordings)
        policy = policy_of(recordings, fit_nominal=fit_nominal)
        kind = CutChains if policy.calibrated else CachedChains
        return _diagnose(with_pwm_timing(kind(model, recordings, policy)), jobs, progress)


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
    """

    chains: CutChains
    stages: Mapping[str, Findings]
    statistical: Statistical
    unknown: unknown_effect.UnknownEffect | None
    misfit: regions.Misfit
    recordings: Sequence[Signals]


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
    """

    held_out: HeldOut
    base: Mapping[str, float]
    runs_before: Sequence[Mapping[str, Array]]
    runs_after: Sequence[Mapping[str, Array]]
    before: Gap
    after: Gap
    floors: Mapping[str, float]


def _diagnose(fitted: CutChains, jobs: int, progress: Progress) -> Diagnosis:
    """The steps after the chain is cut; `fitted`: the chains whose training part parameters are fitted to."""
    found = _find(fitted, jobs, progress)
    progress("fitting all jointly", 0.75)
    joint = fit_jointly(found.chains, found.stages, gust=found.statistical.gust is not None)
    found = replace(found, stages=joint.findings)
    progress("measuring the gap", 0.9)
    gaps = _measure(fitted, found, joint)
    conclusions = _conclude(found, joint, gaps)
    model, chains = found.chains.model, found.chains
    nominal = model if chains.policy.calibrated else with_values(model, of_rig(gaps.base))
    progress("done", 1.0)
    return Diagnosis(nominal, _augmented(model, joint.values, found.statistical), found.recordings, gaps.runs_before,
                     gaps.runs_after, conclusions, found.misfit)


def _find(fitted: CutChains, jobs: int, progress: Progress) -> _Findings:
    """Search effects, detect those that only statistics show, and judge whether one is unknown."""
    chains, recordings = fitted, fitted.recordings
    if not fitted.policy.driven:  # a decay has few swings: effects are selected on all of them
        chains = CutChains(fitted.model, [replace(s, train=len(s)) for s in recordings], fitted.policy)
    stages = search(chains, jobs, lambda stage, share: progress(f"searching effects of the {stage}", 0.7 * share))
    if any(f.cut_short for f in stages.values()):
        recordings = [s.noted(CUT_SHORT) for s in recordings]
    progress("testing for random effects", 0.7)
    spikes = speed_spikes.detect(recordings)
    detected = gust.detect(chains, stages["arm"])
    stages = {**stages, "arm": detected.arm}
    misfit = regions.largest_misfit(chains, stages)
    unknown, stages = unknown_effect.judge(chains, stages, gust=detected.gust is not None, spikes=spikes is not None)
    return _Findings(chains, stages, Statistical(detected.gust, spikes), unknown, misfit, recordings)


def _measure(fitted: CutChains, found: _Findings, joint: JointFit) -> _Gaps:
    """The gap on held-out data before and after."""
    chains, model = found.chains, found.chains.model
    # the identified parameters of an uncalibrated rig, those of each recording, are its nominal model
    base = {n: v for f in found.stages.values() for n, v in f.base.values.items()
            if key(n).is_initial or not chains.policy.calibrated}
    values: Mapping[str, float] = joint.values
    if fitted is not chains:  # what was selected on the whole decay is fitted again to its training part
        base = refit(fitted, "arm", [], base).values
        values = refit(fitted, "arm", found.stages["arm"].effects, values).values
    held_out = HeldOut(chains, model, found.recordings, spikes=found.statistical.spikes is not None)
    before, after = held_out.runs(base), held_out.runs(values)
    return _Gaps(held_out, base, before, after, held_out.gap(before, known=False), held_out.gap(after),
                 held_out.floors())


def _conclude(found: _Findings, joint: JointFit, gaps: _Gaps) -> Conclusions:
    """What the findings, the joint fit and the gaps show."""
    chains, stages, unknown = found.chains, found.stages, found.unknown
    calibrated = chains.policy.calibrated
    candidates = conclude.candidates(stages, joint, found.statistical, gaps.held_out, gaps.after.total)
    amounts = _amounts(found, joint.values, gaps)
    verdict, place, effects = _verdict(amounts, unknown)
    reasons = [f"{c} is off by {x:.1f} times a reading's noise"
               for c, x in _left(stages, gust=found.statistical.gust is not None).items() if x > GOOD_ENOUGH]
    undecided = conclude.not_separable(stages, chains.policy.undecided)
    tried = EXPERIMENTS if calibrated else experiments_within(max(float(s.duty.max()) for s in found.recordings))
    rows = conclude.parameter_rows(chains, joint)
    share, low, high = closure(gaps.before, gaps.after, gaps.floors)
    return Conclusions(
        channels={c: Channel(CHANNELS[c], gaps.before.rms[c], gaps.floors[c], gaps.after.rms[c])
                  for c in CHANNELS if c in gaps.before.rms},
        where=Where(place, regions.shares((p, amount) for _, p, amount in amounts),
                    tuple(regions.regions(found.misfit))),
        which=Which(verdict, tuple(effects), candidates, rows,
                    {channel: Residual(check.rms[channel], check.white[channel], check.dependence)
                     for check in joint.checks.values() for channel in check.rms},
                    tuple(reasons), None if unknown is None else _curves(unknown),
                    tuple(conclude.names(a, b) for a, b in undecided),
                    conclude.next_experiment(chains.model, found.recordings[0], undecided, joint.values, tried)),
        closure=Closure(gaps.before.total, gaps.after.total, gaps.before.total_floor(gaps.floors), share, low, high),
        identified=None if calibrated else conclude.identified_model(chains, joint, rows))


def _verdict(amounts: Sequence[tuple[str, str, float]], unknown: unknown_effect.UnknownEffect | None
             ) -> tuple[str, str, list[str]]:
    """The verdict, its place, and the effects found, the largest first."""
    ranked = sorted((a for a in amounts if a[0]), key=lambda a: -a[2])
    effects = list(dict.fromkeys(name.partition(":")[0] for name, _, _ in ranked))
    if unknown is not None and (unknown.first or not effects):
        return "unknown", unknown.term.place, effects
    return (effects[0], ranked[0][1], effects) if ranked else ("none", "none", effects)


def _curves(unknown: unknown_effect.UnknownEffect) -> UnknownEffect:
    return UnknownEffect(unknown.term.place, tuple(
        Curve(c.variable, c.unit, tuple(c.knot.tolist()), tuple(c.value.tolist())) for c in unknown.term.curves))


def _amounts(found: _Findings, values: Mapping[str, float], gaps: _Gaps) -> list[tuple[str, str, float]]:
    """Name, place and squared gap of each finding: the gap that comes back when it is taken out.

    Entries without a name are no findings: what stays unexplained at a place; if there is neither, the share of each
    place in the gap that nominal parameters leave.
    """
    held_out, statistical = gaps.held_out, found.statistical
    best = held_out.gap_of(values).total ** 2
    unexplained = _unexplained(found.stages, gaps.after, gaps.floors)
    if found.unknown is not None and unexplained:
        unexplained = {found.unknown.term.place: sum(unexplained.values())}

    def comes_back(nominal: Mapping[str, float]) -> float:
        return max(held_out.gap_of({**values, **nominal}).total ** 2 - best, 0.0)

    effects = [h for f in found.stages.values() for h in f.effects]
    amounts = [(h.name, h.place, comes_back({p.name: neutral(held_out.model, p.name) for p in h.own}))
               for h in effects]
    if statistical.gust is not None:
        h = statistical.gust.hypothesis
        amounts.append((h.name, h.place, unexplained.pop("arm", 0.0)))
    if statistical.spikes is not None:
        h = statistical.spikes.hypothesis
        with_, without = held_out.gap(gaps.runs_before, known=False), held_out.gap(gaps.runs_before)
        amounts.append((h.name, h.place, max(with_.total**2 - without.total**2, 0.0)))
    amounts += [("", place, amount) for place, amount in unexplained.items()]
    if not amounts:
        for place in dict.fromkeys(PLACE_OF_PARAMETER.values()):
            back = {n: held_out.model.model[n] for n in values if PLACE_OF_PARAMETER.get(n) == place}
            amounts.append(("", place, comes_back(back)))
    return amounts


def _left(findings: Mapping[str, Findings], *, gust: bool) -> dict[str, float]:
    """Channel -> RMS of the residual that is left in its stage, in units of a reading's noise."""
    left: dict[str, float] = {}
    for stage, f in findings.items():
        for channel, r in f.final.residuals.items():
            if not (gust and stage == "arm"):
                name = key(channel).name
                left[name] = max(left.get(name, 0.0), rms(r))
    return left


def _unexplained(findings: Mapping[str, Findings], after: Gap, floors: Mapping[str, float]) -> dict[str, float]:
    """Place -> squared gap that its channel keeps above the floor in the cut chain."""
    left: dict[str, float] = {}
    for f in findings.values():
        for channel, r in f.final.residuals.items():
            name = key(channel).name
            excess = float(np.mean(r * r)) - GOOD_ENOUGH**2
            if excess > 0.0 and name in after.spread:
                left[PLACE_OF_CHANNEL[name]] = excess * (floors[name] / after.spread[name]) ** 2 / len(after.spread)
    return left


def _augmented(model: Model, values: Mapping[str, float], statistical: Statistical) -> Model:
    """The model with all that was found, ready for the plant node."""
    extra = {n: v for found in statistical.found for n, v in found.fit.values.items()}
    m = with_values(model, {**of_rig(values), **extra})
    return Model(f"{model.name}, augmented", m.model, m.sensing, m.effects)
