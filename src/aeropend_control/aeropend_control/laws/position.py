# SPDX-License-Identifier: Apache-2.0
"""Base of the laws of the arm's angle: observer, PID, allocation, and compensation of dry friction."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

from aeropend_control.laws.allocation import Allocation
from aeropend_control.laws.gains import Gain, checked
from aeropend_control.laws.observer import Estimate, Observer
from aeropend_control.laws.pid import PID
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model
from aeropend_sim.model.rig import Sample
from aeropend_sim.model.state import State

FRICTION_RATE = 0.05
"""[rad/s] Width of the smooth change of sign of the friction compensation (choice)."""

FRICTION_LEAD = 8.0
"""[1/s] Rate per rad of control error that is added to the arm's rate for the sign of the friction compensation, so
that a sticking arm is pushed towards the reference (choice)."""

NEVER = 1e6
"""[s] A tracking time so long that back-calculation has no effect, as in the thesis' library (convention)."""

TRACKING_TIME = Gain("s", 0.0, NEVER, 0.0, "time constant of the anti-windup; 0: half of sqrt(kd/ki)")


class PositionLaw:
    """A PID of the observed angle, and an allocation of the demanded thrust.

    A subclass defines the thrust for an output of the PID (`_thrust`, `_per_thrust`) and the gains (`tune`).
    """

    parameters: ClassVar[dict[str, Gain]]
    reads_motor: ClassVar[bool] = False

    def __init__(self, model: Model, gains: Mapping[str, float] | None = None, period: float = SAMPLE_PERIOD) -> None:
        """Prepare the law for a model.

        Args:
            model: the model of the rig.
            gains: by name; missing ones are the defaults or come from `tune`.
            period: [s] between samples.

        Raises:
            GainError: a gain cannot be used.
        """
        self.model = model
        given = checked(self.parameters, gains or {})
        defaults = {name: p.default for name, p in self.parameters.items() if p.default is not None}
        tuned = {} if {*defaults, *given} >= {*self.parameters} else self.tune(model)
        self.gains: dict[str, float] = {**defaults, **tuned, **given}
        self._numbers = model.numbers()
        self._observer = Observer(model, period, self.reads_motor)
        self._pid = PID(0.0, period=period, exact=True)
        self._allocation = Allocation(self._observer)
        self._arm_friction = model.in_any_form("coulomb_friction", "accel")
        self._apply()
        self.reset()

    @classmethod
    def tune(cls, model: Model) -> dict[str, float]:
        """Gains for a model, by name."""
        raise NotImplementedError

    def reset(self, sample: Sample | None = None, duty: float = 0.0) -> None:
        """Restart the law; see `law.Law`.

        Args:
            sample: a recent sample, whose angle is the initial angle; None: the next sample.
            duty: [0..1] the duty that was constant for a long time.
        """
        self._observer.reset(duty, math.nan if sample is None else sample.theta)
        self._pid.reset()
        self._duty, self._missed = duty, 0.0
        self._bumpless = duty > 0.0

    def retune(self, gains: Mapping[str, float]) -> None:
        """Change some or all gains without a bump.

        Args:
            gains: new values by name.

        Raises:
            GainError: a gain cannot be used; all gains keep their values.
        """
        self.gains = {**self.gains, **checked(self.parameters, gains)}
        self._apply()

    def step(self, sample: Sample, reference: float) -> float:
        """Process a sample.

        Args:
            sample: the readings; NaN where a reading is missing.
            reference: [rad] finite.

        Returns:
            [0..1] The duty to apply from the next sample on.
        """
        estimate = self._observer.step(sample.theta, self._duty, sample.omega, sample.i_a)
        s = estimate.state
        self._schedule(reference)
        aim, ahead = self._aim(reference, estimate)
        if self._bumpless:
            self._bumpless = False
            self._pid.align((s.thrust - self._thrust(ahead, reference, estimate)) * self._per_thrust(estimate), aim,
                            s.theta, s.theta_dot)
        u = self._pid.step(aim, s.theta, s.theta_dot)
        wanted = self._thrust(u + ahead, reference, estimate)
        self._duty, given = self._drive(wanted, s)
        self._missed = (given - wanted) * self._per_thrust(estimate)
        applied = u + self._missed
        if ahead:  # the PID does not make up for feedforward that the limits cut off
            applied = min(max(applied, min(u, 0.0)), max(u, 0.0))
        self._pid.track(applied)
        return self._duty

    def _apply(self) -> None:
        """Pass the gains to the parts of the law."""
        g = self.gains
        self._pid.retune(g["kp"], g["ki"], g["kd"], setpoint_weight=g["setpoint_weight"],
                         tracking_time=g["tracking_time"])
        self._allocation.thrust_time = g.get("thrust_time", 0.0)

    def _schedule(self, reference: float) -> None:
        """Adapt the gains to the reference [rad]."""

    def _aim(self, reference: float, estimate: Estimate) -> tuple[float, float]:  # noqa: ARG002 - for subclasses
        """Reference of the PID [rad], and the feedforward that is added to its output."""
        return reference, 0.0

    def _thrust(self, u: float, reference: float, estimate: Estimate) -> float:
        """[N] Thrust for an output of the PID."""
        raise NotImplementedError

    def _per_thrust(self, estimate: Estimate) -> float:
        """Derivative of the PID's output with respect to the thrust."""
        raise NotImplementedError

    def _drive(self, thrust: float, s: State) -> tuple[float, float]:
        """Duty [0..1] for a thrust [N], and the thrust [N] that results within the limits."""
        return self._allocation.duty(thrust, s)

    def _friction(self, reference: float, s: State) -> float:
        """[rad/s²] Dry friction in the pivot, for the direction in which the arm moves or has to move."""
        if self._arm_friction == 0.0:
            return 0.0
        towards = s.theta_dot + FRICTION_LEAD * (reference - s.theta)
        return self._arm_friction * math.tanh(towards / FRICTION_RATE)
