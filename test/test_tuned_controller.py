# SPDX-License-Identifier: Apache-2.0
"""The augmented model put to use: the plant node runs it, and a controller tuned on it does what was predicted."""

from functools import cache

import numpy as np
import pytest
from evaluation.support.graph import stamps
from evaluation.tuned_controller import M_P, T_S, case, error, nominal, table
from sensor_msgs.msg import BatteryState, JointState
from std_msgs.msg import Float64

from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import load, save
from aeropend_sim.model.rig import Rig
from aeropend_sim.nodes.plant import PERIOD_NS
from aeropend_sim.ros.interface import ARMATURE, DUTY_COMMAND, JOINT_STATES

EFFECTS = ("bridge_drop", "thrust_exponent", "coulomb_friction", "cable_torque", "angle_offset")


@cache
def made(effect):
    return case(effect, list(CATALOGUE).index(effect))


@pytest.fixture(scope="module")
def cases():
    return {effect: made(effect) for effect in EFFECTS}


def test_predictions_come_true_after_the_diagnosis_and_not_before(cases):
    before, after = np.transpose([c.errors() for c in cases.values()])
    assert np.median(after / before) < 0.3
    assert np.all(after < 0.5 * before)


@pytest.mark.parametrize("effect", EFFECTS)
def test_the_rig_does_what_the_augmented_model_predicts(cases, effect):
    c = cases[effect]
    assert effect in c.found
    predicted, measured = c.predicted_after, c.measured_after
    assert measured.t_r == pytest.approx(predicted.t_r, rel=0.08)
    assert measured.t_s == pytest.approx(predicted.t_s, rel=0.2)
    assert measured.M_p == pytest.approx(predicted.M_p, abs=0.02)
    assert measured.e_ss == pytest.approx(predicted.e_ss, abs=0.003)


@pytest.mark.promise("Augmented model", "A controller tuned on it meets its requirements on the rig")
@pytest.mark.parametrize("effect", EFFECTS)
def test_the_controller_tuned_on_it_meets_what_it_was_tuned_for(cases, effect):
    measured = cases[effect].measured_after
    assert measured.t_s == pytest.approx(T_S, rel=0.15)
    assert measured.M_p == pytest.approx(M_P, abs=0.03)
    assert abs(measured.e_ss) < 0.005


def test_the_measure_counts_every_figure():
    p = nominal()
    assert error(p, p) == 0.0
    for worse in (p._replace(t_r=1.1 * p.t_r), p._replace(t_s=0.9 * p.t_s), p._replace(M_p=1.1 * p.M_p),
                  p._replace(e_ss=p.e_ss + 0.035)):
        assert error(p, worse) == pytest.approx(0.1)


def test_the_table_shows_every_case(cases):
    assert table(list(cases.values())).row_count == 2 * len(EFFECTS)


@pytest.mark.promise("Augmented model", "The plant runs `augmented.yaml`")
def test_the_plant_node_runs_the_augmented_model_to_the_last_bit(graph, start, tmp_path):
    file = tmp_path / "augmented.yaml"
    save(made("coulomb_friction").augmented, file)
    start("plant", "--ros-args", "--params-file", str(file), "-p", "speed:=0.8", "-p", "seed:=11")
    with (
        graph.listening(JointState, JOINT_STATES) as joints,
        graph.listening(BatteryState, ARMATURE) as armature,
        graph.talking(Float64, DUTY_COMMAND) as send,
    ):
        graph.until(lambda: joints and armature, "the first samples")
        for command in (0.45, 0.2):
            send(Float64(data=command))
            graph.until(lambda command=command: armature[-1].percentage == np.float32(command), "the command")
            seen = len(joints)
            graph.until(lambda seen=seen: len(joints) > seen + 600, "600 samples")
    sample = np.array(stamps(armature)) // PERIOD_NS - 1  # 0 is the plant's first
    duty = np.zeros(sample[-1] + 1)
    for first, message in zip(sample, armature, strict=True):
        duty[first:] = message.percentage
    reading, _ = Rig(load(file), 11).run(duty)
    assert [message.current for message in armature] == reading[2, sample].astype(np.float32).tolist()
    joints = [message for message in joints if stamps([message])[0] <= stamps(armature)[-1]]
    sample = np.array(stamps(joints)) // PERIOD_NS - 1
    assert [message.position[0] for message in joints] == reading[0, sample].tolist()
    assert [message.velocity[1] for message in joints] == reading[1, sample].tolist()
    assert max(reading[0]) > 0.2
