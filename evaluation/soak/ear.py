# SPDX-License-Identifier: Apache-2.0
"""Hears what a rig and its loop say, message by message, without an executor that could be too slow for it."""

import struct
from array import array
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import Float64

from aeropend_control.nodes import wire
from aeropend_sim.ros import interface

DEPTH = 20_000
"""Messages that wait in the middleware: 40 s at the sample rate."""
Info = Mapping[str, int]
"""Information of the middleware about a message."""
_FLOAT64 = struct.Struct("<4xd")


class Track:
    """What came on a topic.

    Attributes:
        stamps: of the samples; of commands, which have none, when they came, ns.
        values: the angle, the duty applied, the duty commanded.
        received: when they came, ns.
        numbers: the publisher's own.
    """

    def __init__(self) -> None:
        self.stamps, self.values, self.received, self.numbers = array("q"), array("d"), array("q"), array("q")

    def __len__(self) -> int:
        return len(self.stamps)

    def take(self, stamp: int, value: float, info: Info) -> None:
        """Take a message."""
        self.stamps.append(stamp)
        self.values.append(value)
        self.received.append(info["received_timestamp"])
        self.numbers.append(info["publication_sequence_number"])


class Ear:
    """Subscriptions to all topics of a rig, read whenever `drain` is called.

    Attributes:
        joints, armature, commands: what came.
        counters: the last counters of each node, by its name.
        said: what each node's diagnostics said since `forget_said`.
    """

    def __init__(self, namespace: str) -> None:
        self._node = Node("ear", namespace=namespace, start_parameter_services=False, enable_rosout=False)
        self._namespace = namespace.strip("/")
        self.joints, self.armature, self.commands = Track(), Track(), Track()
        self.counters: dict[str, dict[str, str]] = {}
        self.said: dict[str, list[str]] = {}
        qos = QoSProfile(reliability=interface.QOS.reliability, history=interface.QOS.history, depth=DEPTH)
        self._ends: list[tuple[Any, type, Callable[[bytes, Info], None]]] = [
            (self._node.create_subscription(kind, topic, print, qos, raw=True), kind, take)
            for kind, topic, take in (
                (JointState, interface.JOINT_STATES, self._on_joints),
                (BatteryState, interface.ARMATURE, self._on_armature),
                (Float64, interface.DUTY_COMMAND, self._on_command),
                (DiagnosticArray, interface.DIAGNOSTICS, self._on_diagnostics))]  # fmt: skip

    def close(self) -> None:
        """Leave the graph."""
        self._node.destroy_node()

    def drain(self) -> None:
        """Take all that has come."""
        for subscription, kind, take in self._ends:
            handle = subscription.handle
            with handle:
                while (taken := handle.take_message(kind, True)) is not None:
                    with suppress(*wire.MALFORMED):  # junk that a fault sends
                        take(*taken)

    def position(self) -> tuple[int, int]:
        """How many samples there are of joint_states and armature now."""
        self.drain()
        return len(self.joints), len(self.armature)

    def forget_said(self) -> None:
        """From now on only new messages count."""
        self.drain()
        self.said.clear()
        self.counters.clear()

    def _on_joints(self, message: bytes, info: Info) -> None:
        stamp, position, _ = wire.joints(message)
        self.joints.take(stamp, position[interface.JOINTS[0]], info)

    def _on_armature(self, message: bytes, info: Info) -> None:
        stamp, _, _, duty = wire.armature(message)
        self.armature.take(stamp, duty, info)

    def _on_command(self, message: bytes, info: Info) -> None:
        self.commands.take(info["received_timestamp"], _FLOAT64.unpack_from(message)[0], info)

    def _on_diagnostics(self, message: bytes, _: Info) -> None:
        for status in deserialize_message(message, DiagnosticArray).status:
            namespace, _, name = status.name.rpartition("/")
            if namespace == self._namespace:
                self.counters[name] = {value.key: value.value for value in status.values}
                self.said.setdefault(name, []).append(status.message)
