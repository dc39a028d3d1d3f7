# SPDX-License-Identifier: Apache-2.0
"""The head of the page: the verdict as a sentence, and a line for each effect found."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from aeropend_ident.diagnosis.document import CANNOT_TELL, DiagnosisDocument
from aeropend_ident.diagnosis.report.candidates import SAME_END, CandidateRow
from aeropend_ident.diagnosis.report.number_format import exact, percent, quantity, with_unit
from aeropend_sim.model.parameters import PARAMETERS

RANDOM = {"gust", "speed_spikes"}
"""Effects that are random: no model predicts them, so their gap stays open."""

MOSTLY_OPEN = 0.5
"""Share of the gap below which the page explains why a random effect leaves the rest open (choice)."""


@dataclass(frozen=True)
class Part:
    """A part of a sentence; `code`: whether it is a name that is set as code."""

    text: str
    code: bool = False


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
        sentence: the verdict.
        consequence: how far the gap closes, as a sentence.
        lines: the effects found.
        between: the 95 % interval of the closed share, or "".
        besides: place of an unknown effect beside the effects found, or "".
        small: effects whose share of the gap is too small, or too unsure, to be claimed.
        unexplained: reasons for the verdict "unknown".
    """

    title: str
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
    return Verdict(_title(document), _sentence(document, found), _consequence(document, found),
                   [Line(c, _nominal(document, c)) for c in found], _between(document),
                   unknown.place if unknown and which.verdict != "unknown" else "",
                   [c for c in candidates if c.share and not c.found], which.unexplained)


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


def _sentence(document: DiagnosisDocument, found: Sequence[CandidateRow]) -> list[Part]:
    """The verdict."""
    verdict, place = document.which.verdict, document.where.place
    effects = [c.effect for c in found if not c.parameter]
    parameters = [c.parameter for c in found if c.parameter]
    are = "is off." if len(parameters) == 1 else "are off."
    if verdict == "none":
        return [Part("The model lacks nothing that this recording shows.")]
    if verdict == CANNOT_TELL:
        return [Part("Cannot tell: the nominal model could not be identified from this recording.")]
    if verdict == "unknown":
        return [Part(f"The model lacks an effect that the catalogue does not contain, at this place: {place}.")]
    if not effects:
        meanings = dict.fromkeys(PARAMETERS[f"model.{name}"].description.partition(":")[0] for name in parameters)
        return [Part("The structure of the model is right, but "), *_listed(parameters),
                Part(f" ({' and '.join(meanings)}) {are}")]
    count = f"{len(effects)} effects: " if len(effects) > 1 else ""
    sentence = [Part(f"The model lacks {count}"), *_listed(effects)]
    if parameters:
        return [*sentence, Part(", and "), *_listed(parameters), Part(f" {are}")]
    return [*sentence, Part(f": {found[0].physics.partition(': ')[0]}." if len(effects) == 1 else ".")]


def _consequence(document: DiagnosisDocument, found: Sequence[CandidateRow]) -> str:
    """How far the gap closes."""
    which, share, (start, stop) = document.which, document.closure.closed, document.held_out_s
    if share is None:
        return "There is nothing to close: the gap is within the noise of the readings."
    it = "it" if len(found) == 1 else "them"
    if which.verdict in ("none", CANNOT_TELL):
        action = "Refitting its parameters"
    elif which.verdict == "unknown":
        action = "Refitting the parameters and adding the effects found" if found else "Refitting the parameters"
    elif all(c.parameter for c in found):
        action = f"Correcting {it} and refitting the other parameters"
    else:
        action = f"Adding {it} and refitting the parameters"
    held = f"the last {quantity(stop - start, 's', 2)} of the recording"
    if len(document.bags) > 1:
        held = "the last part of each recording"
    between = _between(document)
    interval = f" ({percent(0.95)} interval {between})" if between else ""
    text = f"{action} closes {percent(share) if share > 0.0 else 'none'} of the gap{interval} on held-out data, {held}."
    if share < MOSTLY_OPEN and RANDOM & set(which.effects) and which.verdict != "unknown":
        text += " Random effects can be measured but not predicted, so their part of the gap stays open."
    return text


def _between(document: DiagnosisDocument) -> str:
    low, high = document.closure.low, document.closure.high
    if low is None or high is None or high - low <= SAME_END:
        return ""
    return f"{percent(low)} to {percent(high)}"


def _listed(names: Sequence[str]) -> list[Part]:
    """Names as parts of a sentence."""
    parts = [Part(names[0], code=True)]
    for name in names[1:-1]:
        parts += [Part(", "), Part(name, code=True)]
    return [*parts, Part(" and "), Part(names[-1], code=True)] if len(names) > 1 else parts
