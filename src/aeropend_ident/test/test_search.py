# SPDX-License-Identifier: Apache-2.0
"""The search for an effect: where it starts, in which parameters it is linear, and when it owns up to not knowing."""

import math
from dataclasses import replace

import numpy as np
import pytest

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.priors import nominal_parameters
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.policy import UNCALIBRATED
from aeropend_ident.diagnosis.search.findings import RankedHypothesis, adopted
from aeropend_ident.diagnosis.search.hypotheses import from_linear, linear_parameters
from aeropend_ident.diagnosis.search.search import _with_better_rivals, refit, search, trifling_gap, unsearched
from aeropend_ident.diagnosis.search.selection import squared_gap
from aeropend_ident.estimation.map_fit import fit
from aeropend_ident.signals.signals import from_arrays
from aeropend_ident.testing.rigs import BENCH, drawn_rig, steps
from aeropend_sim.model import rig
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import SAMPLE_PERIOD

LINEAR = [id_ for id_, effect in CATALOGUE.items() if effect.linear_in]


def recording(effects, seed, duration=15.0, read=lambda *_: None):
    duty = steps(duration, seed)
    columns, truth = rig.record(drawn_rig(seed, effects), duty, seed)
    read(columns, truth)
    return from_arrays({**columns, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)


# --- the delay


@pytest.mark.parametrize("periods", [0.4, 2.5, 9.1, 60.7])
def test_the_voltage_places_a_delay_to_the_period(periods):
    chain = CutChains(BENCH, [recording({"command_delay": {"delay": periods * SAMPLE_PERIOD}}, 7, 10.0)]).each[0]
    assert math.floor(chain.likeliest_delay({}) / SAMPLE_PERIOD) == math.floor(periods)


@pytest.mark.parametrize("periods", [2.3, 9.8])
def test_the_current_places_it_within_the_period(periods):
    """The voltage reads alike for every delay between two samples; how far the current has come does not."""
    findings = search(CutChains(BENCH, [recording({"command_delay": {"delay": periods * SAMPLE_PERIOD}}, 8)]), 2)
    assert [h.name for h in findings["actuator"].effects] == ["command_delay"]
    motor = findings["motor"]
    assert motor.effects == []
    assert motor.final.values["command_delay.delay"] == pytest.approx(periods * SAMPLE_PERIOD, abs=1e-4)
    assert motor.final.scale["i_a"] < 1.05


def test_it_is_found_under_a_duty_that_changes_all_the_time():
    """Then what the voltage shows beyond its description without a delay is nothing of the voltage with one."""
    duty = 0.35 + 0.2 * np.sin(2.0 * np.pi * 1.5 * SAMPLE_PERIOD * np.arange(round(20.0 / SAMPLE_PERIOD)))
    columns, _ = rig.record(drawn_rig(4, {"command_delay": {"delay": 0.04}}), duty, 4)
    findings = search(CutChains(BENCH, [from_arrays({**columns, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)]), 2)
    assert [h.name for f in findings.values() for h in f.effects] == ["command_delay"]
    assert findings["motor"].final.values["command_delay.delay"] == pytest.approx(0.04, abs=1e-4)


# --- parameters in which an effect is linear


def test_effects_that_are_linear_in_two_parameters():
    assert LINEAR == ["cable_torque", "encoder_eccentricity"]


@pytest.mark.parametrize(("slope", "product"), [(4.0, 1.6), (0.3, -0.5), (60.0, 0.0)])
def test_the_cable_is_the_same_spring_in_either_parameters(slope, product):
    own = from_linear("cable_torque", {"cable_torque.slope": slope, "cable_torque.product": product, "R_a": 1.0})
    assert set(own) == {"cable_torque.k", "cable_torque.theta0", "R_a"}
    theta = np.linspace(-1.0, 1.0, 9)
    torque = -own["cable_torque.k"] * (theta - own["cable_torque.theta0"])
    np.testing.assert_allclose(torque, product - slope * theta, atol=1e-12)


def test_a_cable_without_stiffness_still_pulls():
    own = from_linear("cable_torque", {"cable_torque.slope": 0.0, "cable_torque.product": 1.5})
    assert own["cable_torque.k"] > 0.0
    assert own["cable_torque.k"] * own["cable_torque.theta0"] == pytest.approx(1.5)


@pytest.mark.parametrize(("cosine", "sine"), [(0.06, 0.0), (0.0, 0.06), (-0.03, 0.04), (-0.02, -0.05)])
def test_the_magnet_is_off_the_same_way_in_either_parameters(cosine, sine):
    own = from_linear("encoder_eccentricity", {"encoder_eccentricity.cosine": cosine,
                                               "encoder_eccentricity.sine": sine})
    amplitude, phase = own["encoder_eccentricity.amplitude"], own["encoder_eccentricity.phase"]
    bounds = CATALOGUE["encoder_eccentricity"].parameters["phase"]
    assert amplitude >= 0.0
    assert bounds.low <= phase <= bounds.high
    theta = np.linspace(-3.0, 3.0, 9)
    np.testing.assert_allclose(amplitude * np.sin(theta + phase), cosine * np.sin(theta) + sine * np.cos(theta),
                               atol=1e-12)


@pytest.mark.parametrize("id_", LINEAR)
def test_both_linear_parameters_are_zero_without_the_effect(id_):
    values = {u.name: u.mean for u in linear_parameters(id_)}
    size = CATALOGUE[id_].parameters[CATALOGUE[id_].size]
    assert from_linear(id_, values)[f"{id_}.{CATALOGUE[id_].size}"] == pytest.approx(size.neutral, abs=1e-5)


@pytest.mark.parametrize(("id_", "true"), [
    ("cable_torque", {"k": 3.0, "theta0": -0.6}), ("cable_torque", {"k": 2.0, "theta0": 1.2}),
    ("encoder_eccentricity", {"amplitude": 0.05, "phase": -2.5}),
    ("encoder_eccentricity", {"amplitude": 0.05, "phase": 2.8})])
def test_a_second_parameter_is_found_wherever_it_is(id_, true):
    findings = search(CutChains(BENCH, [recording({id_: true}, 9, 20.0)]), 2)["arm"]
    assert [h.name for h in findings.effects] == [id_]
    for name, value in true.items():
        full = f"{id_}.{name}"
        assert abs(findings.final.values[full] - value) < 4.0 * findings.final.sd[full] + 0.02 * abs(value)


# --- two effects


@pytest.mark.promise("Verdict", "Two effects of one stage are found, though neither explains much without the other")
@pytest.mark.parametrize(("one", "other"), [
    ({"encoder_eccentricity": {"amplitude": 0.06, "phase": -1.8}}, {"axial_inflow": {}}),
    ({"cable_torque": {"k": 3.0, "theta0": -0.6}}, {"axial_inflow": {}}),
    ({"cable_torque": {"k": 3.0, "theta0": -0.6}}, {"thrust_lag": {"tau": 0.08}}),
    ({"angle_offset": {"bias": 0.06}}, {"thrust_lag": {"tau": 0.08}})])
def test_two_effects_of_one_stage_are_found(one, other):
    findings = search(CutChains(BENCH, [recording({**one, **other}, 9, 30.0)]), 2)["arm"]
    assert {h.family for h in findings.effects} == {*one, *other}


@pytest.mark.parametrize(("gains", "count"), [((-50.0, 20.0), 0), ((-50.0, 80.0), 2), ((50.0, -80.0), 1)])
def test_an_effect_without_evidence_of_its_own_stays_only_if_the_next_ones_support_it(monkeypatch, gains, count):
    chains = CutChains(BENCH, [recording({"coulomb_friction": {}, "cable_torque": {}}, 4, 20.0)], UNCALIBRATED)
    names = ("coulomb_friction", "cable_torque")

    def select(here, findings, candidates):
        k = len(findings.found)
        h = next((h for h in candidates if here.stage == "arm" and h.name == (*names, "")[k]), None)
        if h is None:
            return findings, None
        final = fit(chains.residuals("arm"), adopted(here.known, h))
        selection = (RankedHypothesis(h, final, gains[k], 1.0),)
        return replace(findings, found=(*findings.found, selection), final=final), h

    monkeypatch.setattr("aeropend_ident.diagnosis.search.search._select", select)
    found = search(chains)["arm"]
    assert [h.name for h in found.effects] == list(names[:count])
    assert [r.hypothesis.name for r in found.rivals] == list(names[count:count + 1])


def test_what_only_stood_in_for_an_effect_gives_way_to_it():
    chains = CutChains(BENCH, [recording({"coulomb_friction": {}, "cable_torque": {}}, 4, 20.0)])
    findings = search(chains, 2)["arm"]
    right, wrong, *others = findings.found[0]
    assert [right.hypothesis.name, findings.found[1][0].hypothesis.name] == ["coulomb_friction", "cable_torque"]
    findings = replace(findings, found=((wrong, right, *others), *findings.found[1:]))
    findings = replace(findings, final=refit(chains, "arm", findings.effects, findings.final.values))
    findings = _with_better_rivals(chains, findings, nominal_parameters(chains, "arm"))
    assert [h.name for h in findings.effects] == ["coulomb_friction", "cable_torque"]
    assert findings.found[0][0].probability > 0.999
    assert [w.probability for w in findings.found[0][1:]] == pytest.approx([0.0] * (len(others) + 1), abs=1e-3)


def test_a_trifle_is_searched_only_if_a_person_wants_it():
    chains = CutChains(BENCH, [recording({"coulomb_friction": {"accel": 1.5}, "quadratic_drag": {"k": 0.15}}, 4, 20.0)])
    nominal = unsearched(chains)
    assert {h.name for h in search(chains, 2)["arm"].effects} == {"coulomb_friction", "quadratic_drag"}
    found = search(chains, 2, trifle=trifling_gap(chains, nominal))["arm"]
    assert [h.name for h in found.effects] == ["coulomb_friction"]
    left, before = (squared_gap(chains, f) for f in (found.final, found.base))
    assert 0.0 < left < 0.003 * before


# --- what is not in the catalogue


def bent_current(columns, truth):
    columns["i_a"] = columns["i_a"] + 0.1 * np.sin(6.0 * truth["i_a"])


@pytest.mark.promise(
    "Verdict", "An effect outside the catalogue is `unknown`, with its likeliest place and free curves")
def test_what_the_catalogue_does_not_hold_is_unknown_with_its_place_and_its_curves():
    body = diagnose(BENCH, [recording({}, 5, 20.0, bent_current)]).body
    which = body["which"]
    assert (which["verdict"], which["effects"]) == ("unknown", [])
    assert body["where"]["place"] == which["unknown"]["place"] == "sensing"
    assert which["unexplained"]
    curve = next(c for c in which["unknown"]["curves"] if c["variable"] == "i_a")
    assert curve["unit"] == "A"
    assert len(curve["at"]) == len(curve["value"]) > 4
    assert np.isfinite(curve["value"]).all()


@pytest.mark.parametrize("effects", [{}, {"brush_drop": {}}])
def test_what_the_catalogue_explains_leaves_nothing_unknown(effects):
    which = diagnose(BENCH, [recording(effects, 5, 20.0)]).body["which"]
    assert which["effects"] == list(effects)
    assert which["unknown"] is None


@pytest.mark.promise("Verdict", "Readings at unsteady instants are no unknown effect")
@pytest.mark.parametrize(("seed", "most", "above", "below"), [
    (5, 0.45, 1.1, 1.3), (6, 0.45, 1.1, 1.3), (6, 0.75, 1.35, 1.55)])
def test_readings_at_unsteady_instants_are_nothing_unknown(seed, most, above, below):
    def unsteady(columns, truth):
        late = np.random.default_rng(seed).uniform(-most, most, len(truth["i_a"]))
        columns["i_a"] = columns["i_a"] + late * np.gradient(truth["i_a"])

    diagnosis = diagnose(BENCH, [recording({}, seed, 20.0, unsteady)])
    left = diagnosis.body["which"]["residuals"]["i_a"]
    assert above < left["rms"] < below
    assert diagnosis.body["which"]["verdict"] == "none"


@pytest.mark.promise("Verdict", "Effects that close as much of a gap that stays open are said to be not separable")
@pytest.mark.parametrize("seed", [4, 5])
def test_lags_are_told_apart_only_where_nothing_else_is_missing(seed):
    def rough(columns, truth):
        k = np.arange(len(truth["theta"]))
        columns["theta"] = columns["theta"] + 0.004 * np.sin(k / 97.0) + 0.003 * np.sin(k / 41.0)

    clean, other = (diagnose(BENCH, [recording({"encoder_lag": {"tau": 0.03}}, seed, 20.0, read)]).body["which"]
                    for read in (lambda *_: None, rough))
    assert (clean["verdict"], clean["not_separable"]) == ("encoder_lag", [])
    (pair,) = other["not_separable"]
    assert sorted(pair) == ["encoder_lag", "thrust_lag"]
    assert other["verdict"] in pair
