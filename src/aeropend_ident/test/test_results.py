# SPDX-License-Identifier: Apache-2.0
"""The lines that a diagnosis prints."""

import math

import pytest

from aeropend_ident.diagnosis.document import (
    FORMAT,
    Candidate,
    ClosedGap,
    Closure,
    DiagnosisDocument,
    HangingAngle,
    Identified,
    Interval,
    Lift,
    NextExperiment,
    ParameterRow,
    Where,
    Which,
)
from aeropend_ident.diagnosis.results import describe, experiment, gap_line, identified_line, verdict_lines
from aeropend_ident.diagnosis.typed_json import from_json, schema


@pytest.mark.parametrize(("closed", "low", "high", "text"), [
    (0.876, 0.851, 0.9, "88 % (85 to 90 %) of the gap above the floor is closed"),
    (1.0, None, None, "100 % of the gap above the floor is closed"),
    (-0.001, -0.004, 0.004, "0 % (0 to 0 %) of the gap above the floor is closed"),
    (None, None, None, "nothing to close"),
])
def test_the_line_of_a_gap(closed, low, high, text):
    start = "gap: 12.5 % of the signals' spread, 2.0 % with the augmented model, floor 1.0 %: "
    assert gap_line("gap", ClosedGap(0.125, 0.02, 0.01, closed, low, high)) == start + text


def test_a_gap_beyond_reason_is_a_bound():
    line = gap_line("gap", ClosedGap(63.0, math.nan, 1e-9, -63.0, -1e9, 0.1))
    assert line.startswith("gap: >999 % of the signals' spread, ? % with the augmented model, floor 0.0 %: <-999 % ")
    assert line.endswith("(<-999 to 10 %) of the gap above the floor is closed")


def test_the_parameters_of_a_candidate_have_units():
    friction = Candidate("coulomb_friction", "arm", 0.99, {"accel": Interval(0.8, 0.75, 0.85)}, True, 0.1)
    assert describe(friction) == "accel = 0.8 (0.75 to 0.85) rad/s²"
    off = Candidate("parameter_mismatch", "electrical", 0.99, {"R_a": Interval(1.5, 1.4, 1.6)}, True, 0.1)
    assert describe(off) == "R_a = 1.5 (1.4 to 1.6) Ω"


def test_an_experiment_is_a_command_that_a_shell_understands():
    settings = {"kind": "steps", "on": True, "duration": 60.0, "sequence": (0.0, 0.2)}
    assert experiment(NextExperiment("it separates them", settings)) == (
        "excite --ros-args -p kind:=steps -p on:=true -p duration:=60.0 -p 'sequence:=[0.0, 0.2]' (it separates them)")
    assert experiment(NextExperiment("measure R_a directly", {})) == "measure R_a directly"


def test_the_line_of_an_uncalibrated_rig():
    rows = {"R_a": ParameterRow(1.0, 1.1, 1.0, 1.2, determined=False),
            "c_over_J": ParameterRow(1.0, 1.5, 1.4, 1.6, determined=True, runs=(), run_to_run=0.25)}
    lift = Lift((0.0, 0.9), (0.0, 20.0), 0.1, 0.3)
    assert identified_line(Identified("the angle", ("R_a",), lift, HangingAngle(0.1, 0.0, 0.2)), rows) == (
        "identified from the angle: c_over_J = 1.5 (1.4 to 1.6, run to run 0.25) 1/s, hangs at a reading of 0.1 rad, "
        "lift up to 20.0 rad/s² at a duty of 0.90, none below 0.10, with a lag of 0.30 s; not determined: R_a")
    slow = Lift((0.0, 0.9), (0.0, 20.0), 2.5e-16, 110.0)
    assert identified_line(Identified("the angle", (), slow), {}, 60.0) == (
        "identified from the angle: lift up to 20.0 rad/s² at a duty of 0.90, with a lag longer than the recording")
    assert identified_line(Identified("the angle", ()), {}) == "identified from the angle: nothing"


def test_each_parameter_that_is_claimed_has_its_line():
    share = Interval(0.4, 0.3, 0.5)
    rows = [Candidate("parameter_mismatch", "electrical", 0.99, {n: Interval(x, x, x)}, found, 0.1, share)
            for n, x, found in (("R_a", 1.5, True), ("L_a", 0.01, False), ("c_over_J", 2.0, True))]
    lines = verdict_lines(DiagnosisDocument(
        format=FORMAT, bags=("bag",), model="bench", duration_s=70.0, samples=1000, train_s=(0.0, 49.0),
        held_out_s=(49.0, 70.0), channels={}, where=Where("electrical", {}, ()),
        which=Which("parameter_mismatch", ("parameter_mismatch",), tuple(rows), {}, {}, (), None, (), None),
        closure=Closure(0.2, 0.02, 0.01, 0.9, None, None), notes=(), seconds=1.0))
    assert [line.split(" = ")[0] for line in lines if "parameter_mismatch: " in line] == [
        "  parameter_mismatch: R_a", "  parameter_mismatch: c_over_J"]


def test_a_verdict_of_before_a_key_was_added_is_read():
    assert from_json(Identified, {"from": "the angle", "not_determined": []}) == Identified("the angle", ())
    assert schema(Identified)["required"] == ["from", "not_determined"]
