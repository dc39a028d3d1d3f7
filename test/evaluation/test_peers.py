# SPDX-License-Identifier: Apache-2.0
"""The peers do what their idea allows: they find what is plain, and say nothing of a rig that is as its model."""

import pytest
from evaluation.blind import peers

from aeropend_ident.testing import rigs

PLAIN = {"brush_drop": {"v_brush": 0.15}, "supply_sag": {"r_supply": 0.3}, "cable_torque": {"k": 6.0, "theta0": 0.3}}


@pytest.mark.promise("Measurements", "The peers of the benchmarks work")
@pytest.mark.parametrize("effect", PLAIN)
def test_sparse_regression_finds_a_plain_effect(effect: str) -> None:
    said = peers.sparse_regression(rigs.recorded(5, {effect: PLAIN[effect]}))
    assert said["effects"][0] == effect
    assert said["place"] == peers.place_of(effect)


@pytest.mark.parametrize("optimizer", ["stlsq", "sr3", "frols"])
def test_every_optimizer_of_the_regression_works(optimizer: str) -> None:
    said = peers.sparse_regression(rigs.recorded(5, {"brush_drop": {}}), optimizer=optimizer)
    assert said["effects"][0] == "brush_drop"


def test_a_rig_as_its_model_gives_none() -> None:
    signals = rigs.recorded(6, {}, 28.0, off=0.01)
    none = {"effects": [], "place": "none"}
    for said in (peers.sparse_regression(signals), peers.stepwise_bic(signals)):
        assert {k: said[k] for k in none} == none


@pytest.mark.promise("Measurements", "The peers of the benchmarks work")
def test_stepwise_bic_finds_a_plain_effect_and_keeps_its_time() -> None:
    signals = rigs.recorded(5, {"quadratic_drag": {"k": 1.0}}, duration=20.0)
    said = peers.stepwise_bic(signals)
    assert said["in_time"]
    assert said["effects"][0] == "quadratic_drag"
    assert not peers.stepwise_bic(signals, budget=0.0)["in_time"]
