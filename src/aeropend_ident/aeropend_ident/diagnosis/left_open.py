# SPDX-License-Identifier: Apache-2.0
"""What a verdict leaves open, as the question of the next experiment."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace

from aeropend_ident.diagnosis.document import Candidate, DiagnosisDocument
from aeropend_sim.model.effect_file import BUILT_IN
from aeropend_sim.model.effects import DEFINED, PARAMETER_MISMATCH, RANDOM
from aeropend_sim.model.parameters import Model


@dataclass(frozen=True)
class Open:
    """What a verdict leaves open.

    Attributes:
        names: of the hypotheses that are not told apart; none: nothing certain is known, or nothing is open.
        sizes: effect -> its size in the verdict, as a distance from the neutral one.
        rival: probability of the likeliest of them that is not the first.
    """

    names: tuple[str, ...]
    sizes: Mapping[str, float]
    rival: float


def left_open(document: DiagnosisDocument) -> Open:
    """What a verdict leaves open.

    Args:
        document: of the diagnosis.
    """
    which = document.which
    named = dict.fromkeys(name for pair in which.not_separable for name in pair)
    names: dict[str, None] = {}
    sizes: dict[str, float] = {}
    for c in which.candidates:
        own = _name(c)
        if c.effect not in named and own not in named:
            continue
        if c.effect == PARAMETER_MISMATCH or (c.effect in DEFINED and c.effect not in RANDOM):
            names[own] = None
        if c.effect in DEFINED and not c.form and c.effect != PARAMETER_MISMATCH:
            size = DEFINED[c.effect].size
            neutral = DEFINED[c.effect].parameters[size].neutral
            if size in c.parameters and c.parameters[size].value != neutral:
                sizes[c.effect] = abs(c.parameters[size].value - neutral)
    likely = sorted((c.probability for c in which.candidates if _name(c) in names), reverse=True)
    return Open(tuple(names), sizes, likely[1]) if len(likely) > 1 else Open((), {}, 0.0)


def as_refitted(model: Model, document: DiagnosisDocument) -> Model:
    """A model with what a verdict is sure of: its numbers as they were refitted, and the effects without a rival.

    Args:
        model: the nominal model of the verdict.
        document: of the diagnosis.
    """
    numbers = {n: row.value for n, row in document.which.numbers.items() if n in model.model}
    open_ = left_open(document).names
    sure = {}
    for c in document.which.candidates:
        if c.found and c.law in DEFINED and c.effect not in (*open_, *RANDOM, PARAMETER_MISMATCH):
            rest = DEFINED[c.law].defaults
            sure[c.law] = {**rest, **{n: x.value for n, x in c.parameters.items() if n in rest}}
    return replace(model, model={**model.model, **numbers}).with_effects({**model.effects, **sure})


def design_command(document: DiagnosisDocument) -> str:
    """The command that designs an experiment for what a verdict leaves open; "" if nothing is, or no signal helps.

    An uncalibrated rig has no model file with which an experiment could be designed, nor has a rig that was compared
    with earlier verdicts. An effect of a file is not known to the command.

    Args:
        document: of the diagnosis.
    """
    names, advice = left_open(document).names, document.which.next_experiment
    if document.identified is not None or document.since is not None:
        return ""
    if not names or advice is None or not advice.excite:
        return ""
    if not {name.partition(":")[0] for name in names} <= BUILT_IN | {PARAMETER_MISMATCH}:
        return ""
    return shlex.join(["design", "--model", document.model, "--separate", *names])


def _name(c: Candidate) -> str:
    """The unique name of a candidate: that of its hypothesis."""
    return f"{c.effect}:{next(iter(c.parameters))}" if c.effect == PARAMETER_MISMATCH and c.parameters else c.effect
