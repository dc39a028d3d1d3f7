# SPDX-License-Identifier: Apache-2.0
"""The catalogue of effects that a nominal model can lack: one entry per effect.

To add one: an entry here, its term in `actuator.py`, `motor.py`, `arm.py` or `sensing.py`, and its row in
docs/effects.md. An effect whose term is a formula needs no source: see `effect_file`. Other forms of these effects are
in `forms`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, NamedTuple

PLACES = ("actuator", "electrical", "rotor", "thrust", "arm", "sensing")
"""The places of the chain from the duty to the reading, in the direction of cause."""

PARAMETER_MISMATCH = "parameter_mismatch"
"""The effect that replaces parameters of the model: their names in the model file, and their new values."""

THRUST_PIVOT_SPEED = 150.0
"""[rad/s] Speed at which `thrust_exponent` does not change the thrust (docs/effects.md). Convention."""


@dataclass(frozen=True)
class EffectParameter:
    """One parameter of an effect.

    Attributes:
        unit: its unit; "-" for none.
        neutral: value at which the effect is absent.
        default: value that an effect without this parameter takes; of a size that matters on `bench`.
        low: smallest value.
        high: greatest value.
        description: its meaning.
        refines: whether it refines the effect, which is usually complete with the neutral value.
    """

    unit: str
    neutral: float
    default: float
    low: float
    high: float
    description: str
    refines: bool = False


@dataclass(frozen=True)
class Effect:
    """An effect: its place in the chain, its physics in one line, and its parameters.

    The first parameter is the size: at its neutral value the effect is absent, whatever the values of the others.
    """

    id: str
    place: str
    physics: str
    parameters: dict[str, EffectParameter]
    in_equations: bool = True
    """Whether its term is in `motor` or `arm`; otherwise it is in `actuator` (input) or `sensing` (reading)."""
    linear_in: Literal["", "product", "polar"] = ""
    """How the effect depends on its first two parameters, if it is not linear in the size alone.

    `product`: the size, and the size times the second; `polar`: the size times the cosine and the sine of the second.
    """
    term: str = ""
    """The formula of its term, for an effect that is given by one; see docs/effects.md for what it is added to."""
    law: str = ""
    """The same for an effect that the source holds, if its term is a formula; numbers in it have units."""
    reading: str = ""
    """The reading that an effect at place `sensing` changes; a formula is added to `theta`, `i_a` or `v_a`."""
    memory: str = ""
    """Name of the state that such an effect has of its own; it is 0 at the start."""
    memory_unit: str = ""
    """Its unit."""
    rate: str = ""
    """The formula of the time derivative of that state."""
    sticks: bool = False
    """Whether the term is the size of a dry friction: it opposes the motion, and holds at rest what is smaller."""
    form_of: str = ""
    """The effect of the catalogue of which it is another form."""

    @property
    def family(self) -> str:
        """Id of the effect of which it is a form; its own id if it is none."""
        return self.form_of or self.id

    @property
    def formula(self) -> str:
        """The formula of its term, however it is given; "" if there is none."""
        return self.term or self.law

    @property
    def size(self) -> str:
        """Name of the parameter that is the size of the effect."""
        return next(iter(self.parameters))

    @property
    def defaults(self) -> dict[str, float]:
        """Name of each parameter -> its default; of one that refines the effect the neutral value."""
        return {name: p.neutral if p.refines else p.default for name, p in self.parameters.items()}


P = EffectParameter

_ENTRIES = (
    Effect("bridge_drop", "actuator", "constant voltage drop of the H-bridge: v = max(0, map(τ) - v_drop)",
           {"v_drop": P("V", 0.0, 0.2, 0.0, 2.0, "voltage lost in the bridge")}, in_equations=False,
           law="-min(v_drop, v)"),
    Effect("supply_sag", "actuator", "the supply voltage falls under load: v = map(τ) - r_supply i",
           {"r_supply": P("Ω", 0.0, 0.15, 0.0, 5.0, "internal resistance of the supply")}, law="-r_supply * i_a"),
    Effect("supply_drift", "actuator", "the supply voltage falls with time: v = map(τ)(1 - rate t)",
           {"rate": P("1/s", 0.0, 2e-3, -0.02, 0.02, "relative loss of voltage per second")}, in_equations=False,
           law="-v * rate * t"),
    Effect("command_delay", "actuator", "the duty acts later or, by up to a sample period, earlier",
           {"delay": P("s", 0.0, 0.03, -2.04e-3, 0.5, "time from the duty to its effect")}, in_equations=False),
    Effect("brush_drop", "electrical", "voltage drop over the brushes: v_brush tanh(i/0.02)",
           {"v_brush": P("V", 0.0, 0.12, 0.0, 1.0, "voltage over the brushes")}, law="-v_brush * tanh(i_a / 0.02)"),
    Effect("winding_heating", "electrical", "the winding warms up: R = R_a (1 + gain T), Ṫ = i² - T/tau",
           {"gain": P("1/A²s", 0.0, 0.02, 0.0, 0.5, "relative rise of resistance per A²s"),
            "tau": P("s", 30.0, 30.0, 1.0, 600.0, "time constant of cooling")}),
    Effect("rotor_friction", "rotor", "Coulomb torque on the rotor, with sticking",
           {"torque": P("N·m", 0.0, 5e-4, 0.0, 2e-2, "friction torque")}, law="torque", sticks=True),
    Effect("thrust_lag", "thrust",
           "the thrust lags behind its static value: ḟ = (f_static - f)/tau, /(fall tau) downwards",
           {"tau": P("s", 0.0, 0.08, 0.0, 1.0, "time constant of the thrust while it rises"),
            "fall": P("-", 1.0, 1.0, 0.1, 10.0, "time constant while the thrust falls, over that while it rises",
                      refines=True)}, law="z - thrust", memory="z", memory_unit="N",
           rate="(thrust - z) / (tau * (1 + (fall - 1) * step(z - thrust)))"),
    Effect("thrust_exponent", "thrust",
           "the thrust is not quadratic in the speed: f = k_thrust ω_0² (ω/ω_0)^n, ω_0 = 150 rad/s",
           {"n": P("-", 2.0, 1.8, 1.0, 3.0, "exponent of the speed")},
           law="thrust * ((max(abs(omega), 1) / 150)**(n - 2) - 1)"),
    Effect("axial_inflow", "thrust", "the thrust falls when the rotor moves along its axis: f - k ω θ̇",
           {"k": P("N·s²/rad²", 0.0, 1e-4, 0.0, 2e-3, "loss of thrust per speed and angular rate")},
           law="-k * omega * theta_dot"),
    Effect("ground_effect", "thrust", "the thrust is greater near the rest position: f (1 + gain exp(-|θ|/width))",
           {"gain": P("-", 0.0, 0.25, -0.9, 3.0, "relative rise of thrust at θ = 0"),
            "width": P("rad", 0.3, 0.3, 0.02, 2.0, "angle over which the rise decays")},
           law="thrust * gain * exp(-abs(theta) / width)"),
    Effect("coulomb_friction", "arm", "dry friction in the pivot, with sticking, torque over inertia",
           {"accel": P("rad/s²", 0.0, 0.8, 0.0, 20.0, "friction torque over the arm's inertia")},
           law="accel", sticks=True),
    Effect("quadratic_drag", "arm", "air drag of the arm: - k θ̇|θ̇|",
           {"k": P("1/rad", 0.0, 0.6, 0.0, 20.0, "drag over the arm's inertia")},
           law="-k * theta_dot * abs(theta_dot)"),
    Effect("cable_torque", "arm", "the cable acts as a spring: - k (θ - theta0)",
           {"k": P("1/s²", 0.0, 4.0, 0.0, 60.0, "stiffness over the arm's inertia"),
            "theta0": P("rad", 0.0, 0.4, -2.0, 2.0, "angle at which the cable is slack")}, linear_in="product",
           law="-k * (theta - theta0)"),
    Effect("mast_flex", "arm", "the mast vibrates: q̈ + 2 zeta omega q̇ + omega² q = -coupling θ̈, acting back with -q̈",
           {"coupling": P("-", 0.0, 0.3, 0.0, 0.9, "share of the arm's inertia that the mode moves"),
            "omega": P("rad/s", 12.0, 12.0, 3.0, 300.0, "natural frequency of the mode"),
            "zeta": P("-", 0.03, 0.03, 0.001, 1.0, "damping ratio of the mode")}),
    Effect("gust", "arm", "coloured random torque over inertia (first-order Gauss-Markov)",
           {"sigma": P("rad/s²", 0.0, 1.5, 0.0, 50.0, "standard deviation"),
            "tau": P("s", 0.3, 0.3, 0.005, 30.0, "correlation time")}),
    Effect("angle_offset", "sensing",
           "the angle is read with an offset: θ + bias (an offset centre of mass looks the same)",
           {"bias": P("rad", 0.0, 0.06, -1.0, 1.0, "angle read at rest")}, in_equations=False,
           law="bias", reading="theta"),
    Effect("encoder_lag", "sensing", "the angle filter is slower than in the model file, or faster (tau below 0)",
           {"tau": P("s", 0.0, 0.03, -0.5, 0.5, "time constant added to each stage of the filter")},
           in_equations=False, reading="theta"),
    Effect("encoder_eccentricity", "sensing",
           "the magnet is off the axis: the reading is θ + amplitude sin(θ + phase)",
           {"amplitude": P("rad", 0.0, 0.06, 0.0, 0.5, "amplitude of the error"),
            "phase": P("rad", 0.5, 0.5, -math.pi, math.pi, "direction of the offset")}, in_equations=False,
           linear_in="polar", law="amplitude * sin(theta + phase)", reading="theta"),
    Effect("current_gain", "sensing", "the current has a scale error: the reading is i (1 + gain)",
           {"gain": P("-", 0.0, 0.3, -0.9, 3.0, "relative error of the reading")}, in_equations=False,
           law="i_a * gain", reading="i_a"),
    Effect("current_offset", "sensing", "the current has an offset: the reading is i + bias",
           {"bias": P("A", 0.0, 0.06, -2.0, 2.0, "current read at zero")}, in_equations=False,
           law="bias", reading="i_a"),
    Effect("voltage_offset", "sensing", "the voltage has an offset: the reading is v + bias",
           {"bias": P("V", 0.0, 0.1, -3.0, 3.0, "voltage read at zero")}, in_equations=False,
           law="bias", reading="v_a"),
    Effect("speed_spikes", "sensing", "false capture periods: outliers in ω",
           {"rate": P("1/s", 0.0, 2.0, 0.0, 100.0, "mean number of false periods per second")}, in_equations=False,
           reading="omega"),
)

CATALOGUE: dict[str, Effect] = {entry.id: entry for entry in _ENTRIES}
"""All effects except `parameter_mismatch`, by id, in the order of the chain."""

DEFINED: dict[str, Effect] = dict(CATALOGUE)
"""The effects of the catalogue, and those that effect files and model files of this process have defined, by id."""

RANDOM = frozenset({"gust", "speed_spikes"})
"""Effects of chance: no model predicts their readings, and no fit of readings has their parameters."""

SPIKE_FACTOR = (1.3, 4.0)
"""Range of the false speed over the true one, uniform: a false capture period is too short. Convention."""

_FIELDS = {f"{effect.id}_{name}": parameter.neutral
           for effect in _ENTRIES if effect.in_equations for name, parameter in effect.parameters.items()}

Values = NamedTuple("Values", [(name, float) for name in _FIELDS])  # type: ignore[misc]
"""All parameters of the effects in the equations, as `<id>_<parameter>`, for `motor` and `arm`."""

NO_EFFECT = Values(**_FIELDS)
"""All parameters neutral."""


def family(id_: str) -> str:
    """The effect of which an effect is a form; any other id stays as it is."""
    return DEFINED[id_].family if id_ in DEFINED else id_


def is_active(effect_id: str, parameters: Mapping[str, float]) -> bool:
    """Whether an effect with these parameters differs from the nominal model.

    Args:
        effect_id: its id.
        parameters: all of its parameters by name.
    """
    effect = DEFINED[effect_id]
    return parameters[effect.size] != effect.parameters[effect.size].neutral


def values(effects: Mapping[str, Mapping[str, float]]) -> Values | None:
    """Flatten the active effects of the equations.

    Args:
        effects: effect id -> parameter name -> value, complete (see `parameters.from_flat`).

    Returns:
        Their parameters; None if no effect is active.
    """
    active = {id_: p for id_, p in effects.items()
              if id_ in CATALOGUE and CATALOGUE[id_].in_equations and is_active(id_, p)}
    if not active:
        return None
    flat = {f"{id_}_{name}": float(value) for id_, p in active.items() for name, value in p.items()}
    return Values(**{**_FIELDS, **flat})
