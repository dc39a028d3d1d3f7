# SPDX-License-Identifier: Apache-2.0
"""The model beside the rig: each stage of the cut chain fed with what was measured, and the whole chain from the duty.

As in the diagnosis (docs/method.md, step 3), but causal, and for a few samples at a time. The motor is driven by the
voltage read. The arm is driven by the speed of the model plus the error of the last pulses, and follows the angle read
through an observer, so that it forgets what is past. What the observer has not expected, the innovation, is the
residual of the arm. Each column of the bank (`bank`) has a model of its own beside the nominal one.

An observer whose model lacks a torque also gets a speed that is not there: at rest its correction of the angle and this
speed cancel. Terms that depend on the speed of the arm would then follow the residual itself, and explain any. So the
sensitivities of the arm are those around the motion that was measured: the observers of the columns, and a nominal one
that they are compared with, get the torque that is missing, which a disturbance observer estimates. Dry friction is
compared without it, for it holds the arm against a torque that is missing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba.typed import List
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.priors import REFERENCE_GRAVITY
from aeropend_ident.live.bank import Column
from aeropend_sim.compiled import njit
from aeropend_sim.model import actuator, dynamics, sensing
from aeropend_sim.model.arm import advance_arm
from aeropend_sim.model.coefficients import prepare
from aeropend_sim.model.motor import advance_motor, at_terminals
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model
from aeropend_sim.model.state import State, since
from aeropend_sim.model.terms import SLOTS, terms

Array = NDArray[np.float64]

OBSERVER_RATE = 8.0
"""[rad/s] Natural frequency of the observer of the arm, in those of an arm with `REFERENCE_GRAVITY`.

Choice: it forgets within about a fifth of a second, and passes three quarters of a constant torque that an open loop
would show."""

OBSERVER_DAMPING = 0.7
"""Damping ratio of the observer (convention: fastest without overshoot that matters)."""

DISTURBANCE = 0.3
"""Gain of the disturbance observer over the cube of `OBSERVER_RATE` (derived: its three poles are then about equally
fast, 0.57 to 0.73 of it, and well damped)."""

TURNS = 256
"""Samples of the rotor's angle that are remembered (derived: the longest pulse interval, `sensing.SPEED_TIMEOUT`)."""

SLACK = 0.6
"""Sample periods by which the instant of a pulse may miss the sample that shows it (choice: rounding of the tick)."""

SPEED_ERROR = (1e-3, 1e-3)
"""[-], [rad/s] Least noise of a speed that is sampled directly: a share of it, plus a value (choice: no sensor is
exact)."""

PULSE_ERROR = 2e-3
"""Share of a mean speed over a pulse interval that is noise beside tick and sensor (choice: pulses are not quite evenly
spaced, and the model's angle is taken straight between samples)."""

STANDING = 50
"""Samples between two comparisons with a speed that reads 0 (choice: 0.1 s, a tick of the detector)."""

STANDS = 1.5
"""Multiple of the slowest speed that can be read above which a model does not stand (choice: without a pulse in the
timeout a rotor is slower than 1; half a pulse is margin)."""

FREE_SPEED = 1.0
"""[rad/s] Least floor of the free run's speed (choice: its reading is held between pulses, and so always late)."""

CHANNELS = ("v_a", "i_a", "omega", "theta")
"""Channels, in the order of the chain."""


class Samples(NamedTuple):
    """Some consecutive samples, (N,) each, SI units; what was not read is NaN."""

    theta: Array
    omega: Array
    i_a: Array
    v_a: Array
    duty: Array


@dataclass(frozen=True)
class Residuals:
    """What the stages leave of some samples.

    Attributes:
        rows: stage -> (rows, 1 + M): measured minus model, first of the nominal model, then of each column of the
            stage, in noises of a reading (floors).
        channel: stage -> (rows,) number of the channel of each row, as in `CHANNELS`.
        at: stage -> (rows,) sample of each row.
        spikes: speeds whose pulse interval does not fit the time that passed.
        pulses: number of pulses.
        said: readings of the free-running model (5, N), in the order of `Samples`.
    """

    rows: dict[str, Array]
    channel: dict[str, NDArray[np.int64]]
    at: dict[str, NDArray[np.int64]]
    spikes: int
    pulses: int
    said: Samples


def noise(model: Model) -> dict[str, float]:
    """Noise of a reading of each channel but the speed, with its resolution, SI units.

    That of a speed depends on its pulse interval, see `_motor`.

    Args:
        model: its sensing parameters.
    """
    s = model.sensing

    def of(name: str) -> float:
        return max(math.hypot(s[f"{name}_noise"], s[f"{name}_lsb"] / math.sqrt(12.0)), 1e-9)

    return {"theta": of("angle"), "i_a": of("current"), "v_a": of("voltage")}


class _Members:
    """Models that run side by side in one stage, prepared for compiled code."""

    def __init__(self, models: Sequence[Model], period: float) -> None:
        self.c, self.e, self.x, self.chain, self.states = List(), List(), List(), List(), List()
        self.added: Any = None
        for m in models:
            c, e, x, self.added = prepare(m, period, full=True)
            self.c.append(c)
            self.e.append(e)
            self.x.append(x)
            self.chain.append(sensing.prepare(m, period))
            self.states.append(State())

    def start(self, state: State) -> None:
        """Set all to a state."""
        for j in range(len(self.states)):
            self.states[j] = state


@njit(nogil=True)
def _motor(v: Array, omega: Array, states: Any, c: Any, e: Any, x: Any, chain: Any, added: Any, ring: Array,
           memory: Array, current: Array, pulse: Array, noise_of: Array, speed: Array) -> tuple[int, int]:
    """Advance the motors of a stage by N samples.

    Args:
        v: (N + 1, M) [V] voltage at the terminals by the reading, the sample before first.
        omega: (N,) [rad/s] speed read.
        states: of `_Members`.
        c: of `_Members`.
        e: of `_Members`.
        x: of `_Members`.
        chain: of `_Members`.
        added: of `_Members`.
        ring: (M, TURNS) [rad] angles of the rotors at the last samples.
        memory: samples so far, last speed read, instant of the last pulse [s], is it known, last three errors [rad/s],
            was the last speed missing.
        current: (N, M), filled with the current [A].
        pulse: (N, M), filled with the residuals of the mean speed [rad/s]; NaN where no pulse came.
        noise_of: (N,), filled with the noise of the mean speed [rad/s].
        speed: (N,), filled with the speed that drives the arm [rad/s].

    Returns:
        False captures, and pulses.
    """
    n, size = current.shape
    h = chain[0].h
    step = 2.0 * math.pi / chain[0].pulses if chain[0].pulses > 0.0 else 0.0
    spikes = pulses = 0
    for k in range(n):
        count = int(memory[0])
        now = count * h
        for j in range(size):
            s, volts = states[j], v[k, j]
            for _ in range(c[j].steps):
                past = None if added is None else dynamics.pasts(s, volts, c[j], added)
                i1, _, w1, angle, heat = advance_motor(s, volts, past, c[j], e[j], x[j], added)
                after = State(i1, w1, angle, 0.0, 0.0, 0.0, heat, 0.0, 0.0, 0.0, s.time, s.memory)
                if added is not None and past is not None:
                    after = since(after, dynamics.past_after(s, after, volts, past, c[j], added))
                s = after
            states[j] = s
            ring[j, count % ring.shape[1]] = s.rotor_angle
            current[k, j] = s.i_a
            pulse[k, j] = math.nan
        reading, before = omega[k], memory[1]
        noise_of[k] = 1.0
        if math.isnan(reading):  # a pulse may have come that nobody has seen
            memory[3], memory[7] = 0.0, 1.0
        elif memory[7] > 0.0:
            memory[7] = 0.0
        elif step == 0.0:  # a speed that is sampled directly
            for j in range(size):
                pulse[k, j] = reading - states[j].omega
            noise_of[k] = max(chain[0].speed_noise, SPEED_ERROR[0] * abs(reading) + SPEED_ERROR[1])
            _remember(memory, pulse[k, 0])
            pulses += 1
        elif reading != before and reading > 0.0:
            interval = step / reading
            at, known = now - 0.5 * h, False
            if memory[3] > 0.0:
                expected = memory[2] + interval
                held = step / before if before > 0.0 else 0.0
                turns = 0
                while held > 0.0 and expected < now - (1.0 + SLACK) * h and turns < 1000:  # equal readings between
                    expected += held
                    turns += 1
                if abs(expected - (now - 0.5 * h)) <= (0.5 + SLACK) * h:
                    at, known = min(max(expected, now - h), now), True
            false = memory[3] > 0.0 and not known
            memory[2], memory[3] = at, 1.0
            if false:
                spikes += 1
            elif interval < (ring.shape[1] - 2) * h and count * h > interval:
                for j in range(size):
                    end, begin = _turned(ring, j, at, count, h), _turned(ring, j, at - interval, count, h)
                    pulse[k, j] = reading - (end - begin) / interval
                tick = chain[0].tick / math.sqrt(6.0)
                noise_of[k] = math.sqrt((reading * tick / interval) ** 2 + chain[0].speed_noise ** 2
                                        + (PULSE_ERROR * reading) ** 2)
                _remember(memory, pulse[k, 0])
                pulses += 1
        elif reading == 0.0 and count % STANDING == 0 and now > sensing.SPEED_TIMEOUT:  # no pulse in the timeout
            slowest = step / sensing.SPEED_TIMEOUT
            back = int(sensing.SPEED_TIMEOUT / h)
            for j in range(size):
                mean = (ring[j, count % ring.shape[1]] - ring[j, (count - back) % ring.shape[1]]) / (back * h)
                pulse[k, j] = -max(mean - STANDS * slowest, 0.0)
            noise_of[k] = 1.0
            memory[4] = memory[5] = memory[6] = pulse[k, 0]
            memory[3] = 0.0
        if not math.isnan(reading):
            memory[1] = reading
        memory[0] += 1.0
        a, b, d = memory[4], memory[5], memory[6]
        median = max(min(a, b), min(max(a, b), d))
        speed[k] = states[0].omega + median
    return spikes, pulses


@njit(nogil=True)
def _remember(memory: Array, error: float) -> None:
    memory[4], memory[5], memory[6] = memory[5], memory[6], error


@njit(nogil=True)
def _turned(ring: Array, j: int, t: float, count: int, h: float) -> float:
    """[rad] Angle of rotor j at a time, linear between samples; `count` is the number of the last sample."""
    at = min(max(t / h, count - ring.shape[1] + 2.0), float(count))
    first = int(at)
    share = at - first
    a = ring[j, first % ring.shape[1]]
    b = ring[j, min(first + 1, count) % ring.shape[1]]
    return a + share * (b - a)


@njit(nogil=True)
def _arm(theta: Array, speed: Array, start: float, gains: Array, helped: NDArray[np.bool_], stages: Array, states: Any,
         c: Any, e: Any, x: Any, chain: Any, added: Any, wrong: Any, out: Array) -> None:
    """Advance the observers of the arm by N samples.

    Args:
        theta: (N,) [rad] angle read.
        speed: (N + 1,) [rad/s] speed of the rotor, the sample before first.
        start: [s] time of the first sample.
        gains: (3,) of the observer: [1], [1/s], and [1/s²] of its torque.
        helped: (M,) which of them get the missing torque; the second estimates it.
        stages: (M, 2) states of the angle's filter.
        states: of `_Members`.
        c: of `_Members`.
        e: of `_Members`.
        x: of `_Members`.
        chain: of `_Members`.
        added: of `_Members`.
        wrong: errors of the angle by formula; None without any.
        out: (N, M), filled with the innovations [rad].
    """
    n, size = theta.shape[0], out.shape[1]
    for k in range(n):
        torque = states[1].gust
        for j in range(size):
            s = states[j]
            before = s
            w = speed[k]
            rise = (speed[k + 1] - w) / c[j].steps
            for _ in range(c[j].steps):
                now = State(0.0, w, 0.0, s.theta, s.theta_dot, s.thrust, 0.0, s.flex, s.flex_dot,
                            torque if helped[j] else 0.0, s.time, s.memory)
                past = None if added is None else dynamics.pasts(now, 0.0, c[j], added)
                m, f1 = advance_arm(now, w + 0.5 * rise, w + rise, past, c[j], e[j], x[j], added)
                w += rise
                after = State(0.0, w, 0.0, m.theta, m.theta_dot, f1, 0.0, m.flex, m.flex_dot, 0.0, now.time,
                              now.memory)
                if added is not None and past is not None:
                    after = since(after, dynamics.past_after(now, after, 0.0, past, c[j], added))
                s = after
            first, second = _read(stages[j], before, s, start + (k - 1) * chain[j].h, chain[j], wrong)
            error = theta[k] - second
            out[k, j] = error
            if math.isnan(error):
                error = 0.0
            states[j] = State(0.0, s.omega, 0.0, s.theta + gains[0] * error, s.theta_dot + gains[1] * error,
                              s.thrust, 0.0, s.flex, s.flex_dot, torque + gains[2] * error if j == 1 else 0.0,
                              s.time, s.memory)
            stages[j, 0], stages[j, 1] = first + gains[0] * error, second + gains[0] * error


@njit(nogil=True)
def _read(stages: Array, before: State, after: State, t: float, chain: Any, wrong: Any) -> tuple[float, float]:
    """Both stages of the angle's filter [rad] after a sample, from those and the state before it, at time t [s]."""
    theta, rate = sensing.seen_with_errors(before.theta, before.theta_dot, t, wrong)
    held = sensing.Memory(stages[0], stages[1], theta, rate, 0.0, 0.0, 0.0, 0.0, 0.0)
    theta, rate = sensing.seen_with_errors(after.theta, after.theta_dot, t + chain.h, wrong)
    return sensing.filter_angle(held, theta, rate, chain)


@njit(nogil=True)
def _free(v: Array, start: float, states: Any, c: Any, e: Any, x: Any, chain: Any, added: Any, wrong: Any,
          stages: Array, out: Array) -> None:
    """Advance the whole chain by N holds of the voltage; out (4, N) gets θ read, ω, i_a, and v_a at the terminals."""
    for k in range(out.shape[1]):
        s = states[0]
        out[0, k] = stages[0, 1]
        out[1, k] = s.omega
        out[2, k] = s.i_a
        out[3, k] = at_terminals(v[k], s, e[0], added)
        before = s
        for _ in range(c[0].steps):
            s = dynamics.advance(s, v[k], c[0], e[0], x[0], added)
        stages[0, 0], stages[0, 1] = _read(stages[0], before, s, start + k * chain[0].h, chain[0], wrong)
        states[0] = s


class Companion:
    """The model of a rig beside its samples, with all its effects, whose time and memories begin at the first sample.

    Args:
        model: the nominal model.
        columns: of the bank; none: residuals of the nominal model alone.
        period: [s] time between samples.
    """

    def __init__(self, model: Model, columns: Sequence[Column], period: float = SAMPLE_PERIOD) -> None:
        self.model, self.period = model, period
        self.columns = {stage: [c for c in columns if stage in c.stages] for stage in ("actuator", "motor", "arm")}
        models = {stage: [model, *(c.model(model) for c in own)] for stage, own in self.columns.items()}
        self._actuators = models["actuator"]
        self._numbers = [m.numbers() for m in self._actuators]
        self._motors = [actuator.behind_terminals(m) for m in models["motor"]]
        self._motor = _Members(self._motors, period)
        biases = np.array([m.effect("voltage_offset", "bias") for m in self._motors])
        self._biases = biases - biases[0]
        self._wrong = terms(model.effects, ("theta",))
        self._arm = _Members([model, *models["arm"]], period)
        self._helped = np.array([False, True, *(not c.sticks for c in self.columns["arm"])])
        self._chain = _Members([model], period)
        longest = max(m.effect("command_delay", "delay") for m in self._actuators)
        self._history = math.ceil(longest / period) + 2
        noises = noise(model)
        self._noise = np.array([noises["v_a"], noises["i_a"], 1.0, noises["theta"]])
        gravity, damping = model.numbers()["mgd_over_J"], model.numbers()["c_over_J"]
        rate = OBSERVER_RATE * math.sqrt(gravity / REFERENCE_GRAVITY)
        first = max(2.0 * OBSERVER_DAMPING * rate - damping, 0.0)
        second = max(rate * rate - gravity - damping * first, 0.0)
        self._gains = np.array([first, second, DISTURBANCE * rate**3]) * period
        self.floors = {**noises, "omega": max(model.sensing["speed_noise"], FREE_SPEED)}
        self.running = False

    def restart(self) -> None:
        """Forget the past: the next sample is the first one."""
        self.running = False

    def _start(self, s: Samples) -> None:
        """Begin at the first sample, as if all had been so for long."""
        def first(x: Array, default: float = 0.0) -> float:
            known = x[np.isfinite(x)]
            return float(known[0]) if len(known) else default

        numbers = self.model.numbers()
        theta, omega, i_a = first(s.theta), first(s.omega), first(s.i_a)
        duty = first(s.duty)
        at = sensing.true_angle(self.model, theta)
        thrust = float(actuator.thrust(numbers, omega))
        self._past = np.full(self._history, duty)
        self._count = 0
        self._memories = np.zeros((len(self._actuators), SLOTS))
        self._last_v = first(s.v_a, float(actuator.voltage(numbers, duty)))
        self._last_i, self._last_speed, self._last_off = i_a, omega, 0.0
        self._motor.start(State(i_a=i_a, omega=omega))
        self._ring = np.zeros((len(self._motor.states), TURNS))
        self._memory = np.zeros(8)
        self._memory[1] = omega
        self._arm.start(State(omega=omega, theta=at, thrust=thrust))
        self._chain.start(State(i_a=i_a, omega=omega, theta=at, thrust=thrust))
        self._stages = np.full((len(self._arm.states), 2), theta)
        self._free_stages = np.full((1, 2), theta)
        self.running = True

    def step(self, samples: Samples) -> Residuals:
        """Advance by some samples.

        Args:
            samples: consecutive; NaN where a reading is missing. A missing voltage is held.
        """
        if not self.running:
            self._start(samples)
        n = len(samples.theta)
        duty = _held(samples.duty, float(self._past[-1]))
        i_a = _held(samples.i_a, self._last_i)
        known = np.concatenate([self._past, duty])
        start = self._count - len(self._past)
        time = self.period * np.arange(self._count - 1, self._count + n)  # the sample before first
        now = float(time[1])
        volts, acting, more = [], np.zeros(n), np.zeros(n)
        for m, numbers, memory in zip(self._actuators, self._numbers, self._memories, strict=True):
            held, sampled = (x[len(self._past):] for x in actuator.voltages(numbers, known, m.effects, self.period,
                                                                            start))
            if m is self.model:
                acting, more = held, sampled - held
            loaded = actuator.terminal_voltage(m, sampled, i_a, self.period, now, memory)
            volts.append(sensing.read_voltage(m, loaded, time[1:]))
        self._past = known[-self._history:]
        v_rows = (samples.v_a[:, None] - np.array(volts).T) / self._noise[0]
        off = _held(samples.v_a - volts[0], self._last_off)
        v = np.concatenate([[self._last_v], volts[0] + off])

        size = len(self._motor.states)
        current, pulse, noise_of, speed = np.empty((n, size)), np.empty((n, size)), np.empty(n), np.empty(n)
        seen = v[:, None] - self._biases
        true = sensing.true_voltage(self.model, seen, np.broadcast_to(time[:, None], seen.shape))
        o = self._motor
        spikes, pulses = _motor(true, samples.omega, o.states, o.c, o.e, o.x, o.chain, o.added, self._ring,
                                self._memory, current, pulse, noise_of, speed)
        read = [sensing.read_current(m, current[:, j], time[1:]) for j, m in enumerate(self._motors)]
        i_rows = (samples.i_a[:, None] - np.array(read).T) / self._noise[1]
        pulse /= noise_of[:, None]

        out = np.empty((n, len(self._arm.states)))
        a = self._arm
        _arm(samples.theta, np.concatenate([[self._last_speed], speed]), now, self._gains, self._helped, self._stages,
             a.states, a.c, a.e, a.x, a.chain, a.added, self._wrong, out)
        beside = np.where(self._helped, out[:, 1:2], out[:, :1])
        innovation = (out[:, :1] + (out - beside)[:, [0, *range(2, out.shape[1])]]) / self._noise[3]

        said = np.empty((4, n))
        f = self._chain
        _free(acting, now, f.states, f.c, f.e, f.x, f.chain, f.added, self._wrong, self._free_stages, said)
        said[2] = sensing.read_current(self.model, said[2], time[1:])
        said[3] = sensing.read_voltage(self.model, said[3] + more, time[1:])
        self._count += n
        self._last_off = float(off[-1])
        self._last_v, self._last_i, self._last_speed = float(v[-1]), float(i_a[-1]), float(speed[-1])
        rows = {"actuator": _rows((v_rows, 0)), "motor": _rows((i_rows, 1), (pulse, 2)), "arm": _rows((innovation, 3))}
        return Residuals({k: r[0] for k, r in rows.items()}, {k: r[1] for k, r in rows.items()},
                         {k: r[2] for k, r in rows.items()}, spikes, pulses,
                         Samples(said[0], said[1], said[2], said[3], duty))


def _held(x: Array, before: float) -> Array:
    """A series without NaN: what is missing keeps the value before it."""
    if np.isfinite(x).all():
        return x
    at = np.maximum.accumulate(np.where(np.isfinite(x), np.arange(1, len(x) + 1), 0))
    return np.asarray(np.concatenate([[before], x])[at])


def _rows(*parts: tuple[Array, int]) -> tuple[Array, NDArray[np.int64], NDArray[np.int64]]:
    """Rows of some channels without those that were not read, their channels, and their samples."""
    rows, channels, at = [], [], []
    for values, channel in parts:
        there = np.flatnonzero(np.isfinite(values).all(axis=1))
        rows.append(values[there])
        channels.append(np.full(len(there), channel))
        at.append(there)
    return np.concatenate(rows), np.concatenate(channels), np.concatenate(at)
