# SPDX-License-Identifier: Apache-2.0
"""The whole diagnosis of one rig: gap, place, effects, numbers, and how far the gap closes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from aeropend_ident.diagnosis import conclude, free_run_gap, joint_fit, regions
from aeropend_ident.diagnosis.chain import nominal_fit
from aeropend_ident.diagnosis.chain.cached_chain import ThriftyChains
from aeropend_ident.diagnosis.chain.chain import PLACE_OF_NUMBER, Chains, of_recording, with_values
from aeropend_ident.diagnosis.chain.priors import free_swinging
from aeropend_ident.diagnosis.chain.pwm_timing import timed
from aeropend_ident.diagnosis.experiment_design import EXPERIMENTS, within
from aeropend_ident.diagnosis.joint_fit import neutral
from aeropend_ident.diagnosis.search import gust, speed_spikes, unknown_effect
from aeropend_ident.diagnosis.search.hypotheses import Hypothesis
from aeropend_ident.diagnosis.search.search import Findings, refit, search
from aeropend_ident.diagnosis.search.selection import GOOD_ENOUGH, Weighed
from aeropend_ident.signals.signals import CHANNELS, Signals
from aeropend_sim.model.parameters import Model

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Diagnosis:
    """What was found.

    Attributes:
        model: the nominal model, of a rig whose numbers nobody knows the identified one.
        augmented: with refitted numbers and found effects.
        signals: the recordings. before, after: channel -> (N,) free-run readings, per recording.
        body: the content of `diagnosis.json` from `channels` on (contract section 5).
        misfit: what the nominal structure leaves where it fits worst, and the variables beside it, name -> (M,).
    """

    model: Model
    augmented: Model
    signals: Sequence[Signals]
    before: Sequence[Mapping[str, Array]]
    after: Sequence[Mapping[str, Array]]
    body: dict[str, object]
    misfit: Mapping[str, Array]


Progress = Callable[[str, float], None]
"""Called with what is being done and the share (0..1) that is behind."""


def diagnose(model: Model, recordings: Sequence[Signals], jobs: int = 1, progress: Progress = lambda *_: None, *,
             fit_nominal: bool = False) -> Diagnosis:
    """Find where a model and a rig part, by which effect, and how far the gap closes.

    Args:
        model: the nominal model, with effects already known to be there.
        recordings: one or more of one rig.
        jobs: threads.
        progress: told how far it is.
        fit_nominal: the model's numbers are only a guess, good to a factor of three.
    """
    if fit_nominal:
        progress("identifying the nominal model", 0.0)
        with threadpool_limits(1):
            model, recordings = nominal_fit.identify(model, recordings)
    with threadpool_limits(1):  # the matrices are narrow: threads of the linear algebra only get in each other's way
        chains = ThriftyChains(model, recordings) if fit_nominal else Chains(model, recordings)
        return _diagnose(timed(chains), jobs, progress)


def _diagnose(chains: Chains, jobs: int, progress: Progress) -> Diagnosis:
    model, recordings = chains.model, chains.recordings
    fitted = chains
    if chains.fit_nominal and free_swinging(recordings):  # few swings: what brakes them shows in the last ones too
        chains = Chains(model, [replace(s, train=len(s)) for s in recordings], fit_nominal=True)
    findings = search(chains, jobs, lambda block, share: progress(f"weighing effects of the {block}", 0.7 * share))
    if any(f.cut_short for f in findings.values()):
        said = ("the search was cut short to bound its time: an effect beside the first, or a rival close to it, may "
                "have been missed")
        recordings = [replace(s, notes=(*s.notes, said)) for s in recordings]
    progress("looking for chance", 0.7)
    spikes = speed_spikes.found(recordings)
    torque = gust.found(chains, findings["arm"])
    misfit, variables = regions.misfit_signal(chains, findings)
    strange = unknown_effect.found(chains, findings, torque is not None, bool(spikes))
    progress("fitting the whole chain", 0.75)
    settled = joint_fit.settle(chains, findings, torque is not None)
    values, sd = settled.values, settled.sd
    # of an unknown rig the identified numbers, those of each run, are the nominal model
    base_values = {n: v for f in findings.values() for n, v in f.base.values.items()
                   if n.startswith("initial.") or chains.fit_nominal}
    progress("measuring the gap", 0.9)
    judged = values
    if fitted is not chains:
        base_values, judged = (refit(fitted, "arm", effects, start).values for start, effects in (
            (base_values, []), (values, findings["arm"].effects)))
    before = [free_run_gap.free_run(model, s, chains.own(base_values, k)) for k, s in enumerate(recordings)]
    after = [free_run_gap.free_run(model, s, chains.own(judged, k)) for k, s in enumerate(recordings)]
    found = [h for f in findings.values() for h in f.effects]
    scorer = free_run_gap.Scorer(chains, model, recordings, bool(spikes))
    gap_before, gap_after = scorer.gap(before, known=False), scorer.gap(after)
    floors = scorer.floors()
    share, low, high = free_run_gap.closed(gap_before, gap_after, floors)

    unexplained = _unexplained(findings, gap_after, floors)
    if strange is not None and unexplained:
        unexplained = {strange.shape.place: sum(unexplained.values())}
    amounts = _amounts(found, values, scorer, torque, spikes, before, unexplained)
    candidates = conclude.candidates(findings, values, sd, torque, spikes, scorer, gap_after.total)
    reasons = [f"{c} is off by {x:.1f} times a reading's noise"
               for c, x in _left(findings, torque is not None).items() if x > GOOD_ENOUGH]
    parts = regions.shares((place, amount) for _, place, amount in amounts)
    ranked = sorted((a for a in amounts if a[0]), key=lambda a: -a[2])
    effects = list(dict.fromkeys(name.partition(":")[0] for name, _, _ in ranked))
    verdict, place = (effects[0], ranked[0][1]) if ranked else ("none", "none")
    if strange is not None and (strange.first or not effects):
        verdict, place = "unknown", strange.shape.place

    least = conclude.UNDECIDED_UNKNOWN if chains.fit_nominal else conclude.UNDECIDED
    undecided = conclude.not_separable(findings, least)
    tried = within(max(float(s.duty.max()) for s in recordings)) if chains.fit_nominal else EXPERIMENTS
    augmented = _augmented(model, values, torque, spikes)
    rows = conclude.numbers(chains, values, sd)
    names = [c for c in CHANNELS if c in gap_before.rms]
    body: dict[str, object] = {
        "channels": {c: {"unit": CHANNELS[c], "gap": gap_before.rms[c], "floor": floors[c],
                         "gap_after": gap_after.rms[c]} for c in names},
        "where": {"place": place, "share": parts, "regions": regions.regions(misfit, variables)},
        "which": {"verdict": verdict, "effects": effects, "candidates": candidates,
                  "numbers": rows,
                  "residuals": {channel: {"rms": check.rms[channel], "white": check.white[channel],
                                          "dependence": check.dependence}
                                for check in settled.checks.values() for channel in check.rms},
                  "unexplained": reasons, "unknown": strange.document() if strange is not None else None,
                  "not_separable": [list(conclude.names(a, b)) for a, b in undecided],
                  "next_experiment": conclude.next_experiment(model, recordings[0], undecided, values, tried)},
        "shrink": {"gap": gap_before.total, "gap_after": gap_after.total, "floor": scorer.bottom(gap_before, floors),
                   "closed": share, "low": low, "high": high},
    }
    if chains.fit_nominal:
        body["identified"] = conclude.identified_model(chains, values, sd, rows)
        model = with_values(model, nominal_fit.shared(base_values))
    progress("done", 1.0)
    return Diagnosis(model, augmented, recordings, before, after, body, {"misfit": misfit, **variables})


def _amounts(found: Sequence[Hypothesis], values: Mapping[str, float], scorer: free_run_gap.Scorer,
             torque: Weighed | None, spikes: Weighed | None, before: Sequence[Mapping[str, Array]],
             unexplained: dict[str, float]) -> list[tuple[str, str, float]]:
    """(name, place, squared gap) of each finding: what comes back when it is taken out; no name for what is not one."""
    model, best = scorer.model, scorer.squared(values)

    def comes_back(nominal: Mapping[str, float]) -> float:
        return max(scorer.squared({**values, **nominal}) - best, 0.0)

    amounts = [(h.name, h.place, comes_back({u.name: neutral(model, u.name) for u in h.starts[0]})) for h in found]
    if torque is not None:
        amounts.append((torque.hypothesis.name, torque.hypothesis.place, unexplained.pop("arm", 0.0)))
    if spikes is not None:
        with_, without = scorer.gap(before, known=False), scorer.gap(before)
        amounts.append((spikes.hypothesis.name, spikes.hypothesis.place, max(with_.total**2 - without.total**2, 0.0)))
    amounts += [("", place, amount) for place, amount in unexplained.items()]
    if not amounts:  # nothing but numbers within their uncertainty: how the gap that they leave is shared
        for place in dict.fromkeys(PLACE_OF_NUMBER.values()):
            back = {n: model.model[n] for n in values if PLACE_OF_NUMBER.get(n) == place}
            amounts.append(("", place, comes_back(back)))
    return amounts


def _left(findings: Mapping[str, Findings], torque: bool) -> dict[str, float]:
    """Channel -> RMS of what is left in its part of the cut chain, in units of a reading's noise."""
    left: dict[str, float] = {}
    for block, f in findings.items():
        for channel, r in f.final.residuals.items():
            if not (torque and block == "arm"):
                name = of_recording(channel)[0]
                left[name] = max(left.get(name, 0.0), float(np.sqrt(np.mean(r * r))))
    return left


def _unexplained(findings: Mapping[str, Findings], after: free_run_gap.Gap, floors: Mapping[str, float]
                 ) -> dict[str, float]:
    """Place -> squared gap that is left there: what the cut chain leaves above the floor."""
    home = {"v_a": "actuator", "i_a": "electrical", "omega": "rotor", "theta": "arm"}
    left: dict[str, float] = {}
    for f in findings.values():
        for channel, r in f.final.residuals.items():
            name = of_recording(channel)[0]
            excess = float(np.mean(r * r)) - GOOD_ENOUGH**2
            if excess > 0.0 and name in after.spread:
                left[home[name]] = excess * (floors[name] / after.spread[name]) ** 2 / len(after.spread)
    return left


def _augmented(model: Model, values: Mapping[str, float], torque: Weighed | None, spikes: Weighed | None) -> Model:
    """The model with all that was found, ready for the plant node."""
    extra = {n: v for w in (torque, spikes) if w is not None for n, v in w.fit.values.items()}
    m = with_values(model, {**nominal_fit.shared(values), **extra})
    return Model(f"{model.name}, augmented", m.model, m.sensing, m.effects)
