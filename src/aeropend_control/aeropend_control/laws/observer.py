# SPDX-License-Identifier: Apache-2.0
"""State observer: the model runs in parallel with the rig and is corrected by the readings."""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

from aeropend_sim.compiled import njit
from aeropend_sim.model import actuator, dynamics, sensing
from aeropend_sim.model.arm import arm_drive, arm_terms, near_ground
from aeropend_sim.model.coefficients import Coefficients, Extra, prepare
from aeropend_sim.model.effects import Values
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model
from aeropend_sim.model.state import Motion, Past, State
from aeropend_sim.model.terms import Terms, terms

Array = NDArray[np.float64]

DISTURBANCE = 2.0
"""[rad/s² per √s] Intensity of the random walk that models the unknown torque (choice). A larger value
makes the estimate faster and noisier."""

SPEED_TIME = 0.25
"""[s] Time constant of the correction of the rotor's speed by its reading (choice)."""

CURRENT_TIME = 0.05
"""[s] Time constant of the correction of the current by its reading (choice)."""

OUTLIER = (0.2, 5.0)
"""[-], [rad/s] A reading of the speed is an outlier if it differs from the estimate by more than this share of it plus
this value (choice)."""

OUTLIERS_BELIEVED = 3
"""Number of outliers in a row from which on they are used, limited to the bound of `OUTLIER` (choice)."""

LARGEST_BIAS = 1.0
"""[V] Bound of the bias of the motor's voltage (choice)."""

LEAST_NOISE = 1e-4
"""[rad] Least standard deviation that the observer assumes for a reading of the angle: no model is exact (choice)."""


class Estimate(NamedTuple):
    """An estimate of the observer.

    Attributes:
        state: SI units.
        drive: [rad/s²] `arm_drive` without thrust. It does not include dry friction, the estimate of the
            unknown torque, and the bending of the mast. (In slow motion the mast is practically rigid; in fast motion
            the thrust is too late to compensate it.)
        nominal_drive: [rad/s²] the same without effects.
        ground: share by which the ground effect increases the thrust.
    """

    state: State
    drive: float
    nominal_drive: float
    ground: float


class MotorCorrection(NamedTuple):
    """State of the correction by the readings of the motor.

    Attributes:
        voltage: [V] bias of the motor's voltage.
        current: [A] bias of the motor's current.
        read: [rad/s] last reading of the speed that was used.
        at_pulse: [rad] rotor angle when that reading was new.
        outliers: number of outliers in a row.
        samples: number of samples.
    """

    voltage: float = 0.0
    current: float = 0.0
    read: float = 0.0
    at_pulse: float = 0.0
    outliers: int = 0
    samples: int = 0

HISTORY = 512
"""[samples] Length of the history of the rotor angle: more than the longest time between two pulses that is used."""


class Observer:
    """The model in parallel with the rig, corrected by each reading of the angle and optionally of the motor.

    The state `gust` of the model is the estimate of the unknown torque. The gains are those of the stationary Kalman
    filter of the arm and the angle filter, for the noise and the quantisation of the reading.

    A reading of the speed is the mean over the last interval between two pulses; it is late and held. The observer
    compares it once with the mean of the model's speed over the same interval. The difference corrects the speed and a
    bias of the motor's voltage. The difference of the currents is low-pass filtered and is a bias of the current.
    """

    def __init__(self, model: Model, period: float = SAMPLE_PERIOD, motor: bool = False) -> None:
        """Prepare the observer for a model.

        Args:
            model: the model of the rig.
            period: [s] between samples.
            motor: use the readings of speed and current too.
        """
        self.model, self.period, self.motor = model, period, motor
        self.numbers = model.numbers()
        steady = {"gust": {"sigma": 1e-9, "tau": 1e3}}  # no random torque, only a state for the estimate
        c, e, x, added = prepare(model.with_effects({**model.effects, **steady}), period)
        assert e is not None
        assert x is not None
        self.plant = c, e, x, added
        self._chain = sensing.prepare(model, period)
        self._wrong_angle, self._wrong_current = (terms(model.effects, (reading,)) for reading in ("theta", "i_a"))
        self._gain = _kalman(self._chain, self.numbers["c_over_J"], period)
        n = self.numbers
        self._per_volt = n["K_t"] / (n["R_a"] * n["B_m"] + n["K_e"] * n["K_t"])  # rad/s, without load
        self._duty_map = actuator.duty_map(n)
        self._whole, part = actuator.delay(model.effects, period)
        self._share = actuator.share_of_first(n, part, period) if part else 0.0
        self.reset()

    def reset(self, duty: float = 0.0, theta: float = math.nan) -> None:
        """Restart at rest.

        Args:
            duty: [0..1] the duty that was constant for a long time.
            theta: [rad] reading of the angle; NaN: the next reading is used.
        """
        self.count = 0
        self._memory = sensing.NOTHING_READ
        self._duty = duty
        self._motor = MotorCorrection()
        self._angles = np.zeros(HISTORY)
        self._queue = deque([self._voltage(duty)] * self._whole)
        self.state: State | None = None if math.isnan(theta) else self._start(theta)

    @property
    def voltage_bias(self) -> float:
        """[V] Estimated difference between the motor's voltage and the model's."""
        return self._motor.voltage

    @property
    def current_bias(self) -> float:
        """[A] Estimated difference between the motor's current and the model's."""
        return self._motor.current

    def step(self, theta: float, duty: float, omega: float = math.nan, i_a: float = math.nan) -> Estimate:
        """Process the readings of a sample.

        Args:
            theta: [rad] reading of the angle; NaN if missing.
            duty: [0..1] duty from this sample on.
            omega: [rad/s] reading of the speed; NaN if missing. Used only with `motor`.
            i_a: [A] reading of the current; NaN if missing. Used only with `motor`.

        Returns:
            The estimate for the time when the duty of the next sample begins to act: the next sample, or later with a
            `command_delay`.
        """
        if self.state is None:
            self.state = self._start(theta)
        self._queue.append(self._voltage(duty))
        volts = np.array(self._queue)
        self._queue.popleft()
        now = self.count * self.period
        self.count += 1
        if self.motor:
            self.state, self._motor = _correct_motor(omega, i_a, now, self.state, self._motor, self._angles,
                                                     self._chain, self._wrong_current, self._per_volt)
            volts = np.maximum(volts + self._motor.voltage, 0.0)
        self.state, self._memory, estimate = _observe(theta, now, volts, self.state, self._memory, self._gain,
                                                      self._chain, self._wrong_angle, *self.plant)
        return Estimate(*estimate)

    def _start(self, theta: float) -> State:
        now = self.count * self.period
        angle = 0.0 if math.isnan(theta) else sensing.true_angle(self.model, theta, now)
        seen, rate = sensing.seen_angle(self.model, np.array([angle]), np.zeros(1), self.period, now)
        self._memory = sensing.start(float(seen[0]), float(rate[0]), 0.0, 0.0, self._chain)
        return dynamics.steady(self.model, self._duty)._replace(theta=angle)

    def _voltage(self, duty: float) -> float:
        """[V] Voltage, without sag, in the sample period in which this duty begins to act."""
        before, self._duty = self._duty, duty
        time = (self.count + self._whole) * self.period
        return float(actuator.held_voltage(self._duty_map, duty, before, self._share, time, self.model.effects))


@njit(nogil=True)
def _observe(theta: float, t: float, volts: Array, s: State, m: sensing.Memory, gain: Array,
             chain: sensing.MeasurementChain, wrong: Terms | None, c: Coefficients, e: Values | None, x: Extra | None,
             added: Terms | None) -> tuple[State, sensing.Memory, tuple[State, float, float, float]]:
    """Correct the state by a reading of time t [s], advance it by the first voltage, and predict it over the others."""
    if not math.isnan(theta):
        error = theta - m.stage2
        y, rate = s.theta + gain[0] * error, s.theta_dot + gain[1] * error
        s = State(s.i_a, s.omega, s.rotor_angle, y, rate, s.thrust, s.heat, s.flex, s.flex_dot,
                  s.gust + gain[2] * error, s.time, s.memory)
        y, rate = sensing.seen_with_errors(y, rate, t, wrong)
        m = sensing.Memory(m.stage1 + gain[3] * error, m.stage2 + gain[4] * error, y, rate, m.omega, m.rotor_angle,
                           m.last_pulse, m.speed, m.time)
    scratch, silent = np.empty((7, len(volts))), np.zeros(len(volts))
    s = dynamics.run(volts[:1], silent, s, c, e, x, added, scratch)
    y, rate = sensing.seen_with_errors(s.theta, s.theta_dot, t + chain.h, wrong)
    stage1, stage2 = sensing.filter_angle(m, y, rate, chain)
    m = sensing.Memory(stage1, stage2, y, rate, m.omega, m.rotor_angle, m.last_pulse, m.speed, m.time)
    p = dynamics.run(volts[1:], silent, s, c, e, x, added, scratch) if len(volts) > 1 else s
    sine, motion = math.sin(p.theta), Motion(p.theta, p.theta_dot, 0.0, 0.0)
    drive = arm_drive(sine, motion, 0.0, p.omega, 0.0, c, e)
    if added is not None:
        drive += arm_terms(motion, p.thrust, p.omega, 0.0, Past(p.time, p.memory), c, added)
    nominal = arm_drive(sine, motion, 0.0, p.omega, 0.0, c, None)
    return s, m, (p, drive, nominal, near_ground(p.theta, e))


@njit(nogil=True)
def _correct_motor(omega: float, i_a: float, t: float, s: State, m: MotorCorrection, angles: Array,
                   chain: sensing.MeasurementChain, wrong: Terms | None, per_volt: float
                   ) -> tuple[State, MotorCorrection]:
    """State and correction after the readings of speed and current at time t [s]; `angles` (a ring) is updated."""
    k = m.samples
    voltage, current, read, at_pulse, outliers = m.voltage, m.current, m.read, m.at_pulse, m.outliers
    angles[k % HISTORY] = s.rotor_angle
    if not math.isnan(i_a):
        more = (i_a - chain.current_bias) / chain.current_factor - sensing.seen_current(s.i_a, t, wrong)
        current += (more - current) * -math.expm1(-chain.h / CURRENT_TIME)
    use, time, error = not math.isnan(omega), chain.h, omega - s.omega
    if use and chain.pulses > 0.0:
        turn = 2.0 * math.pi / chain.pulses
        if omega < 0.0:
            use = False  # a counter of pulses does not tell the direction: this is no reading
        elif omega == 0.0:
            use = s.rotor_angle - at_pulse >= 3.0 * turn  # else it is too early for a reading
        elif omega == read:
            use = False  # held, and used already
        else:
            read, at_pulse = omega, s.rotor_angle
            time = turn / omega
            first = k - 0.5 - time / chain.h  # the pulse came half a period ago, on average
            use = first >= 0.0 and time / chain.h <= HISTORY - 2
            if use:
                error = omega - (_at(angles, k - 0.5) - _at(angles, first)) / time
    if use:
        limit = OUTLIER[0] * s.omega + OUTLIER[1]
        if abs(error) > limit:
            outliers += 1
            use = outliers >= OUTLIERS_BELIEVED
            error = math.copysign(limit, error)
        else:
            outliers = 0
    if use:
        share = -math.expm1(-time / SPEED_TIME)
        voltage = min(max(voltage + share * error / per_volt, -LARGEST_BIAS), LARGEST_BIAS)
        s = State(s.i_a, max(s.omega + share * error, 0.0), s.rotor_angle, s.theta, s.theta_dot, s.thrust,
                  s.heat, s.flex, s.flex_dot, s.gust, s.time, s.memory)
    return s, MotorCorrection(voltage, current, read, at_pulse, outliers, k + 1)


@njit(nogil=True)
def _at(angles: Array, k: float) -> float:
    """[rad] Angle of the rotor at sample `k`, interpolated between samples."""
    before = math.floor(k)
    a, b = angles[int(before) % HISTORY], angles[int(before + 1.0) % HISTORY]
    return a + (k - before) * (b - a)


def _kalman(chain: sensing.MeasurementChain, damping: float, period: float) -> Array:
    """Stationary Kalman gains (5,): angle, rate, unknown torque and both stages of the angle filter."""
    filtered = chain.first.rate > 0.0 and chain.second.rate > 0.0
    a = np.zeros((5, 5))
    a[0, 1] = a[1, 2] = 1.0
    a[1, 1] = -damping
    if filtered:
        a[3, 0], a[3, 3] = chain.first.rate, -chain.first.rate
        a[4, 3], a[4, 4] = chain.second.rate, -chain.second.rate
    size, seen = (5, 4) if filtered else (3, 0)
    transition = expm(a[:size, :size] * period)
    kick = np.diag(np.array([0.0, 0.0, DISTURBANCE**2 * period, 0.0, 0.0])[:size])
    noise = max(chain.angle_noise**2 + chain.angle_lsb**2 / 12.0, LEAST_NOISE**2)
    c = np.zeros((1, size))
    c[0, seen] = 1.0
    spread = solve_discrete_are(transition.T, c.T, kick, np.array([[noise]]))
    gain = np.zeros(5)
    gain[:size] = spread[:, seen] / (spread[seen, seen] + noise)
    if not filtered:
        gain[3] = gain[4] = gain[0]
    return gain
