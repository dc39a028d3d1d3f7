# SPDX-License-Identifier: Apache-2.0
"""The columns of the live detector: which parameters and effects are told apart, and the model that each needs.

A column is a small change of one parameter of the model or of one effect of the catalogue. Its sensitivity is the
difference of two predictions, that of the model and that of the model with the change, as in the screening of the
diagnosis. So every equation stays in `aeropend_sim.model`.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from aeropend_ident.diagnosis.chain.priors import CHAIN_SD, NOMINAL_SD, usual_size
from aeropend_ident.diagnosis.chain.values import FILTER, PLACE_OF_PARAMETER, STAGES, stage_at, with_values
from aeropend_ident.diagnosis.search.hypotheses import Hypothesis, hypotheses
from aeropend_ident.estimation.parameter import Parameter
from aeropend_sim.model.effects import DEFINED, RANDOM
from aeropend_sim.model.parameters import Model

IMPERFECTION = 0.15
"""Standard deviation of an effect that no rig is quite free of, in usual sizes (choice).

Small effects that are there from the start are learned within it, as parameters are within their tolerance."""

GROWING = frozenset({"supply_drift"})
"""Effects that grow from zero: they have no instant, and the tracking of the numbers shows them."""

LONGEST_DELAY = (0.3, 1.0, 2.0)
"""Delays of the command that are tried, in usual sizes (choice): a step of the duty is late or not, nothing between."""


@dataclass(frozen=True)
class Column:
    """One column of a stage.

    Attributes:
        hypothesis: its name: the id of an effect, or `parameter_mismatch:NAME`.
        place: of the chain.
        stages: of the cut chain that it changes.
        values: what the model has with the change, by name.
        step: the change, in units of the size.
        sd: standard deviation of the size in a rig that has not changed, in units of the size.
        wide: standard deviation of a size that has changed.
        sign: +1 or -1 if a change has this sign only, else 0.
        log_odds: prior log odds of the hypothesis over the number of its columns.
        size: name of the size, as in the model file.
        unit: of the size.
        joint: whether the hypothesis is linear in the sizes of its columns together (`Effect.linear_in`): else they
            are tried one by one.
    """

    hypothesis: str
    place: str
    stages: tuple[str, ...]
    values: tuple[tuple[str, float], ...]
    step: float
    sd: float
    wide: float
    sign: int
    log_odds: float
    size: str
    unit: str
    joint: bool = False

    @property
    def sticks(self) -> bool:
        """Whether it is a dry friction of the arm."""
        return self.effect in DEFINED and DEFINED[self.effect].sticks

    @property
    def effect(self) -> str:
        """Id of the effect."""
        return self.hypothesis.partition(":")[0]

    def model(self, base: Model) -> Model:
        """The model with the change."""
        return with_values(base, dict(self.values))


def stages_of(effect: str) -> tuple[str, ...]:
    """The stages of the cut chain whose residuals an effect changes.

    Args:
        effect: its id.
    """
    e = DEFINED[effect]
    first = stage_at(e.place, e.reading)
    return (first, "motor") if e.reading == "v_a" else (first,)  # the motor is fed with the voltage read


def size_of(columns: Sequence[Column], sizes: Sequence[float]) -> float:
    """Size of an effect from those of its columns, SI.

    Args:
        columns: of one hypothesis: one, or those that are joint.
        sizes: of them.
    """
    if len(columns) == 1 or DEFINED[columns[0].effect].linear_in != "polar":
        return sum(sizes)
    phase = next(name for name, _ in columns[0].values if name != columns[0].size)
    return abs(sum(size * cmath.exp(1j * dict(c.values)[phase]) for c, size in zip(columns, sizes, strict=True)))


def columns(model: Model) -> list[Column]:
    """All columns of a model: its parameters, and the effects that it lacks.

    Args:
        model: the nominal model; its effects stay as they are.
    """
    found = []
    for h in hypotheses(model):
        if h.parameter:
            found.append(_of_parameter(h, h.own[0], model.model[h.parameter]))
        elif h.effect not in RANDOM | GROWING:
            found += _of_effect(h, model)
    tau = model.sensing["angle_filter_tau"]
    if tau > 0.0:
        sd = CHAIN_SD * tau
        found.append(Column("filter", "sensing", ("arm",), ((FILTER, tau + sd),), sd, sd, 0.0, 0, -1e9, FILTER, "s"))
    return found


def _of_parameter(h: Hypothesis, p: Parameter, nominal: float) -> Column:
    step = NOMINAL_SD * nominal
    (stage,) = (stage for stage, names in STAGES.items() if h.parameter in names)
    return Column(h.name, PLACE_OF_PARAMETER[h.parameter], (stage,), ((p.name, nominal + step),), step, abs(step),
                  p.sd, 0, h.log_odds, p.name, "")


def _of_effect(h: Hypothesis, model: Model) -> list[Column]:
    size = DEFINED[h.effect].parameters[DEFINED[h.effect].size]
    usual = usual_size(h.effect, model) - size.neutral
    starts = h.starts
    if h.effect == "command_delay":
        starts = tuple((replace(h.own[0], start=size.neutral + share * usual),) for share in LONGEST_DELAY)
    elif h.effect in ("coulomb_friction", "rotor_friction"):
        starts = h.starts[:1]
    joint = bool(DEFINED[h.effect].linear_in)
    if joint:  # two columns span all values of both parameters
        starts = (h.starts[0], h.starts[-1])
    sign = 1 if size.low >= size.neutral else 0
    return [Column(h.name, h.place, stages_of(h.effect), tuple((p.name, p.begin) for p in own),
                   own[0].begin - size.neutral, IMPERFECTION * abs(usual), own[0].sd, sign,
                   h.log_odds - (0.0 if joint else math.log(len(starts))), own[0].name, size.unit, joint)
            for own in starts]
