# SPDX-License-Identifier: Apache-2.0
"""Many models at once give the errors of each model alone."""

import numpy as np
import pytest

from aeropend_sim.model import ensemble
from aeropend_sim.model.coefficients import Coefficients
from aeropend_sim.model.dynamics import simulate, steady
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.ensemble import ROW, squared_errors
from aeropend_sim.model.lag import Lag
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model, load


@pytest.mark.parametrize("period", [SAMPLE_PERIOD, 20e-3])
def test_squared_errors_are_those_of_simulate(period):
    rng, base = np.random.default_rng(10), load("bench")
    duty = np.append(np.repeat([0.3, 0.0, 0.9, 0.2, 0.7, 0.4], round(0.5 / period)), rng.uniform(0.0, 1.0, 100))
    measured = np.array(simulate(base, duty, period)[:4])[[0, 3, 2]]
    measured = np.vstack([measured, simulate(base, duty, period).v_a]) + 0.01 * rng.standard_normal((4, len(duty)))
    models, states = [], []
    for k in range(ensemble.LANES + 3):  # more than one block
        model = Model(str(k), {name: value * rng.uniform(0.9, 1.1) for name, value in base.model.items()}, base.sensing)
        models.append(model.with_effects({"parameter_mismatch": {"R_a": 1.3}}) if k % 2 else model)
        states.append(steady(models[-1], 0.05 * k))
    found = squared_errors(models, duty, measured, period, states)
    assert found.shape == (len(models), 4)
    for model, state, sums in zip(models, states, found, strict=True):
        one = simulate(model, duty, period, state)
        expected = [np.sum((a - b)**2) for a, b in zip((one.theta, one.omega, one.i_a, one.v_a), measured, strict=True)]
        assert sums == pytest.approx(expected, rel=1e-9)
    from_rest = squared_errors(models[:1], duty, measured, period)
    one = simulate(models[0], duty, period)
    assert from_rest[0, 0] == pytest.approx(np.sum((one.theta - measured[0])**2), rel=1e-9)
    assert squared_errors([], duty, measured, period).shape == (0, 4)


def test_a_block_has_a_row_for_each_number_of_a_model():
    assert ROW.rotor - ROW.winding == ROW.per_L - ROW.rotor == len(Lag._fields)
    assert {*Coefficients._fields} - {"steps"} <= {*ROW._fields}
    assert ROW.height == ROW.voltage + 1 == ROW.errors + 5


@pytest.mark.parametrize("id_", list(CATALOGUE))
def test_squared_errors_refuse_effects(id_):
    model = load("bench").with_effects({id_: {name: p.default for name, p in CATALOGUE[id_].parameters.items()}})
    with pytest.raises(ValueError, match="nominal"):
        squared_errors([load("bench"), model], np.zeros(3), np.zeros((4, 3)))


def test_squared_errors_take_effects_of_no_size():
    model = load("bench").with_effects({"coulomb_friction": {"accel": 0.0}})
    assert not squared_errors([model], np.zeros(3), np.zeros((4, 3))).any()
