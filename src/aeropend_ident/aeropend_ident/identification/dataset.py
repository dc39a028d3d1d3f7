# SPDX-License-Identifier: Apache-2.0
"""Data of sparse identification: states and inputs on a grid, and the readings that show them.

The rig measures its angle through a filter and its speed as the time between pulses, and no angular rate.
The regression uses the best description of the states that the readings allow. The free runs go through the same filter
and count the same pulses: the states of the measurement chain run with them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from aeropend_ident.bags.recording import Recording, RecordingError, holds
from aeropend_ident.identification.output_error import Means, Output
from aeropend_ident.identification.terms import Array
from aeropend_ident.signals.derivatives import noise_of, smoothed, smoothness
from aeropend_ident.signals.from_bag import from_recording
from aeropend_ident.signals.signals import CHANNELS, MINIMUM_DURATION, Signals
from aeropend_ident.signals.signals import from_arrays as signals_from_arrays
from aeropend_ident.signals.smoothing import slow_part

STATES = ("theta", "theta_dot", "i_a", "omega")
INPUTS = ("v_a", "duty")
RATE = "_dot"
"""A state with this ending is the derivative of the state without it."""

MOST_BAD = 0.2
"""Greatest share of unusable readings in a channel; the fit leaves them out, the regression uses them. Choice."""

STANDS_OUT = 5.0
"""Least standard deviation of a signal over that of its noise. Choice."""

NUMERIC = 1e-5
"""Least noise of a signal over its standard deviation, for errors of sampling and integration. Choice: -100 dB."""

FEWEST = 100
"""Least number of samples. Choice."""

LEAST_PULSES = 10
"""Least number of pulses of the speed. Choice."""

SLOW_VOLTAGE = 0.05
"""[s] Window over which the slow part of a held voltage is smoothed. Choice."""


@dataclass(frozen=True)
class SensorState:
    """A state of the measurement chain.

    Attributes:
        name: of the state.
        rate: variable -> coefficient; the derivative of the state is their sum.
        starts_as: state whose value is its initial value; "": it starts at 0.
    """

    name: str
    rate: Mapping[str, float]
    starts_as: str = ""


@dataclass(frozen=True)
class Dataset:
    """One recording for sparse identification.

    Attributes:
        name: of the data, for messages.
        states: names of the S states.
        inputs: names of the U inputs.
        values: (N, S) the states, as the readings describe them.
        held: (N, U) the inputs, held from sample to sample.
        period: [s] sample period.
        outputs: readings at the samples, each with the name of the variable that it shows (a state or a sensor state).
        means: mean rates over intervals, each with the name of the variable that it shows.
        sensor_states: the states of the measurement chain.
        derived: states that are not measured but differentiated.
        derivatives: (N, S) exact derivatives; None: they are not known.
        noise: (S,) standard deviation of the noise of `values`; None: not known.
        coarse: (S,) number of samples over which `values` were smoothed; None: they were not.
        train: number of samples that models are fitted to; the rest is held out.
        notes: remarks for the user.
    """

    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    values: Array
    held: Array
    period: float
    outputs: tuple[tuple[str, Output], ...]
    means: tuple[tuple[str, Means], ...] = ()
    sensor_states: tuple[SensorState, ...] = ()
    derived: frozenset[str] = frozenset()
    derivatives: Array | None = None
    noise: Array | None = None
    coarse: Array | None = None
    train: int = 0
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.values)

    @property
    def variables(self) -> tuple[str, ...]:
        """States and inputs: the variables of the terms."""
        return (*self.states, *self.inputs)


def from_arrays(states: Mapping[str, Array], inputs: Mapping[str, Array], period: float, held_out: float = 0.25,
                name: str = "data", derivatives: Mapping[str, Array] | None = None) -> Dataset:
    """A dataset of arrays; all states are measured directly, with noise or without.

    Args:
        states: name -> (N,) readings.
        inputs: name -> (N,) values, held from sample to sample.
        period: [s] sample period.
        held_out: share at the end that models are not fitted to.
        name: of the data, for messages.
        derivatives: name -> (N,) exact derivative of each state, if they are known.

    Raises:
        RecordingError: values are not finite, too few, or constant.
    """
    n = len(next(iter(states.values())))
    for kind in (states, inputs, derivatives or {}):
        for column, x in kind.items():
            if len(x) != n:
                raise RecordingError(f"{name}: {column} has {len(x)} samples, others have {n}")
            if not np.isfinite(x).all():
                raise RecordingError(f"{name}: {column} is not a number in {int((~np.isfinite(x)).sum())} of {n} "
                                     "samples; identification needs a recording without holes")
    if n < FEWEST:
        raise RecordingError(f"{name}: {n} samples are too few; identification needs {FEWEST} or more")
    _check_alive(name, {**states, **inputs})
    values = np.column_stack(list(states.values())).astype(float)
    held = np.column_stack(list(inputs.values())).astype(float) if inputs else np.zeros((n, 0))
    noise = _noise(values)
    outputs = tuple((s, Output(s, k, values[:, k], float(noise[k]))) for k, s in enumerate(states))
    known = None if derivatives is None else np.column_stack([derivatives[s] for s in states])
    return Dataset(name, tuple(states), tuple(inputs), values, held, period, outputs, derivatives=known,
                   train=_train(n, held_out))


def _noise(values: Array) -> Array:
    return np.asarray(np.hypot(noise_of(values), NUMERIC * values.std(axis=0)))


def _train(n: int, held_out: float) -> int:
    return max(1, round(n * (1.0 - held_out)))


def _check_alive(name: str, columns: Mapping[str, Array]) -> None:
    for column, x in columns.items():
        if np.ptp(x) == 0.0:
            raise RecordingError(f"{name}: {column} is {x[0]:g} all the time, so no equation with it can be "
                                 "identified; record while `excite` runs, or identify without it (--states, --input)")
        if np.std(x) < STANDS_OUT * float(noise_of(x)):
            raise RecordingError(f"{name}: {column} varies too little beside its noise, so no equation with it can be "
                                 "identified; record while `excite` runs, or identify without it (--states, --input)")


def from_bag(read: Recording, sensing: Mapping[str, float], states: Sequence[str] = STATES,
             inputs: Sequence[str] = ("v_a",), held_out: float = 0.25) -> Dataset:
    """A dataset of a recording of the rig.

    Args:
        read: the recording.
        sensing: parameters of the measurement chain (model file).
        states: names of the states.
        inputs: names of the inputs.
        held_out: share at the end that models are not fitted to.

    Raises:
        RecordingError: the recording has gaps or holes, is too short, or a channel is missing or constant.
    """
    path = read.path
    for what, names, known in (("state", states, STATES), ("input", inputs, (*INPUTS, *STATES))):
        if len(set(names)) != len(names) or not names:
            raise RecordingError(f"{path}: give at least one {what}, and each only once; known: {', '.join(known)}")
        for name in names:
            if name not in known:
                raise RecordingError(f"{path}: there is no {what} '{name}'; known: {', '.join(known)}")
    if both := set(states) & set(inputs):
        raise RecordingError(f"{path}: {', '.join(sorted(both))} cannot be both a state and an input")
    if "theta_dot" in inputs or ("theta_dot" in states and "theta" not in states):
        raise RecordingError(f"{path}: theta_dot is not measured; give theta_dot as a state, beside theta")
    if read.duration < MINIMUM_DURATION:
        raise RecordingError(f"{path}: the recording has {read.duration:.1f} s; identification needs "
                             f"{MINIMUM_DURATION:g} s or more")
    if len(read.gaps):
        at = int(read.gaps[0, 0])
        raise RecordingError(f"{path}: {read.lost} samples are missing in {len(read.gaps)} gaps, the first after "
                             f"{read.t[at]:.3f} s; identification needs a recording without gaps; record again")
    for name in (*states, *inputs):
        if name != "theta_dot":
            _check_channel(read, name)
    signals = from_recording(read, sensing, held_out)
    if len(signals) != len(read):
        raise RecordingError(f"{path}: its stamps keep no sample period (two rigs on one topic, or a clock that was "
                             "set while recording); identification needs one; record again")
    columns = {name: getattr(read, name) for name in (*CHANNELS, "duty")}
    return _from_signals(path, signals, columns, sensing, states, inputs, held_out)


def from_readings(columns: Mapping[str, Array], period: float, sensing: Mapping[str, float],
                  states: Sequence[str] = STATES, inputs: Sequence[str] = ("v_a",), held_out: float = 0.25,
                  name: str = "readings") -> Dataset:
    """A dataset of readings of the rig, as `from_bag`.

    Args:
        columns: channel, or `duty` -> (N,) readings without holes.
        period: [s] sample period.
        sensing: parameters of the measurement chain (model file).
        states: names of the states.
        inputs: names of the inputs.
        held_out: share at the end that models are not fitted to.
        name: of the data, for messages.

    Raises:
        RecordingError: a channel cannot be used.
    """
    signals = signals_from_arrays(columns, period, sensing, held_out, name)
    return _from_signals(name, signals, columns, sensing, states, inputs, held_out)


def _from_signals(name: str, signals: Signals, columns: Mapping[str, Array], sensing: Mapping[str, float],
                  states: Sequence[str], inputs: Sequence[str], held_out: float) -> Dataset:
    for channel in (*states, *inputs):
        bad = float(np.mean(~np.isfinite(signals.channel(channel)))) if channel in CHANNELS else 0.0
        if bad > MOST_BAD:
            raise RecordingError(f"{name}: {100.0 * bad:.0f} % of the readings of {channel} cannot be used (clipped, "
                                 "stuck or jumping); record again")
    n, h = len(signals), signals.period
    tau = sensing["angle_filter_tau"]
    noise = {"i_a": signals.sigma["i_a"], "theta": signals.sigma["theta"], "omega": signals.sigma["omega"]}
    coarse: dict[str, float] = {}
    used = {*states, *inputs}  # what is not used may have holes
    described: dict[str, Array] = {"i_a": columns["i_a"], "duty": signals.duty}
    if "v_a" in used:
        described["v_a"] = _held_voltage(columns["v_a"], signals.duty, signals.sigma["v_a"], h)
    outputs: list[tuple[str, Output]] = []
    means: list[tuple[str, Means]] = []
    sensor_states: list[SensorState] = []
    if used & {"theta", "theta_dot"}:
        smooth, rate = smoothed(columns["theta"], h)
        left = float(np.std(columns["theta"] - smooth))
        coarse["theta_dot"] = smoothness(columns["theta"])
        noise["theta_dot"] = left / (h * max(coarse["theta_dot"], 1.0) ** 1.5)
        late = np.arange(n) + 2.0 * tau / h  # two equal lags are, to first order, a delay of their sum
        described |= {k: np.interp(late, np.arange(n), x)
                      for k, x in (("theta", columns["theta"]), ("theta_dot", rate))}
    seen = "theta"
    if tau > 0.0 and "theta" in states:
        sensor_states += [
            SensorState("theta_stage1", {"theta": 1.0 / tau, "theta_stage1": -1.0 / tau}, "theta"),
            SensorState("theta_stage2", {"theta_stage1": 1.0 / tau, "theta_stage2": -1.0 / tau}, "theta")]
        seen = "theta_stage2"
    floor = {k: NUMERIC * float(np.nanstd(signals.channel(k))) for k in states if k in CHANNELS}
    described["omega"] = columns["omega"]
    p = signals.pulses
    if p is not None:
        use = ~p.false
        if use.sum() < LEAST_PULSES:
            raise RecordingError(f"{name}: the speed shows {int(use.sum())} pulses, too few to identify: check the "
                                 "unit of omega (rad/s), and speed_pulses_per_rev in the model file")
        middle = p.time[use] - 0.5 * p.period[use]
        described["omega"] = np.interp(np.arange(n) * h, np.append(0.0, middle), np.append(0.0, p.omega[use]))
        coarse["omega"] = 2.0 * float(np.median(p.period[use])) / h
        noise["omega"] = float(np.sqrt(np.mean(np.diff(p.omega[use], 2) ** 2))) / 8.0
        if "omega" in states:
            sensor_states.append(SensorState("rotor_angle", {"omega": 1.0}))
            means.append(("rotor_angle", Means("omega", 0, p.time[use], p.period[use], p.omega[use], p.sigma[use])))
    for state in states:
        if state == "theta_dot" or (state == "omega" and means):
            continue
        sigma = math.hypot(signals.sigma[state], floor[state])
        outputs.append((seen if state == "theta" else state, Output(state, 0, signals.channel(state), sigma)))
    values = np.column_stack([described[s] for s in states])
    return Dataset(name, tuple(states), tuple(inputs), values, np.column_stack([described[u] for u in inputs]), h,
                   tuple(outputs), tuple(means), tuple(sensor_states), frozenset({"theta_dot"} & set(states)),
                   noise=np.array([noise[k] for k in states]), coarse=np.array([coarse.get(k, 0.0) for k in states]),
                   train=_train(n, held_out), notes=signals.notes)


def _check_channel(read: Recording, name: str) -> None:
    x = getattr(read, name)
    holes = int((~np.isfinite(x)).sum())
    if holes == len(x):
        raise RecordingError(f"{read.path}: {name} was not measured; record it, or identify without it (--states, "
                             "--input)")
    if holes:
        raise RecordingError(f"{read.path}: {name} is not a number in {holes} of {len(x)} samples; identification "
                             "needs a recording without holes: mend the sensor and record again, or identify without "
                             "it (--states, --input)")
    _check_alive(read.path, {name: x})


def _held_voltage(v: Array, duty: Array, sigma: float, period: float) -> Array:
    """The voltage (N,) without its noise: its mean over each hold of the duty, plus its slow variation."""
    start, length = holds(duty)
    mean = np.repeat(np.add.reduceat(v, start) / length, length)
    return np.asarray(mean + slow_part(v - mean, round(SLOW_VOLTAGE / period), sigma))
