# SPDX-License-Identifier: Apache-2.0
"""Runs of the plant: nominal and with every effect, for one hold of the input at a time.

The chain is advanced in the direction of cause: winding and rotor (`motor`), air and arm (`arm`). A long hold, or the
hold of a plant that is faster than `bench`, is cut into equal steps (`coefficients`).

For the nominal model the effects are None: numba then compiles the equations without them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aeropend_sim.compiled import equation, njit
from aeropend_sim.model import actuator
from aeropend_sim.model.arm import advance_arm, has_dry_friction
from aeropend_sim.model.coefficients import (
    LONGEST_ARM_STEP,
    Coefficients,
    Extra,
    model_parts,
    prepare,
    prepared,
    rates,
    steps_of,
)
from aeropend_sim.model.effects import Values
from aeropend_sim.model.motor import advance_motor, at_terminals
from aeropend_sim.model.parameters import LONGEST_STEP, SAMPLE_PERIOD, Model
from aeropend_sim.model.state import Past, Pasts, State, quantities, since
from aeropend_sim.model.terms import Quantities, Terms, remembered

Array = NDArray[np.float64]


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
    parts = model_parts(model)
    rate = max(rates(*parts, period)[1], 1.0 / LONGEST_ARM_STEP)
    every = max(math.floor(1.0 / (period * rate) + 1e-9), 1)
    c, e, x, added = prepared(*parts, every * period, steps_of(every * period, rate))
    short = prepared(*parts, period, steps_of(period, max(rate, 1.0 / LONGEST_STEP)))
    out = np.empty((2, len(speed)))
    state = run_arm(speed, state, every, c, e, x, added, (short[0], short[2]), out)
    return out[0], out[1], state


@njit(nogil=True)
def run_arm(speed: Array, state: State, every: int, c: Coefficients, e: Values | None, x: Extra | None,
            added: Terms | None, short: tuple[Coefficients, Extra | None], out: Array) -> State:
    """Air and arm alone, for a given speed of the rotor, linear between samples and held after the last one.

    Args:
        speed: (N,) [rad/s] speed at the samples.
        state: at the first sample.
        every: samples in a hold of `c`.
        c: coefficients.
        e: effects; None for the nominal plant.
        x: coefficients of the effects; None for the nominal plant.
        added: terms by formula; None without any.
        short: coefficients of a hold of one sample, in shorter steps. They are taken where the arm reverses against dry
            friction or rests, and for the samples after the last whole hold.
        out: (2, N), filled with θ, θ̇ at the samples.

    Returns:
        The state after the last sample.
    """
    last = speed.shape[0] - 1
    whole = last // every * every if every > 1 else last + 1
    for k in range(0, whole, every):
        before, w = state, speed[k]
        rise = (speed[min(k + every, last)] - w) / c.steps
        middle = 0.5 * rise
        if every > 1:  # the middle at which a parabola has the mean of the speed
            mean = 0.5 * (speed[k] + speed[k + every])
            for j in range(1, every):
                mean += speed[k + j]
            middle = 0.25 * (6.0 * mean / every - speed[k + every] - 5.0 * w)
        for _ in range(c.steps):
            state = arm_after(state, w, w + middle, w + rise, c, e, x, added)
            w += rise
        if short[0].h < c.h and before.theta_dot * state.theta_dot <= 0.0 and has_dry_friction(e, added):
            state = each_sample(speed, before, k, k + every, e, added, short, out)
        else:
            out[0, k], out[1, k] = before.theta, before.theta_dot
            for j in range(1, every):
                out[0, k + j], out[1, k + j] = between(before, state, j / every, c.h)
    return each_sample(speed, state, whole, last + 1, e, added, short, out)


@equation
def each_sample(speed: Array, state: State, first: int, stop: int, e: Values | None, added: Terms | None,
                short: tuple[Coefficients, Extra | None], out: Array) -> State:
    """`run_arm` over the samples from the first up to a stop, by the shorter steps."""
    c, x = short
    for k in range(first, stop):
        out[0, k], out[1, k] = state.theta, state.theta_dot
        w = speed[k]
        rise = (speed[min(k + 1, speed.shape[0] - 1)] - w) / c.steps
        for _ in range(c.steps):
            state = arm_after(state, w, w + 0.5 * rise, w + rise, c, e, x, added)
            w += rise
    return state


@equation
def arm_after(state: State, w0: float, wm: float, w1: float, c: Coefficients, e: Values | None, x: Extra | None,
              added: Terms | None) -> State:
    """Air and arm after one step, for a speed of the rotor at its start, middle and end."""
    now = State(0.0, w0, 0.0, state.theta, state.theta_dot, state.thrust, 0.0, state.flex, state.flex_dot, 0.0,
                state.time, state.memory)
    past = None if added is None else pasts(now, 0.0, c, added)
    m, f1 = advance_arm(now, wm, w1, past, c, e, x, added)
    after = State(0.0, w1, 0.0, m.theta, m.theta_dot, f1, 0.0, m.flex, m.flex_dot, 0.0, now.time, now.memory)
    if added is not None and past is not None:
        after = since(after, past_after(now, after, 0.0, past, c, added))
    return after


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
