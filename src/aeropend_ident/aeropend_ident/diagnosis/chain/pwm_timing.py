# SPDX-License-Identifier: Apache-2.0
"""When a duty begins to act: at the sample that first reports it, or half a sample period before.

A phase-correct PWM takes a new duty at the top of its count (ATmega2560 data sheet, 17.9.4). A board that samples at
the bottom reports the duty half a period after it began to act. The voltage at the samples does not show that; the
current in between does. This is a property of the board and not a gap of the model: it is estimated before effects are
searched, and the model is given a negative `command_delay`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import DELAY, CutChain, CutChains
from aeropend_ident.diagnosis.chain.priors import initial_states, model_parameters
from aeropend_ident.estimation.map_fit import fit
from aeropend_ident.estimation.parameter import Parameter
from aeropend_ident.signals.signals import SETTLED
from aeropend_sim.model.parameters import Model

Array = NDArray[np.float64]

WIDE_SD = 0.3
"""Relative standard deviation of a parameter that may be far off, so that it does not bias the timing (choice)."""

HINT, CERTAIN = 0.3, 0.6
"""Share of an early duty's effect on the current that calls for a fit, and that is conclusive.

The share is about 0 or about 1; the limits lie between (choice)."""


def with_pwm_timing(chains: CutChains) -> CutChains:
    """The chains, with the duty acting half a sample period earlier if the current shows that it does."""
    model = chains.model
    if "command_delay" in model.effects or not all(s.has("v_a") and s.has("i_a") for s in chains.recordings):
        return chains
    lead = 0.5 * chains.each[0].signals.period
    if lead > SETTLED:  # no current is read that would show it
        return chains
    note = (f"the duty acts {1e3 * lead:.2f} ms before the sample that first reports it, as with a phase-correct PWM: "
            f"the model is given a command_delay of {-1e3 * lead:.2f} ms")
    early = _copy(chains, model.with_effects({**model.effects, "command_delay": {"delay": -lead}}), note)
    if early_share(chains, early, {}) < HINT:
        return chains
    at_sample = _copy(chains, model)
    described = fit(chains.residuals("actuator"), _widened(model_parameters(chains, "actuator")))
    at_sample.set_next_input("actuator", described.values)
    early.set_next_input("actuator", described.values)
    values = fit(at_sample.residuals("motor"), [*initial_states(chains, "motor"),
                                                *_widened(model_parameters(chains, "motor"))]).values
    if early_share(at_sample, early, values) < CERTAIN or any(_delayed(chain) for chain in chains.each):
        return chains
    return _copy(chains, early.model, note)


def early_share(at_sample: CutChains, early: CutChains, values: dict[str, float]) -> float:
    """Least-squares share of the change of the current by an early duty that the recordings show: about 0 or 1.

    Each sample is compared with the mean of its two neighbours, which removes most other influences.

    Args:
        at_sample: the chains with the duty acting at the sample.
        early: the chains with the duty acting half a period earlier.
        values: parameters and initial states of the motor.
    """
    expected, seen = [], []
    for k, (chain, other) in enumerate(zip(at_sample.each, early.each, strict=True)):
        own = at_sample.values_of(values, k)
        current = chain.motor(own)[0]
        expected.append(_from_neighbours(other.motor(own)[0] - current))
        seen.append(_from_neighbours(chain.signals.i_a - current))
    x, y = np.concatenate(expected), np.concatenate(seen)
    known = np.isfinite(y)
    power = float(x[known] @ x[known])
    return float(x[known] @ y[known]) / power if power > 0.0 else 0.0


def _from_neighbours(x: Array) -> Array:
    return x[1:-1] - 0.5 * (x[2:] + x[:-2])


def _copy(chains: CutChains, model: Model, *notes: str) -> CutChains:
    return type(chains)(model, [s.noted(*notes) for s in chains.recordings], chains.policy)


def _widened(parameters: list[Parameter]) -> list[Parameter]:
    """The parameters with priors so wide that a wrong one does not bias the timing."""
    return [p if p.log else replace(p, sd=WIDE_SD * abs(p.mean)) for p in parameters]


def _delayed(chain: CutChain) -> bool:
    """Whether the voltage is late by a sample or more: the rest of its delay would look like an early duty."""
    def misfit(values: dict[str, float]) -> float:
        return sum(float(np.mean(r * r)) for r in chain.actuator_residuals(values).values())

    return misfit({DELAY: chain.likeliest_delay({})}) < misfit({})
