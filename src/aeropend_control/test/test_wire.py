# SPDX-License-Identifier: Apache-2.0
import math
import struct

import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import Float64

from aeropend_control.nodes import wire
from aeropend_sim.ros import interface

STAMP = 1_795_303_606_684_245_755


@pytest.mark.parametrize("frame", ["", "a", "base", "base_link"])
@pytest.mark.parametrize("names", [["arm", "rotor"], ["rotor", "arm"], ["x", "arm", "rotors", "rotor"], []])
def test_joint_states_read_as_rclpy_reads_them(frame, names):
    message = JointState(name=names, position=[0.1 * k for k in range(len(names))],
                         velocity=[7.0 + k for k in range(len(names))])
    message.header.stamp, message.header.frame_id = interface.stamp(STAMP), frame
    read = wire.joints(serialize_message(message))
    assert read == (STAMP, dict(zip(names, message.position)), dict(zip(names, message.velocity)))


@pytest.mark.parametrize(("position", "velocity"), [([], []), ([0.5], []), ([], [3.0, 4.0]), ([0.5, 0.6, 0.7], [3.0])])
def test_joints_without_a_reading_are_left_out(position, velocity):
    message = JointState(name=["arm", "rotor"], position=position, velocity=velocity, effort=[1.0])
    read = wire.joints(serialize_message(message))
    assert read.position == dict(zip(["arm", "rotor"], position))
    assert read.velocity == dict(zip(["arm", "rotor"], velocity))


@pytest.mark.parametrize("frame", ["", "abc", "abcd"])
def test_armature_reads_as_rclpy_reads_it(frame):
    message = interface.armature_message(STAMP, 1.5, -0.25, 0.75)
    message.header.frame_id = frame
    message.cell_voltage = [1.0, 2.0]
    raw = serialize_message(message)
    again = deserialize_message(raw, BatteryState)
    assert wire.armature(raw) == (STAMP, again.current, again.voltage, again.percentage) == (STAMP, -0.25, 1.5, 0.75)
    assert wire.stamp_ns(raw) == STAMP


@pytest.mark.parametrize("value", [0.0, 0.1, -1e300, math.inf])
def test_a_float_is_read_by_rclpy(value):
    assert deserialize_message(wire.float64(value), Float64).data == value


def test_big_endian_is_read_too():
    head = b"\x00\x00\x00\x00" + struct.pack(">iII", 5, 6, 1) + b"\0\0\0\0"
    assert wire.armature(head + struct.pack(">7f", 1.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.5)) == (5_000_000_006, 2.0, 1.0, 0.5)


@pytest.mark.parametrize(("seconds", "nanoseconds"), [(-1, 0), (5, 10**9), (5, 2**32 - 1), (-2**31, 0)])
def test_a_stamp_that_is_no_time_is_malformed(seconds, nanoseconds):
    stamp = struct.pack("<iI", seconds, nanoseconds)
    for message, read in ((interface.joint_states_message(STAMP, 0.1, 50.0), wire.joints),
                          (interface.armature_message(STAMP, 1.5, 0.2, 0.7), wire.armature)):
        raw = serialize_message(message)
        for function in (read, wire.stamp_ns):
            with pytest.raises(wire.MALFORMED, match="no time"):
                function(raw[:4] + stamp + raw[12:])


def test_what_is_broken_off_or_of_another_encoding_is_said():
    raw = serialize_message(interface.joint_states_message(STAMP, 0.1, 50.0))
    with pytest.raises(struct.error):
        wire.joints(raw[:40])
    with pytest.raises(ValueError, match="not plain CDR"):
        wire.joints(b"\x00\x07" + raw[2:])
