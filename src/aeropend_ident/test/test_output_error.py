# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest
from sparse_data import STATES, TRUE, noisy, pushed, simulated

from aeropend_ident.identification.dataset import from_arrays
from aeropend_ident.identification.output_error import (
    Entries,
    Fitter,
    low_frequency_power_ratio,
    scaled_solve,
    standard_deviations,
    to_unit_diagonal,
)
from aeropend_ident.identification.problem import Problem
from aeropend_ident.identification.terms import thesis_terms
from aeropend_sim.model.parameters import SAMPLE_PERIOD


def test_the_normal_equations_of_stretches_add_up_to_those_of_the_whole():
    x, v = simulated(8.0)
    problem = Problem(from_arrays(noisy(x, 50.0, 0), {"v_a": v}, SAMPLE_PERIOD), thesis_terms((*STATES, "v_a")))
    start = problem.widened(np.array([[TRUE[s].get(t, 0.0) for t in problem.names] for s in STATES]))
    for length in (0, 900):  # one run, and shots
        fitter = Fitter(problem.experiment(2900), Entries.of(start), length)
        states = fitter.run(*fitter.point)
        residuals = fitter.residuals(states)
        one, _ = fitter.normal_equations(states, fitter.model, residuals)
        many, _ = fitter.normal_equations(states, fitter.model, residuals, blocks=24)
        assert len(many.blocks) == 24
        assert np.allclose(many.H, one.H, rtol=1e-9, atol=1e-9 * np.abs(one.H).max())
        assert np.allclose(many.g, one.g, rtol=1e-6, atol=1e-9 * np.abs(one.g).max())
        assert np.allclose(sum(H for H, _ in many.blocks), many.H)


def linear(length=0):
    """A fitter of x' = -2 x + u, from coefficients that are 20 % off."""
    x, u = pushed(lambda x: -2.0 * x)
    problem = Problem(from_arrays({"x": x}, {"u": u}, 0.005, held_out=0.0), ["x", "u"])
    return Fitter(problem.experiment(len(x)), Entries.of(problem.widened(np.array([[-1.6, 1.2]]))), length, floor=1.0)


@pytest.mark.parametrize("length", [0, 500])
def test_coefficients_are_fitted_in_one_shot_and_in_several(length):
    fitter = linear(length)
    assert fitter.fit()
    assert fitter.model.value == pytest.approx([-2.0, 1.0], rel=0.01)
    assert (np.abs(fitter.model.value - [-2.0, 1.0]) < 5.0 * fitter.deviations()).all()


def test_a_state_restores_all_that_fitting_changes():
    fitter = linear(500)
    before = fitter.state
    fitter.merge_shots(1000)
    assert fitter.fit()
    fitter.refine_steps()
    fitter.steps = 8
    assert not np.allclose(fitter.model.value, before.model.value)
    assert fitter.weights != before.weights
    fitter.state = before
    for now, then in zip(fitter.state, before):
        assert now is then


def test_a_model_that_diverges_is_not_fitted():
    fitter = linear()
    fitter.model = Entries(fitter.model.equation, fitter.model.term, np.array([200.0, 1.0]))
    assert not fitter.fit()
    assert fitter.misfit(fitter.weights) == np.inf


def test_a_slow_residual_has_more_power_at_low_frequencies_than_white_noise():
    white = np.random.default_rng(0).standard_normal(20_000)
    assert low_frequency_power_ratio(white) == pytest.approx(1.0, abs=0.4)
    assert low_frequency_power_ratio(white + np.sin(np.arange(20_000) * 2e-3)) > 10.0


@pytest.mark.filterwarnings("error")
def test_sensitivities_of_an_unstable_model_stay_numbers():
    fitter = linear()
    states = fitter.run(*fitter.point)
    fitter.model = Entries(fitter.model.equation, fitter.model.term, np.array([200.0, 1.0]))
    normal, _ = fitter.normal_equations(states, fitter.model, fitter.residuals(states))
    assert np.isfinite(normal.H).all()


@pytest.mark.filterwarnings("error")
def test_a_diagonal_that_rounding_made_negative_is_not_scaled():
    H = np.array([[-1e30, 1e29], [1e29, 1e36]])
    assert to_unit_diagonal(H).tolist() == [1.0, 1e-18]
    with pytest.raises(np.linalg.LinAlgError):
        scaled_solve(H, np.ones(2))


def test_coefficients_that_cannot_be_told_apart_have_a_standard_deviation():
    rng = np.random.default_rng(0)
    with np.errstate(all="raise"):
        for _ in range(20):  # rounding makes some of the smallest eigenvalues negative
            slopes = rng.standard_normal((50, 2)) @ rng.standard_normal((2, 8)) * 10.0 ** rng.integers(-8, 8, 8)
            slopes[:, 3] = 0.0
            deviations = standard_deviations(slopes.T @ slopes)
            assert np.isinf(deviations[3])
            alone = 1.0 / np.sqrt(np.delete((slopes**2).sum(axis=0), 3))
            assert (np.delete(deviations, 3) >= 0.999 * alone).all()


def test_standard_deviations_are_those_of_the_inverse():
    slopes = np.random.default_rng(0).standard_normal((50, 4)) * [1.0, 1e3, 1e-3, 10.0]
    information = slopes.T @ slopes
    assert standard_deviations(information) == pytest.approx(np.sqrt(np.diag(np.linalg.inv(information))))
