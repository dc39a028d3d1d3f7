# SPDX-License-Identifier: Apache-2.0
"""The equations of winding and rotor, over one step.

Both are first-order lags and act on each other. Each is advanced exactly for an input that is quadratic over the step
(`lag`). So a step as long as the electrical time constant costs no accuracy.

Source of the nominal equations: thesis (3.4) and (3.5), with a quadratic load of the propeller (see `k_load` in
docs/interfaces.md). Equations of the effects: docs/effects.md.
"""

from __future__ import annotations

import math

from aeropend_sim.compiled import equation
from aeropend_sim.model.coefficients import Coefficients, Extra
from aeropend_sim.model.effects import Values
from aeropend_sim.model.lag import Lag, lag
from aeropend_sim.model.state import Over, Past, Pasts, State, quantities
from aeropend_sim.model.terms import NUDGE, Memory, Quantities, Terms, term_sum

BRUSH_CURRENT = 0.02
"""[A] Scale of the current over which the brush drop changes its sign (docs/effects.md). Convention."""


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
    more0 = 0.0
    if added is not None and added.rotor > added.electrical:
        more0 = rotor_terms(i0, w0, v, past.start, added) / x.J_m
        slope += c.h * more0
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
            torque = Over(more0, rotor_terms(im, wm, v, past.middle, added) / x.J_m,
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
def at_terminals(v: float, state: State, e: Values | None, added: Terms | None) -> float:
    """[V] Voltage at the motor's terminals, from that at the bridge (V)."""
    if e is None:
        return v
    loaded = v - e.supply_sag_r_supply * state.i_a
    if added is not None:
        loaded += term_sum(0, added.actuator, quantities(state, v), state.memory, added)
    return loaded
