# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from rclpy.serialization import serialize_message

from aeropend_control.nodes import step_run
from aeropend_sim.ros import interface

STAMP, PERIOD = 10**18, 2_040_000


def test_the_defaults_make_a_folder_of_their_own():
    options = step_run.parse([])
    assert options.levels is None
    assert options.out.name.startswith("step_test_")


def test_results_are_replaced_only_when_asked(tmp_path, capsys):
    (tmp_path / "steps.json").write_text("mine")
    with pytest.raises(SystemExit) as end:
        step_run.parse(["--out", str(tmp_path)])
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "steps.json already" in line
    assert step_run.parse(["--out", str(tmp_path), "--overwrite"]).out == tmp_path


@pytest.mark.parametrize(("words", "said"), [
    (["--hold", "0.1"], "0.5 to 600"), (["--levels", "nan"], "nan"), (["--levels", "much"], "much"),
    (["--law", "bang_bang"], "bang_bang"), (["0.4"], "0.4"), (["--out", __file__], "no folder"),
])
def test_what_cannot_be_used_is_said_in_one_line(capsys, words, said):
    with pytest.raises(SystemExit) as end:
        step_run.parse(words)
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("step_test: ")
    assert said in line


@pytest.mark.parametrize("value", [math.inf, 1e300, math.nan])
def test_readings_that_are_no_possible_numbers_are_missing_ones(value):
    joints, armatures = [], []
    for k in range(100):
        theta, voltage = (value if k in (40, 41) else 0.1 for _ in range(2))
        voltage = math.inf if voltage == 1e300 else voltage
        joints.append(bytes(serialize_message(interface.joint_states_message(STAMP + k * PERIOD, theta, 50.0))))
        armatures.append(bytes(serialize_message(interface.armature_message(STAMP + k * PERIOD, voltage, 0.2, 0.3))))
    _, columns, lost = step_run._columns(joints, armatures, [(STAMP - 1, 0.2)], STAMP + 10**9)
    assert lost == 0
    np.testing.assert_allclose(columns["theta"], 0.1)
    np.testing.assert_allclose(columns["v_a"], 0.1, rtol=1e-6)
