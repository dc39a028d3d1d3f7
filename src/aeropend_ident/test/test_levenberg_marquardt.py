# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from aeropend_ident.estimation.levenberg_marquardt import Search
from aeropend_ident.estimation.map_fit import fit
from aeropend_ident.estimation.parameter import Parameter

RNG = np.random.default_rng(7)
T = np.linspace(0.0, 10.0, 2000)


def test_a_fit_follows_a_narrow_curved_valley_to_its_end():
    along, across, noise = np.random.default_rng(4).standard_normal((3, 2000))

    def valley(values):
        x, y = values["x"], values["y"]
        return {"r": noise + 3.0 * (1.0 - x) * along + 300.0 * (y - x * x) * across}

    found = fit(valley, [Parameter("x", 0.0, 100.0, start=-1.2), Parameter("y", 0.0, 100.0, start=1.44)], 10, 8)
    assert [found.values[n] for n in "xy"] == pytest.approx([1.0, 1.0], abs=0.1)  # straight steps end at x = 0.3


def test_a_step_that_ends_at_a_bound_is_the_best_one_for_the_others():
    x = np.vstack([np.sin(T), np.sin(T) + 0.1 * np.cos(T)])
    parameters = [Parameter("a", 0.0, 1e3, -10.0, 0.5), Parameter("b", 0.0, 1e3)]
    y = x.T @ [2.0, 1.0]
    search = Search(lambda values: {"y": y - x.T @ [values["a"], values["b"]]}, parameters)
    information, gradient, _ = search.normal_equations(search.jacobian())
    a, b = (1e3 * search.step(information, gradient)).tolist()
    assert a == pytest.approx(0.5)
    assert b == pytest.approx(float(x[1] @ (y - 0.5 * x[0]) / (x[1] @ x[1])), rel=1e-3)


def test_few_derivatives_are_computed_where_the_model_is_nearly_linear():
    runs = []
    known = [Parameter(f"a{k}", 0.0, 1.0) for k in range(10)]
    columns = RNG.standard_normal((10, len(T)))
    y = columns.T @ np.linspace(0.1, 1.0, 10) + 0.1 * RNG.standard_normal(len(T))

    def data(values):
        runs.append(values)
        a = np.array([values[p.name] for p in known])
        return {"y": y - columns.T @ (a + 0.05 * a**2)}

    found = fit(data, known)
    a = np.array([found.values[p.name] for p in known])
    assert a + 0.05 * a**2 == pytest.approx(np.linspace(0.1, 1.0, 10), abs=0.02)
    assert len(runs) < 45  # with new derivatives for each of some six steps they are 70


def test_derivatives_that_do_not_change_are_computed_anew_only_with_all():
    runs, linear = [], [f"a{k}" for k in range(20)]

    def bent_in_one(values):
        runs.append(values)
        return {"y": sum(values[n] * np.sin((k + 1) * T) for k, n in enumerate(linear)) + np.exp(values["b"] * T)}

    search = Search(bent_in_one, [Parameter(n, 0.1, 1.0) for n in (*linear, "b")])
    counts = []
    for whole in (True, False, False, True):
        before = len(runs)
        if whole:
            search.steady[:] = False
        search.renew_slopes()
        counts.append(len(runs) - before)
        search.z = search.z + 0.2
        search.current = search.at(search.z)
    assert counts == [21, 21, 1, 21]  # the second time shows that twenty of them stay
    assert search.whole
