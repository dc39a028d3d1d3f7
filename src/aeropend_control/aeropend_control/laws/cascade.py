# SPDX-License-Identifier: Apache-2.0
"""Cascade control of the rotor's speed (thesis 6.7), alone and behind feedback linearization (6.8).

A PI controller of the speed sets the demanded current, within a limit; a PI controller of the current sets the voltage.
Speed and current are estimates of the observer, which models that the reading of the speed is late and held (see
`observer.Observer`). The feedforward gives the steady current and voltage of the model, with its effects and with the
biases that the observer estimates. So tuned loops have no steady-state error although their integral gains are 0, and
there is no windup. With a feedforward of 0 the integrals do all this, as in the thesis.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

from aeropend_control.laws import feedback_linearization
from aeropend_control.laws.allocation import Allocation
from aeropend_control.laws.feedback_linearization import FeedbackLinearization
from aeropend_control.laws.gains import Gain, checked
from aeropend_control.laws.observer import Estimate, Observer
from aeropend_control.laws.pid import PID
from aeropend_control.laws.reference_model import DAMPING, ReferenceModel
from aeropend_control.laws.tuning import (
    OPERATING_POINT,
    TABLE_6_1,
    TIME_SHARE,
    Requirements,
    check,
    place,
    thrust_lag,
)
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model
from aeropend_sim.model.rig import Sample
from aeropend_sim.model.state import State

GAINS = {
    "speed_kp": Gain("A·s/rad", 0.0, 100.0, None, "proportional gain from speed to current"),
    "speed_ki": Gain("A/rad", 0.0, 1e3, None, "integral gain of the speed"),
    "current_kp": Gain("V/A", 0.0, 100.0, None, "proportional gain from current to voltage"),
    "current_ki": Gain("V/A/s", 0.0, 1e4, None, "integral gain of the current"),
    "current_limit": Gain("A", 0.0, 100.0, 2.0, "limit of the demanded current"),
    "feedforward": Gain("-", 0.0, 1.0, 1.0, "share of the model's steady current and voltage that is fed forward"),
}
"""Gains of the cascade."""

THESIS_GAINS = {"speed_kp": 0.1, "speed_ki": 1.5, "current_kp": 1.2, "current_ki": 0.5, "current_limit": 2.0,
                "feedforward": 0.0}
"""Gains of the thesis (6.7). The thesis does not print its current limit; 2 A is the limit of its motor shield."""

REQUIREMENTS = Requirements(t_r=0.2, t_p=0.8, t_s=0.8, M_p=0.1)
"""Requirements of the thesis for a step to 950 RPM (6.7). It has none on t_p; that of 0.8 s is not used."""

REFERENCE_FREQUENCY, LOOP_FREQUENCY, POLE_RATIO = 7.8, 5.1, 2.0
"""[rad/s], [rad/s], [-] For Table 6.1 with t_s = 1.2 s: frequency of the reference model; frequency of the dominant
pole pair of the feedback loop; ratio of the decay of its other poles to that of the pair (compare
`tuning.OTHER_POLES`). Choices; `tune` shows the margins and step responses with them."""

CURRENT_LEAD = 3.0
"""Least ratio of the speed loop's time constant to the current loop's (choice; 3 to 5 is usual in cascades)."""

LARGEST_LOSS = 0.5
"""[rad/s²] Acceleration lost to the limits of the duty above which the reference model restarts (choice)."""

CURRENT_SHARE = 0.3
"""Gain of a tuned current loop as a share of the winding's resistance (choice; a larger gain leaves too little delay
margin for a command delay that the model does not have)."""


class SpeedLoop:
    """Speed PI, current limit, current PI, and the duty for the demanded voltage."""

    def __init__(self, observer: Observer, allocation: Allocation) -> None:
        """Prepare the loops; `retune` must follow.

        Args:
            observer: gives the biases of the motor.
            allocation: gives steady current, voltage drop and duty.
        """
        self._observer, self._allocation = observer, allocation
        self._numbers = observer.model.numbers()
        n = self._numbers
        # a rotor that stops faster than its current changes: compensating friction at the present speed is unstable
        self._light = n["J_m"] * n["R_a"] < n["B_m"] * n["L_a"]
        self._speed, self._current = PID(0.0, period=observer.period), PID(0.0, period=observer.period)

    def retune(self, gains: Mapping[str, float]) -> None:
        """Change the gains (by the names of `GAINS`) without a bump."""
        self._speed.retune(gains["speed_kp"], gains["speed_ki"])
        self._current.retune(gains["current_kp"], gains["current_ki"])
        self._limit, self._feedforward, self._kp = gains["current_limit"], gains["feedforward"], gains["speed_kp"]
        self._slope = gains["current_kp"] + self._feedforward * self._numbers["R_a"]

    def reset(self) -> None:
        """Set the integrals to 0."""
        self._speed.reset()
        self._current.reset()

    def align(self, reference: float, s: State) -> None:
        """Set the integrals so that the loop continues without a bump from the steady voltage of a state.

        Args:
            reference: [rad/s] the next reference of the speed.
            s: the state.
        """
        held = self._allocation.holding_current(s.omega, s.omega)
        free = 1.0 - self._feedforward
        self._speed.align(free * held, reference, s.omega)
        self._current.align(free * (self._numbers["K_e"] * s.omega + self._allocation.drop(held, s)), held, held)

    def duty(self, reference: float, s: State) -> tuple[float, float]:
        """Duty for a demanded speed; call it once a sample.

        Args:
            reference: [rad/s] demanded speed.
            s: state of the rig.

        Returns:
            The duty [0..1], and the speed [rad/s] whose demand the limits of current and duty would have let through.
        """
        a, observer = self._allocation, self._observer
        u = self._speed.step(reference, s.omega, 0.0)
        bias = observer.current_bias
        wanted = u + self._feedforward * (a.holding_current(reference if self._light else s.omega, reference) + bias)
        current = min(max(wanted, -self._limit), self._limit)
        ahead = self._numbers["K_e"] * s.omega + a.drop(current - bias, s) - observer.voltage_bias
        out = self._current.step(current, s.i_a + bias, 0.0)
        voltage = out + self._feedforward * ahead
        duty, given = a.duty_of_voltage(voltage)
        self._current.track(out + given - voltage)
        missed = current - wanted + ((given - voltage) / self._slope if self._slope else 0.0)
        self._speed.track(u + missed)
        return duty, reference + (missed / self._kp if self._kp else 0.0)


class Cascade:
    """The law of the rotor's speed; see the module. Output: duty, 0..1; reference in rad/s."""

    parameters: ClassVar[dict[str, Gain]] = GAINS

    def __init__(self, model: Model, gains: Mapping[str, float] | None = None, period: float = SAMPLE_PERIOD) -> None:
        """Prepare the law for a model.

        Args:
            model: the model of the rig.
            gains: by name; missing ones come from `tune`.
            period: [s] between samples.

        Raises:
            GainError: a gain cannot be used.
        """
        given = checked(self.parameters, gains or {})
        self.model, self.gains = model, {**self.tune(model), **given}
        self._observer = Observer(model, period, motor=True)
        self._loop = SpeedLoop(self._observer, Allocation(self._observer))
        self._loop.retune(self.gains)
        self.reset()

    @staticmethod
    def tune(model: Model, requirements: Requirements = REQUIREMENTS) -> dict[str, float]:
        """Gains that meet requirements with a reserve, if the limits of voltage and current allow it.

        Args:
            model: the model of the rig.
            requirements: on the step response; t_p and M_p have no influence.

        Raises:
            TuningError: a requirement makes no sense; one line that names it.
        """
        check(requirements)
        follow = TIME_SHARE * min(requirements.t_r / 2.2, requirements.t_s / 4.0)
        return {**_defaults(), **tune(model, follow)}

    def reset(self, sample: Sample | None = None, duty: float = 0.0) -> None:
        """See `law.Law`."""
        self._observer.reset(duty, 0.0 if sample is None else sample.theta)
        self._loop.reset()
        self._duty, self._bumpless = duty, duty > 0.0

    def retune(self, gains: Mapping[str, float]) -> None:
        """See `law.Law`."""
        self.gains = {**self.gains, **checked(self.parameters, gains)}
        self._loop.retune(self.gains)

    def step(self, sample: Sample, reference: float) -> float:
        """Process a sample.

        Args:
            sample: the readings; NaN where a reading is missing.
            reference: [rad/s] finite.

        Returns:
            [0..1] The duty to apply from the next sample on.
        """
        s = self._observer.step(sample.theta, self._duty, sample.omega, sample.i_a).state
        if self._bumpless:
            self._bumpless = False
            self._loop.align(reference, s)
        self._duty, _ = self._loop.duty(reference, s)
        return self._duty


class FeedbackLinearizationCascade(FeedbackLinearization):
    """Feedback linearization whose thrust is controlled by the cascade of the rotor's speed.

    The reference of the PID is the output of a reference model, whose acceleration and jerk are fed forward. So the
    step response does not depend on the gains of the PID, and these can be low enough for good stability margins.
    """

    reads_motor: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Gain]] = {
        **feedback_linearization.GAINS,
        "reference_time": Gain("s", 0.0, 10.0, None, "1/ω of the reference model; 0: none"),
        "thrust_time": Gain("s", 0.0, 1.0, None, "time constant of the thrust; 0: that of the cascade"),
        **GAINS}

    def __init__(self, model: Model, gains: Mapping[str, float] | None = None, period: float = SAMPLE_PERIOD) -> None:
        """Prepare the law; see `PositionLaw`."""
        self._loop: SpeedLoop | None = None
        self._reference_model = ReferenceModel(0.0, period)
        super().__init__(model, gains, period)

    @classmethod
    def tune(cls, model: Model, requirements: Requirements = TABLE_6_1) -> dict[str, float]:
        """Gains that meet requirements with a reserve and with little overshoot.

        Args:
            model: the model of the rig.
            requirements: on the step response; M_p has no influence.

        Raises:
            TuningError: a requirement cannot be met; one line that names it.
        """
        check(requirements)
        air = model.effect("thrust_lag", "tau")
        slower = min(requirements.t_r / 0.5, requirements.t_p / 0.9, requirements.t_s / 1.2)
        decay = LOOP_FREQUENCY / slower * DAMPING
        M_p = math.exp(-math.pi * DAMPING / math.sqrt(1.0 - DAMPING**2))
        t_s = -math.log(0.02 * math.sqrt(1.0 - DAMPING**2)) / decay
        kp, ki, kd, _, follow = place(model, t_s, M_p, other_poles=POLE_RATIO)
        follow = follow or thrust_lag(model, OPERATING_POINT)
        return {**_defaults(), "tracking_time": 0.0, "kp": kp, "ki": ki, "kd": kd, "setpoint_weight": 1.0,
                "reference_time": slower / REFERENCE_FREQUENCY + 0.9 * air, "thrust_time": follow,
                **tune(model, follow - min(air, 0.5 * follow))}

    def reset(self, sample: Sample | None = None, duty: float = 0.0) -> None:
        """See `law.Law`."""
        super().reset(sample, duty)
        self._fresh = True
        if self._loop is not None:
            self._loop.reset()

    def _apply(self) -> None:
        super()._apply()
        if self._loop is None:
            self._loop = SpeedLoop(self._observer, self._allocation)
        self._loop.retune(self.gains)
        if self.gains["reference_time"] != self._reference_model.time:
            self._reference_model = ReferenceModel(self.gains["reference_time"], self._observer.period)
            self._fresh = True

    def _aim(self, reference: float, estimate: Estimate) -> tuple[float, float]:
        s = estimate.state
        if self._fresh:
            self._fresh = False
            self._reference_model.reset(s.theta)
        elif abs(self._missed) > LARGEST_LOSS:  # continue from the state of the arm
            acceleration = estimate.drive + self._per_thrust(estimate) * s.thrust
            self._reference_model.reset(s.theta, s.theta_dot, acceleration)
        y, rate, acceleration, jerk = self._reference_model.step(reference)
        c, g, follow = self._numbers["c_over_J"], self._numbers["mgd_over_J"], self.gains["thrust_time"]
        late = follow * (jerk + c * acceleration + g * math.cos(y) * rate)  # compensates the lag of the thrust
        return y, acceleration + c * rate + late + self.gains["kd"] * rate

    def _drive(self, thrust: float, s: State) -> tuple[float, float]:
        assert self._loop is not None
        a = self._allocation
        air_time = a.air_time(self.gains["thrust_time"])
        duty, speed = self._loop.duty(a.speed(a.static_thrust_for(thrust, s, air_time)), s)
        return duty, a.thrust_from(a.thrust(speed), s, air_time)


def _defaults() -> dict[str, float]:
    return {name: gain.default for name, gain in GAINS.items() if gain.default is not None}


def tune(model: Model, follow: float) -> dict[str, float]:
    """Gains of both PI controllers.

    Args:
        model: the model of the rig.
        follow: [s] time constant with which the speed follows its reference.
    """
    n = model.numbers()
    return {"speed_kp": n["J_m"] / (n["K_t"] * follow), "speed_ki": 0.0,
            "current_kp": max(CURRENT_SHARE * n["R_a"], CURRENT_LEAD * n["L_a"] / follow), "current_ki": 0.0}
