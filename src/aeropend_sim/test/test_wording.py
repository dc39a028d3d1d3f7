# SPDX-License-Identifier: Apache-2.0
"""Words for messages."""

import math

import pytest

from aeropend_sim.wording import counted, enumerated, times


@pytest.mark.parametrize(("number", "text"), [(1, "1 row"), (0, "0 rows"), (3, "3 rows")])
def test_a_noun_follows_its_number(number, text):
    assert counted(number, "row") == text


@pytest.mark.parametrize(("ratio", "text"), [
    (9.13, "9.13 times"), (2345.6, "2350 times"), (16875546.0, "more than 10000 times"),
    (math.inf, "more than 10000 times")])
def test_a_ratio_that_is_huge_is_a_bound(ratio, text):
    assert times(ratio) == text


def test_a_list_in_a_sentence():
    assert [enumerated(["a", "b", "c"][:k]) for k in (1, 2, 3)] == ["a", "a and b", "a, b and c"]
