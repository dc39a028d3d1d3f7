# SPDX-License-Identifier: Apache-2.0
"""Coefficients of the equations, and how many steps a hold of the input needs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aeropend_sim.compiled import njit
from aeropend_sim.model import actuator
from aeropend_sim.model.effects import NO_EFFECT, THRUST_PIVOT_SPEED, Values, values
from aeropend_sim.model.lag import NO_LAG, Lag, cached_lag
from aeropend_sim.model.parameters import LONGEST_STEP, SAMPLE_PERIOD, Model
from aeropend_sim.model.terms import EMPTY, NUDGE, Quantities, Terms, term_sum, terms

Array = NDArray[np.float64]

LONGEST_ARM_STEP = 10e-3
"""[s] Longest step of the arm alone while it does not reverse against dry friction.

Measured: the angle of `bench` then changes by at most 1e-5 of its range."""

LONGEST_MOTOR_STEP = 5e-3
"""[s] Longest step of the motor alone where only the arm is read.

Measured: the speed of `bench` and of 13 drawn motors then changes by at most 1e-3 of its range, after a jump of the
voltage."""

SAMPLED = 64
"""Points at which the slopes of terms by formula are sampled. A choice."""

RATIO = 0.5 * (math.sqrt(5.0) - 1.0)
"""Golden ratio: its multiples fill an interval evenly (derived)."""

MOST_TERM_STEPS = 32
"""Greatest number of steps of a hold for terms by formula. A choice: a friction that bends within 1 mrad/s needs 20."""

MOST_STEPS = 1000
"""Greatest number of steps of a hold, also for the fastest plant. A choice."""


class Coefficients(NamedTuple):
    """Coefficients of the equations for one length of hold: `steps` steps of `h` seconds. `prepare` computes them."""

    steps: int
    h: float
    winding: Lag
    rotor: Lag
    per_L: float
    K_e: float
    torque: float
    load: float
    drag: float
    k_thrust: float
    gravity: float
    damping: float
    lever: float


class Extra(NamedTuple):
    """Coefficients of the effects for one length of hold."""

    cooling: Lag
    air: Lag
    falling_air: Lag
    R_a: float
    R_total: float
    J_m: float
    gust_decay: float
    gust_kick: float
    per_free_inertia: float
    per_width: float


def steps_in(model: Model, period: float) -> int:
    """Number of steps of a hold: 1 at the rig's period, unless the plant is much faster than `bench`.

    Args:
        model: parameters and effects.
        period: [s] length of the hold.
    """
    return _steps_in(period, *rates(*model_parts(model), period))


def _steps_in(period: float, *rates: float) -> int:
    return steps_of(period, max(1.0 / LONGEST_STEP, *rates))


def steps_of(period: float, rate: float) -> int:
    """Number of steps of a hold [s] with at least so many steps in a second."""
    return min(MOST_STEPS, math.ceil(period * rate - 1e-9))


def model_parts(model: Model) -> tuple[Mapping[str, float], Values | None, Terms | None]:
    """Parameters, effects and terms by formula of a model."""
    e, added = values(model.effects), terms(model.effects)
    return model.numbers(), NO_EFFECT if e is None and added is not None else e, added


def rates(n: Mapping[str, float], e: Values | None, added: Terms | None, period: float) -> tuple[float, float]:
    """[1/s] Number of steps in a second that the motor and the arm need, by the rates of their fastest motions.

    The factors (0.04, 0.02, 0.1, 0.3) are choices; the tests compare the result with scipy's integrators for fast
    plants.
    """
    top_speed = float(actuator.speed_at(n, actuator.voltage(n, 1.0)))
    back = n["K_t"] * n["K_e"] / (n["J_m"] * n["L_a"])  # 1/s²: the speed acts back on itself through the winding
    motor = [min(math.sqrt(back / 0.04), back * n["L_a"] / (0.02 * n["R_a"])),
             2.0 * n["k_load"] * top_speed / n["J_m"] / 0.1]
    arm_ = [math.sqrt(n["mgd_over_J"]) / 0.3, n["c_over_J"] / 0.3]
    if e is not None:
        free = 1.0 - e.mast_flex_coupling
        top_thrust = n["k_thrust"] * THRUST_PIVOT_SPEED**2 * (top_speed / THRUST_PIVOT_SPEED)**e.thrust_exponent_n
        top_drive = n["mgd_over_J"] + n["L_over_J"] * top_thrust * (1.0 + max(0.0, e.ground_effect_gain))
        damping = (n["c_over_J"] + n["L_over_J"] * e.axial_inflow_k * top_speed
                   + 2.0 * math.sqrt(e.quadratic_drag_k * (top_drive + 4.0 * e.gust_sigma)))  # at terminal speed
        arm_ += [math.sqrt((n["mgd_over_J"] + abs(e.cable_torque_k)) / free) / 0.3, damping / free / 0.3]
        if e.mast_flex_coupling > 0.0:
            arm_ += [e.mast_flex_omega / math.sqrt(free) / 0.3,
                     2.0 * e.mast_flex_zeta * e.mast_flex_omega / free / 0.3]
    if added is not None:
        most = MOST_TERM_STEPS / period
        rate, angle, rotor_ = (min(x / 0.3, most) for x in term_rates(n, top_speed, added))
        motor.append(rotor_)
        arm_ += [rate, angle]
    return max(motor), max(arm_)


@njit()
def _slopes(first: int, end: int, points: Array, column: int, added: Terms) -> float:
    """Steepest slope of some terms with a quantity, over points (7, N)."""
    steepest = 0.0
    for k in range(points.shape[1]):
        p = points[:, k].copy()
        here = term_sum(first, end, Quantities(p[0], p[1], p[2], p[3], p[4], p[5], p[6]), EMPTY, added)
        nudge = NUDGE * max(abs(p[column]), 1e-3)
        p[column] += nudge
        there = term_sum(first, end, Quantities(p[0], p[1], p[2], p[3], p[4], p[5], p[6]), EMPTY, added)
        slope = abs(there - here) / nudge
        if slope > steepest and math.isfinite(slope):
            steepest = slope
    return steepest


def term_rates(n: Mapping[str, float], top_speed: float, added: Terms) -> tuple[float, float, float]:
    """[1/s] Rates of the motions that terms by formula cause: of arm's rate, arm's angle and rotor.

    Slopes are sampled, near standstill densely: there friction bends most.

    Args:
        n: parameters of the model.
        top_speed: [rad/s] of the rotor.
        added: terms.
    """
    share = np.array([(0.5 + k * RATIO) % 1.0 - 0.5 for k in range(SAMPLED)])
    near = 20.0 * share * np.exp(-1.0 * (np.arange(SAMPLED) % 10))
    points = np.zeros((7, SAMPLED))
    points[0], points[1], points[2] = 2.0 * share, near, top_speed * (share + 0.5)
    points[3] = n["k_thrust"] * points[2] ** 2
    lever = n["L_over_J"]
    ends = added.electrical, added.rotor, added.thrust, added.arm
    (rotor, _), (thrust, thrust_angle), (arm, arm_angle) = (
        (_slopes(a, b, points, column, added), _slopes(a, b, points, 0, added))
        for a, b, column in zip(ends, ends[1:], (2, 1, 1)))
    return arm + lever * thrust, math.sqrt(arm_angle + lever * thrust_angle), rotor / n["J_m"]


def prepare(model: Model, period: float = SAMPLE_PERIOD, steps: int = 0, *, full: bool = False
            ) -> tuple[Coefficients, Values | None, Extra | None, Terms | None]:
    """Coefficients of a model for `run`, `run_arm` and `run_motor`.

    Args:
        model: parameters and effects.
        period: [s] length of a hold.
        steps: steps of a hold; 0: `steps_in` decides.
        full: with the coefficients of the effects, also where there are none.

    Returns:
        The coefficients, the effects, the coefficients of the effects, and their terms by formula. What the model does
        not need is None.
    """
    n, e, added = model_parts(model)
    if full and e is None:
        e = NO_EFFECT
    return prepared(n, e, added, period, steps or _steps_in(period, *rates(n, e, added, period)))


def prepare_motor(model: Model, period: float, longest: float = LONGEST_STEP
                  ) -> tuple[Coefficients, Values | None, Extra | None, Terms | None]:
    """As `prepare`, for `run_motor` alone: the rates of the arm do not act on the number of steps.

    Args:
        model: parameters and effects.
        period: [s] length of a hold.
        longest: [s] longest step.
    """
    parts = model_parts(model)
    return prepared(*parts, period, steps_of(period, max(rates(*parts, period)[0], 1.0 / longest)))


def prepared(n: Mapping[str, float], e: Values | None, added: Terms | None, period: float, steps: int
             ) -> tuple[Coefficients, Values | None, Extra | None, Terms | None]:
    """As `prepare`, from the parts of a model and the number of steps."""
    h = period / steps
    resistance = n["R_a"] + (e.supply_sag_r_supply if e else 0.0)
    c = Coefficients(steps, h, cached_lag(resistance / n["L_a"], h), cached_lag(n["B_m"] / n["J_m"], h),
                     1.0 / n["L_a"], n["K_e"], n["K_t"] / n["J_m"], n["k_load"] / n["J_m"], n["B_m"] / n["J_m"],
                     n["k_thrust"], n["mgd_over_J"], n["c_over_J"], n["L_over_J"])
    if e is None:
        return c, None, None, None
    rise = 1.0 / e.thrust_lag_tau if e.thrust_lag_tau > NO_LAG * h else 0.0
    gust_decay = math.exp(-period / e.gust_tau)
    cooling, air, falling_air = (cached_lag(rate, h) for rate in (
        1.0 / e.winding_heating_tau, rise, rise / e.thrust_lag_fall))
    return c, e, Extra(cooling, air, falling_air, n["R_a"], resistance, n["J_m"], gust_decay,
                       e.gust_sigma * math.sqrt(1.0 - gust_decay**2), 1.0 / (1.0 - e.mast_flex_coupling),
                       1.0 / e.ground_effect_width), added
