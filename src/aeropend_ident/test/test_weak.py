# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest
from sparse_data import pushed

from aeropend_ident.identification.sindy import regress
from aeropend_ident.identification.terms import Library
from aeropend_ident.identification.weak import Weak, Windows, corner, half_width, sided

PERIOD = 0.005


def test_the_slope_of_a_test_function_takes_the_derivative():
    t = np.arange(400) * PERIOD
    windows = Windows.over(len(t), 30, PERIOD)
    found = -windows.project(t**2, windows.slope) * PERIOD
    assert found == pytest.approx(2.0 * t[windows.first + 30], rel=1e-6)
    with pytest.raises(ValueError, match="60 samples are fewer"):
        Windows.over(60, 30, PERIOD)


def test_a_noisier_signal_gets_wider_test_functions():
    rng = np.random.default_rng(0)
    x = np.sin(np.arange(4000) * 0.03)
    clean, noisy = (x + sigma * rng.standard_normal(len(x)) for sigma in (1e-6, 1e-1))
    assert corner(noisy) < corner(clean)
    assert half_width(noisy) >= half_width(clean)


def test_terms_at_a_step_of_the_input_are_the_mean_of_both_sides():
    library = Library.of(("x", "u"), ["u"])
    assert sided(library, np.zeros((3, 1)), np.array([[1.0], [3.0], [3.0]]))[:, 0].tolist() == [1.0, 2.0, 3.0]


def test_the_equation_of_a_noisy_signal_is_found():
    x, u = pushed(lambda x: -2.0 * x)
    library = Library.of(("x", "u"), ["1", "x", "u", "x*u", "x*x"])
    c = regress(Weak(library, x[:, None], u[:, None], PERIOD), 0)
    assert np.flatnonzero(c).tolist() == [1, 2]
    assert c[[1, 2]] == pytest.approx([-2.0, 1.0], rel=0.02)
