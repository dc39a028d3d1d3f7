# SPDX-License-Identifier: Apache-2.0
"""Feedback linearization of the arm (thesis chapter 6), with any effect that the model file names.

The law f = (J/L)((mgd/J) sin y + v) leaves the plant 1/(s(s + c/J)) to a PID, whose output is v. Three parts:

- The observer is the model itself (`observer`), corrected by each reading of the angle. So the filter's lag,
  quantisation, noise, and what the effects do to motion and reading are known to it: `angle_offset`,
  `encoder_eccentricity` and `encoder_lag`, `command_delay`, and all that acts between the duty and the angle.
- The law takes back what `dynamics.arm_drive` holds beside the thrust and the viscous friction, which are gravity,
  `cable_torque`, `quadratic_drag` and `axial_inflow`, and beside it `coulomb_friction` and `ground_effect`; of
  `mast_flex` only the observer knows. Under a `command_delay` it acts on the state in which the duty will find the arm.
- The allocation (`allocation`) goes from thrust to speed, voltage and duty.

The law uses the angle only, so effects on the other readings do not reach it; a `gust` cannot be foreseen.
"""

from __future__ import annotations

from typing import ClassVar

from aeropend_control.laws.gains import Gain
from aeropend_control.laws.observer import Estimate
from aeropend_control.laws.position import NEVER, TRACKING_TIME, PositionLaw
from aeropend_control.laws.tuning import (
    OPERATING_POINT,
    OVERSHOOT_SHARE,
    TABLE_6_1,
    Requirements,
    place,
    settling_time,
)
from aeropend_sim.model.parameters import Model

GAINS = {
    "kp": Gain("1/s²", 0.0, 1e4, None, "proportional gain, from angle to acceleration"),
    "ki": Gain("1/s³", 0.0, 1e5, None, "integral gain"),
    "kd": Gain("1/s", -1e3, 1e3, None, "derivative gain"),
    "setpoint_weight": Gain("-", 0.0, 1.0, None, "share of the reference in the proportional part"),
    "tracking_time": TRACKING_TIME,
}
"""Those of the PID whose output is v, rad/s²."""

THESIS_GAINS = {"kp": 291.0, "ki": 436.0, "kd": 15.0, "setpoint_weight": 1.0, "tracking_time": NEVER}
"""The thesis' own (6.6); in print ki and kd are swapped."""


class FeedbackLinearization(PositionLaw):
    """The law, for a model; see the module. Duty 0..1 out, reference and angle in rad."""

    parameters: ClassVar[dict[str, Gain]] = {
        **GAINS, "thrust_time": Gain("s", 0.0, 1.0, None, "time in which the thrust is made to follow; 0: the motor's")}

    @classmethod
    def tune(cls, model: Model, requirements: Requirements = TABLE_6_1) -> dict[str, float]:
        """Gains that meet requirements with a reserve.

        Raises:
            TuningError: one line that says which requirement cannot be met.
        """
        M_p = OVERSHOOT_SHARE * requirements.M_p
        return tune(model, settling_time(requirements, M_p), M_p)

    def _thrust(self, u: float, reference: float, estimate: Estimate) -> float:
        s = estimate.state
        rest = estimate.drive - self._friction(reference, s)
        return (u - self._numbers["c_over_J"] * s.theta_dot - rest) / self._per_thrust(estimate)

    def _per_thrust(self, estimate: Estimate) -> float:
        return self._numbers["L_over_J"] * (1.0 + estimate.ground)


def tune(model: Model, t_s: float = 1.5, M_p: float = 0.1, at: float = OPERATING_POINT) -> dict[str, float]:
    """Gains by pole placement for the model, linear around an angle (see `tuning.place`).

    Args:
        model: the model file's.
        t_s: settling time to 2 %, s.
        M_p: overshoot, 0 < M_p < 1.
        at: angle, rad.

    Raises:
        TuningError: one line that says which requirement cannot be met.
    """
    return place(model, t_s, M_p, at)._asdict()
