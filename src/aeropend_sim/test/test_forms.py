# SPDX-License-Identifier: Apache-2.0
"""The other forms of the effects, and the formulas of the catalogue's own terms."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from aeropend_sim.model import actuator, effect_file
from aeropend_sim.model.dynamics import simulate
from aeropend_sim.model.effect_file import EffectError, checked, define, definitions
from aeropend_sim.model.effects import CATALOGUE, DEFINED, family
from aeropend_sim.model.forms import FORMS
from aeropend_sim.model.formula import QUANTITIES, parse
from aeropend_sim.model.parameters import SAMPLE_PERIOD, load, save
from aeropend_sim.model.rig import record

BENCH = load("bench")
DUTY = np.repeat(np.random.default_rng(3).uniform(0.1, 0.6, 8), 500)
OF_SEVERAL_PARAMETERS = [e for e in DEFINED.values()
                         if e.formula and sum(not p.refines for p in e.parameters.values()) > 1]


def defaults(id_, **given):
    return BENCH.with_effects({id_: {n: p.default for n, p in DEFINED[id_].parameters.items()} | given})


@pytest.mark.parametrize("form", FORMS.values(), ids=lambda e: e.id)
def test_a_form_is_an_effect_of_its_family(form):
    assert not form.term or checked(form) is form
    assert family(form.id) == form.form_of
    assert form.place == CATALOGUE[form.form_of].place
    assert form.size == CATALOGUE[form.form_of].size or form.form_of in ("command_delay", "encoder_lag")
    shared = form.parameters.keys() & CATALOGUE[form.form_of].parameters.keys()
    assert all(form.parameters[n] == CATALOGUE[form.form_of].parameters[n] for n in shared)


@pytest.mark.parametrize("form", FORMS, ids=str)
def test_a_form_acts_like_its_effect_but_not_the_same(form):
    of = FORMS[form].form_of
    own = {n: p.default for n, p in CATALOGUE[of].parameters.items()}
    given = {n: x for n, x in own.items() if n in FORMS[form].parameters}
    (mine, _), (its, _), (nominal, _) = (
        record(m, DUTY, seed=3) for m in (defaults(form, **given), defaults(of), BENCH))

    def away(a, b):
        return math.sqrt(sum(np.nanmean((a[c] - b[c]) ** 2) / np.nanvar(b[c]) for c in ("theta", "i_a", "v_a")))

    assert 0.0 < away(mine, its) < away(its, nominal)


@pytest.mark.parametrize("effect", OF_SEVERAL_PARAMETERS, ids=lambda e: e.id)
def test_almost_without_its_size_an_effect_is_almost_absent_whatever_its_other_parameters_are(effect):
    given = {n: p.neutral if p.refines else 0.7 * p.default + 0.3 * p.high for n, p in effect.parameters.items()}
    size = effect.parameters[effect.size]
    given[effect.size] = size.neutral + 1e-6 * (size.default - size.neutral)
    (mine, _), (nominal, _) = (record(m, DUTY[:1500], seed=3) for m in (defaults(effect.id, **given), BENCH))
    for channel in ("theta", "omega", "i_a", "v_a"):
        assert np.nanstd(mine[channel] - nominal[channel]) < 1e-2 * np.nanstd(nominal[channel])


def test_a_parameter_is_found_in_any_form():
    assert defaults("coulomb_friction_stribeck", accel=0.7).in_any_form("coulomb_friction", "accel") == 0.7
    assert defaults("coulomb_friction", accel=0.6).in_any_form("coulomb_friction", "accel") == 0.6
    assert defaults("quadratic_drag").in_any_form("coulomb_friction", "accel") == 0.0


def test_a_form_needs_no_definition_in_a_model_file(tmp_path):
    assert definitions(["coulomb_friction_stribeck"]) == {}
    save(defaults("coulomb_friction_stribeck"), tmp_path / "m.yaml")
    assert load(tmp_path / "m.yaml").effects["coulomb_friction_stribeck"]["rise"] == 0.3


@pytest.mark.parametrize("effect", [e for e in CATALOGUE.values() if e.law], ids=lambda e: e.id)
def test_a_law_is_a_formula_of_the_parameters_of_its_effect(effect):
    known = {*QUANTITIES, *effect.parameters, effect.memory}
    used = parse(effect.law, known).names | (parse(effect.rate, known).names if effect.rate else set())
    assert set(effect.parameters) <= used


AS_LAW = [e for e in CATALOGUE.values() if e.law and e.id not in ("bridge_drop", "supply_drift")]


@pytest.mark.parametrize("effect", AS_LAW, ids=lambda e: e.id)
def test_a_law_given_as_a_formula_acts_as_the_effect(effect):
    again = f"again_{effect.id}"
    DEFINED[again] = type(effect)(again, effect.place, effect.physics, effect.parameters, term=effect.law,
                                  reading=effect.reading, memory=effect.memory, memory_unit=effect.memory_unit,
                                  rate=effect.rate, sticks=effect.sticks)
    found, expected, nominal = (record(m, DUTY, seed=3)[0] for m in (defaults(again), defaults(effect.id), BENCH))
    effect_file.forget(again)
    for channel in ("theta", "i_a", "v_a"):
        differ = np.nanstd(expected[channel] - nominal[channel])
        assert np.nanstd(found[channel] - expected[channel]) <= 0.02 * differ + 1e-12


def test_a_stribeck_friction_sticks_and_slides_as_its_equation():
    own = {"accel": 1.5, "rise": 0.8, "speed": 0.3}
    model, n = defaults("coulomb_friction_stribeck", **own), BENCH.numbers()
    run = simulate(model, DUTY)
    assert np.sum((run.theta_dot[1:] == 0.0) & (run.theta_dot[:-1] == 0.0)) > 50
    start = int(np.argmax(np.abs(run.theta_dot) > 0.2))
    stop = start + int(np.argmax(run.theta_dot[start:] * run.theta_dot[start] <= 0.0)) - 1
    t = np.arange(start, stop) * SAMPLE_PERIOD
    direction = np.sign(run.theta_dot[start])

    def equation(at, y):
        f = actuator.thrust(n, np.interp(at, t, run.omega[start:stop]))
        level = own["accel"] * (1.0 + own["rise"] * np.exp(-(y[1] / own["speed"]) ** 2))
        return [y[1], n["L_over_J"] * f - n["mgd_over_J"] * np.sin(y[0]) - n["c_over_J"] * y[1] - direction * level]

    exact = solve_ivp(equation, (t[0], t[-1]), [run.theta[start], run.theta_dot[start]], t_eval=t, rtol=1e-9, atol=1e-9)
    assert stop - start > 50
    assert np.abs(exact.y[0] - run.theta[start:stop]).max() < 2e-4


@pytest.mark.parametrize(("key", "value", "says"), [
    ("form_of", "no_effect", "form_of is 'no_effect'; give an effect of the catalogue at place arm"),
    ("form_of", "brush_drop", "form_of is 'brush_drop'; give an effect of the catalogue at place arm"),
    ("sticks", 3, "sticks is true or false")])
def test_a_wrong_form_is_refused(key, value, says):
    tree = {"wrong_form": {"place": "arm", "term": "k", key: value,
                           "parameters": {"k": {"unit": "rad/s²", "default": 1.0, "low": 0.0, "high": 2.0}}}}
    with pytest.raises(EffectError, match=says):
        define(tree, "x.yaml")
