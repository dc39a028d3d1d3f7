# SPDX-License-Identifier: Apache-2.0
"""The verdict as a sentence: it agrees with the numbers in every combination."""

from dataclasses import replace
from itertools import product

import pytest

from aeropend_ident.diagnosis.document import (
    FORMAT,
    Across,
    Candidate,
    Closure,
    DiagnosisDocument,
    Identified,
    Interval,
    Where,
    Which,
)
from aeropend_ident.diagnosis.report import sentence

PLACES = {"coulomb_friction": "arm", "gust": "arm", "thrust_lag": "thrust"}
FAILED = ("the model that was identified does not predict the rig: it is off by more than a constant angle; "
          "a longer recording helps most")


def made(verdict, effects=(), closed=0.97, parameters=(), after=None, low=None, high=None, across=(), unexplained=()):
    """A document with this verdict; the gap is 20 %, its floor 1 %."""
    rows = [Candidate(e, PLACES[e], 0.99, {}, True, 0.02, Interval(0.9, 0.8, 1.0)) for e in effects if e in PLACES]
    rows += [Candidate("parameter_mismatch", "arm", 0.99, {p: Interval(1.0, 0.9, 1.1)}, True, 0.02)
             for p in parameters]
    gap_after = after if after is not None else 0.2 - (closed or 0.0) * 0.19
    place = "none" if verdict in ("none", "cannot_tell") else "arm"
    return DiagnosisDocument(
        format=FORMAT, bags=("bag",), model="bench", duration_s=70.0, samples=1000, train_s=(0.0, 49.0),
        held_out_s=(49.0, 70.0), channels={}, where=Where(place, {}, ()),
        which=Which(verdict, tuple(effects), tuple(rows), {}, {}, tuple(unexplained), None, (), None),
        closure=Closure(0.2, gap_after, 0.01, closed, low, high, tuple(across)), notes=(), seconds=1.0)


def said(document):
    return ("".join(part.text for part in sentence.verdict(document)).replace("\N{NO-BREAK SPACE}", " "),
            sentence.consequence(document).replace("\N{NO-BREAK SPACE}", " "))


FRICTION, LACKS = "coulomb_friction", "The model lacks coulomb_friction"
PHYSICS = "dry friction in the pivot, with sticking, torque over inertia"
UNKNOWN = "The model lacks an effect that the catalogue does not contain, at this place: arm"
PREDICTS = "Random effects can be measured but not predicted, so their part of the gap stays open."
QUIET = "There is nothing to close: the gap is within the noise of the readings."
MISMATCH = "parameter_mismatch"


@pytest.mark.parametrize(("document", "verdict", "begins", "ends"), [
    (made(FRICTION, [FRICTION], low=0.95, high=0.98), f"{LACKS}: {PHYSICS}.",
     "Adding it and refitting the parameters closes 97 % of the gap (95 % interval 95 % to 98 %) on held-out data", ""),
    (made(FRICTION, [FRICTION], 0.62), f"{LACKS}; 38 % of the gap stays open.",
     "Adding it and refitting the parameters closes 62 % of the gap on held-out data", ""),
    (made(FRICTION, [FRICTION], 0.62, after=0.012), f"{LACKS}: {PHYSICS}.",
     "Adding it and refitting the parameters closes 62 % of the gap on held-out data",
     "What stays open is about as small as the noise of the readings."),
    (made(FRICTION, [FRICTION], -63.0),
     "coulomb_friction fits the fitted part of the recording, but closes none of the gap on held-out data.",
     "Adding it and refitting the parameters closes none of the gap on held-out data", "The gap even grows."),
    (made("gust", ["gust", FRICTION], 0.0, low=-0.2, high=0.1),
     "gust and coulomb_friction fit the fitted part of the recording, but close none of the gap on held-out data.",
     "Adding them and refitting the parameters closes none of the gap on held-out data", PREDICTS),
    (made("gust", ["gust"], 0.0), "The model lacks gust; all of the gap stays open.",
     "Adding it and refitting the parameters closes none of the gap on held-out data", PREDICTS),
    (made(MISMATCH, [MISMATCH], parameters=["R_a"]),
     "The structure of the model is right, but R_a (armature resistance) is off.",
     "Correcting it and refitting the other parameters closes 97 % of the gap on held-out data", ""),
    (made(MISMATCH, [MISMATCH], 0.3, parameters=["R_a", "L_a"]),
     "R_a and L_a (armature resistance and armature inductance) are off; 70 % of the gap stays open.",
     "Correcting them and refitting the other parameters closes 30 % of the gap on held-out data", ""),
    (made("thrust_lag", ["thrust_lag", MISMATCH], parameters=["J_m"]), "The model lacks thrust_lag, and J_m is off.",
     "Adding them and refitting the parameters closes 97 % of the gap on held-out data", ""),
    (made("thrust_lag", ["thrust_lag"], None),
     "The model lacks thrust_lag; the gap is within the noise of the readings.", QUIET, ""),
    (made("none", closed=None), "The model lacks nothing that this recording shows.", QUIET, ""),
    (made("none", closed=0.2), "No effect was surely found, but 80 % of the gap stays open.",
     "Refitting the parameters closes 20 % of the gap on held-out data", ""),
    (made("none", closed=-0.2), "No effect was surely found, but all of the gap stays open.",
     "Refitting the parameters closes none of the gap on held-out data", "The gap even grows."),
    (made("unknown", closed=0.4), f"{UNKNOWN}.",
     "Refitting the parameters closes 40 % of the gap on held-out data", ""),
    (made("unknown", ["thrust_lag"], 0.4), f"{UNKNOWN}, beside thrust_lag.",
     "Adding it and refitting the parameters closes 40 % of the gap on held-out data", ""),
    (made("cannot_tell", closed=0.8, unexplained=[FAILED]),
     "Cannot tell: the model that was identified does not predict the rig.",
     "It is off by more than a constant angle. A longer recording helps most.", ""),
    (made("cannot_tell"), "Cannot tell which effect the model lacks.", "", ""),
    (made("none", closed=None, across=[Across("b", 0.2, 0.1, 0.01, 0.55, None, None)]),
     "The model lacks nothing that this recording shows.", QUIET,
     "On the test recording, which no fit has used, 55 % of the gap closes."),
    (made(FRICTION, [FRICTION], across=[Across("b", 0.2, 0.1, 0.01, x, None, None) for x in (0.9, -3.0)]),
     f"{LACKS}: {PHYSICS}.", "Adding it and refitting the parameters closes 97 % of the gap on held-out data",
     "On 2 test recordings, which no fit has used, none to 90 % of the gap closes."),
])
def test_the_sentences_of_each_kind_of_verdict(document, verdict, begins, ends):
    held_out = ", the last 21 s of the recording." if "held-out" in begins else ""
    assert said(document) == (verdict, f"{begins}{held_out} {ends}".rstrip())


@pytest.mark.promise("Verdict", "The headline of the report agrees with its numbers")
def test_no_combination_contradicts_itself():
    verdicts = [("none", ()), ("unknown", ()), ("unknown", ("gust",)), ("cannot_tell", ()), ("gust", ("gust",)),
                ("coulomb_friction", ("coulomb_friction",)), ("gust", ("gust", "coulomb_friction")),
                ("parameter_mismatch", ("parameter_mismatch",))]
    for (verdict, effects), closed in product(verdicts, (None, -63.0, -0.004, 0.0, 0.004, 0.3, 0.89, 0.9, 1.0)):
        parameters = ["R_a"] if "parameter_mismatch" in effects else []
        head, rest = said(made(verdict, effects, closed, parameters, unexplained=[FAILED]))
        assert head.endswith(".")
        assert head[:1].isupper() or head.startswith(tuple(effects))
        if "closes none" in rest and verdict not in ("unknown", "cannot_tell"):
            assert "open" in head or "none of the gap" in head
        if "stays open" in head:
            assert "closes 9" not in rest
            assert "nothing to close" not in rest
        if head.startswith(("The model lacks nothing", "The structure of the model is right")):
            assert "nothing to close" in rest or "closes 9" in rest or "closes 100" in rest
        if verdict == "cannot_tell":
            assert "closes" not in head + rest
        else:
            for effect in set(effects) - {"parameter_mismatch"}:
                assert effect in head


def test_a_model_that_predicts_nothing_is_called_failed():
    good = made("coulomb_friction", ["coulomb_friction"])
    assert sentence.failed(good) == ""
    assert "no verdict" in sentence.failed(made("cannot_tell"))
    off = replace(good, closure=replace(good.closure, gap_after=1.7))
    assert "--uncalibrated" in sentence.failed(off)
    assert "--uncalibrated" in sentence.failed(made("none", closed=-0.2))
    assert sentence.failed(made("none", closed=None)) == ""
    assert "--uncalibrated" not in sentence.failed(replace(off, identified=Identified("the angle", ())))
