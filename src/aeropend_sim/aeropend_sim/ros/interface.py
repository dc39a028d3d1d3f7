# SPDX-License-Identifier: Apache-2.0
"""Topics, types and quality of service that the simulated plant and the hardware bridge share.

Whoever talks to an aeropendulum, simulated or real, takes names, QoS and message layout from here. Names are relative,
so namespaces and remapping work. Units are SI, angles in rad from hanging, duty a fraction 0..1, stamps in ns.
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
"""`std_msgs/msg/Float64`: what a controller is to reach."""
DIAGNOSTICS = "/diagnostics"
"""`diagnostic_msgs/msg/DiagnosticArray`, 1 Hz, from every node."""
TRUTH_JOINT_STATES = "truth/joint_states"
TRUTH_ARMATURE = "truth/armature"
POSE = "pose/joint_states"
"""`sensor_msgs/msg/JointState` from the node `pose`: what of `joint_states` can be drawn."""
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
