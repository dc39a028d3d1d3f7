# SPDX-License-Identifier: Apache-2.0
"""One recording on the grid of its samples, cleaned, with the noise of each channel."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.signals.noise import innovation_noise, least_noise, quantised_noise, resolution, white_noise
from aeropend_ident.signals.outliers import far_from_median, jumps_out, saturated
from aeropend_ident.signals.pulses import UNSURE, Pulses, find_pulses, hold
from aeropend_ident.signals.variants import SAME, Variant
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import SAMPLE_PERIOD
from aeropend_sim.wording import counted

Array = NDArray[np.float64]

CHANNELS = {"theta": "rad", "omega": "rad/s", "i_a": "A", "v_a": "V"}
"""The measured channels and their units, in the order of every table."""

MINIMUM_DURATION = 5.0
"""[s] Shortest recording that is diagnosed (choice: some time constants of the arm)."""

STILL = 0.01
"""Change of the duty that is no excitation (choice)."""

AS_MUCH = 0.3
"""Share of its range that the duty moves in a part of the recording in which a channel then should change (choice)."""

LEAST_LEFT = 0.1
"""Least share of the current's readings that must be left beside steps at unknown instants (choice: some seconds)."""

UNREAD = "{} was not read in the part that is fitted: it is left out"

FEWEST = 10
"""Readings below which a channel was not read (choice: fewer give neither a fit nor a gap)."""

SETTLED = 0.012
"""[s] Time after a step of the duty in which the current shows when the step came, and little else.

Choice: about ten electrical time constants L_a/R_a of the preset `bench`."""

ROTOR = 0.25
"""[s] Time constant with which a wrong speed of the rotor dies away (measured: preset `bench` at low speed)."""

DIED_AWAY = 5.0
"""Time constants after which the speed error of one sample of acceleration is below the timing of a pulse (choice)."""


@dataclass(frozen=True)
class Mounting:
    """How the angle's sensor sits on the arm.

    Attributes:
        zero: [rad] reading where the arm hangs.
        flipped: whether the reading falls where the arm is lifted.
    """

    zero: float = 0.0
    flipped: bool = False

    def of(self, s: Signals) -> Signals:
        """A recording whose angle is 0 where the arm hangs, and positive where it is lifted."""
        return replace(s, theta=self.upright(s.theta), mounting=self)

    def upright(self, theta: Array) -> Array:
        """[rad] (N,) The angles of readings (N,), the inverse of `reading`."""
        return self.zero - theta if self.flipped else theta - self.zero

    def reading(self, theta: float) -> float:
        """[rad] The reading at an angle."""
        return self.zero - theta if self.flipped else self.zero + theta

    def notes(self) -> tuple[str, ...]:
        """What a person should know."""
        hangs = f"angle: its motion shows that the arm hangs at a reading of {math.degrees(self.zero):.1f} degrees"
        return tuple([f"{hangs}: taken as zero"] * (self.zero != 0.0)
                     + ["angle: the reading falls where the arm is lifted: its sign is turned"] * self.flipped)


@dataclass(frozen=True)
class Signals:
    """One recording on the grid of its samples.

    Attributes:
        period: [s] between samples.
        duty: (N,) applied duty, 0 to 1, or -1 to 1 if the motor is driven both ways, held where a sample is missing.
        theta: [rad] (N,) arm angle, NaN where missing; likewise:
        omega: [rad/s] (N,) rotor speed.
        i_a: [A] (N,) armature current.
        v_a: [V] (N,) armature voltage.
        sigma: channel -> standard deviation of a reading, with noise and quantisation.
        pulses: the intervals behind omega; None if the speed is sampled directly, or not measured.
        false_speed: (N,) true where omega is wrong: a false capture, or an outlier.
        train: number of samples that models are fitted to; the rest is held out.
        notes: remarks on the data for a person.
        mounting: of the angle's sensor, if it was found from the motion; `theta` is right then.
        hanging: [rad] `theta` while the arm hangs, before it is driven; None if that was not read.
        window: first sample at which effects act that the model lacks, and the first at which they act no more; None:
            they act all the time.
        variant: of the rig in this recording.
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
    window: tuple[int, int] | None = None
    mounting: Mounting | None = None
    hanging: float | None = None
    variant: Variant = SAME

    def __len__(self) -> int:
        return len(self.duty)

    def head(self, n: int) -> Signals:
        """The first n samples."""
        p = self.pulses
        if p is not None:
            p = p.of(p.index < n)
        return replace(self, duty=self.duty[:n], theta=self.theta[:n], omega=self.omega[:n], i_a=self.i_a[:n],
                       v_a=self.v_a[:n], pulses=p, false_speed=self.false_speed[:n], train=min(self.train, n))

    def noted(self, *notes: str) -> Signals:
        """The same recording with further notes, each once."""
        return replace(self, notes=tuple(dict.fromkeys((*self.notes, *notes))))

    def acting(self, stop: int | None = None) -> list[tuple[slice, bool]]:
        """The pieces of the recording, and whether the effects that the model lacks act in each.

        Args:
            stop: sample at which the last piece ends; None: the end.
        """
        end = len(self) if stop is None else min(stop, len(self))
        if self.window is None:
            return [(slice(0, end), True)]
        first, last = (min(k, end) for k in self.window)
        pieces = [(slice(0, first), False), (slice(first, last), True), (slice(last, end), False)]
        return [(piece, acts) for piece, acts in pieces if piece.stop > piece.start]

    @cached_property
    def time(self) -> Array:
        """[s] (N,) Time of each sample after the first."""
        return np.asarray(self.period * np.arange(len(self)), dtype=np.float64)

    @property
    def samples(self) -> int:
        """Number of instants of the grid at which a channel was measured."""
        return int(np.isfinite([self.theta, self.omega, self.i_a, self.v_a]).any(axis=0).sum())

    @property
    def after_unseen(self) -> int:
        """First sample whose voltage cannot come from a duty before the recording, whatever the command delay."""
        return after_unseen(self.period)

    @cached_property
    def both_ways(self) -> bool:
        """Whether the motor is driven in both directions."""
        return bool(np.min(self.duty) < 0.0)

    def turning(self, omega: Array) -> Array:
        """A speed of the rotor (N,) that is at least 0, unless the motor is driven both ways."""
        return omega if self.both_ways else np.maximum(omega, 0.0)

    @cached_property
    def largest_duty(self) -> float:
        """The largest duty, either way."""
        return float(np.abs(self.duty).max())

    @property
    def driven(self) -> bool:
        """Whether a duty acts at any time."""
        return self.largest_duty >= STILL

    def channel(self, name: str) -> Array:
        """A measured channel (N,) by name."""
        return np.asarray(getattr(self, name))

    @property
    def true_speed(self) -> Array:
        """[rad/s] (N,) The speed, NaN where it is known to be wrong."""
        return np.where(self.false_speed, np.nan, self.omega)

    @cached_property
    def measured(self) -> frozenset[str]:
        """The channels that were measured at all."""
        return frozenset(name for name in CHANNELS if np.isfinite(self.channel(name)).any())

    def has(self, name: str) -> bool:
        """Whether a channel was measured at all."""
        return name in self.measured


def after_unseen(period: float) -> int:
    """See `Signals.after_unseen`.

    Args:
        period: [s] between samples.
    """
    return math.ceil(CATALOGUE["command_delay"].parameters["delay"].high / period) + 1


def from_arrays(columns: Mapping[str, Array], period: float, sensing: Mapping[str, float], held_out: float = 0.3,
                name: str = "recording", notes: tuple[str, ...] = ()) -> Signals:
    """Clean the channels of a recording and estimate their noise.

    Args:
        columns: (N,) by channel, and `duty`, on a uniform grid; NaN where missing.
        period: [s] between samples.
        sensing: parameters of the measurement chain.
        held_out: share of the recording at its end that models are not fitted to.
        name: of the recording, for messages.
        notes: remarks so far.

    Raises:
        RecordingError: too short, no angle, no duty, or nothing happens.
    """
    n = len(columns["duty"])
    if n * period < MINIMUM_DURATION:
        raise RecordingError(f"{name}: {n} samples in {n * period:.3g} s; a diagnosis needs {MINIMUM_DURATION:g} s or "
                             "more")
    if not np.isfinite(columns["theta"]).any():
        raise RecordingError(f"{name}: no arm angle was measured (joint_states, position of 'arm'); nothing to compare")
    _check_turns(columns["theta"], name)
    if not np.isfinite(columns["duty"]).any():
        raise RecordingError(f"{name}: no duty was recorded (armature.percentage or duty_command); "
                             "without it the model has no input; record one of them too, or use --uncalibrated if the "
                             "voltage was measured or the arm swings freely")
    duty, unsure = _between_samples(columns["duty"])
    shaken = np.zeros(n, dtype=bool)
    for gap in unsure:
        shaken[gap.stop:gap.stop + round(ROTOR * (DIED_AWAY + math.log(gap.stop - gap.start)) / period)] = True
    train = max(1, round(n * (1.0 - held_out)))
    columns, said = {channel: np.where(np.isfinite(x), x, np.nan) for channel, x in columns.items()}, [*notes]
    said += _leave_out_stuck(columns, duty, train)
    said += _leave_out_unread(columns, period, train)
    said += _leave_out(columns, period, train)
    said += _leave_out_unread(columns, period, train)
    for part, where in ((slice(train), "fitted"), (slice(train, n), f"held out, the last {n - train} samples")):
        if n > train and np.isfinite(columns["theta"][part]).sum() < FEWEST:
            raise RecordingError(f"{name}: the arm angle was not read in the part that is {where}: it is missing, "
                                 "stuck or at the end of its range; record again, or cut that part off")
    _check_turns(columns["theta"], name)
    if period > 1.25 * SAMPLE_PERIOD:  # the duty may have stepped between two samples
        steps = np.flatnonzero(np.abs(np.diff(duty)) > STILL) + 1
        near = steps[:, None] + np.arange(math.ceil(SETTLED / period) + 1)
        columns["i_a"] = columns["i_a"].copy()
        columns["i_a"][np.minimum(near, n - 1)] = np.nan
    sigma = _noise(columns, duty, sensing, train)
    if len(unsure):
        said.append(f"{counted(len(unsure), 'step')} of the duty fell between samples, into lost ones, at an instant "
                    "that nothing shows: current and speed are not compared just after")
        left = np.where(shaken, np.nan, columns["i_a"])
        if np.isfinite(left).sum() < LEAST_LEFT * np.isfinite(columns["i_a"]).sum():
            said.append("the duty steps so often that hardly any reading of the current is left: it is not compared")
            left = np.full(n, np.nan)
        columns["i_a"] = left
    if np.ptp(duty) < STILL and np.nanstd(columns["theta"]) < 2.0 * sigma["theta"]:
        raise RecordingError(f"{name}: nothing happens in it, duty and angle stay where they are, so no verdict is "
                             "possible; record while `excite` runs")
    pulses = None
    if sensing["speed_pulses_per_rev"] > 0.0 and np.isfinite(columns["omega"]).any():
        pulses = find_pulses(columns["omega"], period, sensing)
        pulses = find_pulses(columns["omega"][:train], period, sensing).then(pulses.of(pulses.index >= train))
        pulses = replace(pulses, sigma=np.where(shaken[pulses.index], UNSURE * np.abs(pulses.omega), pulses.sigma))
    false_speed = pulses.false_samples(n) if pulses else split_apply(
        lambda x: far_from_median(x, sigma["omega"]), columns["omega"], train)
    known = np.isfinite(columns["omega"])
    true = known & ~false_speed
    if known.any() and true[:train].sum() < FEWEST:
        columns["omega"], pulses, false_speed = np.full(n, np.nan), None, np.zeros(n, dtype=bool)
        said.append(UNREAD.format("omega"))
    elif known[train:].any() and true[train:].sum() < FEWEST:
        columns["omega"] = np.where(np.arange(n) < train, columns["omega"], np.nan)
        false_speed[train:] = False
        pulses = None if pulses is None else pulses.of(pulses.index < train)
        said.append("omega is false in the part that is held out: it is left out there")
    return Signals(period, duty, columns["theta"], columns["omega"], columns["i_a"], columns["v_a"], sigma, pulses,
                   false_speed, train, tuple(said))


def split_apply(of: Callable[[Array], NDArray[Any]], x: Array, train: int) -> NDArray[Any]:
    """Apply a function to a series so that the held-out part does not act on the training part.

    Args:
        of: function of a series (M,) that returns a series (M,).
        x: (N,) series.
        train: number of samples in the training part.

    Returns:
        (N,) The training part as the function of itself alone, the rest as the function of the whole series.
    """
    return np.concatenate([of(x[:train]), of(x)[train:]])


def _between_samples(duty: Array) -> tuple[Array, list[slice]]:
    """The duty (N,) without gaps, and the gaps in which it stepped at an unknown instant.

    The step is put into the middle of the gap, where its error is least; into the middle of a sample period by the
    mean of both duties.
    """
    held = hold(duty)
    known = np.flatnonzero(np.isfinite(duty))
    before, after = known[:-1], known[1:]
    gaps = (after - before > 1) & (np.abs(duty[after] - duty[before]) > STILL)
    for a, b in zip(before[gaps], after[gaps], strict=True):
        middle = 0.5 * (a + b + 1)
        held[math.ceil(middle):b] = duty[b]
        if middle != math.ceil(middle):
            held[math.floor(middle)] = 0.5 * (duty[a] + duty[b])
    return held, [slice(int(a) + 1, int(b)) for a, b in zip(before[gaps], after[gaps], strict=True)]


def _noise(columns: Mapping[str, Array], duty: Array, sensing: Mapping[str, float], train: int) -> dict[str, float]:
    """Standard deviation of a reading by channel: as the readings show it, as the model states it if they are few.

    It is above 0, also where a model states no noise. The resolution counts in any case: while a coarse channel rests
    it shows no noise.
    """
    sigma = {"omega": max(sensing["speed_noise"], white_noise(columns["omega"][:train]))}
    for channel, key in (("theta", "angle"), ("i_a", "current"), ("v_a", "voltage")):
        x, stated = columns[channel][:train], sensing[f"{key}_lsb"]
        seen = innovation_noise(x, duty[:train])
        if seen is None:
            seen = math.hypot(sensing[f"{key}_noise"], stated / math.sqrt(12.0))
        sigma[channel] = max(seen, quantised_noise(x, resolution(x) or stated), least_noise(x))
    return sigma


def _check_turns(theta: Array, name: str) -> None:
    known = theta[np.isfinite(theta)]
    if len(known) >= FEWEST and np.ptp(known) == 0.0:
        raise RecordingError(f"{name}: the arm angle is {known[0]:.3g} rad in all readings: the sensor is stuck or "
                             "unplugged, or the arm is held; check it, and record again")


def _leave_out_stuck(columns: dict[str, Array], duty: Array, train: int) -> list[str]:
    """Replace readings that do not change while the duty does by NaN; returns a note for each channel."""
    said = []
    for channel, unit in CHANNELS.items():
        x = columns[channel]
        whole = channel != "theta" and _is_stuck(x, duty, STILL)
        parts = [(slice(None), "")] if whole else [
            (part, where) for part, where in ((slice(train), " in the part that is fitted"),
                                              (slice(train, None), " in the part that is held out"))
            if _is_stuck(x[part], duty[part], AS_MUCH * float(np.ptp(duty)))]
        for part, where in parts:
            value = float(x[part][np.isfinite(x[part])][0])
            said.append(f"{channel} is {value:g} {unit} all the time{where}, whatever the duty: it is left out")
            columns[channel] = columns[channel].copy()
            columns[channel][part] = np.nan
    return said


def _leave_out_unread(columns: dict[str, Array], period: float, train: int) -> list[str]:
    """Leave out a channel of the motor that has no readings to fit to; returns a note for each."""
    said = []
    for channel in ("omega", "i_a", "v_a"):
        known = np.isfinite(columns[channel])
        start = after_unseen(period) if channel == "v_a" else 0
        if known.any() and known[start:train].sum() < FEWEST:
            columns[channel] = np.full(len(known), np.nan)
            said.append(UNREAD.format(channel))
    return said


def _is_stuck(x: Array, duty: Array, moved: float) -> bool:
    """Whether a channel (N,) does not change while the duty (N,) moves by more than `moved`."""
    known = x[np.isfinite(x)]
    return bool(len(known) and np.ptp(known) == 0.0 and np.ptp(duty) > moved)


def _leave_out(columns: dict[str, Array], period: float, train: int) -> list[str]:
    """Replace saturated readings and outliers in the columns by NaN; returns a note for each kind."""
    said = []
    for channel, unit in CHANNELS.items():
        x = columns[channel]
        if channel != "omega":  # a speed is held between its pulses
            limit = split_apply(partial(saturated, period=period, smooth=channel == "theta"), x, train)
            if limit.any():
                ends = " and ".join(f"{e:g}" for e in np.unique(x[limit]))
                said.append(f"{channel} sits at {ends} {unit}, the end of its range, for {100.0 * limit.mean():.1f} % "
                            "of the time: it is left out there")
            x = np.where(limit, np.nan, x)
        alone = split_apply(partial(jumps_out, sigma=white_noise(x[:train])), x, train)
        if alone.any():
            said.append(f"{channel}: {alone.sum()} single readings jump out and are left out")
        columns[channel] = np.where(alone, np.nan, x)
    return said
