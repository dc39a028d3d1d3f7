# SPDX-License-Identifier: Apache-2.0
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeropend_sim.model import dynamics
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import SAMPLE_PERIOD, load
from aeropend_sim.model.rig import Rig, Sample, Truth, record

ALL = {id_: {name: p.default for name, p in effect.parameters.items()} for id_, effect in CATALOGUE.items()}
MODELS = {
    "bench": load("bench"), "thesis": load("thesis"), "bench with all effects": load("bench").with_effects(ALL),
    "bench late by part of a period": load("bench").with_effects({"command_delay": {"delay": 3.3 * SAMPLE_PERIOD}}),
    "bench late by half a second": load("bench").with_effects({"command_delay": {"delay": 0.5}}),
}
DUTY = np.repeat(np.random.default_rng(4).uniform(0.0, 0.6, 10), 60)


def same(a, b):
    return all(np.array_equal(a[name], b[name]) for name in a)


@pytest.mark.parametrize("period", [SAMPLE_PERIOD, 0.02])
@pytest.mark.parametrize("name", MODELS)
def test_sample_by_sample_is_record_to_the_last_bit(name, period):
    read, truth = record(MODELS[name], DUTY, seed=5, period=period)
    rig = Rig(MODELS[name], seed=5, period=period)
    for k, duty in enumerate(DUTY):
        sample, state = rig.sample(float(duty))
        assert sample == tuple(read[field][k] for field in Sample._fields)
        assert state == tuple(truth[field][k] for field in Truth._fields)


@given(cuts=st.lists(st.integers(0, len(DUTY)), max_size=6), name=st.sampled_from(list(MODELS)))
def test_pieces_make_the_whole(cuts, name):
    rig = Rig(MODELS[name], seed=6)
    edges = [0, *sorted(cuts), len(DUTY)]
    pieces = [rig.run(DUTY[a:b]) for a, b in pairwise(edges)]
    read, truth = Rig(MODELS[name], seed=6).run(DUTY)
    assert np.array_equal(np.hstack([piece[0] for piece in pieces]), read)
    assert np.array_equal(np.hstack([piece[1] for piece in pieces]), truth)


@pytest.mark.parametrize("name", MODELS)
def test_same_seed_same_samples(name):
    first, second = (record(MODELS[name], DUTY, seed=7) for _ in range(2))
    assert same(first[0], second[0])
    assert same(first[1], second[1])


def test_another_seed_gives_other_noise_of_the_same_motion():
    read, truth = record(MODELS["bench"], DUTY, seed=8)
    other_read, other_truth = record(MODELS["bench"], DUTY, seed=9)
    for name in Sample._fields:
        assert not np.array_equal(read[name], other_read[name])
    for name in ("theta", "theta_dot", "i_a", "omega", "v_a", "thrust"):
        assert np.array_equal(truth[name], other_truth[name])
    assert truth["rotor_angle"][0] != other_truth["rotor_angle"][0]


def test_another_seed_gives_another_gust():
    model = load("bench").with_effects({"gust": ALL["gust"]})
    assert not np.array_equal(record(model, DUTY, seed=8)[1]["theta"], record(model, DUTY, seed=9)[1]["theta"])


@pytest.mark.parametrize("name", MODELS)
def test_reset_starts_over(name):
    rig = Rig(MODELS[name], seed=10)
    first = rig.run(DUTY)
    rig.reset()
    again = rig.run(DUTY)
    assert np.array_equal(first[0], again[0])
    assert np.array_equal(first[1], again[1])


def test_starts_at_rest_hanging_with_the_duty_applied():
    sample, truth = Rig(MODELS["bench"]).sample(0.5)
    assert (truth.theta, truth.theta_dot, truth.i_a, truth.omega) == (0.0, 0.0, 0.0, 0.0)
    assert truth.v_a == pytest.approx(1.557, abs=1e-3)
    assert sample.omega == 0.0
    assert sample.v_a == pytest.approx(truth.v_a, abs=0.03)


def test_truth_is_what_simulate_gives():
    truth = record(MODELS["bench"], DUTY)[1]
    found = dynamics.simulate(MODELS["bench"], DUTY)
    for name in ("theta", "theta_dot", "i_a", "omega", "v_a", "thrust"):
        assert np.array_equal(truth[name], getattr(found, name))
    turned = truth["rotor_angle"] - truth["rotor_angle"][0]
    assert turned == pytest.approx(found.rotor_angle, abs=1e-9)


def test_thesis_rig_measures_perfectly():
    read, truth = record(MODELS["thesis"], DUTY)
    assert same(read, {name: truth[name] for name in Sample._fields})


def test_samples_are_floats():
    sample, truth = Rig(MODELS["bench"]).sample(0.3)
    assert all(type(value) is float for value in (*sample, *truth))


def test_supply_drift_goes_on_across_pieces():
    model = load("bench").with_effects({"supply_drift": {"rate": 0.02}})
    rig = Rig(model)
    rig.run(np.zeros(2000))
    _, truth = rig.sample(0.5)
    fresh = Rig(model).sample(0.5)[1]
    assert truth.v_a == pytest.approx(fresh.v_a * (1.0 - 0.02 * 2000 * SAMPLE_PERIOD), rel=1e-12)


def test_empty_series():
    read, truth = record(MODELS["bench with all effects"], np.zeros(0))
    assert all(len(channel) == 0 for channel in (*read.values(), *truth.values()))
