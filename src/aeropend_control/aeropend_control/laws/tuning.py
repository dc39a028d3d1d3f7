# SPDX-License-Identifier: Apache-2.0
"""Tuning by pole placement: gains from a model and requirements on the step response."""

from __future__ import annotations

import math
from typing import NamedTuple

from aeropend_sim.errors import UserError
from aeropend_sim.model import actuator
from aeropend_sim.model.parameters import Model

OTHER_POLES = 3.0
"""Ratio of the decay of the other two poles of a tuned loop to that of the dominant pair (choice; 3 to 5 is usual)."""

SHORTEST_LAG, LONGEST_LAG = 0.02, 0.15
"""[s] Limits of the time constant of the thrust in a tuned loop (choice)."""

OPERATING_POINT = 0.4
"""[rad] Angle around which the thesis linearises the arm (6.5)."""

TIME_SHARE, OVERSHOOT_SHARE = 0.7, 0.5
"""Shares of the required times and of the required overshoot that a tuned loop uses; the rest is reserve (choice)."""


class TuningError(UserError):
    """The model cannot meet the requirements; the message is one line for the user."""


class Requirements(NamedTuple):
    """Limits of a step response: rise, peak and settling time [s], overshoot [share]."""

    t_r: float = 0.5
    t_p: float = 0.9
    t_s: float = 3.6
    M_p: float = 0.2


TABLE_6_1 = Requirements()
"""The thesis' requirements, Table 6.1."""


def check(r: Requirements) -> None:
    """Make sure that all limits of a step response can be met by some.

    Args:
        r: the limits.

    Raises:
        TuningError: one is not above 0, or no number; one line that names it.
    """
    for name, value in r._asdict().items():
        if not 0.0 < value < math.inf:
            raise TuningError(f"{name} is {value:g}; give a number above 0")


class Pair(NamedTuple):
    """A dominant pair of poles: s² + 2 decay s + omega_2; [1/s], [1/s²]."""

    decay: float
    omega_2: float


class Placed(NamedTuple):
    """Gains of a PID with output in rad/s² (kp [1/s²], ki [1/s³], kd [1/s]), set-point weight, and thrust time [s]."""

    kp: float
    ki: float
    kd: float
    setpoint_weight: float
    thrust_time: float


def pair(t_s: float, M_p: float) -> Pair:
    """The pair of poles for a settling time and an overshoot.

    Args:
        t_s: [s] settling time to 2 %.
        M_p: overshoot as a share, 0 < M_p < 1.

    Raises:
        TuningError: an argument is out of range.
    """
    if not 0.0 < M_p < 1.0:
        raise TuningError(f"overshoot {M_p:g}: give a share above 0 and below 1")
    if not 0.0 < t_s < math.inf:
        raise TuningError(f"settling time {t_s:g} s: give more than 0")
    zeta = _damping(M_p)
    decay = -math.log(0.02 * math.sqrt(1.0 - zeta**2)) / t_s
    return Pair(decay, (decay / zeta) ** 2)


def _damping(M_p: float) -> float:
    return -math.log(M_p) / math.hypot(math.pi, math.log(M_p))


def settling_time(r: Requirements, M_p: float) -> float:
    """[s] Settling time of the slowest pair of poles whose times are within `TIME_SHARE` of their limits.

    Args:
        r: the limits.
        M_p: overshoot of the pair as a share, 0 < M_p < 1.

    Raises:
        TuningError: a time is not positive, or the overshoot is out of range.
    """
    check(r)
    if not 0.0 < M_p < 1.0:
        raise TuningError(f"overshoot {M_p:g}: give a share above 0 and below 1")
    zeta = _damping(M_p)
    rise = 1.0 - 0.4167 * zeta + 2.917 * zeta**2  # omega t_r of a second-order system (Nise, Control Systems, 4.6)
    peak = math.pi / math.sqrt(1.0 - zeta**2)
    settled = -math.log(0.02 * math.sqrt(1.0 - zeta**2)) / zeta
    omega = max(rise / r.t_r, peak / r.t_p, settled / r.t_s) / TIME_SHARE
    return settled / omega


def place(model: Model, t_s: float, M_p: float, at: float = OPERATING_POINT, other_poles: float = OTHER_POLES
          ) -> Placed:
    """A PID for the linearised arm with compensated gravity, by pole placement.

    With the thrust's time constant T the characteristic polynomial of the loop is
    T s⁴ + (1 + c/J T) s³ + (c/J + mgd/J cos y T + kd) s² + kp s + ki. Its roots are a dominant pair, from the
    requirements, and two real poles that decay `other_poles` times faster. The zero of the set-point weight cancels one
    of these.

    Args:
        model: the model of the rig.
        t_s: [s] settling time to 2 %.
        M_p: overshoot as a share, 0 < M_p < 1.
        at: [rad] angle around which the arm is linearised.
        other_poles: ratio of the decay of the other poles to that of the pair.

    Raises:
        TuningError: a requirement cannot be met; one line that names it.
    """
    decay, omega_2 = pair(t_s, M_p)
    n = model.numbers()
    c, g = n["c_over_J"], arm_stiffness(model, at)
    own = thrust_lag(model, at)
    lag = 1.0 / max(2.0 * (1.0 + other_poles) * decay - c, 1.0 / LONGEST_LAG)
    thrust_time = lag if lag < own else 0.0
    lag = min(lag, own)
    if thrust_time and thrust_time < max(SHORTEST_LAG, 4.0 * n["L_a"] / n["R_a"]):
        raise TuningError(f"settling time {t_s:g} s: the thrust would have to follow in {1e3 * lag:.0f} ms, and the "
                          "motor is not that quick; give a longer one")
    p = 0.5 * (1.0 / lag + c) - decay
    kd = lag * (omega_2 + 4.0 * decay * p + p * p) - c - g * lag
    kp = lag * (2.0 * p * omega_2 + 2.0 * decay * p * p)
    ki = lag * omega_2 * p * p
    return Placed(kp, ki, kd, ki / (kp * p), thrust_time)


def arm_stiffness(model: Model, at: float) -> float:
    """Stiffness of the linearised arm: derivative of gravity's torque over the inertia, with respect to the angle.

    Args:
        model: the model of the rig.
        at: [rad] angle around which the arm is linearised.

    Returns:
        [1/s²] (mgd/J) cos(at).
    """
    return float(model.numbers()["mgd_over_J"]) * math.cos(at)


def thrust_lag(model: Model, at: float) -> float:
    """[s] Time constant from the steady voltage to the thrust: winding, rotor and air.

    Args:
        model: the model of the rig.
        at: [rad] angle of the operating point.
    """
    n = model.numbers()
    speed = float(actuator.speed(n, n["mgd_over_J"] / n["L_over_J"] * math.sin(at)))
    friction = n["B_m"] + 2.0 * n["k_load"] * speed
    motor = (n["R_a"] * n["J_m"] + n["L_a"] * friction) / (n["R_a"] * friction + n["K_e"] * n["K_t"])
    return motor + model.effect("thrust_lag", "tau")
