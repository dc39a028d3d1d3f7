# SPDX-License-Identifier: Apache-2.0
"""When a duty begins to act: at the sample that first reports it, or half a period before.

A phase-correct PWM is sampled at the bottom of its count and takes a new duty at the top (ATmega2560 data sheet,
17.9.4), so a sample reports a duty that has been acting for half a period, and will be for another half. The voltage,
read at the same instants, does not show it; the current in between does. This is a matter of the board, not a gap of
the model: it is told from the recording before effects are looked for, and given to the model as a `command_delay`
below zero.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import DELAY, Chain, Chains
from aeropend_ident.diagnosis.chain.priors import initial_unknowns, number_unknowns
from aeropend_ident.diagnosis.search.hypotheses import MISMATCH_SD
from aeropend_ident.estimation.map_fit import Unknown, fit
from aeropend_sim.model.parameters import Model

Array = NDArray[np.float64]

HINT, CERTAIN = 0.3, 0.6
"""Share of an early duty's mark on the current that makes it worth a closer look, and that leaves no doubt."""


def timed(chains: Chains) -> Chains:
    """The chains, with the duty acting half a period earlier where the current says that it does."""
    model = chains.model
    if "command_delay" in model.effects or not all(s.has("v_a") and s.has("i_a") for _, s in chains.named()):
        return chains
    lead = 0.5 * chains.each[0].signals.period
    note = (f"the duty acts {1e3 * lead:.2f} ms before the sample that first reports it, as a phase-correct PWM takes "
            f"it: the model is given a command_delay of {-1e3 * lead:.2f} ms")
    early = _copy(chains, model.with_effects({**model.effects, "command_delay": {"delay": -lead}}), note)
    if mark(chains, early, {}) < HINT:
        return chains
    at_sample = _copy(chains, model)
    described = fit(chains.residuals("actuator"), _free(number_unknowns(chains, "actuator")))
    at_sample.feed_next("actuator", described.values)
    early.feed_next("actuator", described.values)
    values = fit(at_sample.residuals("motor"), [*initial_unknowns(chains, "motor"),
                                                *_free(number_unknowns(chains, "motor"))]).values
    if mark(at_sample, early, values) < CERTAIN or any(_delayed(chain) for chain in chains.each):
        return chains
    return _copy(chains, early.model, note)


def mark(at_sample: Chains, early: Chains, values: dict[str, float]) -> float:
    """How much of what an early duty would do to the current is in it, least squares: about 0 or about 1.

    Both are taken against the mean of their neighbours in time, where hardly anything else leaves a trace.
    """
    expected, seen = [], []
    for k, (chain, other) in enumerate(zip(at_sample.each, early.each, strict=True)):
        own = at_sample.own(values, k)
        current = chain.motor(own)[0]
        expected.append(_against_neighbours(other.motor(own)[0] - current))
        seen.append(_against_neighbours(chain.signals.i_a - current))
    x, y = np.concatenate(expected), np.concatenate(seen)
    known = np.isfinite(y)
    power = float(x[known] @ x[known])
    return float(x[known] @ y[known]) / power if power > 0.0 else 0.0


def _against_neighbours(x: Array) -> Array:
    return x[1:-1] - 0.5 * (x[2:] + x[:-2])


def _copy(chains: Chains, model: Model, *notes: str) -> Chains:
    signals = [replace(s, notes=(*s.notes, *notes)) for s in chains.recordings]
    return Chains(model, signals, fit_nominal=chains.fit_nominal)


def _free(numbers: list[Unknown]) -> list[Unknown]:
    """Numbers that may be far off, lest a wrong one speaks for a wrong time."""
    return [u if u.log else replace(u, sd=MISMATCH_SD * abs(u.mean)) for u in numbers]


def _delayed(chain: Chain) -> bool:
    """Whether the voltage comes late by a sample or more: then the part of a period beyond looks like an early duty."""
    def misfit(values: dict[str, float]) -> float:
        return sum(float(np.mean(r * r)) for r in chain.actuator_residuals(values).values())

    return misfit({DELAY: chain.likeliest_delay({})}) < misfit({})
