# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from aeropend_ident.bags.recording import CHANNELS, RecordingError, read

JOINT, BATTERY, FLOAT = "sensor_msgs/msg/JointState", "sensor_msgs/msg/BatteryState", "std_msgs/msg/Float64"
NAN = math.nan


def same(recording, made, rows=slice(None)):
    """Assert that a recording holds the arrays that went into the bag, to the last bit."""
    np.testing.assert_array_equal(recording.stamp_ns, made.arrays["stamp_ns"][rows])
    for name in CHANNELS:
        np.testing.assert_array_equal(getattr(recording, name), made.arrays[name][rows], err_msg=name)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("bare", [False, True])
def test_round_trip(bags, tmp_path, storage, bare):
    made = bags.content(300)
    path = bags.write(tmp_path / "bag", made, storage)
    recording = read(next(path.glob("bag.*")) if bare else path)
    same(recording, made)
    assert recording.namespace == "/"
    assert recording.channels == CHANNELS
    assert recording.period == pytest.approx(0.00204, abs=1e-15)
    assert (len(recording), recording.lost, recording.duplicates) == (300, 0, 0)
    assert recording.complete
    assert recording.notes == ()
    assert recording.truth is None
    np.testing.assert_allclose(recording.t, 0.00204 * np.arange(300), rtol=0, atol=1e-12)
    assert recording.duration == recording.t[-1]
    np.testing.assert_array_equal(recording.received_ns, made.arrays["stamp_ns"] + 300_000)
    np.testing.assert_array_equal(recording.command, [0.1, 0.3])
    np.testing.assert_array_equal(recording.command_ns, made.arrays["stamp_ns"][[10, 30]] + 500_000)
    np.testing.assert_array_equal(recording.reference, [0.4])
    np.testing.assert_array_equal(recording.reference_ns, made.arrays["stamp_ns"][[20]] + 500_000)


def test_arrays_keep_their_types(bags, tmp_path):
    recording = read(bags.write(tmp_path / "bag", bags.content(5)))
    for name in ("t", *CHANNELS, "command", "reference"):
        assert getattr(recording, name).dtype == np.float64, name
    for name in ("stamp_ns", "received_ns", "gaps", "command_ns", "reference_ns"):
        assert getattr(recording, name).dtype == np.int64, name


def test_order_of_arrival_does_not_matter(bags, tmp_path):
    made = bags.content(200)
    rng = np.random.default_rng(1)
    times = [one[2] for one in made.messages]
    shuffled = [made.messages[at] for at in rng.permutation(len(made.messages))]
    mixed = bags.Content([(*one[:2], time, one[3]) for one, time in zip(shuffled, times, strict=True)], made.arrays)
    same(read(bags.write(tmp_path / "bag", mixed)), made)


def test_lost_messages_leave_gaps_and_nan(bags, tmp_path):
    made = bags.content(100)
    keep = [
        one
        for one in made.messages
        if not (40 <= (one[2] - made.arrays["stamp_ns"][0]) // 2_040_000 < 43)  # both messages of three samples
        and not (one[0] == "/armature" and one[2] == made.arrays["stamp_ns"][60] + 400_000)
    ]
    recording = read(bags.write(tmp_path / "bag", bags.Content(keep)))
    assert len(recording) == 97
    np.testing.assert_array_equal(recording.gaps, [[39, 3]])
    assert recording.lost == 3
    assert recording.period == pytest.approx(0.00204, abs=1e-15)
    assert np.flatnonzero(np.isnan(recording.duty)).tolist() == [57]
    assert not np.isnan(recording.theta).any()
    assert "1 sample of joint_states has no armature of the same stamp" in recording.notes
    assert "3 samples are missing in 1 gap" in recording.notes


def test_first_of_repeated_stamps_counts(bags, tmp_path):
    made = bags.content(20)
    stamp = int(made.arrays["stamp_ns"][7])
    again = ("/joint_states", JOINT, stamp + 10**9, bags.joint(stamp, [99.0, NAN], [NAN, 99.0]))
    recording = read(bags.write(tmp_path / "bag", bags.Content([*made.messages, again])))
    same(recording, made)
    assert recording.duplicates == 1
    assert "1 message repeats a stamp: the first of each counts" in recording.notes


def test_without_armature_the_duty_is_the_commanded_one(bags, tmp_path):
    made = bags.content(60)
    bad = [
        ("/duty_command", FLOAT, made.messages[-1][2] + time, bags.number(value))
        for time, value in ((1, NAN), (2, 7.0), (3, math.inf))
    ]
    late = (JOINT, made.messages[-1][2] + 10, bags.joint(int(made.arrays["stamp_ns"][-1]) + 2_040_000, [1.0], []))
    content = bags.Content([*made.without("/armature").messages, *bad, ("/joint_states", *late)])
    recording = read(bags.write(tmp_path / "bag", content))
    expected = np.full(61, NAN)
    expected[11:31], expected[31:60], expected[60] = 0.1, 0.3, 1.0  # clamped; NaN and inf refused, as the rig does
    np.testing.assert_array_equal(recording.duty, expected)
    assert recording.channels == ("theta", "omega", "duty")
    assert "no armature: the duty is that of duty_command by the time it was received" in recording.notes
    assert "not measured: i_a, v_a" in recording.notes


def test_an_armature_without_duties_leaves_them_to_the_commands(bags, tmp_path):
    made = bags.content(60, columns={"duty": np.full(60, NAN)})
    recording = read(bags.write(tmp_path / "bag", made))
    assert set(recording.duty[12:]) == {0.1, 0.3}
    assert recording.channels == ("theta", "omega", "i_a", "v_a", "duty")
    assert "no duty in armature: the duty is that of duty_command by the time it was received" in recording.notes


def test_joints_of_other_names_are_kept_beside_ours(bags, tmp_path):
    joints = [("/joint_states", JOINT, k, bags.joint(k, [0.1 * k, NAN], [1.0, 2.0], ["pole", "rotor"]))
              for k in range(1, 9)]
    recording = read(bags.write(tmp_path / "bag", bags.Content(joints)))
    assert recording.channels == ("omega",)
    assert list(recording.others) == ["pole", "pole.velocity"]
    np.testing.assert_allclose(recording.others["pole"], 0.1 * np.arange(1, 9))


@pytest.mark.parametrize(
    ("left_out", "channels"),
    [
        (["/joint_states"], ("i_a", "v_a", "duty")),
        (["/armature", "/duty_command"], ("theta", "omega")),
        (["/duty_command", "/reference"], CHANNELS),
    ],
)
def test_a_recording_that_lacks_topics_is_usable(bags, tmp_path, left_out, channels):
    made = bags.content(30)
    recording = read(bags.write(tmp_path / "bag", made.without(*left_out)))
    assert recording.channels == channels
    for name in CHANNELS:
        expected = made.arrays[name] if name in channels else np.full(30, NAN)
        np.testing.assert_array_equal(getattr(recording, name), expected)


@pytest.mark.parametrize(
    ("names", "position", "velocity", "theta", "omega"),
    [
        (("arm",), [0.5], [], 0.5, NAN),
        (("rotor",), [], [7.0], NAN, 7.0),
        (("rotor", "arm"), [NAN, 0.5], [7.0, NAN], 0.5, 7.0),
        (("base", "rotor", "arm"), [1.0, 2.0, 0.5], [3.0, 7.0, 4.0], 0.5, 7.0),
        (("arm", "rotor"), [0.5], [1.0], 0.5, NAN),
    ],
)
def test_joints_are_found_by_name(bags, tmp_path, names, position, velocity, theta, omega):
    message = bags.joint(5, position, velocity, names)
    recording = read(bags.write(tmp_path / "bag", bags.Content([("/joint_states", JOINT, 9, message)])))
    np.testing.assert_array_equal([recording.theta[0], recording.omega[0]], [theta, omega])
    assert math.isnan(recording.period)


def test_truth_is_kept_apart(bags, tmp_path):
    made = bags.content(20)
    truth = []
    for row, stamp in enumerate(made.arrays["stamp_ns"].tolist()):
        truth.append(("/truth/joint_states", JOINT, stamp + 1, bags.joint(stamp, [row, 1.0], [2.0 * row, 3.0 * row])))
        if row != 4:
            truth.append(("/truth/armature", BATTERY, stamp + 2, bags.battery(stamp, 4.0 * row, 5.0 * row, NAN)))
    recording = read(bags.write(tmp_path / "bag", bags.Content(made.messages + truth)))
    same(recording, made)
    rows = np.arange(20.0)
    np.testing.assert_array_equal(recording.truth.theta, rows)
    np.testing.assert_array_equal(recording.truth.theta_dot, 2 * rows)
    np.testing.assert_array_equal(recording.truth.omega, 3 * rows)
    rows[4] = NAN
    np.testing.assert_array_equal(recording.truth.v_a, 4 * rows)
    np.testing.assert_array_equal(recording.truth.i_a, 5 * rows)


def test_namespace_is_found(bags, tmp_path):
    made = bags.content(20, "/lab/rig1")
    recording = read(bags.write(tmp_path / "bag", made))
    same(recording, made)
    assert recording.namespace == "/lab/rig1"


def test_of_several_rigs_one_is_chosen(bags, tmp_path):
    one, other = bags.content(20, "/rig1"), bags.content(30, "/rig2", seed=1)
    path = bags.write(tmp_path / "bag", bags.Content(one.messages + other.messages))
    with pytest.raises(RecordingError, match=r"several rigs: /rig1, /rig2; choose one with --namespace$"):
        read(path)
    for name in ("/rig2", "rig2", "rig2/"):
        same(read(path, name), other)
    with pytest.raises(RecordingError, match=r"no rig in namespace /rig3; it holds /rig1, /rig2$"):
        read(path, "rig3")


def test_another_robots_joints_and_other_topics_are_ignored(bags, tmp_path):
    made = bags.content(20, "/rig1")
    others = [
        ("/panda/joint_states", JOINT, 5, bags.joint(5, [1.0], [1.0], ["panda_joint1"])),
        ("/chatter", FLOAT, 6, bags.number(1.0)),
        ("/rig1/my_joint_states", JOINT, 7, bags.joint(7, [1.0], [1.0])),
        ("/rig3/joint_states", FLOAT, 8, bags.number(1.0)),
    ]
    same(read(bags.write(tmp_path / "bag", bags.Content(made.messages + others))), made)


def test_what_is_not_ours_is_named(bags, tmp_path):
    others = [("/chatter", FLOAT, 6, bags.number(1.0)), ("/chatter", FLOAT, 7, bags.number(1.0))]
    with pytest.raises(RecordingError, match=r"joint_states or armature .* /chatter \(std_msgs/msg/Float64, 2\): "):
        read(bags.write(tmp_path / "other", bags.Content(others)))
    robot = [("/panda/joint_states", JOINT, 5, bags.joint(5, [1.0], [1.0], ["panda_joint1"]))]
    with pytest.raises(RecordingError, match="/panda/joint_states has no joint named arm or rotor"):
        read(bags.write(tmp_path / "robot", bags.Content(robot)))
    with pytest.raises(RecordingError, match="holds no messages"):
        read(bags.write(tmp_path / "empty", bags.Content()))


def test_samples_without_stamps_are_refused(bags, tmp_path):
    messages = [("/joint_states", JOINT, time, bags.joint(0, [1.0], [1.0])) for time in range(5, 9)]
    with pytest.raises(RecordingError, match=r"/joint_states: header\.stamp is never set"):
        read(bags.write(tmp_path / "bag", bags.Content(messages)))


def test_armature_on_other_stamps_is_left_out(bags, tmp_path):
    made = bags.content(20)
    moved = [
        ("/armature", BATTERY, stamp + 5, bags.battery(stamp + 1, 1.0, 1.0, 0.5))
        for stamp in made.arrays["stamp_ns"].tolist()
    ]
    recording = read(bags.write(tmp_path / "bag", bags.Content(made.without("/armature").messages + moved)))
    assert len(recording) == 20
    assert np.isnan(recording.v_a).all()
    assert ("no stamp of armature equals one of joint_states: armature is left out; give both messages of a sample the "
            "same stamp, and record again") in recording.notes


def test_messages_that_are_none_are_counted(bags, tmp_path):
    made = bags.content(20)
    broken = [("/joint_states", JOINT, 5, b"\0\1\0\0xx"), ("/duty_command", FLOAT, 6, b"")]
    recording = read(bags.write(tmp_path / "bag", bags.Content(made.messages + broken)))
    same(recording, made)
    assert "1 message of /joint_states could not be decoded" in recording.notes
    assert "1 message of /duty_command could not be decoded" in recording.notes
    np.testing.assert_array_equal(recording.command, [0.1])


def test_big_endian(bags, tmp_path):
    messages = [
        ("/joint_states", JOINT, 5, bags.joint(5, [0.5, NAN], [NAN, 8.0], little_endian=False)),
        ("/armature", BATTERY, 6, bags.battery(5, 1.5, 0.25, 0.75, "frame", little_endian=False)),
        ("/duty_command", FLOAT, 7, bags.number(0.75, little_endian=False)),
    ]
    recording = read(bags.write(tmp_path / "bag", bags.Content(messages)))
    assert [getattr(recording, name)[0] for name in CHANNELS] == [0.5, 8.0, 0.25, 1.5, 0.75]
    assert recording.command.tolist() == [0.75]
    assert recording.stamp_ns.tolist() == [5]


def test_two_rigs_on_one_topic_are_noticed(bags, tmp_path):
    one, other = bags.content(200), bags.content(200, seed=1)
    shifted = [(topic, kind, received, bags.joint(received - 300_000 + 700_000, [0.0, NAN], [NAN, 1.0]))
               for topic, kind, received, _ in other.messages if topic == "/joint_states"]
    both = bags.Content(sorted(one.messages + shifted, key=lambda m: m[2]), {})
    notes = read(bags.write(tmp_path / "bag", both)).notes
    assert any("two programs publish one topic" in note for note in notes), notes
