# SPDX-License-Identifier: Apache-2.0
"""Sets of effects: the log evidence of a linear model, and effects that stood in for others."""

from dataclasses import replace
from functools import reduce

import numpy as np
import pytest

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.priors import nominal_parameters
from aeropend_ident.diagnosis.search.findings import Findings, RankedHypothesis, adopted
from aeropend_ident.diagnosis.search.hypotheses import hypotheses, other_forms
from aeropend_ident.diagnosis.search.search import _without_unneeded
from aeropend_ident.diagnosis.search.sets import LinearStage, compared, names, with_best_set
from aeropend_ident.estimation.linear_sets import LinearSets
from aeropend_ident.estimation.map_fit import fit, with_posterior_slopes
from aeropend_ident.estimation.parameter import Parameter, started
from aeropend_ident.signals.signals import from_arrays
from aeropend_ident.testing.rigs import BENCH, drawn_rig, steps
from aeropend_sim.model import rig
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD

N = 3000
T = np.linspace(0.0, 1.0, N)
COLUMNS = np.array([np.ones(N), T, np.sin(40.0 * T), np.sign(np.sin(25.0 * T))])


def test_the_log_evidence_of_a_subset_is_that_of_its_fit():
    y = 0.4 + 0.7 * T + 0.3 * COLUMNS[3] + np.random.default_rng(3).standard_normal(N)
    parameters = [Parameter(f"x{j}", 0.0, 2.0) for j in range(len(COLUMNS))]

    def fitted(subset):
        return fit(lambda values: {"y": y - sum(values[f"x{j}"] * COLUMNS[j] for j in subset)},
                   [parameters[j] for j in subset])

    subsets = [(0,), (0, 1), (0, 1, 2), (0, 1, 3), (0, 1, 2, 3)]
    fits = [fitted(s) for s in subsets]
    ess = fits[-1].ess
    sets = LinearSets({"y": np.vstack([-COLUMNS, y])}, {"y": ess["y"] / N})
    for subset, f in zip(subsets, fits, strict=True):
        found = sets.solve(subset, np.full(len(subset), 2.0), (), np.zeros(len(subset)), np.eye(len(subset)))
        assert 2.0 * found.step == pytest.approx([f.values[f"x{j}"] for j in subset], abs=2e-2)
        assert found.log_evidence == pytest.approx(f.log_evidence(ess), abs=0.5)
    best = max(range(len(fits)), key=lambda k: fits[k].log_evidence(ess))
    assert subsets[best] == (0, 1, 3)


def test_a_column_that_is_fixed_is_added_as_it_is():
    y = COLUMNS[1] + np.random.default_rng(4).standard_normal(N)
    sets = LinearSets({"y": np.vstack([-COLUMNS, y])}, {"y": 1.0})
    free = sets.solve((1,), np.ones(1), (), np.zeros(1), np.eye(1))
    rest = sets.solve((1,), np.ones(1), (1,), np.zeros(1), np.eye(1))
    assert rest.step == pytest.approx(free.step - 1.0, abs=2e-2)


def test_a_parameter_is_held_at_a_value_as_a_fit_ends_at_a_bound():
    y = 0.4 - 0.7 * T + np.random.default_rng(5).standard_normal(N)
    parameters = [Parameter("offset", 0.0, 2.0), Parameter("slope", 0.0, 2.0, low=0.0)]
    f = fit(lambda values: {"y": y - values["offset"] - values["slope"] * T}, parameters)
    assert f.values["slope"] == 0.0
    sets = LinearSets({"y": np.vstack([-COLUMNS, y])}, {"y": f.ess["y"] / N})
    found = sets.solve((0, 1), np.full(2, 2.0), (), np.zeros(2), np.eye(2), {1: 0.0})
    assert 2.0 * found.step == pytest.approx([f.values["offset"], 0.0], abs=2e-2)
    below = sets.solve((0,), np.full(1, 2.0), (), np.zeros(1), np.eye(1)).log_evidence
    assert found.log_evidence - below == pytest.approx(f.log_occam(f.ess) - fit(
        lambda values: {"y": y - values["offset"]}, parameters[:1]).log_occam(f.ess), abs=0.2)


@pytest.fixture(scope="module")
def chains():
    """A rig whose thrust lags, and whose arm has drag."""
    effects = {"thrust_lag": {"tau": 0.04}, "quadratic_drag": {"k": 0.3}}
    columns, _ = rig.record(drawn_rig(6, effects), duty := steps(15.0, 6), 6)
    return CutChains(BENCH, [from_arrays({**columns, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)])


def found_alone(chains, *effects):
    """Findings of the arm with given effects."""
    nominal = nominal_parameters(chains, "arm")
    candidates = {h.name: h for h in hypotheses(BENCH) if h.place in ("arm", "thrust", "sensing")
                  and not h.parameter and h.effect not in ("gust", "speed_spikes")}
    known = nominal
    for name in effects:
        known = adopted(known, candidates[name])
    base, final = fit(chains.residuals("arm"), nominal), fit(chains.residuals("arm"), known)
    found = tuple((RankedHypothesis(candidates[name], fit(chains.residuals("arm"), adopted(nominal, candidates[name])),
                                    10.0, 1.0),) for name in effects)
    return Findings("arm", base, final, found), nominal, list(candidates.values())


def test_the_linear_model_predicts_the_fit_of_a_set(chains):
    findings, nominal, candidates = found_alone(chains, "thrust_lag")
    linear = LinearStage(chains, findings, nominal, candidates)
    members, there = linear.most_promising(set())
    assert {"thrust_lag", "quadratic_drag"} <= names(members)
    assert there.values["quadratic_drag.k"] == pytest.approx(0.3, rel=0.2)


def test_an_effect_whose_fit_ended_at_its_bound_is_no_reason_for_an_infinite_evidence(chains):
    findings, nominal, candidates = found_alone(chains, "thrust_lag", "quadratic_drag", "coulomb_friction")
    assert findings.final.values["coulomb_friction.accel"] == 0.0
    linear = LinearStage(chains, findings, nominal, candidates)
    here = linear.predicted(linear.found)
    assert here.values["coulomb_friction.accel"] == 0.0
    fewer = [linear.predicted(tuple(m for m in linear.found if m is not gone)).log_evidence for gone in linear.found]
    assert np.isfinite([here.log_evidence, *fewer]).all()
    assert fewer[2] > here.log_evidence > max(fewer[:2])


def test_effects_that_stand_in_for_others_give_way_to_them(chains):
    findings, nominal, candidates = found_alone(chains, "encoder_lag", "axial_inflow")
    best = with_best_set(chains, findings, nominal, candidates, 2)
    assert {h.name for h in best.effects} == {"thrust_lag", "quadratic_drag"}
    assert best.final.values["thrust_lag.tau"] == pytest.approx(0.04, rel=0.1)
    assert all(selection[0].probability > 0.9 for selection in best.found)
    assert all(r.probability < 0.1 for selection in best.found for r in selection[1:])


def test_the_right_set_stays_as_it_is(chains):
    findings, nominal, candidates = found_alone(chains, "thrust_lag", "quadratic_drag")
    assert with_best_set(chains, findings, nominal, candidates, 2) is findings


def test_the_sets_that_are_likely_are_those_whose_fits_are(chains):
    findings, nominal, candidates = found_alone(chains, "thrust_lag", "quadratic_drag")
    first, *others = compared(chains, findings, nominal, candidates, 2).sets
    assert set(first.effects) == {"thrust_lag", "quadratic_drag"}
    assert first.probability + sum(s.probability for s in others) <= 1.0
    assert [s.probability for s in others] == sorted((s.probability for s in others), reverse=True)
    fits = [found_alone(chains, *s.effects)[0].final for s in (first, *others)]
    assert all(f.log_evidence(first_ess := fits[0].ess) < fits[0].log_evidence(first_ess) + 3.0 for f in fits)


def test_two_effects_that_stand_in_for_one_of_another_form_give_way_to_it():
    effects = {"encoder_lag": {"tau": 0.027}, "quadratic_drag": {"k": 0.4}}
    columns, _ = rig.record(drawn_rig(8, effects), duty := steps(20.0, 8), 8)
    chains = CutChains(BENCH, [from_arrays({**columns, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)])
    findings, nominal, candidates = found_alone(chains, "encoder_lag", "thrust_lag", "quadratic_drag")
    lag = next(h for h in candidates if h.effect == "encoder_lag")
    (single,) = other_forms(lag, chains)
    known = reduce(adopted, [single, *findings.effects[1:]], nominal)
    start = {"encoder_lag_single.lag": 0.04, "thrust_lag.tau": 0.014, "quadratic_drag.k": 0.4}
    final = fit(chains.residuals("arm"), started(known, {**findings.base.values, **start}))
    assert final.values["thrust_lag.tau"] == pytest.approx(0.014, rel=0.3)
    first = RankedHypothesis(single, final, 10.0, 1.0, (findings.found[0][0],))
    wrong = replace(findings, final=final, found=((first,), *findings.found[1:]))
    right = _without_unneeded(chains, wrong, nominal, 0.0)
    assert [h.name for h in right.effects] == ["encoder_lag", "quadratic_drag"]
    assert right.final.values["encoder_lag.tau"] == pytest.approx(0.027, rel=0.1)


def test_an_effect_that_closes_less_than_a_trifle_is_taken_out(chains):
    findings, nominal, _ = found_alone(chains, "thrust_lag", "quadratic_drag")
    assert len(_without_unneeded(chains, findings, nominal, 0.0).effects) == 2
    assert len(_without_unneeded(chains, findings, nominal, 1.0).effects) == 1


def test_a_search_that_starts_from_the_wrong_lag_ends_at_the_right_one(chains):
    """No small step leads from one to the other, but a contender of the first round is a start too."""
    wrong, nominal, candidates = found_alone(chains, "encoder_lag", "quadratic_drag")
    right, *_ = found_alone(chains, "thrust_lag")
    findings = replace(wrong, found=((wrong.found[0][0], right.found[0][0]), wrong.found[1]))
    best = with_best_set(chains, findings, nominal, candidates, 2)
    assert {h.name for h in best.effects} == {"thrust_lag", "quadratic_drag"}


def sticking(tau, seed):
    """A rig whose arm sticks, and whose thrust lags; its chains."""
    duty = Excitation(duration=20.0, seed=4).series()
    effects = {"thrust_lag": {"tau": tau}, "coulomb_friction": {"accel": 0.4}}
    read, _ = rig.record(BENCH.with_effects(effects), duty, seed)
    return CutChains(BENCH, [from_arrays({**read, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)])


@pytest.mark.promise("Verdict", "Each effect of several is compared with its rivals beside the others")
@pytest.mark.parametrize(("tau", "told_apart"), [(0.008, False), (0.03, True)])
def test_a_rival_is_fitted_beside_the_other_effects(tau, told_apart):
    """A short lag of the thrust is like one of the encoder, a long one is not."""
    chains = sticking(tau, 4)
    findings, nominal, candidates = found_alone(chains, "coulomb_friction", "encoder_lag")
    found = compared(chains, findings, nominal, candidates, 2)
    lag = next(s for s in found.found if s[0].hypothesis.place != "arm")
    probability = {r.hypothesis.name: r.probability for r in lag}
    assert (probability["encoder_lag"] < 0.05) == told_apart
    assert probability["thrust_lag"] > 0.2
    assert sum(p for p in probability.values()) == pytest.approx(1.0, abs=0.01)
    if told_apart:  # the better one takes its place
        assert {h.name for h in found.effects} == {"coulomb_friction", "thrust_lag"}
        assert found.final.values["thrust_lag.tau"] == pytest.approx(tau, rel=0.1)


def test_the_information_of_an_arm_that_sticks_does_not_depend_on_the_path_of_the_fit():
    """Two fits that end at the same place, from other starts."""
    chains = sticking(0.02, 4)
    residuals, nominal = chains.residuals("arm"), nominal_parameters(chains, "arm")
    own = {h.name: h for h in hypotheses(BENCH)}
    known = adopted(adopted(nominal, own["coulomb_friction"]), own["encoder_lag"])
    fits = [fit(residuals, started(known, {"encoder_lag.tau": tau})) for tau in (0.003, 0.01)]
    assert fits[0].log_likelihood == pytest.approx(fits[1].log_likelihood, abs=0.1)
    ess = fits[0].ess
    told = [with_posterior_slopes(residuals, known, f).log_occam(ess) for f in fits]
    assert told[0] == pytest.approx(told[1], abs=0.5)
