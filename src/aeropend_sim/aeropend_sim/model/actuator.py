# SPDX-License-Identifier: Apache-2.0
"""Duty to voltage to speed to thrust in steady state, and the inverse functions for the controllers.

Scalars and arrays (N,) are in SI units. A duty is a fraction 0..1, or -1..1 if the bridge reverses or brakes the motor.
`numbers` are the parameters of the model by name, from `Model.numbers`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from aeropend_sim.compiled import njit
from aeropend_sim.model.effects import DEFINED
from aeropend_sim.model.parameters import LONGEST_STEP, SAMPLE_PERIOD, Model
from aeropend_sim.model.terms import series

Array = NDArray[np.float64]
Numbers = Mapping[str, float]
ScalarOrArray = TypeVar("ScalarOrArray", float, Array)


class DutyMap(NamedTuple):
    """The parameters of the map from duty to voltage; `full` is 0 where k0 to k3 describe it."""

    k0: float
    k1: float
    k2: float
    k3: float
    full: float
    reverse: float


def duty_map(numbers: Numbers) -> DutyMap:
    """The map of a model."""
    full = numbers.get("v_full", 0.0)
    k0, k1, k2, k3 = (0.0,) * 4 if full > 0.0 else (numbers[name] for name in ("k0", "k1", "k2", "k3"))
    return DutyMap(k0, k1, k2, k3, full, numbers.get("reverse", 0.0))


@njit()
def mapped(duty: float, m: DutyMap) -> float:
    """Voltage (V) that a duty gives; see `voltage`."""
    size = abs(duty)
    v = m.full * size if m.full > 0.0 else m.k0 + m.k1 * math.sqrt(m.k2 * size + m.k3)
    if v < 0.0:
        v = 0.0
    return -m.reverse * v if duty < 0.0 else v


@njit(error_model="numpy")  # a fit may try a map that does not depend on the duty
def unmapped(voltage: float, m: DutyMap) -> float:
    """Duty that gives a voltage (V); see `duty`."""
    if voltage == 0.0 or (voltage < 0.0 and m.reverse <= 0.0):
        return 0.0
    size = -voltage / m.reverse if voltage < 0.0 else voltage
    if m.full > 0.0:
        found = size / m.full
    else:
        root = max(0.0, (size - m.k0) / m.k1)
        found = max((root * root - m.k3) / m.k2, 0.0)
    found = min(found, 1.0)
    return -found if voltage < 0.0 else found


@njit()
def _each_mapped(duty: Array, m: DutyMap) -> Array:
    out = np.empty(len(duty))
    for k in range(len(duty)):
        out[k] = mapped(duty[k], m)
    return out


def voltage(numbers: Numbers, duty: ScalarOrArray) -> ScalarOrArray:
    """Voltage (V) that a duty gives: v = max(0, k0 + k1 sqrt(k2 τ + k3)), thesis (4.3), or v = v_full τ.

    For a duty below 0 it is -reverse v(|τ|). With `reverse` 0 the terminals are then shorted: the motor brakes.
    """
    m = duty_map(numbers)
    if isinstance(duty, np.ndarray):
        return _each_mapped(np.ascontiguousarray(duty, dtype=float), m)
    return mapped(float(duty), m)


def duty(numbers: Numbers, voltage: float) -> float:
    """Duty that gives a voltage (V), clipped to its range. At 0 V, the dead zone of the map, it is 0.

    So it is below 0 V, unless the bridge reverses the motor.
    """
    return unmapped(float(voltage), duty_map(numbers))


def thrust(numbers: Numbers, speed: ScalarOrArray) -> ScalarOrArray:
    """Static thrust (N) of a speed (rad/s): f = k_thrust ω|ω|."""
    return numbers["k_thrust"] * speed * abs(speed)


def speed(numbers: Numbers, thrust: float) -> float:
    """Speed (rad/s) that gives a static thrust (N)."""
    return math.copysign(math.sqrt(abs(thrust) / numbers["k_thrust"]), thrust)


def current_at(numbers: Numbers, speed: ScalarOrArray) -> ScalarOrArray:
    """Armature current (A) that holds a speed (rad/s): K_t i = B_m ω + k_load ω|ω|."""
    return (numbers["B_m"] * speed + numbers["k_load"] * speed * abs(speed)) / numbers["K_t"]


def voltage_at(numbers: Numbers, speed: ScalarOrArray) -> ScalarOrArray:
    """Armature voltage (V) that holds a speed (rad/s): v = R_a i + K_e ω, thesis (3.5) at rest."""
    return numbers["R_a"] * current_at(numbers, speed) + numbers["K_e"] * speed


def speed_at(numbers: Numbers, voltage: ScalarOrArray) -> ScalarOrArray:
    """Steady speed (rad/s) of an armature voltage (V): the inverse of `voltage_at`."""
    a = numbers["R_a"] * numbers["k_load"] / numbers["K_t"]
    b = numbers["R_a"] * numbers["B_m"] / numbers["K_t"] + numbers["K_e"]
    return 2.0 * voltage / (b + np.sqrt(b * b + 4.0 * a * abs(voltage)))


def voltages(numbers: Numbers, duty: Array, effects: Mapping[str, Mapping[str, float]],
             period: float, start: int = 0, before: float = 0.0) -> tuple[Array, Array]:
    """`acting_voltage` and `sampled_voltage` together, with the arguments of `acting_voltage`."""
    first, then, part = _over_hold(numbers, duty, effects, period, start, before)
    if part == 0.0:
        return then, first
    return acting(first, then, share_of_first(numbers, part, period)), first


def acting(first: ArrayLike, then: ArrayLike, share: float) -> Array:
    """Voltage (V) over a hold that does the same as one voltage, and another one after it (`share_of_first`)."""
    return np.asarray(share * np.asarray(first) + (1.0 - share) * np.asarray(then))


def held_voltage(m: DutyMap, duty: float, before: float, share: float, time: float,
                 effects: Mapping[str, Mapping[str, float]]) -> float:
    """Voltage (V) at the bridge over one hold: `acting_voltage` of a single duty.

    Args:
        m: map from duty to voltage.
        duty: that acts, from a delayed change within the hold on.
        before: duty that acts until then; without effect if there is no such change.
        share: weight of `before` (`share_of_first`); 0 without such a change.
        time: [s] since the start of `supply_drift`.
        effects: the active effects.
    """
    v = at_bridge(mapped(duty, m), time, effects)
    if share > 0.0:
        v = acting(at_bridge(mapped(before, m), time, effects), v, share)
    return v  # type: ignore[return-value]


def share_of_first(numbers: Numbers, part: float, period: float) -> float:
    """Weight of the voltage before a change within a hold, for `acting`.

    It gives the winding the same current at the end of the hold. Over a hold of several steps it gives the same mean
    voltage instead: the current then follows within the hold, and its mean is what turns the rotor.

    Args:
        numbers: parameters of the model.
        part: share of the hold before the change.
        period: [s] length of the hold.
    """
    if period > LONGEST_STEP:
        return part
    lengths = period * numbers["R_a"] / numbers["L_a"]  # of the hold, in time constants of the winding
    return math.expm1(part * lengths) / math.expm1(lengths) if lengths < 500.0 else 0.0


def acting_voltage(numbers: Numbers, duty: Array, effects: Mapping[str, Mapping[str, float]],
                   period: float, start: int = 0, before: float = 0.0) -> Array:
    """Voltage at the bridge over each hold of a duty series, with the effects that need no state.

    If a delay is not a whole number of periods, the voltage changes within a hold. The result is then a constant
    voltage that does the same (`share_of_first`). `supply_sag` needs the current; see `terminal_voltage`.

    Args:
        numbers: parameters of the model.
        duty: (N,) duty held over [t_k, t_{k+1}).
        effects: the active effects.
        period: [s] time between samples.
        start: index of the first sample, counted from the start of `supply_drift`.
        before: duty that acted before the first sample.

    Returns:
        (N,) [V] voltage.
    """
    return voltages(numbers, duty, effects, period, start, before)[0]


def sampled_voltage(numbers: Numbers, duty: Array, effects: Mapping[str, Mapping[str, float]],
                    period: float, start: int = 0, before: float = 0.0) -> Array:
    """As `acting_voltage`, at the instant of each sample, at which the hold starts."""
    return _over_hold(numbers, duty, effects, period, start, before)[0]


def _over_hold(numbers: Numbers, duty: Array, effects: Mapping[str, Mapping[str, float]], period: float, start: int,
               before: float) -> tuple[Array, Array, float]:
    """Voltage (N,) at the start of each hold, voltage (N,) after a delayed change, and share of the hold before it."""
    n, (whole, part) = len(duty), delay(effects, period)
    time = (start + np.arange(n)) * period if "supply_drift" in effects else np.zeros(0)
    if whole == 0 and part == 0.0:
        v = at_bridge(voltage(numbers, duty), time, effects)
        return v, v, 0.0
    # a negative delay takes later duties of the series; after its end the last duty stays
    late = voltage(numbers, np.concatenate([np.full(max(whole + 1, 0), before), duty, duty[n - max(-whole, 0):]]))
    then = at_bridge(late[1:n + 1], time, effects)
    return (at_bridge(late[:n], time, effects) if part > 0.0 else then), then, part


def delay(effects: Mapping[str, Mapping[str, float]], period: float) -> tuple[int, float]:
    """Whole periods by which a duty acts late, and the share of a period beyond them; below 0 it acts early."""
    periods = effects["command_delay"]["delay"] / period if "command_delay" in effects else 0.0
    whole = math.floor(periods + 1e-9)
    return whole, max(periods - whole, 0.0) if periods - whole > 1e-9 else 0.0


def at_bridge(v: ArrayLike, time: ArrayLike, effects: Mapping[str, Mapping[str, float]]) -> Array:
    """Voltage (V) at the bridge, from that of the duty's map (V), after a time (s)."""
    acts: Array = np.asarray(v, dtype=float)
    if "supply_drift" in effects:
        acts = acts * np.maximum(0.0, 1.0 - effects["supply_drift"]["rate"] * np.asarray(time, dtype=float))
    if "bridge_drop" in effects:
        acts = np.sign(acts) * np.maximum(0.0, np.abs(acts) - effects["bridge_drop"]["v_drop"])
    return acts


def terminal_voltage(model: Model, voltage: ScalarOrArray, current: ScalarOrArray, period: float = SAMPLE_PERIOD,
                     start: float = 0.0, memory: Array | None = None) -> ScalarOrArray:
    """Voltage at the motor's terminals.

    Args:
        model: its effect `supply_sag` acts, and its effects by formula at place `actuator`.
        voltage: [V] scalar or (N,) voltage at the bridge without load, from `acting_voltage` or `sampled_voltage`.
        current: [A] armature current, in the same shape.
        period: [s] time between samples.
        start: [s] time of the first sample, for formulas.
        memory: states of the effects with a memory, for a series in parts; as for `terms.series`.

    Returns:
        [V] v - r_supply i, in the same shape; (N,) with effects by formula.
    """
    loaded = voltage - model.effect("supply_sag", "r_supply") * current
    if any(DEFINED[id_].term and DEFINED[id_].place == "actuator" for id_ in model.effects if id_ in DEFINED):
        v, i = np.broadcast_arrays(np.atleast_1d(voltage), np.atleast_1d(current))
        loaded = loaded + series(  # type: ignore[assignment]
            model.effects, "actuator", len(v), period, start, memory, v=v, i_a=i)
    return loaded


def behind_terminals(model: Model) -> Model:
    """The model without the effects that act between bridge and terminals: a measured voltage holds them."""
    return model.with_effects({id_: p for id_, p in model.effects.items() if id_ != "supply_sag" and not (
        id_ in DEFINED and DEFINED[id_].term and DEFINED[id_].place == "actuator")})


def static_angle(numbers: Numbers, duty: ScalarOrArray) -> ScalarOrArray:
    """Angle (rad) at which a duty holds the arm; NaN if the thrust exceeds the weight of the arm."""
    f = thrust(numbers, speed_at(numbers, voltage(numbers, duty)))
    with np.errstate(invalid="ignore"):
        return np.arcsin(numbers["L_over_J"] * f / numbers["mgd_over_J"])
