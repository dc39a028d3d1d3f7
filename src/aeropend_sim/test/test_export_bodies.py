# SPDX-License-Identifier: Apache-2.0
"""Descriptions of the arm, in the programs that read them: MuJoCo, and parsers of URDF and SDF."""

import importlib
import subprocess
import sys
import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pytest

from aeropend_sim.export import import_model, mujoco_drive, plant_step, rigid_body
from aeropend_sim.export.specialise import fields
from aeropend_sim.model import dynamics, sensing
from aeropend_sim.model.effects import CATALOGUE, DEFINED, RANDOM
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.forms import FORMS
from aeropend_sim.model.parameters import Model, load
from aeropend_sim.model.rig import record
from aeropend_sim.model.state import State

BENCH = load("bench")
DUTY = Excitation(duration=12.0).series()
HELD_OUT = slice(round(0.7 * len(DUTY)), None)
ARM = [id_ for id_, effect in CATALOGUE.items() if effect.place in ("thrust", "arm")]


def with_effects(*ids: str) -> Model:
    return BENCH.with_effects({id_: {name: p.default for name, p in DEFINED[id_].parameters.items()} for id_ in ids})


def in_mujoco(model: Model, folder, monkeypatch, duty: np.ndarray, theta: float = 0.0) -> dict[str, np.ndarray]:
    """The outputs of the exported files, run in MuJoCo."""
    for name, text in mujoco_drive.files(model).items():
        (folder / name).write_text(text)
    monkeypatch.syspath_prepend(str(folder))
    for name in ("aeropend_model", "aeropend_mujoco"):
        sys.modules.pop(name, None)
    rig = importlib.import_module("aeropend_mujoco").Rig(theta)
    rows = np.array([rig.step(float(each)) for each in duty]).T
    return dict(zip(fields(plant_step.Outputs), rows, strict=True))


def rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(x**2)))


@pytest.mark.promise("Other simulators", "The exported rig in MuJoCo leaves at most 1.1 times the gap to a recording "
                                         "that our own simulation leaves, with each effect of thrust and arm")
@pytest.mark.parametrize("id_", [*(i for i in ARM if i not in RANDOM), "rotor_friction", "command_delay", "encoder_lag",
                                 "coulomb_friction_stribeck", "cable_torque_slack", "coulomb_friction_dahl"])
def test_mujoco_leaves_as_small_a_gap_to_a_recording_as_our_own_simulation(id_, tmp_path, monkeypatch):
    model = with_effects(id_)
    read, _ = record(model, DUTY, seed=3)
    found = in_mujoco(model, tmp_path, monkeypatch, DUTY)
    true = dynamics.simulate(model, DUTY)
    for channel, ours in {"theta": sensing.read_angle(model, true.theta, true.theta_dot), "i_a": true.i_a}.items():
        gap, ours_gap = (rms((simulated - read[channel])[HELD_OUT]) for simulated in (found[f"{channel}_read"], ours))
        assert gap < 1.1 * ours_gap, channel
    without = dynamics.simulate(BENCH, DUTY)
    missed = rms((sensing.read_angle(BENCH, without.theta, without.theta_dot) - read["theta"])[HELD_OUT])
    assert missed > 1.2 * ours_gap or id_ not in ARM


def test_dry_friction_holds_the_arm_in_mujoco(tmp_path, monkeypatch):
    """The reason for `solimpfriction`, and for `MULTIPLE`: with MuJoCo's own values the arm creeps back by 0.02 rad."""
    model = with_effects("coulomb_friction")
    found = in_mujoco(model, tmp_path, monkeypatch, np.zeros(5000), theta=0.3)
    ours = dynamics.simulate(model, np.zeros(5000), state=State(theta=0.3))
    assert abs(ours.theta[-1]) > 1e-3
    assert found["theta"][-1] == pytest.approx(ours.theta[-1], abs=1e-4)
    assert abs(found["theta"][-1] - found["theta"][-1500]) < 1e-5


def test_the_arm_alone_is_a_pendulum_of_the_models_frequency_and_damping():
    compiled = mujoco.MjModel.from_xml_string(rigid_body.mjcf(BENCH, steps=4))
    data = mujoco.MjData(compiled)
    data.qpos[0] = 0.8
    theta = []
    for _ in range(4 * 1000):
        theta.append(float(data.qpos[0]))
        mujoco.mj_step(compiled, data)
    free = dynamics.simulate(BENCH, np.zeros(1000), state=State(theta=0.8))
    assert np.allclose(theta[::4], free.theta, atol=2e-3)


@pytest.mark.promise("Other simulators", "A URDF parser and MuJoCo read the exported URDF: inertia, damping, friction")
def test_the_parser_of_ros_and_mujoco_read_the_urdf(tmp_path):
    """check_urdf is urdfdom, with which ROS, Gazebo and Drake read a URDF."""
    model = with_effects("coulomb_friction", "mast_flex")
    (tmp_path / "rig.urdf").write_text(rigid_body.urdf(model))
    done = subprocess.run(["check_urdf", str(tmp_path / "rig.urdf")], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "child(1):  rod" in done.stdout
    compiled, arm = mujoco.MjModel.from_xml_path(str(tmp_path / "rig.urdf")), rigid_body.arm(model)
    assert (compiled.dof_damping[0], compiled.dof_frictionloss[0]) == pytest.approx((arm.damping, arm.friction))
    data, full = mujoco.MjData(compiled), np.zeros((1, 1))
    mujoco.mj_forward(compiled, data)
    mujoco.mj_fullM(compiled, full, data.qM)
    assert full[0, 0] == pytest.approx(arm.inertia)
    assert arm.damping / arm.inertia == pytest.approx(model.numbers()["c_over_J"])


def test_the_sdf_has_the_numbers_of_the_mjcf():
    """libsdformat is not on PyPI; the names are those of http://sdformat.org/spec?ver=1.9&elem=joint."""
    model = with_effects("coulomb_friction", "cable_torque", "mast_flex")
    root = ET.fromstring(rigid_body.sdf(model))
    compiled = mujoco.MjModel.from_xml_string(rigid_body.mjcf(model))
    assert (root.tag, root.get("version")) == ("sdf", "1.9")
    for k, name in enumerate(("arm", "mast_mode")):
        numbers = {one.tag: float(one.text) for one in root.find(f"model/joint[@name='{name}']/axis/dynamics")}
        assert numbers == {"damping": pytest.approx(compiled.dof_damping[k]), "friction": compiled.dof_frictionloss[k],
                           "spring_stiffness": pytest.approx(compiled.jnt_stiffness[k]),
                           "spring_reference": compiled.qpos_spring[k]}
    for k, name in enumerate(("rod", "mast_mode"), start=1):
        inertial = root.find(f"model/link[@name='{name}']/inertial")
        assert float(inertial.findtext("mass")) == pytest.approx(compiled.body_mass[k])
        assert float(inertial.findtext("pose").split()[2]) == pytest.approx(compiled.body_ipos[k][2])
        assert float(inertial.findtext("inertia/ixx")) == pytest.approx(compiled.body_inertia[k].max())


def test_every_effect_is_held_by_a_description_or_named_as_missing():
    for id_ in {**CATALOGUE, **FORMS}:
        for kind, held in rigid_body.HELD.items():
            named = {each.name for each in rigid_body.missing(with_effects(id_), kind)}
            assert (id_ in named) != (id_ in held)


@pytest.mark.promise("Other simulators", "A model that was exported as MJCF or URDF comes back by `import_model`")
@pytest.mark.parametrize(("kind", "effects"), [("mjcf", ("coulomb_friction", "cable_torque")), ("urdf", ())])
def test_an_exported_model_comes_back(kind, effects, tmp_path, capsys):
    model = with_effects(*effects)
    (tmp_path / "rig").write_text(getattr(rigid_body, kind)(model))
    arguments = [str(tmp_path / "rig"), "--out", str(tmp_path / "back.yaml")]
    lever = ["--lever", repr(rigid_body.arm(model).lever)] if kind == "urdf" else []
    assert import_model.main([*arguments, *lever]) == 0
    told = capsys.readouterr().out
    assert "not in the file, from bench: motor and propeller (k0, " in told
    back = load(tmp_path / "back.yaml")
    assert dict(back.model) == pytest.approx(dict(model.model), rel=1e-8)
    assert {id_: pytest.approx(p, rel=1e-8) for id_, p in back.effects.items()} == dict(model.effects)


TILTED = """<mujoco><default><joint damping="0.01"/></default><worldbody><body>
<joint name="shoulder" type="hinge" axis="0 -1 0"/>
<geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.01" mass="0.1"/></body></worldbody></mujoco>"""


def test_a_description_of_someone_else_is_understood(tmp_path):
    (tmp_path / "rig.xml").write_text(TILTED)
    found = import_model.read(tmp_path / "rig.xml", BENCH)
    n = found.model.model
    inertia = 0.01 / n["c_over_J"]
    assert inertia == pytest.approx(0.1 * 0.3**2 / 3.0, rel=0.05)  # a rod, with round ends
    assert n["mgd_over_J"] * inertia == pytest.approx(0.1 * 9.81 * 0.15)
    assert n["L_over_J"] == BENCH.model["L_over_J"]
    told = "\n".join(found.lines)
    assert "L_over_J = 97.6: not in the file, from bench; give --lever if known" in told
    assert "hangs at -1.5708 rad" in told


@pytest.mark.parametrize(("text", "more", "words"), [
    ("", [], "MuJoCo cannot read it as MJCF or URDF"), ("<mujoco/>", [], "it has 0 hinges; a pendulum needs one"),
    (TILTED, ["--joint", "elbow"], "no hinge is named 'elbow'; it has: shoulder"),
    (TILTED.replace("0 -1 0", "0 0 1"), [], "gravity does not turn the joint shoulder"),
])
def test_what_is_no_pendulum_is_refused_in_one_line(text, more, words, tmp_path, capsys):
    (tmp_path / "rig.xml").write_text(text)
    assert import_model.main([str(tmp_path / "rig.xml"), "--out", str(tmp_path / "out.yaml"), *more]) == 2
    told = capsys.readouterr().err
    assert words in told
    assert told.count("\n") == 1
