# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest
from sparse_data import THESIS

from aeropend_ident.identification.discrepancy import nominal
from aeropend_sim.model import dynamics
from aeropend_sim.model.coefficients import prepare
from aeropend_sim.model.parameters import ModelError, load
from aeropend_sim.model.state import State


def test_the_nominal_equations_are_those_of_the_dynamics():
    for model in (THESIS, load("bench")):
        v, h = np.full(3, 1.2), 1e-5
        state = State(0.1, 60.0, 0.0, 0.4, -0.7)
        out = np.empty((7, 3))
        dynamics.run(v, np.zeros(3), state, *prepare(model, h), out)
        slope = (-1.5 * out[:4, 0] + 2.0 * out[:4, 1] - 0.5 * out[:4, 2]) / h
        x = {"theta_dot": -0.7, "sin(theta)": np.sin(0.4), "i_a": 0.1, "omega": 60.0, "v_a": 1.2,
             "omega*abs(omega)": 3600.0}
        for k, equation in enumerate(nominal(model).values()):
            assert sum(c * x[t] for t, c in equation.items()) == pytest.approx(slope[k], rel=2e-4)


def test_a_model_with_effects_is_no_sum_of_terms():
    with pytest.raises(ModelError, match="gust"):
        nominal(THESIS.with_effects({"gust": {"sigma": 1.0, "tau": 0.1}}))
