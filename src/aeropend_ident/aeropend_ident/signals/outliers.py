# SPDX-License-Identifier: Apache-2.0
"""Readings to leave out: at the end of a sensor's range, or single ones far from their neighbours."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

CHANCE = 1e-6
"""Probability of a false alarm in a channel without saturation (choice).

Measured: at ±30 % no verdict of 23 recordings changes (docs/results/thresholds.md)."""

QUIET = 0.9
"""Share of equal neighbours above which a channel shows no noise that could tell a limit from a rest (choice).

So does an angle that goes on in one direction from change to change in as large a share.

Measured: at ±30 % no verdict of 23 recordings changes (docs/results/thresholds.md)."""

SHORTEST = 4
"""Equal readings in a row that never count as a limit, whatever the noise (choice)."""

APPROACH = 0.03
"""[s] Time over which the signal must keep its speed before it stops at a limit (choice: the noise is then small)."""

FEWEST_IN_APPROACH = 3
"""Samples of that time at least, at a low rate (choice)."""

CLEAR = 4.0
"""Steps of the resolution that a signal must move while it approaches a limit.

Derived: with fewer, a parabola that turns at the end seems to keep its speed."""

NEIGHBOURS = 3
"""Readings on either side with which a single one is compared (choice)."""

FAR = 8.0
"""Standard deviations of the noise beyond which a single reading is an outlier.

Choice: normal noise exceeds it in one of 10^15 readings, which leaves room for heavier tails."""

TURN, NEARLY = 2.0 * math.pi, 0.2
"""[rad] A turn; and the part of it by which a jump from one end of an angle's range to the other may differ from it.

Choice: an arm moves less than that between two readings."""


def joined_turns(theta: Array) -> tuple[Array, int]:
    """Join the turns of an angle that is read within one turn: from its end the reading jumps to its beginning.

    Args:
        theta: [rad] (N,) readings, NaN where missing.

    Returns:
        [rad] (N,) The angle without these jumps, from within half a turn of 0 on; and their number.
    """
    known = np.flatnonzero(np.isfinite(theta))
    x = theta[known]
    steps = np.diff(x)
    jumps = np.abs(np.abs(steps) - TURN) < NEARLY * TURN
    if not jumps.any() or np.ptp(x) > (1.0 + 0.5 * NEARLY) * TURN:
        return theta, 0
    turns = np.concatenate([[-np.round(x[0] / TURN)], np.where(jumps, -np.sign(steps), 0.0)]).cumsum()
    joined = theta.copy()
    joined[known] += TURN * turns
    return joined, int(jumps.sum())


def saturated(x: Array, period: float, *, smooth: bool = False) -> Mask:
    """Find the samples of a channel that sit at the end of its range, where the true value may lie beyond.

    At a limit all readings are equal to the last bit; at a true plateau the noise goes on. The largest and the
    smallest reading are limits if they repeat in a row more often than the noise of the channel allows. A speed that is
    held between pulses must not be tested.

    Args:
        x: (N,) readings, NaN where missing.
        period: [s] between samples.
        smooth: whether the signal has no jumps (an angle). A limit is then found without noise too, by a sudden stop;
            and a series that begins at an end of its range rests there, unless it stops there suddenly later.

    Returns:
        (N,) mask.
    """
    out = np.zeros(len(x), dtype=bool)
    known = np.flatnonzero(np.isfinite(x))
    y = x[known]
    approach = max(FEWEST_IN_APPROACH, round(APPROACH / period))
    if len(y) < 2 * approach or np.ptp(y) == 0.0:
        return out
    for end in (float(y.max()), float(y.min())):
        at = y == end
        inside = ~at[1:] & ~at[:-1]
        if not inside.any():
            continue
        equal = float(np.mean(y[1:][inside] == y[:-1][inside]))
        starts, lengths = runs(at)
        if equal < QUIET and not (smooth and _reversals(y) < 1.0 - QUIET):
            enough = 1.0 + math.log(CHANCE / len(y)) / math.log(max(equal, 1e-3))
            long = starts[lengths >= max(enough, SHORTEST)]
            at_rest = smooth and bool(np.any(long == 0))  # an arm that hangs at the beginning repeats a reading too
            hit = _sudden(y, long, end, approach) if at_rest else bool(len(long))
        else:
            hit = smooth and end != 0.0 and _sudden(y, starts[lengths >= approach], end, approach)
        if hit:
            out[known[at]] = True
    return out


def _reversals(y: Array) -> float:
    """Share of the changes of a series (N,) that go back: about 0 without noise, more than half for noise alone."""
    way = np.sign(np.diff(y))
    way = way[way != 0.0]
    return float(np.mean(way[1:] != way[:-1])) if len(way) > 1 else 0.0


def runs(at: Mask) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First index and length of each run of true values in a mask (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], at, [False])).astype(np.int8)))
    return edges[::2], edges[1::2] - edges[::2]


def _sudden(y: Array, starts: NDArray[np.int64], end: float, approach: int) -> bool:
    """Whether a smooth signal reaches `end` without slowing down over the last samples before some starts."""
    starts = starts[starts >= 2 * approach]
    if not len(starts):
        return False
    levels = np.unique(y)
    resolution = float(np.median(np.diff(levels)))  # a limit need not be a whole step
    last = np.abs(y[starts - approach] - end)
    before = np.abs(y[starts - 2 * approach] - y[starts - approach])
    return float(last.sum()) > max(0.6 * float(before.sum()), CLEAR * resolution * len(starts))


def jumps_out(x: Array, sigma: float) -> Mask:
    """Find single samples far from all of their neighbours, which agree with each other.

    Args:
        x: (N,) readings, NaN where missing.
        sigma: standard deviation of a reading, with noise and quantisation.

    Returns:
        (N,) mask.
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
    # at a step half of the neighbours are on either level; an outlier leaves both; one neighbour may be an outlier too
    others.sort(axis=1)
    low, high = others[:, 1], others[:, -2]
    outside = np.maximum(y - high, low - y)
    out[known] = (np.abs(y - middle) > FAR * (sigma + spread)) & (outside > 0.5 * np.abs(y - middle))
    return out


def far_from_median(x: Array, sigma: float) -> Mask:
    """Find samples far from the median of seven, where the spread of the seven is small.

    As `jumps_out`, for a speed whose noise grows with it.

    Args:
        x: (N,) readings, NaN where missing.
        sigma: standard deviation of a reading.

    Returns:
        (N,) mask.
    """
    if len(x) < 2 * NEIGHBOURS + 1:
        return np.zeros(len(x), dtype=bool)
    window = np.lib.stride_tricks.sliding_window_view(np.pad(x, NEIGHBOURS, mode="edge"), 2 * NEIGHBOURS + 1)
    known = np.isfinite(window).sum(axis=1) >= NEIGHBOURS + 1
    median, spread = np.zeros(len(x)), np.zeros(len(x))
    median[known] = np.nanmedian(window[known], axis=1)
    spread[known] = np.nanmedian(np.abs(window[known] - median[known, None]), axis=1)
    return known & (np.abs(x - median) > FAR * (sigma + spread) + 0.1 * np.abs(median))
