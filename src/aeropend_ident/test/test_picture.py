# SPDX-License-Identifier: Apache-2.0

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from aeropend_ident.bench_tests.estimates import Panel
from aeropend_ident.bench_tests.picture import scatter
from aeropend_ident.identification import picture
from aeropend_ident.identification.picture import draw

SVG = "{http://www.w3.org/2000/svg}"


def test_each_state_has_its_derivative_and_its_free_run():
    x = np.random.default_rng(0).standard_normal((4000, 2))
    with_run = ET.fromstring(draw("weak", ["a", "b<c"], 100, 0.01, x, x, x, x))
    assert len(with_run.findall(f"{SVG}g")) == 4
    assert len(with_run.findall(f".//{SVG}polyline")) == 8
    assert "1.0 to 41.0 s" in "".join(with_run.itertext())
    assert len(ET.fromstring(draw("weak", ["a", "b"], 0, 0.01, x, x, x, None)).findall(f"{SVG}g")) == 2


def test_each_panel_of_bench_tests_shows_its_readings_and_its_curve():
    x = np.arange(1.0, 6.0)
    drawn = ET.fromstring(scatter([Panel("load", "x", "y", x, 2.0 * x, lambda x: 2.0 * x)] * 3))
    assert len(drawn.findall(f"{SVG}g")) == 3
    assert len(drawn.findall(f".//{SVG}circle")) == 15


@pytest.mark.filterwarnings("error")
def test_a_run_that_leaves_the_picture_far_is_drawn_at_its_edge():
    assert picture._line(np.array([0.0, 1e300, -1e300]), 0.0, 1e-300, 0, 0, "red").count(",") == 3
