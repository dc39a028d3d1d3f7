# SPDX-License-Identifier: Apache-2.0
"""What cannot be a reading or a time is left out where a recording is read, and counted; or refused in one line."""

import math
import re
import struct
from itertools import product

import numpy as np
import pytest

from aeropend_ident.bags.recording import CHANNELS, RecordingError, read

JOINT, BATTERY, FLOAT = "sensor_msgs/msg/JointState", "sensor_msgs/msg/BatteryState", "std_msgs/msg/Float64"
N, PERIOD = 400, 20_000_000
STAMPS = 1_700_000_000_000_000_000 + PERIOD * np.arange(N)
DAY = 86_400 * 10**9


def written(bags, tmp_path, *, columns=None, stamps=STAMPS, nanosec=None, received=STAMPS):
    """A recording of N samples.

    Args:
        bags: makes them.
        tmp_path: folder.
        columns: channel -> (N,), 0.5 if it is not given.
        stamps: [ns] (N,).
        nanosec: (N,) instead of the rest of the second.
        received: [ns] (N,).
    """
    columns = {name: np.full(N, 0.5) for name in CHANNELS} | (columns or {})
    messages = []
    for k in range(N):
        theta, omega, i_a, v_a, duty = (float(columns[name][k]) for name in CHANNELS)
        seconds, rest = divmod(int(stamps[k]), 10**9)
        stamp = struct.pack("<iI", seconds, rest if nanosec is None else int(nanosec[k]))
        for topic, kind, raw in (("/joint_states", JOINT, bags.joint(0, [theta, math.nan], [math.nan, omega])),
                                 ("/armature", BATTERY, bags.battery(0, v_a, i_a, duty))):
            messages.append((topic, kind, int(received[k]), raw[:4] + stamp + raw[12:]))
    return bags.write(tmp_path / "bag", bags.Content(messages))


BAD = np.isin(np.arange(N), [40, 41, 300])


def single(value):
    """A column of 0.5 with another value in three readings."""
    return np.where(BAD, value, 0.5)


@pytest.mark.parametrize(("channel", "value"), [*product(CHANNELS, [math.inf, -math.inf, 1e38, -1e38]),
                                                ("theta", 1e300), ("omega", -1e300)])
def test_numbers_that_are_no_readings_are_left_out_and_counted(bags, tmp_path, channel, value):
    recording = read(written(bags, tmp_path, columns={channel: single(value)}))
    assert np.flatnonzero(np.isnan(getattr(recording, channel))).tolist() == [40, 41, 300]
    (note,) = recording.notes
    assert note.startswith(f"3 readings of {channel} are no possible number (first ")
    assert note.endswith("): left out")


@pytest.mark.parametrize("value", [1.7, 55.0, -2.0])
def test_a_few_duties_beyond_1_are_left_out_and_a_rounding_counts_as_1(bags, tmp_path, value):
    column = single(value)
    column[7] = 1.0 + 1e-6
    recording = read(written(bags, tmp_path, columns={"duty": column}))
    assert np.flatnonzero(np.isnan(recording.duty)).tolist() == [40, 41, 300]
    assert recording.duty[7] == 1.0
    assert f"first {value:g}, possible are -1 to 1" in recording.notes[0]


@pytest.mark.parametrize(("full", "option"), [(100.0, "%"), (255.0, "counts:255")])
def test_duties_that_are_no_fractions_are_refused_with_the_command_that_mends_them(bags, tmp_path, full, option):
    bag = written(bags, tmp_path, columns={"duty": np.linspace(0.0, full, N)})
    with pytest.raises(RecordingError) as refused:
        read(bag)
    assert re.search(f"duty goes from 0 to {full:g}, .*import .* .*_mended --duty duty:{option}` ", str(refused.value))
    assert "exchanged" not in str(refused.value)
    assert read(bag, judged=False).duty[-1] == full


def test_a_duty_may_be_exchanged_with_a_channel_that_can_be_a_duty(bags, tmp_path):
    bag = written(bags, tmp_path, columns={"duty": np.linspace(0.0, 9.0, N), "v_a": np.linspace(0.0, 0.8, N)})
    with pytest.raises(RecordingError) as refused:
        read(bag)
    assert "exchanged with the voltage" in str(refused.value)
    assert "exchanged with the current" not in str(refused.value)
    assert "`import BAG NEW" not in str(refused.value)


def test_a_duty_that_is_infinite_for_a_while_is_left_out(bags, tmp_path):
    recording = read(written(bags, tmp_path, columns={"duty": np.where(np.arange(N) < 300, 0.5, math.inf)}))
    assert np.isfinite(recording.duty).sum() == 300
    assert recording.notes[0].startswith("100 readings of duty are no possible number")


def test_one_message_of_other_joints_takes_no_channel_away(bags, tmp_path):
    armature = [("/armature", BATTERY, int(t), bags.battery(int(t), 1.0, 0.5, 0.3)) for t in STAMPS]

    def named(folder, *names):
        """A recording whose first joints have one set of names, all others another."""
        joints = [("/joint_states", JOINT, int(t), bags.joint(int(t), [0.1, 0.0], [0.0, 1.0], names[min(k, 1)]))
                  for k, t in enumerate(STAMPS)]
        return read(bags.write(tmp_path / folder, bags.Content([*joints, *armature])))

    assert np.isfinite(named("one", ["臂", "转子"], ["arm", "rotor"]).theta).sum() == N - 1
    recording = named("all", ["pole", "fan"], ["pole", "fan"])
    assert "has no joint named arm or rotor (its joints: fan, pole): left out" in recording.notes[0]
    assert "if pole is the arm, `" in recording.notes[0]
    assert "all_mended --theta pole:rad --omega fan.velocity:rad/s` writes a mended copy to " in recording.notes[0]


def test_commands_in_percent_are_said_where_they_are_the_duty(bags, tmp_path):
    sent = (("/duty_command", FLOAT, int(STAMPS[row]), bags.number(value)) for row, value in ((0, 0.0), (99, 40.0)))
    joints = [("/joint_states", JOINT, int(t), bags.joint(int(t), [0.1, 0.0], [0.0, 1.0])) for t in STAMPS]
    bag = bags.write(tmp_path / "bag", bags.Content([*sent, *joints]))
    recording = read(bag)
    assert set(recording.duty) == {0.0, 1.0}
    (note,) = (note for note in recording.notes if note.startswith("1 of 2 duty_commands is beyond"))
    assert "bag_mended --duty duty:%` writes a mended copy" in note
    assert set(read(bag, judged=False).duty) == {0.0, 40.0}


def test_a_reading_too_small_for_any_sensor_is_0(bags, tmp_path):
    recording = read(written(bags, tmp_path, columns={"omega": single(1e-38)}))
    assert recording.omega[40] == 0.0
    assert recording.notes == ()


@pytest.mark.parametrize("wrong", [{"nanosec": np.where(BAD, 1_500_000_000, STAMPS % 10**9)},
                                   {"stamps": np.where(BAD, -5, STAMPS)}])
def test_stamps_that_are_no_times_are_left_out_and_counted(bags, tmp_path, wrong):
    recording = read(written(bags, tmp_path, **wrong))
    assert recording.stamp_ns.tolist() == STAMPS[~BAD].tolist()
    assert sum(note.startswith("3 messages of /") and "stamp that is no time" in note for note in recording.notes) == 2


def test_a_recording_without_a_time_is_refused_in_one_line(bags, tmp_path):
    with pytest.raises(RecordingError, match=r"no sample could be read: .* a stamp that is no time"):
        read(written(bags, tmp_path, nanosec=np.full(N, 4_000_000_000)))


@pytest.mark.parametrize("by", [-DAY, DAY, -5_003 * 10**6])
def test_a_clock_that_is_set_goes_on_as_the_receive_times_do(bags, tmp_path, by):
    late = np.arange(N) >= N // 2
    theta = np.arange(N) / N
    recording = read(written(bags, tmp_path, columns={"theta": theta}, stamps=STAMPS + by * late))
    np.testing.assert_array_equal(recording.stamp_ns, STAMPS)
    np.testing.assert_array_equal(recording.theta, theta)
    (note,) = recording.notes
    assert f"was set 1 time during the recording (first by {by / 1e9:.0f} s)" in note


def test_single_stamps_far_away_are_left_out(bags, tmp_path):
    far = np.arange(N) % 13 == 7
    recording = read(written(bags, tmp_path, stamps=np.where(far, 10**15 * np.arange(N), STAMPS)))
    assert recording.stamp_ns.tolist() == STAMPS[~far].tolist()
    assert f"{far.sum()} samples have a stamp far from those around: left out" in recording.notes


def test_a_pause_of_the_recorder_is_no_setting_of_the_clock(bags, tmp_path):
    late = np.arange(N) >= N // 2
    recording = read(written(bags, tmp_path, stamps=STAMPS + DAY * late, received=STAMPS + DAY * late))
    assert recording.duration > 86_400.0
    assert not any("clock" in note for note in recording.notes)


def test_receive_times_that_tell_nothing_change_no_stamp(bags, tmp_path):
    rng = np.random.default_rng(0)
    for number, received in enumerate((np.zeros(N), STAMPS[0] + rng.integers(0, 10**12, N))):
        (tmp_path / f"{number}").mkdir()
        assert read(written(bags, tmp_path / f"{number}", received=received)).stamp_ns.tolist() == STAMPS.tolist()


def test_a_signalling_nan_is_a_plain_one(bags, tmp_path):
    joint, motor = bags.joint(0, [0.125, math.nan], [math.nan, 0.25]), bags.battery(0, 0.5, 0.5, 0.5)
    quiet, loud = (struct.pack("<Q", bits) for bits in (0x3FC0000000000000, 0x7FF0000000000001))
    half, short = struct.pack("<f", 0.5), struct.pack("<I", 0x7F800001)
    messages = []
    for k, t in enumerate(STAMPS.tolist()):
        stamp = struct.pack("<iI", *divmod(t, 10**9))
        for topic, kind, raw, old, new in (("/joint_states", JOINT, joint, quiet, loud),
                                           ("/armature", BATTERY, motor, half, short)):
            raw = raw[:4] + stamp + raw[12:]
            messages.append((topic, kind, t, raw.replace(old, new) if BAD[k] else raw))
    messages.append(("/reference", FLOAT, int(STAMPS[5]), bags.number(0.125).replace(quiet, loud)))
    with np.errstate(all="raise"):
        recording = read(bags.write(tmp_path / "bag", bags.Content(messages)))
        for name in ("theta", "i_a", "v_a", "duty"):
            readings = getattr(recording, name)
            assert np.flatnonzero(np.isnan(readings)).tolist() == [40, 41, 300]
            assert np.isfinite(readings - 0.0).sum() == N - 3
        assert np.isnan(recording.reference - 0.0).all()


def test_receive_times_of_another_age_move_no_stamps(bags, tmp_path):
    stamps = STAMPS - np.where(np.arange(N) < 200, 0, 5 * 10**9)
    received = np.where(np.arange(N) < 200, STAMPS, STAMPS + 2**62)
    recording = read(written(bags, tmp_path, stamps=stamps, received=received))
    assert (np.diff(recording.stamp_ns) > 0).all()
    assert recording.stamp_ns.tolist() == sorted(set(stamps.tolist()))
