# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from aeropend_ident.diagnosis.policy import CALIBRATED, MATERIAL_SHARE
from aeropend_ident.diagnosis.search import alike
from aeropend_ident.diagnosis.search.alike import with_simpler
from aeropend_ident.diagnosis.search.findings import Findings, RankedHypothesis
from aeropend_ident.diagnosis.search.hypotheses import hypotheses
from aeropend_ident.estimation.map_fit import estimate
from aeropend_ident.testing.rigs import BENCH

BY_NAME = {h.name: h for h in hypotheses(BENCH)}
OPEN, LEAST = 1.0, 0.004


def taken(monkeypatch, left, probability, mean_square, first="encoder_eccentricity", rival="angle_offset",
          imperfect=()):
    """The effect that is found, where the rival leaves this much of the gap."""
    base, one, other = (estimate({}, {}) for _ in range(3))
    gaps = {id(base): OPEN, id(one): LEAST, id(other): left}
    monkeypatch.setattr(alike, "squared_gap", lambda chains, f, channels: gaps[id(f)])
    monkeypatch.setattr(alike, "mean_square", lambda f, stage: mean_square)
    selection = (RankedHypothesis(BY_NAME[first], one, 30.0, 1.0 - probability),
                 RankedHypothesis(BY_NAME[rival], other, 20.0, probability))
    chains = SimpleNamespace(policy=CALIBRATED, known=None)
    after = with_simpler(chains, Findings("arm", base, one, found=(selection,)), imperfect)
    assert after.final is (one if after.effects[0].name == first else other)
    return after.effects[0].name


@pytest.mark.parametrize(("left", "probability", "mean_square", "name"), [
    (1.9 * LEAST, 0.0, 1.5, "angle_offset"),  # what both leave is more than that by which they differ
    (2.1 * LEAST, 0.0, 1.5, "encoder_eccentricity"),
    (1.9 * LEAST, 0.0, 1.0, "encoder_eccentricity"),  # nothing is left but noise: the evidence decides
    (2.1 * LEAST, 0.2, 1.0, "angle_offset"),  # unless it does not
    (LEAST + 1.1 * MATERIAL_SHARE * OPEN, 0.2, 1.0, "encoder_eccentricity")])
def test_of_effects_that_close_as_much_the_one_with_fewer_parameters_comes_first(
        monkeypatch, left, probability, mean_square, name):
    assert taken(monkeypatch, left, probability, mean_square) == name


@pytest.mark.parametrize(("left", "imperfect", "name"), [
    (2.1 * LEAST, "encoder_eccentricity", "angle_offset"),
    (2.1 * LEAST, "coulomb_friction", "encoder_eccentricity"),
    (LEAST + 1.1 * MATERIAL_SHARE * OPEN, "encoder_eccentricity", "encoder_eccentricity")])
def test_beside_small_imperfections_the_evidence_of_a_further_parameter_does_not_count(
        monkeypatch, left, imperfect, name):
    assert taken(monkeypatch, left, 0.0, 1.0, imperfect=[imperfect]) == name


@pytest.mark.parametrize("rival", ["cable_torque", "parameter_mismatch:mgd_over_J"])
def test_neither_an_effect_with_as_many_parameters_nor_a_parameter_takes_its_place(monkeypatch, rival):
    assert taken(monkeypatch, LEAST, 0.2, 1.5, rival=rival) == "encoder_eccentricity"


def test_the_final_fit_is_of_the_stage_alone(monkeypatch):
    """An effect that acts on later stages was fitted to them too."""
    alone = estimate({}, {})
    monkeypatch.setattr(alike, "refit", lambda chains, stage, effects, values: alone)
    base, one = (replace(estimate({}, {}), residuals={"v_a": np.ones(9)}) for _ in range(2))
    other = replace(one, residuals={"v_a": np.ones(9), "i_a": np.ones(9)})
    monkeypatch.setattr(alike, "squared_gap", lambda chains, f, channels: OPEN if f is base else LEAST)
    selection = (RankedHypothesis(BY_NAME["winding_heating"], one, 30.0, 0.8),
                 RankedHypothesis(BY_NAME["voltage_offset"], other, 20.0, 0.2))
    chains = SimpleNamespace(policy=CALIBRATED, known=None)
    assert with_simpler(chains, Findings("actuator", base, one, found=(selection,))).final is alone
