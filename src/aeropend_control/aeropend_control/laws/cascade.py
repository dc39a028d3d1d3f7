# SPDX-License-Identifier: Apache-2.0
"""Cascade control of the rotor's speed (thesis 6.7), alone and behind feedback linearization (6.8).

A PI on the speed asks for a current, within a limit; a PI on the current asks for a voltage. Speed and current are the
observer's, which knows that the speed is read late and held (see `observer.Observer`). The feedforward gives what holds
speed and current by the model, with the effects that it names and with what the observer found missing, so that tuned
loops leave no error without integrals of their own, which would wind up; 0 leaves all to the integrals, as in the
thesis.
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
from aeropend_control.laws.tuning import OPERATING_POINT, TABLE_6_1, TIME_SHARE, Requirements, place, thrust_lag
from aeropend_sim.model import dynamics
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model
from aeropend_sim.model.rig import Sample

GAINS = {
    "speed_kp": Gain("A·s/rad", 0.0, 100.0, None, "proportional gain, from speed to current"),
    "speed_ki": Gain("A/rad", 0.0, 1e3, None, "integral gain of the speed"),
    "current_kp": Gain("V/A", 0.0, 100.0, None, "proportional gain, from current to voltage"),
    "current_ki": Gain("V/A/s", 0.0, 1e4, None, "integral gain of the current"),
    "current_limit": Gain("A", 0.0, 100.0, 2.0, "current asked for at most"),
    "feedforward": Gain("-", 0.0, 1.0, 1.0, "share given at once of what holds speed and current by the model"),
}
"""Those of the cascade."""

THESIS_GAINS = {"speed_kp": 0.1, "speed_ki": 1.5, "current_kp": 1.2, "current_ki": 0.5, "current_limit": 2.0,
                "feedforward": 0.0}
"""The thesis' own (6.7); its limit of the current is not printed, 2 A is the motor shield's."""

REQUIREMENTS = Requirements(t_r=0.2, t_p=0.8, t_s=0.8, M_p=0.1)
"""What the thesis says of a step to 950 RPM (6.7); nothing of t_p."""

MOTION, STIFFNESS, SOFT = 7.8, 5.1, 2.0
"""For Table 6.1 and t_s 1.2 s: rad/s of the motion to follow after a step, and of the tuned loop behind it, whose other
poles are so many times faster (`tuning.OTHER_POLES`)."""

CURRENT_LEAD = 3.0
"""How many times quicker than the speed the current follows at least."""

OUT_OF_REACH = 0.5
"""rad/s² by which the limits may miss what is wanted before the motion to follow is begun anew."""

CURRENT_SHARE = 0.3
"""Gain of a tuned current loop as a share of the winding's resistance: more does not bear an unknown delay."""


class SpeedLoop:
    """Speed PI, current limit, current PI, and the voltage's way to the duty."""

    def __init__(self, observer: Observer, allocation: Allocation) -> None:
        self._observer, self._allocation = observer, allocation
        self._numbers = observer.model.numbers()
        n = self._numbers
        # friction that stops the rotor sooner than the current changes is not to be taken back at the present speed
        self._light = n["J_m"] * n["R_a"] < n["B_m"] * n["L_a"]
        self._speed, self._current = PID(0.0, period=observer.period), PID(0.0, period=observer.period)

    def retune(self, gains: Mapping[str, float]) -> None:
        """Take gains by the names of `GAINS`, without a bump."""
        self._speed.retune(gains["speed_kp"], gains["speed_ki"])
        self._current.retune(gains["current_kp"], gains["current_ki"])
        self._limit, self._feedforward, self._kp = gains["current_limit"], gains["feedforward"], gains["speed_kp"]
        self._slope = gains["current_kp"] + self._feedforward * self._numbers["R_a"]

    def reset(self) -> None:
        """Forget the past."""
        self._speed.reset()
        self._current.reset()

    def align(self, reference: float, s: dynamics.State) -> None:
        """Go on without a bump from the voltage that holds the state, with this reference next."""
        held = self._allocation.holding_current(s.omega, s.omega)
        free = 1.0 - self._feedforward
        self._speed.align(free * held, reference, s.omega)
        self._current.align(free * (self._numbers["K_e"] * s.omega + self._allocation.drop(held, s)), held, held)

    def duty(self, reference: float, s: dynamics.State) -> tuple[float, float]:
        """Duty for a speed (rad/s) in a state, and the speed that would have asked for what the limits leave."""
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
    """The law of the rotor's speed, for a model; see the module. Duty 0..1 out, reference in rad/s."""

    parameters: ClassVar[dict[str, Gain]] = GAINS

    def __init__(self, model: Model, gains: Mapping[str, float] | None = None, period: float = SAMPLE_PERIOD) -> None:
        """Take the model file's model; gains that are not given are those that `tune` gives for it.

        Raises:
            GainError: a gain that cannot be used.
        """
        given = checked(self.parameters, gains or {})
        self.model, self.gains = model, {**self.tune(model), **given}
        self._observer = Observer(model, period, motor=True)
        self._loop = SpeedLoop(self._observer, Allocation(self._observer))
        self._loop.retune(self.gains)
        self.reset()

    @staticmethod
    def tune(model: Model, requirements: Requirements = REQUIREMENTS) -> dict[str, float]:
        """Gains that meet requirements with a reserve, where the limits of voltage and current allow it."""
        follow = TIME_SHARE * min(requirements.t_r / 2.2, requirements.t_s / 4.0)
        return {**_defaults(), **tune(model, follow)}

    def reset(self, sample: Sample | None = None, duty: float = 0.0) -> None:
        """As `closed_loop.Law`."""
        self._observer.reset(duty, 0.0 if sample is None else sample.theta)
        self._loop.reset()
        self._duty, self._bumpless = duty, duty > 0.0

    def retune(self, gains: Mapping[str, float]) -> None:
        """As `closed_loop.Law`."""
        self.gains = {**self.gains, **checked(self.parameters, gains)}
        self._loop.retune(self.gains)

    def step(self, sample: Sample, reference: float) -> float:
        """Take a sample and return the duty (0..1) to apply from the next sample on.

        Args:
            sample: NaN where a reading was lost.
            reference: rad/s, finite.
        """
        s = self._observer.step(sample.theta, self._duty, sample.omega, sample.i_a).state
        if self._bumpless:
            self._bumpless = False
            self._loop.align(reference, s)
        self._duty, _ = self._loop.duty(reference, s)
        return self._duty


class FeedbackLinearizationCascade(FeedbackLinearization):
    """Feedback linearization whose thrust is held by the cascade on the rotor's speed.

    The PID's reference is the motion of a reference model, which the law knows the acceleration and jerk of: so the
    answer to a step is set apart from how hard the PID reacts, and that can keep its distance from instability.
    """

    reads_motor: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Gain]] = {
        **feedback_linearization.GAINS,
        "reference_time": Gain("s", 0.0, 10.0, None, "1/ω of the motion to follow after a step; 0: the step itself"),
        "thrust_time": Gain("s", 0.0, 1.0, None, "time in which the thrust follows; 0: as quick as the cascade is"),
        **GAINS}

    def __init__(self, model: Model, gains: Mapping[str, float] | None = None, period: float = SAMPLE_PERIOD) -> None:
        """As `PositionLaw`."""
        self._loop: SpeedLoop | None = None
        self._reference_model = ReferenceModel(0.0, period)
        super().__init__(model, gains, period)

    @classmethod
    def tune(cls, model: Model, requirements: Requirements = TABLE_6_1) -> dict[str, float]:
        """Gains that meet requirements with a reserve, with little overshoot.

        Raises:
            TuningError: one line that says which requirement cannot be met.
        """
        air = model.effect("thrust_lag", "tau")
        slower = min(requirements.t_r / 0.5, requirements.t_p / 0.9, requirements.t_s / 1.2)
        decay = STIFFNESS / slower * DAMPING
        M_p = math.exp(-math.pi * DAMPING / math.sqrt(1.0 - DAMPING**2))
        t_s = -math.log(0.02 * math.sqrt(1.0 - DAMPING**2)) / decay
        kp, ki, kd, _, follow = place(model, t_s, M_p, other_poles=SOFT)
        follow = follow or thrust_lag(model, OPERATING_POINT)
        return {**_defaults(), "tracking_time": 0.0, "kp": kp, "ki": ki, "kd": kd, "setpoint_weight": 1.0,
                "reference_time": slower / MOTION + 0.9 * air, "thrust_time": follow,
                **tune(model, follow - min(air, 0.5 * follow))}

    def reset(self, sample: Sample | None = None, duty: float = 0.0) -> None:
        """As `closed_loop.Law`."""
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
        elif abs(self._missed) > OUT_OF_REACH:  # go on from where the arm is
            acceleration = estimate.drive + self._per_thrust(estimate) * s.thrust
            self._reference_model.reset(s.theta, s.theta_dot, acceleration)
        y, rate, acceleration, jerk = self._reference_model.step(reference)
        c, g, follow = self._numbers["c_over_J"], self._numbers["mgd_over_J"], self.gains["thrust_time"]
        late = follow * (jerk + c * acceleration + g * math.cos(y) * rate)  # what a thrust that follows would lack
        return y, acceleration + c * rate + late + self.gains["kd"] * rate

    def _drive(self, thrust: float, s: dynamics.State) -> tuple[float, float]:
        assert self._loop is not None
        a = self._allocation
        air_time = a.air_time(self.gains["thrust_time"])
        duty, speed = self._loop.duty(a.speed(a.static_thrust_for(thrust, s, air_time)), s)
        return duty, a.thrust_from(a.thrust(speed), s, air_time)


def _defaults() -> dict[str, float]:
    return {name: gain.default for name, gain in GAINS.items() if gain.default is not None}


def tune(model: Model, follow: float) -> dict[str, float]:
    """Gains of both PIs with which the speed follows in `follow` s."""
    n = model.numbers()
    return {"speed_kp": n["J_m"] / (n["K_t"] * follow), "speed_ki": 0.0,
            "current_kp": max(CURRENT_SHARE * n["R_a"], CURRENT_LEAD * n["L_a"] / follow), "current_ki": 0.0}
