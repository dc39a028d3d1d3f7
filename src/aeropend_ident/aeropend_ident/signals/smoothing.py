# SPDX-License-Identifier: Apache-2.0
"""Linear filters for series with missing values (NaN)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from aeropend_sim.compiled import njit

Array = NDArray[np.float64]


def moving_mean(x: Array, width: int) -> Array:
    """Centred moving mean.

    scipy.ndimage.uniform_filter1d would do for a series without missing values.

    Args:
        x: (N,) series, NaN where missing.
        width: samples in the window; an even number counts as the next odd one.

    Returns:
        (N,) mean over what is known in the window; 0 where nothing is known.
    """
    known = np.isfinite(x)
    kernel = np.ones(max(1, width | 1))
    total = np.convolve(np.where(known, x, 0.0), kernel, mode="same")
    count = np.convolve(known.astype(float), kernel, mode="same")
    return np.where(count > 0.0, total / np.maximum(count, 1.0), 0.0)


def block_mean(x: Array, width: int) -> Array:
    """Means over consecutive blocks.

    Args:
        x: (N,) series, NaN where missing.
        width: samples in a block; what is left at the end is dropped.

    Returns:
        (N // width,) mean over what is known in each block; NaN where nothing is known.
    """
    n = len(x) // width
    rows = x[: n * width].reshape(n, width)
    count = np.isfinite(rows).sum(axis=1)
    return np.where(count > 0, np.nansum(rows, axis=1) / np.maximum(count, 1), np.nan)


def lag(x: Array, tau: float, period: float, fall: float = 1.0) -> Array:
    """First-order lag that starts in its steady state.

    Args:
        x: (N,) series without missing values.
        tau: [s] time constant.
        period: [s] between samples.
        fall: time constant while the series falls, over that while it rises.

    Returns:
        (N,) filtered series.
    """
    return _lag(np.ascontiguousarray(x), math.exp(-period / tau), math.exp(-period / (fall * tau)))


@njit(nogil=True)
def _lag(x: Array, rising: float, falling: float) -> Array:
    # scipy.signal.lfilter gives the same up to rounding; its import takes longer than all calls of a diagnosis
    out = np.empty_like(x)
    s = x[0]
    for k in range(len(x)):
        keep = rising if x[k] > s else falling
        s = keep * s + (1.0 - keep) * x[k]
        out[k] = s
    return out


def slow_part(residual: Array, width: int, sigma: float) -> Array:
    """Slow part of a residual, shrunk by the power that white noise alone would leave in it (Wiener filter).

    Args:
        residual: (N,), NaN where missing.
        width: samples of the moving mean.
        sigma: standard deviation of the white noise, in the unit of the residual.

    Returns:
        (N,) slow part; 0 where white noise explains all of it.
    """
    slow = moving_mean(residual, width)
    power = float(np.mean(slow * slow))
    return slow * max(0.0, 1.0 - sigma * sigma / (width | 1) / power) if power > 0.0 else slow
