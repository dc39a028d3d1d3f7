# SPDX-License-Identifier: Apache-2.0
"""The plant node: commands, services, parameters, time."""

import math
import signal
import time

import numpy as np
import pytest
import rclpy
from evaluation.support.graph import Process, parameters, stamps
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import DescribeParameters, GetParameters, SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import Float64
from std_srvs.srv import SetBool, Trigger

from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import load, save
from aeropend_sim.model.rig import Rig
from aeropend_sim.nodes.plant import BACKLOG, PERIOD_NS, Pace, read_parameters
from aeropend_sim.ros.interface import ARMATURE, DUTY_COMMAND, JOINT_STATES
from aeropend_sim.ros.settings import overrides


class FakeTime:
    """A clock that only sleeping moves, by what was asked and an extra delay."""

    def __init__(self) -> None:
        self.now = 1_000_000
        self.delays = []

    def clock(self) -> int:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += round(seconds * 1e9) + (self.delays.pop(0) if self.delays else 0)


def pace(time_):
    return Pace(1000, 10, time_.clock, time_.sleep)


def test_pace_keeps_the_grid_whatever_the_delays():
    time_ = FakeTime()
    p = pace(time_)
    first = p.deadline
    time_.delays = [0, 300, 999, 0, 20]
    for k in range(1, 100):
        assert p.next() == 0
        assert p.deadline == first + 1000 * k
    assert p.late == 0
    assert p.max_lateness_ns == 999


def test_pace_catches_up_without_giving_up_within_the_backlog():
    time_ = FakeTime()
    p = pace(time_)
    first = p.deadline
    time_.delays = [10_500]
    for k in range(1, 30):
        assert p.next() == 0
        assert p.deadline == first + 1000 * k
    assert p.late == 10


def test_pace_gives_up_what_is_older_than_the_backlog_and_says_how_much():
    time_ = FakeTime()
    p = pace(time_)
    first = p.deadline
    time_.delays = [500_000]
    assert p.next() == 490
    assert p.deadline == first + 491 * 1000
    assert [p.next() for _ in range(20)] == [0] * 20
    assert p.deadline == first + 511 * 1000
    assert time_.now < p.deadline + 1000


def test_pace_percentile():
    time_ = FakeTime()
    p = Pace(10_000_000, 10, time_.clock, time_.sleep)
    time_.delays = [100_000] * 98 + [5_000_000] * 2
    for _ in range(100):
        p.next()
    assert p.percentile_ms(0.97) == pytest.approx(0.11)
    assert p.percentile_ms(0.99) == pytest.approx(5.01)


def test_commands_are_clamped_and_nonsense_is_refused_and_counted(graph, start):
    plant = start("plant")
    with graph.listening(BatteryState, ARMATURE) as armature, graph.talking(Float64, DUTY_COMMAND) as send:

        def applied(duty):
            graph.until(lambda: armature and armature[-1].percentage == np.float32(duty), f"duty {duty}")

        for command, duty in ((0.2, 0.2), (7.0, 1.0), (-0.5, 0.0), (0.3, 0.3)):
            send(Float64(data=command))
            applied(duty)
        for nonsense in (math.nan, math.inf, -math.inf):
            send(Float64(data=nonsense))
        counters = graph.diagnostics("plant", lambda values: values["refused commands"] == "3")
        assert counters["enabled"] == "True"
        applied(0.3)
    assert plant.output.count("refused") == 1
    assert plant.output.count("duty_command 7 is outside 0 to 1: clamped (give a fraction, not percent)") == 1
    assert counters["clamped commands"] == "2"
    assert plant.output.count("clamped") == 1


def test_a_bridge_that_reverses_takes_commands_below_0(graph, start):
    start("plant", "--ros-args", "-p", "model.v_full:=2.4", "-p", "model.reverse:=1.0")
    with graph.listening(BatteryState, ARMATURE) as armature, graph.talking(Float64, DUTY_COMMAND) as send:
        for command, duty in ((-0.5, -0.5), (-7.0, -1.0), (0.25, 0.25)):
            send(Float64(data=command))
            graph.until(lambda duty=duty: armature and armature[-1].percentage == np.float32(duty), f"duty {duty}")
        graph.until(lambda: abs(armature[-1].voltage - 0.6) < 0.03, "a quarter of 2.4 V")


def test_off_means_duty_0_until_the_next_command_after_on(graph, start):
    start("plant")
    with graph.listening(BatteryState, ARMATURE) as armature, graph.talking(Float64, DUTY_COMMAND) as send:

        def settled(duty):
            seen = len(armature)
            graph.until(lambda: armature[-1].percentage == np.float32(duty) and len(armature) > seen + 20, f"{duty}")
            assert {message.percentage for message in armature[seen + 15 :]} == {np.float32(duty)}

        send(Float64(data=0.4))
        graph.until(lambda: armature and armature[-1].percentage > 0.0, "the command")
        assert graph.call(SetBool, "enable", SetBool.Request(data=False)).success
        settled(0.0)
        send(Float64(data=0.5))
        settled(0.0)
        assert graph.diagnostics("plant", lambda values: values["enabled"] == "False")
        assert graph.call(SetBool, "enable", SetBool.Request(data=True)).success
        settled(0.0)
        send(Float64(data=0.6))
        settled(0.6)


def test_reset_brings_the_rig_to_rest(graph, start):
    start("plant")
    with (
        graph.listening(JointState, JOINT_STATES) as joints,
        graph.listening(BatteryState, ARMATURE) as armature,
        graph.talking(Float64, DUTY_COMMAND) as send,
    ):
        send(Float64(data=0.5))
        graph.until(lambda: joints and joints[-1].position[0] > 0.3, "the arm to rise")
        assert graph.call(Trigger, "reset", Trigger.Request()).success
        seen = len(joints), len(armature)
        graph.until(lambda: len(joints) > seen[0] + 200 and len(armature) > seen[1] + 200, "200 samples")
    assert all(abs(message.position[0]) < 0.05 for message in joints[seen[0] + 10 :])
    assert {message.percentage for message in armature[seen[1] + 10 :]} == {0.0}
    times = stamps(joints)
    assert np.all(np.diff(times) % PERIOD_NS == 0)


def test_parameters_tell_unit_range_and_that_they_are_fixed(graph, start):
    start("plant", *parameters(effects__gust__sigma=2, seed=5))
    names = ["model.R_a", "sensing.angle_lsb", "effects.gust.tau", "speed", "seed", "preset"]
    described = graph.call(DescribeParameters, "/plant/describe_parameters", DescribeParameters.Request(names=names))
    r_a, lsb, tau, speed, seed, preset = described.descriptors
    assert "Ω" in r_a.description
    assert (r_a.floating_point_range[0].from_value, r_a.floating_point_range[0].to_value) == (1e-3, 1e3)
    assert "rad" in lsb.description
    assert "[s]" in tau.description
    assert speed.floating_point_range[0].from_value == 0.0
    assert seed.integer_range[0].from_value == 0
    assert "thesis" in preset.additional_constraints
    assert all(descriptor.read_only for descriptor in described.descriptors)

    names = ["model.R_a", "effects.gust.sigma", "effects.gust.tau", "seed"]
    values = graph.call(GetParameters, "/plant/get_parameters", GetParameters.Request(names=names)).values
    assert [value.double_value for value in values[:3]] == [1.08, 2.0, CATALOGUE["gust"].parameters["tau"].default]
    assert values[3].integer_value == 5

    request = SetParameters.Request(parameters=[Parameter("model.R_a", value=2.0).to_parameter_msg()])
    result: SetParametersResult = graph.call(SetParameters, "/plant/set_parameters", request).results[0]
    assert not result.successful
    assert "read-only" in result.reason


def read_file(path):
    """Read a parameter file as the plant does, in a node of this process."""
    context = rclpy.Context()
    rclpy.init(args=["--ros-args", "--params-file", str(path)], context=context)
    node = Node("plant", context=context, automatically_declare_parameters_from_overrides=True)
    try:
        return read_parameters(node, overrides(node))
    finally:
        node.destroy_node()
        context.try_shutdown()


@pytest.mark.parametrize("effect", [*CATALOGUE, "none"])
def test_saved_models_are_read_back(tmp_path, effect):
    defaults = {id_: {key: p.default for key, p in CATALOGUE[id_].parameters.items()} for id_ in CATALOGUE}
    model = load("thesis").with_effects({effect: defaults[effect]} if effect != "none" else {})
    save(model, tmp_path / "model.yaml")
    _, read = read_file(tmp_path / "model.yaml")
    assert (dict(read.model), dict(read.sensing), dict(read.effects)) == (model.model, model.sensing, model.effects)


def write(path, body):
    path.write_text("/**:\n  ros__parameters:\n" + "".join(f"    {line}\n" for line in body.splitlines()))
    return ["--ros-args", "--params-file", str(path)]


def test_a_file_with_every_effect_runs(graph, start, tmp_path):
    lines = ["effects:", *(f"  {id_}: {{}}" for id_ in CATALOGUE), "  parameter_mismatch: {R_a: 2}", "seed: 3"]
    start("plant", *write(tmp_path / "all.yaml", "\n".join(lines)))
    with graph.listening(JointState, JOINT_STATES) as joints, graph.talking(Float64, DUTY_COMMAND) as send:
        send(Float64(data=0.45))
        graph.until(lambda: len(joints) > 1000, "1000 samples")
    request = GetParameters.Request(names=["effects.gust.sigma", "effects.parameter_mismatch.R_a", "seed"])
    values = graph.call(GetParameters, "/plant/get_parameters", request).values
    assert values[0].double_value == CATALOGUE["gust"].parameters["sigma"].default
    assert (values[1].double_value, values[2].integer_value) == (2.0, 3)
    assert all(math.isfinite(message.position[0]) and math.isfinite(message.velocity[1]) for message in joints)


@pytest.mark.parametrize("body", ["effects: {}\nseed: 3", "seed: 3\nmodel: {R_a: 1}\neffects:", "{}"])
def test_empty_effects_are_no_effects(start, tmp_path, body):
    plant = start("plant", *write(tmp_path / "model.yaml", body)).wait_for("effects: none")
    assert plant.stop() == 0


BAD = {
    "effects: {gusts: {sigma: 1}}": "did you mean gust?",
    "effects: {gust: {sigmaa: 1}}": "did you mean sigma?",
    "effects: {gusts: {}}": "did you mean gust?",
    "effects: {gust: {sigma: 1e3}}": "give 0 to 50",
    "effects: {gust: {sigma: .nan}}": "effects.gust.sigma",
    "effects: {gust: {sigma: strong}}": "give a number in rad/s²",
    "effects: {gust: {sigma: true}}": "give a number in rad/s²",
    "effects: gust": "by id",
    "effects: {parameter_mismatch: {R_b: 1}}": "did you mean R_a?",
    "model: {R_x: 1}": "did you mean model.R_a?",
    "model: {R_a: -1}": "give 0.001 to 1000",
    "sensing: {angle_lbs: 0}": "did you mean sensing.angle_lsb?",
    "speeed: 1.0": "did you mean speed?",
    "seed: -1": "parameter seed is -1: give 0 to 2147483647",
    "speed: -1.0": "give 0 to 1000",
    "seed: 1.5": "whole number",
    "preset: workbench": "one of bench, thesis",
    "publish_truth: 1": "true or false",
    "model: {R_a: 1": "line",
    "model: {R_a: [1, x]}": "line",
    "\tmodel: 1": "line",
}


def assert_one_line(process, expected):
    assert process.wait() == 2, process.output
    (line,) = process.output.splitlines()
    assert line.startswith("plant: ")
    assert expected in line


@pytest.mark.promise("Commands", "An input that cannot be used ends a command with one line and exit code 2")
def test_bad_files_and_arguments_end_in_one_line_and_exit_code_2(start, tmp_path):
    cases = [(write(tmp_path / f"{at}.yaml", body), expected) for at, (body, expected) in enumerate(BAD.items())]
    for name, text, expected in (
        ("typo.yaml", "/**:\n  ros__parameter:\n    seed: 1\n", "typo.yaml"),
        ("bare.yaml", "model: {R_a: 1}\n", "bare.yaml"),
        ("list.yaml", "- 1\n", "list.yaml"),
        ("latin.yaml", "/**:\n  ros__parameters: {}\n# \xe9\n", "latin.yaml"),
    ):
        (tmp_path / name).write_text(text, encoding="latin-1")
        cases.append((["--ros-args", "--params-file", str(tmp_path / name)], expected))
    cases += [
        (["--ros-args", "--params-file", str(tmp_path / "missing.yaml")], "missing.yaml"),
        (["--ros-args", "--params-file", str(tmp_path)], str(tmp_path)),
        (["--ros-args", "--params-file"], "--params-file"),
        (["--ros-args", "-p", "seed"], "seed"),
        (["--ros-args", "--sed"], "--sed"),
        (["model.yaml"], "model.yaml"),
    ]
    for at in range(0, len(cases), 4):
        batch = [(start("plant", *args), expected) for args, expected in cases[at : at + 4]]
        for process, expected in batch:
            assert_one_line(process, expected)


def test_help_names_parameters_and_examples(start):
    plant = start("plant", "--help")
    assert plant.wait() == 0
    for text in ("usage: plant", "preset", "speed", "publish_truth", "coulomb_friction", "--params-file"):
        assert text in plant.output


def test_simulated_time_is_the_same_rig_to_the_last_bit(graph, start):
    start("plant", *parameters(speed=0.8, seed=11, effects__gust__sigma=1.0))
    with (
        graph.listening(JointState, JOINT_STATES) as joints,
        graph.listening(BatteryState, ARMATURE) as armature,
        graph.talking(Float64, DUTY_COMMAND) as send,
    ):
        graph.until(lambda: joints and armature, "the first samples")
        for command in (0.4, 0.1, 0.55, 0.0):
            send(Float64(data=command))
            graph.until(lambda command=command: armature[-1].percentage == np.float32(command), "the command")
            seen = len(joints)
            graph.until(lambda seen=seen: len(joints) > seen + 300, "300 samples")

    sample = np.array(stamps(armature)) // PERIOD_NS - 1  # 0 is the plant's first
    duty = np.zeros(sample[-1] + 1)
    for first, message in zip(sample, armature, strict=True):
        duty[first:] = message.percentage
    model = load("bench").with_effects({"gust": {"sigma": 1.0, "tau": CATALOGUE["gust"].parameters["tau"].default}})
    reading, _ = Rig(model, 11).run(duty)
    assert [message.current for message in armature] == reading[2, sample].astype(np.float32).tolist()
    assert [message.voltage for message in armature] == reading[3, sample].astype(np.float32).tolist()
    joints = [message for message in joints if stamps([message])[0] <= stamps(armature)[-1]]
    sample = np.array(stamps(joints)) // PERIOD_NS - 1
    assert [message.position[0] for message in joints] == reading[0, sample].tolist()
    assert [message.velocity[1] for message in joints] == reading[1, sample].tolist()
    assert len(joints) > 1200


@pytest.mark.parametrize("speed", [2.0, 0.0])
def test_faster_than_real_time_publishes_the_clock(graph, start, speed):
    start("plant", *parameters(speed=speed))
    with graph.listening(Clock, "/clock") as clock, graph.listening(JointState, JOINT_STATES) as joints:
        graph.until(lambda: len(clock) > 300 and len(joints) > 300, "the clock")
    times = [message.clock.sec * 10**9 + message.clock.nanosec for message in clock]
    assert all(time_ % PERIOD_NS == 0 for time_ in times)
    assert np.all(np.diff(times) > 0)
    assert np.all(np.diff(stamps(joints)) % PERIOD_NS == 0)
    assert 0 < times[0] < 60e9


def test_a_process_that_stood_still_is_back_on_ros_time(graph, start):
    plant = start("plant")
    with graph.listening(JointState, JOINT_STATES) as joints:
        graph.until(lambda: len(joints) > 100, "100 samples")
        plant.send(signal.SIGSTOP)
        time.sleep(1.0)
        plant.send(signal.SIGCONT)
        seen = len(joints)
        graph.until(lambda: len(joints) > seen + 300, "300 more samples")
        now = graph.node.get_clock().now().nanoseconds
    steps = np.diff(stamps(joints))
    assert np.all(steps % PERIOD_NS == 0)
    missing = int((steps // PERIOD_NS - 1).sum())
    counters = graph.diagnostics("plant", lambda values: int(values["samples"]) > len(joints))
    assert missing >= int(counters["lost ticks"]) > 400 - BACKLOG  # the test itself may miss some under load
    assert abs(now - stamps(joints)[-1]) < 0.5e9
    assert "samples lost" in plant.output


def test_diagnostics_hold_the_counters(graph, start):
    start("plant")
    counters = graph.diagnostics("plant")
    for name in ("samples", "late ticks", "lost ticks", "refused commands", "lateness p99 ms", "cpu share", "enabled"):
        assert name in counters


def test_stopping_is_clean(start):
    plant: Process = start("plant").wait_for("effects: none")
    assert plant.stop() == 0
    assert "Traceback" not in plant.output
