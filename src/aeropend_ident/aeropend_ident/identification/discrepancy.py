# SPDX-License-Identifier: Apache-2.0
"""Discrepancy SINDy: only the terms that must be added to a known model are identified (thesis 5.4)."""

from __future__ import annotations

from collections.abc import Mapping

from aeropend_sim.model.coefficients import prepare
from aeropend_sim.model.parameters import Model, ModelError

Equations = Mapping[str, Mapping[str, float]]


def nominal(model: Model) -> dict[str, dict[str, float]]:
    """The nominal equations, thesis (3.2) to (3.5), with the numbers of `coefficients`: state -> term -> coefficient.

    Raises:
        ModelError: the model has effects, which are not sums of terms.
    """
    if effects := [e for e in model.effects if e != "parameter_mismatch"]:
        raise ModelError(f"{model.name}: discrepancy methods add to the nominal equations, and this model has the "
                         f"effect {effects[0]}; give a model without effects")
    c = prepare(model)[0]
    winding = model.numbers()["R_a"] * c.per_L
    speed = "omega*abs(omega)"
    found = {"theta": {"theta_dot": 1.0},
             "theta_dot": {"sin(theta)": -c.gravity, "theta_dot": -c.damping, speed: c.lever * c.k_thrust},
             "i_a": {"i_a": -winding, "omega": -c.K_e * c.per_L, "v_a": c.per_L},
             "omega": {"i_a": c.torque, "omega": -c.drag, speed: -c.load}}
    return {s: {t: x for t, x in terms.items() if x != 0.0} for s, terms in found.items()}


def in_library(model: Model) -> dict[str, dict[str, float]]:
    """`nominal` in terms of the thesis' library: the rotor does not turn backwards, so ω|ω| is ω²."""
    return {s: {t.replace("omega*abs(omega)", "omega*omega"): x for t, x in terms.items()}
            for s, terms in nominal(model).items()}
