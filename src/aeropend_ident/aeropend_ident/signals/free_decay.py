# SPDX-License-Identifier: Apache-2.0
"""An arm that swings freely: its turning points, and the stretch of a recording that holds its decay."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.bags.recording import Recording, RecordingError
from aeropend_ident.signals.noise import resolution
from aeropend_ident.signals.signals import Signals

Array = NDArray[np.float64]

SHORTEST = 2.0
"""[s] Shortest free decay that is diagnosed (choice).

Measured: at ±30 % no verdict of 2 recordings changes (docs/results/thresholds.md)."""

FEWEST_SWINGS = 4
"""Swings from one side to the other that a free decay must show (choice).

Measured: at ±30 % no verdict of 2 recordings changes (docs/results/thresholds.md)."""

ELSEWHERE = 0.2
"""[rad] Distance from hanging beyond which an arm at rest must be held by thrust (choice).

Measured: at ±30 % no verdict of 2 recordings changes (docs/results/thresholds.md)."""

GROWTH = 1.03
"""Ratio of a swing to the one before above which the arm was pushed (choice: reading errors stay below).

Measured: ×0.7, which is below 1, changes 2 of 2 verdicts, ×1.3 none (docs/results/thresholds.md)."""


@dataclass(frozen=True)
class Swing:
    """A stretch in which the arm swings freely.

    Attributes:
        start: first sample.
        stop: first sample after it.
        count: swings from one side to the other.
        size: [rad] size of the first swing.
    """

    start: int
    stop: int
    count: int
    size: float


def turning_points(x: Array, least: float) -> list[int]:
    """Indices at which a series turns.

    Args:
        x: (N,) series without missing values.
        least: swings smaller than this are left out, in the unit of x.

    Returns:
        Indices; the first and the last sample count as turning points.
    """
    points, low, high, direction = [0], 0, 0, 0
    for k in range(1, len(x)):
        high = k if x[k] >= x[high] else high
        low = k if x[k] <= x[low] else low
        if direction >= 0 and x[high] - x[k] > least:
            points.append(high)
            direction, low = -1, k
            high = k
        elif direction <= 0 and x[k] - x[low] > least:
            points.append(low)
            direction, high = 1, k
            low = k
    points.append(high if direction > 0 else low if direction < 0 else len(x) - 1)
    return [p for j, p in enumerate(points) if j == 0 or p > points[j - 1]]


def _least_swing(x: Array, sigma: float) -> float:
    """[rad] Size below which a swing of an angle x (N,) is noise (choice: 5 sigma, and 1.5 % of the range)."""
    return max(5.0 * sigma, 0.015 * float(np.ptp(x)))


def free_swings(x: Array, sigma: float) -> list[Swing]:
    """Stretches in which an angle swings with decreasing amplitude; a push begins a new one.

    Args:
        x: [rad] (N,) angle without missing values.
        sigma: [rad] standard deviation of a reading.
    """
    least = _least_swing(x, sigma)
    points = turning_points(x, least)
    sizes = np.abs(np.diff(x[points]))
    found, first = [], 0
    for j in range(1, len(sizes) + 1):
        if j < len(sizes) and sizes[j] <= GROWTH * sizes[j - 1] + least:
            continue
        if j - first >= 1 and sizes[first] > 2.0 * least:
            begin = points[first]
            moved = np.abs(x - x[begin]) > max(0.03 * sizes[first], 4.0 * sigma)
            begin += int(np.argmax(moved[begin:]))
            end = points[j] if j < len(sizes) else len(x)
            found.append(Swing(begin, end, j - first, float(sizes[first])))
        first = j
    return found


def _middle(x: Array, sigma: float) -> float:
    """[rad] Angle about which x (N,) swings, from three turning points in a row each."""
    points = turning_points(x, _least_swing(x, sigma))
    v = x[points[1:-1]]  # the ends may not be turning points
    if len(v) < 3:
        return float(np.median(x))
    middles = 0.25 * (v[:-2] + 2.0 * v[1:-1] + v[2:])
    return float(np.median(middles[len(middles) // 3:]))


def degrees(angle: float) -> str:
    """An angle in rad as text, in rad and degrees."""
    return f"{angle:.2g} rad ({math.degrees(angle):.2g} degrees)"


def free_decay(recording: Recording, theta: Array, period: float, sigma: float, held_out: float, *, commanded: bool
               ) -> Signals:
    """Cut the longest free decay out of a recording.

    Args:
        recording: as it was read, for its name and notes.
        theta: [rad] (N,) angle on a uniform grid, NaN where missing.
        period: [s] between samples.
        sigma: [rad] standard deviation of a reading.
        held_out: share at the end that models are not fitted to.
        commanded: whether a command was recorded (and is zero).

    Raises:
        RecordingError: the arm does not swing freely, or not for long enough.
    """
    known = np.flatnonzero(np.isfinite(theta))
    x = theta[known]
    name = recording.path
    if float(np.ptp(x)) < 10.0 * sigma:
        raise RecordingError(f"{name}: the arm does not move, so no verdict is possible")
    all_ = free_swings(x, sigma)
    swings = [s for s in all_ if s.count >= FEWEST_SWINGS]
    without = "the command is zero all the time" if commanded else "no command was recorded"
    if not swings:
        raise RecordingError(f"{name}: {without} and the arm does not swing down freely, so no verdict is possible "
                             "without the command; record the duty (duty_command or armature.percentage), or an arm "
                             "that is let go and left alone")
    best = max(swings, key=lambda s: s.size * math.sqrt(s.count))
    rest = _middle(x[best.start:best.stop], sigma)
    pushes = sum(s.size > 0.25 * best.size for s in all_) - 1
    if not commanded and abs(rest) > ELSEWHERE:
        pushed = f"is pushed {pushes + 1} times and comes" if pushes > 0 else "comes"
        raise RecordingError(f"{name}: no command was recorded, and the arm {pushed} to rest at "
                             f"{math.degrees(rest):.0f} degrees, where only thrust holds it: no verdict is possible "
                             "without the command; record the duty as well (or, if it hangs there and swings freely, "
                             "correct the angle's zero)")
    away = np.flatnonzero(np.abs(x[best.start:best.stop] - rest) > max(4.0 * sigma, 1.6 * resolution(x)))
    stop = min(best.start + int(away[-1]) + max(round(0.3 / period), 5), best.stop) if len(away) else best.stop
    first, last = int(known[best.start]), int(known[min(stop, len(known)) - 1]) + 1
    seconds = (last - first) * period
    if seconds < SHORTEST:
        raise RecordingError(f"{name}: the arm swings freely for {seconds:.1f} s only; {SHORTEST:g} s or more "
                             "are needed for a verdict")
    n = last - first
    nothing = np.full(n, np.nan)
    what = "the arm was let go" if commanded else "no command was recorded: the arm is taken to swing freely"
    said = [(f"{what}, {best.count} swings from {first * period:.1f} s to {last * period:.1f} s; only parameters and "
             "effects of the arm can be identified"),
            (f"a reading of the angle has a standard deviation of {degrees(sigma)}, from noise and resolution, "
             "estimated from the recording"),
            ("effects of friction and drag are selected on the whole decay; the gap is measured on the end of it, "
             "with parameters fitted to the rest")]
    if pushes > 0:
        said.append(f"the arm is pushed or let go {pushes + 1} times: the longest decay is used")
    return Signals(period, np.zeros(n), theta[first:last], nothing, nothing, nothing,
                   {"theta": sigma, "omega": 1.0, "i_a": 1.0, "v_a": 1.0}, None, np.zeros(n, dtype=bool),
                   max(1, round(n * (1.0 - held_out))), (*recording.notes, *said))
