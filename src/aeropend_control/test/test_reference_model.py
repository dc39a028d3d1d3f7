# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from aeropend_control.laws.reference_model import ReferenceModel

T = 0.002


def test_the_motion_is_smooth_and_ends_at_the_reference():
    model = ReferenceModel(0.15, T)
    model.reset(0.1)
    y, rate, acceleration, jerk = np.array([model.step(0.5) for _ in range(1000)]).T
    assert y[-1] == pytest.approx(0.5, abs=1e-5)
    assert y.max() - 0.5 < 0.03 * 0.4
    for integral, derivative in ((y, rate), (rate, acceleration), (acceleration, jerk)):
        change = 0.5 * T * (derivative[1:] + derivative[:-1])
        assert np.diff(integral) == pytest.approx(change, abs=3e-3 * np.abs(change).max())


def test_it_goes_on_from_where_it_is_put():
    model = ReferenceModel(0.15, T)
    model.reset(0.3, 0.4, -0.1)
    y, rate, acceleration, _ = model.step(0.3)
    assert (y, rate, acceleration) == (pytest.approx(0.3 + 0.4 * T, abs=1e-5), pytest.approx(0.4, abs=0.03),
                                       pytest.approx(-0.1, abs=1.0))


def test_without_a_time_it_is_the_reference():
    assert ReferenceModel(0.0, T).step(0.7) == (0.7, 0.0, 0.0, 0.0)
