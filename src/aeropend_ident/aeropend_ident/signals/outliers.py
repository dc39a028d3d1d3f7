# SPDX-License-Identifier: Apache-2.0
"""Readings that say less than they seem to: at the end of a sensor's range, or single ones that jump out."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CHANCE = 1e-6
"""Probability of a false alarm by chance, a channel."""

QUIET = 0.9
"""Share of equal neighbours from which on a channel shows no noise that could tell a limit from a rest."""

SHORTEST = 4
"""Equal readings in a row that are no limit, whatever the noise."""

APPROACH = 15
"""Samples over which a smooth signal must not slow down before it stands still: what stops at once hits a limit."""

NEIGHBOURS = 3
"""Readings on either side that a single one is compared with."""

FAR = 8.0
"""Standard deviations of the noise by which a reading that jumps out leaves its neighbours."""


def saturated(x: Array, *, smooth: bool = False) -> Mask:
    """Samples (N,) of a channel that sit at the end of its range, where the true value may be anything beyond.

    Above a limit every reading is the same, to the last bit and the noise included; at a plateau that is only a
    plateau, the noise goes on. So the largest and the smallest reading are limits if they are repeated in a row more
    often than the noise of the channel lets them be. Speed held between pulses is no case for this.

    Args:
        x: (N,) readings, NaN where missing.
        smooth: the signal has no jumps (an angle): then a limit is found without noise too, by a stop that is sudden.
    """
    out = np.zeros(len(x), dtype=bool)
    known = np.flatnonzero(np.isfinite(x))
    y = x[known]
    if len(y) < 2 * APPROACH or np.ptp(y) == 0.0:
        return out
    for end in (float(y.max()), float(y.min())):
        at = y == end
        inside = ~at[1:] & ~at[:-1]
        if not inside.any():
            continue
        equal = float(np.mean(y[1:][inside] == y[:-1][inside]))
        starts, lengths = _runs(at)
        if equal < QUIET:
            enough = 1.0 + math.log(CHANCE / len(y)) / math.log(max(equal, 1e-3))
            hit = bool((lengths >= max(enough, SHORTEST)).any())
        else:
            hit = smooth and end != 0.0 and _sudden(y, starts[lengths >= APPROACH], end)
        if hit:
            out[known[at]] = True
    return out


def _runs(at: Mask) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First index and length of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], at, [False])).astype(np.int8)))
    return edges[::2], edges[1::2] - edges[::2]


def _sudden(y: Array, starts: NDArray[np.int64], end: float) -> bool:
    """Whether a smooth signal comes to `end` at full speed: over the last samples as far as over those before."""
    starts = starts[starts >= 2 * APPROACH]
    if not len(starts):
        return False
    levels = np.unique(y)
    resolution = float(np.min(np.diff(levels)))
    last = np.abs(y[starts - APPROACH] - end)
    before = np.abs(y[starts - 2 * APPROACH] - y[starts - APPROACH])
    return float(last.sum()) > max(0.6 * float(before.sum()), 1.5 * resolution * len(starts))


def jumps_out(x: Array, sigma: float) -> Mask:
    """Samples (N,) that stand alone: far from all of their neighbours, which agree with each other.

    Args:
        x: (N,) readings, NaN where missing.
        sigma: standard deviation of a reading, noise and quantisation.
    """
    out = np.zeros(len(x), dtype=bool)
    known = np.flatnonzero(np.isfinite(x))
    y = x[known]
    k = NEIGHBOURS
    if len(y) < 2 * k + 1:
        return out
    window = np.lib.stride_tricks.sliding_window_view(np.pad(y, k, mode="edge"), 2 * k + 1)
    others = np.delete(window, k, axis=1)
    middle = np.median(others, axis=1)
    spread = np.median(np.abs(others - middle[:, None]), axis=1)
    # a step has half of the neighbours on either level; a reading that jumps out leaves both; one more may do so too
    others.sort(axis=1)
    low, high = others[:, 1], others[:, -2]
    outside = np.maximum(y - high, low - y)
    out[known] = (np.abs(y - middle) > FAR * (sigma + spread)) & (outside > 0.5 * np.abs(y - middle))
    return out
