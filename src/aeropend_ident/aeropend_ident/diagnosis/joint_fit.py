# SPDX-License-Identifier: Apache-2.0
"""The joint fit: all effects found and all parameters together, on the whole chain from the duty to all channels."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import CutChain, CutChains, difference
from aeropend_ident.diagnosis.chain.free_run import StagedRun
from aeropend_ident.diagnosis.chain.priors import TOLERANCE, nominal_parameters, nominal_sd
from aeropend_ident.diagnosis.chain.values import neutral
from aeropend_ident.diagnosis.policy import CERTAIN
from aeropend_ident.diagnosis.search.findings import Findings, Selection
from aeropend_ident.diagnosis.search.free_curves import missing_terms
from aeropend_ident.diagnosis.search.hypotheses import Hypothesis
from aeropend_ident.diagnosis.search.search import taken_out
from aeropend_ident.diagnosis.search.selection import noise_over_spread
from aeropend_ident.estimation.bounded_fit import sensitivities, within_bounds
from aeropend_ident.estimation.map_fit import Fit, fit, fit_again
from aeropend_ident.estimation.parallel import parallel
from aeropend_ident.estimation.parameter import Parameter, key, started
from aeropend_ident.estimation.residuals import Sensitivities
from aeropend_ident.signals.statistics import Z95, rms
from aeropend_sim.model.parameters import Model

Array = NDArray[np.float64]

SURE = 2.5
"""Standard deviations by which an effect must differ from none, and a parameter from nominal, after the joint fit.

Choice: 98.8 % each, since some effects are tested in each recording.

Measured: at ±30 % no verdict of 25 recordings changes (docs/results/thresholds.md)."""

WIDER = 1.2
"""Factor on the standard deviations of a fit, since its inputs are measured too and quantisation is not white.

Measured: rigs simulated for the purpose (seeds 11 to 13 of `make blind`); intervals are judged on others."""


AGAIN_STEPS = 8
"""Steps of a fit without some of the effects, with the derivatives of the joint fit (choice: only its gap counts)."""

OTHER_SIZES = (0.6, 0.8, 1.25, 1.6)
"""Factors on the size of an effect from which a recording alone is fitted too (choice: swings have local minima)."""


@dataclass(frozen=True)
class Check:
    """Tests of what the final fit of a stage leaves.

    Attributes:
        rms: channel -> RMS in units of a reading's noise.
        white: channel -> effective sample size over the number of readings.
        dependence: share of the mean square that free curves over inputs and states explain, beyond chance.
        form: RMS that they explain relative to what was explained: the relative error of a size from a wrong form.
    """

    rms: dict[str, float]
    white: dict[str, float]
    dependence: float
    form: float


class Estimate(NamedTuple):
    """An estimate and its standard deviation."""

    value: float
    sd: float


@dataclass(frozen=True)
class JointFit:
    """The joint fit of everything found.

    Attributes:
        chains: that were fitted.
        findings: stage -> what is still claimed after it.
        fit: of everything.
        values: name -> estimate.
        sd: name -> standard deviation, with the uncertainty from the form of an effect.
        sd_given_form: name -> the same without that uncertainty: as if each effect had its true form.
        checks: stage -> tests of what is left of it.
        alone: name -> estimate and standard deviation of each of several calibrated recordings, fitted alone.
    """

    chains: CutChains
    findings: dict[str, Findings]
    fit: Fit
    values: dict[str, float]
    sd: dict[str, float]
    sd_given_form: dict[str, float]
    checks: dict[str, Check]
    alone: dict[str, tuple[Estimate, ...]] = field(default_factory=dict)
    _fitted_without: dict[tuple[frozenset[str], bool], dict[str, float]] = field(default_factory=dict, repr=False)

    @property
    def parameters(self) -> dict[str, Parameter]:
        """All parameters by name: of the nominal model, and of the effects found."""
        return _parameters(self.chains, self.findings)

    @property
    def values_of_rig(self) -> dict[str, float]:
        """The values without the numbers of a calibrated rig's variants, which are a recording's own."""
        own = not self.chains.policy.calibrated
        return {n: v for n, v in self.values.items() if own or key(n).is_initial or not key(n).recording}

    def without(self, effects: Collection[Hypothesis], *, others: bool = False) -> dict[str, float]:
        """The values that leave the smallest gap without some of the effects.

        Calibrated parameters stay within their tolerances. What comes back is what no parameter of the model could take
        over. The values are fitted once.

        Args:
            effects: that are taken out.
            others: whether the other effects are fitted again too; else they stay at their sizes.
        """
        self.fit_without([(effects, others)])
        return self._fitted_without[self._named(effects, others)]

    def fit_without(self, wanted: Sequence[tuple[Collection[Hypothesis], bool]], jobs: int = 1) -> None:
        """Make the fits of several calls of `without`.

        Args:
            wanted: the arguments `effects` and `others` of each.
            jobs: processes.
        """
        asked = {self._named(effects, others): effects for effects, others in wanted}
        new = [(what, effects) for what, effects in asked.items() if what not in self._fitted_without]
        _ = self._slopes  # once, for all processes
        fits = parallel(jobs, lambda one: self._fit_without(one[1], others=one[0][1]), new)
        self._fitted_without.update(zip([what for what, _ in new], fits, strict=True))

    def _named(self, effects: Collection[Hypothesis], others: bool) -> tuple[frozenset[str], bool]:
        some_stay = not self._of_effects <= {p.name for h in effects for p in h.own}
        return frozenset(h.name for h in effects), others and some_stay  # without others both are the same fit

    def _fit_without(self, effects: Collection[Hypothesis], *, others: bool) -> dict[str, float]:
        gone = {p.name for h in effects for p in h.own}
        fixed = gone if others else self._of_effects
        held = {n: self.values[n] for n in fixed if n not in gone}
        free = [j for j, p in enumerate(self._bounded) if p.name not in fixed
                or (p.name in gone and p.name in self._nominal)]
        parameters = [self._back(p) if p.name in gone else p for p in (self._bounded[j] for j in free)]
        slopes = {channel: s.of(free) for channel, s in self._slopes.items()}
        return held | within_bounds(lambda values: self._of_spread(held | values), started(parameters, self.values),
                                    slopes, AGAIN_STEPS)

    @cached_property
    def _of_effects(self) -> set[str]:
        """The names of the parameters that effects have."""
        return {p.name for f in self.findings.values() for h in f.effects for p in h.own}

    @cached_property
    def _nominal(self) -> dict[str, Parameter]:
        """The parameters of the nominal model by name."""
        return {p.name: p for stage in self.findings for p in nominal_parameters(self.chains, stage)}

    def _back(self, p: Parameter) -> Parameter:
        """A parameter that was far off, with the range that it has like any other; its unit stays."""
        own = self._within_tolerance(self._nominal[p.name])
        return replace(p, low=own.low, high=own.high)

    @cached_property
    def _bounded(self) -> list[Parameter]:
        """All parameters, each within its range; calibrated ones within their tolerances, or up to the estimate."""
        return [p if n in self._of_effects else self._within_tolerance(p, self.values[n])
                for n, p in self.parameters.items()]

    @cached_property
    def _slopes(self) -> dict[str, Sensitivities]:
        """The derivatives of `_of_spread` at the joint fit."""
        return sensitivities(self._of_spread, started(self._bounded, self.values))

    def _of_spread(self, values: dict[str, float]) -> dict[str, Array]:
        """Residuals in units of the channel's spread, each channel as if it had as many readings as the longest."""
        found = {k: np.asarray(r) for k, r in self._free_run(values).items() if k in self._noise}
        longest = max((len(r) for r in found.values()), default=0)
        return {k: math.sqrt(longest / len(r)) * self._noise[k] * r for k, r in found.items()}

    @cached_property
    def _noise(self) -> dict[str, float]:
        """Channel -> noise of a reading in units of the channel's spread, of those that were fitted."""
        return {k: noise_over_spread(self.chains, k) for k, r in self.fit.residuals.items() if len(r)}

    @cached_property
    def _free_run(self) -> Callable[[dict[str, float]], dict[str, Array]]:
        return self.chains.joined(_free_run_residuals)

    def _within_tolerance(self, p: Parameter, *also: float) -> Parameter:
        """A calibrated parameter with its tolerance, and what it is also to hold, as its range."""
        chains = self.chains
        if p.name not in chains.model.model or not chains.policy.calibrated or chains.known is not None:
            return p
        ends = (p.mean - TOLERANCE * p.sd, p.mean + TOLERANCE * p.sd, *also)
        return replace(p, low=max(p.low, min(ends)), high=min(p.high, max(ends)))

    def unsure(self, effect: Hypothesis, form: float) -> float:
        """Relative standard deviation of the size of an effect that was found; see `size_sd`.

        Args:
            effect: that was found.
            form: part of the error from another form that counts.
        """
        size = effect.own[0].name
        distance = abs(self.values[size] - neutral(self.chains.model, size))
        of_form = math.sqrt(max(self.sd[size] ** 2 - self.sd_given_form[size] ** 2, 0.0))
        return math.hypot(size_sd(effect, self.fit, self.sd_given_form), form * of_form) / max(distance, 1e-300)

    def expected_without(self, effects: Collection[Hypothesis]) -> dict[str, float]:
        """The values without some of the effects if the readings were linear in all of them."""
        every = self.parameters
        names = list(self.fit.values)
        z = np.array([every[n].to_standard(self.values[n]) for n in names])
        gone = [names.index(h.own[0].name) for h in effects]
        own = {p.name for h in effects for p in h.own}
        kept = [j for j, n in enumerate(names) if n not in own]
        information = self.fit.information(self.fit.ess)
        moved = [every[names[j]].to_standard(neutral(self.chains.model, names[j])) - z[j] for j in gone]
        z[kept] -= np.linalg.solve(information[np.ix_(kept, kept)], information[np.ix_(kept, gone)] @ moved)
        z[gone] += moved
        return {n: min(max(every[n].value(x), every[n].low), every[n].high) for n, x in zip(names, z, strict=True)}


def size_sd(effect: Hypothesis, joint: Fit, sd: Mapping[str, float]) -> float:
    """Standard deviation of the size of an effect, with its other parameters held.

    It says how surely the effect is there. Without its size it is absent, whatever its other parameters are: that a
    phase or a width trades with the size widens the interval of the size alone.

    Args:
        effect: that was fitted.
        joint: the joint fit.
        sd: name -> standard deviation, wider than that of the fit.
    """
    size, *others = (p.name for p in effect.own)
    traded = WIDER**2 * (joint.sd[size] ** 2 - joint.sd_given(size, others) ** 2)
    return math.sqrt(max(sd[size] ** 2 - traded, 0.0))


def run_to_run(estimates: Sequence[Estimate]) -> float:
    """Standard deviation between recordings, beyond the uncertainty of the estimates.

    Random effects, by moments (R. DerSimonian, N. Laird: Meta-analysis in clinical trials. 1986).

    Args:
        estimates: one a recording.
    """
    x, variance = np.array([e.value for e in estimates]), np.square([e.sd for e in estimates])
    w = 1.0 / variance
    scatter = float(np.sum(w * (x - np.average(x, weights=w)) ** 2))
    between = (scatter - (len(x) - 1)) / float(np.sum(w) - np.sum(w**2) / np.sum(w))
    return math.sqrt(max(between, 0.0))


def pooled_sd(estimates: Sequence[Estimate]) -> float:
    """Standard deviation of the mean over recordings, with the scatter from recording to recording.

    Args:
        estimates: one a recording.
    """
    between = run_to_run(estimates)
    return 1.0 / math.sqrt(sum(1.0 / (e.sd**2 + between**2) for e in estimates))


def fit_jointly(chains: CutChains, findings: Mapping[str, Findings], *, gust: bool) -> JointFit:
    """Fit all together until each effect that is left is certain enough to be claimed.

    Args:
        chains: cut.
        findings: stage -> what was found.
        gust: whether `gust` was detected: the rest of the angle then says nothing of the form of an effect.
    """
    found = dict(findings)
    joint, values, sd, alone = _fitted(chains, found)
    while weak := _least_certain(chains, found, joint, sd):
        stage, selection = weak
        found[stage] = found[stage].without(selection)
        joint, values, sd, alone = _fitted(chains, found)
    checks = _checks(chains, found)

    def widened() -> dict[str, float]:
        formed = {b: c for b, c in checks.items() if b != "arm" or not gust}
        return _widened(chains, found, values, sd, formed)

    while not chains.policy.calibrated and (weak := _least_needed(chains.model, found, values, widened())):
        stage, selection = weak
        found[stage] = taken_out(chains, found[stage], selection)
        joint, values, sd, alone = _fitted(chains, found)
        checks = _checks(chains, found)
    return JointFit(chains, found, joint, values, widened(), sd, checks, alone)


def _fitted(chains: CutChains, findings: Mapping[str, Findings]
            ) -> tuple[Fit, dict[str, float], dict[str, float], dict[str, tuple[Estimate, ...]]]:
    """The fit of everything on the whole chain: estimates, standard deviations, and what each recording alone gives."""
    start: dict[str, float] = {}
    for f in findings.values():
        start.update(f.final.values)
    base = findings["arm"].base if chains.policy.wide_search else None
    joint = fit_again(chains.joined(_free_run_residuals), list(_parameters(chains, findings).values()), start, base)
    alone = _of_each_alone(chains, findings, joint)
    sd = {name: WIDER * s for name, s in joint.sd.items()}
    sd |= {name: max(sd[name], pooled_sd(estimates)) for name, estimates in alone.items()}
    return joint, joint.values, sd, alone


def _of_each_alone(chains: CutChains, findings: Mapping[str, Findings], joint: Fit) -> dict[str, tuple[Estimate, ...]]:
    """The estimates of values that several recordings share, with each recording fitted alone."""
    if len(chains.each) < 2:
        return {}
    alone = []
    for k in range(len(chains.each)):
        one, start = chains.only(k), chains.estimates_of(joint.values, k)
        residuals = one.joined(_free_run_residuals)
        sizes = [h.own[0].name for f in findings.values() for h in f.effects]
        starts = [start, *({**start, n: factor * start[n]} for n in sizes for factor in OTHER_SIZES)]
        fits = [fit(residuals, started(_parameters(one, findings).values(), s)) for s in starts]
        alone.append(max(fits, key=lambda f: f.log_likelihood + f.log_prior))
    own = {key(name).plain for name in joint.sd if key(name).recording}
    return {name: tuple(Estimate(f.values[name], WIDER * f.sd[name]) for f in alone) for name in joint.sd
            if not key(name).is_initial and key(name).plain not in own and all(name in f.values for f in alone)}


def _parameters(chains: CutChains, findings: Mapping[str, Findings]) -> dict[str, Parameter]:
    parameters: dict[str, Parameter] = {}
    for stage, f in findings.items():
        parameters.update({p.name: p for p in nominal_parameters(chains, stage)})
        parameters.update({p.name: p for h in f.effects for p in h.own})
    return parameters


def _free_run_residuals(chain: CutChain) -> Callable[[Mapping[str, float]], dict[str, Array]]:
    """Residuals of all channels of a recording in a free run over its training part, in units of their noise."""
    s = chain.signals.head(chain.signals.train)
    run = StagedRun(chain.model, s)

    def residuals(values: Mapping[str, float]) -> dict[str, Array]:
        readings = run.readings(values)
        out: dict[str, Array] = {}
        for channel in ("theta", "i_a", "v_a"):
            part = slice(s.after_unseen if channel == "v_a" else 0, None)
            out[channel] = difference(s.channel(channel)[part], readings[channel][part]) / s.sigma[channel]
        p = s.pulses
        if p is not None:
            use = p.index[~p.false]
            out["omega"] = (s.omega[use] - readings["omega"][use]) / p.sigma[~p.false]
        elif s.has("omega"):
            out["omega"] = difference(s.true_speed, readings["omega"]) / s.sigma["omega"]
        return out

    return residuals


def _checks(chains: CutChains, findings: Mapping[str, Findings]) -> dict[str, Check]:
    """Test the residuals of each stage for whiteness, and for dependence on inputs and states."""
    checks = {}
    for stage, f in findings.items():
        if not f.final.residuals:
            continue
        own = {p.name for h in f.effects for p in h.own}
        known = [p for p in nominal_parameters(chains, stage) if p.name in f.final.values and p.name not in own]
        best = missing_terms(chains, stage, f.final, known)[0]
        left = best.explained
        form = math.sqrt(left / max(f.base.mean_square - best.left, left, 1e-12))
        white = {c: f.final.ess[c] / len(r) for c, r in f.final.residuals.items()}
        checks[stage] = Check({c: rms(r) for c, r in f.final.residuals.items()}, white,
                              left / best.before if best.before > 0.0 else 0.0, form)
    return checks


def _widened(chains: CutChains, findings: Mapping[str, Findings], values: Mapping[str, float],
             sd: Mapping[str, float], checks: Mapping[str, Check]) -> dict[str, float]:
    """Standard deviations with the uncertainty from the form of an effect.

    A true effect of another form leaves a rest that free curves still explain. The error of the effect's parameters is
    taken as of the same relative size as that rest.
    """
    wider = dict(sd)
    for stage, check in checks.items():
        for name in {p.name for h in findings[stage].effects for p in h.own}:
            wider[name] = math.hypot(sd[name], check.form * (values[name] - neutral(chains.model, name)))
    return wider


def _least_certain(chains: CutChains, findings: Mapping[str, Findings], joint: Fit, sd: Mapping[str, float]
                   ) -> tuple[str, Selection] | None:
    """The finding whose size is least certain, if that is too uncertain to be claimed."""
    model, values, certain = chains.model, joint.values, []
    for stage, f in findings.items():
        for selection in f.found:
            size = selection[0].hypothesis.own[0].name
            contradicted = sd[size] > WIDER * joint.sd[size]  # recordings differ by more than their uncertainty
            off = selection[0].hypothesis.parameter and chains.known is None
            if selection[0].gain > CERTAIN and not off and not contradicted:
                continue  # its existence is certain; only its size and those of other values cannot be separated
            spread = max(size_sd(selection[0].hypothesis, joint, sd), nominal_sd(chains, size))
            certain.append((abs(values[size] - neutral(model, size)) / spread, stage, selection))
    worst = min(certain, key=lambda c: c[0], default=None)
    return worst[1:] if worst is not None and worst[0] < SURE else None


def _least_needed(model: Model, findings: Mapping[str, Findings], values: Mapping[str, float],
                  sd: Mapping[str, float]) -> tuple[str, Selection] | None:
    """The finding besides the main one whose size is consistent with zero, given the uncertainty from forms."""
    found = [(stage, selection) for stage, f in findings.items() for selection in f.found]
    main = max((selection[0].gain for _, selection in found), default=0.0)
    certain = []
    for stage, selection in found:
        size = selection[0].hypothesis.own[0].name
        if selection[0].gain < main:
            certain.append((abs(values[size] - neutral(model, size)) / max(sd[size], 1e-300), stage, selection))
    least = min(certain, key=lambda c: c[0], default=None)
    return least[1:] if least is not None and least[0] < Z95 else None
