# SPDX-License-Identifier: Apache-2.0
"""A few tables in other people's habits: what `make habits` measures on many."""

import numpy as np
import pytest
from evaluation.habits import tables
from evaluation.habits.__main__ import one, same

from aeropend_ident.testing import bags

SEED, COUNT = 4242, 12


@pytest.mark.promise("Tables", "What `import` is not sure of is asked, and never used")
def test_tables_are_understood_or_asked_and_never_taken_wrongly(tmp_path):
    found = [one(SEED, k, tmp_path / f"{k}") for k in range(COUNT)]
    assert [made.habits for result, _, made in found if result in ("wrong", "refused")] == []
    known = [result for result, _, made in found if not made.truth.asks]
    assert known.count("right") >= 0.6 * len(known)


@pytest.mark.parametrize(("change", "is_right"), [
    ({}, True), ({"theta": 1.01}, False), ({"duty": 0.5}, False), ({"period": 1.1}, False)])
def test_the_check_sees_a_wrong_unit(tmp_path, change, is_right):
    t = np.arange(500) * 0.02
    truth = tables.Truth(t, np.sin(t), 0.5 + 0.4 * np.cos(t))
    nothing = np.full(500, np.nan)
    columns = {"theta": truth.theta * change.get("theta", 1.0), "omega": nothing, "i_a": nothing, "v_a": nothing,
               "duty": truth.duty * change.get("duty", 1.0)}
    bags.write(tmp_path / "bag", columns, round(0.02e9 * change.get("period", 1.0)))
    assert same(tmp_path / "bag", truth) == is_right


def test_every_habit_is_drawn_and_seeds_differ():
    drawn = [tables.draw(np.random.default_rng([SEED, k])).habits for k in range(150)]
    assert {made["kind"] for made in drawn} == {"steps", "staircase", "binary", "pulses", "multisine", "loop", "free"}
    assert {*tables.LANGUAGES, "none", "unhelpful"} == {made["names"] for made in drawn}
    assert drawn != [tables.draw(np.random.default_rng([SEED + 1, k])).habits for k in range(150)]
