# SPDX-License-Identifier: Apache-2.0
"""What sparse identification works on: states and inputs on a grid, and what was really measured of them.

Of a rig, the angle is seen through a filter and the speed as the time between pulses; the angular rate is not seen at
all. The regression works on the best description of the states that the readings give. The free runs go through the
same filter and count the same pulses: the measurement chain's own states run along.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

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
"""A state of this ending is the derivative of the one without it."""

MOST_BAD = 0.2
"""Share of readings of a channel that may be unusable; the fit leaves them out, the regression takes them as read."""

STANDS_OUT = 5.0
"""A signal must vary by so many times its noise."""


@dataclass(frozen=True)
class Link:
    """A state of the measurement chain: d(name)/dt = Σ coefficient · variable, at first that of `follows`, or 0."""

    name: str
    rate: Mapping[str, float]
    follows: str = ""


@dataclass(frozen=True)
class Dataset:
    """One recording for sparse identification.

    Attributes:
        name: for messages. states, inputs: names of the columns of `values` (N, S) and `held` (N, U).
        period: s between samples.
        outputs, means: what was measured, by the name of the variable that shows it (a state or a link).
        chain: the measurement chain's states. derived: states that were not measured but differentiated.
        derivatives: (N, S) where they are known exactly, else None.
        noise: (S,) standard deviation of `values`. coarse: (S,) samples over which they are smooth by making.
        train: samples that models are fitted to. notes: what a person should know.
    """

    name: str
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    values: Array
    held: Array
    period: float
    outputs: tuple[tuple[str, Output], ...]
    means: tuple[tuple[str, Means], ...] = ()
    chain: tuple[Link, ...] = ()
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
        """States and inputs: what terms are made of."""
        return (*self.states, *self.inputs)


def from_arrays(states: Mapping[str, Array], inputs: Mapping[str, Array], period: float, held_out: float = 0.25,
                name: str = "data", derivatives: Mapping[str, Array] | None = None) -> Dataset:
    """States (N,) and held inputs (N,) by name, all measured directly, noisy or not.

    Args:
        states, inputs: by name. period: s. held_out: share at the end that models are not fitted to.
        name: for messages. derivatives: exact ones of every state by name, if they are known.

    Raises:
        RecordingError: not finite, too short, or nothing happens in it.
    """
    n = len(next(iter(states.values())))
    for kind in (states, inputs, derivatives or {}):
        for column, x in kind.items():
            if len(x) != n:
                raise RecordingError(f"{name}: {column} has {len(x)} samples, others have {n}")
            if not np.isfinite(x).all():
                raise RecordingError(f"{name}: {column} is not a number in {int((~np.isfinite(x)).sum())} of {n} "
                                     "samples; identification needs a recording without holes")
    if n < 100:
        raise RecordingError(f"{name}: {n} samples are too few to identify anything")
    _check_alive(name, {**states, **inputs})
    values = np.column_stack(list(states.values())).astype(float)
    held = np.column_stack(list(inputs.values())).astype(float) if inputs else np.zeros((n, 0))
    noise = _noise(values)
    outputs = tuple((s, Output(s, k, values[:, k], float(noise[k]))) for k, s in enumerate(states))
    known = None if derivatives is None else np.column_stack([derivatives[s] for s in states])
    return Dataset(name, tuple(states), tuple(inputs), values, held, period, outputs, derivatives=known,
                   train=_train(n, held_out))


NUMERIC = 1e-5
"""Share of a signal's spread that sampling and running it costs, however little noise there is (100 dB)."""


def _noise(values: Array) -> Array:
    return np.asarray(np.hypot(noise_of(values), NUMERIC * values.std(axis=0)))


def _train(n: int, held_out: float) -> int:
    return max(1, round(n * (1.0 - held_out)))


def _check_alive(name: str, columns: Mapping[str, Array]) -> None:
    for column, x in columns.items():
        if np.ptp(x) == 0.0:
            raise RecordingError(f"{name}: {column} is {x[0]:g} all the time, so nothing can be identified with it; "
                                 "record while `excite` runs, or leave it out (--states, --input)")
        if np.std(x) < STANDS_OUT * float(noise_of(x)):
            raise RecordingError(f"{name}: {column} does not stand out of its noise, so nothing can be identified "
                                 "with it; record while `excite` runs, or leave it out (--states, --input)")


def from_bag(read: Recording, sensing: Mapping[str, float], states: Sequence[str] = STATES,
             inputs: Sequence[str] = ("v_a",), held_out: float = 0.25) -> Dataset:
    """A recording of the rig.

    Args:
        read: the recording. sensing: the measurement chain (model file). states, inputs: names to identify over.
        held_out: share at the end that models are not fitted to.

    Raises:
        RecordingError: gaps, holes, missing or constant channels, too short; one line that says so.
    """
    path = read.path
    for what, names, known in (("state", states, STATES), ("input", inputs, (*INPUTS, *STATES))):
        if len(set(names)) != len(names) or not names:
            raise RecordingError(f"{path}: give at least one {what}, and each once; known: {', '.join(known)}")
        for name in names:
            if name not in known:
                raise RecordingError(f"{path}: there is no {what} '{name}'; known: {', '.join(known)}")
    if both := set(states) & set(inputs):
        raise RecordingError(f"{path}: {', '.join(sorted(both))} cannot be both a state and an input")
    if "theta_dot" in inputs or ("theta_dot" in states and "theta" not in states):
        raise RecordingError(f"{path}: theta_dot is not measured; give theta among the states, and theta_dot behind it")
    if read.duration < MINIMUM_DURATION:
        raise RecordingError(f"{path}: {read.duration:.1f} s of samples; identification needs {MINIMUM_DURATION:g} s "
                             "or more")
    if len(read.gaps):
        at = int(read.gaps[0, 0])
        raise RecordingError(f"{path}: {read.lost} samples are missing in {len(read.gaps)} gaps, the first after "
                             f"{read.t[at]:.3f} s; identification needs a recording without gaps, record again")
    for name in (*states, *inputs):
        if name != "theta_dot":
            _check_channel(read, name)
    signals = from_recording(read, sensing, held_out)
    columns = {name: getattr(read, name) for name in (*CHANNELS, "duty")}
    return _from_signals(path, signals, columns, sensing, states, inputs, held_out)


def from_readings(columns: Mapping[str, Array], period: float, sensing: Mapping[str, float],
                  states: Sequence[str] = STATES, inputs: Sequence[str] = ("v_a",), held_out: float = 0.25,
                  name: str = "readings") -> Dataset:
    """As `from_bag`, from readings (N,) by channel name and `duty`, without a hole, every `period` seconds."""
    signals = signals_from_arrays(columns, period, sensing, held_out, name)
    return _from_signals(name, signals, columns, sensing, states, inputs, held_out)


def _from_signals(name: str, signals: Signals, columns: Mapping[str, Array], sensing: Mapping[str, float],
                  states: Sequence[str], inputs: Sequence[str], held_out: float) -> Dataset:
    for channel in (*states, *inputs):
        bad = float(np.mean(~np.isfinite(signals.channel(channel)))) if channel in CHANNELS else 0.0
        if bad > MOST_BAD:
            raise RecordingError(f"{name}: {channel} cannot be used for {100.0 * bad:.0f} % of the time (clipped, "
                                 "stuck or jumping readings); record again")
    n, h = len(signals), signals.period
    tau = sensing["angle_filter_tau"]
    noise = {"i_a": signals.sigma["i_a"], "theta": signals.sigma["theta"], "omega": signals.sigma["omega"]}
    coarse: dict[str, float] = {}
    described: dict[str, Array] = {"i_a": columns["i_a"], "duty": signals.duty,
                                   "v_a": _held_voltage(columns["v_a"], signals.duty, signals.sigma["v_a"], h)}
    outputs: list[tuple[str, Output]] = []
    means: list[tuple[str, Means]] = []
    chain: list[Link] = []
    smooth, rate = smoothed(columns["theta"], h)
    left = float(np.std(columns["theta"] - smooth))
    coarse["theta_dot"] = smoothness(columns["theta"])
    noise["theta_dot"] = left / (h * max(coarse["theta_dot"], 1.0) ** 1.5)
    late = np.arange(n) + 2.0 * tau / h  # two equal lags are, to first order, a delay of their sum
    described |= {k: np.interp(late, np.arange(n), x) for k, x in (("theta", columns["theta"]), ("theta_dot", rate))}
    seen = "theta"
    if tau > 0.0 and "theta" in states:
        chain += [Link("theta_stage1", {"theta": 1.0 / tau, "theta_stage1": -1.0 / tau}, "theta"),
                  Link("theta_stage2", {"theta_stage1": 1.0 / tau, "theta_stage2": -1.0 / tau}, "theta")]
        seen = "theta_stage2"
    floor = {k: NUMERIC * float(np.nanstd(signals.channel(k))) for k in CHANNELS}
    described["omega"] = columns["omega"]
    p = signals.pulses
    if p is not None:
        use = ~p.false
        middle = p.time[use] - 0.5 * p.period[use]
        described["omega"] = np.interp(np.arange(n) * h, np.append(0.0, middle), np.append(0.0, p.omega[use]))
        coarse["omega"] = 2.0 * float(np.median(p.period[use])) / h
        noise["omega"] = float(np.sqrt(np.mean(np.diff(p.omega[use], 2) ** 2))) / 8.0
        if "omega" in states:
            chain.append(Link("rotor_angle", {"omega": 1.0}))
            means.append(("rotor_angle", Means("omega", 0, p.time[use], p.period[use], p.omega[use], p.sigma[use])))
    for state in states:
        if state == "theta_dot" or (state == "omega" and means):
            continue
        sigma = math.hypot(signals.sigma[state], floor[state])
        outputs.append((seen if state == "theta" else state, Output(state, 0, signals.channel(state), sigma)))
    values = np.column_stack([described[s] for s in states])
    return Dataset(name, tuple(states), tuple(inputs), values, np.column_stack([described[u] for u in inputs]), h,
                   tuple(outputs), tuple(means), tuple(chain), frozenset({"theta_dot"} & set(states)),
                   noise=np.array([noise[k] for k in states]), coarse=np.array([coarse.get(k, 0.0) for k in states]),
                   train=_train(n, held_out), notes=signals.notes)


def _check_channel(read: Recording, name: str) -> None:
    x = getattr(read, name)
    holes = int((~np.isfinite(x)).sum())
    if holes == len(x):
        raise RecordingError(f"{read.path}: {name} was not measured; leave it out (--states, --input) or record it")
    if holes:
        raise RecordingError(f"{read.path}: {name} is not a number in {holes} of {len(x)} samples; identification "
                             "needs a recording without holes")
    _check_alive(read.path, {name: x})


def _held_voltage(v: Array, duty: Array, sigma: float, period: float) -> Array:
    """The voltage (N,) without its noise: its mean while the duty is held, and what varies slowly beside it."""
    start, length = holds(duty)
    mean = np.repeat(np.add.reduceat(v, start) / length, length)
    return np.asarray(mean + slow_part(v - mean, round(0.05 / period), sigma))


def with_train(data: Dataset, held_out: float) -> Dataset:
    """The same with another share held out."""
    return replace(data, train=_train(len(data), held_out))
