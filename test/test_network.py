# SPDX-License-Identifier: Apache-2.0
"""What goes over the network: how far by default, and what docs/sros2/policy.xml lets whom do."""

import math
import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
from evaluation.support.graph import MODULES, parameters
from rclpy.duration import Duration
from rclpy.serialization import serialize_message
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import Float64
from std_srvs.srv import SetBool

from aeropend_ident.nodes.record import TOPICS
from aeropend_sim.ros import interface
from aeropend_sim.ros.interface import ARMATURE, DUTY_COMMAND, ENABLE, JOINT_STATES, REFERENCE
from aeropend_sim.ros.transport import (
    FOUND_BY_NAME,
    LOCALHOST,
    PROFILES,
    RANGE,
    SUBNET,
    TRANSPORTS,
    without_shared_memory,
)

ROOT = Path(__file__).parents[1]
PEOPLE = {"operator", "viewer"}
"""Enclaves of no node of ours."""

POLICY = {enclave.get("path").removeprefix("/aeropend/"): enclave.findall("profiles/profile")
          for enclave in ElementTree.parse(ROOT / "docs" / "sros2" / "policy.xml").iter("enclave")}


def full(name, namespace, node):
    """A name of the policy as the graph has it."""
    if name.startswith("/"):
        return name
    return f"{namespace}/{node}/{name[2:]}" if name.startswith("~/") else f"{namespace}/{name}"


def allowed(node, namespace):
    """The DDS topics that the policy lets a node publish and subscribe, as sros2's permissions.xsl names them."""
    found = {"publishers": set(), "subscriptions": set()}
    for name, part in ((profile.get("node"), part) for profile in POLICY[node] for part in profile):
        names = [full(one.text, namespace, name) for one in part]
        for kind in set(part.attrib):
            assert part.get(kind) == "ALLOW"
            if kind in ("publish", "subscribe"):
                found["publishers" if kind == "publish" else "subscriptions"] |= {f"rt{name}" for name in names}
            else:
                ask, answer = ("publishers", "subscriptions") if kind == "request" else ("subscriptions", "publishers")
                found[ask] |= {f"rq{name}Request" for name in names}
                found[answer] |= {f"rr{name}Reply" for name in names}
    return found


def shown(graph, namespaces):
    """The DDS topics that the node of each namespace publishes and subscribes."""
    ours = {node: f"rr{namespace}/{node}/get_parametersReply" for node, namespace in namespaces.items()}
    topics = [name for name, _ in graph.node.get_topic_names_and_types(no_demangle=True)]
    infos = {"publishers": graph.node.get_publishers_info_by_topic,
             "subscriptions": graph.node.get_subscriptions_info_by_topic}
    ends = {kind: {topic: {tuple(info.endpoint_gid[:12]) for info in ask(topic, no_mangle=True)} for topic in topics}
            for kind, ask in infos.items()}
    process = {node: next(iter(ends["publishers"].get(topic, ())), None) for node, topic in ours.items()}
    return {node: {kind: {topic for topic, there in ends[kind].items() if process[node] in there} - {
        "ros_discovery_info"} for kind in ends} for node in namespaces}


@pytest.fixture
def bag(tmp_path):
    """A bag with a topic of each kind."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, msgtype in TOPICS.items():
            writer.write(writer.add_connection(f"/{topic.lstrip('/')}", msgtype, typestore=store), 1, b"\0\1\0\0")
    return tmp_path / "bag"


def test_every_node_has_an_enclave_and_nobody_else():
    commands = {"calibrate", "diagnose"}  # no nodes
    assert POLICY.keys() == (MODULES.keys() - commands) | PEOPLE


def test_the_policy_names_every_topic_and_service_of_every_node_and_nothing_more(graph, start, tmp_path, bag):
    more = {
        "plant": parameters(publish_truth=True),
        "bridge": parameters(port="/dev/none"),
        "reference": ["0.2", "--ros-args"],
        "step_test": ["--out", str(tmp_path / "steps"), "--ros-args"],
        "record": [str(tmp_path / "out"), *parameters(truth=True)],
        "replay": [str(bag), *parameters(wait=60.0)],
    }
    namespaces = {node: f"/n_{node}" for node in sorted(POLICY.keys() - PEOPLE)}
    for node, namespace in namespaces.items():
        start(node, *more.get(node, ["--ros-args"]), "-r", f"__ns:={namespace}")
    expected = {node: allowed(node, namespace) for node, namespace in namespaces.items()}
    graph.until(lambda: all(expected[node][kind] <= there[kind] for node, there in shown(graph, namespaces).items()
                            for kind in there), "all that the policy names")
    assert shown(graph, namespaces) == expected


def test_the_operator_may_ask_what_is_offered_and_command_what_is_taken():
    offered = {name for node in POLICY.keys() - PEOPLE for name in allowed(node, "")["subscriptions"]}
    sent = {name for name in allowed("operator", "")["publishers"] if not name.startswith("rr")}
    assert sent - {"rt/rosout", "rt/parameter_events"} <= offered
    assert {f"rt/{DUTY_COMMAND}", f"rt/{REFERENCE}", "rq/enableRequest", "rq/resetRequest"} <= sent
    looks = allowed("viewer", "")["publishers"]
    assert {name for name in looks if not name.startswith("rr/viewer/")} == {"rt/rosout", "rt/parameter_events"}


def test_where_security_cannot_be_had_no_node_starts(tmp_path):
    """Whether there is no keystore, or no DDS that could use it: nothing is ever said in the clear."""
    security = {"ROS_SECURITY_ENABLE": "true", "ROS_SECURITY_STRATEGY": "Enforce",
                "ROS_SECURITY_KEYSTORE": str(tmp_path)}
    enclave = tmp_path / "enclaves" / "aeropend" / "plant"
    enclave.mkdir(parents=True)
    for name in ("identity_ca.cert.pem", "cert.pem", "key.pem", "permissions_ca.cert.pem", "governance.p7s",
                 "permissions.p7s"):
        (enclave / name).touch()
    for path in ("/", "/aeropend/plant"):
        result = subprocess.run([sys.executable, "-m", MODULES["plant"], "--ros-args", "--enclave", path],
                                env={**os.environ, **security}, capture_output=True, text=True, check=False, timeout=60)
        assert result.returncode == 2
        assert result.stdout == ""
        assert len(result.stderr.strip().splitlines()) == 1


@pytest.mark.promise("Start", "Every `make` target keeps ROS traffic on this machine")
@pytest.mark.parametrize(("given", "expected"), [(None, "LOCALHOST"), ("SUBNET", "SUBNET")])
def test_make_keeps_to_this_machine_unless_told_otherwise(given, expected):
    environment = {key: value for key, value in os.environ.items()
                   if key not in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "MAKEFLAGS", "MAKELEVEL")}
    if given:
        environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = given
    recipe = "_range: ; @printenv ROS_AUTOMATIC_DISCOVERY_RANGE"
    result = subprocess.run(["make", "-s", f"--eval={recipe}", "_range"], cwd=ROOT, env=environment,
                            capture_output=True, text=True, check=True)
    assert result.stdout.strip() == expected


SHARED = {RANGE: "LOCALHOST", TRANSPORTS: "DEFAULT"}


@pytest.mark.parametrize(("given", "expected"), [
    ({}, {PROFILES: str(SUBNET)}),
    ({RANGE: "SUBNET"}, {RANGE: "SUBNET", PROFILES: str(SUBNET)}),
    ({RANGE: "OFF", TRANSPORTS: "UDPv4"}, {RANGE: "OFF", PROFILES: str(SUBNET)}),
    ({RANGE: "LOCALHOST"}, {RANGE: "SUBNET", PROFILES: str(LOCALHOST)}),
    ({RANGE: "LOCALHOST", TRANSPORTS: "UDPv4"}, {RANGE: "SUBNET", PROFILES: str(LOCALHOST)}),
    ({RANGE: "LOCALHOST", PROFILES: "mine.xml"}, {RANGE: "LOCALHOST", PROFILES: "mine.xml"}),
    ({PROFILES: "mine.xml"}, {PROFILES: "mine.xml"}),
    (SHARED, SHARED),
])
def test_messages_go_by_udp_unless_somebody_chose(given, expected):
    for _ in range(2):  # a process it starts does it once more
        without_shared_memory(given := dict(given))
        assert given == expected


@pytest.mark.parametrize("name", FOUND_BY_NAME)
def test_a_profile_in_the_folder_of_a_process_is_left_to_work(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).touch()
    without_shared_memory(given := {RANGE: "LOCALHOST"})
    assert given == {RANGE: "LOCALHOST"}


def threads(process):
    """The names of the threads of a process."""
    return {(folder / "comm").read_text().strip() for folder in Path(f"/proc/{process.popen.pid}/task").iterdir()}


@pytest.mark.parametrize("shared", [False, True])
def test_a_node_has_no_shared_memory_hears_no_multicast_and_is_heard_by_all(graph, start, monkeypatch, shared):
    """Multicast comes at port 7400 + 250 per domain."""
    for name in (PROFILES, TRANSPORTS):
        monkeypatch.delenv(name, raising=False)
    for name, value in (SHARED if shared else {RANGE: "LOCALHOST"}).items():
        monkeypatch.setenv(name, value)
    plant = start("plant", "--ros-args", "-r", "__ns:=/transported")
    with graph.listening(JointState, f"/transported/{JOINT_STATES}") as heard:
        graph.until(lambda: len(heard) > 100, "samples")
    assert any(name.startswith("dds.shm") for name in threads(plant)) == shared
    assert f"dds.udp.{7400 + 250 * int(os.environ['ROS_DOMAIN_ID'])}" not in threads(plant)


def test_a_node_has_no_shared_memory_either_where_it_is_not_kept_to_this_machine(start, monkeypatch):
    """With the range OFF, in which it has the same profile as on a network: no test talks to other machines."""
    for name in (PROFILES, TRANSPORTS):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv(RANGE, "OFF")
    plant = start("plant")
    plant.wait_for("model bench")
    assert any(name.startswith("dds.udp") for name in threads(plant))
    assert not any(name.startswith("dds.shm") for name in threads(plant))


RIG = ["-r", f"{JOINT_STATES}:=/strange/{JOINT_STATES}", "-r", f"{ARMATURE}:=/strange/{ARMATURE}"]


def spoil(graph, kind, topic, good, listeners):
    """Send what is no message to everybody who listens to a topic."""
    publisher = graph.node.create_publisher(kind, topic, interface.QOS)
    graph.until(lambda: publisher.get_subscription_count() >= listeners, f"who listens to {topic}")
    for bad in (good[: len(good) // 2], b"\0\1\0\0\1\2", b"\xff" * len(good), good[:4] + b"\xff" * (len(good) - 4)):
        publisher.publish(bad)
    graph.until(lambda: publisher.wait_for_all_acked(Duration(seconds=1.0)), f"all of {topic}")
    graph.node.destroy_publisher(publisher)


def test_what_is_no_message_is_passed_over(graph, start):
    """Bytes of any kind under the name of a type: the middleware takes them from anybody."""
    start("plant")
    start("pose", "--ros-args", *RIG)
    start("small_signal", "--ros-args", *RIG, "-r", "duty_command:=/strange/duty_command")
    sample = serialize_message(interface.joint_states_message(10**18, 0.1, 5.0))
    half = serialize_message(interface.armature_message(10**18, 0.5, 0.1, 0.1))
    number = serialize_message(Float64(data=0.2))
    for kind, topic, good, listeners in ((JointState, f"/strange/{JOINT_STATES}", sample, 2),
                                         (BatteryState, f"/strange/{ARMATURE}", half, 1),
                                         (Float64, DUTY_COMMAND, number, 1), (Float64, REFERENCE, number, 1)):
        spoil(graph, kind, topic, good, listeners)
    graph.diagnostics("small_signal", lambda values: int(values["malformed"]) >= 6)
    graph.diagnostics("pose", lambda values: int(values["malformed"]) >= 1)
    with graph.listening(BatteryState, ARMATURE) as armature, graph.talking(Float64, DUTY_COMMAND) as send:
        send(Float64(data=0.25))
        graph.until(lambda: armature and armature[-1].percentage == 0.25, "the duty")


def test_a_flood_of_junk_commands_stops_neither_the_plant_nor_who_turns_it_off(graph, start):
    plant = start("plant")
    with graph.listening(BatteryState, ARMATURE) as armature, graph.talking(Float64, DUTY_COMMAND) as send:
        send(Float64(data=0.5))
        graph.until(lambda: armature and armature[-1].percentage == 0.5, "the duty")
        before = memory(plant)
        for k in range(20_000):
            send(Float64(data=(math.nan, 7.0, -math.inf, -3.0)[k % 4]))
        assert graph.call(SetBool, ENABLE, SetBool.Request(data=False)).success
        for _ in range(2000):
            send(Float64(data=1.0))
        seen = len(armature)
        graph.until(lambda: len(armature) > seen + 400, "0.8 s of samples")  # the first were taken before
        assert {one.percentage for one in armature[seen + 200:]} == {0.0}
        counters = graph.diagnostics("plant", lambda values: values["enabled"] == "False")
    assert int(counters["refused commands"]) > 0
    assert plant.output.count("refused") == 1
    assert memory(plant) - before < 50_000


def memory(process):
    """What a process holds, kB."""
    status = Path(f"/proc/{process.popen.pid}/status").read_text()
    return next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS"))
