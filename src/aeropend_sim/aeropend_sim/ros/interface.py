# SPDX-License-Identifier: Apache-2.0
"""Topics, message types and quality of service of an aeropendulum, simulated or real (docs/interfaces.md).

All nodes take names, QoS and message layout from here. The names are relative, so that namespaces and remapping work.
Units are SI, angles are in rad from the hanging position, a duty is a fraction 0..1 (-1..1 if the bridge reverses or
brakes the motor), stamps are in ns.
"""

import math

from builtin_interfaces.msg import Time
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import BatteryState, JointState

DUTY_COMMAND = "duty_command"
"""`std_msgs/msg/Float64`: commanded duty."""
JOINT_STATES = "joint_states"
"""`sensor_msgs/msg/JointState`: measured angle and rotor speed."""
ARMATURE = "armature"
"""`sensor_msgs/msg/BatteryState`: measured voltage and current, and the duty applied."""
REFERENCE = "reference"
"""`std_msgs/msg/Float64`: reference of a controller."""
DIAGNOSTICS = "/diagnostics"
"""`diagnostic_msgs/msg/DiagnosticArray`, 1 Hz, from all nodes."""
TRUTH_JOINT_STATES = "truth/joint_states"
TRUTH_ARMATURE = "truth/armature"
MODEL_JOINT_STATES = "model/joint_states"
MODEL_ARMATURE = "model/armature"
"""What the free-running model of `watch` says, as `joint_states` and `armature`."""
POSE = "pose/joint_states"
"""`sensor_msgs/msg/JointState` from the node `pose`: `joint_states` with all positions, for drawing."""
ENABLE = "enable"
"""Service `std_srvs/srv/SetBool`: off means duty 0."""
RESET = "reset"
"""Service `std_srvs/srv/Trigger`, simulated plant only: back to rest."""

JOINTS = ("arm", "rotor")
ARMATURE_LOCATION = "armature"

QOS = QoSProfile(reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_LAST, depth=100)
"""QoS of all publishers and subscriptions. A depth of 100 covers a pause of 200 ms at the sample rate."""

_NAN = math.nan
_S = 1_000_000_000

LATEST_NS = 2**31 * _S
"""[ns] What no stamp reaches: its seconds have 32 bits with sign."""


def stamp(stamp_ns: int) -> Time:
    """Convert a stamp (ns since the epoch) to a message."""
    sec, nanosec = divmod(stamp_ns, _S)
    return Time(sec=sec, nanosec=nanosec)


def stamp_ns(time: Time) -> int:
    """Convert a stamp message to ns since the epoch."""
    return time.sec * _S + time.nanosec


def joint_states_message(
    stamp_ns: int, theta: float, omega: float, theta_dot: float = _NAN, rotor_angle: float = _NAN
) -> JointState:
    """Make one message of `joint_states`. Values that are not measured are NaN.

    Args:
        stamp_ns: [ns] instant of sampling, since the epoch.
        theta: [rad] arm angle from hanging.
        omega: [rad/s] rotor speed.
        theta_dot: [rad/s] arm rate.
        rotor_angle: [rad] rotor angle.
    """
    message = JointState(name=list(JOINTS), position=[theta, rotor_angle], velocity=[theta_dot, omega], effort=[])
    message.header.stamp = stamp(stamp_ns)
    return message


def armature_message(stamp_ns: int, v_a: float, i_a: float, duty: float) -> BatteryState:
    """Make one message of `armature`. Fields without a meaning here are NaN.

    Args:
        stamp_ns: [ns] instant of sampling, since the epoch.
        v_a: [V] armature voltage.
        i_a: [A] armature current, positive when it drives the motor.
        duty: duty applied from this sample to the next, -1..1.
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
