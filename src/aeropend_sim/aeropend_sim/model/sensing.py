# SPDX-License-Identifier: Apache-2.0
"""The measurement chain: from the state of the plant to the reading.

Order for the angle: error of the encoder (`angle_offset`, `encoder_eccentricity`), two-stage filter (slower with
`encoder_lag`), noise, quantisation. For the current: gain, offset, noise, quantisation. For the voltage: offset, noise,
quantisation. The speed is the angle between two pulses over their time difference; `speed_spikes` makes some of these
times false.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from aeropend_sim.compiled import equation, njit
from aeropend_sim.model.dynamics import ROW
from aeropend_sim.model.effects import DEFINED, SPIKE_FACTOR
from aeropend_sim.model.lag import NO_LAG, Lag, cached_lag
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model
from aeropend_sim.model.terms import EMPTY, Quantities, Terms, series, term_sum, terms

Array = NDArray[np.float64]

REPEATED = 20
"""Rounds of the fixed point that takes the error out of a reading. A choice: an error of 30 % falls to 1e-10."""

AHEAD = 1e-4
"""[s] Time over which the rate of an error of the angle is taken (a choice: far below a sample)."""

SPEED_TIMEOUT = 0.5
"""[s] Time without a pulse after which the speed reads 0. Convention, as in the firmware (speed.h)."""


class FilterStage(NamedTuple):
    """One first-order stage of the angle filter: its weights over a sample, and its rate (1/s); 0 without the stage."""

    weights: Lag
    rate: float


class MeasurementChain(NamedTuple):
    """The measurement chain of a model, precomputed for one sample period, in SI units."""

    h: float
    first: FilterStage
    second: FilterStage
    bias: float
    amplitude: float
    phase: float
    angle_noise: float
    angle_lsb: float
    current_factor: float
    current_bias: float
    current_noise: float
    current_lsb: float
    voltage_bias: float
    voltage_noise: float
    voltage_lsb: float
    pulses: float
    tick: float
    speed_noise: float
    spike_rate: float


class _Readings(NamedTuple):
    theta: int = 0
    omega: int = 1
    i_a: int = 2
    v_a: int = 3


READING = _Readings()
"""Row of each channel in an array of readings (4, N)."""


class Memory(NamedTuple):
    """State of the measurement chain between two samples."""

    stage1: float
    stage2: float
    theta: float
    theta_dot: float
    omega: float
    rotor_angle: float
    last_pulse: float
    speed: float
    time: float


ScalarOrArray = TypeVar("ScalarOrArray", float, Array)


def readings_with_errors(model: Model) -> set[str]:
    """The readings that effects by formula add errors to."""
    return {e.reading for id_ in model.effects if (e := DEFINED.get(id_)) is not None and e.term and e.reading}


def read_current(model: Model, current: ScalarOrArray, time: NDArray[np.floating[Any]] | float = 0.0) -> ScalarOrArray:
    """Reading of a current before noise and quantisation.

    Args:
        model: its effects `current_gain` and `current_offset` act, and its effects by formula.
        current: [A] scalar or (N,) true current.
        time: [s] of it, for formulas that depend on it.

    Returns:
        [A] i (1 + gain) + bias, in the shape of `current`.
    """
    current = current + _error(model, "i_a", time, i_a=current)
    return current * (1.0 + model.effect("current_gain", "gain")) + model.effect("current_offset", "bias")


def read_voltage(model: Model, voltage: ScalarOrArray, time: NDArray[np.floating[Any]] | float = 0.0) -> ScalarOrArray:
    """Reading of a voltage before noise and quantisation.

    Args:
        model: its effect `voltage_offset` acts, and its effects by formula.
        voltage: [V] scalar or (N,) true voltage at the motor's terminals.
        time: [s] of it, for formulas that depend on it.

    Returns:
        [V] v + bias, in the shape of `voltage`.
    """
    return voltage + _error(model, "v_a", time, v=voltage) + model.effect("voltage_offset", "bias")


def true_voltage(model: Model, reading: ScalarOrArray, time: NDArray[np.floating[Any]] | float = 0.0) -> ScalarOrArray:
    """The inverse of `read_voltage`.

    Args:
        model: its effect `voltage_offset` acts, and its effects by formula.
        reading: [V] scalar or array of voltages read.
        time: [s] of each, for formulas that depend on it.

    Returns:
        [V] v - bias, in the shape of `reading`.
    """
    first = reading - model.effect("voltage_offset", "bias")
    true = first
    for _ in range(REPEATED if "v_a" in readings_with_errors(model) else 0):
        true = first - _error(model, "v_a", time, v=true)
    return true


def _error(model: Model, channel: str, time: NDArray[np.floating[Any]] | float, **known: ScalarOrArray
           ) -> ScalarOrArray:
    """The error of a reading that formulas give, in the shape of the quantity that it depends on; 0.0 without any."""
    if channel not in readings_with_errors(model):
        return 0.0  # type: ignore[return-value]
    (value,) = known.values()
    found = series(model.effects, channel, np.size(value), 0.0, 0.0, None, t=np.ravel(time),
                   **{name: np.ravel(x) for name, x in known.items()})
    return found.reshape(np.shape(value)) if np.ndim(value) else float(found[0])  # type: ignore[return-value]


def seen_angle(model: Model, theta: Array, theta_dot: Array, period: float, start: float = 0.0) -> tuple[Array, Array]:
    """Angle and rate that the encoder sees: the true ones, with the errors of the reading that are given by formulas.

    Args:
        model: its effects by formula act.
        theta: (N,) [rad] true angle.
        theta_dot: (N,) [rad/s] true rate.
        period: [s] time between samples.
        start: [s] time of the first sample.
    """
    wrong = terms(model.effects, ("theta",))
    if wrong is None:
        return theta, theta_dot
    seen, rate = np.empty(len(theta)), np.empty(len(theta))
    _see(theta, theta_dot, start, period, wrong, seen, rate)
    return seen, rate


@njit()
def _see(theta: Array, theta_dot: Array, start: float, period: float, wrong: Terms, seen: Array, rate: Array) -> None:
    for k in range(theta.shape[0]):
        seen[k], rate[k] = seen_with_errors(theta[k], theta_dot[k], start + period * k, wrong)


@equation
def angle_error(theta: float, theta_dot: float, t: float, wrong: Terms) -> float:
    """[rad] Sum of the errors of the angle that are given by formulas."""
    return term_sum(0, wrong.arm_friction, Quantities(theta, theta_dot, 0.0, 0.0, 0.0, 0.0, t), EMPTY, wrong)


@equation
def seen_with_errors(theta: float, theta_dot: float, t: float, wrong: Terms | None) -> tuple[float, float]:
    """As `seen_angle`, at one instant.

    Args:
        theta: [rad] true angle.
        theta_dot: [rad/s] true rate.
        t: [s] time.
        wrong: errors of the angle; None without any.
    """
    if wrong is None:
        return theta, theta_dot
    later = angle_error(theta + AHEAD * theta_dot, theta_dot, t + AHEAD, wrong)
    earlier = angle_error(theta - AHEAD * theta_dot, theta_dot, t - AHEAD, wrong)
    return theta + angle_error(theta, theta_dot, t, wrong), theta_dot + (later - earlier) / (2.0 * AHEAD)


@equation
def seen_current(current: float, t: float, wrong: Terms | None) -> float:
    """[A] Current that its sensor sees.

    Args:
        current: [A] true current.
        t: [s] time.
        wrong: errors of the current that are given by formulas; None without any.
    """
    if wrong is None:
        return current
    return current + term_sum(0, wrong.arm_friction, Quantities(0.0, 0.0, 0.0, 0.0, current, 0.0, t), EMPTY, wrong)


def read_angle(model: Model, theta: Array, theta_dot: Array, period: float = SAMPLE_PERIOD) -> Array:
    """Reading of the angle before noise and quantisation.

    Args:
        model: sensing parameters and effects.
        theta: (N,) [rad] true angle.
        theta_dot: (N,) [rad/s] true rate.
        period: [s] time between samples.

    Returns:
        (N,) [rad] output of the encoder and its filter.
    """
    return angle_reading(*seen_angle(model, theta, theta_dot, period), prepare(model, period))


def true_angle(model: Model, reading: float, time: float = 0.0) -> float:
    """[rad] Angle at which an arm that has long been at rest gives a reading, without noise and quantisation.

    Args:
        model: sensing parameters and effects.
        reading: [rad] of the angle.
        time: [s] of it, for formulas that depend on it.
    """
    chain, true = prepare(model), reading
    for _ in range(REPEATED):
        seen, _ = seen_angle(model, np.array([true]), np.zeros(1), chain.h, time)
        true += reading - start(float(seen[0]), 0.0, 0.0, 0.0, chain).stage2
    return true


def filter_stages(model: Model) -> tuple[float, float]:
    """[s] Time constants of the two stages of the angle filter, with the effect `encoder_lag` in each of its forms."""
    both = model.sensing["angle_filter_tau"] + model.effect("encoder_lag", "tau")
    return max(both, 0.0), max(both + model.effect("encoder_lag_single", "lag"), 0.0)


def prepare(model: Model, period: float = SAMPLE_PERIOD) -> MeasurementChain:
    """The measurement chain of a model, for `read`.

    Args:
        model: sensing parameters and effects.
        period: [s] time between samples.
    """
    s, effect = model.sensing, model.effect
    first, second = (FilterStage(cached_lag(rate, period), rate) for rate in (
        1.0 / tau if tau > NO_LAG * period else 0.0 for tau in filter_stages(model)))
    return MeasurementChain(
        h=period, first=first, second=second, bias=effect("angle_offset", "bias"),
        amplitude=effect("encoder_eccentricity", "amplitude"), phase=effect("encoder_eccentricity", "phase"),
        angle_noise=s["angle_noise"], angle_lsb=s["angle_lsb"],
        current_factor=1.0 + effect("current_gain", "gain"), current_bias=effect("current_offset", "bias"),
        current_noise=s["current_noise"], current_lsb=s["current_lsb"],
        voltage_bias=effect("voltage_offset", "bias"), voltage_noise=s["voltage_noise"], voltage_lsb=s["voltage_lsb"],
        pulses=s["speed_pulses_per_rev"], tick=s["speed_tick"], speed_noise=s["speed_noise"],
        spike_rate=effect("speed_spikes", "rate"))


@njit()
def encoder_angle(theta: float, c: MeasurementChain) -> float:
    """Angle that the encoder measures, before its filter.

    Args:
        theta: [rad] true angle.
        c: the chain.
    """
    angle = theta + c.bias
    return angle + c.amplitude * math.sin(theta + c.phase) if c.amplitude != 0.0 else angle


@njit()
def current_reading(current: float, c: MeasurementChain) -> float:
    """[A] Reading of a current, before noise and quantisation."""
    return c.current_factor * current + c.current_bias


@njit()
def voltage_reading(voltage: float, c: MeasurementChain) -> float:
    """[V] Reading of a voltage, before noise and quantisation."""
    return voltage + c.voltage_bias


@njit()
def start(theta: float, theta_dot: float, omega: float, rotor_angle: float, c: MeasurementChain) -> Memory:
    """State of the chain when the filter has settled at an angle.

    Args:
        theta: [rad] true angle.
        theta_dot: [rad/s] true rate.
        omega: [rad/s] true speed of the rotor.
        rotor_angle: [rad] true angle of the rotor.
        c: the chain.
    """
    angle = encoder_angle(theta, c)
    return Memory(angle, angle, theta, theta_dot, omega, rotor_angle, math.nan, math.nan, 0.0)


@njit()
def _quantise(x: float, lsb: float) -> float:
    return lsb * math.floor(x / lsb + 0.5) if lsb > 0.0 else x


@njit()
def filter_angle(m: Memory, theta: float, theta_dot: float, c: MeasurementChain) -> tuple[float, float]:
    """Both stages of the angle filter after one period. Between the samples the angle is a Hermite cubic.

    Args:
        m: state of the chain at the sample before.
        theta: [rad] true angle.
        theta_dot: [rad/s] true rate.
        c: the chain.
    """
    now = encoder_angle(theta, c)
    if c.first.rate == 0.0 and c.second.rate == 0.0:
        return now, now
    before = encoder_angle(m.theta, c)
    middle = encoder_angle(0.5 * (m.theta + theta) + 0.125 * c.h * (m.theta_dot - theta_dot), c)
    half, stage1 = _filtered(m.stage1, before, middle, now, c.first)
    _, stage2 = _filtered(m.stage2, m.stage1, half, stage1, c.second)
    return stage1, stage2


@njit()
def _filtered(was: float, before: float, middle: float, now: float, stage: FilterStage) -> tuple[float, float]:
    """Output of a stage in the middle and at the end of a period, for its input at the begin, there and there."""
    if stage.rate == 0.0:
        return middle, now
    k, a = stage.weights, stage.rate
    return (k.half_decay * was + a * (k.u0 * before + k.u1 * middle + k.u2 * now),
            k.decay * was + a * (k.w0 * before + k.w1 * middle + k.w2 * now))


@njit(nogil=True)
def angle_reading(theta: Array, theta_dot: Array, c: MeasurementChain) -> Array:
    """Reading of the angle before noise and quantisation.

    Args:
        theta: (N,) [rad] true angle.
        theta_dot: (N,) [rad/s] true rate.
        c: the chain.

    Returns:
        (N,) [rad] output of the encoder and its filter.
    """
    out = np.empty(theta.shape[0])
    m = start(theta[0], theta_dot[0], 0.0, 0.0, c)
    for k in range(theta.shape[0]):
        if k > 0:
            stage1, stage2 = filter_angle(m, theta[k], theta_dot[k], c)
            m = Memory(stage1, stage2, theta[k], theta_dot[k], 0.0, 0.0, 0.0, 0.0, 0.0)
        out[k] = m.stage2
    return out


@njit()
def time_pulses(m: Memory, omega: float, rotor_angle: float, uniform: Array, normal: float, c: MeasurementChain
                ) -> tuple[float, float, float]:
    """Speed from the pulses since the last sample.

    Args:
        m: state of the chain at the sample before.
        omega: [rad/s] true speed.
        rotor_angle: [rad] true angle of the rotor.
        uniform: (2,) random numbers 0..1, for `speed_spikes`.
        normal: standard normal number, for the noise.
        c: the chain.

    Returns:
        Time of the last pulse (s), speed read (rad/s), and time of this sample (s).
    """
    now = m.time + c.h
    last, speed = m.last_pulse, m.speed
    step = 2.0 * math.pi / c.pulses
    pulse = math.floor(m.rotor_angle / step) + 1.0
    while pulse * step <= rotor_angle:
        ahead = pulse * step - m.rotor_angle
        slope = (omega - m.omega) / c.h
        root = math.sqrt(max(m.omega * m.omega + 2.0 * slope * ahead, 0.0))
        since = 2.0 * ahead / (m.omega + root) if m.omega + root > 0.0 else c.h
        at = m.time + min(max(since, 0.0), c.h)
        if c.tick > 0.0:
            at = c.tick * math.floor(at / c.tick)
        if not math.isnan(last) and at > last:
            speed = step / (at - last)
            if uniform[0] < -math.expm1(-c.spike_rate * (at - last)):
                speed *= SPIKE_FACTOR[0] + (SPIKE_FACTOR[1] - SPIKE_FACTOR[0]) * uniform[1]
            speed += c.speed_noise * normal
        last = at
        pulse += 1.0
    if now - last > SPEED_TIMEOUT:
        speed = 0.0
    return last, speed, now


@njit(nogil=True)
def read(out: Array, truth: Array, normal: Array, uniform: Array, m: Memory, first: bool, c: MeasurementChain
         ) -> Memory:
    """Read N states in sequence.

    Args:
        out: (4, N), filled with the readings θ, ω, i_a, v_a; ω is 0 before two pulses.
        truth: (7, N) states, as `dynamics.run` fills it.
        normal: (N, 4) standard normal numbers.
        uniform: (N, 2) random numbers 0..1.
        m: state of the chain.
        first: whether the first sample is the first of all.
        c: the chain.

    Returns:
        The state of the chain after the last sample.
    """
    for k in range(out.shape[1]):
        theta, theta_dot, i_a = truth[ROW.theta, k], truth[ROW.theta_dot, k], truth[ROW.i_a, k]
        omega, v_a, angle = truth[ROW.omega, k], truth[ROW.v_a, k], truth[ROW.rotor_angle, k]
        if first:
            m = start(theta, theta_dot, omega, angle, c)
            first = False
        else:
            last, speed, now = m.last_pulse, m.speed, m.time + c.h
            if c.pulses > 0.0 and angle < m.rotor_angle:  # a pulse does not tell the direction
                before = Memory(m.stage1, m.stage2, m.theta, m.theta_dot, -m.omega, -m.rotor_angle, last, speed, m.time)
                last, speed, now = time_pulses(before, -omega, -angle, uniform[k], normal[k, 1], c)
            elif c.pulses > 0.0:
                last, speed, now = time_pulses(m, omega, angle, uniform[k], normal[k, 1], c)
            stage1, stage2 = filter_angle(m, theta, theta_dot, c)
            m = Memory(stage1, stage2, theta, theta_dot, omega, angle, last, speed, now)
        out[READING.theta, k] = _quantise(m.stage2 + c.angle_noise * normal[k, 0], c.angle_lsb)
        if c.pulses > 0.0:
            out[READING.omega, k] = 0.0 if math.isnan(m.speed) else m.speed
        else:
            out[READING.omega, k] = omega + c.speed_noise * normal[k, 1]
            if uniform[k, 0] < -math.expm1(-c.spike_rate * c.h):
                out[READING.omega, k] *= SPIKE_FACTOR[0] + (SPIKE_FACTOR[1] - SPIKE_FACTOR[0]) * uniform[k, 1]
        current = current_reading(i_a, c)
        out[READING.i_a, k] = _quantise(current + c.current_noise * normal[k, 2], c.current_lsb)
        out[READING.v_a, k] = _quantise(voltage_reading(v_a, c) + c.voltage_noise * normal[k, 3], c.voltage_lsb)
    return m


NOTHING_READ = Memory(*(math.nan,) * 9)
"""State of the chain before the first sample."""
