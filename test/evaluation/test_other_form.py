# SPDX-License-Identifier: Apache-2.0
"""An effect of another form than the catalogue's, beside one elsewhere that could borrow its gap."""

import ast
from pathlib import Path

import pytest
from evaluation.blind import cases, plant

from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.signals.signals import from_arrays
from aeropend_sim.model.parameters import SAMPLE_PERIOD, load

BENCH = load("bench")


@pytest.mark.parametrize(("effect", "place", "seed"), [("thrust_lag", "thrust", 1), ("thrust_lag", "thrust", 4),
                                                       ("encoder_lag", "sensing", 1)])
def test_a_lag_is_placed_by_what_curves_at_its_place_explain(effect, place, seed):
    case, columns = cases.draw("lag", "single", [effect], "other", BENCH.model, BENCH.sensing, seed, 40.0)
    body = diagnose(BENCH, [from_arrays(columns, SAMPLE_PERIOD, BENCH.sensing)]).body
    assert case.form == "other"
    # so far from the catalogue's form it may pass for unknown, never for the lag of another place
    assert body["which"]["verdict"] in (effect, "unknown")
    assert body["where"]["place"] == place


@pytest.mark.promise("Measurements", "The plant of the blind check shares no code with the simulated rig")
def test_the_plant_of_the_blind_check_shares_nothing_with_ours():
    imported = set()
    for node in ast.walk(ast.parse(Path(plant.__file__).read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            imported |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0
            imported.add(node.module)
    assert {name.partition(".")[0] for name in imported} <= {"__future__", "collections", "math", "numba", "numpy",
                                                             "scipy", "typing"}
