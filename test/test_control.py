# SPDX-License-Identifier: Apache-2.0
"""The controllers as processes: each moves the arm of a plant, and none moves it when in doubt."""

import json
import math
import signal
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from evaluation.support.graph import Process, parameters
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.parameter import Parameter
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import Float64
from std_srvs.srv import SetBool, Trigger

from aeropend_control.laws.registry import LAWS
from aeropend_ident.commands import step_response
from aeropend_sim.ros.interface import (
    ARMATURE,
    DIAGNOSTICS,
    DUTY_COMMAND,
    ENABLE,
    JOINT_STATES,
    REFERENCE,
    RESET,
    armature_message,
    joint_states_message,
)

PERIOD_NS = 2_040_000
FL = "feedback_linearization"


class Loop:
    """A plant's samples, a controller's commands, and what is said of them."""

    def __init__(self, graph, joints, armature, duty, diagnostics, refer):
        self.graph, self.joints, self.armature, self.duty, self.diagnostics = graph, joints, armature, duty, diagnostics
        self._refer = refer

    def refer(self, value):
        self._refer(Float64(data=value))

    @property
    def theta(self):
        return self.joints[-1].position[0]

    @property
    def omega(self):
        return self.joints[-1].velocity[1]

    @property
    def applied(self):
        return self.armature[-1].percentage

    def samples(self, count, what="samples"):
        """Wait for this many more samples, and return them."""
        seen = len(self.joints)
        self.graph.until(lambda: len(self.joints) >= seen + count, what)
        return self.joints[seen:]

    def stays(self, value, within, read=lambda joint: joint.position[0], count=250):
        """Wait until what is read stays near a value for some samples."""

        def settled():
            last = self.joints[-count:]
            return len(last) == count and all(abs(read(joint) - value) < within for joint in last)

        self.graph.until(settled, f"{value} to be held, and it is {read(self.joints[-1])}")

    def off(self, count=100):
        """Wait until the rig has applied duty 0 for some samples."""
        self.graph.until(lambda: not any(one.percentage for one in self.armature[-count:]), "duty 0")

    def said(self, name, text):
        """Wait until the diagnostics of a node say something."""
        seen = len(self.diagnostics)
        return self.graph.until(
            lambda: [status for message in self.diagnostics[seen:] for status in message.status
                     if status.name == name and text in status.message], f"'{text}' on {DIAGNOSTICS}")


@contextmanager
def listening(graph):
    with (
        graph.listening(JointState, JOINT_STATES) as joints,
        graph.listening(BatteryState, ARMATURE) as armature,
        graph.listening(Float64, DUTY_COMMAND) as duty,
        graph.listening(DiagnosticArray, DIAGNOSTICS) as diagnostics,
        graph.talking(Float64, REFERENCE) as refer,
    ):
        graph.until(lambda: joints and armature and duty, "the loop")
        yield Loop(graph, joints, armature, duty, diagnostics, refer)


@pytest.fixture(scope="module")
def running():
    """A plant with feedback linearization, for all tests that leave them as they were."""
    plant, controller = Process("plant"), Process(FL)
    yield SimpleNamespace(plant=plant, controller=controller)
    controller.stop()
    plant.stop()


@pytest.fixture
def loop(graph, running):
    """The same, the arm held at 0.4 rad."""
    with listening(graph) as loop:
        loop.refer(0.4)
        loop.stays(0.4, 0.05, count=100)
        yield loop
    assert running.controller.popen.poll() is None, running.controller.output


def set_parameters(graph, **values):
    request = SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()
                                                for name, value in values.items()])
    return graph.call(SetParameters, f"/{FL}/set_parameters", request).results


@pytest.mark.promise("Control", "A reference out of range is refused, and the former one stays")
def test_a_reference_out_of_range_is_refused_and_the_arm_stays(loop, running):
    for nonsense in (math.nan, math.inf, -0.1, 9.0):
        loop.refer(nonsense)
    loop.said(FL, "reference 9 refused: give 0 to 1.2 rad")
    loop.stays(0.4, 0.05)
    loop.refer(9.0)
    loop.refer(0.4)
    loop.said(FL, "ok")
    assert running.controller.output.count("reference 9 refused") == 1


BAD_GAINS = {"kp": (-5.0, "out of range"), "ki": (math.nan, "ki"), "thrust_time": (7.0, "thrust_time"),
             "angle_limit": (9.0, "out of range"), "reference_max": (0.0, "reference_min < reference_max")}


@pytest.mark.promise("Control", "A wrong gain or limit is refused with the reason, and the loop continues")
def test_a_bad_gain_or_limit_is_refused_with_a_reason_and_the_loop_goes_on(graph, loop):
    request = GetParameters.Request(names=list(BAD_GAINS))
    before = [value.double_value for value in graph.call(GetParameters, f"/{FL}/get_parameters", request).values]
    seen = len(loop.duty)
    for name, (value, reason) in BAD_GAINS.items():
        (result,) = set_parameters(graph, **{name: value})
        assert not result.successful
        assert reason in result.reason
    loop.stays(0.4, 0.05)
    after = [value.double_value for value in graph.call(GetParameters, f"/{FL}/get_parameters", request).values]
    assert after == before
    assert all(message.data > 0.0 for message in loop.duty[seen:][:1])
    (result,) = set_parameters(graph, model="thesis")
    assert not result.successful
    assert "read-only" in result.reason


@pytest.mark.promise("Control", "A wrong gain or limit is refused with the reason, and the loop continues")
def test_a_gain_changes_without_a_bump(graph, loop):
    loop.stays(0.4, 0.02)
    request = GetParameters.Request(names=["kp", "ki", "kd"])
    kp, ki, kd = (v.double_value for v in graph.call(GetParameters, f"/{FL}/get_parameters", request).values)
    try:
        for share in (0.7, 1.0):
            results = set_parameters(graph, kp=share * kp, ki=share * ki, kd=share * kd)
            assert all(result.successful for result in results)
            assert all(abs(joint.position[0] - 0.4) < 0.05 for joint in loop.samples(300))
    finally:
        set_parameters(graph, kp=kp, ki=ki, kd=kd)


def test_off_and_on_again_is_like_a_first_step(graph, loop):
    assert graph.call(SetBool, ENABLE, SetBool.Request(data=False)).success
    loop.off()
    loop.said(FL, "applies duty 0")
    loop.stays(0.0, 0.1)  # meanwhile the law has not wound up
    assert graph.call(SetBool, ENABLE, SetBool.Request(data=True)).success
    seen = len(loop.joints)
    loop.stays(0.4, 0.03)
    assert max(joint.position[0] for joint in loop.joints[seen:]) < 0.4 * 1.25
    loop.said(FL, "ok")


@pytest.mark.promise("Control", "Beyond the angle limit the duty is 0 until the next reference")
def test_beyond_the_angle_limit_the_arm_is_let_down_until_the_next_reference(graph, loop):
    assert set_parameters(graph, angle_limit=0.5)[0].successful
    try:
        loop.refer(0.7)
        loop.off()
        loop.said(FL, "beyond the limit of 0.5 rad")
        loop.stays(0.0, 0.2, count=50)
        loop.refer(0.3)
        loop.stays(0.3, 0.05, count=100)
    finally:
        set_parameters(graph, angle_limit=1.4)


@pytest.mark.promise("Control", "Without samples for 50 ms the duty is 0, and the law restarts with the next sample")
def test_a_plant_that_stands_still_gets_duty_0(loop, running):
    logged = running.controller.output.count("no sample for 0.05 s")
    running.plant.send(signal.SIGSTOP)
    try:
        seen = len(loop.duty)
        loop.said(FL, "no sample for 0.05 s: duty 0")
        assert loop.duty[-1].data == 0.0
        assert len(loop.duty) < seen + 100
    finally:
        running.plant.send(signal.SIGCONT)
    loop.stays(0.4, 0.05, count=100)
    assert "no sample for 0.05 s" in running.controller.output
    assert running.controller.output.count("no sample for 0.05 s") <= logged + 1


@pytest.mark.promise("Control", "A second publisher of `duty_command` is reported")
def test_another_who_commands_the_duty_is_told_of(graph, loop, running):
    with graph.talking(Float64, DUTY_COMMAND):
        loop.said(FL, "2 publishers of duty_command")
    loop.said(FL, "ok")
    assert running.controller.output.count("2 publishers of duty_command") == 1


@pytest.mark.promise("Control", "No sample is missed, and each gets a command")
def test_no_sample_is_missed_and_each_gets_a_command_of_its_own(graph, loop):
    before = graph.diagnostics(FL)
    received = len(loop.duty)
    loop.samples(1500)
    after = graph.diagnostics(FL, lambda values: int(values["samples"]) > int(before["samples"]) + 1000)
    assert after["lost"] == before["lost"]
    assert after["repeated"] == before["repeated"] == "0"
    assert len(loop.duty) - received >= 1400


def test_the_command_reference_moves_the_arm(loop, start):
    reference = start("reference", "0.2")
    loop.stays(0.2, 0.04, count=100)
    assert reference.wait() == 0
    loop.refer(math.nan)
    loop.said(FL, "reference nan refused")
    loop.stays(0.2, 0.04, count=50)


@pytest.mark.promise("Control", "`step_test` and `step_response` give the same figures for one run")
def test_step_test_and_a_recording_of_it_give_the_same_figures(loop, start, tmp_path, capsys):
    out, bag, plot = tmp_path / "out", tmp_path / "bag", tmp_path / "plot.svg"
    loop.refer(0.0)
    record = start("record", str(bag)).wait_for("joint_states")
    step_test = start("step_test", "--levels", "0.2", "0.5", "--hold", "2.5", "--out", str(out))
    assert step_test.wait() == 0, step_test.output
    assert record.stop() == 0

    document = json.loads((out / "steps.json").read_text())
    assert document["law"] == FL
    assert [step["reference"] for step in document["steps"]] == [0.2, 0.5]
    for step in document["steps"]:
        assert step["final"] == pytest.approx(step["reference"], abs=0.02)
        assert 0.05 < step["rise_time"] < 0.5
        assert f"{step['reference']:g} rad" in step_test.output
    rows = np.genfromtxt(out / "steps.csv", delimiter=",", skip_header=1)
    assert rows.shape == (pytest.approx(5.0 / 0.00204, rel=0.05), 7)
    assert np.diff(rows[:, 0]) == pytest.approx(0.00204, rel=1e-3)
    assert (out / "steps.svg").read_text().count("<polyline") == 3

    assert step_response.main([str(bag), "--plot", str(plot)]) == 0
    printed = capsys.readouterr().out
    for step in document["steps"]:
        (row,) = (line for line in printed.splitlines() if f" {step['reference']:g} rad " in line)
        t_r, _, t_s, *_ = row.partition("rad")[2].replace("✗", "").split()
        assert float(t_r) == pytest.approx(step["rise_time"], abs=0.01)
        assert float(t_s) == pytest.approx(step["settling_time"], abs=0.03)
    assert plot.read_text().count("<polyline") == 3
    loop.stays(0.0, 0.1, count=100)  # the arm is let down


@pytest.mark.promise("Control", "The four laws of the thesis follow references within their ranges")
@pytest.mark.parametrize("law", [law for law in LAWS if law != FL])
def test_each_law_starts_by_hand_follows_and_ends_with_duty_0(graph, start, running, law):
    running.controller.stop()
    controller = start(law)
    with listening(graph) as loop:
        graph.call(Trigger, RESET, Trigger.Request())
        loop.said(law, "no reference yet: duty 0")
        loop.off()
        if law == "cascade":
            loop.refer(80.0)
            loop.stays(80.0, 4.0, read=lambda joint: joint.velocity[1])
        else:
            loop.refer(0.3)
            loop.stays(0.3, 0.03)
        controller.send(signal.SIGTERM).send(signal.SIGINT)
        assert controller.wait() == 0
        loop.off()
    assert "Traceback" not in controller.output


@pytest.fixture
def by_hand(graph, start, running):
    """A controller that is fed by hand, with no plant around: what it commands for each sample."""
    running.controller.stop()
    running.plant.stop()
    controller = start(FL).wait_for("kp")
    with (
        graph.talking(JointState, JOINT_STATES) as joint,
        graph.talking(BatteryState, ARMATURE) as battery,
        graph.talking(Float64, REFERENCE) as refer,
        graph.listening(Float64, DUTY_COMMAND) as duty,
    ):
        stamp = 10**18

        def sample(theta, after=1, halves="joint first"):
            """Feed one sample and return its duty."""
            nonlocal stamp
            stamp += after * PERIOD_NS
            seen = len(duty)
            messages = [(joint, joint_states_message(stamp, theta, 0.0)),
                        (battery, armature_message(stamp, 0.0, 0.0, duty[-1].data if duty else 0.0))]
            for publish, message in messages if halves == "joint first" else reversed(messages):
                publish(message)
            graph.until(lambda: len(duty) > seen, "a command")
            return duty[seen].data

        graph.until(lambda: sample(0.0) == 0.0, "a first sample")
        refer(Float64(data=0.4))
        controller.wait_for("reference 0.4")

        def works(theta, **how):
            """Feed samples until one gets a duty: the first may get the 0 of the silence before it."""
            graph.until(lambda: sample(theta, **how) > 0.0, "a duty")

        yield SimpleNamespace(controller=controller, sample=sample, works=works, duty=duty)


@pytest.mark.promise("Control", "NaN in a sample gives duty 0 until the next number")
def test_nan_gives_duty_0_at_once_and_halves_may_come_in_any_order(graph, by_hand):
    by_hand.works(0.1)
    assert by_hand.sample(math.nan) == 0.0
    by_hand.works(0.1, halves="armature first")
    for angle in (math.inf, -math.inf, 3.0, -3.0):
        assert by_hand.sample(angle) == 0.0
    assert by_hand.sample(0.1) == 0.0  # it went beyond the limit
    assert "theta of a sample is NaN" in by_hand.controller.output
    assert by_hand.controller.output.count("NaN") == 1
    assert by_hand.controller.output.count("theta of a sample is no possible number: left out") == 1


@pytest.mark.promise("Control", "Without samples for 50 ms the duty is 0, and the law restarts with the next sample")
def test_silence_gives_duty_0(graph, by_hand):
    by_hand.works(0.1)
    graph.until(lambda: by_hand.duty[-1].data == 0.0, "duty 0")
    by_hand.controller.wait_for("no sample for 0.05 s")
    counters = graph.diagnostics(FL)
    assert int(counters["silent"]) >= 1


BAD = {
    "small_signal": (parameters(model="nothing.yaml"), "nothing.yaml: no such model file"),
    FL: (parameters(kp=-1.0), "kp = -1 1/s² is out of range"),
    "cascade": (parameters(gains="mine"), "one of tuned, thesis"),
    "feedback_linearization_cascade": (parameters(reference_max=0.0), "reference_min < reference_max"),
    "reference": (["much"], "'much' is not a number"),
    "step_test": (["--hold", "0"], "give 0.5 to 600 s"),
}


def test_what_cannot_be_used_ends_in_one_line_and_exit_code_2(start):
    processes = {name: start(name, *args) for name, (args, _) in BAD.items()}
    for name, process in processes.items():
        assert process.wait() == 2, process.output
        (line,) = process.output.splitlines()
        assert line.startswith(f"{name}: ")
        assert BAD[name][1] in line


def test_help_names_gains_limits_and_examples(start):
    processes = {name: start(name, "--help") for name in (FL, "reference", "step_test")}
    words = {FL: (*LAWS[FL].parameters, "angle_limit", "reference_max", "model:="), "reference": ("reference 0.4",),
             "step_test": ("--levels", "steps.csv", "record my_bag")}
    for name, process in processes.items():
        assert process.wait() == 0
        for word in (*words[name], "--ros-args"):
            assert word in process.output
