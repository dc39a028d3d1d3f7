# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest

from aeropend_ident.diagnosis.search.proposed_formula import definition, propose
from aeropend_ident.diagnosis.search.term_shapes import CONSTANTS, SHAPES
from aeropend_sim.model import effect_file
from aeropend_sim.model.compiled_formula import compiled
from aeropend_sim.model.formula import QUANTITIES

UNITS = {"theta": "rad", "theta_dot": "rad/s", "omega": "rad/s", "thrust": "N"}
N = 4000
T = np.linspace(0.0, 40.0, N)
SEEN = {"theta": 0.5 + 0.7 * np.sin(1.1 * T), "theta_dot": 5.0 * np.sin(2.3 * T) * np.cos(0.31 * T),
        "omega": 175.0 + 170.0 * np.sin(0.7 * T)}
SEEN["thrust"] = 3e-5 * SEEN["omega"] ** 2


def learned(term, x, points=12, seed=0):
    """A term as it is learned: lines between points that are 5 % wrong, and their places."""
    at = np.quantile(x, np.linspace(0.0, 1.0, points))
    rms = np.sqrt(np.mean(term(x) ** 2))
    return np.interp(x, at, term(at) + 0.05 * rms * np.random.default_rng(seed).normal(size=points)), at


def off(found, true):
    return np.sqrt(np.mean((found - true) ** 2) / np.mean(true**2))


@pytest.mark.parametrize(("name", "term"), [
    ("theta_dot", lambda x: -0.4 * np.tanh(x / 0.6) - 0.2 * x),
    ("theta", lambda x: 3.0 * np.exp(-((x - 0.6) / 0.3) ** 2)),
    ("omega", lambda x: 1e-4 * x**2), ("theta", lambda x: np.sin(6.0 * x)),
    ("theta_dot", lambda x: np.arctan(x / 0.5) + 0.1 * x), ("theta", lambda x: np.maximum(0.0, x - 0.7))])
@pytest.mark.parametrize("told", [True, False])
def test_a_term_of_one_quantity_is_found(name, term, told):
    x = SEEN[name]
    target, at = learned(term, x)
    best = propose({name: x}, UNITS, target, np.full(N, 0.05 * np.std(target)), "rad/s²",
                   knots={name: at} if told else None)[0]
    assert off(best({name: x}), term(x)) < 0.1


def test_sums_and_products_with_the_thrust_are_found():
    g, at = learned(lambda x: np.exp(-np.abs(x) / 0.3), SEEN["theta"])
    variables = {k: SEEN[k] for k in ("theta", "thrust")}
    best = propose(variables, UNITS, SEEN["thrust"] * g, 0.05 * SEEN["thrust"], "N", knots={"theta": at})[0]
    assert off(best(variables), SEEN["thrust"] * np.exp(-np.abs(SEEN["theta"]) / 0.3)) < 0.1
    g, at = learned(lambda x: 0.5 * x, SEEN["theta"])
    h, rates = learned(np.tanh, SEEN["theta_dot"])
    variables = {k: SEEN[k] for k in ("theta", "theta_dot")}
    best = propose(variables, UNITS, g + h, np.full(N, 0.05), "rad/s²", knots={"theta": at, "theta_dot": rates})[0]
    assert off(best(variables), 0.5 * SEEN["theta"] + np.tanh(SEEN["theta_dot"])) < 0.1


def test_each_proposal_is_an_effect_whose_size_scales_all_of_it():
    target, at = learned(lambda x: np.sin(4.0 * x) + x, SEEN["theta"])
    variables = {k: SEEN[k] for k in ("theta", "theta_dot", "thrust")}
    found = propose(variables, UNITS, target * SEEN["thrust"], 0.05 * SEEN["thrust"], "rad/s²", knots={"theta": at})
    assert 2 <= len(found) <= 5
    for k, one in enumerate(found):
        id_ = f"proposed_in_test_{k}"
        effect = effect_file.define({id_: definition(one, "arm")}, "a test")[id_]
        assert next(iter(effect.parameters.values())).neutral == 0.0
        function = compiled(effect.term, tuple(effect.parameters)).ctypes
        for size in (0.0, 1.0):
            values = np.array([p.default for p in effect.parameters.values()])
            values[0] *= size
            inputs = [float(SEEN[q][7]) if q in SEEN else 0.0 for q in QUANTITIES]
            given = function(*inputs, 0.0, values.ctypes.data_as(function.argtypes[-1]))
            assert given == pytest.approx(size * one(variables)[7], rel=1e-9, abs=1e-12)


def test_the_units_of_all_shapes_fit():
    for k, shape in enumerate(SHAPES[1:]):
        names = {letter: CONSTANTS[letter].name for letter in shape.letters}
        units = {1: "rad/s", -1: "s/rad", 0: "-"}
        constants = {names[c]: {"unit": units[CONSTANTS[c].power], "default": 1.0, "low": 0.5, "high": 2.0}
                     for c in shape.letters}
        unit = {0: "rad/s²", 1: "1/s", 2: "1/rad", 3: "s/rad²", 4: "s²/rad³"}[shape.power]
        effect_file.define({f"shape_in_test_{k}": {
            "place": "arm", "term": f"size * {shape.text.format(x='theta_dot', **names)}",
            "parameters": {"size": {"unit": unit, "default": 1.0, "low": 0.0, "high": 2.0}, **constants}}}, "a test")


def test_a_term_that_is_zero_has_no_formula():
    assert propose({"theta": SEEN["theta"]}, UNITS, np.zeros(N), np.ones(N), "N") == []


@pytest.mark.filterwarnings("error")
def test_points_far_outside_of_the_data_are_no_obstacle():
    x = SEEN["omega"]
    at = np.array([0.0, 100.0, 200.0, 1e6])
    found = propose({"omega": x}, UNITS, 1e-4 * x, np.full(N, 1e-4), "rad/s²", knots={"omega": at})
    assert off(found[0]({"omega": x}), 1e-4 * x) < 0.1
