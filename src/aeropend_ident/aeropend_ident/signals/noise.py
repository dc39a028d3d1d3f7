# SPDX-License-Identifier: Apache-2.0
"""White noise and resolution of a channel, estimated from its readings alone."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import comb, ndtr

Array = NDArray[np.float64]

ORDERS = (2, 3, 4, 6, 8)
"""Orders of the differences that estimate noise at irregular stamps: a higher order removes more of the motion."""

OUTLIERS = 0.01
"""Share of the differences that is left out as spikes (choice).

Measured: at ±30 % no verdict of 5 recordings changes (docs/results/thresholds.md)."""

FEWEST = 10
"""Readings, or differences, below which no noise is estimated (choice).

Measured: at ±30 % no verdict of 25 recordings changes (docs/results/thresholds.md)."""

LEAST_NOISE = 1e-9
"""Smallest standard deviation of a reading in its unit (choice: far below any sensor; residuals are divided by it).

Measured: at ±30 % no verdict of 25 recordings changes (docs/results/thresholds.md)."""

AUTOREGRESSIVE = (2, 6, 16)
"""Orders of the predictors whose innovations estimate noise (choice: the last averages away the noise it takes in)."""

DUTIES = 3
"""Duties, the present one and those before it, that a predictor takes (choice: the current follows in two samples)."""

KNOTS = 30
"""Knots of the curve over each duty (choice: it must follow the dead zone of the motor).

Measured: with 9 knots the current's noise is 27 % too large under a duty that changes with each sample, with 20 1 %."""

MOST_ROWS = 10_000
"""Predicted readings at most (choice: the noise is then known to 1 %)."""

RIDGE = 1e-9
"""Weight that keeps the normal equations regular, relative to columns of norm 1 (choice: far below any information)."""

ROWS_A_WEIGHT = 30
"""Predicted readings that each weight of a predictor needs (choice: the fit then takes 3 % of the noise's power)."""

TRIMMED_SD = 0.9617
"""RMS of standard normal numbers without the `OUTLIERS` largest (derived: sqrt(1 - 2 c φ(c) / 0.99), c = 2.576)."""

LONGEST_STEP = 50.0
"""Steps of the resolution between neighbouring levels, in the median, above which a channel is continuous (choice).

Measured: at ±30 % no verdict of 5 recordings changes (docs/results/thresholds.md)."""

BLOCK = 32
"""Readings in a row whose mean slope gives the motion from one to the next (choice: it is known to 0.01 of a step)."""

SLOW = 0.25
"""Part of a step that a slow channel moves from one reading to the next at most (choice: noise shows beside it)."""


def resolution(x: Array) -> float:
    """Step between the values that a channel takes.

    Args:
        x: (N,) readings, NaN where missing.

    Returns:
        The step in the unit of x; 0 if the channel takes any value.
    """
    x = x[np.isfinite(x)]
    levels = np.unique(x)
    if len(levels) < 3:
        return float(levels[-1] - levels[0]) if len(levels) == 2 else 0.0
    steps = np.diff(levels)
    steps = steps[steps > 1e-7 * (levels[-1] - levels[0])]
    least = float(steps.min())
    multiple = np.rint(steps / least)
    if np.mean(np.abs(steps / least - multiple) < 0.1) < 0.95 or np.median(multiple) > LONGEST_STEP:
        return 0.0
    return float(steps.sum() / multiple.sum())


def white_noise(x: Array) -> float:
    """Standard deviation of a reading on a uniform grid, from second differences.

    The median makes the estimate robust against steps; a coarse channel counts with its quantisation noise.

    Args:
        x: (N,) readings, NaN where missing.

    Returns:
        Standard deviation in the unit of x, at least `LEAST_NOISE`.
    """
    x = x[np.isfinite(x)]
    if len(x) < FEWEST:
        return 1e-6
    white = float(np.median(np.abs(np.diff(x, 2)))) / 0.6745 / math.sqrt(6.0)
    return max(white, least_noise(x))


def least_noise(x: Array) -> float:
    """Standard deviation that a reading has at least, by its resolution.

    Args:
        x: (N,) readings, NaN where missing.
    """
    x = x[np.isfinite(x)]
    levels = np.unique(x)
    step = float(np.median(np.diff(levels))) if 1 < len(levels) < len(x) / 10 else 0.0
    return max(step / math.sqrt(12.0), 1e-6 * float(np.ptp(x)) if len(x) else 0.0, LEAST_NOISE)


def quantised_noise(x: Array, step: float) -> float:
    """Standard deviation of a reading of a coarse channel: quantisation and the noise below one step together.

    The quantisation errors of a slow channel are alike from reading to reading, so a predictor takes them for signal.
    The noise before quantisation is seen from the changes instead: two readings differ by E|d| in the mean, where d is
    the difference before quantisation, if the channel passes all of a step. Here d is the motion m plus noise of
    sqrt(2) σ.

    Source: B. Widrow and I. Kollár, Quantization Noise, Cambridge, 2008 (errors of uniform phase); the mean of |m + n|
    is that of the folded normal distribution.

    Args:
        x: (N,) readings, NaN where missing.
        step: resolution in the unit of x; 0 if none.

    Returns:
        Standard deviation in the unit of x. From noise of half a step on it is that of quantisation alone: the errors
        are then white, and other estimates see all.
    """
    quantised = step / math.sqrt(12.0)
    blocks = x[:len(x) // BLOCK * BLOCK].reshape(-1, BLOCK)
    place = np.arange(BLOCK) - 0.5 * (BLOCK - 1)
    slope = np.abs(blocks @ place / (place @ place))
    slow = (slope * BLOCK >= step) & (slope <= SLOW * step)
    if step == 0.0 or slow.sum() < FEWEST:
        return quantised
    m, change = slope[slow], float(np.mean(np.abs(np.diff(blocks[slow], axis=1))))

    def excess(sd: float) -> float:
        folded = sd * math.sqrt(2.0 / math.pi) * np.exp(-0.5 * (m / sd) ** 2) + m * (1.0 - 2.0 * ndtr(-m / sd))
        return float(np.mean(folded)) - change

    least, most = LEAST_NOISE * step, math.sqrt(0.5 * math.pi) * change
    sd = brentq(excess, least, most) / math.sqrt(2.0) if most > least and excess(least) < 0.0 < excess(most) else 0.0
    return math.hypot(quantised, sd) if sd < 0.5 * step else quantised


def innovation_noise(x: Array, duty: Array) -> float | None:
    """Standard deviation of a reading on a uniform grid, from the innovations of a linear predictor.

    A difference of neighbours takes the movement of the command for noise. Here each reading is predicted from the
    readings before it, with weights a, and from the duties. White noise of standard deviation σ makes an innovation of
    σ sqrt(1 + |a|²). The predictors have several orders; that with the least noise left follows the signal best.

    Source: L. Ljung, System Identification, 2nd edition, 1999, section 7.3 (ARX); T. Söderström, Errors-in-variables
    methods in system identification, Automatica 43, 2007 (noise of the regressors).

    Args:
        x: (N,) readings, NaN where missing.
        duty: (N,) applied duty.

    Returns:
        Standard deviation in the unit of x; None if there are too few readings in a row.
    """
    known = np.isfinite(x)
    knots = np.unique(np.quantile(duty, np.linspace(0.0, 1.0, KNOTS)))
    curves = np.column_stack([np.ones(len(x)), *(np.interp(duty, knots, hat) for hat in np.eye(len(knots))[1:])])
    found = []
    for order in AUTOREGRESSIVE:
        windows = np.lib.stride_tricks.sliding_window_view(known, order + 1) if len(x) > order else known[:0, None]
        at = np.flatnonzero(windows.all(axis=1)) + order
        if len(at) < ROWS_A_WEIGHT * (order + DUTIES * len(knots)):
            continue
        at = at[::math.ceil(len(at) / MOST_ROWS)]
        columns = np.column_stack([*(x[at - j] for j in range(1, order + 1)), curves[at],
                                   *(curves[np.maximum(at - k, 0), 1:] for k in range(1, DUTIES))])
        norm = np.maximum(np.linalg.norm(columns, axis=0), LEAST_NOISE)
        columns /= norm
        weights = np.linalg.solve(columns.T @ columns + RIDGE * np.eye(len(norm)), columns.T @ x[at])
        e = np.sort(np.abs(x[at] - columns @ weights))[:math.ceil((1.0 - OUTLIERS) * len(at))]
        a = weights[:order] / norm[:order]
        found.append(float(np.sqrt(np.mean(e * e))) / TRIMMED_SD / math.sqrt(1.0 + float(a @ a)))
    return min(found, default=None)


def white_noise_at(t: Array, x: Array) -> float:
    """Standard deviation of the white noise of a channel read at irregular instants.

    Differences of several orders are tried; the least one holds the least motion. A trimmed RMS is taken, as the
    median of a coarse channel would be a whole step.

    Args:
        t: [s] (N,) instants.
        x: (N,) readings, NaN where missing.

    Returns:
        Standard deviation in the unit of x; 0 if there are too few readings.
    """
    known = np.isfinite(x)
    t, x = t[known], x[known]
    if len(x) < FEWEST:
        return 0.0
    usual = np.abs(np.diff(t) / np.median(np.diff(t)) - 1.0) < 0.2
    found = []
    for order in ORDERS:
        if len(x) < order + FEWEST:
            break
        even = np.lib.stride_tricks.sliding_window_view(usual, order).all(axis=1)
        d = np.diff(x, order)[even]
        if len(d) >= FEWEST:
            d = np.sort(np.abs(d))[:math.ceil((1.0 - OUTLIERS) * len(d))]
            found.append(float(np.sqrt(np.mean(d * d))) / math.sqrt(float(comb(2 * order, order))))
    return min(found, default=0.0)


def reading_noise_at(t: Array, x: Array) -> float:
    """Standard deviation of a reading at irregular instants: the larger of white noise and quantisation noise.

    Args:
        t: [s] (N,) instants.
        x: (N,) readings, NaN where missing.

    Returns:
        Standard deviation in the unit of x, at least `LEAST_NOISE`.
    """
    return max(white_noise_at(t, x), quantised_noise(x, resolution(x)),
               1e-5 * float(np.nanmax(x) - np.nanmin(x)), LEAST_NOISE)
