# SPDX-License-Identifier: Apache-2.0
"""The limit of a likelihood test: two names of one thing cannot be separated, two things can."""

import pytest
from evaluation.blind.limit import limit

from aeropend_ident.testing import rigs

SIGMA = {"theta": 2.7e-3, "omega": 0.02, "i_a": 5e-3, "v_a": 5.2e-3}
NUMBERS = dict(rigs.BENCH.model) | {"R_a": 1.04 * rigs.BENCH.model["R_a"], "c_over_J": 0.97 * 1.9}
DUTY = rigs.steps(12.0, seed=3)


def test_two_names_of_one_product_are_a_coin_toss() -> None:
    moved = {"k_thrust": 1.3 * NUMBERS["k_thrust"]}
    found = limit(NUMBERS | moved, {"parameter_mismatch": moved}, DUTY, SIGMA)
    assert found["hardest"] == "parameter_mismatch:L_over_J"
    assert found["accuracy"] == pytest.approx(0.5, abs=0.02)


def test_the_smaller_an_effect_the_harder_it_is_to_tell() -> None:
    large, small = (limit(NUMBERS, {"thrust_lag": {"tau": tau}}, DUTY, SIGMA) for tau in (0.08, 0.004))
    assert large["hardest"] == small["hardest"] == "encoder_lag"
    assert small["distance"] < 0.05 * large["distance"]
    assert large["accuracy"] > 0.999
    assert small["accuracy"] < 0.99
    assert large["rivals"]["encoder_lag"] == large["distance"] < large["rivals"]["coulomb_friction"]


@pytest.mark.parametrize("effects", [{}, {"gust": {"sigma": 1.0, "tau": 0.3}},
                                     {"bridge_drop": {"v_drop": 0.1}, "supply_sag": {"r_supply": 0.1}}])
def test_only_single_effects_without_chance_have_a_limit(effects: dict) -> None:
    with pytest.raises(ValueError, match="single effect"):
        limit(NUMBERS, effects, DUTY, SIGMA)
