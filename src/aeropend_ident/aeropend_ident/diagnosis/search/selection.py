# SPDX-License-Identifier: Apache-2.0
"""One look for a further effect in a part of the chain: hypotheses are screened, fitted and weighed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from aeropend_ident.diagnosis.chain import nominal_fit
from aeropend_ident.diagnosis.chain.chain import Chains, of_recording
from aeropend_ident.diagnosis.chain.priors import NUMBER_SD, angle_only, free_swinging, nominal_unknowns
from aeropend_ident.diagnosis.search.free_curves import shapes
from aeropend_ident.diagnosis.search.hypotheses import Hypothesis, from_linear, linear_unknowns, log_odds
from aeropend_ident.estimation.map_fit import Fit, Unknown, fit, independent_samples, screen
from aeropend_sim.model.effects import CATALOGUE

SHORTLIST = 8
"""How many hypotheses are fitted in full after the screening."""

FIRST_LOOK, ROUNDS = 2, 10
"""Rounds of a fit for all of the shortlist, and for the likeliest of them."""

FIRST_LOOK_UNKNOWN = 1
"""As `FIRST_LOOK`, for a rig whose numbers nobody knows: its rounds are longer."""

STEPS, STEPS_UNKNOWN = 4, 12
"""Steps in each round; numbers that nobody knows lie in long valleys."""

LEAST = 100.0
"""Samples that the angle counts for at least in a search of a rig whose numbers nobody knows."""

CONTENDERS = 4
"""How many of the likeliest are fitted to the end, and compared closely when none of them explains all."""

CLOSE = 1.5
"""Rivals are close when their mean square residuals are within this factor."""

GOOD_ENOUGH = 1.3
"""RMS of a residual, in units of a reading's noise, up to which the model explains a channel."""

FORM_SHOWS = 1.2
"""Mean square residual, in units of a reading's noise, from which on an effect must have another form."""

Tried = list[tuple[Hypothesis, Fit]]
"""Hypotheses with what came of them so far."""


@dataclass(frozen=True)
class Weighed:
    """A hypothesis after its fit: log evidence over the best without it, and probability in its round."""

    hypothesis: Hypothesis
    fit: Fit
    gain: float
    probability: float


@dataclass(frozen=True)
class Round:
    """What is known of a part of the chain, and what can be tried on top of it.

    Attributes:
        chains: the cut chains. block: the part.
        where: name of a hypothesis -> the parts whose readings it changes.
        downstream: fits of the other parts that some change, without any.
        known: the unknowns so far. current: their fit.
        pool: threads.
    """

    chains: Chains
    block: str
    where: Mapping[str, tuple[str, ...]]
    downstream: Mapping[str, Fit]
    known: list[Unknown]
    current: Fit
    pool: ThreadPoolExecutor

    @property
    def guessed(self) -> bool:
        """Whether the arm is driven and its numbers are only a guess."""
        return self.chains.fit_nominal and not free_swinging(self.chains.recordings)

    def first_look(self, candidates: list[Hypothesis]) -> Tried:
        """The candidates that linear algebra leaves standing, each fitted for a few rounds from where it did best."""
        rounds = FIRST_LOOK_UNKNOWN if self.guessed else FIRST_LOOK
        work = [(h, self._submit(h, rounds, start)) for h, start in self._shortlist(candidates)]
        return [(h, w.result()) for h, w in work]

    def _shortlist(self, candidates: list[Hypothesis]) -> list[tuple[Hypothesis, int]]:
        groups = [(h, j) for h in candidates for j in range(len(h.starts))]
        left = screen(self.chains.residuals(self.block), self.current, self.known, [h.starts[j] for h, j in groups])
        best: dict[str, tuple[float, Hypothesis, int]] = {}
        for (h, j), x in zip(groups, left, strict=True):
            if h.name not in best or x < best[h.name][0]:
                best[h.name] = (x, h, j)
        ranked = [(h, j) for _, h, j in sorted(best.values(), key=lambda item: item[0])]
        nominal = self.chains.model.model
        # a number that has strayed far explains nothing more as a mismatch; it is only less surprising
        strayed = [(h, j) for h, j in ranked[SHORTLIST:] if h.number and not self.chains.fit_nominal and abs(
            self.current.values[h.number] - nominal[h.number]) > 2.0 * NUMBER_SD * abs(nominal[h.number])]
        return ranked[:SHORTLIST] + strayed

    def led(self, tried: Tried) -> tuple[Tried, Hypothesis | None]:
        """The best fitted to the end, and the others begun anew from its numbers: those that nobody knows lead astray.

        Returns:
            Each with the better of its fits, and which of them needs no further one.
        """
        gain, lead, begun = self._likeliest(tried)[0]
        if gain + log_odds(lead) <= 0.0:
            return tried, None
        best = self._submit(lead, ROUNDS, begun=begun.values).result()
        led = [None if h is lead else self._submit(h, FIRST_LOOK_UNKNOWN, begun=best.values) for h, _ in tried]
        return better(tried, [best if one is None else one.result() for one in led]), lead

    def to_the_end(self, tried: Tried, rounds: int = ROUNDS, *, but: Hypothesis | None = None) -> Tried:
        """The likeliest fitted to their end, the others as they are."""
        likeliest = [h for _, h, _ in self._likeliest(tried)[:CONTENDERS] if h is not but]
        work = [self._submit(h, rounds, begun=f.values) if h in likeliest else None for h, f in tried]
        return [(h, w.result() if w else f) for (h, f), w in zip(tried, work, strict=True)]

    def from_elsewhere(self, tried: Tried) -> Tried:
        """The likeliest begun from their other starts, too: a search may have ended in a valley of its own."""
        def again(h: Hypothesis) -> list[Future[Fit]]:
            one = len(h.starts) == 1 or CATALOGUE[h.effect].linear_in
            return [] if one else [self._submit(h, FIRST_LOOK, start) for start in range(len(h.starts))]

        likeliest = [h for _, h, _ in self._likeliest(tried)[:CONTENDERS]]
        looks = [[w.result() for w in again(h)] if h in likeliest else [] for h, _ in tried]
        counts = counts_of([*(f for _, f in tried), *(f for fits in looks for f in fits)])
        best = [max(fits, key=lambda f: f.likelihood(counts), default=None) for fits in looks]
        work = [self._submit(h, ROUNDS, begun=b.values) if b else None for (h, _), b in zip(tried, best, strict=True)]
        return better(tried, [w.result() if w else f for (_, f), w in zip(tried, work, strict=True)])

    def identified_anew(self, candidates: list[Hypothesis], tried: Tried) -> Tried:
        """Effects of the drive, if nothing tried explains all, identified together with the numbers; and the others.

        Only of a rig that nobody knows, with angle and command alone.
        """
        if not self.guessed or not angle_only(self.chains.recordings):
            return tried
        if any(mean_square(f, self.block) < FORM_SHOWS for _, f in tried):
            return tried

        def go(h: Hypothesis) -> Fit:
            begun = nominal_fit.with_effect(self.chains.model, self.chains.recordings, h.starts[0][0])
            return self._fit(h, ROUNDS, 0, begun)

        drive = [h for h in candidates if h.starts[0][0].name in nominal_fit.SIZES]
        best = dict(tried)
        for h, f in zip(drive, self.pool.map(go, drive), strict=True):
            counts = counts_of([f, best.get(h, f)])
            if h not in best or f.evidence(counts) > best[h].evidence(counts):
                best[h] = f
        return list(best.items())

    def weighed(self, tried: Tried) -> list[Weighed]:
        """Log evidence of each against none further, and probabilities; best first."""
        gains = [x + log_odds(h) for (h, _), x in zip(tried, self._gains(tried, Fit.evidence), strict=True)]
        weights = np.array([*gains, 0.0])
        weights = np.exp(weights - weights.max())
        probability = weights / weights.sum()
        rivals = [Weighed(h, f, g, float(p)) for (h, f), g, p in zip(tried, gains, probability, strict=False)]
        return self._told_apart_by_place(sorted(rivals, key=lambda w: -w.gain))

    def _likeliest(self, tried: Tried) -> list[tuple[float, Hypothesis, Fit]]:
        """Those first that gain most likelihood, which foretells more than evidence where fits are not at their end."""
        gains = self._gains(tried, Fit.likelihood)
        return sorted(((x, h, f) for x, (h, f) in zip(gains, tried, strict=True)), key=lambda item: -item[0])

    def _gains(self, tried: Tried, of: Callable[[Fit, Mapping[str, float]], float]) -> list[float]:
        """How much more evidence or likelihood each fit has than none further."""
        counts = counts_of([self.current, *self.downstream.values(), *(f for _, f in tried)])
        return [of(f, counts) - of(self.current, counts)
                - sum(of(self.downstream[b], counts) for b in self.where[h.name] if b != self.block) for h, f in tried]

    def _told_apart_by_place(self, rivals: list[Weighed]) -> list[Weighed]:
        """Decide between rivals of which none explains all: one is an effect of another form than the catalogue's.

        Each is given free curves at its own place. The right one needs them for its form alone; a wrong one, which only
        borrows the gap of a neighbour, cannot mend it from where it lives.
        """
        best = mean_square(rivals[0].fit, self.block)
        close = [w for w in rivals[:CONTENDERS] if w.gain > 0.0 and mean_square(w.fit, self.block) < CLOSE * best]
        if best < FORM_SHOWS or len({w.hypothesis.place for w in close}) < 2:
            return rivals
        left: list[tuple[float, float]] = []
        for w in close:
            own = [s for s in shapes(
                self.chains, self.block, w.fit, adopted(self.known, w.hypothesis)) if s.place == w.hypothesis.place]
            left += [(s.left, s.independent) for s in own] or [(mean_square(w.fit, self.block), 1.0)]
        count = max(n for _, n in left)
        evidence = np.array([-0.5 * count * math.log(max(x, 1.0)) for x, _ in left])
        weights = np.exp(evidence - evidence.max())
        weights *= sum(w.probability for w in close) / weights.sum()
        again = [replace(w, probability=float(p)) for w, p in zip(close, weights, strict=True)]
        order = {id(w): -float(e) for w, e in zip(again, evidence, strict=True)}
        rest = [w for w in rivals if all(w is not c for c in close)]
        return [*sorted(again, key=lambda w: order[id(w)]), *rest]

    def _submit(self, hypothesis: Hypothesis, rounds: int, start: int = 0, begun: Mapping[str, float] | None = None
                ) -> Future[Fit]:
        return self.pool.submit(self._fit, hypothesis, rounds, start, begun)

    def _fit(self, hypothesis: Hypothesis, rounds: int, start: int, begun: Mapping[str, float] | None) -> Fit:
        """Fit a hypothesis on top of what is known, on every part of the chain that it changes; go on from `begun`."""
        parts = [self.chains.residuals(self.block)]
        unknowns = started(self.known, self.current.values)
        for other in self.where[hypothesis.name]:
            if other != self.block:
                parts.append(self.chains.residuals(other))
                extra = nominal_unknowns(self.chains, other)
                unknowns += started(extra, self.downstream[other].values)

        def residuals(values: dict[str, float]) -> dict[str, np.ndarray]:
            return {k: r for part in parts for k, r in part(values).items()}

        steps, least = (STEPS_UNKNOWN, LEAST) if self.guessed else (STEPS, 0.0)
        if hypothesis.number and begun is None:  # fitted already: as a mismatch it only surprises less by where it is
            begun = self.current.values
        if begun is not None:
            return fit(residuals, started(adopted(unknowns, hypothesis), begun), rounds, steps, least)
        if CATALOGUE[hypothesis.effect].linear_in:
            first = fit(lambda values: residuals(from_linear(hypothesis.effect, values)),
                        [*unknowns, *linear_unknowns(hypothesis.effect)], rounds=3, least=least)
            own = from_linear(hypothesis.effect, first.values)
            size, second = (f"{hypothesis.effect}.{name}" for name in list(CATALOGUE[hypothesis.effect].parameters)[:2])
            bounds = CATALOGUE[hypothesis.effect].parameters[second.partition(".")[2]]
            # of an unknown rig the product alone may be sure: a search that begins at a bound would stay there
            inside = self.chains.fit_nominal and CATALOGUE[hypothesis.effect].linear_in == "product"
            reach = 0.3 if inside else 1.0
            own[size] *= max(1.0, own[second] / (reach * bounds.high), own[second] / (reach * bounds.low))
            if inside:
                own[second] = min(max(own[second], reach * bounds.low), reach * bounds.high)
            return fit(residuals, started(adopted(unknowns, hypothesis), own), rounds, steps, least)
        return fit(residuals, adopted(unknowns, hypothesis, start), rounds, steps, least)


def started(unknowns: Iterable[Unknown], values: Mapping[str, float]) -> list[Unknown]:
    """The unknowns, searched from these values."""
    return [Unknown(u.name, u.mean, u.sd, u.low, u.high, values.get(u.name, u.start), u.log) for u in unknowns]


def adopted(known: list[Unknown], hypothesis: Hypothesis, start: int = 0) -> list[Unknown]:
    """What is known, with the unknowns of a hypothesis."""
    own = hypothesis.starts[start]
    return [*(u for u in known if u.name not in {o.name for o in own}), *own]


def mean_square(f: Fit, block: str) -> float:
    """Mean square residual of a fit in the channels of a block, in units of a reading's noise."""
    home = {"actuator": ("v_a",), "motor": ("i_a", "omega"), "arm": ("theta",)}[block]
    own = [r for k, r in f.residuals.items() if of_recording(k)[0] in home]
    return float(np.mean(np.concatenate(own) ** 2)) if own else 0.0


def counts_of(fits: Iterable[Fit]) -> dict[str, float]:
    """Independent samples of each channel, one count for all fits that are compared: the whitest residual's."""
    counts: dict[str, float] = {}
    for f in fits:
        for channel, n in f.independent.items():
            counts[channel] = max(counts.get(channel, 0.0), n)
    return counts


def better(tried: Tried, again: list[Fit]) -> Tried:
    """Each hypothesis with the better by evidence of its two fits."""
    counts = counts_of([*again, *(f for _, f in tried)])
    return [(h, max(f, g, key=lambda x: x.evidence(counts))) for (h, f), g in zip(tried, again, strict=True)]


def against(f: Fit, other: Fit) -> float:
    """Log evidence of `other` over `f`, with as many independent samples as one of these two leaves.

    A third fit, which leaves more, says nothing of how surely these two are told apart; and a narrow band, in which
    autocorrelations of either sign cancel, is worth fewer than it seems.
    """
    counts: dict[str, float] = {}
    for each in (f, other):
        for channel, r in each.residuals.items():
            own = min(each.independent[channel], independent_samples(r, power=2))
            counts[channel] = max(counts.get(channel, 0.0), own)
    return other.evidence(counts) - f.evidence(counts)
