# SPDX-License-Identifier: Apache-2.0
"""The hypotheses: each effect of the catalogue, or one number that is off; where searches begin, what each changes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from aeropend_ident.diagnosis.chain.chain import BLOCKS, PLACE_OF_NUMBER, Chains
from aeropend_ident.diagnosis.chain.priors import initial_unknowns
from aeropend_ident.estimation.map_fit import Unknown
from aeropend_sim.model.effects import CATALOGUE, PARAMETER_MISMATCH
from aeropend_sim.model.parameters import PARAMETERS, Model

MISMATCH_SD = 0.3
"""As `NUMBER_SD`, for the number that `parameter_mismatch` blames."""

EFFECT_ODDS = 1.0 / 50.0
"""Prior odds of one given effect against none further; `parameter_mismatch` shares them among its numbers."""


@dataclass(frozen=True)
class Hypothesis:
    """One effect of the catalogue, or one number that is off.

    Attributes:
        effect: id. number: the number blamed, for `parameter_mismatch`.
        starts: where searches begin, each the effect's own unknowns.
    """

    effect: str
    number: str = ""
    starts: tuple[tuple[Unknown, ...], ...] = ()

    @property
    def name(self) -> str:
        """A name that no other hypothesis has."""
        return f"{self.effect}:{self.number}" if self.number else self.effect

    @property
    def place(self) -> str:
        """Where in the chain it lives."""
        return PLACE_OF_NUMBER[self.number] if self.number else CATALOGUE[self.effect].place


def hypotheses(model: Model, *, numbers: bool = True) -> list[Hypothesis]:
    """Every effect of the catalogue that the model lacks, and every of its `numbers` as a mismatch."""
    all_ = [Hypothesis(id_, starts=tuple(_starts(id_))) for id_ in CATALOGUE if id_ not in model.effects]
    if not numbers:
        return all_
    for block in BLOCKS.values():
        for name in block:
            nominal = model.model[name]
            if nominal != 0.0:
                p = PARAMETERS[f"model.{name}"]
                unknown = Unknown(name, nominal, MISMATCH_SD * abs(nominal), p.low, p.high, start=1.1 * nominal)
                all_.append(Hypothesis(PARAMETER_MISMATCH, name, ((unknown,),)))
    return all_


def _starts(id_: str) -> Iterable[tuple[Unknown, ...]]:
    """Searches for an effect: its size from a third of the default, each other parameter from several places."""
    effect = CATALOGUE[id_]
    size = effect.parameters[effect.size]
    step = size.default - size.neutral
    head = Unknown(f"{id_}.{effect.size}", size.neutral, 3.0 * abs(step), size.low, size.high,
                   start=size.neutral + 0.3 * step)
    others = [(name, p) for name, p in effect.parameters.items() if name != effect.size]
    if not others:
        return [(head,)]
    grids: list[list[Unknown]] = []
    for name, p in others:
        full = f"{id_}.{name}"
        if p.low > 0.0:
            spread = 0.5 * math.log(p.high / p.low)
            places = [p.default * math.exp(f * spread) for f in (-0.7, -0.35, 0.0, 0.35, 0.7)]
            grids.append([Unknown(full, p.default, 0.6 * spread, p.low, p.high, min(max(x, p.low), p.high), log=True)
                          for x in places])
        else:
            middle, half = 0.5 * (p.low + p.high), 0.5 * (p.high - p.low)
            grids.append([Unknown(full, middle, half, p.low, p.high, middle + f * half) for f in (-0.6, 0.05, 0.65)])
    # the second parameter is searched, any third starts in its middle
    return [(head, first, *(g[len(g) // 2] for g in grids[1:])) for first in grids[0]]


def blocks_of(chains: Chains, hypothesis: Hypothesis) -> tuple[str, ...]:
    """The parts of the cut chain whose readings a hypothesis changes, found by trying it."""
    values: dict[str, float]
    if hypothesis.number:
        values = {hypothesis.number: 1.2 * chains.model.model[hypothesis.number]}
    else:
        values = {f"{hypothesis.effect}.{k}": p.default for k, p in CATALOGUE[hypothesis.effect].parameters.items()}
    changed = []
    for block in BLOCKS:
        # an arm that nothing drives must at least be let go
        state = {u.name: u.mean for u in initial_unknowns(chains, block)} if chains.fit_nominal else {}
        before, after = chains.residuals(block)(state), chains.residuals(block)({**state, **values})
        if any(len(r) and not np.array_equal(r, after[k]) and not (
                chains.fit_nominal and np.allclose(r, after[k], rtol=0.0, atol=1e-6)) for k, r in before.items()):
            changed.append(block)
    return tuple(changed)


def linear_unknowns(id_: str) -> list[Unknown]:
    """Two unknowns in which an effect is linear, in place of its size and second parameter; both 0 without it."""
    size, second = list(CATALOGUE[id_].parameters.values())[:2]
    if CATALOGUE[id_].linear_in == "polar":
        return [Unknown(f"{id_}.cosine", 0.0, 3.0 * size.default), Unknown(f"{id_}.sine", 0.0, 3.0 * size.default)]
    return [Unknown(f"{id_}.slope", 0.0, 3.0 * size.default, size.low, size.high),
            Unknown(f"{id_}.product", 0.0, 3.0 * size.default * second.default)]


def from_linear(id_: str, values: Mapping[str, float]) -> dict[str, float]:
    """Values with the unknowns of `linear_unknowns` turned into the effect's own parameters."""
    (size_name, size), (second_name, _) = list(CATALOGUE[id_].parameters.items())[:2]
    own = dict(values)
    if CATALOGUE[id_].linear_in == "polar":
        x, y = own.pop(f"{id_}.cosine"), own.pop(f"{id_}.sine")
        pair = math.hypot(x, y), math.atan2(y, x)
    else:
        x, y = own.pop(f"{id_}.slope"), own.pop(f"{id_}.product")
        x = max(x, 1e-6 * size.default)  # so that the product alone can act
        pair = x, y / x
    own[f"{id_}.{size_name}"], own[f"{id_}.{second_name}"] = pair
    return own


def log_odds(hypothesis: Hypothesis) -> float:
    """Prior log odds of a hypothesis against none further."""
    return math.log(EFFECT_ODDS / (sum(map(len, BLOCKS.values())) if hypothesis.number else 1))
