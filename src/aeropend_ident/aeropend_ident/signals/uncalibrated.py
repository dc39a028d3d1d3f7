# SPDX-License-Identifier: Apache-2.0
"""A rig whose numbers nobody knows: what its recordings themselves say of resolution, noise, and the nominal model.

The nominal model is identified as richly as the channels allow. With an angle alone the arm must swing freely: gravity,
viscous damping and the angle at which it hangs. With the command as well: a static curve from duty to lift, with a dead
zone and an unknown curvature, behind one lag, through the model file's own map and motor, of which as many numbers are
free as the angle can fix. With speed, current or voltage: every number of the model file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import comb

from aeropend_ident.bags.recording import Recording, RecordingError
from aeropend_ident.signals.signals import STILL, Signals, from_arrays

Array = NDArray[np.float64]

SHORTEST_DECAY = 2.0
"""s of free swinging below which nothing is said."""

FEWEST_SWINGS = 4
"""Swings from one side to the other that a free decay must show."""

ORDERS = (2, 3, 4, 6, 8)
"""Orders of the differences that noise is estimated from: a higher one forgives more motion between samples."""

OUTLIERS = 0.01
"""Share of differences that are left out as spikes."""

LONGEST = 5e-3
"""s: the angle may be read more seldom, but a command acts, late perhaps, on a grid no coarser than this."""

FINEST = 1e-3
"""s: a grid no finer than this is laid under stamps that keep no period."""

JITTER = 0.1
"""Part of a sample period by which a stamp may miss the grid."""

ELSEWHERE = 0.2
"""rad: an arm that comes to rest farther than this from hanging is held there by thrust."""


def resolution(x: Array) -> float:
    """Step between the values that a channel (N,) takes; 0 if it takes any value."""
    x = x[np.isfinite(x)]
    levels = np.unique(x)
    if len(levels) < 3:
        return float(levels[-1] - levels[0]) if len(levels) == 2 else 0.0
    steps = np.diff(levels)
    steps = steps[steps > 1e-7 * (levels[-1] - levels[0])]
    least = float(steps.min())
    multiple = np.rint(steps / least)
    if np.mean(np.abs(steps / least - multiple) < 0.1) < 0.95 or np.median(multiple) > 50.0:
        return 0.0
    return float(steps.sum() / multiple.sum())


def noise(t: Array, x: Array) -> float:
    """Standard deviation of the white noise of a channel x (N,) read at t (N,), by differences of several orders."""
    known = np.isfinite(x)
    t, x = t[known], x[known]
    usual = np.abs(np.diff(t) / np.median(np.diff(t)) - 1.0) < 0.2
    found = []
    for order in ORDERS:
        if len(x) < order + 10:
            break
        even = np.lib.stride_tricks.sliding_window_view(usual, order).all(axis=1)
        d = np.diff(x, order)[even]
        if len(d) >= 10:
            # not a median, which would be a whole step of a coarse x
            d = np.sort(np.abs(d))[:math.ceil((1.0 - OUTLIERS) * len(d))]
            found.append(float(np.sqrt(np.mean(d * d))) / math.sqrt(float(comb(2 * order, order))))
    return min(found, default=0.0)


def reading_sigma(t: Array, x: Array) -> float:
    """Standard deviation of a reading of x (N,) at t (N,): its noise and its resolution."""
    return max(noise(t, x), resolution(x) / math.sqrt(12.0), 1e-5 * float(np.nanmax(x) - np.nanmin(x)), 1e-9)


def grid(stamps: NDArray[np.int64], longest: float = math.inf) -> tuple[NDArray[np.int64], float]:
    """Index (N,) of each stamp (ns) on a uniform grid, and its period in s.

    Stamps that keep one period make that the grid, or parts of it, none longer than `longest` s; others get one that is
    fine enough for all of them.
    """
    since = (stamps - stamps[0]) * 1e-9
    usual = float(np.median(np.diff(since)))
    usual = float(np.mean(np.diff(since)[np.abs(np.diff(since) / usual - 1.0) < 0.25]))
    index = np.rint(since / usual).astype(np.int64)
    if index[-1] > 0:  # a period that is a little off would run away from many stamps
        refined = float(since @ index) / float(index @ index)
        steady = np.percentile(np.abs(since - refined * np.rint(since / refined)), 95.0) < JITTER * usual
        usual = refined if steady else usual
    period = usual
    for parts in (1, 2, 4, 5, 8, 10, 12, 16, 20, 50):
        period = usual / parts
        index = np.rint(since / period).astype(np.int64)
        missed = np.abs(since - index * period)
        if period > longest and period > FINEST:
            continue
        if np.percentile(missed, 95.0) < JITTER * usual or period <= FINEST:
            return index, period
    return index, period


def signals_from(recording: Recording, sensing: Mapping[str, float], held_out: float = 0.3) -> Signals:
    """A recording of an unknown rig: resolution and noise are its own, stamps may be irregular, the command missing.

    Args:
        recording: what was read. sensing: the model's measurement chain, of which only the speed's pulses are taken,
            where the speed read behaves like them.
        held_out: share at the end that models are not fitted to.

    Raises:
        RecordingError: nothing can be told from it; one line that says why.
    """
    if not np.isfinite(recording.theta).any():
        raise RecordingError(f"{recording.path}: no arm angle was measured (joint_states, position of 'arm'); nothing "
                             "to compare")
    driven = np.isfinite(recording.duty).any() and float(np.nanmax(recording.duty)) >= STILL
    alone = not any(np.isfinite(getattr(recording, c)).any() for c in ("omega", "i_a", "v_a"))
    index, period = grid(recording.stamp_ns, LONGEST if driven and alone else math.inf)
    columns = {}
    for name in ("theta", "omega", "i_a", "v_a", "duty"):
        columns[name] = np.full(int(index[-1]) + 1, np.nan)
        columns[name][index] = getattr(recording, name)
    t = (recording.stamp_ns - recording.stamp_ns[0]) * 1e-9
    sigma = {"theta": reading_sigma(t, recording.theta)}
    for name in ("i_a", "v_a", "omega"):
        x = getattr(recording, name)
        if np.isfinite(x).sum() > 10:
            sigma[name] = reading_sigma(t, x)
    own = _own_sensing(recording, sensing)
    duty = columns["duty"]
    idle = not np.isfinite(duty).any() or bool(np.nanmax(np.abs(duty)) < STILL)
    if idle and not any(np.isfinite(columns[c]).any() and np.nanstd(columns[c]) > 3.0 * sigma.get(c, 0.0)
                        for c in ("omega", "i_a", "v_a")):
        return _free_decay(recording, columns["theta"], period, sigma["theta"], held_out,
                           commanded=bool(np.isfinite(duty).any()))
    signals = from_arrays(columns, period, own, held_out, recording.path, recording.notes)
    if signals.pulses is not None:  # how well a speed is known is a matter of its pulses
        sigma.pop("omega", None)
    said = f"angle: read to {_degrees(sigma['theta'])} (noise and resolution, from the recording itself)"
    return replace(signals, sigma={**signals.sigma, **sigma}, notes=(*signals.notes, said))


def _degrees(angle: float) -> str:
    return f"{angle:.2g} rad ({math.degrees(angle):.2g} degrees)"


def _own_sensing(recording: Recording, sensing: Mapping[str, float]) -> dict[str, float]:
    """The measurement chain as the recording shows it; pulses only where the speed is held as they would hold it."""
    own = {**sensing, **{f"{c}_{what}": 0.0 for c in ("angle", "current", "voltage") for what in ("lsb", "noise")}}
    pulses = sensing["speed_pulses_per_rev"]
    speed = recording.omega[np.isfinite(recording.omega)]
    if pulses > 0.0 and len(speed) > 10:
        changes = np.flatnonzero(np.diff(speed)) + 1
        held = np.diff(changes) * recording.period
        turn = 2.0 * math.pi / pulses / np.maximum(np.abs(speed[changes[1:]]), 1e-3)
        fits = np.abs(held - turn) <= 1.5 * recording.period
        if len(held) < 5 or np.mean(fits) < 0.7 or np.median(held) < 2.5 * recording.period:
            own["speed_pulses_per_rev"] = 0.0
    return own


# --- an arm that swings freely

@dataclass(frozen=True)
class Swing:
    """A stretch of free swinging: samples start..stop, how many swings from side to side, and the first one's size."""

    start: int
    stop: int
    count: int
    size: float


def turning_points(x: Array, least: float) -> list[int]:
    """Indices at which x (N,) turns, swings smaller than `least` left out; the ends count as turning points."""
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


def free_swings(x: Array, sigma: float) -> list[Swing]:
    """Stretches in which an angle x (N,) swings with less and less amplitude; a push begins a new one."""
    least = max(5.0 * sigma, 0.015 * float(np.ptp(x)))
    points = turning_points(x, least)
    sizes = np.abs(np.diff(x[points]))
    found, first = [], 0
    for j in range(1, len(sizes) + 1):
        if j < len(sizes) and sizes[j] <= 1.03 * sizes[j - 1] + least:
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
    """The angle about which x (N,) swings less and less: between each turning point and those before and after it."""
    points = turning_points(x, max(5.0 * sigma, 0.015 * float(np.ptp(x))))
    v = x[points[1:-1]]  # the ends may not be turning points
    if len(v) < 3:
        return float(np.median(x))
    return float(np.median((0.25 * (v[:-2] + 2.0 * v[1:-1] + v[2:]))[len(v) // 3:]))


def _free_decay(recording: Recording, theta: Array, period: float, sigma: float, held_out: float, *, commanded: bool
                ) -> Signals:
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
    if seconds < SHORTEST_DECAY:
        raise RecordingError(f"{name}: the arm swings freely for {seconds:.1f} s only; {SHORTEST_DECAY:g} s or more "
                             "are needed for a verdict")
    n = last - first
    nothing = np.full(n, np.nan)
    what = "the arm was let go" if commanded else "no command was recorded: the arm is taken to swing freely"
    said = [(f"{what}, {best.count} swings from {first * period:.1f} s to {last * period:.1f} s; only its own numbers "
            "can be told"), f"the angle is read to {_degrees(sigma)}, noise and resolution, as the recording shows"]
    said.append("what brakes it is chosen from the whole swinging; how far the gap closes is then judged on the end of "
                "it, with numbers fitted to the rest")
    if pushes > 0:
        said.append(f"it is pushed or let go {pushes + 1} times: the longest swinging is used")
    return Signals(period, np.zeros(n), theta[first:last], nothing, nothing, nothing,
                   {"theta": sigma, "omega": 1.0, "i_a": 1.0, "v_a": 1.0}, None, np.zeros(n, dtype=bool),
                   max(1, round(n * (1.0 - held_out))), (*recording.notes, *said))
