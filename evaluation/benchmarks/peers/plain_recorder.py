# SPDX-License-Identifier: Apache-2.0
"""What most people write: decoded subscriptions, spun as by rclpy.spin, into rosbags' Writer."""

import signal
import sys
import time
from functools import partial
from typing import Any

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import Float64

from aeropend_sim.ros import interface

TOPICS = {interface.JOINT_STATES: JointState, interface.ARMATURE: BatteryState, interface.DUTY_COMMAND: Float64}


class PlainRecorder(Node):
    """Records three topics."""

    def __init__(self, writer: Writer) -> None:
        super().__init__("plain_recorder")
        self._writer = writer
        typestore = get_typestore(Stores.ROS2_JAZZY)
        for topic, kind in TOPICS.items():
            name = f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"
            connection = writer.add_connection(self.resolve_topic_name(topic), name, typestore=typestore)
            self.create_subscription(kind, topic, partial(self._write, connection), interface.QOS)

    def _write(self, connection: Any, message: Any) -> None:
        self._writer.write(connection, time.time_ns(), serialize_message(message))


if __name__ == "__main__":
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    ends: list[int] = []
    signal.signal(signal.SIGINT, lambda number, _: ends.append(number))  # raised inside rclpy, it can break the bag
    with Writer(sys.argv[1], version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        executor = SingleThreadedExecutor()
        executor.add_node(PlainRecorder(writer))
        while not ends:
            executor.spin_once()
    rclpy.shutdown()
