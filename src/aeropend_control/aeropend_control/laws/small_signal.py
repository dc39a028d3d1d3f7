# SPDX-License-Identifier: Apache-2.0
"""The small-signal law (thesis 6.5): a PID for the linearised arm, whose output is the thrust.

Around y₀ the arm is H = (L/J)/(s² + (c/J)s + (mgd/J)cos y₀). A set of gains belongs to one y₀. Gain scheduling changes
kp with the reference, so that the closed loop keeps the characteristic polynomial that it has at `OPERATING_POINT`.

The law compensates the effects of the model on the arm, so that the PID controls the nominal arm with its gravity and
viscous friction. Observer and allocation are those of the other laws (see `feedback_linearization`).
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
"""Gains of the thesis (6.5), for 0.4 rad."""

REACH = 0.97
"""Share of the required settling time that is used, because far from the operating point the law is slower (choice)."""


class SmallSignal(PositionLaw):
    """The law; see the module. Output: duty, 0..1; reference and angle in rad."""

    parameters: ClassVar[dict[str, Gain]] = {
        "kp": Gain("N/rad", -10.0, 100.0, None, "proportional gain from angle to thrust at 0.4 rad"),
        "ki": Gain("N/rad/s", 0.0, 1e3, None, "integral gain"),
        "kd": Gain("N·s/rad", -1.0, 10.0, None, "derivative gain at 0.4 rad"),
        "setpoint_weight": Gain("-", 0.0, 1.0, None, "share of the reference in the proportional part"),
        "tracking_time": TRACKING_TIME,
        "feedforward": Gain("-", 0.0, 1.0, None, "share of the steady thrust at the reference that is fed forward"),
        "thrust_time": Gain("s", 0.0, 1.0, None, "time constant of the thrust; 0: the motor's own"),
    }

    def __init__(self, model: Model, gains: Mapping[str, float] | None = None, period: float = SAMPLE_PERIOD,
                 schedule: bool = True) -> None:
        """Prepare the law.

        Args:
            model: see `PositionLaw`.
            gains: see `PositionLaw`.
            period: [s] between samples.
            schedule: gain scheduling; False: the gains for 0.4 rad at every angle, as in the thesis.
        """
        self.schedule = schedule
        super().__init__(model, gains, period)

    @classmethod
    def tune(cls, model: Model, requirements: Requirements = TABLE_6_1) -> dict[str, float]:
        """Gains that meet requirements with a reserve.

        Args:
            model: the model of the rig.
            requirements: on the step response.

        Raises:
            TuningError: a requirement cannot be met; one line that names it.
        """
        M_p = OVERSHOOT_SHARE * requirements.M_p
        kp, ki, kd, weight, thrust_time = place(model, REACH * settling_time(requirements, M_p), M_p)
        n = model.numbers()
        stiffness, per = arm_stiffness(model, OPERATING_POINT), 1.0 / n["L_over_J"]
        # gravity is not compensated: its stiffness counts for kp. The reference acts through the feedforward only.
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
