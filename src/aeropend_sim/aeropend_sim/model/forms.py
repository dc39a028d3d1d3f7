# SPDX-License-Identifier: Apache-2.0
"""Other forms of the effects of the catalogue: the same physics, described by another law.

A form is an effect by formula, as an effect file may hold it, or one of the angle filter in `sensing`. Where it has a
parameter of the effect, it has the same meaning there. The other parameters are its own; a parameter that `refines` is
not fitted.
"""

from __future__ import annotations

import math

from aeropend_sim.model.effects import CATALOGUE, DEFINED, Effect, EffectParameter

P = EffectParameter


def _form(id_: str, of: str, physics: str, term: str, own: dict[str, EffectParameter], *, memory: str = "",
          rate: str = "", sticks: bool = False) -> Effect:
    """A form: the parameters of its effect that its formulas use, then its own."""
    effect = CATALOGUE[of]
    words = set("".join(c if c.isalnum() or c == "_" else " " for c in f"{term} {rate}").split())
    shared = {name: p for name, p in effect.parameters.items() if name in words and name not in own}
    name, _, unit = memory.partition(" ")
    return Effect(id_, effect.place, physics, {**shared, **own}, effect.in_equations, term=term, reading=effect.reading,
                  memory=name, memory_unit=unit, rate=rate, sticks=sticks, form_of=of)


_ENTRIES = (
    _form("bridge_drop_resistive", "bridge_drop",
          "the drop of the H-bridge rises with the current (resistance of its switches)",
          "-v_drop * (1 + rise * abs(i_a)) * tanh(v / soft)",
          {"rise": P("1/A", 0.0, 0.25, 0.0, 5.0, "resistance of the closed switches over the drop"),
           "soft": P("V", 0.1, 0.1, 0.01, 1.0, "voltage below which the drop vanishes", refines=True)}),
    _form("supply_sag_capacitor", "supply_sag",
          "a capacitor at the supply carries the current at first: part of the voltage falls late",
          "-r_supply * ((1 - late) * i_a + late * z)",
          {"late": P("-", 0.0, 0.3, 0.0, 1.0, "share of the resistance behind the capacitor"),
           "tau": P("s", 0.15, 0.15, 0.01, 3.0, "time constant of the capacitor")},
          memory="z A", rate="(i_a - z) / tau"),
    _form("supply_drift_exponential", "supply_drift", "the supply voltage falls with time, exponentially",
          "v * (exp(-rate * t) - 1)", {}),
    _form("command_delay_lag", "command_delay", "the voltage follows the duty with a first-order lag", "z - v",
          {"lag": P("s", 0.0, 0.03, 0.0, 0.5, "time constant of the driver")},
          memory="z V", rate="(v - z) / (lag + 1e-4)"),
    _form("command_delay_ramp", "command_delay", "the driver limits how fast the voltage changes", "z - v",
          {"ramp": P("s/V", 0.0, 0.01, 0.0, 1.0, "time for one volt"),
           "soft": P("s", 1e-3, 1e-3, 1e-4, 0.1, "time constant at the end of the ramp", refines=True)},
          memory="z V", rate="(v - z) / (ramp * abs(v - z) + soft)"),
    _form("brush_drop_algebraic", "brush_drop", "voltage drop over the brushes that rises slowly: i/√(i² + width²)",
          "-v_brush * i_a / sqrt(i_a**2 + width**2)",
          {"width": P("A", 0.02, 0.02, 0.002, 0.5, "current over which the drop arises")}),
    _form("rotor_friction_stribeck", "rotor_friction", "dry friction of the rotor that falls with the speed (Stribeck)",
          "torque * (1 + rise * exp(-(omega / speed)**2))",
          {"rise": P("-", 0.0, 0.3, 0.0, 4.0, "relative rise at standstill"),
           "speed": P("rad/s", 15.0, 15.0, 1.0, 200.0, "speed at which the rise is gone")}, sticks=True),
    _form("thrust_lag_speed", "thrust_lag", "the lag of the thrust is shorter at high speed of the rotor: tau ω_0/ω",
          "z - thrust",
          {"share": P("-", 0.0, 0.5, 0.0, 0.95, "share of the rate that is proportional to the speed"),
           "pivot": P("rad/s", 150.0, 150.0, 1.0, 2000.0, "speed at which the time constant is tau", refines=True)},
          memory="z N", rate="(thrust - z) / (tau + 1e-4) * (1 - share + share * abs(omega) / pivot)"),
    _form("thrust_exponent_reynolds", "thrust_exponent",
          "the coefficient of thrust changes with the logarithm of the speed (Reynolds number)",
          "thrust * (n - 2) * log(max(abs(omega), 1) / pivot)",
          {"pivot": P("rad/s", 150.0, 150.0, 1.0, 2000.0, "speed at which the thrust is not changed", refines=True)}),
    _form("axial_inflow_momentum", "axial_inflow",
          "the loss of thrust bends where the inflow is large (momentum theory)",
          "-k * omega * theta_dot / (1 + bend * abs(k * omega * theta_dot) / (abs(thrust) + 1e-3))",
          {"bend": P("-", 0.0, 0.5, 0.0, 5.0, "bend over the relative loss of thrust")}),
    _form("ground_effect_gaussian", "ground_effect",
          "the thrust is greater near the rest position: f (1 + gain exp(-(θ/width)²))",
          "thrust * gain * exp(-(theta / width)**2)", {}),
    _form("ground_effect_rational", "ground_effect",
          "the thrust is greater near the rest position: f (1 + gain/(1 + (θ/width)²))",
          "thrust * gain / (1 + (theta / width)**2)", {}),
    _form("ground_effect_cheeseman", "ground_effect",
          "the thrust over a plane: f/(1 - (R/4z)²) (Cheeseman and Bennett 1955), height z = z_0 (1 + |θ|/width)",
          "thrust * gain / ((1 + gain) * (1 + abs(theta) / width)**2 - gain)", {}),
    _form("coulomb_friction_stribeck", "coulomb_friction",
          "dry friction in the pivot that falls with the speed (Stribeck 1902)",
          "accel * (1 + rise * exp(-(theta_dot / speed)**2))",
          {"rise": P("-", 0.0, 0.3, 0.0, 4.0, "relative rise at standstill"),
           "speed": P("rad/s", 0.05, 0.05, 0.002, 2.0, "rate of the arm at which the rise is gone")}, sticks=True),
    _form("coulomb_friction_uneven", "coulomb_friction", "dry friction in the pivot that differs upwards and downwards",
          "accel * (1 + uneven * sign(theta_dot))",
          {"uneven": P("-", 0.0, 0.2, -1.0, 1.0, "half the difference of up and down over their mean")}, sticks=True),
    _form("coulomb_friction_loaded", "coulomb_friction", "dry friction in the pivot that rises with the thrust",
          "accel * (1 + load * abs(thrust))",
          {"load": P("1/N", 0.0, 1.0, 0.0, 50.0, "relative rise of the friction per thrust")}, sticks=True),
    _form("coulomb_friction_dahl", "coulomb_friction",
          "dry friction in the pivot over elastic bristles (Dahl 1968): at rest the arm gives a little",
          "-accel * z / bend",
          {"bend": P("rad", 2e-3, 2e-3, 2e-4, 0.1, "deflection of the bristles when they slip")},
          memory="z rad", rate="theta_dot - abs(theta_dot) * z / bend"),
    _form("quadratic_drag_power", "quadratic_drag", "air drag of the arm with another power of the rate",
          "-k * theta_dot * unit * (abs(theta_dot) / unit)**(n - 1)",
          {"n": P("-", 2.0, 1.8, 1.1, 3.5, "exponent of the rate"),
           "unit": P("rad/s", 1.0, 1.0, 0.1, 10.0, "rate at which the drag is that of exponent 2", refines=True)}),
    _form("cable_torque_hardening", "cable_torque", "the cable acts as a spring that hardens: x (1 + hard x²)",
          "-k * (theta - theta0) * (1 + hard * (theta - theta0)**2)",
          {"hard": P("1/rad²", 0.0, 0.5, -0.5, 20.0, "hardening")}),
    _form("cable_torque_slack", "cable_torque", "the cable is slack over a range of angles, a spring beyond",
          "-k * (theta - theta0 - clip(theta - theta0, -slack, slack))",
          {"slack": P("rad", 0.0, 0.1, 0.0, 1.0, "half of the range in which it is slack")}),
    _form("encoder_eccentricity_harmonic", "encoder_eccentricity",
          "the error of the encoder has a second harmonic (magnet off the axis and tilted)",
          "amplitude * (sin(theta + phase) + second * sin(2 * theta + turn))",
          {"second": P("-", 0.0, 0.2, 0.0, 2.0, "amplitude of the second harmonic over that of the first"),
           "turn": P("rad", 0.0, 0.5, -math.pi, math.pi, "its phase")}),
    _form("encoder_lag_single", "encoder_lag", "one of the two stages of the angle filter is slower, or faster", "",
          {"lag": P("s", 0.0, 0.06, -0.5, 1.0, "time constant added to one stage of the filter")}),
    _form("current_gain_bent", "current_gain", "the scale error of the current changes with the current",
          "i_a * gain * (1 - bend * abs(i_a))",
          {"bend": P("1/A", 0.0, 0.05, -0.5, 0.5, "relative change of the error per current")}),
)

FORMS: dict[str, Effect] = {entry.id: entry for entry in _ENTRIES}
"""All other forms by id."""

DEFINED.update(FORMS)

