# SPDX-License-Identifier: Apache-2.0

import numpy as np

from aeropend_ident.identification.subset_selection import (
    NormalEquations,
    best_small_supports,
    ebic_penalty,
    ebic_search,
)


def test_selection_finds_the_terms_that_made_the_data():
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((2000, 20))
    rows[:, 5] = rows[:, 2] + 0.05 * rows[:, 5]  # nearly the same as a true one
    y = 3.0 * rows[:, 2] - 0.5 * rows[:, 11] + 0.1 * rng.standard_normal(2000)
    assert ebic_search(NormalEquations.of(rows, y)) == [2, 11]


def test_nothing_is_found_in_noise():
    rng = np.random.default_rng(1)
    assert ebic_search(NormalEquations.of(rng.standard_normal((2000, 30)), rng.standard_normal(2000))) == []


def test_a_group_of_terms_is_found_that_single_additions_miss():
    rng = np.random.default_rng(2)
    a, b = rng.standard_normal((2, 3000))
    rows = np.column_stack([a, b, a + b + 0.3 * rng.standard_normal(3000)])
    assert ebic_search(NormalEquations.of(rows, a + b)) == [0, 1]


def test_the_best_small_supports_are_those_of_all():
    H, g = np.eye(4), np.array([0.1, 3.0, -2.0, 0.5])
    assert best_small_supports(H, g) == [[1], [1, 2], [1, 2, 3]]


def test_blocks_of_rows_add_up_and_weigh():
    rng = np.random.default_rng(3)
    rows, y = rng.standard_normal((60, 3)), rng.standard_normal(60)
    whole = NormalEquations.of(rows, y)
    total = NormalEquations.total([NormalEquations.of(rows[k:k + 20], y[k:k + 20]) for k in (0, 20, 40)])
    assert np.allclose(total.H, whole.H)
    assert total.n == 60.0
    assert np.allclose(whole.times(0.5).solve([0, 2]), whole.solve([0, 2]))
    assert ebic_penalty(0.5 * whole.n, 3) < ebic_penalty(whole.n, 3) < ebic_penalty(whole.n, 4)
