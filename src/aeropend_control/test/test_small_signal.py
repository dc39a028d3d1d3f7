# SPDX-License-Identifier: Apache-2.0
import pytest

from aeropend_control.analysis import closed_loop
from aeropend_control.analysis.step_response import step_responses
from aeropend_control.laws.small_signal import THESIS_GAINS, SmallSignal
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import load

BENCH, THESIS = load("bench"), load("thesis")


def answer(law, model, level, hold=4.0, smoothing=0.06):
    run = closed_loop.predict(law, model, closed_loop.staircase([level], hold))
    (step,) = step_responses(run.time, run.truth["theta"], run.reference, smoothing)
    return step


def test_the_thesis_gains_give_the_printed_times():
    """Figure 6.3: t_r 0.26, t_s 1.16 s.

    The printed M_p of 9.98 % does not come of the printed gains: they give 4 %, and a tenth more of ki gives 10 %.
    """
    step = answer(SmallSignal(THESIS, THESIS_GAINS, schedule=False), THESIS, 0.4, 5.0, 0.0)
    assert step.rise_time == pytest.approx(0.26, rel=0.1)
    assert step.settling_time == pytest.approx(1.16, rel=0.1)
    assert abs(step.steady_state_error) < 1e-4
    more = {**THESIS_GAINS, "ki": 1.11 * THESIS_GAINS["ki"]}
    assert step.overshoot < 0.05
    assert answer(SmallSignal(THESIS, more, schedule=False), THESIS, 0.4, 5.0, 0.0).overshoot > 0.09


def test_the_schedule_keeps_the_answer_the_same_far_away():
    """A small step around 1 rad is as that around 0.4 rad with the schedule, and not without."""
    gains = SmallSignal.tune(BENCH)
    overshoot = {}
    for schedule in (True, False):
        law = SmallSignal(BENCH, gains, schedule=schedule)
        run = closed_loop.predict(law, BENCH, closed_loop.staircase([0.4, 0.45, 1.0, 1.05], 3.0))
        steps = step_responses(run.time, run.truth["theta"], run.reference)
        overshoot[schedule] = steps[3].overshoot - steps[1].overshoot
    assert abs(overshoot[True]) < 0.5 * abs(overshoot[False])


@pytest.mark.promise("Augmented model", "A controller that gets it compensates the effects in it")
@pytest.mark.parametrize("effect", ["command_delay", "thrust_lag", "axial_inflow", "coulomb_friction", "cable_torque",
                                    "angle_offset", "encoder_lag"])
def test_an_effect_that_the_model_names_is_compensated(effect):
    model = BENCH.with_effects({effect: {name: p.default for name, p in CATALOGUE[effect].parameters.items()}})
    step = answer(SmallSignal(model), model, 0.3)
    assert step.settling_time == pytest.approx(1.03, rel=0.15)
    assert step.overshoot == pytest.approx(0.08, abs=0.025)
    assert abs(step.steady_state_error) < 4e-3
