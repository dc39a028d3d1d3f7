# SPDX-License-Identifier: Apache-2.0
"""The pose of the rig for robot_state_publisher, RViz and Foxglove.

No sensor measures the angle of the rotor, so it is NaN in `joint_states`. robot_state_publisher then makes a transform
of NaN, which tf2 refuses with an error each time. This node publishes some of the samples with the angle of the rotor,
integrated from its speed. The angle at the start is unknown; it does not matter for a picture.
"""

import math
import sys
import time
from collections.abc import Sequence

from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState

from aeropend_sim.readings import is_possible, is_time
from aeropend_sim.ros import interface
from aeropend_sim.ros.diagnostics import Diagnostics
from aeropend_sim.ros.program import run
from aeropend_sim.ros.settings import Setting, overrides, read_settings
from aeropend_sim.ros.usage import usage

PAUSE_S = 0.5
"""[s] Over a longer pause between samples the rotor is not turned. A choice."""

SETTINGS = {
    "rate": Setting(50.0, "greatest rate of poses", "Hz", 1.0, 500.0),
    "slow": Setting(20.0, "factor by which the propeller turns slower than measured, for the eye", low=1.0, high=1e3),
}

USAGE = usage(
    "pose: publishes joint_states again on pose/joint_states, with a position of each joint, to show the rig in 3D.",
    SETTINGS,
    [
        "pose",
        "pose --ros-args -p slow:=1.0",
        "pose --ros-args -r __ns:=/rig1",
    ],
    "  With a ROS 2 installation, RViz and Foxglove show the rig if this runs too:\n"
    "  ros2 run robot_state_publisher robot_state_publisher $(ros2 pkg prefix --share aeropend_sim)/urdf/"
    "aeropendulum.urdf \\\n    --ros-args -r joint_states:=pose/joint_states\n"
    "  In RViz: fixed frame base, and a RobotModel of the topic robot_description.",
)


class Rotor:
    """Angle of the propeller, integrated from its speed.

    Args:
        slow: factor by which it turns slower than measured.
    """

    def __init__(self, slow: float = 1.0) -> None:
        self.angle = 0.0
        self._slow = slow
        self._last_ns: int | None = None

    def turn(self, stamp_ns: int, omega: float) -> float:
        """Angle at a sample, rad, in -pi..pi.

        Args:
            stamp_ns: [ns] instant of the sample.
            omega: [rad/s] speed; with NaN the angle stays.
        """
        passed = 0.0 if self._last_ns is None else 1e-9 * (stamp_ns - self._last_ns)
        self._last_ns = stamp_ns
        if 0.0 < passed < PAUSE_S and is_possible("omega", omega):
            self.angle = math.remainder(self.angle + passed * omega / self._slow, 2.0 * math.pi)
        return self.angle


class Pose(Node):
    """The node; see the docstring of the module."""

    def __init__(self) -> None:
        super().__init__("pose", automatically_declare_parameters_from_overrides=True)
        settings = read_settings(self, SETTINGS, overrides(self))
        self._pause_s = 1.0 / settings["rate"]
        self._rotor = Rotor(settings["slow"])
        self._due = 0.0
        self._counts = {"samples": 0, "published": 0, "without angle": 0, "malformed": 0}
        self._publisher = self.create_publisher(JointState, interface.POSE, interface.QOS)
        self.create_subscription(JointState, interface.JOINT_STATES, self._on_joint_states, interface.QOS, raw=True)
        self._diagnostics = Diagnostics(self, lambda: ("", self._counts))

    def _on_joint_states(self, raw: bytes) -> None:
        self._counts["samples"] += 1
        now = time.monotonic()
        if now < self._due:
            return
        try:
            message = deserialize_message(raw, JointState)
        except Exception:  # its types are those of the middleware
            self._counts["malformed"] += 1
            return
        arm, rotor = interface.JOINTS
        theta = dict(zip(message.name, message.position)).get(arm, math.nan)
        omega = dict(zip(message.name, message.velocity)).get(rotor, math.nan)
        if not is_possible("theta", theta):
            self._counts["without angle"] += 1
            return
        stamp = message.header.stamp
        if not is_time(stamp.sec, stamp.nanosec):
            self._counts["malformed"] += 1
            return
        self._due = now + self._pause_s
        stamp_ns = interface.stamp_ns(stamp)
        angle = self._rotor.turn(stamp_ns, omega)
        self._publisher.publish(interface.joint_states_message(stamp_ns, theta, omega, rotor_angle=angle))
        self._counts["published"] += 1


def main(args: Sequence[str] | None = None) -> int:
    """Entry point of `pose`."""
    return run(Pose, args, USAGE)


if __name__ == "__main__":
    sys.exit(main())
