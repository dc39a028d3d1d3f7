# SPDX-License-Identifier: Apache-2.0
"""The verdict as one sentence, and how far the gap closes as a second one; neither contradicts the numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from aeropend_ident.diagnosis.document import CANNOT_TELL, ClosedGap, Closure, DiagnosisDocument, Since
from aeropend_ident.diagnosis.policy import GOOD_ENOUGH
from aeropend_ident.diagnosis.report.number_format import percent, quantity
from aeropend_sim.model.effects import DEFINED, PARAMETER_MISMATCH, RANDOM
from aeropend_sim.model.parameters import PARAMETERS

CLOSED = 0.9
"""Share of the gap that an effect of the right form closes at least (choice)."""

MOST = 0.5
"""Share of the squared gap above which it mostly does not repeat (derived: half)."""

NONE = 0.005
"""Share of the gap below which none of it is closed (derived: it is 0 % in whole percent)."""

WORTHLESS = 1.0
"""Gap, as a share of the spread, from which a model predicts nothing (derived: that of constant readings)."""

SAME_END = 1e-3
"""Width of the interval of a share below which the interval is not shown (derived: its ends would be the same text)."""

Closing = Literal["nothing open", "most", "part", "none"]
"""How far a gap closes, in words."""


@dataclass(frozen=True)
class Part:
    """A part of a sentence; `code`: whether it is a name that is set as code."""

    text: str
    code: bool = False


def closing(gap: ClosedGap) -> Closing:
    """How far a gap closes; what is left within the noise of the readings counts as closed."""
    if gap.closed is None:
        return "nothing open"
    if gap.closed >= CLOSED or (gap.closed >= NONE and gap.gap_after <= GOOD_ENOUGH * gap.floor):
        return "most"
    return "part" if gap.closed >= NONE else "none"


def open_part(gap: Closure) -> str:
    """How much of a gap stays open, in words: of the squared one, as shares of effects are, if that is known."""
    if closing(gap) != "part":
        return "all of the gap"
    if gap.budget is not None:
        return f"{percent(1.0 - gap.budget.found)} of the squared gap"
    return f"{percent(1.0 - (gap.closed or 0.0))} of the gap"


def failed(document: DiagnosisDocument) -> str:
    """Why the models of a diagnosis are of no use, as a sentence; "" if they are."""
    if document.which.verdict == CANNOT_TELL:
        return "This diagnosis has no verdict. Use neither its numbers nor its augmented model."
    advice = ("" if document.identified else " Check the model file, and the unit, sign and zero of the angle; if "
              "the parameters of the rig are not known, use --uncalibrated.")
    budget = document.closure.budget
    if (advice and document.which.verdict == "none" and closing(document.closure) == "none"
            and not (budget is not None and budget.not_repeatable > MOST)):
        return f"No effect of the catalogue brings the model closer to the rig.{advice}"
    if document.closure.gap_after >= WORTHLESS:
        return ("The augmented model is off by as much as the readings vary, or by more: it predicts no more than "
                f"constant readings do.{advice}")
    return ""


def verdict(document: DiagnosisDocument) -> list[Part]:
    """The verdict as one sentence."""
    which, reached = document.which, closing(document.closure)
    effects = [e for e in which.effects if e != PARAMETER_MISMATCH]
    parameters = _parameters(document)
    open_ = open_part(document.closure)
    if which.verdict == CANNOT_TELL:
        reason = _reason(which.unexplained)[0]
        return [Part(f"Cannot tell: {reason}." if reason else "Cannot tell which effect the model lacks.")]
    if document.since is not None and which.verdict != "unknown":
        return _since(document.since)
    quiet = "; the gap is within the noise of the readings." if reached == "nothing open" else "."
    if which.verdict == "unknown":
        beside = [Part(", beside "), *listed([*effects, *parameters])] if effects or parameters else []
        return [Part("The model lacks an effect that the catalogue does not contain, at this place: "
                     f"{document.where.place}"), *beside, Part(quiet)]
    if not effects and not parameters:
        budget = document.closure.budget
        if reached in ("nothing open", "most"):
            return [Part("The model lacks nothing that this recording shows.")]
        if budget is not None and budget.not_repeatable > MOST:
            return [Part(f"No effect was found, but {open_} stays open; {percent(budget.not_repeatable)} is no "
                         "function of duty and state.")]
        return [Part(f"No effect was surely found, but {open_} stays open.")]
    if reached == "none" and not set(effects) <= RANDOM:
        several = len(effects) + len(parameters) > 1
        return [*listed([*effects, *parameters]), Part(f" {'fit' if several else 'fits'} the fitted part of the "
                f"recording, but {'close' if several else 'closes'} none of the gap on held-out data.")]
    left = f"; {open_} stays open." if reached in ("part", "none") else quiet
    return [*_claim(effects, parameters, complete=left == "."), Part(left)]


def _since(since: Since) -> list[Part]:
    """What has changed since earlier verdicts."""
    if not since.claimed:
        return [Part(f"Nothing has changed since {since.named} that this recording shows.")]
    return [Part(f"Since {since.named}, this has changed: "), *listed(since.claimed), Part(".")]


def _claim(effects: Sequence[str], parameters: Sequence[str], *, complete: bool) -> list[Part]:
    """What the model lacks, without the full stop; `complete`: whether it explains all of the gap."""
    off = f" {'is' if len(parameters) == 1 else 'are'} off"
    if not effects:
        meanings = dict.fromkeys(PARAMETERS[f"model.{name}"].description.partition(":")[0] for name in parameters)
        right = [Part("The structure of the model is right, but ")] if complete else []
        return [*right, *listed(parameters), Part(f" ({' and '.join(meanings)}){off}")]
    count = f"{len(effects)} effects: " if len(effects) > 1 else ""
    sentence = [Part(f"The model lacks {count}"), *listed(effects)]
    if parameters:
        return [*sentence, Part(", and "), *listed(parameters), Part(off)]
    if len(effects) == 1 and complete:
        return [*sentence, Part(f": {DEFINED[effects[0]].physics.partition(': ')[0]}")]
    return sentence


def consequence(document: DiagnosisDocument) -> str:
    """How far the gap closes, in one or two sentences; if there is no verdict, why."""
    which, closure = document.which, document.closure
    if which.verdict == CANNOT_TELL:
        return _reason(which.unexplained)[1]
    if closure.closed is None:
        return f"There is nothing to close: the gap is within the noise of the readings.{_tests(document)}"
    it = "it" if len(which.effects) == 1 else "them"
    action = "Refitting the parameters"
    if which.unknown is not None and which.unknown.id and which.verdict == "unknown":
        action = "The term that was learned from the recording"
    elif which.effects and which.verdict == "unknown":
        action = f"Adding {it} and refitting the parameters"
    elif which.effects == (PARAMETER_MISMATCH,):
        action = f"Correcting {'it' if len(_parameters(document)) == 1 else 'them'} and refitting the other parameters"
    elif which.effects:
        action = f"Adding {it} and refitting the parameters"
    held = "the last part of each recording"
    if len(document.bags) == 1:
        held = f"the last {quantity(document.held_out_s[1] - document.held_out_s[0], 's', 2)} of the recording"
    reached = closing(closure)
    amount = "none" if reached == "none" else percent(closure.closed)
    interval = between(closure) if reached != "none" else ""
    text = (f"{action} closes {amount} of the gap{f' ({percent(0.95)} interval {interval})' if interval else ''} on "
            f"held-out data, {held}.")
    if closure.closed < -NONE:
        text += " The gap even grows."
    if reached in ("part", "none") and RANDOM & set(which.effects):
        text += " Random effects can be measured but not predicted, so their part of the gap stays open."
    if reached == "most" and closure.closed < CLOSED:
        text += " What stays open is about as small as the noise of the readings."
    return text + _tests(document)


def between(gap: ClosedGap) -> str:
    """The 95 % interval of a closed share, or ""."""
    if gap.low is None or gap.high is None or gap.high - gap.low <= SAME_END:
        return ""
    return f"{percent(gap.low)} to {percent(gap.high)}"


def _tests(document: DiagnosisDocument) -> str:
    """What test recordings show, as a sentence with a space in front, or ""."""
    tests = document.closure.across
    shares = sorted(t.closed for t in tests if t.closed is not None)
    if not shares:
        return ""
    ends = dict.fromkeys("none" if x < NONE else percent(x) for x in (shares[0], shares[-1]))
    where = "the test recording" if len(tests) == 1 else f"{len(tests)} test recordings"
    return f" On {where}, which no fit has used, {' to '.join(ends)} of the gap closes."


def _parameters(document: DiagnosisDocument) -> list[str]:
    """The parameters of the model that are part of the verdict."""
    return [name for c in document.which.candidates if c.found and c.effect == PARAMETER_MISMATCH
            for name in c.parameters]


def _reason(reasons: Sequence[str]) -> tuple[str, str]:
    """The first clause of a reason, and the rest as sentences."""
    first, _, rest = "; ".join(reasons).partition(": ")
    sentences = [f"{s[:1].upper()}{s[1:]}." for s in rest.split("; ") if s]
    return first, " ".join(sentences)


def listed(names: Sequence[str]) -> list[Part]:
    """Names as parts of a sentence, as in: a, b and c."""
    parts = [Part(names[0], code=True)]
    for name in names[1:-1]:
        parts += [Part(", "), Part(name, code=True)]
    return [*parts, Part(" and "), Part(names[-1], code=True)] if len(names) > 1 else parts
