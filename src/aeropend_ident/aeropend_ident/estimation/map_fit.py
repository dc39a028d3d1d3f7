# SPDX-License-Identifier: Apache-2.0
"""Maximum a posteriori (MAP) fit of a model to channels of residuals, and its log evidence.

With residuals r_c (in units of a reading's noise) of channels c, and parameters z in standard units, the fit minimises

    sum_c  (ess_c / n_c) * sum(r_c ** 2) / s_c ** 2  +  z' P z

- s_c >= 1 inflates the noise to the RMS of the residual: a model that does not fit cannot claim a precise fit.
- ess_c <= n_c is the effective sample size: a coloured residual holds less information than its samples.
- The prior (z standard normal; P the inverse of its correlations) keeps parameters from moving far to stand in for a
  missing effect.
- A parameter that is pushed against its bound is left out of a step.

Both weights are renewed as the fit goes on. Fits are compared by their log evidence in Laplace's approximation: log
likelihood, with noise that has a spectrum (`whittle`), plus log Occam factor, the prior density times the posterior
volume (D. MacKay, Information Theory, Inference, and Learning Algorithms, 2003, chapter 28).

The steps are Levenberg-Marquardt's. `scipy.optimize.least_squares` with the same residuals, Jacobian and weights ends
at the same cost and takes 2.5 to 3 times the CPU time (`make bench ARGS="--only optimiser"`): it restarts whenever
the weights are renewed, and solves for the bounds more exactly than is needed here.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct
from scipy.optimize import lsq_linear

from aeropend_ident.estimation.parameter import Parameter, key, started
from aeropend_ident.signals.statistics import effective_sample_size
from aeropend_sim.compiled import njit

Array = NDArray[np.float64]
Residuals = Mapping[str, Array]
"""Channel -> residual (N,) in units of a reading's noise, missing samples left out."""
Products = dict[str, tuple[NDArray[np.intp], Array]]
"""Channel -> indices (P,) of the parameters that change it, and the products (P, P) of their sensitivities."""

MAY_CHANGE = 0.1
"""Share of the channels whose weights may still change when a fit ends (choice).

With many recordings some channel always changes a little."""

WEIGHT_CHANGE = 0.02
"""Relative change of a channel's weight that counts as a change (choice)."""

LARGEST = 1e9
"""Largest residual (choice: one beyond it is of a simulation that diverges, and products of it are still numbers)."""

STEP = 1e-4
"""Step of the finite differences, in standard deviations of the prior.

Choice: well above rounding, well below curvature."""

DAMPING, DAMPING_DOWN, DAMPING_UP, MOST_DAMPING = 1e-3, 0.2, 8.0, 1e6
"""Levenberg-Marquardt damping: first value, factors after a step that succeeds and one that fails, and where it ends.

Choice; any factors from 0.1 and 10 on lead to the same minimum."""

GOOD_STEP = 0.75
"""Share of the expected decrease below which the derivatives are computed anew, rather than corrected (choice)."""

ALONG = 0.2
"""Share of a step over which the second derivative along it is taken (choice: its source takes 0.1 to each side)."""

NARROWEST = 8
"""Coefficients of the cosine transform in the narrowest band (choice: their mean square is then good to a half)."""

DAMPINGS = (0.0, 1e-2, 1e-1, 1.0, 10.0)
"""Dampings that are tried until a step of `within_bounds` succeeds (choice: the derivatives are approximate)."""

RIDGE = 1e-12
"""Relative ridge that keeps a matrix regular, and least room for a step (choice: far below any step that counts)."""

NEGLIGIBLE = 3e-3
"""Relative decrease of the sum of squares at which `within_bounds` ends (choice: a gap then changes by 0.2 %)."""

POORER = 1.05
"""Ratio of mean squares above which a fit has ended in a worse local minimum than another (choice: 2.5 % in RMS)."""

ENOUGH, ENOUGH_OF_EXCESS = 1e-2, 1e-4
"""Decrease of the cost below which the search stops: absolute, and relative to the cost above that of noise.

Choice: the cost is twice a log density, and a difference of 1 hardly decides between two hypotheses."""


@dataclass(frozen=True)
class Fit:
    """A fitted hypothesis.

    Attributes:
        values: name -> estimate.
        sd: name -> standard deviation of the estimate.
        residuals: channel -> (N,) in units of a reading's noise, at the estimate.
        scale: channel -> RMS of the residual, at least 1.
        ess: channel -> effective sample size of the residual.
        log_prior: log density of the estimate under the prior, up to a constant.
        products: products of the sensitivities of each channel.
        prior: information matrix (P, P) of the prior.
    """

    values: dict[str, float]
    sd: dict[str, float]
    residuals: dict[str, Array]
    scale: dict[str, float]
    ess: dict[str, float]
    log_prior: float
    products: Products
    prior: Array

    @property
    def mean_square(self) -> float:
        """Mean square residual over all channels, in units of a reading's noise."""
        return float(np.mean(np.concatenate(list(self.residuals.values())) ** 2))

    def log_evidence(self, ess: Mapping[str, float]) -> float:
        """Log evidence in Laplace's approximation.

        Args:
            ess: channel -> effective sample size; the same for all fits that are compared.
        """
        return self.log_likelihood + self.log_occam(ess)

    def evidence_over(self, other: Fit) -> float:
        """Log evidence over that of another fit, each channel with the larger effective sample size of the two."""
        ess = largest_ess([self, other])
        return self.log_evidence(ess) - other.log_evidence(ess)

    @cached_property
    def log_likelihood(self) -> float:
        """Log likelihood with noise that has a spectrum; see `whittle`."""
        return sum(whittle(r) for r in self.residuals.values())

    def log_occam(self, ess: Mapping[str, float]) -> float:
        """Log Occam factor: prior density at the estimate times posterior volume; `ess` as in `log_evidence`."""
        return self.log_prior - 0.5 * float(np.linalg.slogdet(self.information(ess))[1])

    def information(self, ess: Mapping[str, float]) -> Array:
        """Information matrix (P, P) of the parameters in standard units, prior included; `ess` as in `log_evidence`."""
        information = self.prior.copy()
        for channel, (by, products) in self.products.items():
            weight = ess[channel] / len(self.residuals[channel]) / self.scale[channel] ** 2
            information[np.ix_(by, by)] += weight * products
        return information

    def sd_given(self, name: str, held: Collection[str]) -> float:
        """Standard deviation of an estimate while some other parameters are held at theirs.

        Args:
            name: of the parameter.
            held: names of the others.
        """
        names, information = list(self.values), self.information(self.ess)
        free = [n for n in names if n not in held]
        own = [names.index(n) for n in free]
        given = np.diag(covariance_of(information[np.ix_(own, own)]))[free.index(name)]
        variance = np.diag(covariance_of(information))[names.index(name)]
        return self.sd[name] * math.sqrt(min(float(given / variance), 1.0))


def estimate(values: dict[str, float], sd: dict[str, float]) -> Fit:
    """A fit that was not made by `fit`: estimates and standard deviations alone."""
    return Fit(values, sd, {}, {}, {}, 0.0, {}, np.eye(len(values)))


def largest_ess(fits: Iterable[Fit]) -> dict[str, float]:
    """Channel -> effective sample size for a comparison of fits: that of the whitest residual."""
    ess: dict[str, float] = {}
    for f in fits:
        for channel, n in f.ess.items():
            ess[channel] = max(ess.get(channel, 0.0), n)
    return ess


def whittle(r: Array) -> float:
    """Log likelihood of a residual whose noise has a spectrum of its own (P. Whittle, 1953).

    The noise in each band of frequency is that of the residual itself, but at least that of the readings. A slow misfit
    counts for as many samples as its band holds.

    Args:
        r: (N,) in units of a reading's noise.
    """
    if not len(r):
        return 0.0
    edges = bands(len(r))
    count = np.diff(edges).astype(float)
    power = np.add.reduceat(dct(r, norm="ortho") ** 2, edges[:-1]) / count
    return band_log_likelihood(power, count)


@njit(nogil=True)
def band_log_likelihood(power: Array, count: Array) -> float:
    """Log likelihood of a residual by its bands, the noise of each that of the residual, but at least a reading's.

    Args:
        power: (B,) mean square of the residual in each band, in units of a reading's noise.
        count: (B,) coefficients in each band.
    """
    total = 0.0
    for k in range(len(power)):
        noise = max(power[k], 1.0)
        total -= 0.5 * count[k] * (math.log(noise) + power[k] / noise)
    return total


@cache
def bands(n: int) -> NDArray[np.intp]:
    """Edges (B + 1,) of the bands of the n coefficients of a cosine transform: each half as wide as its frequency."""
    edges = [0]
    while edges[-1] < n:
        edges.append(edges[-1] + max(NARROWEST, edges[-1] // 2))
    edges[-1] = n
    return np.array(edges)


@dataclass(frozen=True)
class Sensitivities:
    """Derivatives of one channel's residual (N,).

    Attributes:
        by: (P,) indices of the parameters that change it.
        rows: (P, N) derivatives.
    """

    by: NDArray[np.intp]
    rows: Array

    def corrected(self, step: Array, change: Array) -> Sensitivities:
        """The derivatives corrected by what a step (all parameters,) changed, (N,), with Broyden's formula."""
        own = step[self.by]
        size = max(float(own @ own), 1e-300)
        return Sensitivities(self.by, self.rows + np.outer(own / size, change - own @ self.rows))

    def of(self, kept: Sequence[int]) -> Sensitivities:
        """The derivatives for some of the parameters, which are numbered anew."""
        place = {j: k for k, j in enumerate(kept)}
        at = [k for k, j in enumerate(self.by) if int(j) in place]
        return Sensitivities(np.array([place[int(self.by[k])] for k in at], np.intp), self.rows[at])


class _Trial(NamedTuple):
    """A point (P,) in standard units with its residuals and its cost."""

    z: Array
    residuals: dict[str, Array]
    cost: float


class Search:
    """A point in the space of the parameters, in standard units, with its residuals and their weights.

    Args:
        residuals: values by name -> residuals in units of a reading's noise.
        parameters: to be fitted.
        least_ess: effective sample size that a channel counts for at least.
    """

    def __init__(self, residuals: Callable[[dict[str, float]], Residuals], parameters: Sequence[Parameter],
                 least_ess: float = 0.0) -> None:
        self.residuals, self.parameters, self.least_ess = residuals, tuple(parameters), least_ess
        self.low = np.array([p.to_standard(p.low) for p in parameters])
        self.high = np.array([p.to_standard(p.high) for p in parameters])
        self.z = np.array([p.to_standard(p.begin) for p in parameters])
        self.z = np.clip(self.z, self.low, self.high)
        self.prior = prior_information(parameters)
        self.current = self.at(self.z)
        self.slopes: dict[str, Sensitivities] = {}
        self.fresh = self.ended = False
        self.renew_weights()

    def at(self, z: Array) -> dict[str, Array]:
        """Residuals at a point z (P,) in standard units."""
        values = {p.name: p.value(x) for p, x in zip(self.parameters, z, strict=True)}
        return {k: finite(np.asarray(r)) for k, r in self.residuals(values).items() if len(r)}

    def renew_weights(self) -> None:
        """Set noise inflation and effective sample size to those of the residuals at this point."""
        self.weight, self.scale, self.ess = weights(self.current, self.least_ess)

    def stack(self, residuals: Residuals) -> Array:
        """Weighted residuals of all channels as one vector."""
        return np.concatenate([self.weight[k] * residuals[k] for k in self.weight] or [np.zeros(0)])

    def jacobian(self) -> dict[str, Sensitivities]:
        """Derivatives of the weighted residuals, by finite differences."""
        return self.weighted(self.differences())

    def weighted(self, slopes: Mapping[str, Sensitivities]) -> dict[str, Sensitivities]:
        """Derivatives of the weighted residuals from those of the residuals."""
        return {k: Sensitivities(s.by, self.weight[k] * s.rows) for k, s in slopes.items()}

    def differences(self, step: float = STEP) -> dict[str, Sensitivities]:
        """Derivatives of the residuals, by finite differences towards the inside of the bounds."""
        moves = np.where(self.z + step > self.high, -step, step)
        return self._differences(self.z + moves, None, moves)

    def slopes_over(self, sd: Array) -> dict[str, Sensitivities]:
        """Slopes of the residuals from one standard deviation below to one above, for each parameter.

        Args:
            sd: (P,) standard deviations in standard units.
        """
        after, before = np.minimum(self.z + sd, self.high), np.maximum(self.z - sd, self.low)
        return self._differences(after, before, after - before)

    def _differences(self, after: Array, before: Array | None, moves: Array) -> dict[str, Sensitivities]:
        """Differences of the residuals over those of each parameter, which is moved alone.

        A parameter that each recording has a value of its own for is moved in all recordings at once.

        Args:
            after: (P,) value of each parameter where it is moved.
            before: (P,) the same, of the residuals that are subtracted; None: those at this point.
            moves: (P,) what each parameter is moved by.
        """
        groups: dict[str, dict[int, int]] = {}
        for j, p in enumerate(self.parameters):
            name = key(p.name)
            groups.setdefault(name.plain, {})[name.recording] = j
        by = {k: [g.get(key(k).recording, g.get(0, -1)) for g in groups.values()] for k in self.weight}
        slopes = {}
        for k, each in by.items():
            own = np.array([j for j in each if j >= 0], int)
            slopes[k] = Sensitivities(own, np.empty((len(own), len(self.current[k]))))
        filled = dict.fromkeys(slopes, 0)
        for at, group in enumerate(groups.values()):
            moved, still = self._with(group, after), self.current if before is None else self._with(group, before)
            for k, s in slopes.items():
                if (j := by[k][at]) >= 0:
                    s.rows[filled[k]] = (moved[k] - still[k]) / moves[j]
                    filled[k] += 1
        return slopes

    def _with(self, group: Mapping[int, int], values: Array) -> dict[str, Array]:
        """Residuals with some parameters at other values."""
        z, own = self.z.copy(), list(group.values())
        z[own] = values[own]
        return self.at(z)

    def stacked(self, slopes: Mapping[str, Sensitivities]) -> Array:
        """The derivatives of all channels as one matrix, one row a parameter."""
        out, at = np.zeros((len(self.z), sum(s.rows.shape[1] for s in slopes.values()))), 0
        for s in slopes.values():
            out[s.by, at:at + s.rows.shape[1]] = s.rows
            at += s.rows.shape[1]
        return out

    def normal_equations(self, slopes: Mapping[str, Sensitivities]) -> tuple[Array, Array, Products]:
        """Information matrix (P, P) and gradient (P,) of half the cost, prior included; and what `Fit` keeps."""
        information, gradient = self.prior.copy(), self.prior @ self.z
        products: dict[str, tuple[NDArray[np.intp], Array]] = {}
        for k, s in slopes.items():
            of_all = s.rows @ s.rows.T
            information[np.ix_(s.by, s.by)] += of_all
            gradient[s.by] += s.rows @ (self.weight[k] * self.current[k])
            products[k] = (s.by, of_all / self.weight[k] ** 2)
        return information, gradient, products

    def step(self, damped: Array, gradient: Array) -> Array:
        """The step (P,) to the minimum of a damped quadratic model within the bounds.

        A parameter that is pushed against its bound stays, one that would cross it ends there. The step of the others
        is the best one with that: a step that is computed without bounds and then clipped is wrong for all others.

        Args:
            damped: information matrix (P, P) with damping.
            gradient: (P,) of half the cost.
        """
        free = ~((self.z <= self.low) & (gradient > 0.0) | (self.z >= self.high) & (gradient < 0.0))
        step = np.zeros(len(self.z))
        while free.any():
            held = ~free
            step[free] = np.linalg.solve(damped[np.ix_(free, free)],
                                         -gradient[free] - damped[np.ix_(free, held)] @ step[held])
            inside = np.clip(self.z + step, self.low, self.high) - self.z
            crossed = free & (inside != step)
            if not crossed.any():
                break
            step[crossed] = inside[crossed]
            free &= ~crossed
        return step

    def bent(self, step: Array, damped: Array) -> Array:
        """A step with geodesic acceleration, which follows a curved valley.

        The second derivative of the residuals along the step adds half of what it changes (M. Transtrum and J. Sethna,
        Improvements to the Levenberg-Marquardt algorithm, arXiv:1201.5885, 2012).

        Args:
            step: (P,) the straight one.
            damped: information matrix (P, P) with damping.
        """
        near, far = self.at(self.z + 0.5 * ALONG * step), self.at(self.z + ALONG * step)
        bend = np.zeros(len(step))
        for k, s in self.slopes.items():
            second = (self.current[k] - 2.0 * near[k] + far[k]) / (0.5 * ALONG)**2
            bend[s.by] += self.weight[k]**2 * s.rows @ second
        moved = step != 0.0
        out = step.copy()
        out[moved] -= 0.5 * np.linalg.solve(damped[np.ix_(moved, moved)], bend[moved])
        return out

    def _tried(self, step: Array) -> _Trial:
        """The point after a step, its residuals and its cost."""
        z = np.clip(self.z + step, self.low, self.high)
        residuals = self.at(z)
        r = self.stack(residuals)
        return _Trial(z, residuals, float(r @ r + z @ self.prior @ z))

    def improve(self, steps: int, deadline: float | None = None, *, first_look: bool = False
                ) -> tuple[Array, Products]:
        """Take Levenberg-Marquardt steps with the weights as they are.

        Args:
            steps: at most.
            deadline: after it, only one; see `passed`.
            first_look: see `fit`.

        Returns:
            Information matrix and products of the last `normal_equations`.
        """
        damping = DAMPING
        information, products = self.prior, Products()
        for done in range(steps):
            if done and passed(deadline):
                break
            if not self.slopes:
                self.slopes, self.fresh = self.differences(), True
            r = self.stack(self.current)
            information, gradient, products = self.normal_equations(self.weighted(self.slopes))
            cost = float(r @ r + self.z @ self.prior @ self.z)
            enough = ENOUGH + ENOUGH_OF_EXCESS * max(cost - sum(self.ess.values()), 0.0)
            gained, straight, bent = 0.0, True, False
            while damping < MOST_DAMPING:
                damped = information + damping * np.diag(np.diag(information))
                step = self.step(damped, gradient)
                trial = self._tried(step)
                expected = -float(step @ (2.0 * gradient + information @ step))
                straight = cost - trial.cost >= GOOD_STEP * expected
                bent = self.fresh and not straight and expected > enough
                if bent:
                    trial = min(trial, self._tried(self.bent(step, damped)), key=lambda one: one.cost)
                if trial.cost < cost:
                    gained, moved = cost - trial.cost, trial.z - self.z
                    self.slopes = {k: s.corrected(moved, trial.residuals[k] - self.current[k])
                                   for k, s in self.slopes.items()}
                    self.z, self.current = trial.z, trial.residuals
                    damping *= DAMPING_DOWN
                    break
                if not self.fresh:
                    break
                damping *= DAMPING_UP
            ended = gained < enough
            self.ended = ended and (self.fresh or first_look) and not bent
            if self.ended:
                break
            self.fresh = False
            if ended or not straight:
                self.slopes = {}
        return information, products


def weights(residuals: Residuals, least_ess: float = 0.0
            ) -> tuple[dict[str, float], dict[str, float], dict[str, float]]:
    """Weight of each channel in the cost, its noise inflation, and its effective sample size.

    Args:
        residuals: channel -> (N,) in units of a reading's noise.
        least_ess: effective sample size that a channel counts for at least.
    """
    scale = {k: max(1.0, float(np.sqrt(np.mean(r * r)))) for k, r in residuals.items()}
    ess = {k: effective_sample_size(r) for k, r in residuals.items()}
    return {k: np.sqrt(min(max(ess[k], least_ess) / len(r), 1.0)) / scale[k] for k, r in residuals.items()}, scale, ess


def prior_information(parameters: Sequence[Parameter]) -> Array:
    """Information matrix (P, P) of the prior in standard units: the inverse of the correlations.

    Two parameters are correlated if both state it: one that replaces another is not.
    """
    at = {p.name: j for j, p in enumerate(parameters)}
    stated = {(at[p.name], at[other]): value for p in parameters for other, value in p.correlation if other in at}
    correlations = np.eye(len(parameters))
    for (j, k), value in stated.items():
        if k < j and (k, j) in stated:
            correlations[j, k] = correlations[k, j] = value
    return np.asarray(np.linalg.inv(correlations))


def fit(residuals: Callable[[dict[str, float]], Residuals], parameters: Sequence[Parameter],
        rounds: int = 10, steps: int = 4, least_ess: float = 0.0, deadline: float | None = None, *,
        first_look: bool = False) -> Fit:
    """MAP fit with the noise inflated to the residual; see the module.

    Args:
        residuals: values by name -> residuals in units of a reading's noise.
        parameters: to be fitted.
        rounds: how often the weights are renewed at most.
        steps: Levenberg-Marquardt steps in each round.
        least_ess: effective sample size that a channel counts for at least during the search. A slow drift has a small
            one; with wide priors the search would then stay near their means.
        deadline: after it, the fit ends with its next step; see `passed`.
        first_look: the fit may end with derivatives that are corrected, where others would gain more. It is good enough
            to choose what is fitted on.
    """
    search = Search(residuals, parameters, least_ess)
    information, products = search.prior, Products()
    for done in range(rounds):
        if done and passed(deadline):
            break
        information, products = search.improve(steps, deadline, first_look=first_look)
        before, ended = search.weight, search.ended
        search.renew_weights()
        changed = sum(abs(search.weight[k] - before[k]) >= WEIGHT_CHANGE * before[k] for k in before)
        if ended and changed <= MAY_CHANGE * len(before):
            break
    z, covariance = search.z, covariance_of(information)
    values = {p.name: p.value(x) for p, x in zip(parameters, z, strict=True)}
    sd = {p.name: abs(p.slope(x)) * float(np.sqrt(v)) for p, x, v in zip(parameters, z, np.diag(covariance),
                                                                         strict=True)}
    log_prior = 0.5 * float(np.linalg.slogdet(search.prior)[1] - z @ search.prior @ z)
    return Fit(values, sd, search.current, search.scale, search.ess, log_prior, products, search.prior)


def fit_again(residuals: Callable[[dict[str, float]], Residuals], parameters: Sequence[Parameter],
              start: Mapping[str, float], base: Fit | None = None) -> Fit:
    """Fit from given values, and also from those of a fit with fewer parameters if it ends worse than that one.

    What is gone may have led the values into a local minimum.

    Args:
        residuals: as in `fit`.
        parameters: as in `fit`.
        start: values to start from.
        base: the fit with fewer parameters; None: it is not asked.
    """
    f = fit(residuals, started(parameters, start))
    if base is None or not f.residuals or f.mean_square <= POORER * base.mean_square:
        return f
    return min(f, fit(residuals, started(parameters, {**start, **base.values})), key=lambda one: one.mean_square)


def with_posterior_slopes(residuals: Callable[[dict[str, float]], Residuals], parameters: Sequence[Parameter], f: Fit
                          ) -> Fit:
    """A fit whose information is that of slopes over the posterior, from one standard deviation below to one above.

    An arm that sticks gives residuals with kinks: a derivative at one point then misses the width of the posterior by
    a factor of up to three, and the log evidence by as many nats.

    Args:
        residuals: values by name -> residuals in units of a reading's noise.
        parameters: that were fitted.
        f: the fit.
    """
    search = Search(residuals, started(parameters, f.values))
    sd = np.array([f.sd[p.name] / abs(p.slope(z)) for p, z in zip(parameters, search.z, strict=True)])
    slopes = search.slopes_over(np.maximum(sd, STEP))
    return replace(f, products={k: (s.by, s.rows @ s.rows.T) for k, s in slopes.items()})


def covariance_of(information: Array) -> Array:
    """Covariance (P, P) of estimates from their information matrix.

    Rows of very different sizes are scaled to a diagonal of 1. An inverse of such a matrix has a diagonal of 1 or more;
    one below, or below 0, is of rounding.
    """
    d = 1.0 / np.sqrt(np.diag(information))
    inverse = np.linalg.inv(d[:, None] * information * d)
    inverse[np.diag_indices_from(inverse)] = np.maximum(np.diag(inverse), 1.0)
    return np.asarray(d[:, None] * inverse * d)


def passed(deadline: float | None) -> bool:
    """Whether it is later than an instant [s] of `time.monotonic`; never if there is none."""
    return deadline is not None and time.monotonic() > deadline


def finite(r: Array, largest: float = LARGEST) -> Array:
    """Residuals of any shape, or their slopes, of which each is at most so large, also where a simulation diverges."""
    with np.errstate(over="ignore"):
        if np.vdot(r, r) <= largest**2:  # in one pass
            return r
    return r if np.abs(r).max() <= largest else np.clip(np.nan_to_num(r, nan=largest), -largest, largest)


def sensitivities(residuals: Callable[[dict[str, float]], Residuals], parameters: Sequence[Parameter]
                  ) -> dict[str, Sensitivities]:
    """Channel -> derivatives of the residuals with respect to the parameters in standard units, where these start."""
    return Search(residuals, parameters, math.inf).differences()


def within_bounds(residuals: Callable[[dict[str, float]], Residuals], parameters: Sequence[Parameter],
                  slopes: Mapping[str, Sensitivities], steps: int) -> dict[str, float]:
    """The values with the smallest sum of squares within the bounds, whatever the priors.

    Gauss-Newton steps, each solved exactly for the bounds (P. Stark, R. Parker: Bounded-variable least squares. 1995),
    with derivatives that are corrected by Broyden's formula.

    Args:
        residuals: values by name -> residuals; all count alike.
        parameters: to be fitted, from their starts.
        slopes: of `sensitivities`, at a point nearby.
        steps: at most.
    """
    search = Search(residuals, parameters, math.inf)
    search.slopes = dict(slopes)
    for _ in range(steps):
        r = search.stack(search.current)
        cost = float(r @ r)
        rows = search.stacked(search.weighted(search.slopes))
        information, gradient = rows @ rows.T, rows @ r
        ridge = RIDGE * np.trace(information) / len(information) * np.eye(len(information))
        new = cost
        for damping in DAMPINGS:
            root = np.linalg.cholesky(information + damping * np.diag(np.diag(information)) + ridge)
            room = (np.minimum(search.low - search.z, -RIDGE), np.maximum(search.high - search.z, RIDGE))
            step = lsq_linear(root.T, -np.linalg.solve(root, gradient), room, method="bvls").x
            z = np.clip(search.z + step, search.low, search.high)
            trial = search.at(z)
            r = search.stack(trial)
            new = float(r @ r)
            if new < cost:
                search.slopes = {k: s.corrected(z - search.z, trial[k] - search.current[k])
                                 for k, s in search.slopes.items()}
                search.z, search.current = z, trial
                break
        if not new < (1.0 - NEGLIGIBLE) * cost:
            break
    return {p.name: p.value(x) for p, x in zip(parameters, search.z, strict=True)}


class Screened(NamedTuple):
    """What an addition would do if the model were linear.

    Attributes:
        left: share of the weighted sum of squares that it would leave; 1 where it changes nothing.
        values: name -> value of all parameters there.
    """

    left: float
    values: dict[str, float]


def screen(residuals: Callable[[dict[str, float]], Residuals], base: Fit, known: Sequence[Parameter],
           additions: Sequence[Sequence[Parameter]], least_ess: float = 0.0) -> list[Screened]:
    """What each addition would do if the model were linear: one least-squares solve each.

    Args:
        residuals: as for `fit`.
        base: the fit without additions.
        known: its parameters.
        additions: groups of parameters, each tried at its starts; the first is a size, 0 effect at its mean.
        least_ess: as for `fit`.
    """
    search = Search(residuals, started(known, base.values), least_ess)
    r = search.stack(search.current)
    slopes = search.jacobian()
    information, gradient, _ = search.normal_equations(slopes)
    cost = float(r @ r + search.z @ search.prior @ search.z)
    left = []
    for group in additions:
        values = {**base.values, **{p.name: p.begin for p in group}}
        changed = {k: finite(np.asarray(x)) for k, x in residuals(values).items() if len(x)}
        column = search.stack({k: changed[k] for k in search.weight}) - r
        power = float(column @ column)
        if not np.isfinite(power) or power == 0.0:
            left.append(Screened(1.0, values))
            continue
        cross, at = np.zeros(len(search.z)), 0
        for s in slopes.values():
            cross[s.by] += s.rows @ column[at:at + s.rows.shape[1]]
            at += s.rows.shape[1]
        # a little ridge keeps the matrix regular where a known parameter does the same
        bordered = np.block([[information, cross[:, None]], [cross, (1.0 + 1e-9) * power]])
        right = np.append(gradient, column @ r)
        solved = np.linalg.solve(bordered, right)
        moved = np.clip(search.z - solved[:-1], search.low, search.high)
        size, *_ = group
        there = min(max(size.mean - float(solved[-1]) * (size.begin - size.mean), size.low), size.high)
        left.append(Screened(max(cost - float(right @ solved), 0.0) / max(cost, 1e-300),
                             {**values, **{p.name: p.value(x) for p, x in zip(known, moved, strict=True)},
                              size.name: there}))
    return left
