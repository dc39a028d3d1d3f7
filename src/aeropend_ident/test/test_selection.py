# SPDX-License-Identifier: Apache-2.0
"""The ranking of rivals: what closes hardly more of the gap does not win by its number of parameters."""

from types import SimpleNamespace

import numpy as np
import pytest

from aeropend_ident.diagnosis.search import selection
from aeropend_ident.diagnosis.search.findings import RankedHypothesis
from aeropend_ident.diagnosis.search.hypotheses import hypotheses
from aeropend_ident.diagnosis.search.selection import FEWER
from aeropend_ident.testing.rigs import BENCH

BY_NAME = {h.name: h for h in hypotheses(BENCH)}


def fitted(mean_square):
    return SimpleNamespace(residuals={"theta": np.full(100, np.sqrt(mean_square))})


@pytest.mark.parametrize(("simple", "rich", "likelier"), [
    (3.5, 3.0, [100.0, 100.0 - FEWER]),  # as much is left of other imperfections
    (9.0, 3.0, [100.0, 140.0]),          # the further parameter closes most of the rest
    (1.1, 1.0, [100.0, 140.0]),          # all is explained: details count
])  # fmt: skip
def test_of_alike_hypotheses_that_with_fewer_parameters_is_the_likelier(simple, rich, likelier, monkeypatch):
    monkeypatch.setattr(selection, "squared_gap", lambda _, f, __: float(np.mean(f.residuals["theta"] ** 2)) - 1.0)
    tried = [(SimpleNamespace(own=("size",)), fitted(simple)), (SimpleNamespace(own=("size", "phase")), fitted(rich))]
    assert selection.frugal(None, "arm", tried, [100.0, 140.0]) == likelier


@pytest.mark.parametrize(("curves_leave", "first"), [
    ({"encoder_eccentricity": 1.01, "cable_torque": 1.15}, ["angle_offset", "encoder_eccentricity", "cable_torque"]),
    ({"encoder_eccentricity": 1.15, "cable_torque": 1.01}, ["cable_torque", "angle_offset", "encoder_eccentricity"]),
])  # fmt: skip
def test_free_curves_decide_between_places_and_the_evidence_between_effects_at_one_place(
        curves_leave, first, monkeypatch):
    left = {"angle_offset": 1.1, **curves_leave}
    residuals = {"theta": np.full(100, 2.0)}
    close = [RankedHypothesis(BY_NAME[name], SimpleNamespace(name=name, residuals=residuals), gain, p)
             for name, gain, p in [("angle_offset", 60.0, 0.9), ("encoder_eccentricity", 58.0, 0.09),
                                   ("cable_torque", 57.0, 0.01)]]
    monkeypatch.setattr(selection, "missing_terms", lambda chains, stage, f, known: [
        SimpleNamespace(place=BY_NAME[f.name].place, left=left[f.name], ess=1000.0)])
    here = selection.SelectionRound(None, "arm", {}, {}, [], None, 0.0, 1)
    ranked = here._ranked_by_place(close, ())
    assert [r.hypothesis.name for r in ranked] == first
    assert sum(r.probability for r in ranked) == pytest.approx(1.0)
    of = {r.hypothesis.name: r.probability for r in ranked}
    assert of["encoder_eccentricity"] / of["angle_offset"] == pytest.approx(np.exp(-2.0))
