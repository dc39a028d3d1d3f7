# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest
from sparse_data import TERMS, pushed_once

from aeropend_ident.commands.identify import document, lines
from aeropend_ident.identification.dataset import from_arrays
from aeropend_ident.identification.identify import identify
from aeropend_ident.identification.output_error import Fitter, ReducedNormalEquations
from aeropend_ident.identification.output_error_selection import QuadraticMisfit, select_terms
from aeropend_ident.identification.problem import Problem


@pytest.mark.promise("Identification", "A term that the data do not determine is marked `undetermined`")
def test_a_term_that_hangs_on_one_stretch_of_the_recording_is_undetermined():
    data = pushed_once(0.5)
    found = identify(data, "weak", TERMS)
    assert found.stability["x"]["u"] == 1.0
    assert 0.4 < found.stability["x"]["w"] < 0.8
    assert any("w [undetermined: in " in line for line in lines(found))
    (listed,) = document(found, data, "bag", "bench", 0.0)["undetermined"]
    assert (listed["equation"], listed["term"]) == ("x", "w")


def test_such_a_term_is_left_out_where_held_out_data_do_not_miss_it():
    data = pushed_once(0.02)
    found = identify(data, "weak", TERMS)
    assert set(found.equations["x"]) == set(found.stability["x"]) == {"x", "u"}
    ((state, term, often),) = found.unstable
    assert (state, term) == ("x", "w")
    assert often < 0.8
    assert any("w is left out" in line for line in lines(found))
    (listed,) = document(found, data, "bag", "bench", 0.0)["undetermined"]
    assert (listed["term"], listed["left_out"]) == ("w", True)


def test_a_choice_that_the_free_run_does_not_keep_is_taken_back(monkeypatch):
    monkeypatch.setattr(QuadraticMisfit, "search", lambda misfit, support: [])  # as near-collinear terms can make it
    assert set(identify(pushed_once(0.02), "weak", TERMS).equations["x"]) == {"x", "u"}


@pytest.mark.promise("Identification", "A term that the data do not determine is marked `undetermined`")
def test_a_term_that_the_data_cannot_tell_from_another_is_said_to_be_undetermined():
    t = np.arange(4000) * 0.005
    u = np.repeat(np.random.default_rng(5).uniform(-1.0, 1.0, 40), 100)
    x = np.zeros(len(t))
    for k in range(len(t) - 1):  # so small an angle that its sine is itself
        x[k + 1] = x[k] * np.exp(-2.0 * 0.005) + 1e-3 * u[k] * (1.0 - np.exp(-2.0 * 0.005)) / 2.0
    x += 1e-5 * np.random.default_rng(6).standard_normal(len(t))
    data = from_arrays({"x": x}, {"u": u}, 0.005)
    found = identify(data, "weak")
    pairs = {frozenset((a.term, a.instead)) for a in found.alternatives}
    assert frozenset(("x", "sin(x)")) in pairs
    listed = document(found, data, "bag", "bench", 0.0)["undetermined"]
    assert frozenset(("x", "sin(x)")) in {frozenset((one["term"], one.get("or"))) for one in listed}


@pytest.mark.filterwarnings("error")
def test_terms_that_are_equal_but_for_rounding_cost_no_infinite_misfit():
    H = np.array([[1.0, 1.0 + 1e-9], [1.0 + 1e-9, 1.0]])  # not positive definite, by rounding
    normal = ReducedNormalEquations(H, np.array([1.0, 0.0]), 1.0, 10, [])
    changes = list(QuadraticMisfit(normal, np.zeros(2), 1.0, np.zeros(2, int)).single_changes([0, 1]))
    assert all(np.isfinite(change.value) for change in changes)


def test_a_model_that_runs_in_coarse_steps_only_is_none(monkeypatch):
    """As a fast one that coarse steps damp: finer ones show that it diverges."""
    data = pushed_once(0.02)
    problem = Problem(data, TERMS)
    start = problem.widened(np.where(np.array(TERMS) == "x", -1.0, 0.0)[None])
    run = Fitter.run
    monkeypatch.setattr(Fitter, "run", lambda fitter, model, x0: run(fitter, model, x0) if fitter.steps == 2 else None)
    assert select_terms(problem.experiment(data.train), start, problem.candidates, 200, cut=False) is None
