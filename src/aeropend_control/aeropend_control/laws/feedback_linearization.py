# SPDX-License-Identifier: Apache-2.0
"""Feedback linearization of the arm (thesis chapter 6), for a model with any effects.

With the thrust f = (J/L)((mgd/J) sin y + v) the plant from v to the angle is 1/(s(s + c/J)). A PID controls this plant;
its output is v. The law has three parts:

- The observer (`observer`) runs the model and corrects it by each reading of the angle. So it accounts for the angle
  filter, quantisation and noise, for `angle_offset`, `encoder_eccentricity`, `encoder_lag`, `command_delay` and errors
  of the angle by formula, and for every effect between the duty and the angle.
- The law compensates gravity, `cable_torque`, `quadratic_drag` and `axial_inflow` (the terms of `arm_drive`
  without thrust and viscous friction), `coulomb_friction` and `ground_effect`. Only the observer accounts for
  `mast_flex`. With a `command_delay` the law uses the predicted state at the time when the duty acts.
- The allocation (`allocation`) calculates speed, voltage and duty for the thrust.

The law reads the angle only. So effects on the other readings do not change it. A `gust` cannot be predicted.
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
    "kp": Gain("1/s²", 0.0, 1e4, None, "proportional gain from angle to acceleration"),
    "ki": Gain("1/s³", 0.0, 1e5, None, "integral gain"),
    "kd": Gain("1/s", -1e3, 1e3, None, "derivative gain"),
    "setpoint_weight": Gain("-", 0.0, 1.0, None, "share of the reference in the proportional part"),
    "tracking_time": TRACKING_TIME,
}
"""Gains of the PID, whose output v is in rad/s²."""

THESIS_GAINS = {"kp": 291.0, "ki": 436.0, "kd": 15.0, "setpoint_weight": 1.0, "tracking_time": NEVER}
"""Gains of the thesis (6.6). The printed thesis has ki and kd swapped."""


class FeedbackLinearization(PositionLaw):
    """The law; see the module. Output: duty, 0..1; reference and angle in rad."""

    parameters: ClassVar[dict[str, Gain]] = {
        **GAINS, "thrust_time": Gain("s", 0.0, 1.0, None, "time constant of the thrust; 0: the motor's own")}

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
        return tune(model, settling_time(requirements, M_p), M_p)

    def _thrust(self, u: float, reference: float, estimate: Estimate) -> float:
        s = estimate.state
        rest = estimate.drive - self._friction(reference, s)
        return (u - self._numbers["c_over_J"] * s.theta_dot - rest) / self._per_thrust(estimate)

    def _per_thrust(self, estimate: Estimate) -> float:
        return self._numbers["L_over_J"] * (1.0 + estimate.ground)


def tune(model: Model, t_s: float = 1.5, M_p: float = 0.1, at: float = OPERATING_POINT) -> dict[str, float]:
    """Gains by pole placement for the linearised arm (see `tuning.place`).

    Args:
        model: the model of the rig.
        t_s: [s] settling time to 2 %.
        M_p: overshoot as a share, 0 < M_p < 1.
        at: [rad] angle around which the arm is linearised.

    Raises:
        TuningError: a requirement cannot be met; one line that names it.
    """
    return place(model, t_s, M_p, at)._asdict()
