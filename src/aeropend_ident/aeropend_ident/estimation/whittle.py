# SPDX-License-Identifier: Apache-2.0
"""Log likelihood of a residual whose noise has a spectrum of its own."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct

from aeropend_sim.compiled import njit

Array = NDArray[np.float64]

NARROWEST = 8
"""Coefficients of the cosine transform in the narrowest band (choice: their mean square is then good to a half)."""


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
