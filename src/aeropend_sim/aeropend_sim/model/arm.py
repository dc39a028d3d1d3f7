# SPDX-License-Identifier: Apache-2.0
"""The equations of air and arm, over one step.

The lag of the thrust is advanced exactly for an input that is quadratic over the step (`lag`), and the arm by the
fourth-order Runge-Kutta-Nyström method.

Source of the nominal equations: thesis (3.2) and (3.3). Equations of the effects: docs/effects.md.
"""

from __future__ import annotations

import math

from aeropend_sim.compiled import equation, njit
from aeropend_sim.model.coefficients import Coefficients, Extra
from aeropend_sim.model.effects import THRUST_PIVOT_SPEED, Values
from aeropend_sim.model.lag import NO_LAG
from aeropend_sim.model.state import Motion, Over, Past, Pasts, State
from aeropend_sim.model.terms import Quantities, Terms, term_sum

ROUND = 6755399441055744.0
"""1.5 · 2^52: adding and subtracting it rounds a double to the nearest integer."""


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
def has_dry_friction(e: Values | None, added: Terms | None) -> bool:
    """Whether dry friction acts on the arm."""
    if added is not None and added.arm_friction > added.rotor_friction:
        return True
    return e is not None and e.coulomb_friction_accel > 0.0


@equation
def grip(theta: float, f: float, w: float, past: Pasts | None, e: Values, added: Terms | None) -> float:
    """[rad/s²] Dry friction of the arm at rest, over its inertia."""
    limit = e.coulomb_friction_accel
    if added is not None and added.arm_friction > added.rotor_friction:
        q = Quantities(theta, 0.0, w, f, 0.0, 0.0, past.start.time)
        limit += max(term_sum(added.rotor_friction, added.arm_friction, q, past.start.memory, added), 0.0)
    return limit


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
    if has_dry_friction(e, added):
        return arm_with_dry_friction(motion, Over(f0, fm, f1), speed, state.gust, past, c, e, x, added), f1
    return arm(motion, Over(f0, fm, f1), speed, 0.0, state.gust, past, c, e, x, added), f1


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
