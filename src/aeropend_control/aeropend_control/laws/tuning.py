# SPDX-License-Identifier: Apache-2.0
"""Gains from requirements and a model, by pole placement."""

from __future__ import annotations

import math
from typing import NamedTuple

from aeropend_sim.model import actuator
from aeropend_sim.model.parameters import Model

OTHER_POLES = 3.0
"""How many times faster than the dominant pair the other two poles of a tuned loop decay."""

SHORTEST_LAG, LONGEST_LAG = 0.02, 0.15
"""s in which the thrust of a tuned loop follows."""

OPERATING_POINT = 0.4
"""rad around which the thesis makes the arm linear."""

TIME_SHARE, OVERSHOOT_SHARE = 0.7, 0.5
"""How much of what is required a loop is tuned to use."""


class TuningError(ValueError):
    """Requirements that the model cannot meet; the message is one line for a person."""


class Requirements(NamedTuple):
    """What a step response may take at most: rise, peak and settling time (s), overshoot (share)."""

    t_r: float = 0.5
    t_p: float = 0.9
    t_s: float = 3.6
    M_p: float = 0.2


TABLE_6_1 = Requirements()
"""The thesis' requirements, Table 6.1."""


class Pair(NamedTuple):
    """A dominant pair of poles: s² + 2 decay s + omega_2."""

    decay: float
    omega_2: float


class Placed(NamedTuple):
    """A PID with output in rad/s² that places the poles of the arm (1/s², 1/s³, 1/s), see `place`."""

    kp: float
    ki: float
    kd: float
    setpoint_weight: float
    thrust_time: float


def pair(t_s: float, M_p: float) -> Pair:
    """The pair that settles to 2 % in t_s (s) with an overshoot M_p.

    Raises:
        TuningError: no such pair.
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
    """Settling time (s) of the slowest pair of overshoot M_p with which every time keeps `TIME_SHARE` of its limit.

    Raises:
        TuningError: a time that is not positive, or an overshoot out of range.
    """
    for name, value in r._asdict().items():
        if not 0.0 < value < math.inf:
            raise TuningError(f"{name} is {value:g}; give more than 0")
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
    """A PID for the arm with its gravity taken back, linear around an angle, by pole placement.

    A thrust that follows in T leaves the loop with T s⁴ + (1 + c/J T) s³ + (c/J + mgd/J cos y T + kd) s² + kp s + ki:
    a dominant pair from the requirements, and two real poles `other_poles` times faster, one of them cancelled by the
    set-point weight.

    Args:
        model: the model file's.
        t_s: settling time to 2 %, s.
        M_p: overshoot, 0 < M_p < 1.
        at: angle, rad.
        other_poles: how many times faster than the pair the others decay.

    Raises:
        TuningError: one line that says which requirement cannot be met.
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
    """In how many s the thrust follows the voltage that holds it, around an angle: winding, rotor and air."""
    n = model.numbers()
    speed = float(actuator.speed(n, n["mgd_over_J"] / n["L_over_J"] * math.sin(at)))
    friction = n["B_m"] + 2.0 * n["k_load"] * speed
    motor = (n["R_a"] * n["J_m"] + n["L_a"] * friction) / (n["R_a"] * friction + n["K_e"] * n["K_t"])
    return motor + model.effect("thrust_lag", "tau")
