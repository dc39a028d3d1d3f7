# SPDX-License-Identifier: Apache-2.0
"""Messages of `joint_states` and `armature` in CDR, from a template: rclpy's conversion takes ten times as long."""

from __future__ import annotations

import math
import struct

from rclpy.serialization import serialize_message

from aeropend_sim.ros import interface

_STAMP = struct.Struct("<iI")
_FLOAT = struct.Struct("<d")
_AT_STAMP, _AT_THETA, _AT_OMEGA = 4, 52, 84
_AT_VOLTAGE, _AT_CURRENT, _AT_DUTY = 20, 28, 44
"""Offsets in the serialized messages (derived: CDR; the tests compare with rclpy)."""
_VOLTAGE = struct.Struct("<f")

_JOINTS = serialize_message(interface.joint_states_message(0, 0.0, 0.0))
_ARMATURE = serialize_message(interface.armature_message(0, 0.0, 0.0, 0.0))
_S = 1_000_000_000


def joint_states(stamp_ns: int, theta: float, omega: float) -> bytes:
    """Serialize what `interface.joint_states_message` makes: stamp [ns], angle [rad], speed of the rotor [rad/s]."""
    out = bytearray(_JOINTS)
    _STAMP.pack_into(out, _AT_STAMP, *divmod(stamp_ns, _S))
    _FLOAT.pack_into(out, _AT_THETA, theta)
    _FLOAT.pack_into(out, _AT_OMEGA, omega)
    return bytes(out)


def armature(stamp_ns: int, v_a: float, i_a: float, duty: float) -> bytes:
    """Serialize what `interface.armature_message` makes: stamp [ns], voltage [V], current [A], duty."""
    out = bytearray(_ARMATURE)
    _STAMP.pack_into(out, _AT_STAMP, *divmod(stamp_ns, _S))
    _VOLTAGE.pack_into(out, _AT_VOLTAGE, v_a)
    _VOLTAGE.pack_into(out, _AT_CURRENT, i_a)
    _VOLTAGE.pack_into(out, _AT_DUTY, duty if math.isfinite(duty) else math.nan)
    return bytes(out)
