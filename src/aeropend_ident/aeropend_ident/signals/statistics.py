# SPDX-License-Identifier: Apache-2.0
"""Statistics of a series: effective sample size and root mean square."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft, next_fast_len, rfft

Array = NDArray[np.float64]

Z95 = 1.959964
"""Standard deviations of a normal distribution on either side of its mean that hold 95 % (derived)."""

WINDOW = 5.0
"""Lag, in autocorrelation times, at which their sum stops (convention: Sokal, 1997, section 3: 4 to 10)."""

FEWEST = 16
"""Samples below which no autocorrelation is estimated: the series then counts in full (choice)."""


def effective_sample_size(r: Array, power: int = 1) -> float:
    """Number of independent samples that a residual is worth: N over its integrated autocorrelation time.

    Source: A. Sokal, Monte Carlo methods in statistical mechanics, 1997, section 3 (automatic windowing).

    Args:
        r: (N,) residual.
        power: 1 for the mean of the residual. 2 for its mean square: autocorrelations of either sign then add up, so
            that a narrow band does not seem to hold many samples.

    Returns:
        Effective sample size, 1 to N.
    """
    n = len(r)
    if n < FEWEST:
        return float(n)
    size = next_fast_len(2 * n, real=True)
    correlation = irfft(np.abs(rfft(r, size)) ** 2, size)[: n // 4]
    if correlation[0] <= 0.0:
        return float(n)
    correlation = correlation / correlation[0]
    running = 1.0 + 2.0 * np.cumsum(correlation[1:] ** power)
    lags = np.arange(1, len(correlation))
    stop = np.flatnonzero(lags >= WINDOW * running)
    time = running[stop[0]] if len(stop) else running[-1]
    return float(n / max(time, 1.0))


def rms(x: Array) -> float:
    """Root mean square of a series (N,) without missing values."""
    return float(np.sqrt(np.mean(x * x)))
