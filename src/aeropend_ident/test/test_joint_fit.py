# SPDX-License-Identifier: Apache-2.0
"""The fits without an effect, with which its share of the gap is measured."""

import math
from dataclasses import replace

import numpy as np
import pytest

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.free_run_gap import HeldOut
from aeropend_ident.diagnosis.joint_fit import fit_jointly
from aeropend_ident.diagnosis.search.search import search
from aeropend_ident.signals.signals import from_arrays
from aeropend_ident.testing.rigs import BENCH, drawn_rig, steps
from aeropend_sim.model import rig
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model


@pytest.mark.parametrize("seed", [2, 3])
def test_a_fit_without_an_effect_leaves_a_smaller_gap_than_the_values_beside_the_effect(seed):
    """A current that is read too large: R_a, L_a and K_t can take over a part of it."""
    duty = steps(25.0, seed)
    columns, _ = rig.record(drawn_rig(seed, {"current_gain": {"gain": -0.1}}), duty, seed)
    chains = CutChains(BENCH, [from_arrays({**columns, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)])
    findings = search(chains, 2)
    effects = [h for f in findings.values() for h in f.effects if h.name == "current_gain"]
    joint = fit_jointly(chains, findings, gust=False)
    held_out = HeldOut(chains, BENCH, chains.recordings, spikes=False)
    fitted = joint.without(effects)
    assert all(h.own[0].name not in fitted for h in effects)
    beside = {n: v for n, v in joint.values.items() if n in fitted}
    again, same, after = (held_out.gap_of(v) for v in (fitted, beside, joint.values))
    assert again.total < 0.8 * same.total
    assert again.total > after.total
    nominal = BENCH.model
    assert all(abs(fitted[n] / nominal[n] - 1.0) < 0.0521 for n in ("R_a", "L_a", "K_t", "J_m"))
    assert np.isfinite(list(fitted.values())).all()


def test_in_a_fit_without_one_effect_the_others_keep_their_sizes():
    """An exponent and an eccentricity stand in for each other: fitted again, one would take over the other's part."""
    effects = {"encoder_eccentricity": {"amplitude": 0.05, "phase": 0.36}, "thrust_exponent": {"n": 1.9}}
    duty = steps(15.0, 1)
    columns, _ = rig.record(drawn_rig(1, effects), duty, 1)
    chains = CutChains(BENCH, [from_arrays({**columns, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)])
    joint = fit_jointly(chains, search(chains, 2), gust=False)
    both = joint.findings["arm"].effects
    assert {h.effect for h in both} == set(effects)
    held_out = HeldOut(chains, BENCH, chains.recordings, spikes=False)
    whole = held_out.gap_of(joint.without(both)).total
    for h in both:
        without = joint.without([h])
        others = [p.name for other in both if other is not h for p in other.own]
        assert {n: without[n] for n in others} == {n: joint.values[n] for n in others}
        assert not {p.name for p in h.own} & set(without)
        assert without["L_over_J"] != joint.values["L_over_J"]
        assert held_out.gap_of(without).total < 1.1 * whole


def test_without_its_mismatch_a_number_is_back_within_its_tolerance():
    model = drawn_rig(80, {})
    model = Model("rig", {**model.model, "R_a": 1.4 * BENCH.model["R_a"]}, model.sensing)
    duty = steps(25.0, 80)
    columns, _ = rig.record(model, duty, 80)
    chains = CutChains(BENCH, [from_arrays({**columns, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)])
    joint = fit_jointly(chains, search(chains, 2), gust=False)
    effects = [h for f in joint.findings.values() for h in f.effects]
    assert [h.name for h in effects] == ["parameter_mismatch:R_a"]
    assert joint.values["R_a"] == pytest.approx(1.4 * BENCH.model["R_a"], rel=0.06)
    assert joint.without(effects)["R_a"] == pytest.approx(1.05196 * BENCH.model["R_a"], rel=1e-3)
    assert joint.without([])["R_a"] == pytest.approx(joint.values["R_a"], rel=0.05)


def test_the_error_from_another_form_counts_for_a_size_as_far_as_it_is_asked_for():
    duty = steps(15.0, 1)
    columns, _ = rig.record(drawn_rig(1, {"brush_drop": {}}), duty, 1)
    chains = CutChains(BENCH, [from_arrays({**columns, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)])
    joint = fit_jointly(chains, search(chains, 2), gust=False)
    (effect,), form = joint.findings["motor"].effects, 0.4
    size = effect.own[0].name
    joint = replace(joint, sd={**joint.sd, size: math.hypot(joint.sd_given_form[size], form * joint.values[size])})
    without = joint.unsure(effect, form=0.0)
    assert 0.0 < without <= joint.sd_given_form[size] / joint.values[size]
    assert joint.unsure(effect, form=0.5) == pytest.approx(math.hypot(without, 0.5 * form))
