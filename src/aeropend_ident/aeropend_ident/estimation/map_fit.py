# SPDX-License-Identifier: Apache-2.0
"""Fit a hypothesis to a block of channels, numbers and effects together, and weigh it against others.

Every number of the model carries a prior, so that it cannot wander off to cover for a missing effect. A residual that
is larger than the noise or coloured counts for less: the standard deviation is inflated to what is seen and the samples
are thinned to as many as are independent. So a wrong hypothesis cannot buy a precise fit with absurd numbers, and the
right one, whose residual is white and as small as the noise, is weighed in full.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

Array = NDArray[np.float64]
Residuals = Mapping[str, Array]
"""Channel -> residual in units of its standard deviation, missing samples left out."""
Products = dict[str, tuple[NDArray[np.intp], Array]]
"""Channel -> the unknowns (U,) that change it, and their slopes' products (U, U), summed over its samples."""

STRAGGLERS = 0.1
"""Share of the channels whose weights may still change when a fit ends: of many recordings there is always one."""


@dataclass(frozen=True)
class Unknown:
    """A number to be fitted.

    Attributes:
        name: of the number; `x@k` is the x of the channels that end in `@k`.
        mean, sd: of its prior, which is normal, or log-normal if `log` (then sd is that of the logarithm and mean, low
            and high are positive).
        low, high: bounds. start: where the search starts; the mean by default.
    """

    name: str
    mean: float
    sd: float
    low: float = -np.inf
    high: float = np.inf
    start: float | None = None
    log: bool = False

    def to_standard(self, value: float) -> float:
        """The value as a standard normal number."""
        if self.log:
            return (np.log(value) - np.log(self.mean)) / self.sd if value > 0.0 else -np.inf
        return (value - self.mean) / self.sd

    def value(self, z: float) -> float:
        """The inverse of `to_standard`."""
        return float(self.mean * np.exp(self.sd * z)) if self.log else float(self.mean + self.sd * z)

    def slope(self, z: float) -> float:
        """D value / d z."""
        return self.value(z) * self.sd if self.log else self.sd


@dataclass(frozen=True)
class Fit:
    """A fitted hypothesis.

    Attributes:
        values: name -> estimate.
        sd: name -> standard deviation.
        residuals: channel -> (N,) in units of the noise, at the estimate.
        scale: channel -> RMS of the residual, at least 1.
        independent: channel -> number of independent samples.
        prior: log density of the estimate under the prior.
        slopes: products of the slopes of each channel.
    """

    values: dict[str, float]
    sd: dict[str, float]
    residuals: dict[str, Array]
    scale: dict[str, float]
    independent: dict[str, float]
    prior: float
    slopes: Products

    @property
    def mean_square(self) -> float:
        """Mean square residual over all channels, in units of a reading's noise."""
        return float(np.mean(np.concatenate(list(self.residuals.values())) ** 2))

    def evidence(self, independent: Mapping[str, float]) -> float:
        """Log evidence of the hypothesis when a channel counts as so many independent samples."""
        return self.likelihood(independent) + self.simplicity(independent)

    def likelihood(self, independent: Mapping[str, float]) -> float:
        """What of the evidence is the misfit."""
        total = 0.0
        for channel, r in self.residuals.items():
            s2 = self.scale[channel] ** 2
            total -= 0.5 * independent[channel] * (np.log(s2) + float(np.mean(r * r)) / s2)
        return total

    def simplicity(self, independent: Mapping[str, float]) -> float:
        """What of it is the prior, less what the data's precision costs (Laplace)."""
        information = np.eye(len(self.values))
        for channel, (by, products) in self.slopes.items():
            weight = independent[channel] / len(self.residuals[channel]) / self.scale[channel] ** 2
            information[np.ix_(by, by)] += weight * products
        return self.prior - 0.5 * float(np.linalg.slogdet(information)[1])


def independent_samples(r: Array, power: int = 1) -> float:
    """How many independent samples a residual (N,) is worth: N over its integrated autocorrelation time.

    Args:
        r: the residual. power: 2 asks it of the mean square, whose scatter autocorrelations of either sign widen alike,
            those of a narrow band included.
    """
    n = len(r)
    if n < 16:
        return float(n)
    size = next_fast_len(2 * n, real=True)
    correlation = irfft(np.abs(rfft(r, size)) ** 2, size)[: n // 4]
    if correlation[0] <= 0.0:
        return float(n)
    correlation = correlation / correlation[0]
    running = 1.0 + 2.0 * np.cumsum(correlation[1:] ** power)
    # Sokal's window: stop where the lag exceeds five times the time found so far
    lags = np.arange(1, len(correlation))
    stop = np.flatnonzero(lags >= 5.0 * running)
    time = running[stop[0]] if len(stop) else running[-1]
    return float(n / max(time, 1.0))


class Slopes:
    """Derivatives of one channel's residual (N,): `by`: the unknowns that change it; `rows`: (len(by), N)."""

    def __init__(self, by: NDArray[np.intp], n: int) -> None:
        self.by, self.rows = by, np.empty((len(by), n))


class Search:
    """A point in the space of the unknowns, in standard units, with its residuals and their weights."""

    def __init__(self, residuals: Callable[[dict[str, float]], Residuals], unknowns: Sequence[Unknown],
                 least: float = 0.0) -> None:
        self.residuals, self.unknowns, self.least = residuals, tuple(unknowns), least
        self.low = np.array([u.to_standard(u.low) for u in unknowns])
        self.high = np.array([u.to_standard(u.high) for u in unknowns])
        self.z = np.array([u.to_standard(u.mean if u.start is None else u.start) for u in unknowns])
        self.z = np.clip(self.z, self.low, self.high)
        self.current = self.at(self.z)
        self.renew_weights()

    def at(self, z: Array) -> dict[str, Array]:
        """Residuals at a point in standard units."""
        values = {u.name: u.value(x) for u, x in zip(self.unknowns, z, strict=True)}
        return {k: np.asarray(r) for k, r in self.residuals(values).items() if len(r)}

    def renew_weights(self) -> None:
        """Inflate the noise and thin the samples to what the residuals at this point show."""
        self.scale = {k: max(1.0, float(np.sqrt(np.mean(r * r)))) for k, r in self.current.items()}
        self.independent = {k: independent_samples(r) for k, r in self.current.items()}
        self.weight = {k: np.sqrt(min(max(self.independent[k], self.least) / len(r), 1.0)) / self.scale[k]
                       for k, r in self.current.items()}

    def stack(self, residuals: Residuals) -> Array:
        """Weighted residuals of all channels as one vector."""
        return np.concatenate([self.weight[k] * residuals[k] for k in self.weight] or [np.zeros(0)])

    def jacobian(self, step: float = 1e-4) -> dict[str, Slopes]:
        """Derivatives of the weighted residuals, by differences towards the inside of the bounds.

        What each of several recordings has its own of is moved in all of them at once.
        """
        moves = np.where(self.z + step > self.high, -step, step)
        groups: dict[str, dict[str, int]] = {}
        for j, u in enumerate(self.unknowns):
            name, _, recording = u.name.partition("@")
            groups.setdefault(name, {})[recording] = j
        by = {k: [g.get(k.partition("@")[2], g.get("", -1)) for g in groups.values()] for k in self.weight}
        slopes = {k: Slopes(np.array([j for j in by[k] if j >= 0], int), len(self.current[k])) for k in self.weight}
        filled = dict.fromkeys(slopes, 0)
        for at, group in enumerate(groups.values()):
            z = self.z.copy()
            z[list(group.values())] += moves[list(group.values())]
            moved = self.at(z)
            for k, s in slopes.items():
                if (j := by[k][at]) >= 0:
                    s.rows[filled[k]] = (self.weight[k] * moved[k] - self.weight[k] * self.current[k]) / moves[j]
                    filled[k] += 1
        return slopes

    def stacked(self, slopes: Mapping[str, Slopes]) -> Array:
        """The slopes of all channels as one matrix, one row an unknown."""
        out, at = np.zeros((len(self.z), sum(s.rows.shape[1] for s in slopes.values()))), 0
        for s in slopes.values():
            out[s.by, at:at + s.rows.shape[1]] = s.rows
            at += s.rows.shape[1]
        return out

    def normal(self, slopes: Mapping[str, Slopes]) -> tuple[Array, Array, Products]:
        """The information matrix and the gradient of half the cost, prior included; and what `Fit.slopes` keeps."""
        information, gradient = np.eye(len(self.z)), self.z.copy()
        products: dict[str, tuple[NDArray[np.intp], Array]] = {}
        for k, s in slopes.items():
            of_all = s.rows @ s.rows.T
            information[np.ix_(s.by, s.by)] += of_all
            gradient[s.by] += s.rows @ (self.weight[k] * self.current[k])
            products[k] = (s.by, of_all / self.weight[k] ** 2)
        return information, gradient, products

    def improve(self, steps: int) -> tuple[Array, Products]:
        """Levenberg-Marquardt steps with the weights as they are; returns the last `normal` but for its gradient."""
        damping = 1e-3
        information, products = np.eye(len(self.z)), Products()
        for _ in range(steps):
            r = self.stack(self.current)
            information, gradient, products = self.normal(self.jacobian())
            cost = float(r @ r + self.z @ self.z)
            gained = 0.0
            while damping < 1e6:
                step = np.linalg.solve(information + damping * np.diag(np.diag(information)), -gradient)
                z = np.clip(self.z + step, self.low, self.high)
                trial = self.at(z)
                r = self.stack(trial)
                new = float(r @ r + z @ z)
                if np.isfinite(new) and new < cost:
                    gained = cost - new
                    self.z, self.current = z, trial
                    damping *= 0.2
                    break
                damping *= 8.0
            if gained < 1e-2 + 1e-4 * max(cost - sum(self.independent.values()), 0.0):
                break
        return information, products


def fit(residuals: Callable[[dict[str, float]], Residuals], unknowns: Sequence[Unknown],
        rounds: int = 10, steps: int = 4, least: float = 0.0) -> Fit:
    """Maximum a posteriori fit with the noise inflated to what the residual shows.

    Args:
        residuals: values by name -> residuals in units of the noise.
        unknowns: what is fitted.
        rounds: how often the weights are renewed at most; steps: Levenberg-Marquardt steps in each.
        least: samples that a channel counts for at least while the search goes on. A slow drift, which is worth a few,
            would not pull numbers and sizes from where a wide prior has its middle.
    """
    search = Search(residuals, unknowns, least)
    information, products = np.eye(len(search.z)), Products()
    for _ in range(rounds):
        information, products = search.improve(steps)
        before = search.weight
        search.renew_weights()
        if sum(abs(search.weight[k] - before[k]) >= 0.02 * before[k] for k in before) <= STRAGGLERS * len(before):
            break
    z, covariance = search.z, np.linalg.inv(information)
    values = {u.name: u.value(x) for u, x in zip(unknowns, z, strict=True)}
    sd = {u.name: abs(u.slope(x)) * float(np.sqrt(v)) for u, x, v in zip(unknowns, z, np.diag(covariance), strict=True)}
    return Fit(values, sd, search.current, search.scale, search.independent, -0.5 * float(z @ z), products)


def screen(residuals: Callable[[dict[str, float]], Residuals], base: Fit, known: Sequence[Unknown],
           additions: Sequence[Sequence[Unknown]]) -> list[float]:
    """How much of the misfit each addition would take away if everything were linear, by one least-squares solve each.

    Args:
        residuals: as for `fit`.
        base: the fit without additions, over `known`.
        known: its unknowns.
        additions: groups of unknowns, each tried at its starts.

    Returns:
        Share of the weighted sum of squares that is left, one an addition; 1 where nothing changes.
    """
    search = Search(residuals, [replace(u, start=base.values[u.name]) for u in known])
    r = search.stack(search.current)
    slopes = search.jacobian()
    information, gradient, _ = search.normal(slopes)
    cost = float(r @ r + search.z @ search.z)
    left = []
    for group in additions:
        values = {**base.values, **{u.name: u.mean if u.start is None else u.start for u in group}}
        changed = {k: np.asarray(x) for k, x in residuals(values).items() if len(x)}
        column = search.stack({k: changed[k] for k in search.weight}) - r
        size = float(column @ column)
        if not np.isfinite(size) or size == 0.0:
            left.append(1.0)
            continue
        cross, at = np.zeros(len(search.z)), 0
        for s in slopes.values():
            cross[s.by] += s.rows @ column[at:at + s.rows.shape[1]]
            at += s.rows.shape[1]
        bordered = np.block([[information, cross[:, None]], [cross, (1.0 + 1e-9) * size]])
        right = np.append(gradient, column @ r)
        left.append(max(cost - float(right @ np.linalg.solve(bordered, right)), 0.0) / max(cost, 1e-300))
    return left
