# SPDX-License-Identifier: Apache-2.0
"""`investigate` with real processes: a rig that runs, an experiment that is recorded, and a verdict."""

import json
import signal
import sys

import pytest
from evaluation.support.graph import Process, parameters
from std_msgs.msg import Float64

from aeropend_sim.model import excitation_file

pytestmark = pytest.mark.live

SMALL = ("--yes", "--tries", "4", "--theta", "-0.8", "1.2")
"""Few signals are tried, so that the test takes no longer than it must."""


class Inquiry(Process):
    """The command: it starts nodes, and is none itself."""

    def command(self, *args: str) -> list[str]:
        """What is run."""
        return [sys.executable, "-m", "aeropend_ident.commands.investigate", *args]


@pytest.mark.promise("Verdict", "`investigate` works on a running plant, and the motor is off at the end")
def test_a_running_rig_is_investigated_until_the_verdict_is_sure(tmp_path):
    rig = ["-r", "__ns:=/asked"]
    out = tmp_path / "out"
    with Process("plant", *parameters(effects__coulomb_friction__accel=0.5, seed=3), *rig) as plant:
        plant.wait_for("model bench")
        with Inquiry("investigate", *SMALL, "--out", str(out), "--ros-args", *rig) as inquiry:
            assert inquiry.wait(180.0) == 0, inquiry.output
            said = inquiry.output
    assert "verdict: coulomb_friction (arm)" in said
    assert said.strip().endswith("1 experiments, 20 s of motion. The verdict is sure: no rival is left.")
    assert json.loads((out / "verdict" / "diagnosis.json").read_text())["which"]["verdict"] == "coulomb_friction"
    signal_ = excitation_file.load(out / "1" / "experiment.yaml")
    assert signal_.kind == "holds"
    assert (out / "1" / "experiment.html").is_file()


def test_what_was_found_before_an_experiment_failed_is_kept(tmp_path):
    rig, out = ["-r", "__ns:=/gone"], tmp_path / "out"
    with Process("plant", *parameters(effects__cable_torque__k=0.25, effects__cable_torque__theta0=0.4), *rig) as plant:
        plant.wait_for("model bench")
        with Inquiry("investigate", *SMALL, "--most", "40", "--out", str(out), "--ros-args", *rig) as inquiry:
            inquiry.wait_for("verdict: ")
            assert plant.stop() == 0
            assert inquiry.wait(180.0) == 2, inquiry.output
            *_, last = inquiry.output.strip().splitlines()
    assert "investigate: no rig listens to /gone/duty_command: start a plant or a bridge first" in last
    assert last.endswith(f"; {out / 'verdict'} has the verdict so far")
    assert json.loads((out / "verdict" / "diagnosis.json").read_text())["bags"] == [str(out / "1" / "recording")]


def test_a_rig_that_somebody_drives_is_left_alone(tmp_path):
    rig = ["-r", "__ns:=/driven"]
    with (
        Process("plant", "--ros-args", *rig),
        Process("excite", *parameters(kind="hold", duty=0.1, duration=300.0), *rig) as other,
    ):
        other.wait_for("hold")
        with Inquiry("investigate", *SMALL, "--out", str(tmp_path / "out"), "--ros-args", *rig) as inquiry:
            assert inquiry.wait() == 2
            assert "something drives the rig on /driven/duty_command already" in inquiry.output


@pytest.mark.parametrize(("ended", "code"), [(signal.SIGINT, 130), (signal.SIGKILL, -9)])
def test_however_it_ends_during_an_experiment_the_motor_stops(tmp_path, graph, ended, code):
    rig = ["-r", f"__ns:=/stopped{int(ended)}"]
    with Process("plant", "--ros-args", *rig) as plant:
        plant.wait_for("model bench")
        with (
            Inquiry("investigate", *SMALL, "--out", str(tmp_path / "out"), "--ros-args", *rig) as inquiry,
            graph.listening(Float64, f"/stopped{int(ended)}/duty_command") as duties,
        ):
            graph.until(lambda: any(d.data > 0.1 for d in duties), "a duty")
            assert inquiry.send(ended).wait() == code
            assert ended is signal.SIGKILL or "the motor is off" in inquiry.output
            graph.until(lambda: [d.data for d in duties[-5:]] == [0.0] * 5, "five times duty 0")
