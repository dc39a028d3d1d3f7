# SPDX-License-Identifier: Apache-2.0
"""Lines as the page draws them: what is left out of a long one, where it has gaps, and how its values are packed."""

import base64
import math

import numpy as np

from aeropend_ident.diagnosis.report import drawing, traces


def test_every_stretch_keeps_its_least_and_greatest():
    x = np.random.default_rng(1).standard_normal(10_007)
    x[[500, 5000]] = 99.0, -99.0
    x[2000:3000] = np.nan
    drawn = drawing.least_and_greatest(x, 400)
    assert len(drawn) == 400
    assert (np.nanmax(drawn), np.nanmin(drawn)) == (99.0, -99.0)
    assert 30 <= np.isnan(drawn).sum() <= 40
    assert drawing.least_and_greatest(x, 20_000) is x


def test_readings_that_are_some_samples_apart_are_connected():
    nothing = math.nan
    x = np.array([nothing, 1.0, nothing, 3.0, nothing, 5.0, *[nothing] * 12, 9.0, nothing])
    drawn = drawing.connected(x)
    assert drawn[:6].tolist()[1:] == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert np.isnan(drawn[[0, *range(6, 18), -1]]).all()
    dense = np.array([1.0, 2.0, nothing, nothing, 3.0, 4.0, 5.0])
    assert drawing.connected(dense) is dense


def test_packed_values_come_back():
    x = np.concatenate([np.linspace(-3.0, 5.0, 1001), [np.nan]])
    packed = traces._packed(x)
    steps = np.frombuffer(base64.b64decode(packed["data"]), "<i2").astype(float)
    back = np.where(steps == -32768, np.nan, packed["low"] + (steps + 32767) * packed["scale"])
    assert np.nanmax(np.abs(back - x)) <= 8.0 / 65534 / 2 * 1.001
    assert np.isnan(back[-1])
    assert not np.isnan(back[:-1]).any()


def test_a_path_has_gaps_where_values_are_missing():
    drawn = drawing.path(np.array([0.0, 1.0, np.nan, 1.0, 0.0]), 0.0, 1.0)
    assert drawn == "M0 400l0 0 400-400M1200 0l0 0 400 400"
