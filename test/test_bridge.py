# SPDX-License-Identifier: Apache-2.0
"""The bridge and a board behind a real pty: samples, commands, and what happens when the board or the host goes."""

import math
import signal
import time
from itertools import pairwise

import numpy as np
import pytest
from evaluation.support.graph import Process, parameters, stamps
from pty_board import PtyBoard
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import Float64
from std_srvs.srv import SetBool

from aeropend_bridge import calibration
from aeropend_bridge.protocol import Type
from aeropend_sim.ros.interface import ARMATURE, DUTY_COMMAND, JOINT_STATES

PERIOD_NS = 2_040_000




def away(name):
    """Arguments that take a bridge away from the rig that most tests share."""
    return ["--ros-args", "-r", f"__ns:=/{name}"]


class Rig:
    """A board and the bridge's process."""

    def __init__(self, graph, folder, *args, **board):
        self.graph = graph
        self.board = PtyBoard(folder / "tty", **board)
        self.bridge = Process("bridge", *parameters(port=self.board.path), *args)

    def close(self):
        self.bridge.stop()
        self.board.stop()

    def counters(self, enough=bool):
        return self.graph.diagnostics("bridge", enough)


@pytest.fixture(scope="module")
def rig(graph, tmp_path_factory):
    """A board whose clock wraps soon and is slow; one for all tests that leave it as it was."""
    fields = lambda duty: {"current": 2 * duty, "angle": 1023, "voltage": -3, "period": 40_000 if duty else 0}  # noqa: E731
    rig = Rig(graph, tmp_path_factory.mktemp("rig"), ticks=2**32 - 8_000_000, drift=500e-6, sample=fields)
    yield rig
    rig.close()


@pytest.fixture
def ends(rig, graph):
    """What the rig publishes, and how it is commanded; it is enabled and stands at the end."""
    with (
        graph.listening(JointState, JOINT_STATES) as joints,
        graph.listening(BatteryState, ARMATURE) as armature,
        graph.talking(Float64, DUTY_COMMAND) as send,
    ):
        graph.until(lambda: joints and armature, "samples")
        yield joints, armature, lambda duty: send(Float64(data=duty))
        graph.call(SetBool, "enable", SetBool.Request(data=True))
        send(Float64(data=0.0))
        graph.until(lambda: rig.board.duty == 0, "duty 0")


def test_samples_are_as_the_interfaces_define_them(rig, graph, ends):
    joints, armature, command = ends
    command(0.2)
    graph.until(lambda: armature[-1].percentage == np.float32(51 / 255), "the duty")
    seen = len(armature)
    graph.until(lambda: len(armature) > seen + 2000, "2000 samples")  # the board's clock wraps meanwhile
    sample, battery = joints[-1], armature[-1]
    assert list(sample.name) == ["arm", "rotor"]
    assert sample.position[0] == pytest.approx((1023 - 256.75) * 2 * math.pi / 1024 * 1025 / 1024 - 2 * math.pi)
    assert math.isnan(sample.position[1])
    assert math.isnan(sample.velocity[0])
    assert sample.velocity[1] == pytest.approx(2 * math.pi / 0.02)
    assert list(sample.effort) == []
    assert battery.current == pytest.approx(102 * 2.56 / 1024 / 1.65)
    assert battery.voltage == pytest.approx(-3 * 2.56 / 512)
    assert (battery.location, battery.present) == ("armature", True)
    others = ("temperature", "charge", "capacity", "design_capacity")
    assert all(math.isnan(getattr(battery, name)) for name in others)

    times = np.array(stamps(armature))
    assert len(set(times.tolist()) & set(stamps(joints))) > 0.95 * len(times)
    steps = np.diff(times)
    assert np.all(steps > 0)
    assert np.median(steps) == pytest.approx(PERIOD_NS * 1.0005, rel=2e-4)
    # how close they are is for the clock's own test, and for the benchmark
    assert abs(times[-1] - rig.board.taken[-1][1] - (time.time_ns() - time.monotonic_ns())) < 0.1e9
    counters = rig.counters(lambda values: int(values["samples"]) > 2000)
    assert (counters["bad frames"], counters["board resets"]) == ("0", "0")
    assert counters["connected"] == "True"
    assert counters["firmware"] == "1.2.3"


def test_commands_are_clamped_and_nonsense_is_refused_and_counted(rig, graph, ends):
    _, armature, command = ends
    for duty, value in ((0.2, 51), (7.0, 255), (-0.5, 0), (0.6, 153)):
        command(duty)
        graph.until(lambda value=value: rig.board.duty == value, f"duty {duty}")
    for nonsense in (math.nan, math.inf, -math.inf):
        command(nonsense)
    rig.counters(lambda values: values["refused commands"] == "3")
    graph.until(lambda: armature[-1].percentage == np.float32(153 / 255), "the same duty")
    assert rig.bridge.output.count("refused") == 1


def test_one_command_holds_as_it_does_on_the_plant(rig, graph, ends):
    _, armature, command = ends
    command(0.4)
    graph.until(lambda: armature[-1].percentage == np.float32(102 / 255), "the command")
    seen = len(armature)
    graph.until(lambda: len(armature) > seen + 400, "0.8 s")
    assert {message.percentage for message in armature[seen:]} == {np.float32(102 / 255)}


def test_off_means_duty_0_until_the_next_command_after_on(rig, graph, ends):
    _, armature, command = ends

    def settled(value):
        graph.until(lambda: rig.board.duty == value, f"register {value}")
        seen = len(armature)
        graph.until(lambda: len(armature) > seen + 60, "60 samples")
        assert {message.percentage for message in armature[seen + 30 :]} == {np.float32(value / 255)}

    command(0.4)
    settled(102)
    assert graph.call(SetBool, "enable", SetBool.Request(data=False)).success
    settled(0)
    assert not rig.board.enabled
    command(0.5)
    settled(0)
    assert graph.call(SetBool, "enable", SetBool.Request(data=True)).success
    settled(0)
    command(0.6)
    settled(153)


def test_what_the_board_forgets_is_told_again(rig, graph, ends):
    rig.board.enabled = False
    graph.until(lambda: rig.board.enabled, "the board to be enabled again")
    rig.board.mode = 1
    graph.until(lambda: rig.board.mode == 0, "direct mode")


def test_garbage_on_the_line_is_refused_counted_and_costs_nothing_else(rig, graph, ends):
    joints, _, _ = ends
    before = rig.counters()
    for k in range(20):
        rig.board.litter(bytes(range(k, 40 + k)) + b"\0")
        graph.until(lambda: not rig.board.garbage, "the garbage to be sent")
    counters = rig.counters(lambda values: int(values["bad frames"]) >= int(before["bad frames"]) + 20)
    assert counters["lost samples"] == before["lost samples"]
    assert {message.position[0] for message in joints} == {joints[0].position[0]}


def test_a_board_that_says_nothing_blocks_nobody(rig, graph, ends):
    joints, _, command = ends
    before = rig.counters()
    rig.board.mute = True
    try:
        assert rig.counters(lambda values: values["connected"] == "False")
        assert graph.call(SetBool, "enable", SetBool.Request(data=False)).success
        assert graph.call(SetBool, "enable", SetBool.Request(data=True)).success
        for _ in range(100):
            command(0.1)
    finally:
        rig.board.mute = False
    seen = len(joints)
    graph.until(lambda: len(joints) > seen + 10, "samples again")
    counters = rig.counters(lambda values: int(values["gaps"]) > int(before["gaps"]))
    assert float(counters["longest gap s"]) > 0.5
    assert int(counters["lost samples"]) > 200  # the board's clock went on


@pytest.mark.promise("Hardware", "The motor stops when the host, the bridge or the connection fails")
def test_unplugged_and_plugged_in_again(rig, graph, ends):
    joints, armature, command = ends
    command(0.4)
    graph.until(lambda: rig.board.duty == 102, "the duty")
    counted = rig.counters()
    rig.board.unplug()
    before = stamps(joints)[-1]
    graph.until(lambda: rig.board.duty == 0, "duty 0")
    rig.board.plug()
    plugged, seen = time.time_ns(), len(armature)
    graph.until(lambda: len(armature) > seen + 30 and len(joints) > 30, "samples again")
    again = next(stamp for stamp in stamps(armature) if stamp > plugged)
    assert again - plugged < 1e9
    assert again - before > 0.1e9
    assert {message.percentage for message in armature[seen + 10 :]} == {0.0}  # until the next command
    assert rig.board.duty == 0
    command(0.6)
    graph.until(lambda: rig.board.duty == 153, "a new command")
    counters = rig.counters(lambda values: int(values["gaps"]) > int(counted["gaps"]))
    assert int(counters["reconnects"]) == int(counted["reconnects"]) + 1


@pytest.mark.promise("Hardware", "The motor stops when the host, the bridge or the connection fails")
def test_a_reset_of_the_board(rig, graph, ends):
    _, armature, command = ends
    command(0.4)
    graph.until(lambda: rig.board.duty == 102, "the duty")
    applied, before = len(rig.board.applied), rig.counters()
    rig.board.reset()
    reset, seen = time.time_ns(), len(armature)
    graph.until(lambda: len(armature) > seen + 60, "samples again")
    first = next(stamp for stamp in stamps(armature) if stamp > reset)
    assert first - reset < 1e9
    assert {value for _, value in list(rig.board.applied)[applied:]} <= {0}
    assert np.all(np.diff(stamps(armature)) > 0)
    counters = rig.counters(lambda values: int(values["board resets"]) > int(before["board resets"]))
    assert int(counters["gaps"]) >= 1
    assert "the board was reset (reset line)" in rig.bridge.output


@pytest.mark.promise("Hardware", "The motor stops when the host, the bridge or the connection fails")
def test_the_motor_stops_when_the_host_is_killed(graph, tmp_path):
    rig = Rig(graph, tmp_path, *away("killed"))
    try:
        with graph.talking(Float64, f"/killed/{DUTY_COMMAND}") as send:
            for number in (signal.SIGSTOP, signal.SIGKILL):
                graph.until(lambda: send(Float64(data=0.5)) or rig.board.duty == 128, "the duty")
                rig.bridge.send(number)
                sent = time.monotonic_ns()
                graph.until(lambda: rig.board.duty == 0, "duty 0")
                assert rig.board.applied[-1][0] - sent < 0.12e9
                if number == signal.SIGSTOP:
                    for _ in range(5):  # these wait while it stands still
                        send(Float64(data=0.5))
                    heard = len(rig.board.commands)
                    rig.bridge.send(signal.SIGCONT)
                    rig.bridge.wait_for("duty 0 until the next command")
                    graph.until(lambda heard=heard: len(rig.board.commands) > heard + 5, "the duty's repetitions")
                    assert rig.board.duty == 0
    finally:
        rig.close()


@pytest.mark.promise("Hardware", "The motor stops when the host, the bridge or the connection fails")
def test_it_waits_for_its_board_and_ends_with_the_motor_at_rest(graph, tmp_path):
    path = tmp_path / "tty"
    bridge = Process("bridge", *parameters(port=path, scheme="ssi"), *away("other"))
    board = None
    try:
        bridge.wait_for(f"there is no {path}")
        assert graph.call(SetBool, "/other/enable", SetBool.Request(data=True)).success
        assert graph.diagnostics("other/bridge", lambda values: values["connected"] == "False")
        board = PtyBoard(path)
        with graph.talking(Float64, f"/other/{DUTY_COMMAND}") as send:
            graph.until(lambda: send(Float64(data=0.5)) or board.duty == 128, "the duty")
        assert board.scheme == 1
        second = Process("bridge", *parameters(port=path), *away("second"))
        second.wait_for("in use by another program")
        assert second.stop() == 0
        assert bridge.stop() == 0
        commanded = board.applied[-1]
        graph.until(lambda: board.duty == 0, "duty 0")
        assert board.applied[-1][0] >= commanded[0]
        assert "Traceback" not in bridge.output
    finally:
        bridge.stop()
        if board:
            board.stop()


@pytest.mark.promise("Hardware", "A firmware of another protocol version is refused")
def test_a_firmware_of_another_version_is_refused(tmp_path):
    board = PtyBoard(tmp_path / "tty", version=9)
    bridge = Process("bridge", *parameters(port=board.path))
    try:
        assert bridge.wait() == 2
        (line,) = bridge.output.splitlines()
        assert line.startswith("bridge: the board at ")
        assert "version 9" in line
        assert "make -C firmware flash" in line
        assert set(board.commands) <= {Type.HELLO_REQUEST}
    finally:
        bridge.stop()
        board.stop()


@pytest.mark.promise("Commands", "An input that cannot be used ends a command with one line and exit code 2")
@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"scheme": "i2c"}, "one of pwm, ssi"),
        ({"calibration__curent_zero": 1.0}, "did you mean calibration.current_zero?"),
        ({"calibration__latency": 3.0}, "give 0 to 0.1 s"),
    ],
)
def test_bad_parameters_end_in_one_line_and_exit_code_2(start, arguments, expected):
    bridge = start("bridge", *parameters(**arguments))
    assert bridge.wait() == 2
    (line,) = bridge.output.splitlines()
    assert line.startswith("bridge: ")
    assert expected in line


@pytest.mark.promise("Hardware", "`calibrate` measures the zeros of a rig at rest, and refuses others")
def test_calibrate_measures_a_rig_at_rest_and_the_bridge_takes_the_file(graph, start, tmp_path):
    steady = {"current": 4, "angle": 300, "voltage": -7, "period": 0}
    board = PtyBoard(tmp_path / "tty", sample=lambda duty: steady)
    try:
        file = tmp_path / "rig.yaml"
        arguments = [str(file), "--port", str(board.path), "--seconds", "0.3"]
        done = start("calibrate", *arguments)
        assert done.wait() == 0, done.output
        found = calibration.load(file)
        assert (found.current_zero, found.voltage_zero, found.pwm_zero, found.ssi_zero) == (4.0, -7.0, 300.0, 300.0)
        before = file.read_bytes()
        again = start("calibrate", *arguments)
        assert again.wait() == 2
        assert "--force" in again.output
        assert file.read_bytes() == before
        start("bridge", *parameters(port=board.path), "--params-file", str(file), *away("calibrated"))
        with graph.listening(JointState, f"/calibrated/{JOINT_STATES}") as joints:
            graph.until(lambda: joints, "samples")
        assert joints[-1].position[0] == 0.0
    finally:
        board.stop()


def test_calibrate_refuses_a_rig_that_is_not_there_or_not_at_rest(start, tmp_path):
    turning = {"current": 4, "angle": 300, "voltage": -7, "period": 40_000}
    board = PtyBoard(tmp_path / "tty", sample=lambda duty: turning)
    try:
        cases = [
            ([str(tmp_path / "rig.yaml"), "--port", str(board.path), "--seconds", "0.2"], "the propeller turns"),
            ([str(tmp_path / "rig.yaml"), "--port", str(tmp_path / "none")], "there is no"),
            ([str(tmp_path / "nowhere" / "rig.yaml")], "no folder"),
            ([str(tmp_path / "rig.yaml"), "--base", str(tmp_path / "none.yaml")], "none.yaml"),
            ([str(tmp_path / "rig.yaml"), "--seconds", "0"], "--seconds"),
        ]
        for process, expected in [(start("calibrate", *arguments), expected) for arguments, expected in cases]:
            assert process.wait() == 2
            (line,) = process.output.splitlines()
            assert line.startswith("calibrate: ")
            assert expected in line
        assert list(tmp_path.iterdir()) == [board.path]
    finally:
        board.stop()


def test_help_names_parameters_and_examples(start):
    bridge = start("bridge", "--help")
    assert bridge.wait() == 0
    assert all(text in bridge.output for text in ("usage: bridge", "port", "scheme", "calibration.pwm_zero"))


def test_stamps_of_a_sample_agree(rig, graph, ends):
    joints, armature, _ = ends
    graph.until(lambda: len(armature) > 200 and len(joints) > 200, "200 samples")
    both = min(len(joints), len(armature))
    assert len(set(stamps(joints)) & set(stamps(armature))) > 0.9 * both
    assert all(after > before for before, after in pairwise(stamps(joints)))
