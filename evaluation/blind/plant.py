# SPDX-License-Identifier: Apache-2.0
"""A second aeropendulum, written from the equations of docs/interfaces.md and sharing no line with aeropend_sim.

It makes the recordings of the blind check. The states are integrated by LSODA (scipy), the angle filter with them; the
pulses of the speed are found on the rotor's angle. Each effect has two forms: `table`, as docs/effects.md
writes it, and `other`, what a real rig may do instead: LuGre friction, a two-state thermal winding, a battery with
polarisation, Dryden turbulence. `OUTSIDE` holds effects that no catalogue lists.
"""

from __future__ import annotations

import math
from collections import namedtuple
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.integrate import odeint
from scipy.interpolate import CubicHermiteSpline

Array = NDArray[np.float64]

PERIOD = 64 * 510 / 16e6
"""s between samples."""

NUMBERS = ("k0", "k1", "k2", "k3", "R_a", "L_a", "K_e", "K_t", "J_m", "B_m", "k_load", "k_thrust", "mgd_over_J",
           "c_over_J", "L_over_J")

EFFECTS = {
    "bridge_drop": ("v_drop",), "supply_sag": ("r_supply",), "supply_drift": ("rate",), "command_delay": ("delay",),
    "brush_drop": ("v_brush",), "winding_heating": ("gain", "tau"), "rotor_friction": ("torque",),
    "thrust_lag": ("tau",), "thrust_exponent": ("n",), "axial_inflow": ("k",), "ground_effect": ("gain", "width"),
    "coulomb_friction": ("accel",), "quadratic_drag": ("k",), "cable_torque": ("k", "theta0"),
    "mast_flex": ("coupling", "omega", "zeta"), "gust": ("sigma", "tau"), "angle_offset": ("bias",),
    "encoder_lag": ("tau",), "encoder_eccentricity": ("amplitude", "phase"), "current_gain": ("gain",),
    "current_offset": ("bias",), "voltage_offset": ("bias",), "speed_spikes": ("rate",),
}
NEUTRAL = {"thrust_exponent_n": 2.0, "winding_heating_tau": 30.0, "ground_effect_width": 0.3, "mast_flex_omega": 12.0,
           "mast_flex_zeta": 0.03, "gust_tau": 0.3, "outside_current_clip": math.inf}

OUTSIDE = {
    "duty_ripple": ("actuator", 0.05), "slew_limit": ("actuator", 0.05), "brown_outs": ("actuator", 0.2),
    "speed_resistance": ("electrical", 0.3), "field_weakening": ("electrical", 0.1),
    "blade_stall": ("rotor", 0.3), "gear_wobble": ("rotor", 2e-4),
    "thrust_dip": ("thrust", 0.2), "own_wake": ("thrust", 0.2), "blockage": ("thrust", 0.2),
    "detent": ("arm", 1.0), "soft_stop": ("arm", 20.0), "one_way_drag": ("arm", 1.0),
    "encoder_harmonic": ("sensing", 0.02), "current_bend": ("sensing", 0.1), "current_clip": ("sensing", 1.0),
}
"""Effects that the catalogue does not know: place, and a size to start from."""

HELD = {"slew_limit": "command_delay", "soft_stop": "cable_torque"}
"""Those of `OUTSIDE` that another form of an effect holds: a ramp of the voltage, a spring with slack."""

PARAMETERS = (*NUMBERS, "filter_tau", *(f"{e}_{q}" for e, qs in EFFECTS.items() for q in qs),
              *(f"outside_{name}" for name in OUTSIDE), "other_form")
Index = namedtuple("Index", PARAMETERS)  # type: ignore[misc]
I = Index(*range(len(PARAMETERS)))  # noqa: E741

States = namedtuple("States", "i omega turned theta rate stage1 stage2 thrust heat case bristle flex flex_rate sag "
                              "slew wake")
S = States(*range(16))

THIRD = 1.5
"""Number of the form above which it is the third: one that the catalogue does not hold either."""

BRISTLE = 2e-4
"""[rad] Deflection of the bristles of the dry friction: it sticks and does not creep."""


@njit(cache=True)
def terminal_voltage(duty: float, t: float, y: Array, p: Array) -> float:
    """Armature voltage."""
    other, third = p[I.other_form], p[I.other_form] > THIRD
    v = max(0.0, p[I.k0] + p[I.k1] * math.sqrt(max(p[I.k2] * duty + p[I.k3], 0.0)))
    v *= 1.0 + p[I.outside_duty_ripple] * math.sin(6.0 * math.pi * duty)
    if p[I.outside_brown_outs] > 0.0 and math.sin(0.9 * t) + math.sin(1.43 * t + 1.0) > 1.2:
        v *= 1.0 - p[I.outside_brown_outs]
    if third:  # the battery recovers towards a lower voltage; the switches are bipolar; the supply polarises
        v *= 1.0 - p[I.supply_drift_rate] * 60.0 * (1.0 - math.exp(-t / 60.0))
        v = max(0.0, v - p[I.bridge_drop_v_drop] * (1.0 - math.exp(-v / 0.3)))
        v -= p[I.supply_sag_r_supply] * y[S.i] * abs(y[S.i]) ** -0.15 if y[S.i] != 0.0 else 0.0
    elif other:
        v *= math.exp(-p[I.supply_drift_rate] * t)
        v = max(0.0, v - p[I.bridge_drop_v_drop] * math.tanh(v / 0.1) * (0.85 + 0.25 * abs(y[S.i])))
        v -= 0.8 * p[I.supply_sag_r_supply] * y[S.i] + y[S.sag]
    else:
        v *= 1.0 - p[I.supply_drift_rate] * t
        v = max(0.0, v - p[I.bridge_drop_v_drop]) - p[I.supply_sag_r_supply] * y[S.i]
    if p[I.outside_slew_limit] > 0.0:
        v = y[S.slew]
    return v


@njit(cache=True)
def voltages(duty: float, first: int, y: Array, p: Array) -> Array:
    """Armature voltage (N,) at the states (N, 16) of the samples from `first` on."""
    v = np.empty(len(y))
    for k in range(len(y)):
        v[k] = terminal_voltage(duty, (first + k) * PERIOD, y[k], p)
    return v


def derivative(y: Array, t: float, duty: float, p: Array, gusts: Array, d: Array) -> Array:
    """Time derivative of the states, written to d (16,): to make an array each time takes longer than to fill it."""
    _derivative(y, t, duty, p, gusts, d)
    return d


@njit(cache=True)
def _derivative(y: Array, t: float, duty: float, p: Array, gusts: Array, d: Array) -> None:
    other, third = p[I.other_form], p[I.other_form] > THIRD
    d[:] = 0.0
    i, w, theta, rate = y[S.i], y[S.omega], y[S.theta], y[S.rate]
    v = terminal_voltage(duty, t, y, p)
    if other and not third and p[I.supply_sag_r_supply] > 0.0:
        d[S.sag] = (0.2 * p[I.supply_sag_r_supply] * i - y[S.sag]) / 0.15
    if p[I.outside_slew_limit] > 0.0:
        goal = max(0.0, p[I.k0] + p[I.k1] * math.sqrt(max(p[I.k2] * duty + p[I.k3], 0.0)))
        d[S.slew] = math.tanh((goal - y[S.slew]) / 0.02) / p[I.outside_slew_limit]

    # winding
    r = p[I.R_a] * (1.0 + p[I.winding_heating_gain] * (y[S.heat] + y[S.case]))
    r *= 1.0 + p[I.outside_speed_resistance] * w / 150.0
    if third:
        drop = p[I.brush_drop_v_brush] * i / (abs(i) + 0.012)
    elif other:
        drop = p[I.brush_drop_v_brush] * i / math.sqrt(i * i + 0.02 * 0.02)
    else:
        drop = p[I.brush_drop_v_brush] * math.tanh(i / 0.02)
    back = p[I.K_e] * w * (1.0 - p[I.outside_field_weakening] * i)
    d[S.i] = (v - drop - r * i - back) / p[I.L_a]
    if p[I.winding_heating_gain] > 0.0:
        tau = p[I.winding_heating_tau]
        if third:  # the propeller's wind cools
            d[S.heat] = i * i - y[S.heat] / tau * (0.7 + w / 300.0)
        elif other:  # winding and case: the case is three times as heavy and warms behind
            d[S.heat] = 0.8 * i * i - y[S.heat] / (0.7 * tau)
            d[S.case] = 0.2 * i * i - y[S.case] / (2.0 * tau)
        else:
            d[S.heat] = i * i - y[S.heat] / tau

    # rotor
    friction = p[I.rotor_friction_torque] * math.tanh(w / 0.3)
    if third:
        friction *= 1.0 + 0.4 / (1.0 + (w / 20.0) ** 2)
    elif other:
        friction *= 1.0 + 0.3 * math.exp(-((w / 15.0) ** 2))
    load = p[I.k_load] * w * abs(w) * (1.0 + p[I.outside_blade_stall] / (1.0 + math.exp(-(w - 130.0) / 6.0)))
    wobble = p[I.outside_gear_wobble] * math.sin(3.1 * t) * math.tanh(w / 20.0)
    d[S.omega] = (p[I.K_t] * i - p[I.B_m] * w - load - friction - wobble) / p[I.J_m]
    d[S.turned] = w

    # thrust
    n = p[I.thrust_exponent_n]
    if n == 2.0:
        f = p[I.k_thrust] * w * abs(w)
    elif third:  # a coefficient that levels off
        f = p[I.k_thrust] * w * abs(w) * (1.0 + 1.6 * (n - 2.0) * (abs(w) - 150.0) / (abs(w) + 150.0))
    elif other:  # a coefficient that falls with the logarithm of the Reynolds number
        f = p[I.k_thrust] * w * abs(w) * (1.0 + (n - 2.0) * math.log(max(abs(w), 1.0) / 150.0))
    else:
        f = p[I.k_thrust] * 150.0**2 * (abs(w) / 150.0) ** n
    f *= 1.0 - p[I.outside_thrust_dip] * math.exp(-(((w - 120.0) / 15.0) ** 2))
    f *= 1.0 - p[I.outside_own_wake] * y[S.wake]
    if p[I.outside_own_wake] > 0.0:
        d[S.wake] = (w / 150.0 - y[S.wake]) / 2.0
    if p[I.thrust_lag_tau] > 0.0:
        tau = p[I.thrust_lag_tau]
        if third:  # two lags in series; the wake's state serves as the first
            d[S.wake] = (f - y[S.wake]) / (0.35 * tau)
            f, tau = y[S.wake], 0.65 * tau
        elif other:  # the wake fills faster when the rotor turns fast
            tau *= 1.3 / (0.3 + abs(w) / 120.0)
        d[S.thrust] = (f - y[S.thrust]) / tau
        f = y[S.thrust]
    f *= 1.0 - p[I.outside_blockage] * math.sin(3.0 * theta) ** 2
    gain, width = p[I.ground_effect_gain], p[I.ground_effect_width]
    if third:
        f *= 1.0 + gain / math.cosh(1.3 * theta / width)
    elif other:
        f *= 1.0 + gain / (1.0 + (theta / width) ** 2)
    else:
        f *= 1.0 + gain * math.exp(-abs(theta) / width)
    if third and p[I.axial_inflow_k] > 0.0 and abs(w) > 1.0:
        f *= math.exp(-p[I.axial_inflow_k] * rate / (p[I.k_thrust] * abs(w)))
    elif other and p[I.axial_inflow_k] > 0.0 and abs(w) > 1.0:  # bends as momentum theory has it
        x = p[I.axial_inflow_k] * rate / (p[I.k_thrust] * abs(w))
        f *= 1.0 - x / (1.0 + 0.3 * abs(x))
    else:
        f -= p[I.axial_inflow_k] * w * rate

    # arm
    a = -p[I.mgd_over_J] * math.sin(theta) - p[I.c_over_J] * rate + p[I.L_over_J] * f
    fc = p[I.coulomb_friction_accel]
    if fc > 0.0:  # LuGre (Canudas de Wit 1995); the table's form has stiff bristles and no Stribeck effect
        bend = 10.0 * BRISTLE if other else BRISTLE
        stiff = fc / bend
        level = fc * (1.0 + (0.25 * math.exp(-((rate / 0.05) ** 2)) if other else 0.0))
        if third:  # a Tustin curve, and more friction while the cable is wound up
            level = fc * (0.9 + 0.3 * math.exp(-abs(rate) / 0.1) + 0.15 * theta)
        d[S.bristle] = rate - stiff * abs(rate) / level * y[S.bristle]
        a -= stiff * y[S.bristle] + 0.6 * math.sqrt(stiff) * d[S.bristle] / (1.0 + abs(rate) / 0.05)
    drag = p[I.quadratic_drag_k]
    if third:  # the propeller's disc drags more on the way up
        a -= drag * rate * abs(rate) * (1.0 + 0.25 * math.tanh(rate))
    elif other:
        a -= drag * rate * abs(rate) ** 0.85
    else:
        a -= drag * rate * abs(rate)
    twist = theta - p[I.cable_torque_theta0]
    if third:  # it stiffens at once
        twist += 0.35 * twist * abs(twist)
    elif other:
        twist += 0.4 * twist**3
    a -= p[I.cable_torque_k] * twist
    a -= p[I.outside_detent] * math.sin(6.0 * theta)
    a -= p[I.outside_soft_stop] * max(theta - 0.45, 0.0)
    a -= p[I.outside_one_way_drag] * max(rate, 0.0)
    if len(gusts):
        at = t / PERIOD
        k = min(int(at), len(gusts) - 2)
        a += gusts[k] + (at - k) * (gusts[k + 1] - gusts[k])
    c = p[I.mast_flex_coupling]
    if c > 0.0:  # q̈ + 2ζω q̇ + ω² q = -c θ̈ and θ̈ = a - q̈, solved for both
        o = p[I.mast_flex_omega]
        restoring = 2.0 * p[I.mast_flex_zeta] * o * y[S.flex_rate] + o * o * y[S.flex]
        if third:  # the mount rubs
            restoring += 0.4 * o * abs(y[S.flex]) * math.tanh(y[S.flex_rate] / 0.05)
        elif other:
            restoring += o * o * 20.0 * y[S.flex] ** 3
        bent = (-restoring - c * a) / (1.0 - c)
        d[S.flex], d[S.flex_rate] = y[S.flex_rate], bent
        a -= bent
    d[S.theta], d[S.rate] = rate, a

    # encoder and its filter
    shown = theta + p[I.angle_offset_bias] + p[I.encoder_eccentricity_amplitude] * math.sin(
        theta + p[I.encoder_eccentricity_phase])
    if third:
        shown += 0.12 * p[I.encoder_eccentricity_amplitude] * math.sin(3.0 * theta + 1.0)
    elif other:
        shown += 0.15 * p[I.encoder_eccentricity_amplitude] * math.sin(2.0 * theta)
    shown += p[I.outside_encoder_harmonic] * math.sin(5.0 * theta + 1.0)
    lag = p[I.encoder_lag_tau]
    first, second = p[I.filter_tau] + lag, p[I.filter_tau] + lag
    if third:
        first, second = p[I.filter_tau] + 1.8 * lag, p[I.filter_tau] + 0.2 * lag
    elif other:
        first, second = p[I.filter_tau] + 1.4 * lag, p[I.filter_tau] + 0.6 * lag
    d[S.stage1] = (shown - y[S.stage1]) / first
    d[S.stage2] = (y[S.stage1] - y[S.stage2]) / second


def packed(numbers: Mapping[str, float], filter_tau: float, effects: Mapping[str, Mapping[str, float]],
           outside: Mapping[str, float], other: int) -> Array:
    """All parameters of a rig as the equations take them; `other`: number of the form, 0 for that of the table."""
    flat: dict[str, float] = dict.fromkeys(PARAMETERS, 0.0) | NEUTRAL
    flat |= {**numbers, "filter_tau": filter_tau, "other_form": float(other)}
    flat |= {f"{e}_{q}": v for e, qs in effects.items() for q, v in qs.items() if e in EFFECTS}
    flat |= {f"outside_{name}": v for name, v in outside.items()}
    return np.array([flat[name] for name in PARAMETERS])


def turbulence(sigma: float, tau: float, n: int, other: bool, rng: np.random.Generator) -> Array:
    """Random torque over inertia (n + 2,): Gauss-Markov, or two lags in series (Dryden's form) of the same size."""
    x = rng.standard_normal(n + 2)
    stages = (0.5 * tau, 0.5 * tau) if other else (tau,)
    for lag in stages:
        keep = math.exp(-PERIOD / lag)
        x = _recursive(x, keep)
    return sigma * x / (np.std(x) if other else math.sqrt(1.0 / (1.0 - keep * keep)))


@njit(cache=True)
def _recursive(x: Array, keep: float) -> Array:
    out = np.empty_like(x)
    out[0] = x[0] / math.sqrt(1.0 - keep * keep)
    for k in range(1, len(x)):
        out[k] = keep * out[k - 1] + x[k]
    return out


def states(p: Array, duty: Array, gusts: Array, controller: Callable[[float, float], float] | None = None,
           later: tuple[int, Array] | None = None) -> tuple[Array, Array, Array]:
    """Integrate from rest.

    Args:
        p: parameters.
        duty: (N,) held from each sample to the next.
        gusts: (N + 2,) or (0,).
        controller: (t, angle shown) -> duty, in place of `duty`.
        later: sample from which on other parameters hold, and these; not with a controller or a delay.

    Returns:
        States (N, 16), terminal voltage (N,), duty (N,).
    """
    n = len(duty)
    delay = p[I.command_delay_delay]
    y, room = np.zeros(16), np.zeros(16)
    y[S.stage1] = y[S.stage2] = p[I.angle_offset_bias] + p[I.encoder_eccentricity_amplitude] * math.sin(
        p[I.encoder_eccentricity_phase]) + p[I.outside_encoder_harmonic] * math.sin(1.0)
    options: dict[str, Any] = {"rtol": 1e-7, "atol": 1e-8, "mxstep": 20000}
    out, v, applied = np.empty((n, 16)), np.empty(n), np.array(duty, dtype=float)
    if controller is not None:
        late = round(delay / PERIOD)
        for k in range(n):
            out[k] = y
            applied[k] = controller(k * PERIOD, y[S.stage2])
            acting = applied[k - late] if k >= late else 0.0
            v[k] = terminal_voltage(acting, k * PERIOD, y, p)
            span = np.array([k * PERIOD, (k + 1) * PERIOD])
            y = odeint(derivative, y, span, (acting, p, gusts, room), tcrit=span[1:], **options)[-1]
        return out, v, applied
    edges = np.flatnonzero(np.diff(duty, prepend=duty[0] - 1.0))
    starts = edges * PERIOD + np.where(edges > 0, delay, 0.0)
    stops = np.append(starts[1:], (n - 1) * PERIOD + 1e-9)
    levels = duty[edges]
    if delay > 0.0:  # nothing acts before the first duty has come through
        starts, stops, levels = np.append(0.0, starts), np.append(starts[1:2], stops), np.append(0.0, levels)
        starts[1], stops[0] = delay, delay
    done = 0
    change, after = (math.inf, p) if later is None else (later[0] * PERIOD, later[1])
    pieces = [(max(a, low), min(b, high), u, q) for a, b, u in zip(starts, stops, levels, strict=True)
              for low, high, q in ((0.0, change, p), (change, math.inf, after)) if a < high and b > low]
    for a, b, u, q in pieces:
        last = max(done, min(n, math.ceil((b - 1e-12) / PERIOD)))
        grid = np.concatenate([[a], np.arange(done, last) * PERIOD, [b]])
        if b <= a:
            continue
        path = odeint(derivative, y, np.maximum(grid, a), (u, q, gusts, room), tcrit=[b], **options)
        out[done:last] = path[1:-1]
        v[done:last] = voltages(u, done, out[done:last], q)
        y, done = path[-1], last
    return out, v, applied


def shown(p: Array, y: Array, v: Array) -> dict[str, Array]:
    """Readings (N,) by channel before noise, quantisation and pulse timing."""
    i = y[:, S.i]
    read = i * (1.0 + p[I.current_gain_gain]) + p[I.current_offset_bias]
    if p[I.other_form] > THIRD:
        read = read + 0.1 * p[I.current_gain_gain] * np.minimum(i, 1.0) + 0.2 * p[I.current_offset_bias] * np.tanh(i)
    elif p[I.other_form]:
        t = np.arange(len(v)) * PERIOD
        read = read - 0.05 * p[I.current_gain_gain] * i * np.abs(i) + 0.1 * p[I.current_offset_bias] * np.sin(0.1 * t)
    read = read + p[I.outside_current_bend] * i * np.abs(i)
    read = np.minimum(read, p[I.outside_current_clip])
    return {"theta": y[:, S.stage2], "omega": y[:, S.omega], "i_a": read, "v_a": v + p[I.voltage_offset_bias]}


def at_other_instants(y: Array, share: float, rng: np.random.Generator) -> Array:
    """States (N, 16) with angle and current sampled up to a share of the period early or late."""
    t, moved = np.arange(len(y)), np.array(y)
    at = np.clip(t + share * rng.uniform(-1.0, 1.0, len(y)), 0, len(y) - 1)
    for state in (S.stage2, S.i):
        moved[:, state] = np.interp(at, t, y[:, state])
    return moved


def ideal(p: Array, y: Array, v: Array, later: tuple[int, Array] | None = None) -> dict[str, Array]:
    """As `shown`, of a rig that changes; `later` as for `states`."""
    first = shown(p, y, v)
    if later is None:
        return first
    return {c: np.append(first[c][:later[0]], x[later[0]:]) for c, x in shown(later[1], y, v).items()}


def speed_from_pulses(turned: Array, omega: Array, start: float, tick: float, spikes: float, other: bool,
                      rng: np.random.Generator) -> Array:
    """Speed as held between pulses, one a revolution (docs/interfaces.md), with false captures."""
    n = len(turned)
    t = np.arange(n) * PERIOD
    path = CubicHermiteSpline(t, turned + start, omega)
    marks = 2.0 * math.pi * np.arange(math.floor(start / (2.0 * math.pi)) + 1.0,
                                      math.floor((turned[-1] + start) / (2.0 * math.pi)) + 1.0)
    rising = np.maximum.accumulate(turned + start) + 1e-12 * np.arange(n)
    at = np.interp(marks, rising, t)
    for _ in range(4):
        at = np.clip(at - (path(at) - marks) / np.maximum(path(at, 1), 1e-3), 0.0, t[-1])
    at = np.floor(at / tick) * tick if tick > 0.0 else at
    period = np.diff(at)
    speed = 2.0 * math.pi / np.maximum(period, 1e-9)
    false = rng.random(len(period)) < -np.expm1(-spikes * period)
    factor = np.where(rng.random(len(period)) < 0.5, rng.uniform(1.2, 2.0, len(period)),
                      rng.uniform(2.0, 6.0, len(period))) if other else rng.uniform(1.3, 4.0, len(period))
    speed = np.where(false, speed * factor, speed)
    last = np.searchsorted(at, t, side="right") - 1
    out = np.where(last >= 1, np.append(speed, 0.0)[np.maximum(last - 1, 0)], 0.0) if len(speed) else np.zeros(n)
    since = t - at[np.maximum(last, 0)] if len(at) else np.full(n, np.inf)
    return np.where(since > 0.5, 0.0, out)


def measured(p: Array, y: Array, v: Array, sensing: Mapping[str, float], rng: np.random.Generator,
             later: tuple[int, Array] | None = None) -> dict[str, Array]:
    """Readings (N,) as the rig reports them; `later` as for `states`."""
    exact, n = ideal(p, y, v, later), len(v)

    def digits(x: Array, noise: float, lsb: float) -> Array:
        x = x + noise * rng.standard_normal(n)
        return np.round(x / lsb) * lsb if lsb > 0.0 else x

    pulses = speed_from_pulses(y[:, S.turned], y[:, S.omega], rng.uniform(0.0, 2.0 * math.pi), sensing["speed_tick"],
                               p[I.speed_spikes_rate], bool(p[I.other_form]), rng)
    return {"theta": digits(exact["theta"], sensing["angle_noise"], sensing["angle_lsb"]), "omega": pulses,
            "i_a": digits(exact["i_a"], sensing["current_noise"], sensing["current_lsb"]),
            "v_a": digits(exact["v_a"], sensing["voltage_noise"], sensing["voltage_lsb"])}
