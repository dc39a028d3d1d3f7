# SPDX-License-Identifier: Apache-2.0
"""The small-signal law (thesis 6.5): a PID for the arm made linear around an angle, its output the thrust.

Around y₀ the arm is H = (L/J)/(s² + (c/J)s + (mgd/J)cos y₀). One set of gains belongs to one y₀; the schedule changes
kp with the reference so that the loop keeps the polynomial it has at `OPERATING_POINT`.

What the model names of effects on the arm, beside gravity and viscous friction, is taken back, so that the nominal arm
is left to the PID; the observer and the allocation are those of the other laws (see `feedback_linearization`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import ClassVar

from aeropend_control.laws.gains import Gain
from aeropend_control.laws.observer import Estimate
from aeropend_control.laws.position import NEVER, TRACKING_TIME, PositionLaw
from aeropend_control.laws.tuning import (
    OPERATING_POINT,
    OVERSHOOT_SHARE,
    TABLE_6_1,
    Requirements,
    arm_stiffness,
    place,
    settling_time,
)
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model

THESIS_GAINS = {"kp": 0.04, "ki": 0.993, "kd": -0.0086, "setpoint_weight": 1.0, "tracking_time": NEVER,
                "feedforward": 0.0, "thrust_time": 0.0}
"""The thesis' own (6.5), for 0.4 rad."""

REACH = 0.97
"""Share of the settling time it is tuned for: far from where the arm was made linear the law is slower."""


class SmallSignal(PositionLaw):
    """The law, for a model; see the module. Duty 0..1 out, reference and angle in rad."""

    parameters: ClassVar[dict[str, Gain]] = {
        "kp": Gain("N/rad", -10.0, 100.0, None, "proportional gain at 0.4 rad, from angle to thrust"),
        "ki": Gain("N/rad/s", 0.0, 1e3, None, "integral gain"),
        "kd": Gain("N·s/rad", -1.0, 10.0, None, "derivative gain at 0.4 rad"),
        "setpoint_weight": Gain("-", 0.0, 1.0, None, "share of the reference in the proportional part"),
        "tracking_time": TRACKING_TIME,
        "feedforward": Gain("-", 0.0, 1.0, None, "share of the thrust that holds the reference given at once"),
        "thrust_time": Gain("s", 0.0, 1.0, None, "time in which the thrust is made to follow; 0: the motor's"),
    }

    def __init__(self, model: Model, gains: Mapping[str, float] | None = None, period: float = SAMPLE_PERIOD,
                 schedule: bool = True) -> None:
        """As `PositionLaw`; without `schedule` the gains are those of 0.4 rad everywhere, as in the thesis."""
        self.schedule = schedule
        super().__init__(model, gains, period)

    @classmethod
    def tune(cls, model: Model, requirements: Requirements = TABLE_6_1) -> dict[str, float]:
        """Gains that meet requirements with a reserve.

        Raises:
            TuningError: one line that says which requirement cannot be met.
        """
        M_p = OVERSHOOT_SHARE * requirements.M_p
        kp, ki, kd, weight, thrust_time = place(model, REACH * settling_time(requirements, M_p), M_p)
        n = model.numbers()
        stiffness, per = arm_stiffness(model, OPERATING_POINT), 1.0 / n["L_over_J"]
        # with gravity left to the PID kp loses what gravity gives; the reference acts through the feedforward alone
        return {"kp": per * (kp - stiffness), "ki": per * ki, "kd": per * kd, "setpoint_weight": 0.0,
                "feedforward": min(1.0, weight * kp / stiffness), "thrust_time": thrust_time}

    def _apply(self) -> None:
        super()._apply()
        self._scheduled = math.nan

    def _schedule(self, reference: float) -> None:
        if not self.schedule or reference == self._scheduled:
            return
        self._scheduled = reference
        g, per = self.gains, 1.0 / self._numbers["L_over_J"]
        less = arm_stiffness(self.model, OPERATING_POINT) - arm_stiffness(self.model, reference)
        self._pid.retune(g["kp"] + per * less, g["ki"], g["kd"], setpoint_weight=g["setpoint_weight"],
                         tracking_time=g["tracking_time"])

    def _thrust(self, u: float, reference: float, estimate: Estimate) -> float:
        n, s = self._numbers, estimate.state
        held = self.gains["feedforward"] * arm_stiffness(self.model, OPERATING_POINT) * reference
        effects = estimate.drive - estimate.nominal_drive - self._friction(reference, s)
        return (u + (held - effects) / n["L_over_J"]) / (1.0 + estimate.ground)

    def _per_thrust(self, estimate: Estimate) -> float:
        return 1.0 + estimate.ground
