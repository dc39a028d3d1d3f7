# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from aeropend_ident.signals.noise import innovation_noise, quantised_noise


def swing(noise, step, seed=3):
    t = np.arange(0.0, 40.0, 1.0 / 490.0)
    exact = 0.7 * np.sin(0.3 * t) + 0.3 * np.sin(1.1 * t)
    return np.round((exact + noise * np.random.default_rng(seed).standard_normal(len(t))) / step) * step


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.14, 0.3, 0.45])
def test_noise_below_the_step_of_a_slow_coarse_channel_counts_beside_it(noise):
    step = 0.006
    x = swing(noise * step, step)
    assert quantised_noise(x, step) == pytest.approx(step * math.hypot(noise, math.sqrt(1.0 / 12.0)), rel=0.03)


def test_a_predictor_sees_too_little_noise_of_a_slow_coarse_channel():
    step = 0.006
    x = swing(0.05 * step, step)
    assert 0.1 * step < innovation_noise(x, np.zeros(len(x))) < 0.9 * quantised_noise(x, step)


@pytest.mark.parametrize(("x", "step"), [(np.full(2000, 0.3), 0.01), (swing(0.0, 0.006)[:20], 0.006),
                                         (np.full(2000, np.nan), 0.01), (swing(0.0, 1e-9), 0.0)])
def test_a_channel_that_does_not_move_slowly_over_steps_has_its_quantisation_noise(x, step):
    assert quantised_noise(x, step) == step / math.sqrt(12.0)
