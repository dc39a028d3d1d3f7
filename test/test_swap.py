# SPDX-License-Identifier: Apache-2.0
"""Plant or board: the graph looks the same, and all other nodes start with the same arguments."""

import json
import math
import subprocess
import sys
import time

import numpy as np
import pytest
from evaluation import swap
from evaluation.support.graph import Process, parameters, stamps
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import Float64

from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.ros.interface import ARMATURE, JOINT_STATES, RESET

NAMESPACE = "/rig"
EFFECT, PLACE = "coulomb_friction", "arm"
RECORDED_S = 30.0
LAWS = ("feedback_linearization_cascade",)


def endpoints(graph, node):
    """Everything a node shows to the graph: topics with types and QoS, services with types."""
    name = f"{NAMESPACE}/{node}"

    def qos(info):
        profile = info.qos_profile
        return (
            info.topic_type, profile.reliability, profile.durability, profile.history, profile.depth,
            profile.deadline.nanoseconds, profile.lifespan.nanoseconds, profile.liveliness,
        )  # fmt: skip

    def all_of_them():
        shown = graph.shown(f"{NAMESPACE}/{JOINT_STATES}")
        if not shown:
            return None
        found = {kind: {topic: sorted(map(qos, own)) for topic, own in ends.items()} for kind, ends in shown.items()}
        found["services"] = {
            service.replace(name, "NODE"): types
            for service, types in graph.node.get_service_names_and_types()
            if service.startswith(f"{NAMESPACE}/")
        }
        complete = f"{NAMESPACE}/enable" in found["services"] and "/diagnostics" in found["publishers"]
        return found if complete and found["subscriptions"] else None

    return graph.until(all_of_them, f"the graph of {node}")


def settled(graph, node):
    """The same, once discovery has nothing to add."""
    found, seconds = None, 0
    while seconds < 4:  # looks without news
        again = endpoints(graph, node)
        seconds = seconds + 1 if again == found else 0
        found = again
        graph.until(lambda clock=[0]: clock.append(0) or len(clock) > 10, "a moment")
    return found


def seen(graph, node):
    """What a node shows, and a sample of it."""
    found = settled(graph, node)
    with (
        graph.listening(JointState, f"{NAMESPACE}/{JOINT_STATES}") as joints,
        graph.listening(BatteryState, f"{NAMESPACE}/{ARMATURE}") as armature,
    ):
        graph.until(lambda: len(joints) > 300 and len(armature) > 300, "samples")
    return found, joints, armature


def shape(message):
    """A message without its numbers: which are there, which are NaN, texts, lengths."""
    if hasattr(message, "get_fields_and_field_types"):
        return {field: shape(getattr(message, field)) for field in message.get_fields_and_field_types()
                if field != "stamp"}  # fmt: skip
    if isinstance(message, float):
        return "NaN" if math.isnan(message) else "number"
    if isinstance(message, (str, bool, int)):
        return message
    return [shape(item) for item in message]


@pytest.mark.promise("Hardware", "The bridge replaces the plant without any other change")
def test_the_graphs_are_the_same_item_by_item(graph):
    remap = ["--ros-args", "-r", f"__ns:={NAMESPACE}"]
    graphs, joints, armature = {}, {}, {}
    for node in ("plant", "bridge"):
        with swap.rig(node, args=remap):
            graphs[node], joints[node], armature[node] = seen(graph, node)
    del graphs["plant"]["services"][f"{NAMESPACE}/{RESET}"]  # only the plant has it (docs/interfaces.md)
    assert graphs["bridge"] == graphs["plant"]
    for messages in joints, armature:
        assert shape(messages["bridge"][-1]) == shape(messages["plant"][-1])
        period = {node: (stamps(messages[node])[-1] - stamps(messages[node])[0]) / (len(messages[node]) - 1)
                  for node in messages}  # fmt: skip
        assert period["bridge"] == pytest.approx(period["plant"], rel=0.02)


def test_the_firmware_is_back_within_a_second_at_duty_0_and_stops_without_its_host(graph, tmp_path):
    remap = ["--ros-args", "-r", "__ns:=/faults"]
    truth = tmp_path / "truth"
    with (
        swap.emulated_board("--truth", str(truth)) as board,
        Process("bridge", *parameters(port=board.port), *remap) as bridge,
        graph.listening(BatteryState, f"/faults/{ARMATURE}") as armature,
        graph.talking(Float64, "/faults/duty_command") as send,
    ):
        def commanded():
            send(Float64(data=0.4))
            return armature and armature[-1].percentage > 0.3

        for fault, away_s in ("reset", 0.0), ("hang", 0.06), ("unplug+0.3", 0.3):
            graph.until(commanded, "the duty")
            at = board.inject(fault)
            graph.until(lambda at=at: stamps(armature[-1:])[0] > at + 0.25e9, "samples again")
            times = np.array(stamps(armature))
            last = np.flatnonzero(np.diff(times) > 0.1e9)[-1]
            assert times[last + 1] - at < (away_s + 1.0) * 1e9
            assert {message.percentage for message in armature[last + 1 :]} == {0.0}
        values = graph.diagnostics("faults/bridge", lambda values: values["gaps"] == "3")
        assert (values["board resets"], values["reconnects"]) == ("2", "1")
        graph.until(commanded, "the duty")
        killed = time.time_ns()
        bridge.popen.kill()
        graph.until(lambda: time.time_ns() > killed + 0.4e9, "the motor to stop")
    rows = np.array([line.split()[:4] for line in truth.read_text().splitlines() if len(line.split()) == 9], dtype=int)
    instant, _, register, written = rows.T
    stopped = np.flatnonzero((instant > killed) & (register == 0))[0]
    assert register[stopped - 1] == 102
    assert 0 < written[stopped] - killed < 0.1e9


@pytest.mark.promise("Hardware", "The bridge replaces the plant without any other change")
@pytest.mark.parametrize("law", LAWS)
def test_a_law_steps_both_rigs_alike(graph, tmp_path, law):
    found = {}
    for number, node in enumerate(("plant", "bridge"), 1):
        with swap.domain(number), swap.rig(node):
            found[node] = swap.steps(law, 2.0, tmp_path / node)
    ratios = swap.ratios(found["plant"], found["bridge"])
    for metric in ("rise_time", "peak_time", "peak"):  # settling within 2 % is a count of the encoder: noise decides
        assert ratios[metric] == pytest.approx(1.0, abs=0.1), metric


@pytest.mark.promise("Hardware", "An effect is found through the bridge")
@pytest.mark.alone
def test_a_withheld_effect_is_found_from_a_recording_through_the_bridge(tmp_path):
    bag = tmp_path / "bag"
    subprocess.run([sys.executable, "-m", "evaluation.swap", "record", bag, str(RECORDED_S), EFFECT], check=True,
                   timeout=120)
    with Process("diagnose", str(bag), "--out", str(tmp_path)) as diagnose:
        assert diagnose.wait(120.0) == 0, diagnose.output
    body = json.loads((tmp_path / "diagnosis.json").read_text())
    assert body["which"]["verdict"] == EFFECT
    assert body["where"]["place"] == PLACE
    (found,) = (one for one in body["which"]["candidates"] if one["effect"] == EFFECT)
    (name,) = CATALOGUE[EFFECT].parameters
    assert found["parameters"][name]["value"] == pytest.approx(CATALOGUE[EFFECT].parameters[name].default, rel=0.05)
