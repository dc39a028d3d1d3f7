# SPDX-License-Identifier: Apache-2.0
"""Selection of the terms by free runs of the model, compared with the readings.

A regression on noisy states is biased where terms are nearly collinear: it chooses false terms and misses true ones. No
noise enters a free run. So the terms are chosen again by how much each would lower or raise the misfit of the free run
(score and Wald statistics of the likelihood, from its sensitivities). The model is then fitted again, until no change
lowers the extended Bayesian information criterion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from aeropend_ident.identification.output_error import (
    Entries,
    Experiment,
    Fitter,
    ReducedNormalEquations,
    to_unit_diagonal,
)
from aeropend_ident.identification.subset_selection import (
    Change,
    addition_gains,
    best_small_supports,
    descend,
    ebic_penalty,
)
from aeropend_ident.identification.terms import Array, Indices
from aeropend_sim.cli.progress import Show, nothing

ROUNDS = 12
"""Greatest number of times that the terms are chosen again. Choice."""

LOST = 1.2
"""Growth of a residual with longer shots above which these are too long: the system forgets its start. Choice."""

TRACKS = 0.2
"""RMS of a residual, as a share of the RMS of the readings about their mean, up to which a model tracks. Choice."""

SHOTS = 100
"""Greatest number of shots. Choice."""

MOST = 12
"""Greatest number of terms in an equation. Choice; the equations of the thesis have up to three."""

SINGLE = 4
"""Number of single changes that are tried if the free run does not confirm the best support. Choice."""

BLOCKS, RESAMPLES = 24, 50
"""Stretches of time in a resample, and number of resamples. Choice: 50 give a share to ±6 % at 0.8."""

STABLE = 0.8
"""Share of resamples below which a term is unstable. Choice, in the range 0.6 to 0.9 of Meinshausen & Bühlmann (2010).
A term that only one of 24 stretches needs is chosen in 64 % of resamples, 1 - (23/24)^24."""

NO_WORSE = 0.01
"""Relative increase of the held-out misfit up to which an unstable term is left out. Choice."""

SAME = 10.0
"""Increase of the criterion up to which an exchanged term explains the data as well. Choice; a greater difference in
BIC is called very strong evidence (Kass & Raftery, Journal of the American Statistical Association 90, 1995)."""

LEAST_OF_INVERSE = 0.5
"""What each element of the diagonal of an inverse has at least.

Derived: where the diagonal of a positive definite matrix is 1, that of its inverse is 1 or more, but for rounding."""

RIDGE = 1e-11
"""Added to the diagonal of scaled systems, so that equal terms do not make them singular. Choice."""

USABLE = 1e-12
"""Least diagonal element of a candidate's normal equations; below it, the term does not act on the readings. Choice."""


Score = Callable[[Fitter], float]


class QuadraticMisfit:
    """The misfit of a free run as a quadratic function of all candidate coefficients, around a model.

    Attributes:
        c: (P,) the model's coefficients, scaled.
        unscale: (P,) a scaled coefficient times this is the coefficient.
        penalty: increase of the criterion by each coefficient.
    """

    def __init__(self, normal: ReducedNormalEquations, values: Array, penalty: float, equation: Indices) -> None:
        """Scale the normal equations to a diagonal of 1.

        Args:
            normal: the linearised problem over all candidates.
            values: (P,) the model's coefficients, 0 for candidates outside.
            penalty: increase of the criterion by each coefficient.
            equation: (P,) equation of each candidate.
        """
        d = to_unit_diagonal(normal.H)
        self._usable = np.diag(normal.H) > USABLE
        self._H, self._g, self.c = d[:, None] * normal.H * d, d * normal.g, values / d
        self.penalty, self._equation = penalty, equation
        self.unscale = d

    def with_equations(self, normal: ReducedNormalEquations) -> QuadraticMisfit:
        """The same model with other normal equations, as those of a resample."""
        return QuadraticMisfit(normal, self.c * self.unscale, self.penalty, self._equation)

    def _right(self, support: Sequence[int]) -> tuple[Array, Array]:
        """Steps (P,) that drop what is outside a support, and the right-hand side (P,) after them."""
        out = np.ones(len(self.c), dtype=bool)
        out[np.array(support, dtype=int)] = False
        dropped = np.where(out, -self.c, 0.0)
        return dropped, self._g - self._H @ dropped

    def solve(self, support: Sequence[int]) -> tuple[Array, Array, float]:
        """Minimise over a support: steps of its coefficients, inverse of its H, and change of the misfit."""
        s = np.array(support, dtype=int)
        dropped, right = self._right(support)
        inverse = np.linalg.inv(self._H[np.ix_(s, s)] + RIDGE * np.eye(len(s))) if len(s) else np.zeros((0, 0))
        step = inverse @ right[s]
        change = -2.0 * dropped @ self._g + dropped @ self._H @ dropped - right[s] @ step
        return step, inverse, float(change)

    def rate(self, support: Sequence[int]) -> float:
        """The criterion of a support, up to a constant."""
        return self.solve(support)[2] + self.penalty * len(support)

    def at_minimum(self, support: Sequence[int]) -> Array:
        """The coefficients over a support at the minimum."""
        step, _, _ = self.solve(support)
        s = np.array(support, dtype=int)
        return np.asarray(self.unscale[s] * (self.c[s] + step))

    def single_changes(self, support: Sequence[int]) -> Iterator[Change]:
        """The best addition and the best removal."""
        s = list(support)
        step, inverse, change = self.solve(s)
        base = change + self.penalty * len(s)
        yield from self._addition(s, inverse, step, base)
        if s:
            total = self.c[s] + step
            loss = total**2 / np.maximum(np.diag(inverse), LEAST_OF_INVERSE)
            j = int(np.argmin(loss))
            yield Change(base + float(loss[j]) - self.penalty, tuple(s[:j] + s[j + 1:]))

    def exchanges(self, support: Sequence[int]) -> Iterator[Change]:
        """For each term the best other term in its place."""
        for j in range(len(support)):
            rest = [*support[:j], *support[j + 1:]]
            step, inverse, change = self.solve(rest)
            for found in self._addition(rest, inverse, step, change + self.penalty * len(rest)):
                if set(found.support) != set(support):
                    yield found

    def _addition(self, s: list[int], inverse: Array, step: Array, base: float) -> Iterator[Change]:
        gains = self.gains(s, inverse, step)
        if gains.max(initial=0.0) > 0.0:
            j = int(np.argmax(gains))
            yield Change(base - float(gains[j]) + self.penalty, tuple(sorted([*s, j])))

    def gains(self, s: list[int], inverse: Array, step: Array) -> Array:
        """Decrease (P,) of the misfit by each candidate outside a support; -1 for those that cannot be added.

        The coefficient of a candidate that was dropped starts from its value in the model.
        """
        gains = addition_gains(self._H, self._right(s)[1], s, inverse, step)
        full = [e for e, k in zip(*np.unique(self._equation[s], return_counts=True)) if k >= MOST]
        allowed = self._usable & ~np.isin(self._equation, full)
        allowed[s] = False
        return np.where(allowed, gains, -1.0)

    def search(self, support: Sequence[int]) -> list[int]:
        """The support with the lowest criterion, from a start and from no terms, finally equation by equation."""
        best = min((self.descend(start) for start in (list(support), [])), key=self.rate)
        for _ in range(MOST):
            found = min((s for e in np.unique(self._equation) for s in self._with_small_equation(best, int(e))),
                        key=self.rate, default=best)
            if self.rate(found) > self.rate(best) - 1e-6:
                break
            best = self.descend(found)
        return best

    def descend(self, support: list[int]) -> list[int]:
        """Add, drop and exchange terms while the criterion decreases."""
        return descend(support, self.rate(support), self.single_changes, self.exchanges)

    def _with_small_equation(self, support: list[int], equation: int) -> Iterator[list[int]]:
        """Supports in which one equation has the best of all small supports."""
        rest = [j for j in support if self._equation[j] != equation]
        step, inverse, _ = self.solve(rest)
        own = np.flatnonzero((self._equation == equation) & self._usable)
        _, right = self._right(rest)
        cross = self._H[own][:, rest]
        H = self._H[own][:, own] - cross @ inverse @ cross.T
        for small in best_small_supports(H, right[own] - cross @ step):
            yield sorted([*rest, *(int(own[j]) for j in small)])


class Alternative(NamedTuple):
    """A term of an equation that another could replace, and by how much that raises the criterion; indices."""

    equation: int
    term: int
    instead: int
    worse: float


@dataclass(frozen=True)
class SelectedModel:
    """A model whose terms were selected by free runs.

    Attributes:
        matrix: (equations, terms) coefficients.
        sigma: (equations, terms) their standard deviations.
        stability: (equations, terms) share of resamples of the recording in which each term is chosen.
        unstable: (equation, term, share) of the terms that were left out: few resamples choose them, and the misfit on
            held-out data does not need them.
        fitter: in its last state.
        alternatives: other terms that explain the data as well.
    """

    matrix: Array
    sigma: Array
    stability: Array
    unstable: list[tuple[int, int, float]]
    fitter: Fitter
    alternatives: list[Alternative]


def select_terms(experiment: Experiment, start: Array, candidates: Array, shot: int, *, cut: bool = True,
                 score: Score | None = None, show: Show = nothing) -> SelectedModel | None:
    """Choose terms and coefficients by free runs.

    If the first model tracks the whole recording, it is run at once. If not, it is run in shots, which grow for as long
    as the model tracks: a wrong model drifts away, and a chaotic system forgets its initial state.

    Args:
        experiment: inputs and readings.
        start: (equations, terms) coefficients of a first model.
        candidates: (equations, terms) bool, the entries that may be in the model.
        shot: samples of the shortest shots.
        cut: whether shots are tried; if not, the first model only has to run.
        score: misfit of a fitted model on held-out data, which decides about unstable terms; None: they stay, and
            stability is not computed.
        show: progress display, from 0 to 1.

    Returns:
        None when the first model diverges, or the chosen one once it is integrated in finer steps.
    """
    every = Entries.candidates(candidates)
    fitter = _first_fit(experiment, start, every, shot, cut=cut)
    if fitter is None:
        return None
    show(0.3, "choosing terms by free runs")
    improve_terms(fitter, every, start.shape)
    steps = fitter.steps
    fitter.refine_steps()
    if fitter.steps != steps:
        if not fitter.fit():
            return None
        improve_terms(fitter, every, start.shape)
    unstable: list[tuple[int, int, float]] = []
    if score is not None:
        show(0.6, "testing the terms on resamples")
        misfit, now, often, unstable = stability_selection(fitter, every, start.shape, score)
    else:
        misfit, now, _ = linearise(fitter, every, start.shape)
        often = np.zeros(len(every))
    matrix, sigma, stability = np.zeros(start.shape), np.zeros(start.shape), np.zeros(start.shape)
    stability[every.equation, every.term] = often
    matrix[fitter.model.equation, fitter.model.term] = fitter.model.value
    sigma[fitter.model.equation, fitter.model.term] = fitter.deviations()
    return SelectedModel(matrix, sigma, stability, unstable, fitter, list(alternatives(misfit, every, now)))


def _first_fit(experiment: Experiment, start: Array, every: Entries, shot: int, *, cut: bool) -> Fitter | None:
    """A first model, fitted to the whole recording or in shots; None when it diverges. See `select_terms`."""
    fitter = Fitter(experiment, Entries.of(start), 0, floor=1.0)
    runs = fitter.fit(rounds=15)
    if not cut or (runs and tracks(fitter)):
        return fitter if runs else None
    whole = fitter if runs else None
    shot = max(shot, len(experiment) // SHOTS)
    fitter = Fitter(experiment, Entries.of(start), shot, floor=1.0)
    if not fitter.fit(rounds=15):
        return whole
    lengthen_shots(fitter, every, start.shape, shot)
    return fitter


def stability_selection(fitter: Fitter, every: Entries, shape: tuple[int, ...], score: Score
                        ) -> tuple[QuadraticMisfit, tuple[int, ...], Array, list[tuple[int, int, float]]]:
    """Leave out, one by one, terms that few resamples choose and that held-out data do not need.

    Args:
        fitter: the fitted model; its terms are changed.
        every: all candidates.
        shape: of matrices (equations, terms).
        score: misfit of a fitted model on held-out data.

    Returns:
        The final linearised problem, its support, how often (P,) each candidate is chosen, and the terms left out, each
        with its equation and its share of resamples.
    """
    needed: set[int] = set()
    unstable: list[tuple[int, int, float]] = []
    while True:
        misfit, now, normal = linearise(fitter, every, shape, BLOCKS)
        often = selection_frequencies(misfit, normal, now)
        doubtful = [j for j in now if often[j] < STABLE and j not in needed]
        if not doubtful:
            return misfit, now, often, unstable
        least = min(doubtful, key=lambda j: often[j])
        before, held_out = fitter.state, score(fitter)
        fitter.model = _at_minimum(misfit, every, [j for j in now if j != least])
        if np.isfinite(held_out) and fitter.fit(rounds=15) and score(fitter) <= (1.0 + NO_WORSE) * held_out:
            unstable.append((int(every.equation[least]), int(every.term[least]), float(often[least])))
        else:
            fitter.state = before
            needed.add(least)


def tracks(fitter: Fitter) -> bool:
    """Whether a fitted model stays near the readings, or within twice their noise, over the whole recording."""
    e = fitter.experiment
    spread = {o.name: float(np.nanstd(o.value)) / o.sigma for o in e.outputs}
    spread |= {m.name: float(np.std(m.value / m.sigma)) for m in e.means if len(m.value)}
    return all(fitter.scale[k] < max(2.0, TRACKS * spread[k]) for k in spread)


def lengthen_shots(fitter: Fitter, every: Entries, shape: tuple[int, ...], shot: int) -> None:
    """Choose terms in short shots, and double their length for as long as the residuals do not grow."""
    improve_terms(fitter, every, shape)
    while len(fitter.shots) > 1:
        kept, noise = fitter.state, fitter.scale
        shot *= 2
        fitter.merge_shots(shot)
        if not fitter.fit(rounds=15) or any(fitter.scale[k] > LOST * noise[k] for k in noise):
            fitter.state = kept
            fitter.fit(rounds=2)
            return
        improve_terms(fitter, every, shape)


def improve_terms(fitter: Fitter, every: Entries, shape: tuple[int, ...]) -> None:
    """Change the terms until no change lowers the criterion, by the linearised problem and then by the free run."""
    for _ in range(ROUNDS):
        misfit, now, normal = linearise(fitter, every, shape)
        chosen = tuple(misfit.search(now))
        if chosen == now:
            return
        value = normal.cost + misfit.penalty * len(now)
        before = fitter.state
        for support in _proposals(misfit, now, chosen):
            if _fit_over(fitter, misfit, every, now, support) and fitter.misfit(
                    before.weights) + misfit.penalty * len(support) < value:
                break
            fitter.state = before
        else:
            fitter.fit(rounds=2)
            return


def _proposals(misfit: QuadraticMisfit, now: Sequence[int], chosen: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """The best of all supports, then the best that differ from the present one by a single change."""
    yield chosen
    single = sorted([*misfit.single_changes(now), *misfit.exchanges(now)])
    yield from (change.support for change in single[:SINGLE])


def _fit_over(fitter: Fitter, misfit: QuadraticMisfit, every: Entries, now: Sequence[int], support: Sequence[int]
              ) -> bool:
    """Fit the model over another support; returns whether it can be run."""
    before = fitter.state
    fitter.model = _at_minimum(misfit, every, support)
    if fitter.fit(rounds=15):
        return True
    # outside the range of linearisation: start the remaining coefficients from their present values, new ones from 0
    fitter.state = before
    values = np.zeros(len(every))
    values[list(now)] = fitter.model.value
    fitter.model = replace(every.subset(support), value=values[list(support)])
    return fitter.fit(rounds=30)


def _at_minimum(misfit: QuadraticMisfit, every: Entries, support: Sequence[int]) -> Entries:
    """The model over a support at the minimum of the linearised problem."""
    return replace(every.subset(support), value=misfit.at_minimum(support))


def linearise(fitter: Fitter, every: Entries, shape: tuple[int, ...], blocks: int = 1
              ) -> tuple[QuadraticMisfit, tuple[int, ...], ReducedNormalEquations]:
    """Linearise the free run over all candidates. The entries of the model are put into the order of the candidates.

    Args:
        fitter: the fitted model.
        every: all candidates.
        shape: of matrices (equations, terms).
        blocks: number of stretches of time whose normal equations are kept.

    Returns:
        The linearised problem, the candidates that are in the model, and the normal equations.
    """
    states = fitter.run(fitter.model, fitter.initial)
    assert states is not None
    residuals = fitter.residuals(states)
    fitter.reweigh(residuals)
    normal, _ = fitter.normal_equations(states, every, residuals, blocks)
    position = {(e, t): k for k, (e, t) in enumerate(zip(every.equation.tolist(), every.term.tolist()))}
    now = [position[e, t] for e, t in zip(fitter.model.equation.tolist(), fitter.model.term.tolist())]
    values = np.zeros(len(every))
    values[now] = fitter.model.value
    fitter.model = fitter.model.subset(np.argsort(now).tolist())
    return (QuadraticMisfit(normal, values, ebic_penalty(normal.count, shape[1]), every.equation), tuple(sorted(now)),
            normal)


def selection_frequencies(misfit: QuadraticMisfit, normal: ReducedNormalEquations, support: Sequence[int], seed: int = 0
                          ) -> Array:
    """Share (P,) of resamples in which each candidate is chosen (stability selection, Meinshausen & Bühlmann, 2010).

    A resample draws stretches of time, with replacement.

    Args:
        misfit: the linearised problem.
        normal: its normal equations, with blocks.
        support: candidates that are in the model; each search starts there.
        seed: of the random draws.
    """
    rng, count = np.random.default_rng(seed), np.zeros(len(misfit.c))
    H, g = (np.array([block[k] for block in normal.blocks]) for k in (0, 1))
    for _ in range(RESAMPLES):
        times = np.bincount(rng.integers(len(H), size=len(H)), minlength=len(H)).astype(float)
        drawn = ReducedNormalEquations(np.tensordot(times, H, 1), times @ g, normal.cost, normal.count)
        count[misfit.with_equations(drawn).descend(list(support))] += 1.0
    return count / RESAMPLES


def alternatives(misfit: QuadraticMisfit, every: Entries, support: Sequence[int]) -> Iterator[Alternative]:
    """Exchanges of one term of an equation for another that explains the data as well (`SAME`)."""
    base = misfit.rate(support)
    for j in range(len(support)):
        rest = [*support[:j], *support[j + 1:]]
        step, inverse, change = misfit.solve(rest)
        gains = misfit.gains(rest, inverse, step)
        values = change - gains + misfit.penalty * len(support)
        out = support[j]
        own = np.flatnonzero((every.equation == every.equation[out]) & (gains > 0.0))
        for k in own:
            if k != out and values[k] < base + SAME:
                yield Alternative(int(every.equation[out]), int(every.term[out]), int(every.term[k]),
                                  float(values[k] - base))
