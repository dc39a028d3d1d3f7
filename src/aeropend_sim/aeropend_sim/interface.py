# SPDX-License-Identifier: Apache-2.0
"""Topics, types and quality of service that the simulated plant and the hardware bridge share.

Whoever talks to an aeropendulum, simulated or real, takes names, QoS and message layout from here. Names are relative,
so namespaces and remapping work. Units are SI, angles in rad from hanging, duty a fraction 0..1, stamps in ns.
"""

import math
import struct
from collections.abc import Sequence

from builtin_interfaces.msg import Time
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import BatteryState, JointState

DUTY_COMMAND = "duty_command"
"""`std_msgs/msg/Float64`: commanded duty."""
JOINT_STATES = "joint_states"
"""`sensor_msgs/msg/JointState`: measured angle and rotor speed."""
ARMATURE = "armature"
"""`sensor_msgs/msg/BatteryState`: measured voltage and current, and the duty applied."""
REFERENCE = "reference"
"""`std_msgs/msg/Float64`: what a controller is to reach."""
DIAGNOSTICS = "/diagnostics"
"""`diagnostic_msgs/msg/DiagnosticArray`, 1 Hz, from every node."""
TRUTH_JOINT_STATES = "truth/joint_states"
TRUTH_ARMATURE = "truth/armature"
ENABLE = "enable"
"""Service `std_srvs/srv/SetBool`: off means duty 0."""
RESET = "reset"
"""Service `std_srvs/srv/Trigger`, simulated plant only: back to rest."""

JOINTS = ("arm", "rotor")
ARMATURE_LOCATION = "armature"

QOS = QoSProfile(reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=100)
"""Of every publisher and subscription: depth 100 bridges a stall of 200 ms at the sample rate."""

_NAN = math.nan
_S = 1_000_000_000


def stamp(stamp_ns: int) -> Time:
    """Turn a stamp in ns since the epoch into a message."""
    sec, nanosec = divmod(stamp_ns, _S)
    return Time(sec=sec, nanosec=nanosec)


def stamp_ns(time: Time) -> int:
    """Turn a stamp message into ns since the epoch."""
    return time.sec * _S + time.nanosec


def joint_states_message(
    stamp_ns: int, theta: float, omega: float, theta_dot: float = _NAN, rotor_angle: float = _NAN
) -> JointState:
    """Build one sample of `joint_states`; what is not measured stays NaN.

    Args:
        stamp_ns: instant of sampling, ns since the epoch.
        theta: arm angle from hanging, rad.
        omega: rotor speed, rad/s.
        theta_dot: arm rate, rad/s.
        rotor_angle: rotor angle, rad.
    """
    message = JointState(name=list(JOINTS), position=[theta, rotor_angle], velocity=[theta_dot, omega], effort=[])
    message.header.stamp = stamp(stamp_ns)
    return message


def armature_message(stamp_ns: int, v_a: float, i_a: float, duty: float) -> BatteryState:
    """Build one sample of `armature`; every float that has no meaning here is NaN.

    Args:
        stamp_ns: instant of sampling, ns since the epoch.
        v_a: armature voltage, V.
        i_a: armature current, A, positive when it drives the motor.
        duty: duty applied from this sample to the next, 0..1.
    """
    message = BatteryState(
        voltage=v_a,
        current=i_a,
        percentage=duty,
        temperature=_NAN,
        charge=_NAN,
        capacity=_NAN,
        design_capacity=_NAN,
        present=True,
        location=ARMATURE_LOCATION,
    )
    message.header.stamp = stamp(stamp_ns)
    return message


class _Packer:
    """One message type as bytes on the wire, with holes for the stamp and the values.

    Filling a message object and serialising it costs about ten times as much as writing into a buffer that was
    serialised once, which matters at the sample rate.
    """

    def __init__(self, template: JointState | BatteryState | Clock, stamp_at: Time, marks: Sequence[bytes]) -> None:
        stamp_at.sec, stamp_at.nanosec = 0x5EC0_5EC0, 0x0A50_A50A
        wire = serialize_message(template)
        self._buffer = bytearray(wire)
        self._stamp = self._find(wire, struct.pack("<iI", stamp_at.sec, stamp_at.nanosec))
        self._values = [self._find(wire, mark) for mark in marks]
        self._pack_stamp = struct.Struct("<iI").pack_into

    @staticmethod
    def _find(wire: bytes, mark: bytes) -> int:
        if wire.count(mark) != 1:
            raise RuntimeError("this middleware does not serialise messages as little-endian CDR")
        return wire.index(mark)


class JointStatesPacker(_Packer):
    """Serialise `joint_states` samples fast, for `Publisher.publish(bytes)`."""

    def __init__(self) -> None:
        marks = (1.1e100, 1.2e100, 1.3e100, 1.4e100)
        message = joint_states_message(0, marks[0], marks[1], marks[2], marks[3])
        super().__init__(message, message.header.stamp, [struct.pack("<d", mark) for mark in marks])
        self._double = struct.Struct("<d").pack_into

    def pack(
        self, stamp_ns: int, theta: float, omega: float, theta_dot: float = _NAN, rotor_angle: float = _NAN
    ) -> bytes:
        """Return the bytes of `joint_states_message` of the same arguments."""
        buffer, double = self._buffer, self._double
        self._pack_stamp(buffer, self._stamp, stamp_ns // _S, stamp_ns % _S)
        at_theta, at_omega, at_theta_dot, at_rotor_angle = self._values
        double(buffer, at_theta, theta)
        double(buffer, at_omega, omega)
        double(buffer, at_theta_dot, theta_dot)
        double(buffer, at_rotor_angle, rotor_angle)
        return bytes(buffer)


class ArmaturePacker(_Packer):
    """Serialise `armature` samples fast, for `Publisher.publish(bytes)`."""

    def __init__(self) -> None:
        marks = (1.1e30, 1.2e30, 1.3e30)
        message = armature_message(0, *marks)
        super().__init__(message, message.header.stamp, [struct.pack("<f", mark) for mark in marks])
        self._float = struct.Struct("<f").pack_into

    def pack(self, stamp_ns: int, v_a: float, i_a: float, duty: float) -> bytes:
        """Return the bytes of `armature_message` of the same arguments."""
        buffer, single = self._buffer, self._float
        self._pack_stamp(buffer, self._stamp, stamp_ns // _S, stamp_ns % _S)
        at_v_a, at_i_a, at_duty = self._values
        single(buffer, at_v_a, v_a)
        single(buffer, at_i_a, i_a)
        single(buffer, at_duty, duty)
        return bytes(buffer)


class ClockPacker(_Packer):
    """Serialise `/clock` fast, for `Publisher.publish(bytes)`."""

    def __init__(self) -> None:
        message = Clock()
        super().__init__(message, message.clock, [])

    def pack(self, stamp_ns: int) -> bytes:
        """Return the bytes of the clock message of this instant."""
        self._pack_stamp(self._buffer, self._stamp, stamp_ns // _S, stamp_ns % _S)
        return bytes(self._buffer)
