# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from aeropend_ident.estimation.whittle import whittle


def test_a_slow_misfit_counts_for_less_than_white_noise_of_its_power_however_long_it_is():
    for n in (2000, 8000):
        noise = np.random.default_rng(n).standard_normal(n)
        slow = noise + 3.0 * np.sqrt(2.0) * np.sin(np.linspace(0.0, 6.0, n))
        lost_slow, lost_white = (whittle(noise) - whittle(r) for r in (slow, np.sqrt(10.0) * noise))
        assert 0.0 < lost_slow < 0.1 * lost_white
        assert lost_slow < 60.0
        assert lost_white == pytest.approx(0.5 * n * np.log(10.0), rel=0.1)
