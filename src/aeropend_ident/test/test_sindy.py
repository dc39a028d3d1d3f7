# SPDX-License-Identifier: Apache-2.0

import pytest
from sparse_data import pushed

from aeropend_ident.identification.dataset import from_arrays
from aeropend_ident.identification.identify import identify


def test_derivatives_may_be_those_of_total_variation():
    x, u = pushed(lambda x: -2.0 * x)
    data = from_arrays({"x": x}, {"u": u}, 0.005)
    found = {way: identify(data, "sindy", ["x", "u", "x*u"], derivative=way) for way in ("smoothed", "tv")}
    for one in found.values():
        assert set(one.equations["x"]) == {"x", "u"}
        assert one.equations["x"]["x"] == pytest.approx(-2.0, rel=0.02)
    assert found["tv"].held_out_mse != found["smoothed"].held_out_mse
