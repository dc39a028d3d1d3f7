# SPDX-License-Identifier: Apache-2.0
"""An effect of another form than the catalogue's, beside one elsewhere that could borrow its gap."""

import pytest

from aeropend_ident.gap.diagnosis import diagnose
from aeropend_ident.gap.signals import from_arrays
from aeropend_sim.parameters import SAMPLE_PERIOD, load
from blind import cases

BENCH = load("bench")


@pytest.mark.parametrize(("effect", "place", "seed"), [("thrust_lag", "thrust", 1), ("thrust_lag", "thrust", 4),
                                                       ("encoder_lag", "sensing", 1)])
def test_a_lag_is_placed_by_what_curves_at_its_place_explain(effect, place, seed):
    case, columns = cases.draw("lag", "single", [effect], "other", BENCH.model, BENCH.sensing, seed, 40.0)
    body = diagnose(BENCH, [from_arrays(columns, SAMPLE_PERIOD, BENCH.sensing)], 2).body
    assert case.form == "other"
    # so far from the catalogue's form it may pass for unknown, never for the lag of another place
    assert body["which"]["verdict"] in (effect, "unknown")
    assert body["where"]["place"] == place
