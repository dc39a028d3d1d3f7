# SPDX-License-Identifier: Apache-2.0
"""The search for missing effects: stage by stage, round by round, until the rest is noise or nothing explains it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import reduce
from itertools import pairwise

import numpy as np
from scipy.special import expit

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.priors import TOLERANCE, model_parameters, nominal_parameters
from aeropend_ident.diagnosis.chain.values import CHANNELS_OF, STAGES
from aeropend_ident.diagnosis.policy import MATERIAL, MATERIAL_SHARE
from aeropend_ident.diagnosis.search.findings import Findings, RankedHypothesis, Selection, adopted, drop_unneeded
from aeropend_ident.diagnosis.search.free_curves import missing_terms
from aeropend_ident.diagnosis.search.hypotheses import (
    Hypothesis,
    as_form,
    as_identified,
    delay_from_voltage,
    hypotheses,
    is_decided,
    stages_of,
)
from aeropend_ident.diagnosis.search.selection import (
    ALIKE,
    CONTENDERS,
    FORM_SHOWS,
    ROUNDS,
    SelectionRound,
    better,
    frugal,
    log_evidence_over,
    mean_square,
    shared,
    squared_gap,
)
from aeropend_ident.diagnosis.search.sets import compared, with_best_set
from aeropend_ident.estimation.deadline import passed
from aeropend_ident.estimation.map_fit import Fit, fit, fit_again, largest_ess
from aeropend_ident.estimation.parallel import parallel
from aeropend_ident.estimation.parameter import Parameter, started

TRIFLE = 0.1
"""Part of a material share of the gap below which the rest of a stage is not searched, nor an effect accepted (choice).

Effects that overlap are worth more in the free run than in their stage: a whole share would be too much."""

MOST_EFFECTS = 3
"""Effects that are searched one after another in one stage, where sets are not compared (choice).

Measured: at ±30 % no verdict of 25 recordings changes (docs/results/thresholds.md)."""

CUT_SHORT_ROUNDS = 2
"""Rounds of the last fits when the budget is spent (choice).

Measured: at ±30 % no verdict of 22 recordings changes (docs/results/thresholds.md)."""

BETTER_ALONE = 1.0
"""Log evidence by which the fit without an effect must improve from a rival's parameters to replace it (choice).

Measured: at ±30 % no verdict of 22 recordings changes (docs/results/thresholds.md)."""

UNNEEDED = 1e9
"""[nats] Log evidence by which an effect that closes a trifle counts as unneeded (choice: more than any evidence)."""

STANDS_IN = 0.5
"""Squared correlation of the sizes of two effects above which one may stand in for the other.

Derived: more than half of the variance of its size is that of the other's."""

EVEN = 0.5
"""Probability of all hypotheses of a round together above which an effect is found.

Derived: an effect is then more likely than none."""


FORMED_ANEW = 2
"""How often the forms of the effects are chosen anew, and a better set is searched with them (choice)."""

MOSTLY = 0.5
"""Share of the gap of a stage above which an effect is kept for the next round, whatever its evidence alone.

Derived: it closes more than it leaves."""


def search(chains: CutChains, jobs: int = 1, progress: Callable[[str, float], None] = lambda *_: None,
           deadline: float | None = None, trifle: float = 0.0, nominal: Mapping[str, Findings] | None = None
           ) -> dict[str, Findings]:
    """Search for effects stage by stage, along the chain.

    Args:
        chains: cut; the input of each stage is set to what was measured, described by what was found before it.
        jobs: processes.
        progress: called with the stage and the share of stages behind it.
        deadline: [s] of `time.monotonic` after which no further effect is searched; None: the budget of the policy.
        trifle: squared gap below which the rest of a stage is not searched, nor an effect accepted; see
            `trifling_gap`.
        nominal: what `unsearched` returns for these chains, which saves its fits; None: they are made.

    Returns:
        Stage -> what was found.
    """
    findings: dict[str, Findings] = {}
    calibrated, known = chains.policy.calibrated, chains.known
    all_ = hypotheses(chains.model, chains.further, chains.left_out, mismatches=calibrated, known=known)
    everything = [as_identified(chains, h) for h in all_ if not is_decided(chains, h)]
    stages = stages_of(chains, everything)
    acts_on = {h.family: stages[h.name] for h in everything}
    carried: dict[str, Parameter] = {}
    bases, following = {stage: f.final for stage, f in (nominal or {}).items()}, dict(pairwise(STAGES))
    for done, stage in enumerate(STAGES):
        progress(stage, done / len(STAGES))
        mine = [h for h in everything if acts_on[h.family][:1] == (stage,)]
        f = _search_stage(chains, stage, mine, acts_on, list(carried.values()), bases, trifle, jobs, deadline)
        findings[stage] = f
        if f.final is not bases.get(stage):  # the input of the next stage changes
            bases.pop(following.get(stage, ""), None)
        # an effect that acts on later stages too goes along, with the uncertainty that it has here
        for h in f.effects:
            if len(acts_on[h.family]) > 1:
                for p in h.own:
                    carried[p.name] = Parameter(p.name, f.final.values[p.name], max(f.final.sd[p.name], 1e-12),
                                                p.low, p.high)
        chains.set_next_input(stage, f.final.values)
    return findings


def unsearched(chains: CutChains) -> dict[str, Findings]:
    """The fits of the nominal structure alone, stage by stage, with nothing found."""
    findings = {}
    for stage in STAGES:
        base = fit(chains.residuals(stage), nominal_parameters(chains, stage), least_ess=chains.policy.least_ess)
        findings[stage] = Findings(stage, base, base)
        chains.set_next_input(stage, base.values)
    return findings


def trifling_gap(chains: CutChains, nominal: Mapping[str, Findings]) -> float:
    """The squared gap that is a trifle, compared with what the nominal structure leaves in all stages.

    Args:
        chains: cut.
        nominal: what `unsearched` returns; nothing for a free decay, in whose few swings the evidence decides.
    """
    return TRIFLE * MATERIAL_SHARE * sum(squared_gap(chains, f.final, CHANNELS_OF[b]) for b, f in nominal.items())


def _search_stage(chains: CutChains, stage: str, candidates: list[Hypothesis],
                  acts_on: Mapping[str, tuple[str, ...]], carried: list[Parameter], bases: Mapping[str, Fit],
                  trifle: float, jobs: int, deadline: float | None) -> Findings:
    def base_of(b: str, parameters: Sequence[Parameter]) -> Fit:
        if b in bases and not (b == stage and carried):
            return bases[b]
        return fit(chains.residuals(b), parameters, least_ess=chains.policy.least_ess, deadline=deadline)

    nominal: list[Parameter] = [*nominal_parameters(chains, stage), *carried]
    base = base_of(stage, nominal)
    findings = Findings(stage, base, base)
    if not base.residuals:
        return findings
    values = chains.values_of(base.values, 0)
    candidates = [delay_from_voltage(chains.each[0], h, values) for h in candidates]
    others = {b for h in candidates for b in acts_on[h.family] if b != stage}
    downstream = {b: base_of(b, nominal_parameters(chains, b)) for b in others}
    known, supported, gained = nominal, findings, 0.0
    in_sets = chains.policy.calibrated and chains.known is None
    while len(findings.found) < (1 if in_sets else MOST_EFFECTS):
        here = SelectionRound(chains, stage, acts_on, downstream, known, findings.final, trifle, jobs, deadline)
        if chains.policy.driven and _explained(here):
            break
        if here.budget_spent:
            findings = replace(findings, cut_short=True)
            break
        findings, best = _select(here, findings, candidates)
        if best is None:
            break
        known, gained = adopted(known, best), gained + findings.found[-1][0].gain
        if gained > 0.0:
            supported, gained = findings, 0.0
    if len(findings.found) > len(supported.found):
        rivals = findings.found[len(supported.found)]
        findings = replace(supported, rivals=rivals, cut_short=findings.cut_short)
    # an effect that explains all stands in for no others
    several = in_sets and not passes_as_noise(findings.final, MATERIAL)
    if not passed(deadline):
        if several:
            findings = _with_best_set(chains, findings, nominal, candidates, jobs)
        else:
            findings = _with_best_forms(chains, _with_better_rivals(chains, findings, nominal), nominal, jobs)
    findings = _without_unneeded(chains, findings, nominal, trifle, jobs)
    if findings.found and several and not passed(deadline):
        findings = compared(chains, findings, nominal, candidates, jobs)
    return findings


def _with_best_set(chains: CutChains, findings: Findings, nominal: list[Parameter],
                   candidates: Sequence[Hypothesis], jobs: int) -> Findings:
    """The best set of effects, each in its best form beside the others; another form may lead to another set."""
    for done in range(FORMED_ANEW):
        best = with_best_set(chains, findings, nominal, candidates, jobs, contenders=not done)
        if best is findings:
            break
        findings = _with_best_forms(chains, best, nominal, jobs)
        if findings.final is best.final:
            break
    return findings


def _select(here: SelectionRound, findings: Findings, candidates: list[Hypothesis]
            ) -> tuple[Findings, Hypothesis | None]:
    """One selection round: screen, fit, rank, accept; returns the effect that was accepted, if any."""
    chains, policy = here.chains, here.chains.policy
    open_ = [h for h in candidates if h.family not in {g.family for g in findings.effects}]
    tried, lead = here.screened(open_), None
    if not tried:
        return findings, None
    if policy.budget is not None:
        tried, lead = here.warm_started(tried)
        findings = replace(findings, cut_short=findings.cut_short or here.budget_spent)
    late = passed(here.deadline)
    findings = replace(findings, cut_short=findings.cut_short or late)
    rounds = CUT_SHORT_ROUNDS if findings.cut_short else ROUNDS
    tried = here.converged(tried, rounds, but=lead)
    if not late and not policy.wide_search and not any(passes_as_noise(f, MATERIAL) for _, f in tried):
        tried = here.multi_started(tried)
    # a change keeps the form that is known; an instant is located without a form that could stand in for it
    if (not late and policy.driven and policy.calibrated and chains.known is None
            and chains.recordings[0].window is None):
        tried = here.with_forms(tried)
    if not findings.found:
        tried = here.from_plain(open_, tried)
    ranked = here.ranked(tried)
    # the parameters that the best hypothesis was led to may serve as well without it
    again = fit(chains.residuals(here.stage), started(here.known, ranked[0].fit.values),
                least_ess=chains.policy.least_ess, deadline=here.deadline)
    if again.evidence_over(here.current) > BETTER_ALONE:
        findings = replace(findings, final=again, base=findings.base if findings.found else again)
        here = replace(here, current=again)
        ranked = here.ranked(tried)
    best = ranked[0]
    shows = _material(here.current, best.fit) or beyond_tolerance(chains, here.stage, here.current)
    matters = (best.hypothesis.parameter or at_end_of_prior(chains, here.stage, here.current)
               or (shows and here.closes(best.fit) > here.trifle))
    if not policy.driven and findings.found:  # a residual in a narrow band seems to hold many independent samples
        sure = [float(expit(log_evidence_over(here.current, r.fit) + r.hypothesis.log_odds)) for r in ranked]
        ranked = tuple(replace(r, probability=min(r.probability, p)) for r, p in zip(ranked, sure, strict=True))
    if not matters:
        return replace(findings, rivals=ranked), None
    if sum(r.probability for r in ranked) < EVEN:
        if not policy.calibrated or here.closes(best.fit) < MOSTLY * here.left_open(here.current):
            return replace(findings, rivals=ranked), None
        ranked = here.ranked(tried, none=False)  # what a further effect would explain may speak against this one alone
        best = ranked[0]
    # an effect that acts on later stages was fitted to them too: the final fit is of this stage alone
    final = best.fit if set(best.fit.residuals) == set(findings.base.residuals) else fit(
        chains.residuals(here.stage), started(adopted(here.known, best.hypothesis), best.fit.values))
    return replace(findings, found=(*findings.found, ranked), final=final), best.hypothesis


def _beside(findings: Findings, nominal: list[Parameter], hypothesis: Hypothesis) -> list[Parameter]:
    """The parameters of all effects found but one."""
    return reduce(adopted, [h for h in findings.effects if h is not hypothesis], nominal)


def _with_better_rivals(chains: CutChains, findings: Findings, nominal: list[Parameter]) -> Findings:
    """Replace an effect found early by a close rival that fits better beside the effects found later.

    It is looked again after a replacement: each raises the evidence, so this ends.
    """
    if len(findings.found) < 2:
        return findings
    before = None
    while findings is not before:
        before = findings
        for k in range(len(findings.found)):
            swaps = (_swapped(chains, findings, nominal, k, rival) for rival in _rivals(findings, k))
            findings = next((better for better in swaps if better is not None), findings)
    return findings


def _rivals(findings: Findings, k: int) -> list[RankedHypothesis]:
    """The close rivals of an effect found: those with evidence, but all of an effect that alone had none."""
    selection, taken = findings.found[k], {h.family for h in findings.effects}
    return [r for r in selection[1:CONTENDERS]
            if (r.gain > 0.0 or selection[0].gain <= 0.0) and r.hypothesis.family not in taken]


def _swapped(chains: CutChains, findings: Findings, nominal: list[Parameter], k: int, rival: RankedHypothesis
             ) -> Findings | None:
    """The findings with a rival in place of an effect; None if they are not better."""
    selection, new = findings.found[k], rival.hypothesis
    old = selection[0].hypothesis
    begun = {**findings.final.values, **{p.name: rival.fit.values[p.name] for p in new.own}}
    f = fit(chains.residuals(findings.stage), started(adopted(_beside(findings, nominal, old), new), begun))
    gain = f.evidence_over(findings.final) + new.log_odds - old.log_odds
    if gain <= 0.0 or (len(new.own) > len(old.own) and _alike(chains, findings, f)):
        return None
    sure = float(expit(gain))
    others = [replace(r, probability=1.0 - sure if r is selection[0] else 0.0) for r in selection if r is not rival]
    swapped = (replace(rival, fit=f, gain=rival.gain + gain, probability=sure), *others)
    return replace(findings, found=(*findings.found[:k], swapped, *findings.found[k + 1:]), final=f)


def _with_best_forms(chains: CutChains, findings: Findings, nominal: list[Parameter], jobs: int) -> Findings:
    """Choose the form of each effect again beside the others: alone, it may have stood in for one of them."""
    if len(findings.found) < 2:
        return findings
    for k, (first, *_) in enumerate(findings.found):
        if first.others:
            findings = _in_best_form(chains, findings, k, nominal, jobs)
    return findings


def _in_best_form(chains: CutChains, findings: Findings, k: int, nominal: list[Parameter], jobs: int) -> Findings:
    """The findings with the k-th effect in the form that is best beside the others."""
    first, *rivals = findings.found[k]
    best, *others = _forms_beside(chains, findings, _beside(findings, nominal, first.hypothesis), first, jobs)
    found = (replace(best, others=shared(best, others)), *rivals)
    return replace(findings, found=(*findings.found[:k], found, *findings.found[k + 1:]), final=best.fit)


def _forms_beside(chains: CutChains, findings: Findings, beside: list[Parameter], first: RankedHypothesis,
                  jobs: int) -> list[RankedHypothesis]:
    """The forms of an effect that was found, each fitted beside the other effects; the best first."""
    def fitted(begun: Sequence[tuple[Hypothesis, Mapping[str, float]]]) -> list[tuple[Hypothesis, Fit]]:
        residuals = chains.residuals(findings.stage)
        fits = parallel(jobs, lambda one: fit(residuals, started(adopted(beside, one[0]), one[1])), begun)
        return [(h, f) for (h, _), f in zip(begun, fits, strict=True)]

    now = findings.final.values
    tried = [(first.hypothesis, findings.final)]
    tried += fitted([(r.hypothesis, {**now, **{p.name: r.fit.values[p.name] for p in r.hypothesis.own}})
                     for r in first.others])
    lead, led = max(tried, key=lambda one: one[1].log_likelihood)
    # a form with fewer parameters may serve as well with those of the likeliest
    again = dict(fitted([(h, as_form(lead, h, led.values)) for h, _ in tried
                         if h is not lead and len(h.own) <= len(lead.own)]))
    tried = better(tried, [again.get(h, f) for h, f in tried])
    ess = largest_ess([f for _, f in tried])
    gains = [f.log_evidence(ess) - findings.final.log_evidence(ess) + h.log_odds - first.hypothesis.log_odds
             for h, f in tried]
    gains = frugal(chains, findings.stage, tried, gains)
    ranked = [RankedHypothesis(h, f, first.gain + g, first.probability) for (h, f), g in zip(tried, gains, strict=True)]
    return sorted(ranked, key=lambda r: -r.gain)


def _alike(chains: CutChains, findings: Findings, f: Fit) -> bool:
    """Whether a fit with more parameters neither explains all nor halves the squared gap that is left."""
    return (mean_square(f, findings.stage) >= FORM_SHOWS
            and squared_gap(chains, findings.final) <= ALIKE * squared_gap(chains, f))


def _without_unneeded(chains: CutChains, findings: Findings, nominal: list[Parameter], trifle: float, jobs: int = 1
                      ) -> Findings:
    """Take out effects that are not needed beside the others, and those that close no more than a trifle.

    Two effects may stand in for one of another form: a lag of the thrust and one stage of the angle's filter, say, for
    both stages. So without an effect, the one that may stand in for it has its form chosen again.
    """
    def without(now: Findings, selection: Selection) -> Findings:
        others = _beside(now, nominal, selection[0].hypothesis)
        fewer = now.without(selection, fit(chains.residuals(now.stage), started(others, now.final.values)))
        k = _stand_in(now, selection[0].hypothesis, fewer)
        return fewer if k is None else _in_best_form(chains, fewer, k, nominal, 1)

    def lost(now: Findings, fewer: Findings) -> float:
        closes = (squared_gap(chains, fewer.final, CHANNELS_OF[now.stage])
                  - squared_gap(chains, now.final, CHANNELS_OF[now.stage]))
        if closes <= trifle and not at_end_of_prior(chains, now.stage, fewer.final):
            return closes - UNNEEDED
        return now.final.evidence_over(fewer.final)

    return drop_unneeded(findings, without, lost, 1, jobs)


def _stand_in(now: Findings, h: Hypothesis, fewer: Findings) -> int | None:
    """Number, without an effect, of the one with other forms that may stand in for it; None if none may."""
    size = h.own[0].name

    def shared_variance(k: int) -> float:
        other = fewer.found[k][0].hypothesis.own[0].name
        return 1.0 - (now.final.sd_given(size, [other]) / now.final.sd[size]) ** 2

    formed = [k for k, (first, *_) in enumerate(fewer.found) if first.others and shared_variance(k) > STANDS_IN]
    return max(formed, key=shared_variance, default=None)


def refit(chains: CutChains, stage: str, effects: Sequence[Hypothesis], start: Mapping[str, float],
          base: Fit | None = None) -> Fit:
    """Fit a stage again with given effects.

    Args:
        chains: cut.
        stage: to be fitted.
        effects: of the stage.
        start: values to start from.
        base: the fit without effects, see `fit_again`.
    """
    if base is not None and not effects:
        return base
    parameters = [*nominal_parameters(chains, stage), *(p for h in effects for p in h.own)]
    return fit_again(chains.residuals(stage), parameters, start, base)


def taken_out(chains: CutChains, findings: Findings, selection: Selection) -> Findings:
    """The findings of a stage without one of the effects, the others fitted again."""
    f = findings.without(selection)
    return replace(f, final=refit(chains, f.stage, f.effects, f.final.values, f.base))


def at_end_of_prior(chains: CutChains, stage: str, f: Fit) -> bool:
    """Whether a calibrated parameter of the stage went to the end of its prior, to stand in for a missing effect."""
    own = {p.name: p for p in model_parameters(chains, stage)}
    return chains.policy.calibrated and any(
        not p.low < f.values[n] < p.high for n, p in own.items() if n in f.values)


def beyond_tolerance(chains: CutChains, stage: str, f: Fit) -> bool:
    """Whether a calibrated parameter of the stage left its tolerance: it may stand in for a missing effect."""
    return chains.policy.calibrated and chains.known is None and any(
        abs(f.values[p.name] - p.mean) > TOLERANCE * p.sd for p in model_parameters(chains, stage)
        if p.name in f.values)


def _explained(here: SelectionRound) -> bool:
    """Whether the rest passes as noise.

    The noise of an uncalibrated rig is an estimate: a somewhat larger rest passes too if it follows neither inputs nor
    states.
    """
    if at_end_of_prior(here.chains, here.stage, here.current):
        return False
    if here.left_open(here.current) <= here.trifle:
        return True
    if beyond_tolerance(here.chains, here.stage, here.current):
        return False
    if passes_as_noise(here.current, MATERIAL):
        return True
    policy = here.chains.policy
    if not policy.wide_search or not passes_as_noise(here.current, policy.noise_margin):
        return False
    term = missing_terms(here.chains, here.stage, here.current, here.known)[0]
    return not term.follows


def passes_as_noise(f: Fit, material: float) -> bool:
    """Whether the rest is so small that no effect could explain a material part of it.

    Args:
        f: the fit.
        material: RMS, in units of a reading's noise, that is material; half of its square passes.
    """
    return all(float(np.mean(r * r)) < 1.0 + 0.5 * material**2 for r in f.residuals.values())


def _material(before: Fit, after: Fit) -> bool:
    """Whether an effect explains a material part of some channel."""
    return any(float(np.mean(r * r)) - float(np.mean(after.residuals[k] ** 2)) > MATERIAL**2
               for k, r in before.residuals.items() if len(r))
