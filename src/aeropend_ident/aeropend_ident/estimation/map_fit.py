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

The steps are those of `levenberg_marquardt`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.estimation.deadline import passed
from aeropend_ident.estimation.levenberg_marquardt import STEP, Products, Search
from aeropend_ident.estimation.parameter import Parameter, started
from aeropend_ident.estimation.residuals import Residuals
from aeropend_ident.estimation.whittle import whittle

Array = NDArray[np.float64]

MAY_CHANGE = 0.1
"""Share of the channels whose weights may still change when a fit ends (choice).

With many recordings some channel always changes a little."""

WEIGHT_CHANGE = 0.02
"""Relative change of a channel's weight that counts as a change (choice)."""

POORER = 1.05
"""Ratio of mean squares above which a fit has ended in a worse local minimum than another (choice: 2.5 % in RMS)."""


@dataclass(frozen=True, eq=False)
class Fit:
    """A fitted hypothesis; equal to itself alone.

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
            one; with wide priors the search would then stay near their means. Standard deviations count the true one.
        deadline: after it, the fit ends with its next step; see `passed`.
        first_look: the fit may end with derivatives that are corrected, where others would gain more. It is good enough
            to choose what is fitted on.
    """
    search = Search(residuals, parameters, least_ess)
    products = Products()
    for done in range(rounds):
        if done and passed(deadline):
            break
        products = search.improve(steps, deadline, first_look=first_look)
        before, ended = search.weight, search.ended
        search.renew_weights()
        changed = sum(abs(search.weight[k] - before[k]) >= WEIGHT_CHANGE * before[k] for k in before)
        if ended and changed <= MAY_CHANGE * len(before):
            break
    z = search.z
    log_prior = 0.5 * float(np.linalg.slogdet(search.prior)[1] - z @ search.prior @ z)
    f = Fit({p.name: p.value(x) for p, x in zip(parameters, z, strict=True)}, {}, search.current, search.scale,
            search.ess, log_prior, products, search.prior)
    variance = np.diag(covariance_of(f.information(f.ess)))
    return replace(f, sd={p.name: abs(p.slope(x)) * math.sqrt(v)
                          for p, x, v in zip(parameters, z, variance, strict=True)})


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
