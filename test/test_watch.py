# SPDX-License-Identifier: Apache-2.0
"""The node `watch` beside a running plant: topics, states, page, alarm bag."""

import json
import subprocess
import sys
import urllib.request

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from evaluation.support.graph import parameters, stamps
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from tornado.ioloop import IOLoop
from tornado.websocket import websocket_connect

from aeropend_ident.nodes import said
from aeropend_ident.nodes.topic_recorder import TopicRecorder
from aeropend_sim.model.effects import PLACES
from aeropend_sim.ros import interface

PORT = 18080


def test_messages_are_those_of_rclpy():
    from rclpy.serialization import deserialize_message

    stamp = 1_700_000_000_123_456_789
    assert deserialize_message(said.joint_states(stamp, 0.25, 100.5), JointState).velocity[1] == 100.5
    for made, kind, wanted in (
        (said.joint_states(stamp, 0.25, 100.5), JointState, interface.joint_states_message(stamp, 0.25, 100.5)),
        (said.armature(stamp, 1.5, -0.5, 0.75), BatteryState, interface.armature_message(stamp, 1.5, -0.5, 0.75)),
    ):
        assert str(deserialize_message(made, kind)) == str(wanted)


def test_the_model_speaks_beside_the_rig_and_the_page_shows_what_is_published(graph, start, tmp_path):
    watch = start("watch", *parameters(page=True, page_port=PORT, bags=str(tmp_path / "alarms")))
    start("plant")
    with (
        graph.listening(JointState, interface.JOINT_STATES) as rig,
        graph.listening(JointState, interface.MODEL_JOINT_STATES) as model,
        graph.listening(DiagnosticArray, interface.DIAGNOSTICS) as told,
    ):
        graph.until(lambda: len(model) > 490, "a second of the model")
        page = IOLoop(make_current=False).run_sync(_first_samples)
        graph.until(lambda: len(rig) and stamps(rig[-1:])[0] > page[-1][0] * 1e9 + 1e8, "what the page has shown")
        graph.until(lambda: any(len(m.status) > len(PLACES) for m in told), "the state of each place")
    assert set(stamps(model[5:-100])) <= set(stamps(rig))
    assert {tuple(m.name) for m in model} == {interface.JOINTS}
    at = {round(s * 1e-9, 4): m.position[0] for s, m in zip(stamps(rig), rig, strict=True)}
    shown = [(at[row[0]], row[1]) for row in page if row[0] in at]
    assert shown
    assert np.allclose(*np.array(shown).T, rtol=1e-3, atol=1e-6)
    with urllib.request.urlopen(f"http://127.0.0.1:{PORT}/", timeout=10) as answer:
        assert "default-src 'self'" in answer.headers["Content-Security-Policy"]
        assert b"http://" not in answer.read()
    assert graph.call(Trigger, "watch/clear", Trigger.Request()).success
    assert watch.stop() == 0
    assert "no sample yet" not in watch.output


def test_no_message_is_lost_when_a_publisher_of_another_qos_comes(graph):
    subscriber, topic, taken = Node("counting", context=graph.node.context), "/counted", []
    recorder = TopicRecorder(topic, "std_msgs/msg/Float64")

    def look():
        recorder.follow(subscriber, subscriber.get_publishers_info_by_topic(topic), 0.0,
                        lambda: taken.extend(iter(recorder.take, None)))
        return recorder.publishers

    reliable = graph.node.create_publisher(Float64, topic, 100)
    graph.until(lambda: look() == 1 and reliable.get_subscription_count(), "the subscription")
    for k in range(50):
        reliable.publish(Float64(data=float(k)))
    assert reliable.wait_for_all_acked(Duration(seconds=20))
    other = graph.node.create_publisher(Float64, topic, QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    graph.until(lambda: look() == 2, "the other publisher")
    assert recorder.qos.reliability == ReliabilityPolicy.BEST_EFFORT
    assert len(taken) == 50
    for publisher in (reliable, other):
        graph.node.destroy_publisher(publisher)
    subscriber.destroy_node()


def test_a_folder_for_bags_that_cannot_be_made_is_refused_at_the_start(tmp_path):
    (tmp_path / "file").write_text("")
    done = subprocess.run([sys.executable, "-m", "aeropend_ident.nodes.watch",
                           *parameters(bags=str(tmp_path / "file" / "alarms"))], capture_output=True, text=True,
                          timeout=60, check=False)
    assert done.returncode == 2
    assert f"alarms cannot be written ({tmp_path / 'file'} is a file); give another folder" in done.stderr


async def _first_samples() -> list[list[float]]:
    """The samples of the first messages of the page."""
    connection = await websocket_connect(f"ws://127.0.0.1:{PORT}/live")
    rows: list[list[float]] = []
    while len(rows) < 60:
        message = json.loads(await connection.read_message())
        rows += message.get("samples", [])
    connection.close()
    return rows


@pytest.mark.parametrize(("given", "says"), [
    ({"model": "nothing.yaml"}, "nothing.yaml"), ({"page": True, "page_address": "203.0.113.1"}, "cannot be shown"),
])
def test_what_cannot_be_used_is_one_line(start, given, says):
    node = start("watch", *parameters(**given))
    assert node.wait(60.0) == 2
    assert says in node.output
    assert "Traceback" not in node.output
