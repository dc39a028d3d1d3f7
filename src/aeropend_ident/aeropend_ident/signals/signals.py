# SPDX-License-Identifier: Apache-2.0
"""What a recording offers to the diagnosis: channels on a uniform grid, their noise, the pulses behind the speed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.bags.recording import Recording, RecordingError
from aeropend_ident.signals.outliers import jumps_out, saturated
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import SAMPLE_PERIOD
from aeropend_sim.model.sensing import SPEED_TIMEOUT

Array = NDArray[np.float64]

CHANNELS = {"theta": "rad", "omega": "rad/s", "i_a": "A", "v_a": "V"}
"""The measured channels and their units, in the order of every table."""

MINIMUM_DURATION = 5.0
"""s of data below which nothing is said."""


STILL = 0.01
"""Duty that changes by less is no excitation."""

SETTLED = 0.012
"""s after a step of the duty in which the current says when the step came, and little else."""

PEAK = 1.25
"""A rotor is too heavy for one interval to be this much faster than both of its neighbours."""


@dataclass(frozen=True)
class Pulses:
    """The speed as its pulses gave it: one entry for each interval that completed.

    Attributes:
        index: (M,) sample in which the new speed first shows.
        time: (M,) s, estimated end of the interval; at most one sample early.
        period: (M,) s, its length.
        omega: (M,) rad/s, mean speed over it.
        sigma: (M,) rad/s, what its timing leaves uncertain.
        false: (M,) the period does not fit the time that passed since the pulse before: a false capture.
    """

    index: NDArray[np.int64]
    time: Array
    period: Array
    omega: Array
    sigma: Array
    false: NDArray[np.bool_]

    def of(self, which: NDArray[np.bool_]) -> Pulses:
        """Those of them, by mask (M,)."""
        return Pulses(*(getattr(self, f.name)[which] for f in fields(self)))

    def then(self, others: Pulses) -> Pulses:
        """These, and the others after them."""
        return Pulses(*(np.concatenate([getattr(self, f.name), getattr(others, f.name)]) for f in fields(self)))


@dataclass(frozen=True)
class Signals:
    """One recording on the grid of its samples.

    Attributes:
        period: s between samples.
        duty: (N,) applied duty, 0..1, held where a sample is missing.
        theta, omega, i_a, v_a: (N,) measured, NaN where missing.
        sigma: channel -> standard deviation of a reading (noise and quantisation).
        pulses: the intervals behind omega, or None where the speed is sampled directly or not at all.
        false_speed: (N,) where omega is known to be false: a false period, or a sample that stands alone.
        train: number of samples that models are fitted to; the rest is held out.
        notes: what a person should know about the data.
    """

    period: float
    duty: Array
    theta: Array
    omega: Array
    i_a: Array
    v_a: Array
    sigma: Mapping[str, float]
    pulses: Pulses | None
    false_speed: NDArray[np.bool_]
    train: int
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.duty)

    def head(self, n: int) -> Signals:
        """The first n samples."""
        p = self.pulses
        if p is not None:
            p = p.of(p.index < n)
        return replace(self, duty=self.duty[:n], theta=self.theta[:n], omega=self.omega[:n], i_a=self.i_a[:n],
                       v_a=self.v_a[:n], pulses=p, false_speed=self.false_speed[:n], train=min(self.train, n))

    @property
    def samples(self) -> int:
        """Instants of the grid at which something was measured."""
        return int(np.isfinite([self.theta, self.omega, self.i_a, self.v_a]).any(axis=0).sum())

    @property
    def after_unseen(self) -> int:
        """First sample whose voltage no duty from before the recording can have set, however late it acts."""
        return math.ceil(CATALOGUE["command_delay"].parameters["delay"].high / self.period) + 1

    @property
    def driven(self) -> bool:
        """Whether a duty ever acts."""
        return bool(np.max(self.duty) >= STILL)

    def channel(self, name: str) -> Array:
        """A measured channel by name, (N,)."""
        return np.asarray(getattr(self, name))

    @property
    def true_speed(self) -> Array:
        """The speed (N,) with what is known to be false taken out (NaN)."""
        return np.where(self.false_speed, np.nan, self.omega)

    def has(self, name: str) -> bool:
        """Whether a channel was measured at all."""
        return bool(np.isfinite(self.channel(name)).any())


def from_recording(recording: Recording, sensing: Mapping[str, float], held_out: float = 0.3) -> Signals:
    """Put a recording on the uniform grid of its samples.

    Args:
        recording: what was read.
        sensing: the model's measurement chain.
        held_out: share of the recording at its end that models are not fitted to.

    Raises:
        RecordingError: too short, no angle, or no duty.
    """
    index = np.rint((recording.stamp_ns - recording.stamp_ns[0]) / (recording.period * 1e9)).astype(np.int64)
    n = int(index[-1]) + 1
    period = float(recording.stamp_ns[-1] - recording.stamp_ns[0]) * 1e-9 / max(n - 1, 1)
    columns = {}
    for name in (*CHANNELS, "duty"):
        columns[name] = np.full(n, np.nan)
        columns[name][index] = getattr(recording, name)
    return from_arrays(columns, period, sensing, held_out, recording.path, recording.notes)


def from_arrays(columns: Mapping[str, Array], period: float, sensing: Mapping[str, float], held_out: float = 0.3,
                name: str = "recording", notes: tuple[str, ...] = ()) -> Signals:
    """As `from_recording`, from arrays (N,) by channel name and `duty`, on a uniform grid of `period` seconds.

    Raises:
        RecordingError: too short, no angle, or no duty.
    """
    n = len(columns["duty"])
    if n * period < MINIMUM_DURATION:
        raise RecordingError(f"{name}: {n * period:.1f} s of samples; a diagnosis needs {MINIMUM_DURATION:g} s or more")
    if not np.isfinite(columns["theta"]).any():
        raise RecordingError(f"{name}: no arm angle was measured (joint_states, position of 'arm'); nothing to compare")
    if not np.isfinite(columns["duty"]).any():
        raise RecordingError(f"{name}: no duty was recorded (armature.percentage or duty_command); "
                             "without it the model has no input")
    duty = _held(columns["duty"])
    train = max(1, round(n * (1.0 - held_out)))
    columns, said = dict(columns), [*notes]
    for channel in ("omega", "i_a", "v_a"):
        x = columns[channel][np.isfinite(columns[channel])]
        if len(x) and np.ptp(x) == 0.0 and np.ptp(duty) > STILL:
            columns[channel] = np.full(n, np.nan)
            said.append(f"{channel} is {x[0]:g} {CHANNELS[channel]} all the time, whatever the duty: it is left out")
    said += _left_out(columns, train)
    if np.ptp(columns["theta"][np.isfinite(columns["theta"])]) == 0.0:
        raise RecordingError(f"{name}: the arm angle stays the same all the time: the sensor or the arm is stuck, "
                             "so no verdict is possible")
    if period > 1.25 * SAMPLE_PERIOD:  # the duty may have stepped between two samples
        steps = np.flatnonzero(np.abs(np.diff(duty)) > STILL) + 1
        near = steps[:, None] + np.arange(math.ceil(SETTLED / period) + 1)
        columns["i_a"] = columns["i_a"].copy()
        columns["i_a"][np.minimum(near, n - 1)] = np.nan
    lsb = {"theta": "angle", "i_a": "current", "v_a": "voltage"}
    sigma = {"omega": max(sensing["speed_noise"], _noise_of(columns["omega"][:train]))}
    for channel, key in lsb.items():
        stated = math.hypot(sensing[f"{key}_noise"], sensing[f"{key}_lsb"] / math.sqrt(12.0))
        seen = _noise_of(columns[channel][:train])
        sigma[channel] = seen if seen > 2.0 * stated else stated  # quantisation spoils what is seen of a small noise
    if np.ptp(duty) < STILL and np.nanstd(columns["theta"]) < 2.0 * sigma["theta"]:
        raise RecordingError(f"{name}: nothing happens in it, duty and angle stay where they are, so no verdict is "
                             "possible; record while `excite` runs")
    pulses = None
    if sensing["speed_pulses_per_rev"] > 0.0 and np.isfinite(columns["omega"]).any():
        pulses = find_pulses(columns["omega"], period, sensing)
        pulses = find_pulses(columns["omega"][:train], period, sensing).then(pulses.of(pulses.index >= train))
    false_speed = _held_false(pulses, n) if pulses else apart(
        lambda x: _outliers(x, sigma["omega"]), columns["omega"], train)
    return Signals(period, duty, columns["theta"], columns["omega"], columns["i_a"], columns["v_a"], sigma, pulses,
                   false_speed, train, tuple(said))


def apart(of: Callable[[Array], NDArray[Any]], x: Array, train: int) -> NDArray[Any]:
    """`of` a channel x (N,), but what models are fitted to is worked out from itself alone."""
    return np.concatenate([of(x[:train]), of(x)[train:]])


def _left_out(columns: dict[str, Array], train: int) -> list[str]:
    """Take readings at the end of their range, and single ones that jump out, from the columns; says which."""
    said = []
    for channel, unit in CHANNELS.items():
        x = columns[channel]
        if channel != "omega":  # a speed is held between its pulses
            limit = apart(partial(saturated, smooth=channel == "theta"), x, train)
            if limit.any():
                ends = " and ".join(f"{e:g}" for e in np.unique(x[limit]))
                said.append(f"{channel} sits at {ends} {unit}, the end of its range, for {100.0 * limit.mean():.1f} % "
                            "of the time: it is left out there")
            x = np.where(limit, np.nan, x)
        alone = apart(partial(jumps_out, sigma=_noise_of(x[:train])), x, train)
        if alone.any():
            said.append(f"{channel}: {alone.sum()} single readings jump out and are left out")
        columns[channel] = np.where(alone, np.nan, x)
    return said


def _held(x: Array) -> Array:
    """Each missing value takes the one before it; those before the first take the first."""
    known = np.flatnonzero(np.isfinite(x))
    return x[known[np.maximum(np.searchsorted(known, np.arange(len(x)), side="right") - 1, 0)]]


def _noise_of(x: Array) -> float:
    """White noise of a channel from its second differences, robust against steps, and from its resolution."""
    x = x[np.isfinite(x)]
    if len(x) < 10:
        return 1e-6
    levels = np.unique(x)
    resolution = float(np.median(np.diff(levels))) if 1 < len(levels) < len(x) / 10 else 0.0
    white = float(np.median(np.abs(np.diff(x, 2)))) / 0.6745 / math.sqrt(6.0)
    return max(white, resolution / math.sqrt(12.0), 1e-6 * float(np.ptp(x)), 1e-9)


def _pulse_times(at: NDArray[np.int64], unseen: NDArray[np.int64], passed: Array, period: float
                 ) -> tuple[Array, Array]:
    """Instants (M,) of pulses, and by how much each may be off either way (M,).

    Args:
        at: (M,) samples in which they show first. unseen: (M,) samples missing before those.
        passed: (M,) s since the pulse before; inf where that is not known. period: s between samples.

    A pulse fell into the period before its sample. Where intervals follow each other without a break, that holds for
    all of them at once, and leaves little room for any.
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


def _held_false(pulses: Pulses, n: int) -> NDArray[np.bool_]:
    """The samples (n,) at which a false period is held."""
    out = np.zeros(n, dtype=bool)
    ends = np.append(pulses.index[1:], n)
    for a, b in zip(pulses.index[pulses.false], ends[pulses.false], strict=True):
        out[a:b] = True
    return out


def _outliers(x: Array, sigma: float) -> NDArray[np.bool_]:
    """Samples (N,) that stand alone: far from the median of their neighbours, which agree with each other."""
    if len(x) < 7:
        return np.zeros(len(x), dtype=bool)
    window = np.lib.stride_tricks.sliding_window_view(np.pad(x, 3, mode="edge"), 7)
    known = np.isfinite(window).sum(axis=1) >= 4
    median, spread = np.zeros(len(x)), np.zeros(len(x))
    median[known] = np.nanmedian(window[known], axis=1)
    spread[known] = np.nanmedian(np.abs(window[known] - median[known, None]), axis=1)
    return known & (np.abs(x - median) > 8.0 * (sigma + spread) + 0.1 * np.abs(median))


def find_pulses(omega: Array, period: float, sensing: Mapping[str, float]) -> Pulses:
    """Recover the intervals between pulses from a held speed (N,) sampled every `period` s."""
    turn = 2.0 * math.pi / sensing["speed_pulses_per_rev"]
    held = _held(omega)
    changes = np.flatnonzero(np.diff(held) != 0.0) + 1
    at = changes[held[changes] > 0.0]
    speed = held[at]
    length = turn / speed if len(at) else np.zeros(0)
    elapsed = np.diff(at, prepend=-(10**9)) * period
    stopped = np.zeros(len(at), dtype=bool)  # the speed read 0 before this interval showed
    stopped[:1] = held[:1] == 0.0
    stopped[1:] = np.minimum.reduceat(held, at)[:-1] == 0.0 if len(at) else []
    known = np.flatnonzero(np.isfinite(omega))
    unseen = at - 1 - known[np.maximum(np.searchsorted(known, at) - 1, 0)]  # samples missing before each, (M,)
    anew = np.zeros(len(at), dtype=bool)  # after a stop: nothing says how long the interval was
    passed = length.copy()  # time since the pulse of the interval before
    starts_anew = stopped & (length < SPEED_TIMEOUT)
    after = np.append(speed, [np.inf, np.inf])
    before = np.where(starts_anew & (after[2:] > after[1:-1]), 0.0, np.append(held[:1], speed)[: len(at)])
    alone = speed > PEAK * np.maximum(before, after[1:-1])
    false = alone.copy()
    for j in range(1, len(at)):
        if not false[j - 1]:
            # a period repeated to the tick does not show: whole multiples of the one before may have passed unseen
            passed[j] += max(round((elapsed[j] - length[j]) / length[j - 1]), 0) * length[j - 1]
        late = (1.01 + unseen[j] + unseen[j - 1]) * period + 2.0 * sensing["speed_tick"]
        fits = abs(elapsed[j] - passed[j]) <= late
        false[j] = alone[j] or not (fits or starts_anew[j])
        anew[j] = not fits and not false[j]
        if false[j] or stopped[j]:
            passed[j] = np.inf
    time, room = _pulse_times(at, unseen, passed, period)
    room = np.hypot(room, max(period - SAMPLE_PERIOD, 0.0))  # the duty may have stepped between two samples
    slope = np.gradient(speed, time) if len(at) > 2 else np.zeros(len(at))
    tick = np.maximum(sensing["speed_tick"], 1e-6) * speed / np.maximum(length, 1e-9) if len(at) else np.zeros(0)
    sigma: Array = np.sqrt(tick**2 + sensing["speed_noise"] ** 2 + (room * slope) ** 2 + (2e-4 * speed) ** 2)
    sigma = np.where(anew, 0.5 * speed, sigma)
    whole = time >= length  # an interval that began before the recording cannot be simulated
    return Pulses(at[whole], time[whole], length[whole], speed[whole], sigma[whole], false[whole])
