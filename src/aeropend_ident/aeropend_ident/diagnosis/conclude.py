# SPDX-License-Identifier: Apache-2.0
"""The conclusions of a diagnosis as parts of its document: parameters, candidates, close pairs, next experiment."""

from __future__ import annotations

import math
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aeropend_ident.diagnosis import experiment_design, gap_share, regions, since
from aeropend_ident.diagnosis.chain import driven_rig
from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.priors import CHOSEN, OF_THE_ARM, UNCALIBRATED_SD, ZERO, basis, model_parameters
from aeropend_ident.diagnosis.chain.values import FILTER, STAGES, limits, neutral, of_rig, with_values
from aeropend_ident.diagnosis.document import (
    CANNOT_TELL,
    Candidate,
    Channel,
    Closure,
    Conclusions,
    Curve,
    EffectSet,
    Formula,
    HangingAngle,
    Identified,
    Interval,
    NextExperiment,
    ParameterRow,
    Residual,
    VariantFound,
    Where,
    Which,
    interval,
)
from aeropend_ident.diagnosis.document import UnknownEffect as DrawnEffect
from aeropend_ident.diagnosis.experiment_design import EXPERIMENTS, experiments_within
from aeropend_ident.diagnosis.free_run_gap import Gap, HeldOut, closure
from aeropend_ident.diagnosis.joint_fit import WIDER, JointFit, run_to_run
from aeropend_ident.diagnosis.measured import (
    Gaps,
    Measured,
    Settings,
    Statistical,
    parts_of_parameters,
    share_of_learned,
)
from aeropend_ident.diagnosis.policy import CALIBRATED, GOOD_ENOUGH, angle_only
from aeropend_ident.diagnosis.search.alike import closing_as_much
from aeropend_ident.diagnosis.search.findings import Findings, RankedHypothesis
from aeropend_ident.diagnosis.search.formula_fit import fitted_formulas
from aeropend_ident.diagnosis.search.free_curves import MissingTerm
from aeropend_ident.diagnosis.search.learned_term import Learned
from aeropend_ident.diagnosis.search.onset import Onset
from aeropend_ident.diagnosis.search.selection import plausible
from aeropend_ident.diagnosis.strength import Strengths
from aeropend_ident.estimation.parameter import Parameter, key
from aeropend_ident.signals.signals import CHANNELS, Mounting, Signals
from aeropend_ident.signals.statistics import Z95, rms
from aeropend_ident.signals.variants import SAME
from aeropend_sim.model.effects import DEFINED, family
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import DUTY_MAP, MODEL_NAMES, OPTIONAL, Model
from aeropend_sim.wording import times

DETERMINED = 0.5
"""Share of a prior's width above which the recordings have not determined a parameter (choice)."""

RUNS_AWAY = ("the free run of the model runs away where the rig does not; check the numbers of the model file "
             "(doctor), or let them be identified (--fit-nominal)")

FACTORS = {"": "", "thrust": " (share of the thrust)", "theta_dot": " (damping)", "i_a": " (resistance)"}
"""What the values of a curve are that is multiplied by a quantity."""


def conclusions(now: Measured, settings: Settings) -> Conclusions:
    """What the findings, the joint fit and the gaps show."""
    found, joint, gaps, parts = now
    chains, stages, unknown = found.chains, joint.findings, found.unknown
    calibrated = chains.policy.calibrated
    share = gap_share.shares(parts)
    head = gap_share.headline(parts, share, settings.material)
    failed = (found.failed or _why_untried(stages, head.verdict) or _why_not_predicted(chains, gaps)
              or (RUNS_AWAY if gaps.after.diverges else ""))
    if head.verdict == "none" and not calibrated:
        failed = failed or gap_share.why_unsure(share, settings.material)
    if failed:
        head = gap_share.Headline(CANNOT_TELL, "none", [], [], set())
    listed = tuple(c for c in candidates(joint, found.statistical, gaps.held_out, gaps.after.total, head.claimed, share,
                                         found.onset) if found.learned is None or c.effect != found.learned.id)
    unlearned = {} if found.learned is None else {found.learned.without.stage: found.learned.without}
    left = _left({**stages, **unlearned}, gust=found.statistical.gust is not None)
    reasons = [f"{c} is off by {times(x)} a reading's noise" for c, x in left.items() if x > GOOD_ENOUGH]
    reasons = [failed] if failed else reasons
    drawn = None if unknown is None else _drawn(unknown.term, now, settings)
    undecided = [*not_separable(chains, stages), *stand_ins(parts, stages)]
    tried = EXPERIMENTS if calibrated else experiments_within(max(s.largest_duty for s in found.recordings))
    rows = parameter_rows(chains, joint)
    closed, low, high = closure(gaps.before, gaps.after, gaps.floors)
    places = gap_share.share_of_places(parts, lambda: parts_of_parameters(joint, gaps))
    return Conclusions(
        channels={c: Channel(CHANNELS[c], gaps.before.rms[c], gaps.floors[c], gaps.after.rms[c], *gaps.fits(c))
                  for c in CHANNELS if all(c in g.rms for g in (gaps.before, gaps.after, gaps.fitted))},
        where=Where(head.place, regions.shares(places), tuple(regions.regions(found.misfit))),
        which=Which(family(head.verdict), _families(head.effects), listed, rows,
                    {channel: Residual(check.rms[channel], check.white[channel], check.dependence)
                     for check in joint.checks.values() for channel in check.rms},
                    tuple(reasons), drawn, tuple(names(a, b) for a, b in undecided),
                    next_experiment(chains.model, found.recordings[0], undecided,
                                    _unlearned(joint.values_of_rig, found.learned), tried, settings.jobs),
                    _families(head.small), sets(stages)),
        closure=Closure(gaps.before.total, gaps.after.total, gaps.before.total_floor(gaps.floors), closed, low, high,
                        budget=gaps.budget(gust=found.statistical.gust is not None, jobs=settings.jobs)),
        identified=None if calibrated else identified_model(chains, joint, rows),
        variants=variants(chains, joint) or None,
        since=None if chains.known is None else since.changes(
            chains.known, joint, found.statistical, head.claimed),
        estimates=None if failed else since.estimates(joint, found.statistical))


def parameter_rows(chains: CutChains, joint: JointFit) -> dict[str, ParameterRow]:
    """The parameters of the model that were refitted.

    For an uncalibrated rig all of them, marked by whether the recordings determine them.
    """
    nominal, values, sd = chains.model.model, joint.values, joint.sd
    if chains.policy.calibrated:
        rows = {n: _row(neutral(chains.model, n), interval(values[n], sd[n])) for n in (*MODEL_NAMES, FILTER)
                if n in values}
        return {n: _with_runs(row, n, joint) for n, row in rows.items()}
    fitted = {p.name: p for stage in STAGES for p in model_parameters(chains, stage)}
    alone = angle_only(chains.recordings)
    rows, found = {}, with_values(chains.model, of_rig(values)).model
    left_out = {name for name in (*OPTIONAL, *DUTY_MAP) if nominal[name] == 0.0}
    for n in (name for name in MODEL_NAMES if name not in left_out):
        ends = limits(n)
        p = fitted.get(n, Parameter(n, nominal[n], UNCALIBRATED_SD, ends.low, ends.high, log=nominal[n] > 0.0))
        # with the angle alone, only the curve from duty to lift is identifiable, not its parameters
        known = n in fitted and (n in OF_THE_ARM or not alone)
        value = found[n]
        spread = sd[n] if known else UNCALIBRATED_SD * abs(value)
        prior = p.sd * (value if p.log else 1.0)
        if p.log and value > 0.0:
            reach = math.exp(Z95 * spread / value)
            between = Interval(value, max(value / reach, ends.low), min(value * reach, ends.high))
        else:
            between = interval(value, spread, p.low, p.high)
        row = _row(nominal[n], between, known and spread < DETERMINED * prior)
        own = _over_recordings(n, values, sd) if known else None
        rows[n] = row if own is None else replace(row, value=own.mean.value, low=own.mean.low, high=own.mean.high,
                                                  runs=own.runs, run_to_run=own.run_to_run)
    return rows


def _row(nominal: float, estimate: Interval, determined: bool | None = None) -> ParameterRow:
    return ParameterRow(nominal, estimate.value, estimate.low, estimate.high, determined)


def _with_runs(row: ParameterRow, name: str, joint: JointFit) -> ParameterRow:
    """The row of a calibrated parameter, with what each of several recordings gives for it in its variant."""
    chains = joint.chains
    if name in joint.alone:
        factors = [s.variant.factor.get(name, 1.0) for s in chains.recordings]
        runs = tuple(interval(x * e.value, abs(x) * e.sd) for x, e in zip(factors, joint.alone[name], strict=True))
        return replace(row, runs=runs, run_to_run=run_to_run(joint.alone[name]))
    of_each = [key(name).of(k) if key(name).of(k) in joint.values else name for k in range(len(chains.each))]
    if len(set(of_each)) == 1:
        return row
    return replace(row, runs=tuple(interval(joint.values[n], joint.sd[n]) for n in of_each))


def variants(chains: CutChains, joint: JointFit) -> tuple[VariantFound, ...]:
    """The variants of the rig among the recordings, with the numbers in which they differ.

    Args:
        chains: cut.
        joint: the joint fit.
    """
    found: dict[str, VariantFound] = {}
    for k, s in enumerate(chains.recordings):
        if s.variant == SAME:
            continue
        known = {n: interval(x * joint.values[n], abs(x) * joint.sd[n]) for n, x in s.variant.factor.items()
                 if n in joint.values}
        own = {n: key(n).of(k) for n in s.variant.unknown}
        unknown = {n: interval(joint.values[m], joint.sd[m]) for n, m in own.items() if m in joint.values}
        one = found.setdefault(s.variant.name, VariantFound(s.variant.name, (), {}))
        found[s.variant.name] = replace(one, recordings=(*one.recordings, k),
                                        numbers={**known, **unknown, **one.numbers})
    return tuple(found.values())


@dataclass(frozen=True)
class _OverRecordings:
    """A value that each recording has of its own: mean, values, and their scatter beyond their uncertainty."""

    mean: Interval
    runs: tuple[Interval, ...]
    run_to_run: float


def _over_recordings(name: str, of_all: Mapping[str, float], sd_of_all: Mapping[str, float]) -> _OverRecordings | None:
    """The value of each recording; None if they share one."""
    own = sorted((n for n in of_all if key(n).plain == name), key=lambda n: key(n).recording)
    if len(own) < 2:
        return None
    values, sd = [of_all[n] for n in own], [sd_of_all[n] for n in own]
    spread = math.sqrt(max(float(np.var(values, ddof=1)) - float(np.mean(np.square(sd))), 0.0))
    mean, unsure = float(np.mean(values)), math.sqrt(float(np.var(values, ddof=1)) / len(values))
    unsure = max(unsure, math.sqrt(float(np.sum(np.square(sd)))) / len(sd))
    return _OverRecordings(interval(mean, unsure),
                           tuple(interval(v, s) for v, s in zip(values, sd, strict=True)), spread)


def identified_model(chains: CutChains, joint: JointFit, rows: Mapping[str, ParameterRow]) -> Identified:
    """What the nominal model of an uncalibrated rig was identified from.

    Args:
        chains: cut.
        joint: the joint fit.
        rows: of `parameter_rows`.
    """
    recordings, values = chains.recordings, joint.values
    lift, hangs = None, None
    if "k3" in values and angle_only(recordings):
        lift = driven_rig.lift(with_values(chains.model, chains.values_of(values, 0)), recordings)
    mounting = recordings[0].mounting or Mounting()
    if ZERO in values:
        one, own = interval(values[ZERO], joint.sd[ZERO]), _over_recordings(ZERO, values, joint.sd)
        mean, *runs = (_reading(mounting, x) for x in ([one] if own is None else [own.mean, *own.runs]))
        hangs = HangingAngle(mean.value, mean.low, mean.high, tuple(runs) or None, own.run_to_run if own else None)
    terms = [n for n in CHOSEN if n in values and n != ZERO and key(n).owner in chains.model.effects and lift]
    return Identified(basis(recordings), tuple(n for n, row in rows.items() if not row.determined), lift, hangs,
                      None if mounting == Mounting() else mounting,
                      {n: _within_range(n, values[n], joint.sd[n]) for n in terms})


def _reading(mounting: Mounting, theta: Interval) -> Interval:
    """The reading of the sensor where the angle is one that the fits have, in rad."""
    ends = sorted(mounting.reading(x) for x in (theta.low, theta.high))
    return Interval(mounting.reading(theta.value), *ends)


def candidates(joint: JointFit, statistical: Statistical, held_out: HeldOut, gap_after: float,
               claimed: Container[str], share: Mapping[str, Interval], onset: Onset | None = None
               ) -> tuple[Candidate, ...]:
    """Every hypothesis that was ranked, the most probable first; a found one with its intervals of the joint fit.

    Args:
        joint: the joint fit.
        statistical: effects that were detected by their statistics.
        held_out: measures gaps.
        gap_after: gap of the augmented model.
        claimed: names of the hypotheses that are part of the verdict.
        share: name -> share of the gap.
        onset: when the effects found begin or end; None: they act all the time.
    """
    rows: dict[str, Candidate] = {}
    strengths = Strengths(joint)
    for f in joint.findings.values():
        accepted = {h.family for h in f.effects}
        for k, selection in enumerate(f.selections):
            winner = selection[0].hypothesis.family if k < len(f.found) else None
            # what was found in its place, and after it, is no part of a rival's model
            off = {p.name: neutral(held_out.model, p.name) for s in f.found[k:] for p in s[0].hypothesis.own}
            for r in selection:
                h = r.hypothesis
                mine = h.family in accepted
                if h.family in rows and (rows[h.family].probability >= r.probability or mine):
                    continue
                if mine and r is not selection[0]:
                    continue
                source, spread = (joint.values, joint.sd) if mine else (r.fit.values, r.fit.sd)
                whole = {**joint.values, **off, **r.fit.values}
                estimates = {key(p.name).name: interval(source[p.name], spread[p.name], p.low, p.high) for p in h.own}
                strength = None
                if mine:
                    estimates = _over_forms(estimates, r, f.stage)
                    strength = strengths.interval(r, f.stage, joint.checks[f.stage].form)
                after = gap_after if mine else _bounded(held_out.gap_of(whole))
                since, until = (onset.since, onset.until) if onset and mine else (None, None)
                effect = family(h.effect)
                rows[h.family] = Candidate(
                    effect, h.place, r.probability, estimates, h.name in claimed, after,
                    share.get(h.name) if mine else None, since, until, _finite(r.gain), None if mine else winner,
                    "" if effect == h.effect else h.effect, r.forms or None, strength,
                    {key(p.name).name: run_to_run(joint.alone[p.name]) for p in h.own if p.name in joint.alone} or None
                    if mine else None)
    for extra in statistical.found:
        h = extra.hypothesis
        estimates = {key(n).name: interval(v, extra.fit.sd[n], 0.0) for n, v in extra.fit.values.items()}
        rows[h.name] = Candidate(h.effect, h.place, extra.probability, estimates, h.name in claimed, gap_after,
                                 share.get(h.name))
    return tuple(sorted(rows.values(), key=lambda row: -row.probability))


def _over_forms(estimates: Mapping[str, Interval], ranked: RankedHypothesis, stage: str) -> dict[str, Interval]:
    """The estimates of an effect's parameters, their intervals over all its forms that explain the recording."""
    wider = dict(estimates)
    for r in plausible(ranked, stage):
        for p in r.hypothesis.own:
            name = key(p.name).name
            if name in wider:
                one, now = interval(r.fit.values[p.name], WIDER * r.fit.sd[p.name], p.low, p.high), wider[name]
                wider[name] = replace(now, low=min(now.low, one.low), high=max(now.high, one.high))
    return wider


def not_separable(chains: CutChains, findings: Mapping[str, Findings]
                  ) -> list[tuple[RankedHypothesis, RankedHypothesis]]:
    """Pairs that the recordings cannot separate: the first of a selection, and a rival.

    The rival is probable, or closes as much of the gap.

    Args:
        chains: cut.
        findings: stage -> what is claimed.
    """
    pairs = []
    for f in findings.values():
        before = f.base
        for selection in f.selections:
            if not selection or selection[0].probability <= CALIBRATED.undecided:
                continue
            first, *rest = selection
            doubted = [r for r in rest if r.probability <= chains.policy.undecided]
            alike = closing_as_much(chains, f, before, first, doubted) if selection in f.found else set()
            pairs += [(first, r) for r in rest
                      if r.probability > chains.policy.undecided or r.hypothesis.name in alike]
            before = first.fit
    return pairs


def stand_ins(parts: Sequence[gap_share.Part], findings: Mapping[str, Findings]
              ) -> list[tuple[RankedHypothesis, RankedHypothesis]]:
    """Pairs of effects found of which either closes what both do: the one that is claimed, and the other.

    Args:
        parts: of the gap.
        findings: stage -> what is claimed.
    """
    found = {s[0].hypothesis.name: s[0] for f in findings.values() for s in f.found}
    return [(found[p.instead_of], found[p.name]) for p in parts if p.instead_of]


def sets(findings: Mapping[str, Findings]) -> tuple[EffectSet, ...]:
    """The sets of effects that are likely, where more than one set of a stage is."""
    return tuple(EffectSet(stage, s.effects, s.probability) for stage, f in findings.items() if len(f.sets) > 1
                 for s in f.sets)


def names(first: RankedHypothesis, second: RankedHypothesis) -> tuple[str, str]:
    """The names of two rivals: their effects; of two parameters that may be far off `parameter_mismatch:PARAMETER`."""
    a, b = first.hypothesis, second.hypothesis
    return (family(a.effect), family(b.effect)) if a.effect != b.effect else (a.name, b.name)


def next_experiment(model: Model, signals: Signals, pairs: Sequence[tuple[RankedHypothesis, RankedHypothesis]],
                    values: Mapping[str, float], tried: Sequence[Excitation], jobs: int = 1) -> NextExperiment | None:
    """The experiment that would separate the closest pair; None where nothing is open.

    Args:
        model: the nominal model.
        signals: a recording.
        pairs: see `not_separable`.
        values: of the joint fit.
        tried: the signals that are tried.
        jobs: processes.
    """
    if not pairs:
        return None
    if not signals.driven:
        return NextExperiment("release the arm from a larger angle and record until it rests: the decay of the swings "
                              "shows the kind of friction; drive the arm and record the command as well to see more",
                              {})
    first, second = max(pairs, key=lambda pair: pair[1].probability)
    own = {p.name: neutral(model, p.name) for r in (first, second) for p in r.hypothesis.own}
    one, other = ({**values, **own, **r.fit.values} for r in (first, second))
    if any(key(n).recording for n in values):
        one, other = of_rig(one), of_rig(other)
    return experiment_design.next_experiment(model, signals, one, other, names(first, second), tried, jobs)


def _within_range(name: str, value: float, sd: float) -> Interval:
    """The estimate of a parameter of an effect; its interval ends where the range of the parameter does."""
    p = limits(name)
    return interval(value, sd, p.low, p.high)


def _finite(x: float) -> float | None:
    return x if math.isfinite(x) else None


def _bounded(gap: Gap) -> float | None:
    """The total gap; None if the run diverges."""
    return None if gap.diverges else gap.total


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


def _why_not_predicted(chains: CutChains, gaps: Gaps) -> str:
    """Why a model that was identified predicts nothing that it was not fitted to; "" if it predicts something."""
    if not chains.policy.wide_search or "theta" not in gaps.after.rms:
        return ""
    fitted, unseen = gaps.fits("theta")
    if unseen >= 0.0:
        return ""
    return ("the model that was identified does not predict the rig: on the unseen part its free run is off by "
            f"{times(1.0 - unseen)} as much as a constant angle, on the part that was fitted by {times(1.0 - fitted)}; "
            "a longer recording whose last third repeats angles and duties of the part before helps most")


def _drawn(term: MissingTerm, now: Measured, settings: Settings) -> DrawnEffect:
    """The unknown effect by the curves of the term that was learned; by free curves if none was."""
    joint, gaps, learned = now.joint, now.gaps, now.found.learned
    if learned is None:
        return DrawnEffect(term.place, tuple(
            Curve(c.variable, c.unit, tuple(c.knot.tolist()), tuple(c.value.tolist())) for c in term.curves))
    curves = tuple(Curve(f"{c.form.of}{FACTORS[c.form.factor]}", c.form.value_unit, tuple(c.knot.tolist()),
                         tuple(learned.values_of(c, joint.values))) for c in learned.curves)
    fitted = fitted_formulas(gaps.held_out.chains, learned, joint.values, joint.sd, settings.jobs)
    formulas = tuple(Formula(f.id, DEFINED[f.id].term, {n: p.default for n, p in DEFINED[f.id].parameters.items()},
                             _gap_with(f.values, learned, joint, gaps)) for f in fitted)
    return DrawnEffect(learned.place, curves, learned.id, share_of_learned(now, learned, settings), formulas)


def _gap_with(values: Mapping[str, float], learned: Learned, joint: JointFit, gaps: Gaps) -> float | None:
    """The gap with a formula in place of the learned term; None if the model diverges."""
    others = {n: v for n, v in joint.values.items() if key(n).owner != learned.id}
    return _bounded(gaps.held_out.gap_of({**others, **values}))


def _left(findings: Mapping[str, Findings], *, gust: bool) -> dict[str, float]:
    """Channel -> RMS of the residual that is left in its stage, in units of a reading's noise."""
    left: dict[str, float] = {}
    for stage, f in findings.items():
        for channel, r in f.final.residuals.items():
            if not (gust and stage == "arm"):
                name = key(channel).name
                left[name] = max(left.get(name, 0.0), rms(r))
    return left
