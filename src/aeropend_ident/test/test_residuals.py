# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from aeropend_ident.estimation.residuals import LARGEST, Sensitivities, finite


@pytest.mark.filterwarnings("error")
def test_residuals_of_a_simulation_that_diverges_stay_numbers():
    assert finite(np.array([1.0, np.nan, -np.inf, 1e300])).tolist() == [1.0, LARGEST, -LARGEST, LARGEST]
    assert finite(np.array([[1.0, 1e40]]), 1e30).tolist() == [[1.0, 1e30]]
    assert finite(np.zeros((0, 3))).shape == (0, 3)


def test_corrected_derivatives_hold_along_the_step_and_stay_across_it():
    rng = np.random.default_rng(7)
    rows = rng.standard_normal((3, 50))
    step, change = np.array([0.7, 0.2, -0.1, 0.5]), rng.standard_normal(50)
    by = np.array([1, 2, 3])
    corrected = Sensitivities(by, rows).corrected(step, change)
    assert corrected.rows.T @ step[by] == pytest.approx(change)
    across = np.array([0.1, 0.2, 0.0])
    assert across @ step[by] == pytest.approx(0.0)
    assert corrected.rows.T @ across == pytest.approx(rows.T @ across)
