# SPDX-License-Identifier: Apache-2.0
"""Derivatives of noisy signals, in time and memory proportional to their length.

Both methods replace the signal f by a smooth g and differentiate g. `smoothed` penalises the square of the third
derivative of g. `tv_derivative` penalises the total variation of g' (TVRegDiff: Chartrand, ISRN Applied Mathematics,
2011), so that g' can jump. Chartrand's equations for g' have a dense matrix; here the unknown is g, and the matrix has
five diagonals.

`scipy.interpolate.make_smoothing_spline` penalises the second derivative. To estimate a first derivative, the third one
is penalised (Ramsay & Silverman, Functional Data Analysis, 2005, ch. 5).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct
from scipy.linalg import solveh_banded
from scipy.optimize import minimize_scalar

Array = NDArray[np.float64]


def noise_of(x: Array) -> Array:
    """Standard deviation of white noise on signals (N,) or (N, S), by third differences; steps hardly change it."""
    d = np.diff(x, 3, axis=0)
    # 0.6745: median of |x| of the standard normal distribution; 20: sum of squares of 1, -3, 3, -1
    return np.asarray(np.median(np.abs(d - np.median(d, axis=0)), axis=0) / 0.6745 / np.sqrt(20.0))


def differences(g: Array, period: float) -> Array:
    """Derivative (N,) of samples (N,) by central differences of fourth order, of second order at the ends.

    Args:
        g: (N,) samples.
        period: [s] sample period.
    """
    out = np.gradient(g, period, edge_order=2)
    out[2:-2] = (g[:-4] - 8.0 * g[1:-3] + 8.0 * g[3:-1] - g[4:]) / (12.0 * period)
    return np.asarray(out)


def smoothed(f: Array, period: float, strength: float | None = None) -> tuple[Array, Array]:
    """Smooth a signal (N,) and differentiate it.

    Args:
        f: (N,) samples.
        period: [s] sample period.
        strength: weight of the squared third difference; None: by generalised cross-validation (Garcia, Computational
            Statistics & Data Analysis 54, 2010).

    Returns:
        The smooth signal and its derivative, each (N,).
    """
    strength = _cross_validated(f) if strength is None else strength
    g = f if strength <= 0.0 else solveh_banded(_penalty(np.ones(len(f) - 3), 3, strength), f, lower=True)
    return np.asarray(g), differences(np.asarray(g), period)


def smoothness(f: Array) -> float:
    """Number of samples over which `smoothed` averages a signal (N,)."""
    return float(2.0 * _cross_validated(f) ** (1.0 / 6.0))


def _cross_validated(f: Array) -> float:
    n = len(f)
    ramp = f - np.linspace(f[0], f[-1], n)
    power = dct(ramp, norm="ortho") ** 2
    size = (2.0 - 2.0 * np.cos(np.pi * np.arange(n) / n)) ** 3
    if power.sum() <= 0.0:
        return 0.0

    def score(log: float) -> float:
        taken = 1.0 - 1.0 / (1.0 + np.exp(log) * size)
        left = float(np.mean(taken))
        return float(np.log(np.mean(taken**2 * power) + 1e-300) - 2.0 * np.log(left + 1e-300))

    grid = np.linspace(-12.0, 30.0, 43)
    best = grid[int(np.argmin([score(x) for x in grid]))]
    return float(np.exp(minimize_scalar(score, bounds=(best - 1.0, best + 1.0), method="bounded").x))


def _penalty(weights: Array, order: int, strength: float) -> Array:
    """Lower bands (order + 1, N) of I + strength D'WD.

    Args:
        weights: (N - order,) diagonal of W.
        order: of the difference operator D.
        strength: weight of the penalty.
    """
    n = len(weights) + order
    row = np.array([1.0])
    for _ in range(order):
        row = np.convolve(row, [1.0, -1.0])
    bands = np.zeros((order + 1, n))
    bands[0] = 1.0
    for a in range(order + 1):
        for b in range(a + 1):
            bands[a - b, b : b + len(weights)] += strength * row[a] * row[b] * weights
    return bands


def tv_derivative(f: Array, period: float, alpha: float | None = None, iterations: int = 20) -> tuple[Array, Array]:
    """Differentiate a signal (N,) with total-variation regularisation.

    Args:
        f: (N,) samples.
        period: [s] sample period.
        alpha: weight of the total variation of the derivative, for a sample period of 1 s; None: the weight at which
            the residual is as large as the noise of the signal (discrepancy principle).
        iterations: greatest number of iterations (lagged diffusivity).

    Returns:
        The smooth signal and its derivative, each (N,).
    """
    noise = float(noise_of(f))
    scale = noise if noise > 0.0 else float(np.std(f)) * 1e-9 + 1e-300
    if alpha is not None:
        return _tv(f, alpha, scale, iterations, f, period)
    if noise <= 1e-9 * float(np.ptp(f)):
        return f, differences(f, period)
    low, high, g = -3.0, 12.0, f
    for _ in range(10):
        middle = 0.5 * (low + high)
        g, _ = _tv(f, scale * np.exp(middle), scale, 6, g, period)
        if float(np.sqrt(np.mean((g - f) ** 2))) < noise:
            low = middle
        else:
            high = middle
    return _tv(f, scale * np.exp(0.5 * (low + high)), scale, iterations, g, period)


def _tv(f: Array, alpha: float, scale: float, iterations: int, start: Array, period: float) -> tuple[Array, Array]:
    g, small = start, (1e-3 * scale) ** 2
    for _ in range(iterations):
        weights = 1.0 / np.sqrt(np.diff(g, 2) ** 2 + small)
        new = np.asarray(solveh_banded(_penalty(weights, 2, alpha), f, lower=True))
        done = float(np.max(np.abs(new - g))) < 1e-3 * scale
        g = new
        if done:
            break
    return g, np.gradient(g, period)
