# SPDX-License-Identifier: Apache-2.0
"""What the plant shows to the graph: topics, types, QoS, services, stamps."""

import math
from itertools import pairwise

import pytest
from evaluation.support.graph import parameters, stamps
from rclpy.qos import DurabilityPolicy, HistoryPolicy, ReliabilityPolicy
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import Float64

from aeropend_sim.ros.interface import ARMATURE, DIAGNOSTICS, JOINT_STATES, TRUTH_ARMATURE, TRUTH_JOINT_STATES

PERIOD_NS = 2_040_000
JOINT_STATE, BATTERY_STATE = "sensor_msgs/msg/JointState", "sensor_msgs/msg/BatteryState"


@pytest.mark.parametrize("namespace", ["", "/left"])
def test_topics_types_and_qos(graph, start, namespace):
    remap = ["--ros-args", "-r", f"__ns:={namespace}"] if namespace else []
    start("plant", *remap, *parameters(publish_truth=True))
    published = {
        f"{namespace}/{JOINT_STATES}": JOINT_STATE,
        f"{namespace}/{ARMATURE}": BATTERY_STATE,
        f"{namespace}/{TRUTH_JOINT_STATES}": JOINT_STATE,
        f"{namespace}/{TRUTH_ARMATURE}": BATTERY_STATE,
        DIAGNOSTICS: "diagnostic_msgs/msg/DiagnosticArray",
    }
    command = f"{namespace}/duty_command"

    def shown():
        found = graph.shown(f"{namespace}/{JOINT_STATES}")
        return found if found and published.keys() <= found["publishers"].keys() and found["subscriptions"] else None

    found = graph.until(shown, "the plant's topics")
    for topic, kind in published.items():
        (info,) = found["publishers"][topic]
        assert info.topic_type == kind
        assert info.qos_profile.reliability == ReliabilityPolicy.RELIABLE
        assert info.qos_profile.durability == DurabilityPolicy.VOLATILE
        assert info.qos_profile.history in (HistoryPolicy.KEEP_LAST, HistoryPolicy.UNKNOWN)  # not part of discovery
        assert info.qos_profile.depth in (100, 0)
    assert set(found["subscriptions"]) == {command}
    (info,) = found["subscriptions"][command]
    assert info.topic_type == "std_msgs/msg/Float64"
    assert info.qos_profile.reliability == ReliabilityPolicy.RELIABLE

    def services():
        known = dict(graph.node.get_service_names_and_types())
        return known if {f"{namespace}/enable", f"{namespace}/reset"} <= known.keys() else None

    offered = graph.until(services, "the services")
    assert offered[f"{namespace}/enable"] == ["std_srvs/srv/SetBool"]
    assert offered[f"{namespace}/reset"] == ["std_srvs/srv/Trigger"]


def test_truth_and_clock_are_off_by_default(graph, start):
    start("plant", "--ros-args", "-r", "__ns:=/plain")
    expected = {"/plain/joint_states", "/plain/armature", "/diagnostics", "/parameter_events", "/rosout"}

    def topics():
        return set((graph.shown(f"/plain/{JOINT_STATES}") or {}).get("publishers", ()))

    graph.until(lambda: expected <= topics(), "the plant's topics")
    assert topics() == expected


def test_samples_are_as_the_interfaces_define_them(graph, start):
    start("plant", *parameters(publish_truth=True))
    with (
        graph.listening(JointState, JOINT_STATES) as joints,
        graph.listening(BatteryState, ARMATURE) as armature,
        graph.listening(JointState, TRUTH_JOINT_STATES) as true_joints,
        graph.listening(BatteryState, TRUTH_ARMATURE) as true_armature,
        graph.talking(Float64, "duty_command") as send,
    ):
        send(Float64(data=0.3))
        graph.until(lambda: armature and armature[-1].percentage > 0.29, "the duty")
        seen = len(armature)
        graph.until(lambda: len(armature) > seen + 500, "500 samples")

    sample = joints[-1]
    assert list(sample.name) == ["arm", "rotor"]
    assert math.isnan(sample.position[1])
    assert math.isnan(sample.velocity[0])
    assert sample.velocity[1] > 50.0
    assert 0.05 < sample.position[0] < 0.8
    assert list(sample.effort) == []
    assert [math.isnan(value) for value in true_joints[-1].position] == [False, False]
    assert [math.isnan(value) for value in true_joints[-1].velocity] == [False, False]
    for battery in (armature[-1], true_armature[-1]):
        assert battery.location == "armature"
        assert battery.present
        assert battery.percentage == pytest.approx(0.3)
        assert 0.5 < battery.voltage < 2.5
        assert 0.05 < battery.current < 2.0
        others = ("temperature", "charge", "capacity", "design_capacity")
        assert all(math.isnan(getattr(battery, name)) for name in others)

    common = set(stamps(joints)) & set(stamps(armature)) & set(stamps(true_joints)) & set(stamps(true_armature))
    assert len(common) > 500
    for messages in (joints, armature, true_joints, true_armature):
        times = stamps(messages)
        steps = [after - before for before, after in pairwise(times)]
        assert all(step > 0 and step % PERIOD_NS == 0 for step in steps)
        assert steps.count(PERIOD_NS) > 0.95 * len(steps)  # the test itself may miss some under load


def test_stamps_are_ros_time(graph, start):
    start("plant")
    with graph.listening(JointState, JOINT_STATES) as joints:
        graph.until(lambda: len(joints) > 100, "100 samples")
        now = graph.node.get_clock().now().nanoseconds
    assert abs(now - stamps(joints)[-1]) < 1e9
