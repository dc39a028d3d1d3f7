# SPDX-License-Identifier: Apache-2.0
"""Sparse equations from arrays: known truth in, the same truth out."""

import numpy as np
import pytest
from scipy.signal import lfilter

from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.commands.identify import document, lines
from aeropend_ident.identification.dataset import from_arrays
from aeropend_ident.identification.discrepancy import nominal
from aeropend_ident.identification.identify import identify
from aeropend_ident.identification.output_error import Entries, Fitter
from aeropend_ident.identification.output_error_selection import QuadraticMisfit
from aeropend_ident.identification.problem import Problem
from aeropend_ident.identification.subset_selection import NormalEquations, ebic_search
from aeropend_ident.identification.terms import thesis_terms
from aeropend_ident.studies import lorenz
from aeropend_sim.model import actuator, dynamics
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model, ModelError, load

STATES = ("theta", "theta_dot", "i_a", "omega")
THESIS = load("thesis")


def squared(equations):
    """The rotor never turns backwards, so ω|ω| is ω²."""
    return {s: {t.replace("omega*abs(omega)", "omega*omega"): c for t, c in e.items()} for s, e in equations.items()}


TRUE = squared(nominal(THESIS))


def simulated(seconds, seed=0):
    v = actuator.voltage(THESIS.numbers(), Excitation(duration=seconds, seed=seed).series())
    out = np.empty((7, len(v)))
    dynamics.run(v, np.zeros(len(v)), dynamics.State(), *dynamics.prepare(THESIS, SAMPLE_PERIOD, 32), out)
    return dict(zip(STATES, out[:4])), v


def noisy(x, decibel, seed):
    rng = np.random.default_rng(seed)
    return {s: a + np.sqrt(np.mean(a**2)) * 10.0 ** (-decibel / 20.0) * rng.standard_normal(len(a))
            for s, a in x.items()}


def rates(x, v):
    values = {"theta_dot": x["theta_dot"], "sin(theta)": np.sin(x["theta"]), "omega*omega": x["omega"] ** 2,
              "i_a": x["i_a"], "omega": x["omega"], "v_a": v}
    return {s: sum(c * values[t] for t, c in e.items()) for s, e in TRUE.items()}


def test_selection_finds_the_terms_that_made_the_data():
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((2000, 20))
    rows[:, 5] = rows[:, 2] + 0.05 * rows[:, 5]  # nearly the same as a true one
    y = 3.0 * rows[:, 2] - 0.5 * rows[:, 11] + 0.1 * rng.standard_normal(2000)
    assert ebic_search(NormalEquations.of(rows, y)) == [2, 11]


def test_nothing_is_found_in_noise():
    rng = np.random.default_rng(1)
    assert ebic_search(NormalEquations.of(rng.standard_normal((2000, 30)), rng.standard_normal(2000))) == []


def test_the_nominal_equations_are_those_of_the_dynamics():
    for model in (THESIS, load("bench")):
        v, h = np.full(3, 1.2), 1e-5
        state = dynamics.State(0.1, 60.0, 0.0, 0.4, -0.7)
        out = np.empty((7, 3))
        dynamics.run(v, np.zeros(3), state, *dynamics.prepare(model, h), out)
        slope = (-1.5 * out[:4, 0] + 2.0 * out[:4, 1] - 0.5 * out[:4, 2]) / h
        x = {"theta_dot": -0.7, "sin(theta)": np.sin(0.4), "i_a": 0.1, "omega": 60.0, "v_a": 1.2,
             "omega*abs(omega)": 3600.0}
        for k, equation in enumerate(nominal(model).values()):
            assert sum(c * x[t] for t, c in equation.items()) == pytest.approx(slope[k], rel=2e-4)


def test_a_model_with_effects_is_no_sum_of_terms():
    with pytest.raises(ModelError, match="gust"):
        nominal(THESIS.with_effects({"gust": {"sigma": 1.0, "tau": 0.1}}))


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


@pytest.mark.parametrize("method", ["weak", "sindy"])
def test_noisy_data_give_the_true_terms_and_honest_sigmas(method):
    x, v = simulated(25.0, 3)
    found = identify(from_arrays(noisy(x, 50.0, 3), {"v_a": v}, SAMPLE_PERIOD), method)
    assert lorenz.is_exact(found.equations, TRUE)
    z = [(found.equations[s][t] - c) / found.sigma[s][t] for s, e in TRUE.items() for t, c in e.items()]
    assert 0.2 < np.sqrt(np.mean(np.square(z))) < 2.0
    for run in found.free_run.values():
        assert run.gap == pytest.approx(run.floor, rel=0.1)


def test_lorenz_is_found_by_every_method():
    for method in ("sindy", "weak", "discrepancy-sindy", "discrepancy-weak"):
        found = lorenz.study(method, 0.05, 4)
        assert lorenz.is_exact(found.equations, lorenz.truth(method)), method


def pushed_once(push, n=6000, seed=5):
    """x' = -20 x + u + w (N,), where w pushes in one short stretch only; noisy readings, and both inputs."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, n // 100), 100)
    w = np.where(abs(np.arange(n) - 2330) < 70, push, 0.0)
    x = lfilter([0.0, (1.0 - np.exp(-0.1)) / 20.0], [1.0, -np.exp(-0.1)], u + w)
    return from_arrays({"x": x + 1e-3 * rng.standard_normal(n)}, {"u": u, "w": w}, 0.005)


TERMS = ["x", "u", "w", "x*u", "x*x"]


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


def pushed(slope, n=3000, period=0.005, seed=7):
    """x (N,) of x' = slope(x) + u from rest, with noise, and u (N,), held for half a second each."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, n // 100), 100)
    x = np.zeros(n)
    for k in range(n - 1):
        x[k + 1] = x[k]
        for _ in range(10):
            x[k + 1] += 0.1 * period * (slope(x[k + 1]) + u[k])
    return x + 1e-3 * rng.standard_normal(n), u


@pytest.mark.parametrize("cubic", [0.0, -40.0])
def test_what_is_no_sum_of_the_terms_is_noted(cubic):
    x, u = pushed(lambda x: -2.0 * x + cubic * x**3)
    found = identify(from_arrays({"x": x}, {"u": u}, 0.005), "weak", ["x", "u", "x*u"])
    assert any(line.startswith("note: the free run misses") for line in lines(found)) == bool(cubic)


def test_nothing_is_fitted_to_what_is_held_out():
    x, u = pushed(lambda x: -2.0 * x)
    late = np.arange(len(x)) >= 0.75 * len(x)
    fitted, other = (identify(from_arrays({"x": one}, {"u": u}, 0.005), "weak", ["x", "u", "x*u"])
                     for one in (x, np.where(late, -x, x)))
    assert other.equations == fitted.equations
    assert other.free_run["x"].gap > 10.0 * fitted.free_run["x"].gap


def test_derivatives_may_be_those_of_total_variation():
    x, u = pushed(lambda x: -2.0 * x)
    data = from_arrays({"x": x}, {"u": u}, 0.005)
    found = {way: identify(data, "sindy", ["x", "u", "x*u"], derivative=way) for way in ("smoothed", "tv")}
    for one in found.values():
        assert set(one.equations["x"]) == {"x", "u"}
        assert one.equations["x"]["x"] == pytest.approx(-2.0, rel=0.02)
    assert found["tv"].held_out_mse != found["smoothed"].held_out_mse


@pytest.mark.parametrize(("change", "words"), [
    ({"omega": np.nan}, "omega is not a number"),
    ({"i_a": 0.5}, "i_a is 0.5 all the time"),
])
def test_bad_arrays_are_refused_in_one_line(change, words):
    x, v = simulated(6.0)
    for name, value in change.items():
        x[name] = np.full(len(v), value)
    with pytest.raises(RecordingError, match=words) as error:
        from_arrays(x, {"v_a": v}, SAMPLE_PERIOD)
    assert "\n" not in str(error.value)
