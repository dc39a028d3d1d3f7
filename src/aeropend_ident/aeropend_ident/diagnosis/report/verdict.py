# SPDX-License-Identifier: Apache-2.0
"""The head of the page: the verdict as a sentence, and a line for each effect found."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from aeropend_ident.diagnosis.document import CANNOT_TELL, DiagnosisDocument
from aeropend_ident.diagnosis.report import sentence
from aeropend_ident.diagnosis.report.candidates import CandidateRow
from aeropend_ident.diagnosis.report.number_format import exact, with_unit
from aeropend_ident.diagnosis.report.sentence import Part
from aeropend_sim.model.parameters import PARAMETERS


@dataclass(frozen=True)
class Line:
    """An effect found; `nominal`: nominal value of a parameter that is off, with its unit, or ""."""

    candidate: CandidateRow
    nominal: str


@dataclass(frozen=True)
class Verdict:
    """The content of the head.

    Attributes:
        title: of the page.
        failed: why the models are of no use, or "".
        sentence: the verdict.
        consequence: how far the gap closes, as a sentence.
        lines: the effects found.
        between: the 95 % interval of the closed share, or "".
        besides: place of an unknown effect beside the effects found, or "".
        small: effects that were found and are not claimed: see `why_lost`.
        unexplained: reasons for the verdict "unknown".
    """

    title: str
    failed: str
    sentence: list[Part]
    consequence: str
    lines: list[Line]
    between: str
    besides: str
    small: list[CandidateRow]
    unexplained: tuple[str, ...]


def section(document: DiagnosisDocument, candidates: Sequence[CandidateRow]) -> Verdict:
    """The content of the head.

    Args:
        document: of the diagnosis.
        candidates: all rows.
    """
    which = document.which
    found = sorted((c for c in candidates if c.found), key=lambda c: which.effects.index(c.effect))
    unknown = which.unknown
    return Verdict(_title(document), sentence.failed(document), sentence.verdict(document),
                   sentence.consequence(document), [Line(c, _nominal(document, c)) for c in found],
                   sentence.between(document.closure),
                   unknown.place if unknown and which.verdict not in ("unknown", CANNOT_TELL) else "",
                   [c for c in candidates if c.share and not c.found],
                   which.unexplained if which.verdict == "unknown" else ())


def _title(document: DiagnosisDocument) -> str:
    which = document.which
    found = {"none": "nothing missing", "unknown": "unknown effect", CANNOT_TELL: "cannot tell"}.get(
        which.verdict, ", ".join(which.effects))
    return f"{found} · diagnose"


def _nominal(document: DiagnosisDocument, candidate: CandidateRow) -> str:
    if not candidate.parameter:
        return ""
    row = document.which.numbers.get(candidate.parameter)
    return with_unit(exact(row.nominal if row else math.nan), PARAMETERS[f"model.{candidate.parameter}"].unit)
