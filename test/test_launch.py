# SPDX-License-Identifier: Apache-2.0
"""The launch files name what there is; what they do to topics and namespaces is done here to the same nodes.

ROS's launch cannot be had by pip, so the files are read as what they are: lists of nodes, arguments and parameters.
"""

import importlib
import re
from contextlib import suppress
from pathlib import Path

import pytest
import yaml
from evaluation.support.graph import parameters

from aeropend_sim.cli.completion import commands
from aeropend_sim.model.parameters import load
from aeropend_sim.ros import interface

FOLDER = Path(__file__).parents[1] / "src" / "aeropend_ident" / "aeropend_ident" / "launch"
FILES = {path.name: yaml.safe_load(path.read_text(encoding="utf-8"))["launch"] for path in FOLDER.glob("*.launch.yaml")}
COMMANDS = {entry.name: entry for entry in commands()}
TOPICS = {interface.JOINT_STATES, interface.ARMATURE, interface.DUTY_COMMAND, interface.REFERENCE}
DRIVERS = ("excite", "small_signal", "feedback_linearization", "cascade", "feedback_linearization_cascade")


def entries(name, kind):
    return [action[kind] for action in FILES[name] if kind in action]


def arguments(name):
    """The arguments of a file, with those of the files that it includes."""
    mine = {one["name"]: one for one in entries(name, "arg")}
    for include in entries(name, "include"):
        mine = arguments(include["file"].rpartition("/")[2]) | mine
    return mine


NODES = [pytest.param(name, node, command, id=f"{name} {command}") for name in FILES for node in entries(name, "node")
         for command in (DRIVERS[1:] if node["exec"].startswith("$") else [node["exec"]])]


@pytest.mark.promise("Views", "Launch files start the simulated and the real rig, drive them and record them")
@pytest.mark.parametrize(("name", "node", "command"), NODES)
def test_a_launch_file_starts_a_node_with_parameters_and_topics_that_it_has(name, node, command, capsys):
    entry = COMMANDS[command]
    assert entry.value.startswith(f"{node['pkg']}.")
    module, _, function = entry.value.partition(":")
    with suppress(SystemExit):
        getattr(importlib.import_module(module), function)(["--help"])
    told = set(re.findall(r"\w+", capsys.readouterr().out)) | {"use_sim_time"}
    assert {one["name"] for one in node.get("param", []) if "name" in one} <= told
    remapped = {one["from"]: one["to"] for one in node["remap"]}
    assert remapped.keys() <= TOPICS
    assert all(to == f"$(var {topic})" for topic, to in remapped.items())
    assert node["namespace"] == "$(var namespace)"


@pytest.mark.parametrize("name", FILES)
def test_each_argument_is_described_and_used(name):
    known, text = arguments(name), (FOLDER / name).read_text(encoding="utf-8")
    used = set(re.findall(r"\$\(var (\w+)\)", text))
    assert used <= known.keys()
    for one in entries(name, "arg"):
        assert one["description"]
        assert one["name"] in used
        assert isinstance(one["default"], str)  # launch takes no other type


@pytest.mark.parametrize("name", FILES)
def test_the_drivers_that_can_be_chosen_are_all_there_are(name):
    choices = [one["value"] for one in arguments(name)["control"]["choice"]]
    assert choices == ["none", *DRIVERS]
    load("bench")  # the default model is that preset's file
    assert arguments(name)["model"]["default"].endswith("config/bench.yaml")


@pytest.mark.promise("Views", "Each topic can be remapped, and two rigs run in two namespaces")
def test_each_topic_can_be_remapped_in_two_namespaces(graph, start):
    """The command lines are those that launch makes of sim.launch.yaml (seen with launch 3.4.3)."""
    names = {topic: f"my_{topic}" for topic in sorted(TOPICS)}
    remaps = [word for topic, to in names.items() for word in ("-r", f"{topic}:={to}")]
    rigs = ("/left", "/right")
    for rig in rigs:
        start("plant", *parameters(seed=1), "-r", f"__ns:={rig}", *remaps)
        start("small_signal", "--ros-args", "-r", f"__ns:={rig}", *remaps)

    def ends():
        return {(rig, topic): (graph.node.count_publishers(f"{rig}/{to}"), graph.node.count_subscribers(f"{rig}/{to}"))
                for rig in rigs for topic, to in names.items()}

    expected = {(rig, topic): (0 if topic == interface.REFERENCE else 1, 1) for rig in rigs for topic in names}
    graph.until(lambda: ends() == expected, "all topics under their new names")
    found = {name for name, _ in graph.node.get_topic_names_and_types()}
    assert not {f"{rig}/{topic}" for rig in rigs for topic in names} & found


def test_what_plant_pose_and_watch_publish_besides_can_be_remapped_too(graph, start):
    published = {interface.TRUTH_JOINT_STATES: {"plant"}, interface.TRUTH_ARMATURE: {"plant"}, interface.POSE: {"pose"},
                 interface.MODEL_JOINT_STATES: {"watch"}, interface.MODEL_ARMATURE: {"watch"},
                 interface.DIAGNOSTICS: {"plant", "pose", "watch"}, interface.JOINT_STATES: {"plant"},
                 interface.ARMATURE: {"plant"}}
    old = {topic: topic if topic.startswith("/") else f"/rig/{topic}" for topic in published}
    new = {topic: f"{name}_of_mine" for topic, name in old.items()}
    remaps = ["-r", "__ns:=/rig", *(word for topic, name in new.items() for word in ("-r", f"{topic}:={name}"))]
    start("plant", *parameters(publish_truth=True), *remaps)
    start("pose", "--ros-args", *remaps)
    start("watch", *parameters(bags="''"), *remaps)

    def publishers():
        return {topic: {end.node_name for end in graph.node.get_publishers_info_by_topic(name)}
                for topic, name in new.items()}

    graph.until(lambda: publishers() == published, "all topics under their new names")
    graph.until(lambda: graph.node.count_subscribers(new[interface.JOINT_STATES]) == 2, "pose and watch to listen")
    assert not set(old.values()) & {name for name, _ in graph.node.get_topic_names_and_types()}
