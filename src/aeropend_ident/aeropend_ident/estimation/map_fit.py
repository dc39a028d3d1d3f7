# SPDX-License-Identifier: Apache-2.0
"""Maximum a posteriori (MAP) fit of a model to channels of residuals, and its log evidence.

With residuals r_c (in units of a reading's noise) of channels c, and parameters z in standard units, the fit minimises

    sum_c  (ess_c / n_c) * sum(r_c ** 2) / s_c ** 2  +  sum(z ** 2)

- s_c >= 1 inflates the noise to the RMS of the residual: a model that does not fit cannot claim a precise fit.
- ess_c <= n_c is the effective sample size: a coloured residual holds less information than its samples.
- The prior (z standard normal) keeps parameters from moving far to stand in for a missing effect.

Both weights are renewed as the fit goes on. Fits are compared by their log evidence in Laplace's approximation: log
likelihood plus log Occam factor, the prior density times the posterior volume (D. MacKay, Information Theory,
Inference, and Learning Algorithms, 2003, chapter 28).

The steps are Levenberg-Marquardt's. `scipy.optimize.least_squares` with the same residuals, Jacobian and weights ends
at the same cost and takes 2.5 to 3 times the CPU time (`make bench ARGS="--only optimiser"`): it restarts whenever
the weights are renewed, and solves for the bounds more exactly than is needed here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.estimation.parameter import Parameter, key, started
from aeropend_ident.signals.statistics import effective_sample_size

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

STEP = 1e-4
"""Step of the finite differences, in standard deviations of the prior.

Choice: well above rounding, well below curvature."""

DAMPING, DAMPING_DOWN, DAMPING_UP, MOST_DAMPING = 1e-3, 0.2, 8.0, 1e6
"""Levenberg-Marquardt damping: first value, factors after a step that succeeds and one that fails, and where it ends.

Choice; any factors from 0.1 and 10 on lead to the same minimum."""

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
    """

    values: dict[str, float]
    sd: dict[str, float]
    residuals: dict[str, Array]
    scale: dict[str, float]
    ess: dict[str, float]
    log_prior: float
    products: Products

    @property
    def mean_square(self) -> float:
        """Mean square residual over all channels, in units of a reading's noise."""
        return float(np.mean(np.concatenate(list(self.residuals.values())) ** 2))

    def log_evidence(self, ess: Mapping[str, float]) -> float:
        """Log evidence in Laplace's approximation.

        Args:
            ess: channel -> effective sample size; the same for all fits that are compared.
        """
        return self.log_likelihood(ess) + self.log_occam(ess)

    def log_likelihood(self, ess: Mapping[str, float]) -> float:
        """Log likelihood, normal with the inflated noise; `ess` as in `log_evidence`."""
        total = 0.0
        for channel, r in self.residuals.items():
            s2 = self.scale[channel] ** 2
            total -= 0.5 * ess[channel] * (np.log(s2) + float(np.mean(r * r)) / s2)
        return total

    def log_occam(self, ess: Mapping[str, float]) -> float:
        """Log Occam factor: prior density at the estimate times posterior volume; `ess` as in `log_evidence`."""
        return self.log_prior - 0.5 * float(np.linalg.slogdet(self.information(ess))[1])

    def information(self, ess: Mapping[str, float]) -> Array:
        """Information matrix (P, P) of the parameters in standard units, prior included; `ess` as in `log_evidence`."""
        information = np.eye(len(self.values))
        for channel, (by, products) in self.products.items():
            weight = ess[channel] / len(self.residuals[channel]) / self.scale[channel] ** 2
            information[np.ix_(by, by)] += weight * products
        return information


def estimate(values: dict[str, float], sd: dict[str, float]) -> Fit:
    """A fit that was not made by `fit`: estimates and standard deviations alone."""
    return Fit(values, sd, {}, {}, {}, 0.0, {})


def largest_ess(fits: Iterable[Fit]) -> dict[str, float]:
    """Channel -> effective sample size for a comparison of fits: that of the whitest residual."""
    ess: dict[str, float] = {}
    for f in fits:
        for channel, n in f.ess.items():
            ess[channel] = max(ess.get(channel, 0.0), n)
    return ess


class Sensitivities:
    """Derivatives of one channel's residual (N,).

    Attributes:
        by: (P,) indices of the parameters that change it.
        rows: (P, N) derivatives.
    """

    def __init__(self, by: NDArray[np.intp], n: int) -> None:
        self.by, self.rows = by, np.empty((len(by), n))


class Search:
    """A point in the space of the parameters, in standard units, with its residuals and their weights.

    Args:
        residuals: values by name -> residuals in units of a reading's noise.
        parameters: to be fitted.
        least_ess: effective sample size that a channel counts for at least.
        holds: whether a parameter that is pushed against its bound is left out of a step.
    """

    def __init__(self, residuals: Callable[[dict[str, float]], Residuals], parameters: Sequence[Parameter],
                 least_ess: float = 0.0, *, holds: bool = False) -> None:
        self.residuals, self.parameters, self.least_ess = residuals, tuple(parameters), least_ess
        self.holds = holds
        self.low = np.array([p.to_standard(p.low) for p in parameters])
        self.high = np.array([p.to_standard(p.high) for p in parameters])
        self.z = np.array([p.to_standard(p.begin) for p in parameters])
        self.z = np.clip(self.z, self.low, self.high)
        self.current = self.at(self.z)
        self.renew_weights()

    def at(self, z: Array) -> dict[str, Array]:
        """Residuals at a point z (P,) in standard units."""
        values = {p.name: p.value(x) for p, x in zip(self.parameters, z, strict=True)}
        return {k: np.asarray(r) for k, r in self.residuals(values).items() if len(r)}

    def renew_weights(self) -> None:
        """Set noise inflation and effective sample size to those of the residuals at this point."""
        self.scale = {k: max(1.0, float(np.sqrt(np.mean(r * r)))) for k, r in self.current.items()}
        self.ess = {k: effective_sample_size(r) for k, r in self.current.items()}
        self.weight = {k: np.sqrt(min(max(self.ess[k], self.least_ess) / len(r), 1.0)) / self.scale[k]
                       for k, r in self.current.items()}

    def stack(self, residuals: Residuals) -> Array:
        """Weighted residuals of all channels as one vector."""
        return np.concatenate([self.weight[k] * residuals[k] for k in self.weight] or [np.zeros(0)])

    def jacobian(self, step: float = STEP) -> dict[str, Sensitivities]:
        """Derivatives of the weighted residuals, by finite differences towards the inside of the bounds.

        A parameter that each recording has a value of its own for is moved in all recordings at once.
        """
        moves = np.where(self.z + step > self.high, -step, step)
        groups: dict[str, dict[int, int]] = {}
        for j, p in enumerate(self.parameters):
            name = key(p.name)
            groups.setdefault(name.plain, {})[name.recording] = j
        by = {k: [g.get(key(k).recording, g.get(0, -1)) for g in groups.values()] for k in self.weight}
        slopes = {k: Sensitivities(np.array([j for j in by[k] if j >= 0], int), len(self.current[k]))
                  for k in self.weight}
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

    def stacked(self, slopes: Mapping[str, Sensitivities]) -> Array:
        """The derivatives of all channels as one matrix, one row a parameter."""
        out, at = np.zeros((len(self.z), sum(s.rows.shape[1] for s in slopes.values()))), 0
        for s in slopes.values():
            out[s.by, at:at + s.rows.shape[1]] = s.rows
            at += s.rows.shape[1]
        return out

    def normal_equations(self, slopes: Mapping[str, Sensitivities]) -> tuple[Array, Array, Products]:
        """Information matrix (P, P) and gradient (P,) of half the cost, prior included; and what `Fit` keeps."""
        information, gradient = np.eye(len(self.z)), self.z.copy()
        products: dict[str, tuple[NDArray[np.intp], Array]] = {}
        for k, s in slopes.items():
            of_all = s.rows @ s.rows.T
            information[np.ix_(s.by, s.by)] += of_all
            gradient[s.by] += s.rows @ (self.weight[k] * self.current[k])
            products[k] = (s.by, of_all / self.weight[k] ** 2)
        return information, gradient, products

    def free(self, z: Array, gradient: Array) -> NDArray[np.bool_]:
        """Which parameters (P,) may move; with `holds`, not one that is pushed against its bound.

        A step that is computed with its move and then clipped is wrong for all others.
        """
        pushed = ((z <= self.low) & (gradient > 0.0)) | ((z >= self.high) & (gradient < 0.0))
        return ~pushed if self.holds else np.ones(len(z), dtype=bool)

    def improve(self, steps: int) -> tuple[Array, Products]:
        """Take Levenberg-Marquardt steps with the weights as they are.

        Args:
            steps: at most.

        Returns:
            Information matrix and products of the last `normal_equations`.
        """
        damping = DAMPING
        information, products = np.eye(len(self.z)), Products()
        for _ in range(steps):
            r = self.stack(self.current)
            information, gradient, products = self.normal_equations(self.jacobian())
            cost = float(r @ r + self.z @ self.z)
            gained = 0.0
            free = self.free(self.z, gradient)
            step = np.zeros(len(self.z))
            reduced = information[np.ix_(free, free)]
            while damping < MOST_DAMPING:
                step[free] = np.linalg.solve(reduced + damping * np.diag(np.diag(reduced)), -gradient[free])
                z = np.clip(self.z + step, self.low, self.high)
                trial = self.at(z)
                r = self.stack(trial)
                new = float(r @ r + z @ z)
                if np.isfinite(new) and new < cost:
                    gained = cost - new
                    self.z, self.current = z, trial
                    damping *= DAMPING_DOWN
                    break
                damping *= DAMPING_UP
            if gained < ENOUGH + ENOUGH_OF_EXCESS * max(cost - sum(self.ess.values()), 0.0):
                break
        return information, products


def fit(residuals: Callable[[dict[str, float]], Residuals], parameters: Sequence[Parameter],
        rounds: int = 10, steps: int = 4, least_ess: float = 0.0, *, holds: bool = False) -> Fit:
    """MAP fit with the noise inflated to the residual; see the module.

    Args:
        residuals: values by name -> residuals in units of a reading's noise.
        parameters: to be fitted.
        rounds: how often the weights are renewed at most.
        steps: Levenberg-Marquardt steps in each round.
        least_ess: effective sample size that a channel counts for at least during the search. A slow drift has a small
            one; with wide priors the search would then stay near their means.
        holds: whether a parameter that is pushed against its bound is left out of a step: needed where many end there.
    """
    search = Search(residuals, parameters, least_ess, holds=holds)
    information, products = np.eye(len(search.z)), Products()
    for _ in range(rounds):
        information, products = search.improve(steps)
        before = search.weight
        search.renew_weights()
        changed = sum(abs(search.weight[k] - before[k]) >= WEIGHT_CHANGE * before[k] for k in before)
        if changed <= MAY_CHANGE * len(before):
            break
    z, covariance = search.z, np.linalg.inv(information)
    values = {p.name: p.value(x) for p, x in zip(parameters, z, strict=True)}
    sd = {p.name: abs(p.slope(x)) * float(np.sqrt(v)) for p, x, v in zip(parameters, z, np.diag(covariance),
                                                                         strict=True)}
    return Fit(values, sd, search.current, search.scale, search.ess, -0.5 * float(z @ z), products)


def screen(residuals: Callable[[dict[str, float]], Residuals], base: Fit, known: Sequence[Parameter],
           additions: Sequence[Sequence[Parameter]]) -> list[float]:
    """Share of the misfit that each addition would leave if the model were linear: one least-squares solve each.

    Args:
        residuals: as for `fit`.
        base: the fit without additions.
        known: its parameters.
        additions: groups of parameters, each tried at its starts.

    Returns:
        Share of the weighted sum of squares that is left, one an addition; 1 where nothing changes.
    """
    search = Search(residuals, started(known, base.values))
    r = search.stack(search.current)
    slopes = search.jacobian()
    information, gradient, _ = search.normal_equations(slopes)
    cost = float(r @ r + search.z @ search.z)
    left = []
    for group in additions:
        values = {**base.values, **{p.name: p.begin for p in group}}
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
        # a little ridge keeps the matrix regular where a known parameter does the same
        bordered = np.block([[information, cross[:, None]], [cross, (1.0 + 1e-9) * size]])
        right = np.append(gradient, column @ r)
        left.append(max(cost - float(right @ np.linalg.solve(bordered, right)), 0.0) / max(cost, 1e-300))
    return left
