# SPDX-License-Identifier: Apache-2.0
"""The pulses behind a rotor speed that is held between them, recovered from the held readings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from aeropend_sim.model.parameters import SAMPLE_PERIOD
from aeropend_sim.model.sensing import SPEED_TIMEOUT

Array = NDArray[np.float64]

PEAK = 1.25
"""Ratio of an interval's speed to those of both neighbours that the rotor's inertia does not allow: a false capture.

Choice: within one pulse interval the preset rotor changes its speed by a few percent.

Measured: ×0.7, which is below 1, changes 14 of 20 verdicts, ×1.3 none (docs/results/thresholds.md)."""

CLOCK_TOLERANCE = 2e-4
"""Relative standard deviation of a pulse interval from the tolerance of the board's clock (choice: 200 ppm).

Measured: at ±30 % no verdict of 20 recordings changes (docs/results/thresholds.md)."""


UNSURE = 0.5
"""Relative standard deviation of an interval whose length is not known: it counts for next to nothing (choice)."""


@dataclass(frozen=True)
class Pulses:
    """The intervals between pulses that a held speed shows, one entry an interval.

    Attributes:
        index: (M,) sample in which the new speed first shows.
        time: [s] (M,) estimated end of the interval; at most one sample before `index`.
        period: [s] (M,) length.
        omega: [rad/s] (M,) mean speed over the interval, with a sign if the readings have one.
        sigma: [rad/s] (M,) standard deviation of that mean, from the timing.
        false: (M,) true for a false capture: the length does not fit the time since the pulse before.
    """

    index: NDArray[np.int64]
    time: Array
    period: Array
    omega: Array
    sigma: Array
    false: NDArray[np.bool_]

    def of(self, which: NDArray[np.bool_]) -> Pulses:
        """The intervals that a mask (M,) selects."""
        return Pulses(*(getattr(self, f.name)[which] for f in fields(self)))

    @property
    def sure(self) -> NDArray[np.bool_]:
        """(M,) true for an interval whose length is known."""
        return self.sigma < UNSURE * np.abs(self.omega)

    def then(self, others: Pulses) -> Pulses:
        """These intervals, followed by others."""
        return Pulses(*(np.concatenate([getattr(self, f.name), getattr(others, f.name)]) for f in fields(self)))

    def false_samples(self, n: int) -> NDArray[np.bool_]:
        """Samples (n,) that hold the speed of a false capture."""
        out = np.zeros(n, dtype=bool)
        ends = np.append(self.index[1:], n)
        for a, b in zip(self.index[self.false], ends[self.false], strict=True):
            out[a:b] = True
        return out


def hold(x: Array) -> Array:
    """Replace each missing value of a series (N,) by the one before it, the first ones by the first known."""
    known = np.flatnonzero(np.isfinite(x))
    return x[known[np.maximum(np.searchsorted(known, np.arange(len(x)), side="right") - 1, 0)]]


def mean_speed(angle: Array, time: Array, length: Array, period: float) -> Array:
    """Mean speed over intervals, from a sampled rotor angle.

    Args:
        angle: [rad] (N,) rotor angle at the samples.
        time: [s] (M,) ends of the intervals.
        length: [s] (M,) lengths.
        period: [s] between samples.

    Returns:
        [rad/s] (M,) mean speeds.
    """
    grid = np.arange(len(angle)) * period
    return (np.interp(time, grid, angle) - np.interp(time - length, grid, angle)) / length


def find_pulses(omega: Array, period: float, sensing: Mapping[str, float]) -> Pulses:
    """Recover the intervals between pulses from a held speed.

    Args:
        omega: [rad/s] (N,) held speed, NaN where missing; a pulse has no direction, so that a sign is the driver's.
        period: [s] between samples.
        sensing: parameters of the measurement chain (`speed_pulses_per_rev`, `speed_tick`, `speed_noise`).

    Returns:
        The intervals that began within the recording.
    """
    turn = 2.0 * math.pi / sensing["speed_pulses_per_rev"]
    signed = hold(omega)
    held = np.abs(signed)
    changes = np.flatnonzero(np.diff(held) != 0.0) + 1  # a sign that changes alone is no pulse
    at = changes[held[changes] > 0.0]
    speed, way = held[at], np.sign(signed[at])
    turned = np.diff(way, prepend=way[:1]) != 0.0  # the rotor turned round in this interval: its length tells no speed
    length = turn / speed if len(at) else np.zeros(0)
    elapsed = np.diff(at, prepend=-(10**9)) * period
    stopped = np.zeros(len(at), dtype=bool)  # the speed read 0 before this interval showed
    stopped[:1] = held[:1] == 0.0
    stopped[1:] = np.minimum.reduceat(held, at)[:-1] == 0.0 if len(at) else []
    known = np.flatnonzero(np.isfinite(omega))
    unseen = at - 1 - known[np.maximum(np.searchsorted(known, at) - 1, 0)]  # missing samples before each, (M,)
    anew = np.zeros(len(at), dtype=bool)  # after a stop: the length of the interval is not known
    passed = length.copy()  # time since the pulse of the interval before
    starts_anew = stopped & (length < SPEED_TIMEOUT)
    after = np.append(speed, [np.inf, np.inf])
    before = np.where(starts_anew & (after[2:] > after[1:-1]), 0.0, np.append(held[:1], speed)[: len(at)])
    beside = turned.copy()  # an interval in which the rotor turned round is no measure for its neighbours
    beside[1:] |= turned[:-1]
    beside[:-1] |= turned[1:]
    alone = (speed > PEAK * np.maximum(before, after[1:-1])) & ~beside
    false = alone.copy()
    for j in range(1, len(at)):
        if not false[j - 1]:
            # an interval repeated to the tick changes no reading: whole multiples may have passed
            passed[j] += max(round((elapsed[j] - length[j]) / length[j - 1]), 0) * length[j - 1]
        late = (1.01 + unseen[j] + unseen[j - 1]) * period + 2.0 * sensing["speed_tick"]
        fits = abs(elapsed[j] - passed[j]) <= late
        false[j] = alone[j] or not (fits or starts_anew[j] or turned[j])
        anew[j] = (turned[j] or not fits) and not false[j]
        if false[j] or stopped[j] or turned[j]:
            passed[j] = np.inf
    time, room = _pulse_times(at, unseen, passed, period)
    room = np.hypot(room, max(period - SAMPLE_PERIOD, 0.0))  # the duty may have stepped between two samples
    slope = np.gradient(way * speed, time) if len(at) > 2 else np.zeros(len(at))
    tick = np.maximum(sensing["speed_tick"], 1e-6) * speed / np.maximum(length, 1e-9) if len(at) else np.zeros(0)
    sigma: Array = np.sqrt(tick**2 + sensing["speed_noise"] ** 2 + (room * slope) ** 2
                           + (CLOCK_TOLERANCE * speed) ** 2)
    sigma = np.where(anew, UNSURE * speed, sigma)
    whole = time >= length  # an interval that began before the recording cannot be simulated
    return Pulses(at[whole], time[whole], length[whole], (way * speed)[whole], sigma[whole], false[whole])


def _pulse_times(at: NDArray[np.int64], unseen: NDArray[np.int64], passed: Array, period: float
                 ) -> tuple[Array, Array]:
    """Instants of pulses, and their uncertainty.

    A pulse fell into the period before its sample. In a run of consecutive intervals this holds for all of them at
    once, which leaves a narrow range for each.

    Args:
        at: (M,) samples in which the pulses show first.
        unseen: (M,) missing samples before those.
        passed: [s] (M,) time since the pulse before; inf where it is not known.
        period: [s] between samples.

    Returns:
        [s] (M,) instants, and (M,) half-widths of their ranges.
    """
    earliest, latest = (at - 1.0 - unseen) * period, at * period
    time, room = 0.5 * (earliest + latest), 0.5 * (latest - earliest)
    start = 0
    while start < len(at):
        low, high, since, stop = earliest[start], latest[start], 0.0, start + 1
        offsets = [0.0]
        while stop < len(at):
            since += passed[stop]
            narrower = max(low, earliest[stop] - since), min(high, latest[stop] - since)
            if not narrower[0] < narrower[1]:
                break
            low, high = narrower
            offsets.append(since)
            stop += 1
        time[start:stop] = 0.5 * (low + high) + np.array(offsets)
        room[start:stop] = 0.5 * (high - low)
        start = stop
    return np.asarray(time, dtype=float), np.asarray(room, dtype=float)
