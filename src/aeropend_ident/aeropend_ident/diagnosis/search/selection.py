# SPDX-License-Identifier: Apache-2.0
"""One selection round: hypotheses for a stage are screened, fitted, and ranked by their log evidence.

The order, as `search` calls it: `screened` (linear algebra leaves a shortlist, which is fitted for some rounds),
`warm_started` (uncalibrated rigs: the best is fitted to its end, the others start again from its parameters),
`converged` (the contenders are fitted to their end), `multi_started` (from their other start points),
`with_forms` (other forms of the contenders are fitted too), `from_plain` (driven rigs with the angle alone: from the
nominal model without its further terms), `ranked`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.special import softmax

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.priors import absent, nominal_parameters, nominal_sd
from aeropend_ident.diagnosis.chain.values import CHANNELS_OF, neutral
from aeropend_ident.diagnosis.policy import CALIBRATED, MATERIAL_SHARE
from aeropend_ident.diagnosis.search.findings import RankedHypothesis, Selection, adopted
from aeropend_ident.diagnosis.search.free_curves import missing_terms
from aeropend_ident.diagnosis.search.hypotheses import (
    Hypothesis,
    as_form,
    from_linear,
    linear_parameters,
    other_forms,
)
from aeropend_ident.estimation.deadline import passed
from aeropend_ident.estimation.map_fit import Fit, fit, largest_ess
from aeropend_ident.estimation.parallel import parallel
from aeropend_ident.estimation.parameter import Parameter, key, started
from aeropend_ident.estimation.residuals import finite
from aeropend_ident.estimation.screening import screen
from aeropend_ident.estimation.whittle import whittle
from aeropend_ident.signals.signals import CHANNELS
from aeropend_ident.signals.statistics import effective_sample_size
from aeropend_sim.model.effects import DEFINED

SHORTLIST = 8
"""Hypotheses that are fitted after the screening (choice: a third of the catalogue).

Measured: at ±30 % no verdict of 22 recordings changes (docs/results/thresholds.md)."""

ROUNDS = 10
"""Rounds of a fit to its end; most need fewer (choice).

Measured: at ±30 % no verdict of 22 recordings changes (docs/results/thresholds.md)."""

CONTENDERS = 4
"""Hypotheses that are fitted to their end, and compared by their place if none explains all (choice).

Measured: at ±30 % no verdict of 22 recordings changes (docs/results/thresholds.md)."""

CLOSE = 1.5
"""Ratio of mean square residuals within which rivals are close (choice).

Measured: at ±30 % no verdict of 22 recordings changes (docs/results/thresholds.md)."""

CLOSE_GAIN = 10.0
"""Log evidence by which a rival may be behind and still be close (choice: what another form of an effect may cost).

Measured: on simulated rigs whose effects have another form the true one is up to 6 behind. Far more decides, though
free curves may say otherwise: with many small imperfections they explain those."""

FORM_SHOWS = 1.2
"""Mean square residual, in units of a reading's noise, above which an effect's form does not fit (choice).

Measured: ×0.7 changes 1 of 22 verdicts, ×1.3 none (docs/results/thresholds.md)."""

ALIKE = 2.0
"""Ratio of the squared gaps that are left up to which hypotheses are alike (derived: they then differ by less than what
no hypothesis explains)."""

FEWER = 1.1
"""[nats] Log odds of a hypothesis over an alike one with more parameters, at least (choice: 3 to 1)."""

MISPLACED = 2.0
"""Standard deviations of its prior beyond which a parameter is tried as a mismatch in any case.

Convention: 95 %."""

INSIDE = 0.3
"""Part of a parameter's range from which a search starts if only the product with the size is certain (choice).

Measured: at ±30 % no verdict of 9 recordings changes (docs/results/thresholds.md)."""

FittedHypotheses = list[tuple[Hypothesis, Fit]]
"""Hypotheses with their fits so far."""


class _Start(NamedTuple):
    """A fit to be made.

    Attributes:
        hypothesis: that is fitted.
        rounds: of the fit at most; None: of a first look, see `fit`.
        start: number of its start point.
        begun: values to go on from instead; None: the start point.
    """

    hypothesis: Hypothesis
    rounds: int | None
    start: int = 0
    begun: Mapping[str, float] | None = None


@dataclass(frozen=True)
class SelectionRound:
    """A selection round in one stage of the chain.

    Attributes:
        chains: the cut chains.
        stage: that is searched.
        acts_on: name of a hypothesis -> the stages whose residuals it changes.
        downstream: fits of the later stages that some hypothesis changes, without any.
        known: the parameters so far.
        current: their fit.
        trifle: squared gap that need not be closed.
        jobs: processes.
        deadline: [s] of `time.monotonic` after which no further effect is searched; None: the budget decides.
    """

    chains: CutChains
    stage: str
    acts_on: Mapping[str, tuple[str, ...]]
    downstream: Mapping[str, Fit]
    known: list[Parameter]
    current: Fit
    trifle: float
    jobs: int
    deadline: float | None = None

    @property
    def budget_spent(self) -> bool:
        """Whether the search has cost as much time, or as many simulations, as it may."""
        if self.deadline is not None:
            return passed(self.deadline)
        budget = self.chains.policy.budget
        return budget is not None and self.chains.runs > budget

    def screened(self, candidates: list[Hypothesis]) -> FittedHypotheses:
        """The hypotheses that the linear screening leaves, each fitted for some rounds from its best start point."""
        shortlist = self._shortlist(candidates)
        fits = self._fits([_Start(h, None, start, self._better_start(h, start, linear))
                           for h, start, linear in shortlist])
        return [(h, f) for (h, _, _), f in zip(shortlist, fits, strict=True)]

    def _better_start(self, h: Hypothesis, start: int, linear: Mapping[str, float]) -> Mapping[str, float] | None:
        """The values that linear algebra leads to, if a search that starts there starts better; else None."""
        if h.parameter or h.begun or DEFINED[h.effect].linear_in or h.effect in self.chains.model.effects:
            return None
        usual = {**self.current.values, **{p.name: p.begin for p in h.starts[start]}}
        residuals = self.chains.residuals(self.stage)

        def log_likelihood(values: Mapping[str, float]) -> float:
            return sum(whittle(finite(np.asarray(r))) for r in residuals(dict(values)).values())

        return linear if log_likelihood(linear) > log_likelihood(usual) else None

    def _shortlist(self, candidates: list[Hypothesis]) -> list[tuple[Hypothesis, int, dict[str, float]]]:
        """Hypotheses, the number of their best start point, and the values that linear algebra leads to from there."""
        groups = [(h, j) for h in candidates for j in range(len(h.starts))]
        left = screen(self.chains.residuals(self.stage), self.current, self.known,
                      [h.starts[j] for h, j in groups], self.chains.policy.least_ess)
        best: dict[str, tuple[float, Hypothesis, int, dict[str, float]]] = {}
        for (h, j), x in zip(groups, left, strict=True):
            if h.name not in best or x.left < best[h.name][0]:
                best[h.name] = (x.left, h, j, x.values)
        ranked = [(h, j, values) for _, h, j, values in sorted(best.values(), key=lambda item: item[0])]
        # a parameter that is far off already explains nothing more as a mismatch; its wider prior only fits better
        misplaced = [item for item in ranked[SHORTLIST:] if item[0].begun or self._misplaced(item[0])]
        return ranked[:SHORTLIST] + misplaced

    def _misplaced(self, h: Hypothesis) -> bool:
        chains, now = self.chains, self.current.values
        return chains.policy.calibrated and any(
            abs(now[p.name] - neutral(chains.model, p.name)) > MISPLACED * nominal_sd(chains, p.name)
            for p in h.own if p.name in now)

    def warm_started(self, tried: FittedHypotheses) -> tuple[FittedHypotheses, Hypothesis | None]:
        """Fit the best to its end and start the others again from its parameters.

        The uncalibrated parameters that each starts from itself are poor.

        Returns:
            Each hypothesis with the better of its fits, and the one that was fitted to its end.
        """
        gain, lead, begun = self._likeliest(tried)[0]
        if gain + lead.log_odds <= 0.0:
            return tried, None
        best = self._fit(_Start(lead, ROUNDS, begun=begun.values))
        again = iter(self._fits([_Start(h, None, begun=best.values) for h, _ in tried if h is not lead]))
        return better(tried, [best if h is lead else next(again) for h, _ in tried]), lead

    def converged(self, tried: FittedHypotheses, rounds: int = ROUNDS, *, but: Hypothesis | None = None
                  ) -> FittedHypotheses:
        """Fit the contenders to their end.

        Args:
            tried: all hypotheses with their fits.
            rounds: of the fits at most.
            but: a hypothesis that was fitted to its end already.
        """
        likeliest = [(h, f) for _, h, f in self._likeliest(tried)[:CONTENDERS] if h is not but]
        fits = self._fits([_Start(h, rounds, begun=f.values) for h, f in likeliest])
        ended = {h.name: f for (h, _), f in zip(likeliest, fits, strict=True)}
        return [(h, ended.get(h.name, f)) for h, f in tried]

    def multi_started(self, tried: FittedHypotheses) -> FittedHypotheses:
        """Fit the contenders from their other start points too: a search may have ended in a local minimum."""
        starts = [_Start(h, None, start) for _, h, _ in self._likeliest(tried)[:CONTENDERS]
                  if len(h.starts) > 1 and not DEFINED[h.effect].linear_in for start in range(len(h.starts))]
        best = _likeliest_of_each(zip([s.hypothesis for s in starts], self._fits(starts), strict=True))
        ended = self._fits([_Start(h, ROUNDS, begun=f.values) for h, f in best])
        again = {h.name: f for (h, _), f in zip(best, ended, strict=True)}
        return better(tried, [again.get(h.name, f) for h, f in tried])

    def with_forms(self, tried: FittedHypotheses) -> FittedHypotheses:
        """The hypotheses, and other forms of the contenders; if one explains all, of those that close as much."""
        likeliest = self._likeliest(tried)[:CONTENDERS]
        if mean_square(likeliest[0][2], self.stage) < FORM_SHOWS:
            most = self._close_most([(h, f) for _, h, f in likeliest])
            likeliest = [one for one, closes in zip(likeliest, most, strict=True) if closes]
        forms = [(form, _Start(replace(form, starts=(start,)), ROUNDS, begun=as_form(h, form, f.values)))
                 for _, h, f in likeliest for form in other_forms(h, self.chains) for start in form.starts]
        done = _likeliest_of_each(zip([form for form, _ in forms], self._fits([s for _, s in forms]), strict=True))
        starts = []
        for _, h, f in likeliest:  # the effect itself may serve as well with the parameters of its likeliest form
            own = [(form, g) for form, g in done if form.family == h.family]
            form, best = max([(h, f), *own], key=lambda one: one[1].log_likelihood)
            if form is not h:
                starts.append(_Start(h, ROUNDS, begun=as_form(form, h, best.values)))
        again = {s.hypothesis.name: f for s, f in zip(starts, self._fits(starts), strict=True)}
        tried = [*tried, *done]
        return better(tried, [again.get(h.name, f) for h, f in tried])

    def from_plain(self, candidates: list[Hypothesis], tried: FittedHypotheses) -> FittedHypotheses:
        """Fit from the nominal model without its further terms, if nothing tried explains all.

        Of a rig with angle and command alone such terms may stand in for an effect; no step leads back from there.
        """
        plain, chains = self.chains.plain, self.chains
        if plain is None or passed(self.deadline) or any(mean_square(f, self.stage) < FORM_SHOWS for _, f in tried):
            return tried
        there = type(chains)(plain, chains.recordings, chains.policy)
        known = nominal_parameters(there, self.stage)
        base = fit(there.residuals(self.stage), known, least_ess=chains.policy.least_ess, deadline=self.deadline)
        here = replace(self, chains=there, known=known, current=base)
        lead, best = min(here.converged(here.screened(candidates)), key=lambda item: item[1].mean_square)
        if best.mean_square > min(f.mean_square for _, f in tried):
            return tried
        ended = self._fit(_Start(lead, ROUNDS, begun={**absent(self.known), **best.values}))
        return [(h, f) for h, f in tried if h.name != lead.name] + better(
            [(lead, ended)], [f for h, f in tried if h.name == lead.name] or [ended])

    def ranked(self, tried: FittedHypotheses, *, none: bool = True) -> Selection:
        """Log evidence of each over no further effect, and probabilities; the best first.

        Args:
            tried: all hypotheses with their fits.
            none: whether no further effect is a hypothesis too.
        """
        gains = [x + h.log_odds for (h, _), x in zip(tried, self._gains(tried, Fit.log_evidence), strict=True)]
        first = self._close_most(tried)
        by_evidence, gains = gains, frugal(self.chains, self.stage, tried, gains)
        behind = {h.name for (h, _), g, now, closes in zip(tried, by_evidence, gains, first, strict=True)
                  if now < g or not closes}
        probability = softmax(np.where([*first, none], [*gains, 0.0], -np.inf))
        ranked = [RankedHypothesis(h, f, g, float(p)) for (h, f), g, p in zip(tried, gains, probability, strict=False)]
        order = sorted(range(len(tried)), key=lambda j: (not first[j], -gains[j]))
        return tuple(self._ranked_by_place(by_family([ranked[j] for j in order]), behind))

    def _close_most(self, tried: FittedHypotheses) -> list[bool]:
        """Whether no other hypothesis leaves a materially smaller gap in this stage: evidence decides only among these.

        With many samples the evidence goes by details that are significant but small.
        """
        left = [self.left_open(f) for _, f in tried]
        most = min(left, default=0.0) + MATERIAL_SHARE * self.left_open(self.current)
        return [x <= most for x in left]

    def left_open(self, f: Fit) -> float:
        """What a fit leaves of the squared gap in this stage."""
        return squared_gap(self.chains, f, CHANNELS_OF[self.stage])

    def closes(self, f: Fit) -> float:
        """What a fit closes of the squared gap that is left, in this stage."""
        return self.left_open(self.current) - self.left_open(f)

    def _likeliest(self, tried: FittedHypotheses) -> list[tuple[float, Hypothesis, Fit]]:
        """Those that close most first, each group ordered by likelihood.

        It predicts the final rank better than the evidence while fits are not at their end.
        """
        gains = self._gains(tried, lambda f, _: f.log_likelihood)
        first = self._close_most(tried)
        order = sorted(range(len(tried)), key=lambda j: (not first[j], -gains[j]))
        return [(gains[j], *tried[j]) for j in order]

    def _gains(self, tried: FittedHypotheses, of: Callable[[Fit, Mapping[str, float]], float]) -> list[float]:
        """How much more log evidence or likelihood each fit has than no further effect."""
        ess = largest_ess([self.current, *self.downstream.values(), *(f for _, f in tried)])
        later = {b: of(f, ess) for b, f in self.downstream.items()}
        return [of(f, ess) - of(self.current, ess)
                - sum(later[b] for b in self.acts_on[h.family] if b != self.stage) for h, f in tried]

    def _ranked_by_place(self, ranked: list[RankedHypothesis], behind: Collection[str]) -> list[RankedHypothesis]:
        """Decide between close rivals at different places if none of them explains the whole misfit.

        The true effect then has another form than the catalogue's. Each rival is given free curves at its own place.
        The right one needs them for its form only. A wrong one cannot correct, from its place, an error that arises
        elsewhere. The likelihoods with free curves divide the total probability of the close rivals among the places;
        the evidence divides it among those at one place. If free curves explain the whole misfit with none of them,
        more than a form is missing, and the evidence decides.

        Args:
            ranked: the best first.
            behind: names of those that are no rivals: they close less, or an alike one has fewer parameters.
        """
        best = mean_square(ranked[0].fit, self.stage)
        close = [r for r in ranked[:CONTENDERS] if r.gain > max(ranked[0].gain - CLOSE_GAIN, 0.0)
                 and r.hypothesis.name not in behind and mean_square(r.fit, self.stage) < CLOSE * best]
        if best < FORM_SHOWS or len({r.hypothesis.place for r in close}) < 2:
            return ranked
        left: list[tuple[float, float]] = []
        for r in close:
            own = [t for t in missing_terms(self.chains, self.stage, r.fit, adopted(self.known, r.hypothesis))
                   if t.place == r.hypothesis.place]
            left += [(t.left, t.ess) for t in own] or [(mean_square(r.fit, self.stage), 1.0)]
        if min(x for x, _ in left) > FORM_SHOWS:  # more than a form is missing: what curves add may be another effect
            return ranked
        count = max(n for _, n in left)
        places: dict[str, float] = {}
        for r, (x, _) in zip(close, left, strict=True):
            evidence = -0.5 * count * math.log(max(x, 1.0))
            places[r.hypothesis.place] = max(places.get(r.hypothesis.place, -np.inf), evidence)
        of_place = dict(zip(places, softmax([*places.values()]), strict=True))
        total, again = sum(r.probability for r in close), []
        for place in sorted(places, key=lambda place: -places[place]):
            mine = [r for r in close if r.hypothesis.place == place]
            shares = total * of_place[place] * softmax([r.gain for r in mine])
            again += [replace(r, probability=float(p)) for r, p in zip(mine, shares, strict=True)]
        rest = [r for r in ranked if all(r is not c for c in close)]
        return [*again, *rest]

    def _fits(self, starts: Sequence[_Start]) -> list[Fit]:
        return parallel(self.jobs, self._fit, starts)

    def _fit(self, one: _Start) -> Fit:
        """Fit a hypothesis on top of what is known, on every stage that it changes."""
        hypothesis, rounds, start, begun = one
        functions = [self.chains.residuals(self.stage)]
        known = started(self.known, self.current.values)
        for other in self.acts_on[hypothesis.family]:
            if other != self.stage:
                functions.append(self.chains.residuals(other))
                known += started(nominal_parameters(self.chains, other), self.downstream[other].values)

        def residuals(values: dict[str, float]) -> dict[str, np.ndarray]:
            return {k: r for function in functions for k, r in function(values).items()}

        policy = self.chains.policy
        fit_from = partial(fit, residuals, rounds=rounds or policy.screening_rounds, steps=policy.steps,
                           least_ess=policy.least_ess, deadline=self.deadline, first_look=rounds is None)
        fitted = hypothesis.parameter or hypothesis.effect in self.chains.model.effects
        if fitted and begun is None:  # it is fitted already: only its prior becomes wider
            begun = self.current.values
        if begun is None and hypothesis.begun:
            begun = {**self.current.values, **dict(hypothesis.begun)}
        if begun is None and DEFINED[hypothesis.effect].linear_in:
            first = fit(lambda values: residuals(from_linear(hypothesis.effect, values)),
                        [*known, *linear_parameters(hypothesis.effect)], rounds=3, least_ess=policy.least_ess,
                        deadline=self.deadline, first_look=True)
            begun = self._within_range(hypothesis.effect, from_linear(hypothesis.effect, first.values))
        if begun is not None:
            return fit_from(started(adopted(known, hypothesis), begun))
        return fit_from(adopted(known, hypothesis, start))

    def _within_range(self, effect: str, own: dict[str, float]) -> dict[str, float]:
        """Values from a linear fit, with the second parameter within its range and the same product.

        For an uncalibrated rig only the product may be certain: a search that starts at a bound would stay there.
        """
        size, second = (f"{effect}.{name}" for name in list(DEFINED[effect].parameters)[:2])
        bounds = DEFINED[effect].parameters[key(second).name]
        inside = not self.chains.policy.calibrated and DEFINED[effect].linear_in == "product"
        reach = INSIDE if inside else 1.0
        own[size] *= max(1.0, own[second] / (reach * bounds.high), own[second] / (reach * bounds.low))
        if inside:
            own[second] = min(max(own[second], reach * bounds.low), reach * bounds.high)
        return own


def frugal(chains: CutChains, stage: str, tried: FittedHypotheses, gains: list[float]) -> list[float]:
    """The gains, where of alike hypotheses that with fewer parameters is the likelier one.

    If no hypothesis explains all, other imperfections are left. A further parameter then describes some of them: it has
    much more evidence, but closes hardly more of the gap.
    """
    left = [squared_gap(chains, f, CHANNELS_OF[stage]) for _, f in tried]
    if min((mean_square(f, stage) for _, f in tried), default=0.0) < FORM_SHOWS:
        return gains
    alike = [j for j, x in enumerate(left) if x <= ALIKE * min(left)]
    simpler = {j: [gains[i] - FEWER for i in alike if len(tried[i][0].own) < len(tried[j][0].own)] for j in alike}
    return [min(g, *simpler[j]) if simpler.get(j) else g for j, g in enumerate(gains)]


def by_family(ranked: list[RankedHypothesis]) -> list[RankedHypothesis]:
    """Of each effect the best of its forms, with the probability of all of them and how it is shared among them.

    Args:
        ranked: the best first.
    """
    forms: dict[str, list[RankedHypothesis]] = {}
    for r in ranked:
        forms.setdefault(r.hypothesis.family, []).append(r)
    found = []
    for first, *others in forms.values():
        if not others:
            found.append(first)
            continue
        total = sum(r.probability for r in (first, *others))
        found.append(replace(first, probability=total, others=shared(first, others)))
    return found


def shared(first: RankedHypothesis, others: Sequence[RankedHypothesis]) -> tuple[RankedHypothesis, ...]:
    """The other forms of an effect, each with its probability among all of them, the first included.

    One with more log evidence that closes less of the gap counts as much as the first at most.
    """
    weights = np.exp([min(r.gain - first.gain, 0.0) for r in (first, *others)])
    return tuple(replace(r, probability=float(p)) for r, p in zip(others, weights[1:] / weights.sum(), strict=True))


def plausible(ranked: RankedHypothesis, stage: str) -> list[RankedHypothesis]:
    """The other forms of an effect that explain a recording: by probability, or, if none fits, as much as the best."""
    if mean_square(ranked.fit, stage) < FORM_SHOWS:
        return [r for r in ranked.others if r.probability > CALIBRATED.undecided]
    return [r for r in ranked.others if mean_square(r.fit, stage) <= ALIKE * mean_square(ranked.fit, stage)]


def better(tried: FittedHypotheses, again: list[Fit]) -> FittedHypotheses:
    """Each hypothesis with the better of its two fits, by evidence."""
    ess = largest_ess([*again, *(f for _, f in tried)])
    return [(h, max(f, g, key=lambda x: x.log_evidence(ess))) for (h, f), g in zip(tried, again, strict=True)]


def _likeliest_of_each(fits: Iterable[tuple[Hypothesis, Fit]]) -> FittedHypotheses:
    """Each hypothesis with the likeliest of its fits."""
    best: dict[str, tuple[Hypothesis, Fit]] = {}
    for h, f in fits:
        if h.name not in best or f.log_likelihood > best[h.name][1].log_likelihood:
            best[h.name] = h, f
    return [*best.values()]


def squared_gap(chains: CutChains, f: Fit, channels: Collection[str] = tuple(CHANNELS)) -> float:
    """What a fit leaves of some channels above the noise of the readings, in units of their squared spread."""
    return sum(max(float(np.mean(r * r)) - 1.0, 0.0) * noise_over_spread(chains, channel) ** 2
               for channel, r in f.residuals.items() if len(r) and key(channel).name in channels)


def noise_over_spread(chains: CutChains, channel: str) -> float:
    """Noise of a reading of a channel, in units of the channel's standard deviation."""
    k = key(channel)
    s = chains.each[k.recording].signals
    noise = s.sigma[k.name]
    if k.name == "omega" and s.pulses:
        noise = float(np.sqrt(np.mean(s.pulses.sigma[s.pulses.index < s.train] ** 2)))
    return noise / max(float(np.nanstd(s.channel(k.name)[:s.train])), noise)


def mean_square(f: Fit, stage: str) -> float:
    """Mean square residual of a fit in the channels of a stage, in units of a reading's noise."""
    own = [r for k, r in f.residuals.items() if key(k).name in CHANNELS_OF[stage]]
    return float(np.mean(np.concatenate(own) ** 2)) if own else 0.0


def log_evidence_over(f: Fit, other: Fit) -> float:
    """Log evidence of `other` over `f`, with the effective sample size of these two fits alone.

    A third fit with a larger residual must not count here. The sample size is that of the mean square, since in a
    narrow band autocorrelations of either sign cancel and the usual one is too large.
    """
    ess: dict[str, float] = {}
    for each in (f, other):
        for channel, r in each.residuals.items():
            own = min(each.ess[channel], effective_sample_size(r, power=2))
            ess[channel] = max(ess.get(channel, 0.0), own)
    return other.log_evidence(ess) - f.log_evidence(ess)
