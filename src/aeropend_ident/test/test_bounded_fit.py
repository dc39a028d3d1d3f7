# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from aeropend_ident.estimation.bounded_fit import sensitivities, within_bounds
from aeropend_ident.estimation.parameter import Parameter


def test_least_squares_within_bounds_are_exact_for_a_linear_problem():
    rng = np.random.default_rng(3)
    rows = rng.standard_normal((4, 50)) * np.array([1.0, 3.0, 0.2, 1.0])[:, None]
    target = rng.standard_normal(50) + 2.0 * rows[0] - 1.0 * rows[1]
    names = "abcd"
    limits = [Parameter(n, 0.0, 1.0, -0.5, 0.5) for n in names]

    def residuals(values):
        return {"x": np.array([values[n] for n in names]) @ rows - target}

    exact = lsq_linear(rows.T, target, (-0.5, 0.5)).x
    near = sensitivities(residuals, limits)
    rough = {"x": replace(near["x"], rows=near["x"].rows * rng.uniform(0.9, 1.1, rows.shape))}
    for slopes, steps_, off in ((near, 1, 1e-6), (rough, 30, 0.02)):
        found = within_bounds(residuals, limits, slopes, steps_)
        np.testing.assert_allclose([found[n] for n in names], exact, atol=off)


@pytest.mark.parametrize("log", [False, True])
def test_a_parameter_at_a_bound_does_not_leave_its_range_by_rounding(log):
    for mean, sd, low, high in np.random.default_rng(3).uniform(0.1, 5.0, (500, 4)):
        one = Parameter("k", mean, sd, min(low, high), max(low, high), log=log)
        assert one.low <= one.value(one.to_standard(one.low))
        assert one.value(one.to_standard(one.high)) <= one.high
        assert one.value(one.to_standard(one.low) - 1e-3) < one.low
