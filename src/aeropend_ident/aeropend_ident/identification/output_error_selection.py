# SPDX-License-Identifier: Apache-2.0
"""The last word on the terms: free runs of the model against what was measured.

A regression on noisy states is biased where terms are nearly collinear: it takes spurious ones in, and true ones out.
A free run has no noise in it. So the terms are chosen anew by how much each would take off, or put on, the misfit of
the free run (score and Wald statistics of the likelihood, from its sensitivities), and the model is fitted again, until
no change pays by the extended Bayesian criterion.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from aeropend_ident.identification.output_error import Entries, Experiment, Fitter, Normal
from aeropend_ident.identification.subset_selection import price, smallest
from aeropend_ident.identification.terms import Array, Indices
from aeropend_sim.cli.progress import Show, nothing

ROUNDS = 12
"""Times that terms are chosen anew at most."""

LOST = 1.2
"""Growth of a residual with longer shots from which on these are too long: the system forgets where it started."""

FOLLOWS = 0.2
"""Residual, as a share of what a channel varies by, up to which a model follows the recording."""

SHOTS = 100
"""Shots that a recording is cut into at most."""

MOST = 12
"""Terms of one equation at most."""

SINGLE = 4
"""Changes of a single term that are tried where the best of all supports does not keep what it promises."""

BLOCKS, RESAMPLES = 24, 50
"""Stretches of time that are drawn anew, with repeats, and how often, to see which terms are chosen every time."""

STABLE = 0.8
"""Share of resamples below which a term is unstable; one that shows in one stretch alone has 0.64."""

NO_WORSE = 0.01
"""Share by which the held-out misfit may grow when an unstable term is left out."""


Score = Callable[[Fitter], float]


@dataclass(frozen=True)
class Change:
    """A change of the support in the linearised problem: new support (entries of all candidates) and its criterion."""

    support: tuple[int, ...]
    value: float


class Linear:
    """The misfit of a free run as a quadratic in all candidate coefficients, around a model.

    Args:
        normal: its normal equations over all candidates. values: (P,) the model's coefficients, 0 where not in it.
        cost: what one coefficient costs. equation: (P,) of each candidate.
    """

    def __init__(self, normal: Normal, values: Array, cost: float, equation: Indices) -> None:
        d = 1.0 / np.sqrt(np.maximum(np.diag(normal.H), 1e-300))
        self.usable = np.diag(normal.H) > 1e-12
        self.H, self.g, self.c = d[:, None] * normal.H * d, d * normal.g, values / d
        self.price, self.equation = cost, equation
        self.d = d

    def solve(self, support: Sequence[int]) -> tuple[Array, Array, float]:
        """For a support: its steps, the inverse of its H, and the change in the misfit."""
        s = np.array(support, dtype=int)
        out = np.ones(len(self.c), dtype=bool)
        out[s] = False
        dropped = np.where(out, -self.c, 0.0)
        right = self.g - self.H @ dropped
        inverse = np.linalg.inv(self.H[np.ix_(s, s)] + 1e-11 * np.eye(len(s))) if len(s) else np.zeros((0, 0))
        step = inverse @ right[s]
        change = -2.0 * dropped @ self.g + dropped @ self.H @ dropped - right[s] @ step
        return step, inverse, float(change)

    def rate(self, support: Sequence[int]) -> float:
        """The criterion of a support, less that of an arbitrary constant."""
        return self.solve(support)[2] + self.price * len(support)

    def moves(self, support: Sequence[int]) -> Iterator[Change]:
        """The best single addition, the best single removal, and the best exchange."""
        s = list(support)
        step, inverse, change = self.solve(s)
        base = change + self.price * len(s)
        yield from self._addition(s, inverse, step, base)
        if s:
            total = self.c[s] + step
            loss = total**2 / np.maximum(np.diag(inverse), 1e-300)
            j = int(np.argmin(loss))
            yield Change(tuple(s[:j] + s[j + 1:]), base + float(loss[j]) - self.price)

    def exchanges(self, support: Sequence[int]) -> Iterator[Change]:
        """For every term the best other one in its place."""
        for j in range(len(support)):
            rest = [*support[:j], *support[j + 1:]]
            step, inverse, change = self.solve(rest)
            for found in self._addition(rest, inverse, step, change + self.price * len(rest)):
                if set(found.support) != set(support):
                    yield found

    def _addition(self, s: list[int], inverse: Array, step: Array, base: float) -> Iterator[Change]:
        gains = self.gains(s, inverse, step)
        if gains.max(initial=0.0) > 0.0:
            j = int(np.argmax(gains))
            yield Change(tuple(sorted([*s, j])), base - float(gains[j]) + self.price)

    def gains(self, s: list[int], inverse: Array, step: Array) -> Array:
        """What each candidate outside would take off the misfit; -1 for those that may not come."""
        out = np.ones(len(self.c), dtype=bool)
        out[s] = False
        dropped = np.where(out, -self.c, 0.0)
        right = self.g - self.H @ dropped
        cross = self.H[:, s]
        left = right - cross @ step
        # the coefficient of a candidate that was dropped starts from where it was
        size = np.diag(self.H) - np.einsum("ij,jk,ik->i", cross, inverse, cross)
        full = [e for e, k in zip(*np.unique(self.equation[s], return_counts=True)) if k >= MOST]
        fine = out & self.usable & (size > 1e-9) & ~np.isin(self.equation, full)
        return np.where(fine, left**2 / np.maximum(size, 1e-9), -1.0)

    def search(self, support: Sequence[int]) -> list[int]:
        """The support that the criterion prefers, found from a start and from nothing, equation by equation at last."""
        best = min((self.descend(start) for start in (list(support), [])), key=self.rate)
        for _ in range(MOST):
            found = min((s for e in np.unique(self.equation) for s in self.replaced(best, int(e))), key=self.rate,
                        default=best)
            if self.rate(found) > self.rate(best) - 1e-6:
                break
            best = self.descend(found)
        return best

    def replaced(self, support: list[int], equation: int) -> Iterator[list[int]]:
        """Supports in which one equation is the best of all small ones."""
        rest = [j for j in support if self.equation[j] != equation]
        step, inverse, _ = self.solve(rest)
        own = np.flatnonzero((self.equation == equation) & self.usable)
        out = np.ones(len(self.c), dtype=bool)
        out[rest] = False
        right = self.g - self.H @ np.where(out, -self.c, 0.0)
        cross = self.H[own][:, rest]
        H = self.H[own][:, own] - cross @ inverse @ cross.T
        for small in smallest(H, right[own] - cross @ step):
            yield sorted([*rest, *(int(own[j]) for j in small)])

    def descend(self, best: list[int]) -> list[int]:
        """Add, drop and exchange while it pays."""
        value = self.rate(best)
        for _ in range(8 * MOST):
            found = min(self.moves(best), key=lambda c: c.value, default=None)
            if found is None or found.value > value - 1e-6:
                found = min(self.exchanges(best), key=lambda c: c.value, default=None)
            if found is None or found.value > value - 1e-6:
                break
            best, value = list(found.support), found.value
        return best


@dataclass(frozen=True)
class Refined:
    """A model that free runs preferred.

    Attributes:
        matrix: (equations, terms) coefficients. sigma: the same shape, 1 sigma.
        stability: the same shape, share of resamples of the recording in which each term is chosen.
        unstable: (equation, term, share) that were left out: few resamples choose them, and held-out data miss nothing.
        fitter: in its last state. alternatives: (equation, term, term instead) that explain the data as well.
    """

    matrix: Array
    sigma: Array
    stability: Array
    unstable: list[tuple[int, int, float]]
    fitter: Fitter
    alternatives: list[tuple[int, int, int, float]]


def refine(experiment: Experiment, start: Array, candidates: Array, shot: int, *, follow: bool = True,
           score: Score | None = None, show: Show = nothing) -> Refined | None:
    """Choose terms and coefficients by free runs.

    The whole recording is run at once if the first model can follow it so; if not, in shots that grow for as long as
    the model follows: a wrong model drifts off, and a chaotic system forgets where it started.

    Args:
        experiment: what to run on, and what was measured.
        start: (equations, terms) a first model. candidates: (equations, terms) bool, what may be in the model.
        shot: samples of the shortest shots. follow: whether to try shots; if not, a model that runs is good enough.
        score: misfit of a fitted model on held-out data, by which unstable terms are judged; None: they are not.
        show: how far it is, up to 1.

    Returns:
        None when the first model cannot be run.
    """
    equation, term = np.nonzero(candidates)
    every = Entries(equation.astype(np.int64), term.astype(np.int64), np.zeros(len(term)))
    fitter = Fitter(experiment, Entries.of(start), 0, floor=1.0)
    runs = fitter.fit(rounds=15)
    if not runs and not follow:
        return None
    if follow and not (runs and follows(fitter)):
        whole = fitter if runs else None
        shot = max(shot, len(experiment) // SHOTS)
        fitter = Fitter(experiment, Entries.of(start), shot, floor=1.0)
        if fitter.fit(rounds=15):
            grow(fitter, every, start.shape, shot)
        elif whole is not None:
            fitter = whole
        else:
            return None
    show(0.3, "choosing terms by free runs")
    choose(fitter, every, start.shape)
    steps = fitter.steps
    fitter.refine_steps()
    if fitter.steps != steps:
        fitter.fit()
        choose(fitter, every, start.shape)
    unstable: list[tuple[int, int, float]] = []
    if score is not None:
        show(0.6, "drawing the recording anew")
        linear, now, often = stabilise(fitter, every, start.shape, score, unstable)
    else:
        linear, now, _ = linearise(fitter, every, start.shape)
        often = np.zeros(len(every))
    matrix, sigma, stability = np.zeros(start.shape), np.zeros(start.shape), np.zeros(start.shape)
    stability[equation, term] = often
    matrix[fitter.model.equation, fitter.model.term] = fitter.model.value
    sigma[fitter.model.equation, fitter.model.term] = np.sqrt(np.diag(fitter.covariance()))
    return Refined(matrix, sigma, stability, unstable, fitter, list(alternatives(linear, every, now)))


def stabilise(fitter: Fitter, every: Entries, shape: tuple[int, ...], score: Score,
              unstable: list[tuple[int, int, float]]) -> tuple[Linear, tuple[int, ...], Array]:
    """Leave out one by one the terms that few resamples choose and held-out data do not miss; they go to `unstable`.

    Returns:
        The linearised problem that is left, its support, and how often (P,) each candidate is chosen.
    """
    missed: set[int] = set()
    while True:
        linear, now, normal = linearise(fitter, every, shape, BLOCKS)
        often = frequencies(linear, normal, now)
        doubtful = [j for j in now if often[j] < STABLE and j not in missed]
        if not doubtful:
            return linear, now, often
        least = min(doubtful, key=lambda j: often[j])
        before, misfit = fitter.state, score(fitter)
        fitter.model = moved(linear, every, [j for j in now if j != least])
        if np.isfinite(misfit) and fitter.fit(rounds=15) and score(fitter) <= (1.0 + NO_WORSE) * misfit:
            unstable.append((int(every.equation[least]), int(every.term[least]), float(often[least])))
        else:
            fitter.state = before
            missed.add(least)


def follows(fitter: Fitter) -> bool:
    """Whether a fitted model stays near the readings, or within twice their noise, all along."""
    e = fitter.experiment
    spread = {o.name: float(np.nanstd(o.value)) / o.sigma for o in e.outputs}
    spread |= {m.name: float(np.std(m.value / m.sigma)) for m in e.means}
    return all(fitter.scale[k] < max(2.0, FOLLOWS * spread[k]) for k in spread)


def grow(fitter: Fitter, every: Entries, shape: tuple[int, ...], shot: int) -> None:
    """Choose terms in short shots, and double their length for as long as the misfit stays."""
    choose(fitter, every, shape)
    while len(fitter.parts) > 1:
        kept, noise = fitter.state, dict(fitter.scale)
        shot *= 2
        fitter.merge(shot)
        if not fitter.fit(rounds=15) or any(fitter.scale[k] > LOST * noise[k] for k in noise):
            fitter.state = kept
            fitter.fit(rounds=2)
            return
        choose(fitter, every, shape)


def choose(fitter: Fitter, every: Entries, shape: tuple[int, ...]) -> None:
    """Change the terms until no change pays: what the linearised problem promises, the free run must keep."""
    for _ in range(ROUNDS):
        linear, now, normal = linearise(fitter, every, shape)
        chosen = tuple(linear.search(now))
        if chosen == now:
            return
        value = normal.cost + linear.price * len(now)
        before, weights = fitter.state, fitter.weights
        for support in promising(linear, now, chosen):
            if changed(fitter, linear, every, now, support) and fitter.misfit(weights) + linear.price * len(
                    support) < value:
                break
            fitter.state = before
        else:
            fitter.fit(rounds=2)
            return


def promising(linear: Linear, now: Sequence[int], chosen: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
    """The best of all supports, then the best that differ from the present one by a single change."""
    yield chosen
    single = sorted([*linear.moves(now), *linear.exchanges(now)], key=lambda change: change.value)
    yield from (change.support for change in single[:SINGLE])


def changed(fitter: Fitter, linear: Linear, every: Entries, now: Sequence[int], support: Sequence[int]) -> bool:
    """Fit the model over another support; returns whether it can be run."""
    before = fitter.state
    fitter.model = moved(linear, every, support)
    if fitter.fit(rounds=15):
        return True
    # too far for a straight line: from where the remaining coefficients were, new ones from 0
    fitter.state = before
    values = np.zeros(len(every))
    values[list(now)] = fitter.model.value
    fitter.model = replace(take(every, support), value=values[list(support)])
    return fitter.fit(rounds=30)


def take(every: Entries, support: Sequence[int]) -> Entries:
    """Some of all candidates."""
    s = np.array(support, dtype=int)
    return Entries(every.equation[s], every.term[s], every.value[s])


def moved(linear: Linear, every: Entries, support: Sequence[int]) -> Entries:
    """The model over a new support where the linearised problem has its minimum."""
    step, _, _ = linear.solve(support)
    s = np.array(support, dtype=int)
    return replace(take(every, support), value=linear.d[s] * (linear.c[s] + step))


def linearise(fitter: Fitter, every: Entries, shape: tuple[int, ...], blocks: int = 1
              ) -> tuple[Linear, tuple[int, ...], Normal]:
    """The linearised problem over all candidates, which of them are in the model, and its normal equations."""
    states = fitter.run(fitter.model, fitter.initial)
    assert states is not None
    residuals = fitter.residuals(states)
    fitter.reweigh(residuals)
    normal, _ = fitter.normal(states, every, residuals, blocks=blocks)
    position = {(e, t): k for k, (e, t) in enumerate(zip(every.equation.tolist(), every.term.tolist()))}
    now = [position[e, t] for e, t in zip(fitter.model.equation.tolist(), fitter.model.term.tolist())]
    values = np.zeros(len(every))
    values[now] = fitter.model.value
    order = np.argsort(now)
    fitter.model = Entries(fitter.model.equation[order], fitter.model.term[order], fitter.model.value[order])
    return Linear(normal, values, price(normal.count, shape[1]), every.equation), tuple(sorted(now)), normal


def frequencies(linear: Linear, normal: Normal, support: Sequence[int], seed: int = 0) -> Array:
    """How often (P,) each candidate is chosen when stretches of time are drawn anew (Meinshausen & Bühlmann, 2010).

    Args:
        linear: around the model. normal: its normal equations, with blocks. support: of the model; each search starts
            there. seed: of the draws.
    """
    rng, count = np.random.default_rng(seed), np.zeros(len(linear.c))
    H, g = (np.array([block[k] for block in normal.blocks]) for k in (0, 1))
    for _ in range(RESAMPLES):
        times = np.bincount(rng.integers(len(H), size=len(H)), minlength=len(H)).astype(float)
        drawn = Normal(np.tensordot(times, H, 1), times @ g, normal.cost, normal.count)
        count[Linear(drawn, linear.c * linear.d, linear.price, linear.equation).descend(list(support))] += 1.0
    return count / RESAMPLES


def alternatives(linear: Linear, every: Entries, support: Sequence[int], same: float = 10.0
                 ) -> Iterator[tuple[int, int, int, float]]:
    """Exchanges of one term of an equation for another that the data cannot tell from what was chosen."""
    base = linear.rate(support)
    for j in range(len(support)):
        rest = [*support[:j], *support[j + 1:]]
        step, inverse, change = linear.solve(rest)
        gains = linear.gains(rest, inverse, step)
        values = change - gains + linear.price * len(support)
        out = support[j]
        own = np.flatnonzero((every.equation == every.equation[out]) & (gains > 0.0))
        for k in own:
            if k != out and values[k] < base + same:
                yield int(every.equation[out]), int(every.term[out]), int(every.term[k]), float(values[k] - base)
