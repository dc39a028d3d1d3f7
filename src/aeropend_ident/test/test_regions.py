# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from aeropend_ident.diagnosis.regions import Misfit, regions, shares
from aeropend_sim.model.effects import PLACES


def test_shares_add_up_and_name_every_place():
    found = shares([("arm", 3.0), ("thrust", 1.0), ("arm", 1.0)])
    assert tuple(found) == PLACES
    assert found["arm"] == pytest.approx(0.8)
    assert sum(found.values()) == pytest.approx(1.0)
    assert set(shares([]).values()) == {0.0}


def test_a_misfit_in_a_band_is_located_and_one_everywhere_is_not():
    rng = np.random.default_rng(0)
    x, other = rng.uniform(-1.0, 1.0, 20_000), rng.uniform(-1.0, 1.0, 20_000)
    misfit = rng.standard_normal(len(x)) * np.where((x > 0.2) & (x < 0.6), 5.0, 0.5)
    found = regions(Misfit(misfit, {"x": x, "other": other}))
    assert [r.variable for r in found] == ["x"]
    assert found[0].low == pytest.approx(0.2, abs=0.17)
    assert found[0].high == pytest.approx(0.6, abs=0.17)
    assert found[0].share > 0.9
    assert found[0].time < 0.4
    assert regions(Misfit(rng.standard_normal(len(x)), {"x": x, "other": other})) == []
    assert regions(Misfit(np.zeros(len(x)), {"x": x})) == []
