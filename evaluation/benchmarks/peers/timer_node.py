# SPDX-License-Identifier: Apache-2.0
"""What most people write: the plant's two messages from an rclpy timer, spun by rclpy.spin."""

import time

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import BatteryState, JointState

from aeropend_sim.model.parameters import SAMPLE_PERIOD
from aeropend_sim.ros import interface


class TimerNode(Node):
    """Publishes joint_states and armature at the sample rate."""

    def __init__(self) -> None:
        super().__init__("timer_node")
        self._joint_states = self.create_publisher(JointState, interface.JOINT_STATES, interface.QOS)
        self._armature = self.create_publisher(BatteryState, interface.ARMATURE, interface.QOS)
        self._timer = self.create_timer(SAMPLE_PERIOD, self._tick)

    def _tick(self) -> None:
        # when this tick was due, which a timer does not tell
        due = time.time_ns() + self._timer.time_until_next_call() - self._timer.timer_period_ns
        self._joint_states.publish(interface.joint_states_message(due, 0.5, 100.0))
        self._armature.publish(interface.armature_message(due, 1.0, 0.3, 0.4))


if __name__ == "__main__":
    rclpy.init()
    try:
        rclpy.spin(TimerNode())
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()
