# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest

from aeropend_ident.identification.free_run import RightHandSide, Wanted, run, sensitivities
from aeropend_ident.identification.terms import Library

PERIOD = 0.01
LIBRARY = Library.of(("x", "v", "u"), ["x", "v", "u", "sin(x)"])
U = np.repeat(np.random.default_rng(0).uniform(-1.0, 1.0, 20), 10)[:, None]
PENDULUM = (np.array([0, 1, 1, 1]), np.array([1, 3, 1, 2]), np.array([1.0, -30.0, -2.0, 5.0]))
"""x' = v, v' = -30 sin x - 2 v + 5 u: equation, term and coefficient."""


def states(coefficient, start, steps=4, limit=100.0):
    equation, term, _ = PENDULUM
    right = RightHandSide(np.unique(term), LIBRARY.table, equation, term, coefficient)
    out = np.empty((len(U), 2))
    return right, out, run(start, U, PERIOD, steps, right, np.full(2, -limit), np.full(2, limit), out)


def test_a_linear_run_is_the_exact_one():
    table = Library.of(("x", "u"), ["x", "u"]).table
    right = RightHandSide(np.array([0, 1]), table, np.array([0, 0]), np.array([0, 1]), np.array([-3.0, 2.0]))
    out = np.empty((len(U), 1))
    assert run(np.array([0.7]), U, PERIOD, 4, right, np.array([-9.0]), np.array([9.0]), out)
    x, a = 0.7, np.exp(-3.0 * PERIOD)
    for k, u in enumerate(U[:, 0]):
        assert out[k, 0] == pytest.approx(x, abs=1e-9)
        x = a * x + (1.0 - a) * 2.0 / 3.0 * u


def test_a_run_that_leaves_its_limits_ends():
    assert states(PENDULUM[2], np.array([0.2, 0.0]))[2]
    assert not states(PENDULUM[2], np.array([0.2, 0.0]), limit=0.1)[2]


def test_sensitivities_are_the_differences_of_runs():
    start = np.array([0.2, -0.4])
    right, x, _ = states(PENDULUM[2], start)
    wanted = Wanted(right.used, right.equation, right.term, np.arange(2))
    carry, found = np.zeros((2, 6)), np.empty((len(U), 2, 6))
    carry[:, 4:] = np.eye(2)
    sensitivities(x, U, PERIOD, 4, right, wanted, carry, found)
    for p in range(6):
        step = 1e-6 * np.eye(6)[p]
        up, down = (states(PENDULUM[2] + sign * step[:4], start + sign * step[4:])[1] for sign in (1.0, -1.0))
        assert found[:, :, p] == pytest.approx((up - down) / 2e-6, abs=1e-5 * np.abs(found[:, :, p]).max())
