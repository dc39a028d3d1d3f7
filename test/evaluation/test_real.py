# SPDX-License-Identifier: Apache-2.0
"""The table of real rigs: its file, the grey box beside the diagnosis, and contradictions between recordings."""

import math

import numpy as np
import pytest
from evaluation.real import grey_box
from evaluation.real.__main__ import COLUMNS, Row, contradicted, rigs_of

PERIOD = 0.01


def row(name, rig, *effects, own=()):
    return Row(name, rig, "", (90.0,), (80.0,), ", ".join(effects), effects, 1.0, own)


@pytest.mark.parametrize("text", ["", "name;rig\na;b\n", ";".join(COLUMNS) + "\n"])
def test_a_table_without_its_columns_or_lines_is_refused_in_one_line(tmp_path, text):
    (tmp_path / "rigs.csv").write_text(text)
    with pytest.raises(SystemExit, match="needs a first line name;rig;file;options;known") as refused:
        rigs_of(tmp_path)
    assert "\n" not in str(refused.value)


def test_a_missing_table_is_refused_in_one_line(tmp_path):
    with pytest.raises(SystemExit, match=r"rigs.csv: cannot be read") as refused:
        rigs_of(tmp_path)
    assert "\n" not in str(refused.value)


def test_a_claim_is_contradicted_by_another_recording_of_the_rig_alone():
    rows = [row("a", "x", "coulomb_friction"), row("b", "x"), row("c", "y", "mast_flex")]
    assert contradicted(rows) == {"a": ["coulomb_friction"], "b": [], "c": []}
    assert contradicted([rows[0], row("b", "x", "coulomb_friction")])["a"] == []


def test_a_claim_is_not_contradicted_where_the_nominal_model_of_the_other_recording_holds_the_effect():
    assert contradicted([row("a", "x", "coulomb_friction"), row("b", "x", own=("coulomb_friction",))])["a"] == []


def test_the_grey_box_recovers_a_simulated_rig():
    rng = np.random.default_rng(3)
    duty = np.repeat(rng.uniform(0.0, 1.0, 25), 100)
    x = np.array([math.log(30.0), math.log(1.2), math.log(20.0), 0.05, 1.5, math.log(0.15), 0.0, 0.05, 0.02, 0.03, 0.0,
                  0.0])
    theta = grey_box._run(x, duty, PERIOD) + 0.001 * rng.standard_normal(len(duty))
    train = 1750
    found = grey_box.fit(np.arange(len(duty)) * PERIOD, theta, duty, train)
    assert grey_box.fit_percent(found.theta[train:], theta[train:]) > 95.0
    assert math.exp(found.values["G"]) == pytest.approx(30.0, rel=0.05)
    assert found.values["friction"] == pytest.approx(0.02, rel=0.3)
