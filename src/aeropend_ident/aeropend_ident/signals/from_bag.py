# SPDX-License-Identifier: Apache-2.0
"""A bag as signals: read, cut at pauses, put on a grid, cleaned.

Of a calibrated rig the model file states the measurement chain, and the stamps must keep the sample period. Of an
uncalibrated rig noise and resolution are estimated from the recording, stamps may be irregular, and the command may be
missing.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.bags import judging, recording
from aeropend_ident.bags.mending import mend, named
from aeropend_ident.bags.recording import Recording, RecordingError
from aeropend_ident.signals import mistakes
from aeropend_ident.signals.free_decay import degrees, free_decay
from aeropend_ident.signals.grid import check_period, irregular_grid, longest_piece, regular_grid
from aeropend_ident.signals.mistakes import Mistake
from aeropend_ident.signals.noise import reading_noise_at, white_noise_at
from aeropend_ident.signals.outliers import joined_turns, jumps_out
from aeropend_ident.signals.pulses import hold
from aeropend_ident.signals.signals import CHANNELS, MINIMUM_DURATION, STILL, Mounting, Signals, from_arrays
from aeropend_sim.model.parameters import Model
from aeropend_sim.wording import counted

Array = NDArray[np.float64]

FEWEST = 30
"""Samples of an uncalibrated rig below which there is no verdict (choice).

Measured: at ±30 % no verdict of 5 recordings changes (docs/results/thresholds.md)."""

LONGEST_PERIOD = 5e-3
"""[s] Longest period of the grid on which a command acts; the angle may be read at a lower rate.

Choice: a command that is late by half of it moves the arm by less than a reading's noise.

Measured: at ±30 % no verdict of 5 recordings changes (docs/results/thresholds.md)."""

SLOWEST = 0.2
"""[s] Longest sample period of a recording with a verdict (choice: five samples in a swing of the arm of `bench`)."""

FOLLOWED = 0.9
"""Share of the steps of the duty that the commands must explain to fill in the samples that are lost (choice)."""

LATEST = 3
"""Samples between a command and the sample that reports it, at most (choice: a bridge has one or two)."""

MOVES = 3.0
"""Standard deviations of a reading that a channel must vary by to show that the motor runs (choice).

Measured: at ±30 % no verdict of 5 recordings changes (docs/results/thresholds.md)."""


MOST_MISSING = 100
"""Greatest ratio of missing samples to samples with which a recording is simulated (choice; it bounds the memory)."""

MOST_PLACES = 500
"""Greatest ratio of the places of a grid to the samples on it (choice; it bounds the memory)."""

AS_LONG = 1.2
"""Ratio by which the span of stamps may miss that of the receive times (choice: a recorder may begin late)."""

FASTEST_RATE = 20e3
"""[1/s] Samples in a second above which stamps are in another unit (choice: far above what a board of a rig sends)."""

BACKWARDS = 0.02
"""Voltage of the other sign, over the largest, that is no drive in both directions (choice: an offset)."""

RESTS, SETTLES, MOSTLY = 0.02, 0.05, 0.5
"""Change of angle and duty, over their range, that is rest; time after the last motion, over that before it, that is
kept; and share of the held-out part that rests from which on it is left out (choice)."""


def signals_of(bag: str | Path, namespace: str | None, model: Model, held_out: float = 0.3, *,
               fit_nominal: bool = False, mounting: Mounting | None = None) -> Signals:
    """Read a bag as signals.

    Args:
        bag: folder or file; see `recording.read`.
        namespace: of the rig, if the bag holds several.
        model: gives the parameters of the measurement chain, and the duty of a voltage.
        held_out: share of the recording at its end that models are not fitted to.
        fit_nominal: whether the rig is uncalibrated.
        mounting: of the angle's sensor, if it is known; the caller applies it.

    Raises:
        RecordingError: no verdict is possible; one line that says why.
    """
    return as_signals(recording.read(bag, namespace), model, held_out, fit_nominal=fit_nominal, mounting=mounting)


def as_signals(read: Recording, model: Model, held_out: float = 0.3, *, fit_nominal: bool = False,
               mounting: Mounting | None = None) -> Signals:
    """A recording as signals; arguments and errors as for `signals_of`.

    Args:
        read: the recording.
        model: gives the parameters of the measurement chain, and the duty of a voltage.
        held_out: share of the recording at its end that models are not fitted to.
        fit_nominal: whether the rig is uncalibrated.
        mounting: of the angle's sensor, if it is known; the caller applies it.
    """
    if not np.isfinite(read.theta).any():
        raise RecordingError(f"{read.path}: {no_angle(read)}; nothing to compare")
    check_stamps(read)
    theta, jumps = joined_turns(read.theta)
    if jumps:
        said = f"theta jumps by a turn {counted(jumps, 'time')}, from an end of its range to the other: joined"
        read = replace(read, theta=theta, notes=(*read.notes, said))
    if float(np.nanmin(read.duty, initial=0.0)) < -STILL:
        read = _driven_backward(read, reverses=fit_nominal or model.model["reverse"] > 0.0)
    sense, slowest = model.sensing, float(np.nanmin(read.omega, initial=0.0))
    if slowest < 0.0 < sense["speed_pulses_per_rev"] and not _held_by_pulses(read, sense):
        sense = {**sense, "speed_pulses_per_rev": 0.0}
        said = ("omega goes below 0 and is not held from pulse to pulse: taken as sampled, as with "
                "speed_pulses_per_rev: 0")
        read = replace(read, notes=(*read.notes, said))
    if read.period > SLOWEST:
        raise RecordingError(f"{read.path}: its samples are {read.period:.3g} s apart, which shows no swing of an arm; "
                             "record 20 or more a second")
    if not fit_nominal:
        check_period(read)
        piece = longest_piece(with_voltage_as_command(read, model.model["v_full"]) if model.model["v_full"] else read)
        if not np.isfinite(piece.duty).any() and (why := _noted(read, recording.NO_DUTY)) is not None:
            raise RecordingError(f"{read.path}: no duty: {why}")
        return from_recording(checked(piece, model, mounting), sense, held_out)
    piece = longest_piece(read)
    if len(piece) < FEWEST:
        raise RecordingError(f"{read.path}: {counted(len(piece), 'sample')} without a pause "
                             f"{'is' if len(piece) == 1 else 'are'} too few for a verdict: record {MINIMUM_DURATION:g} "
                             "s or more without a pause")
    piece = with_voltage_as_command(piece)
    likely = mistakes.without_model(piece.theta, piece.duty, piece.i_a, piece.v_a)
    piece = replace(piece, notes=(*piece.notes, *(named(mistakes.said([one]), read.path) for one in likely)))
    return from_uncalibrated(piece, sense, held_out)


def checked(read: Recording, model: Model, mounting: Mounting | None = None) -> Recording:
    """A recording of a calibrated rig, with a note on each likely mistake of its units, signs, zero and columns.

    Args:
        read: the recording.
        model: the nominal model.
        mounting: of the angle's sensor, if it is known.

    Raises:
        RecordingError: a mistake is sure: no result could be right.
    """
    likely = likely_mistakes(read, model, mounting)
    if sure := [one for one in likely if one.sure]:
        raise RecordingError(f"{read.path}: {named(mistakes.said(sure), read.path)}")
    return replace(read, notes=(*read.notes, *(named(mistakes.said([one]), read.path) for one in likely)))


def no_angle(read: Recording) -> str:
    """Why a recording has no angle, and what to do if the arm has another name."""
    positions = [name for name in read.others if f"{name}.velocity" in read.others or not name.endswith(".velocity")]
    if not positions:
        said = _noted(read, recording.NO_JOINT, recording.NO_JOINTS, recording.NO_POSITION, judging.of("theta"))
        return f"no arm angle: {said}" if said else (
            "no arm angle was measured (joint_states, position of 'arm'): it is missing or NaN in all messages; check "
            "the sensor and the program that publishes them, and record again")
    options = [f"--theta {positions[0]}:rad"]
    speeds = [name for name in read.others if name.endswith(".velocity") and name != f"{positions[0]}.velocity"]
    if not np.isfinite(read.omega).any() and speeds:
        options.append(f"--omega {speeds[0]}:rad/s")
    names = dict.fromkeys(recording.shown(name.removesuffix(".velocity")) for name in read.others)
    return (f"no arm angle: joint_states has {'the joint' if len(names) == 1 else 'joints named'} {', '.join(names)}, "
            f"none is called arm: if {recording.shown(positions[0])} is the arm, "
            f"{named(mend(*(shlex.join(option.split(' ', 1)) for option in options)), read.path)}")


def _noted(read: Recording, *words: str) -> str | None:
    """The first note of a recording with one of these words."""
    return next((note for note in read.notes if any(word in note for word in words)), None)


def check_stamps(read: Recording) -> None:
    """Refuse a recording whose stamps are in a smaller unit, by the times at which it was received, or by its rate.

    Raises:
        RecordingError: they are; one line with the command that mends it.
    """
    received = float(np.ptp(read.received_ns)) * 1e-9
    if not 0.0 < read.duration < MINIMUM_DURATION:
        return
    power = round(math.log10(received / read.duration) / 3.0) if received >= MINIMUM_DURATION else 0
    if power >= 1 and 1.0 / AS_LONG < received / read.duration / 1000.0**power < AS_LONG:
        raise RecordingError(f"{read.path}: its stamps span {read.duration:.3g} s, but it was received over "
                             f"{received:.3g} s: if the stamps are in another unit, "
                             f"{named(mend(f'--time t:{1000**power}s'), read.path)}")
    if (rate := len(read) / read.duration) > FASTEST_RATE:
        unit = f"{1000 ** math.ceil(math.log10(rate / FASTEST_RATE) / 3.0)}s"
        raise RecordingError(f"{read.path}: {len(read)} samples in {read.duration:.3g} s, {rate:.3g} a second: if the "
                             f"stamps are in another unit, {named(mend(f'--time t:{unit}'), read.path)}")


def likely_mistakes(read: Recording, model: Model, mounting: Mounting | None = None) -> list[Mistake]:
    """Likely mistakes of units, signs, zero and columns in a recording of a calibrated rig.

    Args:
        read: the recording.
        model: the nominal model.
        mounting: of the angle's sensor, if it is known.
    """
    piece = longest_piece(replace(read, theta=joined_turns(read.theta)[0]))
    if not piece.period > 0.0 or piece.duration > MOST_MISSING * len(piece) * piece.period:
        return []
    index, period = regular_grid(piece)
    columns = _columns(piece, index)
    if not np.isfinite(columns["duty"]).any():
        return []
    columns["theta"] = (mounting or Mounting()).upright(columns["theta"])
    likely = mistakes.found(columns, hold(columns["duty"]), period, model)
    if any(mistakes.JUMPS in one.what for one in likely) and (off := _noted(read, recording.OFF)) is not None:
        return [Mistake(f"the angle jumps, and {off}", sure=True)]
    return likely


def _driven_backward(read: Recording, *, reverses: bool) -> Recording:
    """A recording with duties below 0: a speed whose readings do not tell the direction is left out.

    Args:
        read: the recording.
        reverses: whether the bridge reverses the motor there; else it brakes.
    """
    if not reverses:
        said = "the duty goes below 0: the bridge of this model brakes there (its parameter `reverse` is 0)"
        return replace(read, notes=(*read.notes, said))
    if not np.isfinite(read.omega).any() or np.nanmin(read.omega) < 0.0:
        return read
    said = "omega: the motor is driven both ways, and its speed is read without a sign: left out"
    return replace(read, omega=np.full(len(read.omega), np.nan), notes=(*read.notes, said))


def with_voltage_as_command(read: Recording, full: float | None = None) -> Recording:
    """A recording without commands whose voltage was measured: the voltage over that of full duty is its duty.

    Args:
        read: the recording.
        full: [V] voltage of full duty; the largest one if it is not given.

    Raises:
        RecordingError: the voltage is larger; one line that says what to do.
    """
    v = read.v_a
    known = np.isfinite(v)
    if np.isfinite(read.duty).any() or known.sum() <= FEWEST:
        return read
    noise = reading_noise_at((read.stamp_ns - read.stamp_ns[0]) * 1e-9, v)
    bottom, largest = float(v[known].min()), float(np.abs(v[known]).max())
    if float(np.ptp(v[known])) <= MOVES * noise:
        return read
    top = largest if full is None else full
    if largest > top + MOVES * noise:
        raise RecordingError(f"{read.path}: the voltage reaches {largest:.3g} V, more than the {top:.3g} V of full "
                             "duty: correct v_full in the model file")
    low = -1.0 if bottom < -max(MOVES * noise, BACKWARDS * top) else 0.0
    of = "its largest value" if full is None else "that of full duty"
    said = (f"no command was recorded: the voltage over {of}, {top:.3g} V, takes its place; nothing is said of bridge "
            "and supply")
    return replace(read, duty=np.clip(v / top, low, 1.0), v_a=np.full(len(v), np.nan), notes=(*read.notes, said))


def from_recording(read: Recording, sensing: Mapping[str, float], held_out: float = 0.3) -> Signals:
    """Signals of a calibrated rig.

    Args:
        read: the recording.
        sensing: parameters of the model's measurement chain.
        held_out: share of the recording at its end that models are not fitted to.

    Raises:
        RecordingError: no verdict is possible; one line that says why.
    """
    index, period = regular_grid(read)
    columns = _columns(read, index)
    columns["duty"] = with_commands(columns["duty"], read, index)
    return from_arrays(columns, period, sensing, held_out, read.path, read.notes)


def from_uncalibrated(read: Recording, sensing: Mapping[str, float], held_out: float = 0.3) -> Signals:
    """Signals of an uncalibrated rig.

    Args:
        read: the recording.
        sensing: parameters of the model's measurement chain; only the pulses of the speed are used, if the speed
            read behaves like them.
        held_out: share of the recording at its end that models are not fitted to.

    Raises:
        RecordingError: no verdict is possible; one line that says why.
    """
    driven = np.isfinite(read.duty).any() and float(np.nanmax(np.abs(read.duty))) >= STILL
    alone = not any(np.isfinite(getattr(read, c)).any() for c in ("omega", "i_a", "v_a"))
    index, period = irregular_grid(read.stamp_ns, LONGEST_PERIOD if driven and alone else math.inf)
    columns = _columns(read, index)
    t = (read.stamp_ns - read.stamp_ns[0]) * 1e-9
    sigma = {"theta": _reading_noise(t, read.theta)}
    for name in ("i_a", "v_a", "omega"):
        x = getattr(read, name)
        if np.isfinite(x).sum() > 10:
            sigma[name] = _reading_noise(t, x)
    own = _own_sensing(read, sensing)
    duty = columns["duty"]
    idle = not np.isfinite(duty).any() or bool(np.nanmax(np.abs(duty)) < STILL)
    if idle and not any(np.isfinite(columns[c]).any() and np.nanstd(columns[c]) > MOVES * sigma.get(c, 0.0)
                        for c in ("omega", "i_a", "v_a")):
        return free_decay(read, columns["theta"], period, sigma["theta"], held_out,
                          commanded=bool(np.isfinite(duty).any()))
    notes = read.notes
    if np.isfinite(duty).any():
        columns["duty"] = hold(duty)
        last = end_of_motion(columns["theta"], columns["duty"], sigma["theta"], held_out) if alone else 0
        if last * period >= MINIMUM_DURATION:
            columns = {name: x[:last] for name, x in columns.items()}
            notes = (*notes, f"the arm rests from {last * period:.1f} s on: the rest is left out")
    signals = from_arrays(columns, period, own, held_out, read.path, notes)
    if signals.pulses is not None:  # the accuracy of the speed is that of its pulses
        sigma.pop("omega", None)
    said = (f"angle: a reading has a standard deviation of {degrees(sigma['theta'])}, from noise and resolution, "
            "estimated from the recording")
    return replace(signals, sigma={**signals.sigma, **sigma}).noted(said)


def end_of_motion(theta: Array, duty: Array, sigma: float, held_out: float) -> int:
    """Samples after which an arm rests, if most of the held-out part is such a rest; else 0.

    Where nothing happens, no model can be judged. The duty is constant there, or the arm lies at an end of its range.

    Args:
        theta: [rad] (N,) angle, NaN where missing.
        duty: (N,) duty.
        sigma: [rad] standard deviation of a reading.
        held_out: share of the recording at its end that models are not fitted to.
    """
    known = np.flatnonzero(np.isfinite(theta))
    x = theta[known]
    rest, near = np.median(x[-max(len(x) // 50, 1):]), max(MOVES * sigma, RESTS * float(np.ptp(x)))
    away = np.abs(x - rest) > near
    lies = min(rest - x.min(), x.max() - rest) <= near
    changed = np.flatnonzero((np.abs(duty - duty[-1]) > RESTS * float(np.ptp(duty))) & (not lies))
    last = max(int(known[away][-1]) if away.any() else 0, int(changed[-1]) if len(changed) else 0) + 1
    kept = min(round((1.0 + SETTLES) * last), len(duty))
    return kept if kept < (1.0 - MOSTLY * held_out) * len(duty) else 0


def with_commands(duty: Array, read: Recording, index: NDArray[np.int64]) -> Array:
    """The duty with the samples that were lost filled in from the commands, if these explain all other samples.

    Args:
        duty: (N,) on the grid, NaN where a sample is missing.
        read: the recording, with the instants at which commands were received.
        index: (M,) of each sample on the grid.
    """
    taken = np.isfinite(read.command)
    times, commands = read.command_ns[taken], np.clip(read.command[taken], -1.0, 1.0)
    missing = ~np.isfinite(duty)
    if not missing.any() or len(times) < 2:
        return duty
    grid = np.arange(len(duty))
    received = np.interp(grid, index, read.received_ns.astype(float))
    period = float(np.median(np.diff(received)))
    known = grid[~missing]
    best, right = duty, FOLLOWED
    for late in range(LATEST + 1):  # a rig takes a command over with its next sample, or the one after
        last = np.searchsorted(times, received - late * period, side="right") - 1
        followed = np.where(last >= 0, commands[np.maximum(last, 0)], np.nan)
        stepped = known[1:][np.abs(np.diff(duty[known])) > STILL]
        share = float(np.mean(np.abs(followed[stepped] - duty[stepped]) < STILL)) if len(stepped) else 0.0
        if share > right:
            best, right = np.where(missing, followed, duty), share
    return best


def _columns(read: Recording, index: np.ndarray) -> dict[str, np.ndarray]:
    """The channels and the duty on the grid, by name; NaN where nothing was measured."""
    columns, places = {}, int(index[-1]) + 1
    if places > MOST_PLACES * len(read):
        raise RecordingError(f"{read.path}: {len(read)} samples, but its stamps tell of {places}: they keep no sample "
                             "period, so no verdict is possible; record again")
    for name in (*CHANNELS, "duty"):
        columns[name] = np.full(places, np.nan)
        columns[name][index] = getattr(read, name)
    return columns


def _reading_noise(t: Array, x: Array) -> float:
    """Standard deviation of a reading (N,) at t (N,) [s]; single readings that jump out do not count."""
    return reading_noise_at(t, np.where(jumps_out(x, white_noise_at(t, x)), np.nan, x))


def _own_sensing(read: Recording, sensing: Mapping[str, float]) -> dict[str, float]:
    """The measurement chain as the recording shows it; pulses only if the speed is held as pulses would hold it."""
    own = {**sensing, **{f"{c}_{what}": 0.0 for c in ("angle", "current", "voltage") for what in ("lsb", "noise")}}
    known = np.isfinite(read.omega).sum() > 10
    if sensing["speed_pulses_per_rev"] > 0.0 and known and not _held_by_pulses(read, sensing):
        own["speed_pulses_per_rev"] = 0.0
    return own


def _held_by_pulses(read: Recording, sensing: Mapping[str, float]) -> bool:
    """Whether the readings of the speed are held for as long as pulses of that speed would hold them."""
    speed = read.omega[np.isfinite(read.omega)]
    changes = np.flatnonzero(np.diff(speed)) + 1
    held = np.diff(changes) * read.period
    turn = 2.0 * math.pi / sensing["speed_pulses_per_rev"] / np.maximum(np.abs(speed[changes[1:]]), 1e-3)
    fits = np.abs(held - turn) <= 1.5 * read.period
    return len(held) >= 5 and bool(np.mean(fits) >= 0.7) and bool(np.median(held) >= 2.5 * read.period)
