# SPDX-License-Identifier: Apache-2.0
"""What the laws of the arm's angle have in common: observer, PID, allocation, and compensation of dry friction."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

from aeropend_control.laws.allocation import Allocation
from aeropend_control.laws.gains import Gain, checked
from aeropend_control.laws.observer import Estimate, Observer
from aeropend_control.laws.pid import PID
from aeropend_sim.model import dynamics
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model
from aeropend_sim.model.rig import Sample

FRICTION_RATE = 0.05
"""rad/s over which the compensation of dry friction changes its sign."""

FRICTION_LEAD = 8.0
"""1/s: an arm that sticks is taken to be meant to move towards the reference at this rate per rad."""

NEVER = 1e6
"""s: a tracking time with which nothing is led back, as in the thesis' library, whose limits are the PID's own."""

TRACKING_TIME = Gain("s", 0.0, NEVER, 0.0, "time in which the integral is led back at a limit; 0: half of sqrt(kd/ki)")


class PositionLaw:
    """A PID on the observed angle, and an allocation of the thrust that it asks for.

    A law says in `_thrust` which thrust the output of its PID means, and in `tune` what its gains are.
    """

    parameters: ClassVar[dict[str, Gain]]
    reads_motor: ClassVar[bool] = False

    def __init__(self, model: Model, gains: Mapping[str, float] | None = None, period: float = SAMPLE_PERIOD) -> None:
        """Take the model file's model; gains that are not given are those that `tune` gives for it.

        Raises:
            GainError: a gain that cannot be used.
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
        self._arm_friction = model.effect("coulomb_friction", "accel")
        self._apply()
        self.reset()

    @classmethod
    def tune(cls, model: Model) -> dict[str, float]:
        """Gains for a model."""
        raise NotImplementedError

    def reset(self, sample: Sample | None = None, duty: float = 0.0) -> None:
        """Forget the past; `duty` has been applied since long, and the law goes on from there without a bump.

        Args:
            sample: a recent one, from whose angle to start; without one, that of the next.
            duty: 0..1.
        """
        self._observer.reset(duty, math.nan if sample is None else sample.theta)
        self._pid.reset()
        self._duty, self._missed = duty, 0.0
        self._bumpless = duty > 0.0

    def retune(self, gains: Mapping[str, float]) -> None:
        """Take other gains, all or some, without a bump.

        Raises:
            GainError: a gain that cannot be used; all are as they were.
        """
        self.gains = {**self.gains, **checked(self.parameters, gains)}
        self._apply()

    def step(self, sample: Sample, reference: float) -> float:
        """Take a sample and return the duty (0..1) to apply from the next sample on.

        Args:
            sample: NaN where a reading was lost.
            reference: rad, finite.
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
        if ahead:  # what the motion ahead asks for beyond the limits is not the PID's to make good
            applied = min(max(applied, min(u, 0.0)), max(u, 0.0))
        self._pid.track(applied)
        return self._duty

    def _apply(self) -> None:
        """Put the gains to use."""
        g = self.gains
        self._pid.retune(g["kp"], g["ki"], g["kd"], setpoint_weight=g["setpoint_weight"],
                         tracking_time=g["tracking_time"])
        self._allocation.thrust_time = g.get("thrust_time", 0.0)

    def _schedule(self, reference: float) -> None:
        """Adapt the gains to the reference."""

    def _aim(self, reference: float, estimate: Estimate) -> tuple[float, float]:  # noqa: ARG002 - for others
        """Where the arm is meant to be now, and what is to be added to the PID's output for that."""
        return reference, 0.0

    def _thrust(self, u: float, reference: float, estimate: Estimate) -> float:
        """Thrust (N) that an output of the PID means."""
        raise NotImplementedError

    def _per_thrust(self, estimate: Estimate) -> float:
        """Change of the PID's output for a change of the thrust."""
        raise NotImplementedError

    def _drive(self, thrust: float, s: dynamics.State) -> tuple[float, float]:
        """Duty for a thrust, and the thrust that comes of it."""
        return self._allocation.duty(thrust, s)

    def _friction(self, reference: float, s: dynamics.State) -> float:
        """Dry friction in the pivot, rad/s², where the arm is meant to move."""
        if self._arm_friction == 0.0:
            return 0.0
        towards = s.theta_dot + FRICTION_LEAD * (reference - s.theta)
        return self._arm_friction * math.tanh(towards / FRICTION_RATE)
