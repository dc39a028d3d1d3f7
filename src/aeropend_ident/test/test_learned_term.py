# SPDX-License-Identifier: Apache-2.0
"""What no effect of the catalogue explains is learned, and the plant runs it."""

import numpy as np
import pytest

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.results import Results, document
from aeropend_ident.diagnosis.search.formula_fit import _proposals
from aeropend_ident.diagnosis.search.hypotheses import hypotheses
from aeropend_ident.diagnosis.search.learned_term import FORMS, Curve, Learned, _raised, defined, definition
from aeropend_ident.testing.rigs import BENCH, drawn_rig, recorded, steps
from aeropend_sim.model import effect_file
from aeropend_sim.model.effects import CATALOGUE, DEFINED
from aeropend_sim.model.parameters import load
from aeropend_sim.model.rig import record

SIZES = {"low": 0.0, "high": 500.0}
HIDDEN = {
    "hidden_magnet": {"place": "arm", "term": "-k * (theta - at) * exp(-((theta - at) / width)**2)", "parameters": {
        "k": {"unit": "1/s²", "default": 20.0, **SIZES}, "at": {"unit": "rad", "default": 0.4, **SIZES},
        "width": {"unit": "rad", "default": 0.15, "low": 0.01, "high": 2.0}}},
    "hidden_hose": {"place": "arm", "term": "-k * z",
                    "memory": {"name": "z", "unit": "rad", "rate": "theta_dot - z / tau"},
                    "parameters": {"k": {"unit": "1/s²", "default": 6.0, **SIZES},
                                   "tau": {"unit": "s", "default": 0.6, "low": 0.01, "high": 9.0}}},
    "hidden_stall": {"place": "thrust", "term": "-share * thrust * clip((omega - above) / band, 0, 1)", "parameters": {
        "share": {"unit": "-", "default": 0.3, **SIZES}, "above": {"unit": "rad/s", "default": 150.0, **SIZES},
        "band": {"unit": "rad/s", "default": 30.0, "low": 1.0, "high": 99.0}}},
    "hidden_gear": {"place": "rotor", "term": "-gain * abs(i_a) * tanh(omega / slow)", "parameters": {
        "gain": {"unit": "N·m/A", "default": 1e-3, **SIZES}, "slow": {"unit": "rad/s", "default": 5.0, **SIZES}}},
}
effect_file.define(HIDDEN, "test_learned_term")


@pytest.fixture(scope="module", params=["hidden_gear", "hidden_hose"])
def verdict(request):
    """A rig with an effect that the catalogue does not hold, and its diagnosis."""
    signals = recorded(104, {request.param: {}}, duration=30.0)
    return request.param, diagnose(BENCH, [signals])


@pytest.mark.promise("Verdict", "Where the verdict is `unknown`, the missing term is learned at its place, and its "
                     "share of the squared gap on unseen data is told")
def test_an_effect_outside_of_the_catalogue_is_learned_at_its_place(verdict):
    id_, found = verdict
    which, closure = found.conclusions.which, found.conclusions.closure
    assert which.verdict == "unknown"
    assert found.conclusions.where.place == which.unknown.place == HIDDEN[id_]["place"]
    assert closure.closed > 0.8
    assert which.unknown.closes.value > 0.5
    assert which.unknown.id in found.augmented.effects
    assert which.unknown.id not in which.effects
    assert which.unknown.id not in {c.effect for c in which.candidates}


@pytest.mark.promise("Augmented model", "The plant runs a learned term from `augmented.yaml` alone")
def test_the_plant_runs_what_was_learned(verdict, tmp_path):
    """On other duties the augmented model, read from its file, is nearer to the rig than the nominal one."""
    id_, found = verdict
    results = Results.of(found, document(found, ["a bag"], "bench", 1.0), "diagnose a bag")
    results.write(tmp_path / "out", overwrite=False)
    learned = found.conclusions.which.unknown.id
    kept = DEFINED.pop(learned)
    augmented = load(tmp_path / "out" / "augmented.yaml")
    assert DEFINED[learned].term == kept.term
    assert any(learned in line for line in results.lines)
    duty = steps(20.0, 77)
    truth, nominal, again = (record(m, duty, 5)[1]["theta"] for m in (drawn_rig(104, {id_: {}}), BENCH, augmented))
    assert np.std(truth - again) < 0.5 * np.std(truth - nominal)


@pytest.mark.promise("Verdict", "Formulas are proposed for a learned term, in a file that `diagnose --effects` takes")
def test_a_formula_is_proposed_and_is_tomorrows_catalogue_entry(verdict, tmp_path):
    id_, found = verdict
    closure, formulas = found.conclusions.closure, found.conclusions.which.unknown.formulas
    assert formulas[0].gap_after < 1.2 * closure.gap_after
    results = Results.of(found, document(found, ["a bag"], "bench", 1.0), "diagnose a bag")
    results.write(tmp_path / "out", overwrite=False)
    proposed = effect_file.load(tmp_path / "out" / "proposed.yaml")
    assert list(proposed) == [f.id for f in formulas]
    again = diagnose(BENCH, [recorded(105, {id_: {}}, duration=30.0)], further=[formulas[0].id])
    assert again.conclusions.which.verdict == formulas[0].id
    assert again.conclusions.closure.closed > 0.9


def test_what_is_left_out_or_added_stays_so_when_chains_are_cut_again():
    chains = CutChains(BENCH, [recorded(104, {}, duration=10.0)])
    chains.further, chains.left_out = ("hidden_hose",), ("gust",)
    again = chains.anew(chains.recordings)
    assert (again.further, again.left_out, again.known) == (("hidden_hose",), ("gust",), None)
    names = {h.name for h in hypotheses(BENCH, again.further, again.left_out)}
    assert "hidden_hose" in names
    assert "gust" not in names


def test_every_form_makes_an_effect_whose_units_are_right():
    for forms in FORMS.values():
        for place in {(f.place, f.reading) for f in forms}:
            mine = [f for f in forms if (f.place, f.reading) == place]
            with_memory = [f for f in mine if f.rate][:1]
            chosen = [*(f for f in mine if not f.rate), *with_memory][:3]
            curves = [Curve(f, np.linspace(-1.0, 1.0, 14), letter) for f, letter in zip(chosen, "abc", strict=False)]
            effect_file.define({"any_learned": definition(curves)}, "a test")
            effect_file.forget("any_learned")


def test_formulas_are_proposed_for_two_curves_over_one_quantity():
    chains = CutChains(BENCH, [recorded(104, {}, duration=10.0)])
    knot = np.linspace(0.0, 400.0, 14)
    forms = [f for f in FORMS["motor"] if (f.place, f.of) == ("electrical", "omega")]
    curves = tuple(Curve(f, knot, letter) for f, letter in zip(forms, "ab", strict=True))
    learned = Learned(defined(curves), "electrical", curves, None, None)
    size = {"a": 2e-3, "b": 1e-3}
    values = {f"{learned.id}.{name}": size[c.letter] * x for c in curves for name, x in
              zip(c.names, knot)}
    values[f"{learned.id}.gain"] = 1.0
    terms = [str(tree["term"]) for tree in _proposals(chains, learned, values, dict.fromkeys(values, 1e-3))]
    assert any("i_a" in term and "omega" in term for term in terms)


def test_the_catalogue_is_never_forgotten():
    effect_file.forget("gust")
    assert CATALOGUE["gust"] is DEFINED["gust"]


@pytest.mark.filterwarnings("error")
def test_responses_of_a_curve_with_which_a_simulation_diverges_are_numbers():
    curve = Curve(FORMS["motor"][0], np.linspace(0.0, 1.0, 3))
    raised = _raised(lambda values: {"i_a": np.array([np.inf, 1e300, np.nan]), "v_a": np.zeros(0)}, {}, curve)
    assert all(np.isfinite(np.sum(response["i_a"] ** 2)) for response in raised)
