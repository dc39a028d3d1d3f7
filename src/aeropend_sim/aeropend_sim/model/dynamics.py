# SPDX-License-Identifier: Apache-2.0
"""The equations of the plant, once: nominal and with every effect, for one hold of the input at a time.

The chain is advanced in the direction of cause: winding and rotor (which act on each other), air, arm. Winding, rotor
and air are first-order lags. They are advanced exactly for an input that is quadratic over the step (exponential time
differencing, Cox & Matthews 2002). The arm is advanced by the fourth-order Runge-Kutta-Nyström method. So a step as
long as the electrical time constant costs no accuracy. A longer hold, or the hold of a faster plant, is cut into equal
steps.

For the nominal model the effects are None: numba then compiles the equations without them.

Source of the nominal equations: thesis (3.2) to (3.5), with a quadratic load of the propeller (see `k_load` in
docs/interfaces.md). Equations of the effects: docs/effects.md.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aeropend_sim.compiled import njit
from aeropend_sim.model import actuator
from aeropend_sim.model.effects import NO_EFFECT, Values, values
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model
from aeropend_sim.model.terms import (
    EMPTY,
    NUDGE,
    Memory,
    Quantities,
    Terms,
    remembered,
    term_sum,
    terms,
)

Array = NDArray[np.float64]

equation = njit(forceinline=True, error_model="numpy")
"""Decorator of an equation: it is compiled into its callers, without a test for zero before each division."""

THRUST_PIVOT_SPEED = 150.0
"""[rad/s] Speed at which `thrust_exponent` does not change the thrust (docs/effects.md). Convention."""

NO_LAG = 1e-6
"""Share of a step below which the time constant of a lag counts as zero. A choice."""

ROUND = 6755399441055744.0
"""1.5 · 2^52: adding and subtracting it rounds a double to the nearest integer."""

BRUSH_CURRENT = 0.02
"""[A] Scale of the current over which the brush drop changes its sign (docs/effects.md). Convention."""

LONGEST_STEP = 2.5e-3
"""[s] Longest step. Measured: over a longer one the error exceeds 2e-5 of the range of each state of `bench`."""

LONGEST_ARM_STEP = 10e-3
"""[s] Longest step of the arm alone. Measured: the angle of `bench` then changes by at most 1e-5 of its range."""

SAMPLED = 64
"""Points at which the slopes of terms by formula are sampled. A choice."""

RATIO = 0.5 * (math.sqrt(5.0) - 1.0)
"""Golden ratio: its multiples fill an interval evenly (derived)."""

MOST_TERM_STEPS = 32
"""Greatest number of steps of a hold for terms by formula. A choice: a friction that bends within 1 mrad/s needs 20."""

MOST_STEPS = 1000
"""Greatest number of steps of a hold, also for the fastest plant. A choice."""


class Lag(NamedTuple):
    """Weights of a first-order lag ẋ = -a x + g over a step h, for g quadratic through its values at 0, h/2, h.

    x(h) = decay x + w0 g0 + w1 g(h/2) + w2 g(h), and x(h/2) likewise with half_decay, u0, u1, u2.
    """

    decay: float
    w0: float
    w1: float
    w2: float
    half_decay: float
    u0: float
    u1: float
    u2: float


@equation
def lag(a: float, h: float) -> Lag:
    """The weights of a lag.

    Args:
        a: [1/s] rate, >= 0.
        h: [s] length of the step.
    """
    half = math.exp(-0.5 * a * h)
    full = half * half
    p1, p2, p3 = _phi(full, -a * h)
    q1, q2, q3 = _phi(half, -0.5 * a * h)
    s = 0.5 * h
    return Lag(full, h * (p1 - 3.0 * p2 + 4.0 * p3), h * (4.0 * p2 - 8.0 * p3), h * (4.0 * p3 - p2),
               half, s * (q1 - 1.5 * q2 + q3), s * (2.0 * q2 - 2.0 * q3), s * (q3 - 0.5 * q2))


@equation
def _phi(exp_z: float, z: float) -> tuple[float, float, float]:
    """The functions of exponential integrators, φ_k(z) = Σ z^j / (j + k)!, for k = 1, 2, 3."""
    if abs(z) > 0.3:  # a choice: nearer to 0 the differences lose digits, and the series below is exact to rounding
        per_z = 1.0 / z
        p1 = (exp_z - 1.0) * per_z
        p2 = (p1 - 1.0) * per_z
        return p1, p2, (p2 - 0.5) * per_z
    p3 = term = 1.0 / 6.0
    for j in range(4, 16):
        term *= z / j
        p3 += term
    p2 = 0.5 + z * p3
    return 1.0 + z * p2, p2, p3


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


class State(NamedTuple):
    """State of the plant at an instant, SI units. The last six belong to effects and are 0 without them."""

    i_a: float = 0.0
    omega: float = 0.0
    rotor_angle: float = 0.0
    theta: float = 0.0
    theta_dot: float = 0.0
    thrust: float = 0.0
    heat: float = 0.0
    flex: float = 0.0
    flex_dot: float = 0.0
    gust: float = 0.0
    time: float = 0.0
    memory: Memory = EMPTY


class Over(NamedTuple):
    """A quantity over one step."""

    start: float
    middle: float
    end: float


class Past(NamedTuple):
    """Time (s), and the states of effects by formula, at an instant."""

    time: float
    memory: Memory


class Pasts(NamedTuple):
    """`Past` over one step."""

    start: Past
    middle: Past
    end: Past


class Motion(NamedTuple):
    """The motion of the arm, and of the mode of the mast."""

    theta: float
    theta_dot: float
    flex: float
    flex_dot: float


@equation
def sine_cosine(x: float) -> tuple[float, float]:
    """(sin x, cos x) to 1e-15 within a few turns, without branch or call, so that it runs in SIMD lanes."""
    k = (x * (1.0 / math.pi) + ROUND) - ROUND
    r = x - k * math.pi
    z = r * r
    z2 = z * z
    z4 = z2 * z2
    # Taylor series over [-π/2, π/2], summed in Estrin's order
    s = ((1.0 - z * (1.0 / 6.0)) + z2 * (1.0 / 120.0 - z * (1.0 / 5040.0))
         + z4 * ((1.0 / 362880.0 - z * (1.0 / 39916800.0)) + z2 * (1.0 / 6227020800.0 - z * (1.0 / 1307674368000.0)))
         + z4 * z4 * (1.0 / 355687428096000.0 - z * (1.0 / 121645100408832000.0)))
    c = ((1.0 - z * (1.0 / 2.0)) + z2 * (1.0 / 24.0 - z * (1.0 / 720.0))
         + z4 * ((1.0 / 40320.0 - z * (1.0 / 3628800.0)) + z2 * (1.0 / 479001600.0 - z * (1.0 / 87178291200.0)))
         + z4 * z4 * ((1.0 / 20922789888000.0 - z * (1.0 / 6402373705728000.0)) + z2 * (1.0 / 2432902008176640000.0)))
    odd = k - 2.0 * ((0.5 * k + ROUND) - ROUND)
    sign = 1.0 - 2.0 * odd * odd
    return sign * r * s, sign * c


@equation
def near(sin_x: float, cos_x: float, d: float) -> float:
    """sin(x + d) for a small d, to d²/2."""
    return sin_x + d * cos_x


@equation
def volts(i: float, w: float, v: float, t: float, memory: Memory, added: Terms) -> float:
    """[V] Sum of the terms by formula at the actuator and in the winding."""
    q = Quantities(0.0, 0.0, w, 0.0, i, v, t)
    return term_sum(0, added.electrical, q, memory, added)


@equation
def linear_volts(i: float, w: float, v: float, p: Past, added: Terms) -> tuple[float, float]:
    """`volts` made linear around a current: its value at no current (V), and its slope (Ω)."""
    nudge = NUDGE * max(abs(i), 0.1)
    here = volts(i, w, v, p.time, p.memory, added)
    slope = (volts(i + nudge, w, v, p.time, p.memory, added) - here) / nudge
    return here - slope * i, slope


@equation
def rotor_terms(i: float, w: float, v: float, p: Past, added: Terms) -> float:
    """[N·m] Sum of the terms by formula on the rotor."""
    return term_sum(added.electrical, added.rotor, Quantities(0.0, 0.0, w, 0.0, i, v, p.time), p.memory, added)


@equation
def arm_terms(motion: Motion, f: float, w: float, direction: float, p: Past, c: Coefficients, added: Terms) -> float:
    """[rad/s²] Sum of the terms by formula of the thrust and on the arm, over the arm's inertia.

    Args:
        motion: of the arm.
        f: [N] thrust.
        w: [rad/s] speed of the rotor.
        direction: sign of the motion, which dry friction opposes; 0: without dry friction.
        p: time and memories.
        c: coefficients.
        added: terms by formula.
    """
    q = Quantities(motion.theta, motion.theta_dot, w, f, 0.0, 0.0, p.time)
    total = (c.lever * term_sum(added.rotor, added.thrust, q, p.memory, added)
             + term_sum(added.thrust, added.arm, q, p.memory, added))
    if added.arm_friction > added.rotor_friction and direction != 0.0:
        total -= direction * max(term_sum(added.rotor_friction, added.arm_friction, q, p.memory, added), 0.0)
    return total


@equation
def grip(theta: float, f: float, w: float, past: Pasts | None, e: Values, added: Terms | None) -> float:
    """[rad/s²] Dry friction of the arm at rest, over its inertia."""
    limit = e.coulomb_friction_accel
    if added is not None and added.arm_friction > added.rotor_friction:
        q = Quantities(theta, 0.0, w, f, 0.0, 0.0, past.start.time)
        limit += max(term_sum(added.rotor_friction, added.arm_friction, q, past.start.memory, added), 0.0)
    return limit


@equation
def winding(i0: float, v: float, speed: Over, k: Lag, c: Coefficients) -> tuple[float, float]:
    """L_a di/dt = v - R_a i - K_e ω, thesis (3.5), over one step.

    Args:
        i0: [A] current at the start.
        v: [V] voltage, constant.
        speed: [rad/s] ω.
        k: weights of the winding.
        c: coefficients.

    Returns:
        [A] current in the middle and at the end.
    """
    g0, gm, g1 = (v - c.K_e * speed.start) * c.per_L, (v - c.K_e * speed.middle) * c.per_L, (
        v - c.K_e * speed.end) * c.per_L
    return (k.half_decay * i0 + k.u0 * g0 + k.u1 * gm + k.u2 * g1,
            k.decay * i0 + k.w0 * g0 + k.w1 * gm + k.w2 * g1)


@equation
def rotor(current: Over, speed: Over, friction: float, c: Coefficients, more: Over | None) -> tuple[float, float]:
    """J_m dω/dt = K_t i - B_m ω - k_load ω|ω| over one step.

    Args:
        current: [A] i.
        speed: [rad/s] ω at the start, and estimates of it in the middle and at the end, which give the quadratic load.
        friction: [rad/s²] Coulomb torque over inertia, with its sign.
        c: coefficients.
        more: [rad/s²] further torque over inertia.

    Returns:
        [rad/s] speed in the middle and at the end.
    """
    g0 = c.torque * current.start - c.load * speed.start * abs(speed.start) - friction
    gm = c.torque * current.middle - c.load * speed.middle * abs(speed.middle) - friction
    g1 = c.torque * current.end - c.load * speed.end * abs(speed.end) - friction
    if more is not None:
        g0, gm, g1 = g0 + more.start, gm + more.middle, g1 + more.end
    k = c.rotor
    return (k.half_decay * speed.start + k.u0 * g0 + k.u1 * gm + k.u2 * g1,
            k.decay * speed.start + k.w0 * g0 + k.w1 * gm + k.w2 * g1)


@equation
def winding_rotor(i0: float, w0: float, v: float, heat: float, past: Pasts | None, c: Coefficients, e: Values | None,
                  x: Extra | None, added: Terms | None) -> tuple[float, float, float, float]:
    """Winding and rotor together over one step, by two sweeps over the pair.

    Args:
        i0: [A] current at the start.
        w0: [rad/s] speed at the start.
        v: [V] voltage, constant.
        heat: [A²s] state of `winding_heating` in the middle.
        past: time and memories; None without terms.
        c: coefficients.
        e: effects.
        x: coefficients of the effects.
        added: terms by formula.

    Returns:
        Current in the middle and at the end, speed in the middle and at the end.
    """
    friction, sticks = 0.0, False
    if e is not None:
        friction = e.rotor_friction_torque / x.J_m
    if added is not None and added.rotor_friction > added.arm:
        q = Quantities(0.0, 0.0, w0, 0.0, i0, v, past.start.time)
        friction += max(term_sum(added.arm, added.rotor_friction, q, past.start.memory, added), 0.0) / x.J_m
    if e is not None and friction > 0.0:
        drive = c.torque * i0
        sticks = w0 == 0.0 and abs(drive) <= friction
        if w0 < 0.0 or (w0 == 0.0 and drive < 0.0):
            friction = -friction
    slope = c.h * (c.torque * i0 - c.load * w0 * abs(w0) - c.drag * w0 - friction)
    if added is not None and added.rotor > added.electrical:
        slope += c.h * rotor_terms(i0, w0, v, past.start, added) / x.J_m
    wm, w1 = w0 + 0.5 * slope, w0 + slope
    if sticks:
        wm, w1 = 0.0, 0.0
    im, i1 = i0, i0
    k, resistance, drop, pieces = c.winding, 0.0, 0.0, 1
    if added is not None:
        resistance = x.R_total
    if e is not None and (e.brush_drop_v_brush > 0.0 or e.winding_heating_gain > 0.0):
        resistance, drop, pieces = linearised_winding(i0, v - c.K_e * w0, heat, c, e, x)
        k = lag(resistance * c.per_L, c.h)
    for _ in range(2):
        more = drop
        if added is not None and added.electrical > 0:
            constant, fall = linear_volts(im, wm, v, past.middle, added)
            k, more = lag((resistance - fall) * c.per_L, c.h), drop - constant
        if e is not None and pieces > 1:
            im, i1 = brush_winding(i0, v, Over(w0, wm, w1), heat, pieces, past, c, e, x, added)
        else:
            im, i1 = winding(i0, v - more, Over(w0, wm, w1), k, c)
        if sticks:
            wm, w1 = breakaway(Over(c.torque * i0, c.torque * im, c.torque * i1), abs(friction), 0.5 * c.h)
        elif added is not None and added.rotor > added.electrical:
            torque = Over(rotor_terms(i0, w0, v, past.start, added) / x.J_m,
                          rotor_terms(im, wm, v, past.middle, added) / x.J_m,
                          rotor_terms(i1, w1, v, past.end, added) / x.J_m)
            wm, w1 = rotor(Over(i0, im, i1), Over(w0, wm, w1), friction, c, torque)
        else:
            wm, w1 = rotor(Over(i0, im, i1), Over(w0, wm, w1), friction, c, None)
    if e is not None and not sticks and friction * w1 < 0.0:
        wm, w1 = wm if w0 * wm > 0.0 else 0.0, 0.0  # it stops; the next step decides whether it turns again
    return im, i1, wm, w1


@equation
def breakaway(drive: Over, limit: float, s: float) -> tuple[float, float]:
    """Speed of a rotor that sticks until |drive| > limit, for a drive that is linear between its values.

    Args:
        drive: [rad/s²] torque over inertia.
        limit: [rad/s²] friction torque over inertia.
        s: [s] half of the step.

    Returns:
        [rad/s] speed in the middle and at the end.
    """
    d0, dm, d1 = drive
    a, b = abs(dm) - limit, abs(d1) - limit
    if a > 0.0:
        wm = 0.5 * s * a * a / (abs(dm) - abs(d0))
        return math.copysign(wm, dm), math.copysign(max(wm + 0.5 * s * (a + b), 0.0), dm)
    if b > 0.0:
        return 0.0, math.copysign(0.5 * s * b * b / (abs(d1) - abs(dm)), d1)
    return 0.0, 0.0


@equation
def brush_sign(i: float) -> float:
    """tanh(i/0.02), to 4e-9."""
    if abs(i) > 10.0 * BRUSH_CURRENT:
        return math.copysign(1.0, i)
    return 1.0 - 2.0 / (1.0 + math.exp(2.0 * i / BRUSH_CURRENT))


@equation
def linearised_winding(i0: float, v: float, heat: float, c: Coefficients, e: Values, x: Extra | None
                       ) -> tuple[float, float, int]:
    """The winding with brushes and heat, v - v_brush tanh(i/0.02) - R(T) i - K_e ω, made linear around i0.

    Args:
        i0: [A] current at the start.
        v: [V] voltage minus back-EMF.
        heat: [A²s] T in the middle of the step.
        c: coefficients.
        e: effects.
        x: coefficients of the effects.

    Returns:
        The resistance with that of the brushes (Ω), the constant part of the brush drop (V), and the number of pieces
        into which the step must be cut: more than one if the current crosses the bend of the tanh.
    """
    resistance = x.R_total + x.R_a * e.winding_heating_gain * heat
    if e.brush_drop_v_brush == 0.0:
        return resistance, 0.0, 1
    t = brush_sign(i0)
    stiffness = e.brush_drop_v_brush * (1.0 - t * t) / BRUSH_CURRENT
    decay = math.exp(-(resistance + stiffness) * c.per_L * c.h)
    drop = e.brush_drop_v_brush * t - stiffness * i0
    i1 = decay * i0 + (1.0 - decay) * (v - drop) / (resistance + stiffness)
    pieces = 1  # the limits below are choices: pieces of 0.2 BRUSH_CURRENT near the bend, at most 16
    if i0 * i1 < 0.0 or min(abs(i0), abs(i1)) < 6.0 * BRUSH_CURRENT:
        pieces = 1 + min(15, int(abs(i1 - i0) / (0.2 * BRUSH_CURRENT)))
    return resistance + stiffness, drop, pieces


@equation
def brush_winding(i0: float, v: float, speed: Over, heat: float, pieces: int, past: Pasts | None, c: Coefficients,
                  e: Values, x: Extra | None, added: Terms | None) -> tuple[float, float]:
    """As `winding`, the step cut into pieces, and made linear in each (exponential Rosenbrock-Euler method).

    Args:
        i0: [A] current at the start.
        v: [V] voltage, constant.
        speed: [rad/s] ω.
        heat: [A²s] T in the middle of the step.
        pieces: number of pieces; an odd number is raised by one.
        past: time and memories; None without terms.
        c: coefficients.
        e: effects.
        x: coefficients of the effects.
        added: terms by formula.

    Returns:
        [A] current in the middle and at the end.
    """
    w0, wm, w1 = speed
    resistance = x.R_total + x.R_a * e.winding_heating_gain * heat
    pieces += pieces % 2
    h = c.h / pieces
    i = im = i0
    for j in range(pieces):
        s = (j + 0.5) / pieces
        w = w0 + s * (4.0 * wm - 3.0 * w0 - w1) + s * s * (2.0 * w0 - 4.0 * wm + 2.0 * w1)
        t = brush_sign(i)
        total = resistance + e.brush_drop_v_brush * (1.0 - t * t) / BRUSH_CURRENT
        forcing = v - c.K_e * w - e.brush_drop_v_brush * t - resistance * i
        if added is not None:
            constant, fall = linear_volts(i, w, v, past.middle, added)
            total -= fall
            forcing += constant + fall * i
        i += (1.0 - math.exp(-total * c.per_L * h)) / total * forcing
        if 2 * (j + 1) == pieces:
            im = i
    return im, i


@equation
def static_thrust(w: float, c: Coefficients, e: Values | None) -> float:
    """Thrust of a steady speed: f = k_thrust ω|ω|, thesis (3.3)."""
    if e is not None and e.thrust_exponent_n != 2.0:
        size = c.k_thrust * THRUST_PIVOT_SPEED**2 * (abs(w) / THRUST_PIVOT_SPEED) ** e.thrust_exponent_n
        return math.copysign(size, w)
    return c.k_thrust * w * abs(w)


@equation
def static_thrust_near(w: float, w0: float, f0: float, c: Coefficients, e: Values | None) -> float:
    """As `static_thrust`. Within 5 % of a speed w0 of known thrust f0, the binomial series is used, which is faster.

    Its first omitted term is below 4e-9 of the thrust, for exponents from 1 to 3.
    """
    if e is None or e.thrust_exponent_n == 2.0 or abs(w - w0) >= 0.05 * abs(w0):
        return static_thrust(w, c, e)
    n, d = e.thrust_exponent_n, w / w0 - 1.0
    return f0 * (1.0 + n * d * (1.0 + (n - 1.0) / 2.0 * d * (1.0 + (n - 2.0) / 3.0 * d * (1.0 + (n - 3.0) / 4.0 * d))))


@equation
def arm_drive(sin_theta: float, motion: Motion, f: float, w: float, gust: float, c: Coefficients,
              e: Values | None) -> float:
    """Torque on the arm over its inertia, without dry friction: -(mgd/J) sin θ - (c/J) θ̇ + (L/J) f, thesis (3.2).

    Args:
        sin_theta: sine of the angle.
        motion: of arm and mast.
        f: [N] thrust.
        w: [rad/s] speed of the rotor.
        gust: [rad/s²] further torque over inertia.
        c: coefficients.
        e: effects.

    Returns:
        [rad/s²] torque over inertia.
    """
    if e is None:
        return (c.lever * f - c.damping * motion.theta_dot) - c.gravity * sin_theta
    damping = c.damping + c.lever * e.axial_inflow_k * w + e.quadratic_drag_k * abs(motion.theta_dot)
    other = gust - e.cable_torque_k * (motion.theta - e.cable_torque_theta0) + flex_restoring(motion.flex,
                                                                                             motion.flex_dot, e)
    return ((c.lever * f - damping * motion.theta_dot) - c.gravity * sin_theta) + other


@equation
def near_ground(theta: float, e: Values | None) -> float:
    """Relative rise of the thrust by the ground effect: gain exp(-|θ|/width)."""
    if e is None or e.ground_effect_gain == 0.0:
        return 0.0
    return e.ground_effect_gain * math.exp(-abs(theta) / e.ground_effect_width)


@equation
def nearer_ground(g: float, theta: float, moved: float, e: Values | None, x: Extra | None) -> float:
    """`near_ground` of an angle `moved` that is close to `theta`, where its value is g."""
    if e is None or e.ground_effect_gain == 0.0:
        return 0.0
    return g + g * ((abs(theta) - abs(moved)) * x.per_width)


@equation
def flex_restoring(flex: float, flex_dot: float, e: Values) -> float:
    """Restoring acceleration of the mast: 2 zeta omega q̇ + omega² q."""
    if e.mast_flex_coupling == 0.0:
        return 0.0
    return 2.0 * e.mast_flex_zeta * e.mast_flex_omega * flex_dot + e.mast_flex_omega**2 * flex


@equation
def arm(motion: Motion, thrust: Over, speed: Over, direction: float, gust: float, past: Pasts | None, c: Coefficients,
        e: Values | None, x: Extra | None, added: Terms | None) -> Motion:
    """The arm, and the mode of the mast, over one step by the Runge-Kutta-Nyström method of fourth order.

    Args:
        motion: at the start.
        thrust: [N] thrust, without the ground effect.
        speed: [rad/s] speed of the rotor.
        direction: sign of the motion, which dry friction opposes; 0: without dry friction.
        gust: [rad/s²] random torque over inertia, constant.
        past: time and memories; None without terms.
        c: coefficients.
        e: effects.
        x: coefficients of the effects.
        added: terms by formula.

    Returns:
        The motion at the end.
    """
    y, yd, q, qd = motion
    s = 0.5 * c.h
    torque = gust if e is None else gust - direction * e.coulomb_friction_accel
    # One sine and cosine, in the middle. Those of the ends follow by rotation, so that the stages need not wait for
    # each other. The ground effect likewise: where the arm would be without acceleration, then moved a little.
    d = s * yd
    sin_m, cos_m = sine_cosine(y + d)
    d2 = d * d
    sin_d, cos_d = d * (1.0 - d2 * (1.0 / 6.0 - d2 * (1.0 / 120.0))), 1.0 - d2 * (0.5 - d2 * (1.0 / 24.0))
    sin_1, cos_1 = sin_m * cos_d + cos_m * sin_d, cos_m * cos_d - sin_m * sin_d
    g0, gm, g1 = near_ground(y, e), near_ground(y + d, e), near_ground(y + 2.0 * d, e)
    f0 = thrust.start + thrust.start * g0
    more = torque if added is None else torque + arm_terms(motion, f0, speed.start, direction, past.start, c, added)
    a1, b1 = arm_stage(sin_m * cos_d - cos_m * sin_d, motion, f0, speed.start, more, c, e, x)
    bend = 0.5 * s * s * a1
    sin_m, middle, qm = near(sin_m, cos_m, bend), y + d + bend, q + s * (qd + 0.5 * s * b1)
    fm = thrust.middle + thrust.middle * nearer_ground(gm, y + d, middle, e, x)
    second = Motion(middle, yd + s * a1, qm, qd + s * b1)
    more = torque if added is None else torque + arm_terms(second, fm, speed.middle, direction, past.middle, c, added)
    a2, b2 = arm_stage(sin_m, second, fm, speed.middle, more, c, e, x)
    third = Motion(middle, yd + s * a2, qm, qd + s * b2)
    more = torque if added is None else torque + arm_terms(third, fm, speed.middle, direction, past.middle, c, added)
    a3, b3 = arm_stage(sin_m, third, fm, speed.middle, more, c, e, x)
    bend = c.h * s * a3
    end = y + 2.0 * d + bend
    last = Motion(end, yd + c.h * a3, q + c.h * (qd + s * b3), qd + c.h * b3)
    f1 = thrust.end + thrust.end * nearer_ground(g1, y + 2.0 * d, end, e, x)
    more = torque if added is None else torque + arm_terms(last, f1, speed.end, direction, past.end, c, added)
    a4, b4 = arm_stage(near(sin_1, cos_1, bend), last, f1, speed.end, more, c, e, x)
    return Motion(
        y + c.h * (yd + s * (1.0 / 3.0) * (a1 + a2 + a3)), yd + s * (1.0 / 3.0) * (a1 + 2.0 * (a2 + a3) + a4),
        q + c.h * (qd + s * (1.0 / 3.0) * (b1 + b2 + b3)), qd + s * (1.0 / 3.0) * (b1 + 2.0 * (b2 + b3) + b4))


@equation
def arm_stage(sin_theta: float, motion: Motion, f: float, w: float, torque: float, c: Coefficients, e: Values | None,
              x: Extra | None) -> tuple[float, float]:
    """Accelerations (θ̈, q̈): the mode of the mast carries a share of the arm's inertia and acts back with -q̈.

    Args:
        sin_theta: sine of the angle.
        motion: of arm and mast.
        f: [N] thrust.
        w: [rad/s] speed of the rotor.
        torque: [rad/s²] gust minus dry friction.
        c: coefficients.
        e: effects.
        x: coefficients of the effects.
    """
    drive = arm_drive(sin_theta, motion, f, w, torque, c, e)
    if e is None:
        return drive, 0.0
    acceleration = drive * x.per_free_inertia
    return acceleration, -flex_restoring(motion.flex, motion.flex_dot, e) - e.mast_flex_coupling * acceleration


@equation
def mast_alone(q: float, qd: float, c: Coefficients, e: Values) -> tuple[float, float]:
    """The mode of the mast over one step while the arm sticks: q, q̇ at the end, as in `arm`."""
    s = 0.5 * c.h
    b1 = -flex_restoring(q, qd, e)
    qm = q + s * (qd + 0.5 * s * b1)
    b2 = -flex_restoring(qm, qd + s * b1, e)
    b3 = -flex_restoring(qm, qd + s * b2, e)
    b4 = -flex_restoring(q + c.h * (qd + s * b3), qd + c.h * b3, e)
    return q + c.h * (qd + s * (1.0 / 3.0) * (b1 + b2 + b3)), qd + s * (1.0 / 3.0) * (b1 + 2.0 * (b2 + b3) + b4)


@equation
def arm_with_dry_friction(motion: Motion, thrust: Over, speed: Over, gust: float, past: Pasts | None, c: Coefficients,
                          e: Values, x: Extra | None, added: Terms | None) -> Motion:
    """As `arm`, with Coulomb friction.

    Where the motion reverses, the step is cut at that instant. There the arm sticks, unless the drive is greater than
    the friction.

    Args:
        motion: at the start.
        thrust: [N] thrust, without the ground effect.
        speed: [rad/s] speed of the rotor.
        gust: [rad/s²] random torque over inertia, constant.
        past: time and memories; None without terms.
        c: coefficients.
        e: effects.
        x: coefficients of the effects.
        added: terms by formula.

    Returns:
        The motion at the end.
    """
    y, yd, q, qd = motion
    direction = 1.0 if yd > 0.0 else -1.0
    if yd == 0.0:
        f = thrust.start * (1.0 + near_ground(y, e))
        torque = gust if added is None else gust + arm_terms(motion, f, speed.start, 0.0, past.start, c, added)
        drive = arm_drive(math.sin(y), motion, f, speed.start, torque, c, e)
        if abs(drive) <= grip(y, f, speed.start, past, e, added):  # it sticks; the mast swings on alone
            q, qd = mast_alone(q, qd, c, e)
            return Motion(y, 0.0, q, qd)
        direction = 1.0 if drive > 0.0 else -1.0
    after = arm(motion, thrust, speed, direction, gust, past, c, e, x, added)
    if yd == 0.0 or yd * after.theta_dot > 0.0:
        return after
    reached = yd / (yd - after.theta_dot) if yd != after.theta_dot else 1.0
    turn = y + 0.5 * reached * c.h * yd
    f = (thrust.start + reached * (thrust.end - thrust.start)) * (1.0 + near_ground(turn, e))
    resting = Motion(turn, 0.0, after.flex, after.flex_dot)
    torque = gust if added is None else gust + arm_terms(resting, f, speed.end, 0.0, past.end, c, added)
    drive = arm_drive(math.sin(turn), resting, f, speed.end, torque, c, e)
    limit = grip(turn, f, speed.end, past, e, added)
    if abs(drive) <= limit:
        return resting
    rest = (1.0 - reached) * c.h
    acceleration = (drive - limit if drive > 0.0 else drive + limit) * x.per_free_inertia
    return Motion(turn + 0.5 * rest * rest * acceleration, rest * acceleration, after.flex, after.flex_dot)


@equation
def quantities(state: State, v: float) -> Quantities:
    """What formulas take, from the state of the plant and the voltage."""
    return Quantities(state.theta, state.theta_dot, state.omega, state.thrust, state.i_a, v, state.time)


@equation
def pasts(state: State, v: float, c: Coefficients, added: Terms) -> Pasts:
    """Time and memories over a step, predicted from its start."""
    start = Past(state.time, state.memory)
    middle, end = Past(state.time + 0.5 * c.h, state.memory), Past(state.time + c.h, state.memory)
    if added.memories == 0:
        return Pasts(start, middle, end)
    q = quantities(state, v)
    q = Quantities(q.theta + 0.5 * c.h * q.theta_dot, q.theta_dot, q.omega, q.thrust, q.i_a, q.v, middle.time)
    half = remembered(state.memory, state.memory, q, 0.5 * c.h, added)
    return Pasts(start, Past(middle.time, half), Past(end.time, remembered(state.memory, half, q, c.h, added)))


@equation
def past_after(state: State, after: State, v: float, past: Pasts, c: Coefficients, added: Terms) -> Past:
    """Time and memories at the end of a step whose other quantities are known."""
    if added.memories == 0:
        return past.end
    a, b = quantities(state, v), quantities(after, v)
    q = Quantities(0.5 * (a.theta + b.theta), 0.5 * (a.theta_dot + b.theta_dot), 0.5 * (a.omega + b.omega),
                   0.5 * (a.thrust + b.thrust), 0.5 * (a.i_a + b.i_a), v, past.middle.time)
    return Past(past.end.time, remembered(state.memory, past.middle.memory, q, c.h, added))


@equation
def advance_motor(state: State, v: float, past: Pasts | None, c: Coefficients, e: Values | None, x: Extra | None,
                  added: Terms | None) -> tuple[float, float, float, float, float]:
    """Winding and rotor over one step.

    Args:
        state: at the start.
        v: [V] voltage, constant.
        past: time and memories; None without terms.
        c: coefficients.
        e: effects.
        x: coefficients of the effects.
        added: terms by formula.

    Returns:
        Current at the end, speed in the middle and at the end, rotor angle and heat at the end.
    """
    i0, w0 = state.i_a, state.omega
    heat = state.heat
    if e is not None and e.winding_heating_gain > 0.0:
        heat += 0.5 * c.h * (i0 * i0 - heat / e.winding_heating_tau)
    im, i1, wm, w1 = winding_rotor(i0, w0, v, heat, past, c, e, x, added)
    angle = state.rotor_angle + c.h * (1.0 / 6.0) * (w0 + 4.0 * wm + w1)
    heat = 0.0
    if e is not None and e.winding_heating_gain > 0.0:
        k = x.cooling
        heat = k.decay * state.heat + k.w0 * i0 * i0 + k.w1 * im * im + k.w2 * i1 * i1
    return i1, wm, w1, angle, heat


@equation
def advance_arm(state: State, wm: float, w1: float, past: Pasts | None, c: Coefficients, e: Values | None,
                x: Extra | None, added: Terms | None) -> tuple[Motion, float]:
    """Air and arm over one step.

    Args:
        state: at the start.
        wm: [rad/s] speed of the rotor in the middle.
        w1: [rad/s] speed of the rotor at the end.
        past: time and memories; None without terms.
        c: coefficients.
        e: effects.
        x: coefficients of the effects.
        added: terms by formula.

    Returns:
        The motion and the thrust (N) at the end.
    """
    w0 = state.omega
    speed = Over(w0, wm, w1)
    f0 = static_thrust(w0, c, e)
    fm, f1 = static_thrust_near(wm, w0, f0, c, e), static_thrust_near(w1, w0, f0, c, e)
    if e is None:
        return arm(Motion(state.theta, state.theta_dot, 0.0, 0.0), Over(f0, fm, f1), speed, 0.0, 0.0, None, c, e, x,
                   None), f1
    if e.thrust_lag_tau > NO_LAG * c.h:
        k, a = x.air, 1.0 / e.thrust_lag_tau
        if e.thrust_lag_fall != 1.0 and fm < state.thrust:
            k, a = x.falling_air, a / e.thrust_lag_fall
        s0, sm, s1 = a * f0, a * fm, a * f1
        f0 = state.thrust
        fm, f1 = (k.half_decay * f0 + k.u0 * s0 + k.u1 * sm + k.u2 * s1,
                  k.decay * f0 + k.w0 * s0 + k.w1 * sm + k.w2 * s1)
    motion = Motion(state.theta, state.theta_dot, state.flex, state.flex_dot)
    sticks = e.coulomb_friction_accel > 0.0
    if added is not None:
        sticks = sticks or added.arm_friction > added.rotor_friction
    if sticks:
        return arm_with_dry_friction(motion, Over(f0, fm, f1), speed, state.gust, past, c, e, x, added), f1
    return arm(motion, Over(f0, fm, f1), speed, 0.0, state.gust, past, c, e, x, added), f1


@equation
def advance(state: State, v: float, c: Coefficients, e: Values | None, x: Extra | None, added: Terms | None) -> State:
    """The whole plant over one step, the gust held.

    Args:
        state: at the start.
        v: voltage at the bridge, held (`actuator.acting_voltage`).
        c: coefficients.
        e: effects; None for the nominal plant.
        x: coefficients of the effects; None for the nominal plant.
        added: terms by formula; None without any.
    """
    past = None if added is None else pasts(state, v, c, added)
    i1, wm, w1, angle, heat = advance_motor(state, v, past, c, e, x, added)
    m, f1 = advance_arm(state, wm, w1, past, c, e, x, added)
    after = State(i1, w1, angle, m.theta, m.theta_dot, f1, heat, m.flex, m.flex_dot, state.gust, state.time,
                  state.memory)
    if added is None or past is None:
        return after
    return since(after, past_after(state, after, v, past, c, added))


@equation
def since(state: State, past: Past) -> State:
    """The state with this time and these memories."""
    s = state
    return State(s.i_a, s.omega, s.rotor_angle, s.theta, s.theta_dot, s.thrust, s.heat, s.flex, s.flex_dot, s.gust,
                 past.time, past.memory)


@equation
def at_terminals(v: float, state: State, e: Values | None, added: Terms | None) -> float:
    """[V] Voltage at the motor's terminals, from that at the bridge (V)."""
    if e is None:
        return v
    loaded = v - e.supply_sag_r_supply * state.i_a
    if added is not None:
        loaded += term_sum(0, added.actuator, quantities(state, v), state.memory, added)
    return loaded


@equation
def next_gust(state: State, noise: float, x: Extra | None) -> State:
    """The state with the gust of the next hold.

    Args:
        state: after a hold.
        noise: a standard normal number.
        x: coefficients of the effects.
    """
    s = state
    return State(s.i_a, s.omega, s.rotor_angle, s.theta, s.theta_dot, s.thrust, s.heat, s.flex, s.flex_dot,
                 x.gust_decay * s.gust + x.gust_kick * noise, s.time, s.memory)


def steady(model: Model, duty: float) -> State:
    """Steady state of the nominal plant for a duty; the arm hangs if the thrust exceeds its weight.

    Args:
        model: its effects are ignored, except `parameter_mismatch`.
        duty: 0..1.
    """
    n = model.numbers()
    omega = float(actuator.speed_at(n, actuator.voltage(n, duty)))
    theta = float(actuator.static_angle(n, duty))
    return State(float(actuator.current_at(n, omega)), omega, 0.0, 0.0 if math.isnan(theta) else theta, 0.0,
                 float(actuator.thrust(n, omega)))


def steps_in(model: Model, period: float) -> int:
    """Number of steps of a hold: 1 at the rig's period, unless the plant is much faster than `bench`.

    Args:
        model: parameters and effects.
        period: [s] length of the hold.
    """
    return _steps_in(period, *_rates(*_parts(model), period))


def _steps_in(period: float, *rates: float) -> int:
    return min(MOST_STEPS, math.ceil(period * max(1.0 / LONGEST_STEP, *rates) - 1e-9))


def _parts(model: Model) -> tuple[Mapping[str, float], Values | None, Terms | None]:
    """Parameters, effects and terms by formula of a model."""
    e, added = values(model.effects), terms(model.effects)
    return model.numbers(), NO_EFFECT if e is None and added is not None else e, added


def _rates(n: Mapping[str, float], e: Values | None, added: Terms | None, period: float) -> tuple[float, float]:
    """[1/s] Number of steps in a second that the motor and the arm need, by the rates of their fastest motions.

    The factors (0.04, 0.02, 0.1, 0.3) are choices; the tests compare the result with scipy's integrators for fast
    plants.
    """
    top_speed = float(actuator.voltage(n, 1.0)) / n["K_e"]  # rad/s, never reached
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
        if e.coulomb_friction_accel > 0.0:  # a step is cut once where the motion reverses
            arm_.append(1.0 / LONGEST_STEP)
        if e.mast_flex_coupling > 0.0:
            arm_ += [e.mast_flex_omega / math.sqrt(free) / 0.3,
                     2.0 * e.mast_flex_zeta * e.mast_flex_omega / free / 0.3]
    if added is not None:
        most = MOST_TERM_STEPS / period
        rate, angle, rotor_ = (min(x / 0.3, most) for x in term_rates(n, top_speed, added))
        motor.append(rotor_)
        arm_ += [rate, angle, 1.0 / LONGEST_STEP if added.arm_friction > added.rotor_friction else 0.0]
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
    n, e, added = _parts(model)
    if full and e is None:
        e = NO_EFFECT
    return _prepared(n, e, added, period, steps or _steps_in(period, *_rates(n, e, added, period)))


def _prepared(n: Mapping[str, float], e: Values | None, added: Terms | None, period: float, steps: int
              ) -> tuple[Coefficients, Values | None, Extra | None, Terms | None]:
    h = period / steps
    resistance = n["R_a"] + (e.supply_sag_r_supply if e else 0.0)
    c = Coefficients(steps, h, lag(resistance / n["L_a"], h), lag(n["B_m"] / n["J_m"], h), 1.0 / n["L_a"],
                     n["K_e"], n["K_t"] / n["J_m"], n["k_load"] / n["J_m"], n["B_m"] / n["J_m"], n["k_thrust"],
                     n["mgd_over_J"], n["c_over_J"], n["L_over_J"])
    if e is None:
        return c, None, None, None
    rise = 1.0 / e.thrust_lag_tau if e.thrust_lag_tau > NO_LAG * h else 0.0
    gust_decay = math.exp(-period / e.gust_tau)
    return c, e, Extra(lag(1.0 / e.winding_heating_tau, h), lag(rise, h), lag(rise / e.thrust_lag_fall, h), n["R_a"],
                       resistance, n["J_m"], gust_decay, e.gust_sigma * math.sqrt(1.0 - gust_decay**2),
                       1.0 / (1.0 - e.mast_flex_coupling), 1.0 / e.ground_effect_width), added


class Trajectory(NamedTuple):
    """States at the samples, each (N,), SI units.

    `v_a` is the voltage at the motor's terminals at the start of the hold. `thrust` is the thrust before the
    effects `ground_effect` and `axial_inflow`.
    """

    theta: Array
    theta_dot: Array
    i_a: Array
    omega: Array
    v_a: Array
    rotor_angle: Array
    thrust: Array


class _Rows(NamedTuple):
    """Rows of the arrays that `run` fills and `Trajectory` names."""

    theta: int = 0
    theta_dot: int = 1
    i_a: int = 2
    omega: int = 3
    v_a: int = 4
    rotor_angle: int = 5
    thrust: int = 6


ROW = _Rows()
"""Row of each quantity in an array of states (7, N), as `run` fills it."""


@njit()
def linear_arm(stiffness: float, damping: float, h: float) -> tuple[float, float, float, float, float, float]:
    """Transition of the arm, made linear around a motion, over a short time, to second order in the time.

    The state is (δ, δ̇, w): deviation of the angle and of its rate, and a torque over inertia that stays constant.

    Args:
        stiffness: [1/s²] slope of the restoring torque over inertia: mgd/J cos θ for gravity.
        damping: [1/s] viscous friction over inertia.
        h: [s] time.

    Returns:
        The first two rows of the transition matrix: δ from (δ, δ̇, w), then δ̇ from (δ, δ̇, w).
    """
    half = 0.5 * h * h
    return (1.0 - half * stiffness, h - half * damping, half,
            -h * stiffness + half * damping * stiffness, 1.0 - h * damping + half * (damping * damping - stiffness),
            h - half * damping)


@njit(nogil=True)
def run(v: Array, noise: Array, state: State, c: Coefficients, e: Values | None, x: Extra | None, added: Terms | None,
        out: Array) -> State:
    """Advance the plant over N holds.

    Args:
        v: (N,) [V] voltage at the bridge, held (`actuator.acting_voltage`).
        noise: (N,) standard normal numbers for `gust`.
        state: at the first sample.
        c: coefficients.
        e: effects; None for the nominal plant.
        x: coefficients of the effects; None for the nominal plant.
        added: terms by formula; None without any.
        out: (7, N), filled with the states at the start of each hold, in the order of `Trajectory`.

    Returns:
        The state after the last hold.
    """
    for k in range(v.shape[0]):
        out[ROW.theta, k], out[ROW.theta_dot, k] = state.theta, state.theta_dot
        out[ROW.i_a, k], out[ROW.omega, k] = state.i_a, state.omega
        out[ROW.rotor_angle, k], out[ROW.thrust, k] = state.rotor_angle, state.thrust
        out[ROW.v_a, k] = at_terminals(v[k], state, e, added)
        for _ in range(c.steps):
            state = advance(state, v[k], c, e, x, added)
        if e is not None:
            state = next_gust(state, noise[k], x)
    return state


def swing(model: Model, speed: Array, state: State, period: float = SAMPLE_PERIOD) -> tuple[Array, Array, State]:
    """Air and arm alone, for a given speed of the rotor, linear between samples.

    The arm is slow: a step may be longer than a sample.

    Args:
        model: parameters and effects.
        speed: (N,) [rad/s] speed at the samples.
        state: at the first sample.
        period: [s] time between samples.

    Returns:
        θ and θ̇ (N,) at the samples, and the state after the last one.
    """
    parts = _parts(model)
    rate = max(_rates(*parts, period)[1], 1.0 / LONGEST_ARM_STEP)
    out = np.empty((2, len(speed)))
    every, done = math.floor(1.0 / (period * rate) + 1e-9), 0
    if every > 1:
        done = (len(speed) - 1) // every * every
        state = run_arm(speed[:done + 1], state, every, *_prepared(*parts, every * period, 1), out[:, :done])
    steps = min(MOST_STEPS, math.ceil(period * rate - 1e-9))
    state = run_arm(speed[done:], state, 1, *_prepared(*parts, period, steps), out[:, done:])
    return out[0], out[1], state


@njit(nogil=True)
def run_arm(speed: Array, state: State, every: int, c: Coefficients, e: Values | None, x: Extra | None,
            added: Terms | None, out: Array) -> State:
    """Air and arm alone, for a given speed of the rotor, linear between samples.

    Args:
        speed: (N,) [rad/s] speed at the samples.
        state: at the first sample.
        every: samples in a hold of `c`. If 1, the speed is held after the last sample.
        c: coefficients.
        e: effects; None for the nominal plant.
        x: coefficients of the effects; None for the nominal plant.
        added: terms by formula; None without any.
        out: (2, M), filled with θ, θ̇: at N samples, or, if `every` is greater than 1, at N - 1, a multiple of it.

    Returns:
        The state after the last sample of `out`.
    """
    last = speed.shape[0] - 1
    for k in range(0, out.shape[1], every):
        before, w = state, speed[k]
        rise = (speed[min(k + every, last)] - w) / c.steps
        middle = 0.5 * rise
        if every > 1:  # the middle at which a parabola has the mean of the speed
            mean = 0.5 * (speed[k] + speed[k + every])
            for j in range(1, every):
                mean += speed[k + j]
            middle = 0.25 * (6.0 * mean / every - speed[k + every] - 5.0 * w)
        for _ in range(c.steps):
            now = State(0.0, w, 0.0, state.theta, state.theta_dot, state.thrust, 0.0, state.flex, state.flex_dot, 0.0,
                        state.time, state.memory)
            past = None if added is None else pasts(now, 0.0, c, added)
            m, f1 = advance_arm(now, w + middle, w + rise, past, c, e, x, added)
            w += rise
            state = State(0.0, w, 0.0, m.theta, m.theta_dot, f1, 0.0, m.flex, m.flex_dot, 0.0, now.time, now.memory)
            if added is not None and past is not None:
                state = since(state, past_after(now, state, 0.0, past, c, added))
        out[0, k], out[1, k] = before.theta, before.theta_dot
        for j in range(1, every):
            out[0, k + j], out[1, k + j] = between(before, state, j / every, c.h)
    return state


@equation
def between(a: State, b: State, s: float, h: float) -> tuple[float, float]:
    """θ and θ̇ at a part s of a step of h seconds, by the cubic that has both at its ends."""
    moved = b.theta - a.theta
    c2, c3 = 3.0 * moved - h * (2.0 * a.theta_dot + b.theta_dot), h * (a.theta_dot + b.theta_dot) - 2.0 * moved
    return (a.theta + s * (h * a.theta_dot + s * (c2 + s * c3)),
            a.theta_dot + s * (2.0 * c2 + 3.0 * s * c3) / h)


@njit(nogil=True)
def run_motor(v: Array, state: State, c: Coefficients, e: Values | None, x: Extra | None, added: Terms | None,
              out: Array) -> State:
    """Winding and rotor alone, for a given voltage at the motor's terminals.

    Args:
        v: (N,) [V] voltage, held.
        state: at the first sample.
        c: coefficients.
        e: effects; None for the nominal plant.
        x: coefficients of the effects; None for the nominal plant.
        added: terms by formula; None without any.
        out: (3, N), filled with i_a, ω, rotor angle.

    Returns:
        The state after the last sample.
    """
    for k in range(v.shape[0]):
        out[0, k], out[1, k], out[2, k] = state.i_a, state.omega, state.rotor_angle
        for _ in range(c.steps):
            now = state
            past = None if added is None else pasts(now, v[k], c, added)
            i1, _, w1, angle, heat = advance_motor(now, v[k], past, c, e, x, added)
            state = State(i1, w1, angle, 0.0, 0.0, 0.0, heat, 0.0, 0.0, 0.0, now.time, now.memory)
            if added is not None and past is not None:
                state = since(state, past_after(now, state, v[k], past, c, added))
    return state


def simulate(model: Model, duty: Array, period: float = SAMPLE_PERIOD, state: State | None = None,
             noise: Array | None = None, start: int = 0) -> Trajectory:
    """Simulate the plant for a duty series, each value held for one period.

    Args:
        model: parameters and effects.
        duty: (N,) 0..1.
        period: [s] time between samples.
        state: at the first sample; at rest by default.
        noise: (N,) standard normal numbers for `gust`; None: no gust.
        start: index of the first sample, counted from the start of `supply_drift`.

    Returns:
        Trajectory of (N,) arrays at the N sample instants.
    """
    duty = np.ascontiguousarray(duty, dtype=float)
    v, sampled = actuator.voltages(model.numbers(), duty, model.effects, period, start)
    out = np.empty((7, len(duty)))
    run(v, np.zeros(len(duty)) if noise is None else noise, State() if state is None else state,
        *prepare(model, period), out)
    if "command_delay" in model.effects:
        out[ROW.v_a] += sampled - v
    return Trajectory(*out)
