# SPDX-License-Identifier: Apache-2.0
"""The section on the effects: the candidates, the pairs that stay open, and the next experiment."""

from __future__ import annotations

from dataclasses import dataclass

from aeropend_ident.diagnosis.document import Candidate, DiagnosisDocument, Interval, NextExperiment
from aeropend_ident.diagnosis.report.number_format import interval, minus, percent, with_unit
from aeropend_ident.diagnosis.report.sentence import SAME_END
from aeropend_sim.model.effects import CATALOGUE, PARAMETER_MISMATCH
from aeropend_sim.model.parameters import PARAMETERS

PROBABLE = 0.01
"""Probability from which a candidate is always visible (choice)."""


@dataclass(frozen=True)
class Estimate:
    """A parameter of an effect, as texts: its name, its value with the unit, and the interval."""

    name: str
    value: str
    between: str


@dataclass(frozen=True)
class CandidateRow:
    """A candidate as it is shown.

    Attributes:
        effect: its id.
        parameter: of the model, if that is what is off; "" for an effect.
        place: where it acts.
        physics: what it is, in words.
        probability: [0..1] among its rivals.
        estimates: of its parameters.
        gap_after: [share of the spread] total gap with it; None if it was not computed.
        found: whether it is part of the verdict.
        share: of the gap, as a text; "" if it is not in the augmented model.
        when: it begins or ends, as a text; "" if it acts all the time.
    """

    effect: str
    parameter: str
    place: str
    physics: str
    probability: float
    estimates: list[Estimate]
    gap_after: float | None
    found: bool
    share: str
    when: str

    @property
    def name(self) -> str:
        """The parameter or the effect."""
        return self.parameter or self.effect


@dataclass(frozen=True)
class Candidates:
    """The content of the section.

    Attributes:
        shown: rows that are always visible.
        others: rows that a click shows.
        not_separable: pairs of names.
        advice: the next experiment.
    """

    shown: list[CandidateRow]
    others: list[CandidateRow]
    not_separable: list[tuple[str, str]]
    advice: NextExperiment | None


def unit_of(effect: str, parameter: str) -> str:
    """Unit of a parameter of a candidate; "-" for none.

    Args:
        effect: id of the effect, or "parameter_mismatch".
        parameter: of the effect, or of the model.
    """
    if effect == PARAMETER_MISMATCH:
        return PARAMETERS[f"model.{parameter}"].unit
    return CATALOGUE[effect].parameters[parameter].unit


def share_text(share: Interval) -> str:
    """A share of the gap with its 95 % interval: `62 % (55 % to 70 %)`."""
    if share.high - share.low <= SAME_END:
        return percent(share.value)
    return f"{percent(share.value)} ({percent(share.low)} to {percent(share.high)})"


def open_pairs(document: DiagnosisDocument) -> list[tuple[str, str]]:
    """The pairs of hypotheses that stay open and concern the verdict: one of the two is part of it."""
    which = document.which
    claimed = {c.effect for c in which.candidates if c.found}
    claimed |= {f"{c.effect}:{name}" for c in which.candidates if c.found for name in c.parameters}
    return [pair for pair in which.not_separable if claimed & set(pair)]


def rows(document: DiagnosisDocument) -> list[CandidateRow]:
    """All candidates."""
    return [_row(c) for c in document.which.candidates]


def section(document: DiagnosisDocument, candidates: list[CandidateRow]) -> Candidates:
    """The content of the section.

    Args:
        document: of the diagnosis.
        candidates: all rows.
    """
    shown = [c for c in candidates if c.found or c.share or c.probability >= PROBABLE]
    others = [c for c in candidates if c not in shown]
    return Candidates(shown, others, open_pairs(document),
                      document.which.next_experiment)


def _row(c: Candidate) -> CandidateRow:
    parameter = next(iter(c.parameters), "") if c.effect == PARAMETER_MISMATCH else ""
    estimates = []
    for name, q in c.parameters.items():
        value, between = interval(q.value, q.low, q.high)
        estimates.append(Estimate(name, with_unit(value, unit_of(c.effect, name)), between))
    physics = minus(f"{PARAMETERS[f'model.{parameter}'].description}; its value is off" if parameter
                    else CATALOGUE[c.effect].physics)
    return CandidateRow(c.effect, parameter, c.place, physics, c.probability, estimates, c.gap_after, c.found,
                        share_text(c.share) if c.share else "", _when(c))


def _when(c: Candidate) -> str:
    """When a candidate begins or ends."""
    texts = []
    for word, t in (("begins", c.since), ("ends", c.until)):
        if t is not None:
            value, between = interval(t.value, t.low, t.high)
            texts.append(f"{word} at {with_unit(value, 's')} ({between})")
    return ", ".join(texts)
