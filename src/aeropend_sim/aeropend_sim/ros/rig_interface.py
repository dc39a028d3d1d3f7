# SPDX-License-Identifier: Apache-2.0
"""The part of a rig's node that is the same for the simulated plant and for the bridge to a real board."""

import ctypes
import math
import threading

from rclpy.node import Node
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import Float64
from std_srvs.srv import SetBool

from aeropend_sim.readings import ROUNDING
from aeropend_sim.ros import interface
from aeropend_sim.ros.diagnostics import CpuShare
from aeropend_sim.ros.realtime import CLOCK_STEP_NS, monotonic_to_ros_ns


class RigInterface(Node):
    """A node that publishes samples, takes duties, and can be enabled and disabled.

    A node of this kind reads its parameters, prepares its rig, and then calls `advertise`. It defines `take_duty`.

    Args:
        name: of the node.

    Attributes:
        lock: guards the attributes that follow, and whatever else the callbacks and the sampling thread share.
        duty: duty that the rig is to apply.
        enabled: whether commands act.
        lowest: the least duty: 0, or -1 for a bridge that drives the motor both ways.
        refused: number of commands that were not finite numbers.
        clamped: number of commands beyond the limits.
        clock_steps: number of times that the system clock was set.
        to_ros_ns: [ns] system time minus the monotonic clock.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name, automatically_declare_parameters_from_overrides=True)
        self.lock = threading.Lock()
        self.duty = 0.0
        self.enabled = True
        self.lowest = 0.0
        self.refused = 0
        self.clamped = 0
        self.clock_steps = 0
        self.to_ros_ns = monotonic_to_ros_ns()
        self.cpu_share = CpuShare()

    def advertise(self) -> None:
        """Create publishers, subscription and service. From here on, `take_duty` may be called."""
        qos = interface.QOS
        self.to_ros_ns = monotonic_to_ros_ns()
        self._joint_states = self.create_publisher(JointState, interface.JOINT_STATES, qos)
        self._armature = self.create_publisher(BatteryState, interface.ARMATURE, qos)
        self.create_subscription(Float64, interface.DUTY_COMMAND, self._on_duty, qos)
        self.create_service(SetBool, interface.ENABLE, self._on_enable)

    def take_duty(self, duty: float) -> None:
        """Apply a commanded duty, or ignore it. The lock is held.

        Args:
            duty: `lowest`..1.
        """
        raise NotImplementedError

    def enabled_changed(self) -> None:
        """React to a new value of `enabled`. The lock is held."""

    def publish_sample(self, stamp_ns: int, theta: float, omega: float, v_a: float, i_a: float, duty: float) -> None:
        """Publish one sample.

        Args:
            stamp_ns: [ns] instant of sampling, since the epoch.
            theta: [rad] arm angle.
            omega: [rad/s] rotor speed.
            v_a: [V] armature voltage.
            i_a: [A] armature current.
            duty: duty applied from this sample to the next, -1..1.
        """
        self._joint_states.publish(interface.joint_states_message(stamp_ns, theta, omega))
        self._armature.publish(interface.armature_message(stamp_ns, v_a, i_a, duty))

    def follow_system_clock(self, grid_ns: int = 1) -> None:
        """Move `to_ros_ns` if the system clock was set, and log it.

        Args:
            grid_ns: [ns] stamps move by a multiple of this.
        """
        step = monotonic_to_ros_ns() - self.to_ros_ns
        if abs(step) > CLOCK_STEP_NS:
            moved = round(step / grid_ns) * grid_ns
            self.to_ros_ns += moved
            self.clock_steps += 1
            self.get_logger().warn(f"the system clock was set: stamps move by {moved * 1e-9:.3f} s")

    def _on_duty(self, message: Float64) -> None:
        if not math.isfinite(message.data):
            self.refused += 1
            if self.refused == 1:
                self.get_logger().warn(f"duty_command {message.data} refused; further ones are only counted")
            return
        if not self.lowest - ROUNDING <= message.data <= 1.0 + ROUNDING:
            self.clamped += 1
            if self.clamped == 1:
                self.get_logger().warn(f"duty_command {message.data:g} is outside {self.lowest:g} to 1: clamped (give "
                                       "a fraction, not percent); further ones are only counted")
        # as the 32-bit float that `armature` reports, so that a recording holds exactly the duty that acted
        duty = ctypes.c_float(min(max(message.data, self.lowest), 1.0)).value
        with self.lock:
            self.take_duty(duty)

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        with self.lock:
            self.enabled = request.data
            if not self.enabled:
                self.duty = 0.0  # it also stays 0 after enabling, until the next command
            self.enabled_changed()
        response.success = True
        response.message = "enabled" if request.data else "disabled: duty 0"
        return response
