# SPDX-License-Identifier: Apache-2.0
"""Rules that a verdict must keep, for a machine that decides by it: `diagnose --fail-on RULE`, `--junit FILE`."""

from __future__ import annotations

import difflib
import operator
import re
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from aeropend_ident.diagnosis.document import CANNOT_TELL, DiagnosisDocument
from aeropend_ident.result_folder import OutputError
from aeropend_sim.errors import UserError
from aeropend_sim.model.effects import DEFINED, PARAMETER_MISMATCH
from aeropend_sim.untrusted import printable

NUMBERS = {"gap": "gap of the nominal model on held-out data, over the spread of the signals",
           "gap_after": "the same of the augmented model", "closed": "share of the gap that closes",
           "share": "share of the squared gap of any effect that is claimed"}
"""What a rule may compare with a number."""

STATES = {"effect": "an effect is claimed, or something unknown is there", "unknown": "the verdict is unknown",
          "cannot_tell": "the verdict is cannot_tell", "not_separable": "the recording cannot separate two hypotheses",
          "not_determined": "a parameter of an uncalibrated rig is not determined"}
"""What a rule may name alone."""

_RULE = re.compile(r"\s*(\w+)\s*(?:([<>])\s*([0-9.eE+-]+)\s*(%?)\s*)?")


class RuleError(UserError):
    """A rule that cannot be used. The message is one line."""


@dataclass(frozen=True)
class Rule:
    """A rule: it is broken where its condition holds.

    Attributes:
        text: as it was given.
        name: one of `NUMBERS` or `STATES`, or the id of an effect.
        sign: `<` or `>`; "" for a state, or for an effect that must not be claimed at all.
        limit: what the number is compared with; a share.
    """

    text: str
    name: str
    sign: str = ""
    limit: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """What a rule says of one recording, or of those that were fitted together.

    Attributes:
        recording: name.
        rule: text of the rule.
        found: what there is, in words.
        broken: whether the rule is broken.
        error: why there is no verdict; "" if there is one.
    """

    recording: str
    rule: str
    found: str = ""
    broken: bool = False
    error: str = ""


def parse(text: str) -> Rule:
    """Read a rule.

    Args:
        text: `gap>0.05`, `closed<90%`, `coulomb_friction>10%`, `coulomb_friction`, `unknown`.

    Raises:
        RuleError: it is none.
    """
    match = _RULE.fullmatch(text)
    if match is None:
        raise RuleError(f"--fail-on {printable(text)}: not a rule; write gap>5%, coulomb_friction>10% or unknown")
    name, sign, number, percent = match.groups()
    known = [*NUMBERS, *STATES, *DEFINED, PARAMETER_MISMATCH]
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        raise RuleError(f"--fail-on {printable(text)}: '{name}' is not known; "
                        + (f"did you mean {near[0]}?" if near else f"known: {', '.join([*NUMBERS, *STATES])}, "
                           "and the ids of effects"))
    if sign is None:
        if name in NUMBERS:
            raise RuleError(f"--fail-on {name}: compare it with a number, as in {name}>5%")
        return Rule(text, name)
    if name in STATES:
        raise RuleError(f"--fail-on {printable(text)}: {name} is or is not; leave the number out")
    try:
        limit = float(number) / (100.0 if percent else 1.0)
    except ValueError:
        raise RuleError(f"--fail-on {printable(text)}: '{number}' is not a number") from None
    return Rule(text, name, sign, limit)


def check(document: DiagnosisDocument, rules: Sequence[Rule]) -> list[Outcome]:
    """What rules say of a verdict.

    Args:
        document: of the verdict. Of several recordings, a gap is the worst of those fitted and of those tested on.
        rules: the rules.
    """
    name = ", ".join(document.bags)
    return [Outcome(name, rule.text, *_of(document, rule)) for rule in rules]


def _of(document: DiagnosisDocument, rule: Rule) -> tuple[str, bool]:
    """What there is, and whether the rule is broken."""
    which = document.which
    if rule.name in STATES:
        states = {"effect": which.verdict not in ("none", CANNOT_TELL), "unknown": which.verdict == "unknown",
                  "cannot_tell": which.verdict == CANNOT_TELL, "not_separable": bool(which.not_separable),
                  "not_determined": bool(document.identified and document.identified.not_determined)}
        more = {"not_separable": ", ".join(" and ".join(pair) for pair in which.not_separable),
                "not_determined": ", ".join(document.identified.not_determined) if document.identified else ""}
        return more.get(rule.name) or f"the verdict is {which.verdict}", states[rule.name]
    shares: dict[str, float] = {}
    for c in which.candidates:
        if c.found:
            shares[c.effect] = shares.get(c.effect, 0.0) + (c.share.value if c.share else 1.0)
    if rule.name in NUMBERS:
        runs = (document.closure, *document.closure.across)
        values = {"gap": [run.gap for run in runs], "gap_after": [run.gap_after for run in runs],
                  "closed": [run.closed for run in runs if run.closed is not None],
                  "share": list(shares.values())}[rule.name]
        if not values:
            return "there is nothing to close" if rule.name == "closed" else "no effect is claimed", False
        value = min(values) if rule.sign == "<" else max(values)
    elif not rule.sign:
        return (f"it is claimed, with {100.0 * shares[rule.name]:.3g} % of the squared gap" if rule.name in shares
                else "it is not claimed"), rule.name in shares
    else:
        value = shares.get(rule.name, 0.0)
    return f"it is {100.0 * value:.3g} %", {"<": operator.lt, ">": operator.gt}[rule.sign](value, rule.limit)


def summary(outcomes: Sequence[Outcome]) -> str:
    """All outcomes in one line."""
    broken = [one for one in outcomes if one.broken]
    failed = len({one.recording for one in outcomes if one.error})
    several = len({one.recording for one in outcomes}) > 1
    told = [f"{one.recording}: " * several + f"{one.rule} ({one.found})" for one in broken]
    left = f"; {failed} without a verdict" if failed else ""
    checked = [one for one in outcomes if not one.error]
    if not broken and not failed:
        return f"check: passed, {len(checked)} of {len(checked)} rules kept"
    what = ": " * bool(told) + "; ".join(told)
    return printable(f"check: failed, {len(broken)} of {len(checked)} rules broken{what}{left}")


def write_junit(path: Path, outcomes: Sequence[Outcome]) -> None:
    """Write outcomes as JUnit XML, a test case each, for servers that show tests.

    Args:
        path: the file; it is replaced.
        outcomes: of all rules and recordings.

    Raises:
        OutputError: it cannot be written.
    """
    broken, errors = sum(one.broken for one in outcomes), sum(bool(one.error) for one in outcomes)
    suite = ET.Element("testsuite", name="diagnose", tests=str(len(outcomes)), failures=str(broken), errors=str(errors))
    for one in outcomes:
        case = ET.SubElement(suite, "testcase", classname=printable(one.recording), name=printable(one.rule))
        if one.error:
            ET.SubElement(case, "error", message=printable(one.error))
        elif one.broken:
            ET.SubElement(case, "failure", message=printable(f"{one.rule}: {one.found}"))
        else:
            ET.SubElement(case, "system-out").text = printable(one.found)
    root = ET.Element("testsuites")
    root.append(suite)
    ET.indent(root)
    try:
        path.write_bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True) + b"\n")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from None
