# SPDX-License-Identifier: Apache-2.0
"""A random torque on the arm, seen through the angle: a Gauss-Markov process tracked by a Kalman filter.

No simulation can follow chance, so `gust` is judged by the statistics of what every simulation leaves. The smoothed
torque also shows where in operation something unexplained pushes the arm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import minimize

Array = NDArray[np.float64]

STEP = 0.01
"""s between the residuals that the filter takes: the arm is slow."""


@dataclass(frozen=True)
class Gust:
    """A Gauss-Markov torque fitted to a residual of the angle.

    Attributes:
        sigma: rad/s², and tau: s, estimates. sigma_sd: relative, and tau_sd: likewise, of their logarithms.
        gain: log likelihood over no torque but inflated white noise.
        torque: (M,) rad/s², smoothed, at `index` (M,) of the samples.
        whiteness: lag-one correlation of the filter's innovations.
    """

    sigma: float
    tau: float
    sigma_sd: float
    tau_sd: float
    gain: float
    torque: Array
    index: NDArray[np.int64]
    whiteness: float


@njit(cache=True, nogil=True)
def _filter(r: Array, stiffness: Array, damping: float, h: float, noise: float, sigma: float, tau: float,
            torque: Array, innovations: Array) -> float:
    """Kalman filter and Rauch-Tung-Striebel smoother over (δ, δ̇, w); returns the log likelihood."""
    n = r.shape[0]
    xs, ps = np.zeros((n, 3)), np.zeros((n, 3, 3))
    xp, pp = np.zeros((n, 3)), np.zeros((n, 3, 3))
    fs = np.zeros((n, 3, 3))
    x, p = np.zeros(3), np.diag(np.array([noise * noise, 0.01, sigma * sigma]))
    decay = math.exp(-h / tau)
    q = sigma * sigma * (1.0 - decay * decay)
    total = 0.0
    for k in range(n):
        if k > 0:
            a = np.array([[0.0, 1.0, 0.0], [-stiffness[k], -damping, 1.0], [0.0, 0.0, 0.0]])
            f = np.eye(3) + h * a + 0.5 * h * h * (a @ a)
            f[2, 2] = decay
            x = f @ x
            p = f @ p @ f.T
            p[2, 2] += q
            fs[k] = f
        xp[k], pp[k] = x, p
        if not math.isnan(r[k]):
            s = p[0, 0] + noise * noise
            e = r[k] - x[0]
            gain = p[:, 0].copy() / s
            x = x + gain * e
            p = p - np.outer(gain, p[0, :].copy())
            total -= 0.5 * (math.log(s) + e * e / s)
            innovations[k] = e / math.sqrt(s)
        else:
            innovations[k] = 0.0
        xs[k], ps[k] = x, p
    torque[n - 1] = xs[n - 1, 2]
    for k in range(n - 2, -1, -1):
        g = ps[k] @ fs[k + 1].T @ np.linalg.inv(pp[k + 1] + 1e-15 * np.eye(3))
        xs[k] = xs[k] + g @ (xs[k + 1] - xp[k + 1])
        torque[k] = xs[k, 2]
    return total


def fit_gust(residual: Array, theta: Array, gravity: float, damping: float, noise: float, period: float) -> Gust:
    """Fit a Gauss-Markov torque to a residual.

    Args:
        residual: (N,) rad, measured minus simulated angle, NaN where missing.
        theta: (N,) rad, the motion around which the arm is linear.
        gravity: mgd/J, 1/s²; damping: c/J, 1/s. noise: rad, of a reading. period: s between samples.
    """
    every = max(1, round(STEP / period))
    n = len(residual) // every
    blocks = residual[: n * every].reshape(n, every)
    count = np.isfinite(blocks).sum(axis=1)
    r = np.where(count > 0, np.nansum(blocks, axis=1) / np.maximum(count, 1), np.nan)
    index = np.arange(n) * every + every // 2
    stiffness = gravity * np.cos(np.nan_to_num(theta[index]))
    h, sd = every * period, noise / math.sqrt(every)
    torque, innovations = np.zeros(n), np.zeros(n)

    def cost(z: Array) -> float:
        return -_filter(r, stiffness, damping, h, sd, math.exp(z[0]), math.exp(z[1]), torque, innovations)

    size = float(np.nanstd(r)) * (gravity + 1.0)
    best = min((minimize(cost, [math.log(max(size, 1e-6)), math.log(tau)], method="Nelder-Mead",
                         options={"xatol": 0.02, "fatol": 0.1, "maxfev": 60}) for tau in (0.05, 0.5)),
               key=lambda solution: solution.fun)
    z = best.x
    width = []
    for j in range(2):
        step = np.zeros(2)
        step[j] = 0.05
        curvature = (cost(z + step) - 2.0 * best.fun + cost(z - step)) / 0.05**2
        width.append(1.0 / math.sqrt(max(curvature, 1e-6)))
    known = r[np.isfinite(r)]
    white = max(float(np.mean(known**2)), sd**2)
    without = -0.5 * len(known) * (math.log(white) + float(np.mean(known**2)) / white)
    cost(z)
    e = innovations
    whiteness = float(np.mean(e[1:] * e[:-1]) / max(float(np.mean(e * e)), 1e-300))
    return Gust(math.exp(z[0]), math.exp(z[1]), width[0], width[1], -best.fun - without, torque.copy(), index,
                whiteness)


def follows_state(torque: Array, columns: list[Array]) -> float:
    """Share of the torque's variance (0..1) that a linear combination of columns (each (M,)) explains."""
    a = np.column_stack([np.ones(len(torque)), *columns])
    a = a / np.maximum(np.linalg.norm(a, axis=0), 1e-12)
    fitted = a @ np.linalg.lstsq(a, torque, rcond=1e-8)[0]
    total = float(np.sum((torque - torque.mean()) ** 2))
    return 1.0 - float(np.sum((torque - fitted) ** 2)) / total if total > 0.0 else 0.0
