# SPDX-License-Identifier: Apache-2.0
"""Serialization (CDR) of the three messages of the control loop.

It replaces the conversions of rclpy, which take a third of the time of a control step.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from aeropend_sim.readings import is_time

_HEAD = {order: struct.Struct(order + "iII") for order in "<>"}  # stamp, length of frame_id
_COUNT = {order: struct.Struct(order + "I") for order in "<>"}
_BATTERY = {order: struct.Struct(order + "7f") for order in "<>"}
_FLOAT64 = struct.Struct("<4xd")
_S = 1_000_000_000

MALFORMED = (struct.error, ValueError, IndexError)
"""Exceptions of the reading functions for a malformed message, or one whose stamp is no time."""


class Joints(NamedTuple):
    """Contents of a `sensor_msgs/msg/JointState`: stamp [ns], and position and velocity by joint [SI]."""

    stamp_ns: int
    position: dict[str, float]
    velocity: dict[str, float]


class Armature(NamedTuple):
    """Used fields of a `sensor_msgs/msg/BatteryState`: stamp [ns], current [A], voltage [V], applied duty [0..1]."""

    stamp_ns: int
    i_a: float
    v_a: float
    duty: float


def joints(message: bytes) -> Joints:
    """Read a serialized `sensor_msgs/msg/JointState`.

    Raises:
        MALFORMED: it ends early, is not plain CDR, or its stamp is no time.
    """
    order = _order(message)
    count = _COUNT[order].unpack_from
    seconds, nanoseconds, length = _HEAD[order].unpack_from(message, 4)
    at = _aligned(16 + length)
    (number,) = count(message, at)
    at += 4
    names = []
    for _ in range(number):
        at = _aligned(at)
        (length,) = count(message, at)
        names.append(message[at + 4:at + 3 + length].decode())
        at += 4 + length
    read = []
    for _ in range(2):  # position, velocity
        at = _aligned(at)
        (number,) = count(message, at)
        at += 4
        if number:
            at += (4 - at) % 8
        read.append(dict(zip(names, struct.unpack_from(f"{order}{number}d", message, at), strict=False)))
        at += 8 * number
    return Joints(_time(seconds, nanoseconds), *read)


def armature(message: bytes) -> Armature:
    """Read a serialized `sensor_msgs/msg/BatteryState`.

    Raises:
        MALFORMED: it ends early, is not plain CDR, or its stamp is no time.
    """
    order = _order(message)
    seconds, nanoseconds, length = _HEAD[order].unpack_from(message, 4)
    voltage, _, current, _, _, _, percentage = _BATTERY[order].unpack_from(message, _aligned(16 + length))
    return Armature(_time(seconds, nanoseconds), current, voltage, percentage)


def stamp_ns(message: bytes) -> int:
    """[ns] Stamp of a serialized message that begins with a header."""
    seconds, nanoseconds, _ = _HEAD[_order(message)].unpack_from(message, 4)
    return _time(seconds, nanoseconds)


def float64(value: float) -> bytes:
    """Serialize a `std_msgs/msg/Float64`."""
    out = bytearray(_FLOAT64.size)
    _FLOAT64.pack_into(out, 0, value)
    out[1] = 1  # little-endian CDR
    return bytes(out)


def read_float64(message: bytes) -> float:
    """Read a serialized `std_msgs/msg/Float64`.

    Raises:
        MALFORMED: it ends early, or is not plain CDR.
    """
    (value,) = struct.unpack_from(f"{_order(message)}d", message, 4)
    return float(value)


def _time(seconds: int, nanoseconds: int) -> int:
    """[ns] A stamp."""
    if not is_time(seconds, nanoseconds):
        raise ValueError("the stamp is no time")
    return seconds * _S + nanoseconds


def _order(message: bytes) -> str:
    if message[0] != 0 or message[1] > 1:
        raise ValueError("not plain CDR")
    return "<" if message[1] else ">"


def _aligned(at: int) -> int:
    return at + -at % 4
