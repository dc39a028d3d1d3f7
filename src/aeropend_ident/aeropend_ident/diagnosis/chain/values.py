# SPDX-License-Identifier: Apache-2.0
"""Values by name: what they mean for a model. `estimation.parameter.key` knows the form of the names."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from aeropend_ident.estimation.parameter import key
from aeropend_ident.signals.signals import Signals
from aeropend_sim.model.effects import DEFINED, EffectParameter
from aeropend_sim.model.parameters import DUTY_MAP, OPTIONAL, PARAMETERS, Model
from aeropend_sim.model.parameters import Parameter as ModelParameter

Values = Mapping[str, float]

STAGES: dict[str, tuple[str, ...]] = {
    "actuator": (*DUTY_MAP, *OPTIONAL),
    "motor": ("R_a", "L_a", "K_e", "K_t", "J_m", "B_m", "k_load"),
    "arm": ("k_thrust", "mgd_over_J", "c_over_J", "L_over_J"),
}
"""The stages of the cut chain and the parameters of the model in each."""

FEWEST_PARAMETERS = sum(map(len, STAGES.values())) - len(OPTIONAL)
"""Number of parameters of a model without `v_full` and `reverse` (derived)."""

FILTER = "sensing.angle_filter_tau"
"""The one parameter of the measurement chain that is fitted along."""

CHANNELS_OF = {"actuator": ("v_a",), "motor": ("i_a", "omega"), "arm": ("theta",)}
"""The channels that each stage predicts."""

AT_REST = "map.at_rest"
"""[V] k0 + k1 sqrt(k3), the map's value at a duty of 0, which is fitted in place of k0 where only the angle is known.

It is at most 0 if such a duty does not turn the rotor. A fit moves along a bound of a parameter, but not along one that
two parameters share."""

PLACE_OF_PARAMETER = {
    **dict.fromkeys(STAGES["actuator"], "actuator"), **dict.fromkeys(("R_a", "L_a", "K_e"), "electrical"),
    **dict.fromkeys(("K_t", "J_m", "B_m", "k_load"), "rotor"), "k_thrust": "thrust", "L_over_J": "thrust",
    "mgd_over_J": "arm", "c_over_J": "arm", FILTER: "sensing", AT_REST: "actuator",
}
"""The place in the chain of each parameter of the model."""

BEHIND_ROTOR = ("thrust", "arm", "sensing")
"""Places in the chain that do not act back on voltage, current and speed."""

PLACE_OF_CHANNEL = {"v_a": "actuator", "i_a": "electrical", "omega": "rotor", "theta": "arm"}
"""The place whose misfit a channel shows first."""


PLACES_OF = {stage: {PLACE_OF_PARAMETER[n] for n in names} for stage, names in STAGES.items()}
"""Stage -> places of its parameters."""


def stage_at(place: str, reading: str = "") -> str:
    """The first stage of the cut chain in which a term acts.

    Args:
        place: of the chain.
        reading: that it changes, at place `sensing`.
    """
    at = PLACE_OF_CHANNEL[reading] if place == "sensing" else place
    return next((stage for stage, places in PLACES_OF.items() if at in places), "arm")


def with_values(model: Model, values: Values) -> Model:
    """The model with these values; initial states are left out.

    Args:
        model: gives the rest.
        values: by name, of one recording.
    """
    numbers, measuring = dict(model.model), dict(model.sensing)
    effects = {k: dict(v) for k, v in model.effects.items()}
    for name, value in values.items():
        k = key(name)
        if not k.owner:
            numbers[name] = value
        elif k.owner == "sensing":
            measuring[k.name] = value
        elif name != AT_REST and not k.is_initial:
            effects.setdefault(k.owner, {})[k.name] = value
    if AT_REST in values:
        numbers["k0"] = values[AT_REST] - numbers["k1"] * math.sqrt(numbers["k3"])
    return Model(model.name, numbers, measuring, effects)


def at_rest(model: Model) -> float:
    """[V] `AT_REST` of a model."""
    return model.model["k0"] + model.model["k1"] * math.sqrt(model.model["k3"])


def without_effects(values: Values, model: Model) -> dict[str, float]:
    """The values without those of effects that the model lacks."""
    return {n: v for n, v in values.items() if key(n).owner not in DEFINED or key(n).owner in model.effects}


def absent_at(name: str) -> float:
    """The value of a parameter of an effect at which the effect is absent."""
    return DEFINED[key(name).owner].parameters[key(name).name].neutral


def neutral(model: Model, name: str) -> float:
    """The value of a parameter in the nominal model; that of an effect which the model lacks is the one without it."""
    k = key(name)
    if name == AT_REST:
        return at_rest(model)
    if k.owner == "sensing":
        return model.sensing[k.name]
    return model.effect(k.owner, k.name) if k.owner else model.model[k.name]


def acts_on_motor(name: str) -> bool:
    """Whether a value acts on voltage, current or speed, rather than on the arm or on a reading alone.

    An error of the voltage's reading does: it puts off the true voltage, which is that of the reading without it.
    """
    k = key(name)
    if k.owner in DEFINED:
        return DEFINED[k.owner].place not in BEHIND_ROTOR or DEFINED[k.owner].reading == "v_a"
    return k.owner != "sensing" and name not in (*STAGES["arm"], "initial.theta", "initial.theta_dot")


def acts_on_arm(name: str) -> bool:
    """Whether a value acts on the motion of the arm, rather than on a reading alone."""
    owner = key(name).owner
    read = DEFINED[owner].place == "sensing" if owner in DEFINED else owner == "sensing"
    return not read or acts_on_motor(name)


def limits(name: str) -> EffectParameter | ModelParameter:
    """The limits of a parameter of the model, of the measurement chain or of an effect."""
    k = key(name)
    if name == AT_REST:
        return PARAMETERS["model.k0"]
    return DEFINED[k.owner].parameters[k.name] if k.owner in DEFINED else PARAMETERS[
        name if k.owner else f"model.{name}"]


def clipped(name: str, value: float) -> float:
    """A value within the range of its parameter."""
    p = limits(name)
    return min(max(value, p.low), p.high)


def own_sensing(model: Model, recordings: Sequence[Signals]) -> dict[str, float]:
    """The measurement chain of a model with the noise that the recordings show; it holds their resolution."""
    own = dict(model.sensing)
    for channel, name in (("theta", "angle"), ("i_a", "current"), ("v_a", "voltage")):
        seen = [s.sigma[channel] for s in recordings if s.has(channel)]
        if seen:
            own |= {f"{name}_noise": float(np.mean(seen)), f"{name}_lsb": 0.0}
    return own


def states(values: Values) -> dict[str, float]:
    """The initial states among values."""
    return {n: v for n, v in values.items() if key(n).is_initial}


def of_rig(values: Values) -> dict[str, float]:
    """The values that hold for the rig: without initial states; those that differ between recordings as their mean."""
    out: dict[str, list[float]] = {}
    for name, value in values.items():
        k = key(name)
        if not k.is_initial:
            out.setdefault(k.plain, []).append(value)
    return {name: float(np.mean(all_)) for name, all_ in out.items()}
