# SPDX-License-Identifier: Apache-2.0
"""An effect of another form than the catalogue's is named, with its form, and its strength holds in any form."""

from dataclasses import replace

import numpy as np
import pytest

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.joint_fit import JointFit
from aeropend_ident.diagnosis.report.candidates import form_text, strength_text
from aeropend_ident.diagnosis.results import document, verdict_lines
from aeropend_ident.diagnosis.search.findings import RankedHypothesis
from aeropend_ident.diagnosis.search.hypotheses import hypotheses, other_forms
from aeropend_ident.diagnosis.strength import Strengths
from aeropend_ident.estimation.map_fit import estimate
from aeropend_ident.testing.rigs import BENCH, recorded
from aeropend_sim.model import effect_file
from aeropend_sim.model.effects import family

TRUE = {"coulomb_friction_stribeck": {"accel": 0.8, "rise": 0.6, "speed": 0.3},
        "cable_torque_hardening": {"k": 4.0, "theta0": 0.3, "hard": 2.5},
        "axial_inflow_momentum": {"k": 1.5e-4, "bend": 1.5},
        "ground_effect_rational": {"gain": 0.3, "width": 0.25}}


@pytest.fixture(scope="module", params=TRUE)
def verdict(request):
    """A rig with a form of an effect, and its diagnosis."""
    return request.param, diagnose(BENCH, [recorded(71, {request.param: TRUE[request.param]}, duration=28.0)])


def found_of(verdict):
    form, found = verdict
    return next(c for c in found.conclusions.which.candidates if c.effect == family(form))


@pytest.mark.promise("Verdict", "An effect of another form than the catalogue's is named, with its form or "
                     "those that the recording cannot separate")
def test_an_effect_of_another_form_is_named_with_its_form(verdict):
    form, found = verdict
    which, one = found.conclusions.which, found_of(verdict)
    assert which.verdict == family(form)
    assert which.effects == (family(form),)
    assert one.form == form or one.forms[form] > 0.05
    assert sum(one.forms.values()) == pytest.approx(1.0)
    assert one.law in found.augmented.effects
    assert form_text(one).startswith("form")


@pytest.mark.promise("Verdict", "The strength of an effect, the RMS of its term, has an interval over all forms that "
                     "explain the recording")
def test_the_interval_of_the_strength_holds_the_true_one(verdict):
    form, _ = verdict
    one = found_of(verdict)
    true = {"coulomb_friction_stribeck": (0.8, 0.8 * 1.6)}.get(form)
    assert one.strength.low <= one.strength.value <= one.strength.high
    assert one.strength.high - one.strength.low < one.strength.value
    if true is not None:  # where it moves it lies between that of a fast arm and that at rest
        assert one.strength.low < true[1]
        assert one.strength.high > true[0]
    else:
        for name, value in TRUE[form].items():
            if one.form == form:
                assert one.parameters[name].low <= value <= one.parameters[name].high
    assert "RMS" in strength_text(one)


def test_the_words_say_form_and_strength(verdict):
    _, found = verdict
    text = "\n".join(verdict_lines(document(found, ["bag"], "bench", 1.0)))
    assert "form" in text
    assert "RMS" in text


def test_a_lag_of_one_stage_of_the_filter_is_one_of_the_encoder():
    found = diagnose(BENCH, [recorded(73, {"encoder_lag_single": {"lag": 0.12}}, duration=28.0)])
    which = found.conclusions.which
    assert which.effects == ("encoder_lag",)
    lag = next(c for c in which.candidates if c.effect == "encoder_lag").parameters["lag"]
    assert lag.low <= 0.12 <= lag.high


def test_a_form_of_an_effect_file_is_tried():
    effect_file.define({"test_forms_drag": {
        "place": "arm", "form_of": "quadratic_drag", "term": "-k * theta_dot * abs(theta_dot) * step(theta_dot)",
        "parameters": {"k": {"unit": "1/rad", "default": 0.6, "low": 0.0, "high": 20.0}}}}, "test")
    signals = recorded(72, {"test_forms_drag": {"k": 1.5}}, duration=28.0)
    with_, without = (diagnose(BENCH, [signals], further=ids) for ids in (["test_forms_drag"], []))
    assert with_.conclusions.which.verdict == "quadratic_drag"
    assert with_.augmented.effects["test_forms_drag"]["k"] == pytest.approx(1.5, rel=0.2)
    assert all(c.law != "test_forms_drag" for c in without.conclusions.which.candidates)
    assert with_.conclusions.closure.gap_after <= without.conclusions.closure.gap_after * 1.05
    assert np.isfinite(with_.conclusions.closure.gap_after)


def test_a_form_that_is_no_formula_leaves_the_strength_open():
    chains = CutChains(BENCH, [recorded(71, duration=8.0)])
    delay = next(h for h in hypotheses(BENCH) if h.effect == "command_delay")
    lag = other_forms(delay, chains)[0]
    f = replace(estimate({}, {}), residuals={"v_a": np.ones(100)})
    ranked = RankedHypothesis(lag, f, 1.0, 0.6, others=(RankedHypothesis(delay, f, 1.0, 0.4),))
    assert Strengths(JointFit(chains, {}, f, {}, {}, {}, {})).interval(ranked, "actuator", 0.0) is None
