# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from aeropend_sim.model.step_features import step_features


def second_order(zeta, omega):
    """Step response of a second-order system, and its features in closed form where there is one."""
    time = np.arange(0.0, 12.0, 2e-3)
    damped = omega * math.sqrt(1.0 - zeta**2)
    y = 1.0 - np.exp(-zeta * omega * time) * (np.cos(damped * time) + zeta * omega / damped * np.sin(damped * time))
    return time, y, math.pi / damped, math.exp(-math.pi * zeta / math.sqrt(1.0 - zeta**2))


@pytest.mark.parametrize(("zeta", "omega"), [(0.2, 5.0), (0.4, 3.0), (0.6, 8.0)])
def test_features_of_a_second_order_system(zeta, omega):
    time, y, peak_time, overshoot = second_order(zeta, omega)
    found = step_features(time, 0.7 * y, 0.7)
    assert found.peak_time == pytest.approx(peak_time, abs=1e-4)
    assert found.overshoot == pytest.approx(overshoot, abs=1e-4)
    fine = np.interp(np.arange(0.0, 11.99, 1e-5), time, y)
    assert found.rise_time == pytest.approx(1e-5 * (np.argmax(fine >= 0.9) - np.argmax(fine >= 0.1)), abs=3e-5)
    assert found.settling_time == pytest.approx(1e-5 * np.flatnonzero(np.abs(fine - 1.0) > 0.02)[-1], abs=3e-5)


def test_features_that_are_not_reached_are_nan():
    time = np.arange(0.0, 1.0, 0.01)
    found = step_features(time, 0.5 * time, 1.0)
    assert math.isnan(found.rise_time)
    assert math.isnan(found.settling_time)
