# SPDX-License-Identifier: Apache-2.0
"""Sparse equations from arrays: known truth in, the same truth out."""

import numpy as np
import pytest
from sparse_data import THESIS, TRUE, noisy, pushed, rates, simulated

from aeropend_ident.commands.identify import lines
from aeropend_ident.identification.dataset import from_arrays
from aeropend_ident.identification.discrepancy import nominal
from aeropend_ident.identification.identify import identify
from aeropend_ident.studies import lorenz
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model


def test_exact_data_give_exact_equations():
    x, v = simulated(10.0)
    found = identify(from_arrays(x, {"v_a": v}, SAMPLE_PERIOD, derivatives=rates(x, v)), "sindy")
    assert lorenz.is_exact(found.equations, TRUE)
    for s, equation in TRUE.items():
        for term, c in equation.items():
            assert found.equations[s][term] == pytest.approx(c, rel=1e-8)


def test_what_must_be_added_to_a_wrong_model_is_found():
    wrong = Model("wrong", {**THESIS.model, "mgd_over_J": 131.5, "k_thrust": 1.65 / THESIS.model["L_over_J"]},
                  THESIS.sensing)
    x, v = simulated(10.0)
    for data, method in ((from_arrays(x, {"v_a": v}, SAMPLE_PERIOD, derivatives=rates(x, v)), "discrepancy-sindy"),
                         (from_arrays(x, {"v_a": v}, SAMPLE_PERIOD), "discrepancy-weak")):
        found = identify(data, method, known=nominal(wrong)).equations
        assert {s: set(e) for s, e in found.items()} == {
            "theta": set(), "theta_dot": {"sin(theta)", "omega*omega"}, "i_a": set(), "omega": set()}
        assert found["theta_dot"]["sin(theta)"] == pytest.approx(-0.25, rel=1e-3)
        assert found["theta_dot"]["omega*omega"] == pytest.approx(0.0785, rel=1e-3)


@pytest.mark.promise(
    "Identification", "`identify` finds the equations of the simulated rig through its measurement chain")
@pytest.mark.parametrize("method", ["weak", "sindy"])
def test_noisy_data_give_the_true_terms_and_honest_sigmas(method):
    x, v = simulated(25.0, 3)
    found = identify(from_arrays(noisy(x, 50.0, 3), {"v_a": v}, SAMPLE_PERIOD), method)
    assert lorenz.is_exact(found.equations, TRUE)
    z = [(found.equations[s][t] - c) / found.sigma[s][t] for s, e in TRUE.items() for t, c in e.items()]
    assert 0.2 < np.sqrt(np.mean(np.square(z))) < 2.0
    for run in found.free_run.values():
        assert run.gap == pytest.approx(run.floor, rel=0.1)


@pytest.mark.parametrize("cubic", [0.0, -40.0])
def test_what_is_no_sum_of_the_terms_is_noted(cubic):
    x, u = pushed(lambda x: -2.0 * x + cubic * x**3)
    found = identify(from_arrays({"x": x}, {"u": u}, 0.005), "weak", ["x", "u", "x*u"])
    assert any(line.startswith("note: the free run misses") for line in lines(found)) == bool(cubic)


@pytest.mark.promise("Identification", "Nothing is fitted to held-out data")
def test_nothing_is_fitted_to_what_is_held_out():
    x, u = pushed(lambda x: -2.0 * x)
    late = np.arange(len(x)) >= 0.75 * len(x)
    fitted, other = (identify(from_arrays({"x": one}, {"u": u}, 0.005), "weak", ["x", "u", "x*u"])
                     for one in (x, np.where(late, -x, x)))
    assert other.equations == fitted.equations
    assert other.free_run["x"].gap > 10.0 * fitted.free_run["x"].gap
