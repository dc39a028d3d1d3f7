# SPDX-License-Identifier: Apache-2.0
"""The section on what was tried: each hypothesis, how far it came and why it lost; what stays open; what to record."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import groupby

from aeropend_ident.diagnosis.document import (
    CANNOT_TELL,
    Candidate,
    DiagnosisDocument,
    EffectSet,
    Interval,
    NextExperiment,
)
from aeropend_ident.diagnosis.left_open import design_command
from aeropend_ident.diagnosis.policy import CALIBRATED
from aeropend_ident.diagnosis.report.number_format import interval, minus, percent, probability, quantity, with_unit
from aeropend_ident.diagnosis.report.sentence import NONE, SAME_END
from aeropend_sim.model.effect_file import unit_of as unit_of_term
from aeropend_sim.model.effects import DEFINED, PARAMETER_MISMATCH
from aeropend_sim.model.parameters import PARAMETERS

PROBABLE = 0.01
"""Probability from which a candidate is always visible (choice)."""

AT_LEAST = 5
"""Hypotheses that are visible at least, if there are as many: of the improbable ones those that leave the least gap
(choice)."""

LARGER = 0.05
"""Share by which a gap must be larger than that of the verdict to be called larger (choice)."""

AT_END = 1e-3
"""Share of the end of a range within which a value is at it (choice: a bounded fit stops there)."""


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
        gap_after: [share of the spread] total gap with it; None if it is not known.
        closes: share of the gap that it closes, as a text.
        found: whether it is part of the verdict.
        share: of the gap, as a text; "" if it is not in the augmented model.
        lost: why it is not part of the verdict, as a text; "" if it is.
        when: it begins or ends, as a text; "" if it acts all the time.
    """

    effect: str
    parameter: str
    place: str
    physics: str
    probability: float
    estimates: list[Estimate]
    gap_after: float | None
    closes: str
    found: bool
    share: str
    lost: str
    when: str

    @property
    def name(self) -> str:
        """The parameter or the effect."""
        return self.parameter or self.effect


@dataclass(frozen=True)
class OpenPair:
    """Two hypotheses that the recordings cannot separate: their names, and how close they are, in words."""

    names: tuple[str, str]
    how: str


@dataclass(frozen=True)
class Candidates:
    """The content of the section.

    Attributes:
        shown: rows that are always visible.
        others: rows that a click shows.
        nothing: why nothing was tried; "" if something was.
        not_separable: pairs that concern the verdict.
        sets: the sets of effects of a stage that are likely, a list a stage.
        advice: the next experiment.
        design: the command that designs one; "" if there is none.
    """

    shown: list[CandidateRow]
    others: list[CandidateRow]
    nothing: str
    not_separable: list[OpenPair]
    sets: list[list[EffectSet]]
    advice: NextExperiment | None
    design: str


def unit_of(effect: str, parameter: str) -> str:
    """Unit of a parameter of a candidate; "-" for none.

    Args:
        effect: id of the effect, or "parameter_mismatch".
        parameter: of the effect, or of the model.
    """
    if effect == PARAMETER_MISMATCH:
        return PARAMETERS[f"model.{parameter}"].unit
    return DEFINED[effect].parameters[parameter].unit


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
    return [_row(document, c) for c in document.which.candidates]


def section(document: DiagnosisDocument, candidates: list[CandidateRow]) -> Candidates:
    """The content of the section.

    Args:
        document: of the diagnosis.
        candidates: all rows.
    """
    shown = [c for c in candidates if c.found or c.share or c.probability >= PROBABLE]
    closest = sorted((c for c in candidates if c not in shown), key=_distance)[:max(AT_LEAST - len(shown), 0)]
    shown = [c for c in candidates if c in shown or c in closest]
    others = [c for c in candidates if c not in shown]
    nothing = "" if candidates else (
        "No effect was tried, since the nominal model could not be identified." if document.which.verdict == CANNOT_TELL
        else "No effect was tried: refitted parameters leave too little of the gap.")
    pairs = [OpenPair(pair, _how_close(document, pair)) for pair in open_pairs(document)]
    sets = [list(of_stage) for _, of_stage in groupby(document.which.sets, lambda s: s.stage)]
    return Candidates(shown, others, nothing, pairs, sets, document.which.next_experiment if pairs else None,
                      design_command(document) if pairs else "")


def why_lost(document: DiagnosisDocument, c: Candidate) -> str:
    """Why a hypothesis is not part of the verdict, in a few words; "" if it is.

    Args:
        document: of the diagnosis.
        c: the hypothesis.
    """
    if c.found:
        return ""
    if c.share is not None:
        if c.share.low <= 0.0:
            return "its share of the squared gap is not surely above 0"
        return "its share of the squared gap is too small or too unsure, or other effects could close it"
    reasons = [f"{name} is at the end of its range" for name in _at_an_end(c)]
    if c.behind is not None:
        reasons.append(f"less evidence than {c.behind.rpartition(':')[2]}")
    elif c.evidence is not None and c.evidence <= 0.0:
        reasons.append("no more evidence than without it")
    closure = document.closure
    if c.gap_after is not None and c.gap_after >= closure.gap:
        reasons.append("does not make the gap smaller")
    elif c.gap_after is not None and c.gap_after > (1.0 + LARGER) * max(closure.gap_after, closure.floor):
        reasons.append("leaves a larger gap")
    if document.which.verdict == "unknown" and not reasons:
        reasons.append("leaves a misfit that repeats")
    return "; ".join(reasons) or "too improbable"


def _row(document: DiagnosisDocument, c: Candidate) -> CandidateRow:
    parameter = next(iter(c.parameters), "") if c.effect == PARAMETER_MISMATCH else ""
    estimates = []
    for name, q in c.parameters.items():
        value, between = interval(q.value, q.low, q.high)
        if spread := (c.run_to_run or {}).get(name):
            between += f"; run to run {quantity(spread, digits=2)}"
        estimates.append(Estimate(name, with_unit(value, unit_of(c.law, name)), between))
    physics = minus(f"{PARAMETERS[f'model.{parameter}'].description}; its value is off" if parameter
                    else DEFINED[c.law].physics)
    physics += "".join(f"; {text}" for text in (form_text(c), strength_text(c)) if text)
    return CandidateRow(c.effect, parameter, c.place, physics, c.probability, estimates, c.gap_after,
                        _closes(document, c), c.found, share_text(c.share) if c.share else "", why_lost(document, c),
                        _when(c))


def form_text(c: Candidate) -> str:
    """The form of an effect: `form: ground_effect_rational`, or those that the recording cannot separate."""
    likely = {form: p for form, p in (c.forms or {}).items() if p > CALIBRATED.undecided}
    names = [f"{form} {percent(p)}" for form, p in likely.items()]
    if len(likely) > 1:
        return f"form not separable: {', '.join(names)}"
    return f"form: {c.law}" if c.form else ""


def strength_text(c: Candidate) -> str:
    """The strength of an effect: `its term has 0.81 rad/s² RMS (0.79 to 0.83)`."""
    if c.strength is None:
        return ""
    effect = DEFINED[c.law]
    value, between = interval(c.strength.value, c.strength.low, c.strength.high)
    return f"its term has {with_unit(value, unit_of_term(effect.place, effect.reading))} RMS ({between})"


def _closes(document: DiagnosisDocument, c: Candidate) -> str:
    """The share of the gap that a hypothesis closes, as a text."""
    gap, floor = document.closure.gap, document.closure.floor
    if c.gap_after is None or document.closure.closed is None or not gap > floor:
        return ""
    share = min((gap - c.gap_after) / (gap - floor), 1.0)
    return "closes none" if share < NONE else f"closes {percent(share)}"


def _at_an_end(c: Candidate) -> list[str]:
    """The parameters of an effect that are at an end of their range, apart from the value without the effect."""
    if c.effect == PARAMETER_MISMATCH:
        return []
    known = DEFINED[c.law].parameters
    return [name for name, q in c.parameters.items() for end in (known[name].low, known[name].high)
            if end != known[name].neutral and abs(q.value - end) <= AT_END * abs(end)]


def _how_close(document: DiagnosisDocument, pair: tuple[str, str]) -> str:
    """How close two hypotheses are: probability and gap of each."""
    texts = []
    for name in pair:
        effect, _, parameter = name.partition(":")
        mine = next((c for c in document.which.candidates
                     if c.effect == effect and (not parameter or parameter in c.parameters)), None)
        if mine is not None:
            texts.append(f"{parameter or effect}: probability {probability(mine.probability)}, "
                         f"gap after {percent(mine.gap_after)}")
    return "; ".join(texts)


def _distance(c: CandidateRow) -> float:
    """Sort key: the hypotheses that leave the least gap come first."""
    return math.inf if c.gap_after is None or math.isnan(c.gap_after) else c.gap_after


def _when(c: Candidate) -> str:
    """When a candidate begins or ends."""
    texts = []
    for word, t in (("begins", c.since), ("ends", c.until)):
        if t is not None:
            value, between = interval(t.value, t.low, t.high)
            texts.append(f"{word} at {with_unit(value, 's')} ({between})")
    return ", ".join(texts)
