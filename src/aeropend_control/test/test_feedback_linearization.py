# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from aeropend_control.analysis import closed_loop
from aeropend_control.analysis.step_response import step_responses
from aeropend_control.laws.feedback_linearization import THESIS_GAINS, FeedbackLinearization, tune
from aeropend_control.laws.tuning import TuningError
from aeropend_sim.model import effect_file
from aeropend_sim.model.effects import CATALOGUE, DEFINED
from aeropend_sim.model.parameters import Model, load
from aeropend_sim.model.rig import Rig, Sample

BENCH, THESIS = load("bench"), load("thesis")
NOT_OF_THE_ANGLE = ("current_gain", "current_offset", "voltage_offset", "speed_spikes")
FORESEEN = [id_ for id_ in CATALOGUE if id_ != "gust" and id_ not in NOT_OF_THE_ANGLE]


def defaults(effect):
    return {effect: {name: p.default for name, p in CATALOGUE[effect].parameters.items()}}


def answers(law, model, levels=(0.2, 0.5), hold=4.0):
    run = closed_loop.predict(law, model, closed_loop.staircase(levels, hold))
    return step_responses(run.time, run.truth["theta"], run.reference)


def test_the_thesis_gains_give_the_checked_response():
    """Figure 6.8: from rest to 0.4 rad, which takes the motor to its limit, with ki and kd as they must be."""
    law = FeedbackLinearization(THESIS, {**THESIS_GAINS, "thrust_time": 0.0})
    run = closed_loop.predict(law, THESIS, closed_loop.staircase([0.4], 5.0))
    (step,) = step_responses(run.time, run.truth["theta"], run.reference, smoothing=0.0)
    assert step.rise_time == pytest.approx(0.114, rel=0.03)
    assert step.peak_time == pytest.approx(0.326, rel=0.03)
    assert step.settling_time == pytest.approx(1.58, rel=0.03)
    assert step.overshoot == pytest.approx(0.177, rel=0.03)
    assert abs(step.steady_state_error) < 1e-4


@pytest.mark.promise("Control", "`tune` meets its requirements, and prints margins")
@pytest.mark.parametrize(("model", "t_s", "M_p"), [(BENCH, 1.5, 0.1), (BENCH, 1.2, 0.05), (THESIS, 1.5, 0.2)])
def test_a_tuned_loop_meets_what_it_was_tuned_for(model, t_s, M_p):
    for step in answers(FeedbackLinearization(model, tune(model, t_s, M_p)), model):
        assert step.settling_time == pytest.approx(t_s, rel=0.15)
        assert step.overshoot == pytest.approx(M_p, abs=0.025)
        assert abs(step.steady_state_error) < 2e-3


@pytest.mark.promise("Augmented model", "A controller that gets it compensates the effects in it")
@pytest.mark.parametrize("effect", FORESEEN)
def test_an_effect_that_the_model_names_is_compensated(effect):
    """With the effect known, the loop is as good as the nominal one."""
    model = BENCH.with_effects(defaults(effect))
    for step in answers(FeedbackLinearization(model, tune(model)), model, levels=(0.3,), hold=3.5):
        assert step.settling_time == pytest.approx(1.45, rel=0.15)
        assert step.overshoot == pytest.approx(0.09, abs=0.025)
        assert abs(step.steady_state_error) < 4e-3


SIZES = {"low": 0.0, "high": 500.0}
effect_file.define({
    "loop_magnet": {"place": "arm", "term": "-k * (theta - at) * exp(-((theta - at) / width)**2)", "parameters": {
        "k": {"unit": "1/s²", "default": 20.0, **SIZES}, "at": {"unit": "rad", "default": 0.25, **SIZES},
        "width": {"unit": "rad", "default": 0.15, "low": 0.01, "high": 2.0}}},
    "loop_wake": {"place": "thrust", "term": "-share * thrust * sin(3 * theta)**2", "parameters": {
        "share": {"unit": "-", "default": 0.3, **SIZES}}},
    "loop_hose": {"place": "arm", "term": "-k * z",
                  "memory": {"name": "z", "unit": "rad", "rate": "theta_dot - z / tau"},
                  "parameters": {"k": {"unit": "1/s²", "default": 8.0, **SIZES},
                                 "tau": {"unit": "s", "default": 0.6, "low": 0.01, "high": 9.0}}},
}, "test_feedback_linearization")


@pytest.mark.parametrize("effect", ["loop_magnet", "loop_wake", "loop_hose"])
def test_an_effect_by_formula_is_compensated(effect):
    """What is left of the excess in settling time and overshoot, beside a law that does not know the effect."""
    rig = BENCH.with_effects({effect: {n: p.default for n, p in DEFINED[effect].parameters.items()}})
    gains = tune(BENCH)
    nominal, blind, seeing = (answers(FeedbackLinearization(known, gains), plant, levels=(0.3,), hold=3.5)[0]
                              for known, plant in ((BENCH, BENCH), (BENCH, rig), (rig, rig)))

    def excess(step):
        return (abs(step.overshoot - nominal.overshoot) / nominal.overshoot
                + abs(step.settling_time - nominal.settling_time) / nominal.settling_time)

    assert excess(seeing) < 0.5 * excess(blind)


def test_without_an_error_the_thrust_holds_the_weight():
    n = BENCH.model
    gains = {"kp": 1.0, "ki": 0.0, "kd": 0.0, "setpoint_weight": 1.0, "thrust_time": 0.0}
    law = FeedbackLinearization(BENCH, gains)
    for angle in (0.2, 0.6, 1.0):  # the reference is where the arm is: v = 0
        law.reset()
        duty = law.step(Sample(angle, 0.0, 0.0, 0.0), angle)
        lift = n["mgd_over_J"] * math.sin(angle)
        rig = Rig(Model("held", n, dict.fromkeys(BENCH.sensing, 0.0)))
        truth = rig.run(np.full(8000, duty))[1]
        assert truth[6, -1] * n["L_over_J"] == pytest.approx(lift, rel=0.01)


def test_the_same_run_gives_the_same_duties_and_they_are_duties():
    model = BENCH.with_effects(defaults("command_delay"))
    law = FeedbackLinearization(model, tune(model))
    reference = closed_loop.staircase([0.9, 0.0, 0.3], 1.0)
    first, second = (closed_loop.predict(law, model, reference, seed=5) for _ in range(2))
    assert np.array_equal(first.duty, second.duty)
    assert first.duty.min() == 0.0
    assert first.duty.max() <= 1.0


@pytest.mark.parametrize(("t_s", "M_p", "said"), [
    (0.05, 0.1, "not that quick"), (-1.0, 0.1, "settling"), (math.nan, 0.1, "settling"), (1.5, 0.0, "overshoot"),
    (1.5, 1.0, "overshoot")])
def test_requirements_that_cannot_be_met_are_refused(t_s, M_p, said):
    with pytest.raises(TuningError, match=said) as error:
        tune(BENCH, t_s, M_p)
    assert len(str(error.value).splitlines()) == 1
