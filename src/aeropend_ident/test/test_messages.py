# SPDX-License-Identifier: Apache-2.0
"""What is said of a recording that cannot be used names the cause, and what to do."""

import struct
from dataclasses import replace

import numpy as np
import pytest

from aeropend_ident.bags.recording import RecordingError, read
from aeropend_ident.checkup.bag import checks, contents
from aeropend_ident.commands.step_response import main as step_response
from aeropend_ident.commands.step_response import other_law, remarks
from aeropend_ident.signals.from_bag import as_signals
from aeropend_ident.testing.rigs import BENCH, drawn_rig, steps
from aeropend_sim.model import rig

JOINT, FLOAT, FLOAT32 = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64", "std_msgs/msg/Float32"


@pytest.fixture(scope="module")
def columns():
    duty = steps(6.0, 31)
    return {**rig.record(drawn_rig(31, {}), duty, 31)[0], "duty": duty}


@pytest.fixture(scope="module")
def good(bags, columns):
    return bags.content(len(columns["duty"]), columns=columns)


def changed(bags, path, good, columns, name):
    """A bag whose joint_states are those that `name` makes of a sample: names, positions, speeds, instant [ns]."""
    joints = []
    for k, stamp in enumerate(good.arrays["stamp_ns"].tolist()):
        names, position, speed, at = name(k, float(columns["theta"][k]), float(columns["omega"][k]), stamp)
        joints.append(("/joint_states", JOINT, stamp, bags.joint(at, position, speed, names)))
    return bags.write(path, bags.Content([*good.without("/joint_states").messages, *joints]))


def refusal(bag):
    with pytest.raises(RecordingError) as refused:
        as_signals(read(bag), BENCH)
    return str(refused.value)


NAN = float("nan")


@pytest.mark.parametrize(("name", "words"), [
    (lambda k, x, w, at: (("arm", "rotor"), [NAN, NAN], [NAN, w], at), "missing or NaN in all messages; check the"),
    (lambda k, x, w, at: (("rotor", "arm"), [x, NAN], [NAN, w], at), "that of 'rotor' is: if the names are exchanged"),
    (lambda k, x, w, at: (("arm", "rotor"), [np.inf, NAN], [NAN, w], at), "readings of theta are no possible number"),
    (lambda k, x, w, at: ((), [], [], at), "its messages name no joint): left out; name the joints arm and rotor"),
    (lambda k, x, w, at: (("arm ", "rotor"), [x, NAN], [NAN, w], at), "the joint 'arm ', none is called arm: if '"),
])
def test_a_recording_without_an_angle_says_why(bags, tmp_path, good, columns, name, words):
    assert words in refusal(changed(bags, tmp_path / "bag", good, columns, name))


def test_a_topic_that_is_missing_or_of_another_type_is_named(bags, tmp_path, good):
    rest = good.without("/joint_states").messages
    bag = bags.write(tmp_path / "none", bags.Content(rest))
    assert "there is no joint_states: record it together with armature" in refusal(bag)
    other = [("/joint_states", FLOAT, time, bags.number(0.3)) for _, _, time, _ in rest[:9]]
    bag = bags.write(tmp_path / "other", bags.Content([*rest, *other]))
    said = refusal(bag)
    assert f"/joint_states has the type {FLOAT} and is left out; publish it as {JOINT}, and record again" in said
    assert any(c.level == "warning" and "has the type" in c.text for c in checks(str(bag), BENCH))


def test_a_command_that_is_none_is_named(bags, tmp_path, good):
    rest = good.without("/armature", "/duty_command").messages
    times = [time for _, _, time, _ in rest[:9]]
    bag = bags.write(tmp_path / "float32", bags.Content(
        [*rest, *(("/duty_command", FLOAT32, time, struct.pack("<If", 256, 0.3)) for time in times)]))
    assert f"duty_command holds no duty: /duty_command has the type {FLOAT32}" in refusal(bag)
    bag = bags.write(tmp_path / "nan", bags.Content(
        [*rest, *(("/duty_command", FLOAT, time, bags.number(NAN)) for time in times)]))
    assert "duty_command holds no duty: none of its 9 messages is a number" in refusal(bag)


def test_messages_without_our_joints_and_joints_that_are_named_twice_are_counted(bags, tmp_path, good, columns):
    bag = changed(bags, tmp_path / "bag", good, columns, lambda k, x, w, at: (
        ((), [], [], at) if k % 10 == 0 else (("arm", "arm", "rotor"), [x, x, NAN], [NAN, NAN, w], at)))
    notes = read(bag).notes
    count = -(-len(columns["duty"]) // 10)
    assert f"{count} messages of /joint_states name neither arm nor rotor: left out" in notes
    assert "/joint_states names the joint arm twice: the first counts, the second is left out" in notes


def test_a_clock_that_stands_still_is_said(bags, tmp_path, good, columns):
    first = good.arrays["stamp_ns"][0]
    rest = good.without("/armature")
    bag = changed(bags, tmp_path / "all", rest, columns,
                  lambda k, x, w, at: (("arm", "rotor"), [x, NAN], [NAN, w], first))
    with pytest.raises(RecordingError, match=r"have one stamp: the clock .* stands still.*set header.stamp to"):
        read(bag)
    half = good.arrays["stamp_ns"][len(columns["duty"]) // 2]
    bag = changed(bags, tmp_path / "half", rest, columns,
                  lambda k, x, w, at: (("arm", "rotor"), [x, NAN], [NAN, w], min(at, half)))
    assert any("the clock that stamps them stands still" in c.text for c in checks(str(bag), BENCH)
               if c.level == "warning")


def test_two_publishers_are_said_where_the_angle_jumps_between_them(bags, tmp_path, good, columns):
    rows = range(len(columns["duty"]))
    other = [("/joint_states", JOINT, stamp, bags.joint(stamp + 700_000, [2.0, NAN], [NAN, 50.0], ("arm", "rotor")))
             for _, stamp in zip(rows, good.arrays["stamp_ns"].tolist(), strict=True)]
    bag = bags.write(tmp_path / "bag", bags.Content([*good.messages, *other]))
    said = [c.text for c in checks(str(bag), BENCH)]
    assert any("the angle jumps, and the stamps do not lie on one grid: two programs publish one topic" in text
               for text in said)
    assert not any("its zero was set there" in text for text in said)


def test_two_publishers_with_the_same_stamps_are_said(bags, tmp_path, good):
    same = [message for message in good.messages if message[0] == "/armature"]
    other = [("/joint_states", JOINT, stamp, bags.joint(stamp, [2.0, NAN], [NAN, 50.0], ("arm", "rotor")))
             for stamp in good.arrays["stamp_ns"].tolist()]
    said = read(bags.write(tmp_path / "bag", bags.Content([*good.messages, *same, *other]))).notes
    assert any(f"{len(other)} messages of /joint_states have the stamp of another and other values" in note
               for note in said)
    assert not any("of /armature have the stamp of another" in note for note in said)


def test_a_pause_is_no_loss_of_samples(bags, tmp_path, good):
    recording = read(bags.write(tmp_path / "bag", good))
    paused = replace(recording, gaps=np.array([[100, 2000]]))
    said = [c.text for c in contents("bag", paused)]
    assert any("pauses once, first at 0.2 s for 4.08 s" in text for text in said)
    assert not any("lost" in text for text in said)


def test_step_response_says_which_references_do_not_count(bags, tmp_path, good, capsys):
    def bag(name, *levels):
        at = good.arrays["stamp_ns"][0] + np.arange(len(levels)) * 1_000_000_000
        return str(bags.write(tmp_path / name, bags.Content([*good.without("/reference").messages, *(
            ("/reference", FLOAT, int(time), bags.number(level)) for time, level in zip(at, levels, strict=True))])))

    for name, levels, words in (("none", (), "record the topic reference while the controller gets its steps"),
                                ("nan", (NAN,), "all 1 references are NaN or infinite"),
                                ("deg", (11.5, 23.0), "its references go from 11.5 to 23; give the --law that ran")):
        assert step_response([bag(name, *levels)]) == 2
        assert words in capsys.readouterr().err
    (said,) = remarks(read(bag("inf", -np.inf, 0.4)), "feedback_linearization")
    assert said.endswith("as the controller refuses it (first NaN or infinite)")


def test_step_response_says_which_law_the_references_fit():
    reference = np.repeat([0.2, 0.4], 500)
    grid = {"theta": reference + 0.01, "omega": np.full(1000, 130.0), "reference": reference}
    (said,) = other_law(grid, "cascade")
    assert said.startswith("theta follows these references, omega does not: give --law ")
    assert other_law(grid, "feedback_linearization") == []


def test_a_table_that_is_no_bag_names_the_command_that_makes_one(tmp_path):
    (tmp_path / "a b.csv").write_text("t,theta\n0,1\n")
    with pytest.raises(RecordingError, match=r"if it is a table, `.*import '.*a b.csv'` shows how to make a recording"):
        read(tmp_path / "a b.csv")


def test_an_angle_that_wraps_at_a_turn_is_no_slip(bags, tmp_path, columns):
    wrapped = bags.content(len(columns["duty"]), columns=columns | {"theta": columns["theta"] % (2.0 * np.pi)})
    bag = bags.write(tmp_path / "bag", wrapped)
    assert not any("it slipped" in c.text or c.level == "error" for c in checks(str(bag), BENCH))
