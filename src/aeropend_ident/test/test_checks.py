# SPDX-License-Identifier: Apache-2.0
"""Rules for a machine that decides by a verdict."""

import xml.etree.ElementTree as ET
from dataclasses import replace

import pytest

from aeropend_ident.commands import diagnose
from aeropend_ident.diagnosis import checks
from aeropend_ident.diagnosis.document import (
    FORMAT,
    Across,
    Candidate,
    Closure,
    DiagnosisDocument,
    Interval,
    Where,
    Which,
)


def made(verdict: str, shares: dict[str, float], gap: float = 0.2, closed: float | None = 0.9) -> DiagnosisDocument:
    """A document of a verdict whose effects have shares of the gap."""
    rows = tuple(Candidate(e, "arm", 0.99, {}, True, 0.02, Interval(x, x, x)) for e, x in shares.items())
    which = Which(verdict, tuple(shares), rows, {}, {}, (), None, (), None)
    return DiagnosisDocument(
        format=FORMAT, bags=("bag",), model="bench", duration_s=70.0, samples=1000, train_s=(0.0, 49.0),
        held_out_s=(49.0, 70.0), channels={}, where=Where("arm", {}, ()), which=which,
        closure=Closure(gap, 0.02, 0.01, closed, None, None), notes=(), seconds=1.0)


FOUND = made("coulomb_friction", {"coulomb_friction": 0.7, "gust": 0.1})
NONE = made("none", {}, 0.01, None)

WORSE = Across("b", 0.6, 0.5, 0.1, 0.2, None, None)


@pytest.mark.promise("Verdict", "`--fail-on` gives exit code 1 if a verdict breaks a rule, `--junit` writes JUnit XML")
@pytest.mark.parametrize(("rule", "document", "broken"), [
    ("gap>19%", FOUND, True), ("gap > 0.21", FOUND, False), ("gap>19%", NONE, False), ("gap_after>1e-3", NONE, True),
    ("closed<95%", FOUND, True), ("closed<95%", NONE, False), ("share>60%", FOUND, True), ("share>60%", NONE, False),
    ("coulomb_friction", FOUND, True), ("coulomb_friction>75%", FOUND, False), ("gust>5%", FOUND, True),
    ("ground_effect", FOUND, False), ("effect", FOUND, True), ("effect", NONE, False), ("unknown", FOUND, False),
    ("unknown", made("unknown", {}), True), ("effect", made("unknown", {}), True),
    ("cannot_tell", made("cannot_tell", {}), True), ("effect", made("cannot_tell", {}), False),
    ("not_separable", FOUND, False), ("not_determined", FOUND, False),
    ("not_separable", replace(FOUND, which=replace(FOUND.which, not_separable=(("a", "b"),))), True),
    ("gap>50%", replace(FOUND, closure=replace(FOUND.closure, across=(WORSE,))), True),
])
def test_a_rule_is_broken_where_its_condition_holds(rule, document, broken):
    (outcome,) = checks.check(document, [checks.parse(rule)])
    assert outcome.broken is broken, outcome


@pytest.mark.parametrize(("rule", "found"), [("parameter_mismatch>15%", "it is 10 %"), ("share>15%", "it is 10 %"),
                                             ("parameter_mismatch", "it is claimed, with 10 % of the squared gap")])
def test_shares_are_those_of_what_is_claimed(rule, found):
    """Of two parameters that are claimed, beside one that was a rival and has no share."""
    claimed, rival = (Candidate("parameter_mismatch", "arm", 0.9, {}, was, 0.02, share)
                      for was, share in ((True, Interval(0.05, 0.04, 0.06)), (False, None)))
    document = replace(FOUND, which=replace(FOUND.which, effects=("parameter_mismatch",),
                                            candidates=(claimed, claimed, rival)))
    (outcome,) = checks.check(document, [checks.parse(rule)])
    assert outcome.found == found


@pytest.mark.parametrize(("rule", "words"), [
    ("gap", "compare it with a number"), ("gap>", "not a rule"), ("gap>1e", "not a number"),
    ("gapp>1", "did you mean gap?"), ("coulomb_frictio", "did you mean coulomb_friction?"),
    ("unknown>1", "leave the number out"), ("\x1b[2J", "not a rule"),
])
def test_what_is_no_rule_is_refused_in_one_line(rule, words, capsys):
    assert diagnose.main(["no_bag", "--fail-on", rule]) == 2
    told = capsys.readouterr().err
    assert words in told
    assert told.count("\n") == 1
    assert "\x1b" not in told


def test_a_recording_that_cannot_be_used_is_an_error_in_junit(tmp_path):
    assert diagnose.main(["no_bag", "--fail-on", "unknown", "--junit", str(tmp_path / "v.xml")]) == 2
    (suite,) = ET.parse(tmp_path / "v.xml").getroot()
    assert suite.get("errors") == "1"
    assert "no_bag" in suite.find("testcase/error").get("message")


def test_the_last_line_says_which_rules_are_broken():
    rules = [checks.parse(text) for text in ("gap>5%", "unknown", "gust>5%")]
    said = checks.check(FOUND, rules)
    assert checks.summary(said) == "check: failed, 2 of 3 rules broken: gap>5% (it is 20 %); gust>5% (it is 10 %)"
    lost = checks.Outcome("other", "unknown", error="gone")
    assert checks.summary([said[1], lost]) == "check: failed, 0 of 1 rules broken; 1 without a verdict"
    assert checks.summary(said[1:2]) == "check: passed, 1 of 1 rules kept"
