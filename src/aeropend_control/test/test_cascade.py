# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from aeropend_control.analysis import closed_loop
from aeropend_control.analysis.step_response import step_responses
from aeropend_control.laws.cascade import THESIS_GAINS, Cascade, FeedbackLinearizationCascade
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import load

BENCH = load("bench")
RPM = 2.0 * math.pi / 60.0


def with_effect(effect):
    return BENCH.with_effects({effect: {name: p.default for name, p in CATALOGUE[effect].parameters.items()}})


def answer(law, model, level, what="omega", hold=2.0):
    run = closed_loop.predict(law, model, closed_loop.staircase([level], hold))
    (step,) = step_responses(run.time, run.truth[what], run.reference, 0.0 if what == "omega" else 0.06)
    return step, run


def test_a_step_to_950_rpm():
    """Section 6.7: t_s <= 0.8 s, t_r <= 0.2 s, M_p <= 10 %, though the speed is read once a revolution."""
    step, run = answer(Cascade(BENCH), BENCH, 950 * RPM)
    assert step.settling_time <= 0.8
    assert step.rise_time <= 0.2
    assert step.overshoot <= 0.1
    assert abs(step.steady_state_error) < 1.0
    assert run.truth["i_a"].max() < 2.05


def test_the_thesis_gains_settle_in_time_though_without_feedforward():
    step, _ = answer(Cascade(BENCH, THESIS_GAINS), BENCH, 950 * RPM)
    assert step.settling_time <= 0.8
    assert step.overshoot <= 0.1


@pytest.mark.parametrize("limit", [0.5, 1.0])
def test_the_current_stays_within_its_limit(limit):
    _, run = answer(Cascade(BENCH, {"current_limit": limit}), BENCH, 80.0)
    assert run.truth["i_a"].max() == pytest.approx(limit, rel=0.06)


@pytest.mark.parametrize("effect", ["bridge_drop", "supply_sag", "brush_drop", "rotor_friction", "command_delay",
                                    "current_gain", "current_offset", "speed_spikes"])
def test_the_speed_is_held_though_the_model_does_not_name_the_effect(effect):
    step, run = answer(Cascade(BENCH), with_effect(effect), 100.0, hold=4.0)
    assert abs(step.steady_state_error) < 1.0
    assert np.ptp(run.truth["omega"][-500:]) < 1.0
    assert step.overshoot < 0.1


@pytest.mark.promise("Augmented model", "A controller that gets it compensates the effects in it")
@pytest.mark.parametrize("effect", ["bridge_drop", "brush_drop", "rotor_friction", "command_delay"])
def test_an_effect_that_the_model_names_is_compensated(effect):
    step, _ = answer(Cascade(with_effect(effect)), with_effect(effect), 100.0)
    assert step.settling_time == pytest.approx(answer(Cascade(BENCH), BENCH, 100.0)[0].settling_time, rel=0.15)


@pytest.mark.parametrize("effect", ["command_delay", "thrust_lag", "encoder_lag", "supply_sag", "coulomb_friction"])
def test_the_arm_behind_the_cascade_bears_what_the_model_does_not_name(effect):
    step, run = answer(FeedbackLinearizationCascade(BENCH), with_effect(effect), 0.4, "theta", 4.0)
    assert abs(step.steady_state_error) < math.radians(0.5)
    assert np.ptp(run.truth["theta"][-500:]) < 0.01


@pytest.mark.promise("Augmented model", "A controller that gets it compensates the effects in it")
@pytest.mark.parametrize("effect", ["command_delay", "thrust_lag", "encoder_lag", "axial_inflow", "coulomb_friction"])
def test_the_arm_behind_the_cascade_is_compensated(effect):
    model = with_effect(effect)
    step, _ = answer(FeedbackLinearizationCascade(model), model, 0.4, "theta", 4.0)
    assert step.settling_time < 1.4  # thrust_lag; without an effect less than 1.2
    assert step.overshoot < 0.06
    assert abs(step.steady_state_error) < math.radians(0.5)
