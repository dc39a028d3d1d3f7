# SPDX-License-Identifier: Apache-2.0
"""A random torque on the arm, estimated from the angle: a Gauss-Markov process in a Kalman filter.

No simulation can follow a random torque, so the effect `gust` is judged by the statistics of the residual. The smoothed
torque also shows in which range of operation an unexplained torque acts.

Source: A. Bryson and Y.-C. Ho, Applied Optimal Control, 1975, chapters 11 to 13 (Gauss-Markov process, Kalman filter);
H. Rauch, F. Tung and C. Striebel, AIAA Journal 3, 1965 (smoother).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.signals.smoothing import block_mean
from aeropend_ident.signals.statistics import Z95
from aeropend_sim.compiled import njit
from aeropend_sim.model.arm import linear_arm
from aeropend_sim.model.effects import CATALOGUE

Array = NDArray[np.float64]

STEP = 0.01
"""[s] Time between the residuals that the filter takes (choice: a fiftieth of the arm's usual period).

Measured: at ±30 % no verdict of 15 recordings changes (docs/results/thresholds.md)."""

SETTLED = 1.0
"""[s] Time after which the filter has forgotten its initial state (choice: some time constants of the arm).

Measured: at ±30 % no verdict of 15 recordings changes (docs/results/thresholds.md)."""

NOT_KEPT = np.empty((0, 18))

FOLDS = 10
"""Stretches of time in the cross-validation, each predicted from the others (convention: ten folds)."""


CURVATURE_STEP = 0.05
"""Step of the finite differences of the cost, in the logarithm of a parameter (choice: well above rounding)."""

MOST_CORRELATED = 0.99
"""Largest correlation of the two parameters (choice: a flat valley stays invertible)."""


@dataclass(frozen=True)
class Gust:
    """A Gauss-Markov torque fitted to a residual of the angle.

    Attributes:
        sigma: [rad/s²] standard deviation of the torque over the arm's inertia.
        tau: [s] correlation time.
        sigma_sd: standard deviation of the logarithm of sigma.
        tau_sd: standard deviation of the logarithm of tau.
        log_likelihood: of the residual.
        gain: log likelihood over that of no torque with inflated white noise.
        torque: [rad/s²] (M,) smoothed torque.
        index: (M,) its samples.
        resolved: whether the correlation time differs from that of a white torque and from that of a constant one.
        kurtosis: fourth moment of the filter's innovations over that of a normal distribution: 1 for a random torque;
            far above it the angle jumps, which no torque causes.
    """

    sigma: float
    tau: float
    sigma_sd: float
    tau_sd: float
    log_likelihood: float
    gain: float
    torque: Array
    index: NDArray[np.int64]
    kurtosis: float
    resolved: bool


@njit(nogil=True)
def _filter(r: Array, stiffness: Array, damping: float, h: float, noise: float, sigma: float, tau: float,
            innovations: Array, kept: Array) -> float:
    """Kalman filter over the state (δ, δ̇, w): deviation of the angle, its rate, and the torque.

    The 3 × 3 products are written out, since small arrays are slow in compiled code too.

    Args:
        r: [rad] (M,) residual, NaN where missing.
        stiffness: [1/s²] (M,) of the arm at its angle.
        damping: [1/s] of the arm.
        h: [s] between residuals.
        noise: [rad] standard deviation of a residual.
        sigma: [rad/s²] of the process.
        tau: [s] of the process.
        innovations: (M,) filled, in units of their standard deviation.
        kept: (M, 18) or (0, 18), filled for the smoother: state and upper triangle of the covariance after each
            measurement, and the same before it.

    Returns:
        Log likelihood, up to a constant.
    """
    x0 = x1 = x2 = 0.0
    p00, p01, p02, p11, p12, p22 = noise * noise, 0.0, 0.0, 0.01, 0.0, sigma * sigma
    decay = math.exp(-h / tau)
    q = sigma * sigma * (1.0 - decay * decay)
    total = 0.0
    for k in range(r.shape[0]):
        if k > 0:
            a, b, c, d, e, f = linear_arm(stiffness[k], damping, h)
            x0, x1, x2 = a * x0 + b * x1 + c * x2, d * x0 + e * x1 + f * x2, decay * x2
            s00, s01, s02 = a * p00 + b * p01 + c * p02, a * p01 + b * p11 + c * p12, a * p02 + b * p12 + c * p22
            s10, s11, s12 = d * p00 + e * p01 + f * p02, d * p01 + e * p11 + f * p12, d * p02 + e * p12 + f * p22
            p00, p01, p02 = s00 * a + s01 * b + s02 * c, s00 * d + s01 * e + s02 * f, s02 * decay
            p11, p12, p22 = s10 * d + s11 * e + s12 * f, s12 * decay, p22 * decay * decay + q
        if len(kept):
            kept[k, 9:18] = x0, x1, x2, p00, p01, p02, p11, p12, p22
        if not math.isnan(r[k]):
            s = p00 + noise * noise
            e0 = r[k] - x0
            g0, g1, g2 = p00 / s, p01 / s, p02 / s
            x0, x1, x2 = x0 + g0 * e0, x1 + g1 * e0, x2 + g2 * e0
            p11, p12, p22 = p11 - g1 * p01, p12 - g1 * p02, p22 - g2 * p02
            p00, p01, p02 = p00 - g0 * p00, p01 - g0 * p01, p02 - g0 * p02
            total -= 0.5 * (math.log(s) + e0 * e0 / s)
            innovations[k] = e0 / math.sqrt(s)
        else:
            innovations[k] = 0.0
        if len(kept):
            kept[k, :9] = x0, x1, x2, p00, p01, p02, p11, p12, p22
    return total


@njit(nogil=True)
def _smooth(kept: Array, stiffness: Array, damping: float, h: float, tau: float, torque: Array) -> None:
    """Rauch-Tung-Striebel smoother over `kept` of the filter; fills `torque` [rad/s²] (M,)."""
    n = kept.shape[0]
    x = kept[n - 1, :3].copy()
    torque[n - 1] = x[2]
    f = np.zeros((3, 3))
    f[2, 2] = math.exp(-h / tau)
    for k in range(n - 2, -1, -1):
        f[0, 0], f[0, 1], f[0, 2], f[1, 0], f[1, 1], f[1, 2] = linear_arm(stiffness[k + 1], damping, h)
        gain = symmetric(kept[k, 3:9]) @ f.T @ np.linalg.inv(symmetric(kept[k + 1, 12:18]) + 1e-15 * np.eye(3))
        x = kept[k, :3] + gain @ (x - kept[k + 1, 9:12])
        torque[k] = x[2]


@njit()
def symmetric(p: Array) -> Array:
    """The matrix (3, 3) of an upper triangle (6,)."""
    out = np.empty((3, 3))
    out[0, 0], out[0, 1], out[0, 2], out[1, 1], out[1, 2], out[2, 2] = p[0], p[1], p[2], p[3], p[4], p[5]
    out[1, 0], out[2, 0], out[2, 1] = p[1], p[2], p[4]
    return out


def fit_gust(residual: Array, theta: Array, gravity: float, damping: float, noise: float, period: float) -> Gust:
    """Fit a Gauss-Markov torque to a residual (maximum likelihood).

    Args:
        residual: [rad] (N,) measured minus simulated angle, NaN where missing.
        theta: [rad] (N,) motion around which the arm is linear.
        gravity: [1/s²] mgd/J.
        damping: [1/s] c/J.
        noise: [rad] standard deviation of a reading.
        period: [s] between samples.
    """
    from scipy.optimize import minimize  # its import is slow

    every = max(1, round(STEP / period))
    n = len(residual) // every
    r = block_mean(residual, every)
    index = np.arange(n) * every + every // 2
    stiffness = gravity * np.cos(np.nan_to_num(theta[index]))
    h, sd = every * period, noise / math.sqrt(every)
    torque, innovations = np.zeros(n), np.zeros(n)

    def cost(z: Array, kept: Array = NOT_KEPT) -> float:
        tau = math.exp(min(max(z[1], shortest), longest))
        return -_filter(r, stiffness, damping, h, sd, math.exp(z[0]), tau, innovations, kept)

    limits = CATALOGUE["gust"].parameters["tau"]
    shortest, longest = math.log(limits.low), math.log(min(limits.high, n * h))
    size = float(np.nanstd(r)) * (gravity + 1.0)
    best = min((minimize(cost, [math.log(max(size, 1e-6)), math.log(tau)], method="Nelder-Mead",
                         options={"xatol": 0.02, "fatol": 0.1, "maxfev": 60}) for tau in (0.05, 0.5)),
               key=lambda solution: solution.fun)
    z = np.array([best.x[0], min(max(best.x[1], shortest), longest)])
    width = _widths(cost, z)
    known = r[np.isfinite(r)]
    white = max(float(np.mean(known**2)), sd**2)
    without = -0.5 * len(known) * (math.log(white) + float(np.mean(known**2)) / white)
    kept = np.empty((n, 18))
    cost(z, kept)
    _smooth(kept, stiffness, damping, h, math.exp(z[1]), torque)
    e = innovations[min(round(SETTLED / h), n // 2):]
    kurtosis = float(np.mean(e**4) / (3.0 * max(float(np.mean(e * e)), 1e-150) ** 2))
    resolved = z[1] - Z95 * width[1] > math.log(h) and z[1] + Z95 * width[1] < longest
    return Gust(math.exp(z[0]), math.exp(z[1]), width[0], width[1], -best.fun, -best.fun - without, torque.copy(),
                index, kurtosis, bool(resolved))


def _widths(cost: Callable[[Array], float], z: Array) -> Array:
    """Standard deviations (2,) of the parameters from the curvature of the cost; the two are correlated."""
    s, t = CURVATURE_STEP * np.eye(2)
    here = cost(z)
    own = [max(cost(z + x) - 2.0 * here + cost(z - x), 1e-6) for x in (s, t)]
    mixed = 0.25 * (cost(z + s + t) - cost(z + s - t) - cost(z - s + t) + cost(z - s - t))
    most = MOST_CORRELATED * math.sqrt(own[0] * own[1])
    mixed = min(max(mixed, -most), most)
    curvature = np.array([[own[0], mixed], [mixed, own[1]]]) / CURVATURE_STEP**2
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(curvature))))


def gauss_markov(shape: tuple[int, int], tau: float, period: float, rng: np.random.Generator) -> Array:
    """Draw random torques of variance 1.

    Args:
        shape: (D, N) number of torques and of samples.
        tau: [s] correlation time.
        period: [s] between samples.
        rng: source of random numbers.
    """
    return _correlated(rng.standard_normal(shape), math.exp(-period / tau))


@njit(nogil=True)
def _correlated(white: Array, keep: float) -> Array:
    kick = math.sqrt(1.0 - keep * keep)
    for row in white:
        for k in range(1, len(row)):
            row[k] = keep * row[k - 1] + kick * row[k]
    return white


def follows_state(torque: Array, columns: Array) -> float:
    """Share of a torque's variance that a linear combination of columns predicts in cross-validation.

    Args:
        torque: (M,).
        columns: (M, K).

    Returns:
        At most 1; negative where the prediction is worse than the mean.
    """
    a = np.column_stack([np.ones(len(torque)), columns])
    a = a / np.maximum(np.linalg.norm(a, axis=0), 1e-12)
    fold = np.arange(len(torque)) * FOLDS // len(torque)
    error = np.empty(len(torque))
    for k in range(FOLDS):
        out = fold == k
        x = a[~out]
        weights = np.linalg.solve(x.T @ x + 1e-3 * np.eye(a.shape[1]), x.T @ torque[~out])
        error[out] = torque[out] - a[out] @ weights
    total = float(np.sum((torque - torque.mean()) ** 2))
    return 1.0 - float(np.sum(error**2)) / total if total > 0.0 else 0.0
