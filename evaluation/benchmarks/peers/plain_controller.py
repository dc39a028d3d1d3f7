# SPDX-License-Identifier: Apache-2.0
"""What most people write: the same law behind decoded subscriptions, spun by rclpy.spin."""

import sys

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import Float64

from aeropend_control.laws.registry import LAWS
from aeropend_sim.model.parameters import load
from aeropend_sim.model.rig import Sample
from aeropend_sim.ros import interface


class PlainController(Node):
    """Joins the two messages of a sample and steps the law."""

    def __init__(self, law: str) -> None:
        super().__init__("plain_controller")
        self._law = LAWS[law].make(load("bench"))
        self._reference = 0.0
        self._joints: dict[int, JointState] = {}
        self._publisher = self.create_publisher(Float64, interface.DUTY_COMMAND, interface.QOS)
        self.create_subscription(JointState, interface.JOINT_STATES, self._on_joint_states, interface.QOS)
        self.create_subscription(BatteryState, interface.ARMATURE, self._on_armature, interface.QOS)
        self.create_subscription(Float64, interface.REFERENCE, self._on_reference, interface.QOS)

    def _on_reference(self, message: Float64) -> None:
        self._reference = message.data

    def _on_joint_states(self, message: JointState) -> None:
        self._joints[interface.stamp_ns(message.header.stamp)] = message

    def _on_armature(self, message: BatteryState) -> None:
        joint = self._joints.pop(interface.stamp_ns(message.header.stamp), None)
        if joint is not None:
            sample = Sample(joint.position[0], joint.velocity[1], message.current, message.voltage)
            self._publisher.publish(Float64(data=self._law.step(sample, self._reference)))


if __name__ == "__main__":
    rclpy.init()
    try:
        rclpy.spin(PlainController(sys.argv[1]))
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()
