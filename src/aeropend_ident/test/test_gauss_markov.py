# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from aeropend_ident.diagnosis.search.gauss_markov import fit_gust, follows_state, gauss_markov
from aeropend_ident.diagnosis.search.linear_response import arm_response
from aeropend_ident.testing.rigs import drawn_rig, steps
from aeropend_sim.model import rig
from aeropend_sim.model.parameters import SAMPLE_PERIOD


def test_size_and_correlation_time_of_a_random_torque_are_recovered():
    model = drawn_rig(31, {"gust": {"sigma": 1.5, "tau": 0.3}})
    duty = steps(60.0, 31)
    read, truth = rig.record(model, duty, 31)
    _, calm = rig.record(model.with_effects({}), duty, 31)
    found = fit_gust(read["theta"] - calm["theta"], read["theta"], model.model["mgd_over_J"], model.model["c_over_J"],
                     0.0027, SAMPLE_PERIOD)
    assert abs(np.log(found.sigma / 1.5)) < 3.0 * found.sigma_sd
    assert abs(np.log(found.tau / 0.3)) < 3.0 * found.tau_sd
    assert found.gain > 100.0
    theta = truth["theta"][found.index]
    assert follows_state(found.torque, np.column_stack([theta, np.sin(theta)])) < 0.2


def test_a_torque_that_follows_the_state_is_told_from_chance():
    x = np.random.default_rng(0).standard_normal(5000)
    assert follows_state(2.0 * x + 1.0, x[:, None]) == pytest.approx(1.0, abs=1e-3)
    assert follows_state(np.random.default_rng(1).standard_normal(5000), x[:, None]) < 0.01


@pytest.mark.parametrize(("tau", "resolved"), [(0.3, True), (1e-3, False), (300.0, False)])
def test_a_torque_that_is_white_or_constant_has_no_correlation_time(tau, resolved):
    gravity, damping, h = 20.0, 1.0, SAMPLE_PERIOD
    torque = gauss_markov((1, 20000), tau, h, np.random.default_rng(5))[0] * (2.0 if resolved else 20.0)
    angle = arm_response(torque[None, :], np.full(20000, gravity), damping, 0.0, h)[0]
    read = angle + 2e-3 * np.random.default_rng(6).standard_normal(len(angle))
    assert fit_gust(read, np.zeros(len(read)), gravity, damping, 2e-3, h).resolved == resolved
