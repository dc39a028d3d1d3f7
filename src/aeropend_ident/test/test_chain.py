# SPDX-License-Identifier: Apache-2.0
"""The cut chains of one or more recordings."""

from collections import Counter
from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from aeropend_ident.bags.reading import RecordingError
from aeropend_ident.diagnosis.chain.chain import CutChain, CutChains
from aeropend_ident.diagnosis.chain.nominal_fit import _possible
from aeropend_ident.diagnosis.chain.priors import nominal_parameters
from aeropend_ident.diagnosis.chain.values import STAGES
from aeropend_ident.estimation.levenberg_marquardt import Search
from aeropend_ident.testing.rigs import BENCH, recorded
from aeropend_sim.model import actuator
from aeropend_sim.model.parameters import SAMPLE_PERIOD


@pytest.fixture(scope="module")
def chains():
    return CutChains(BENCH, [recorded(seed, duration=8.0) for seed in range(3)])


@pytest.mark.parametrize("stage", STAGES)
def test_the_training_part_alone_has_the_same_residuals(chains, stage):
    values = {"initial.theta": 0.1, "initial.theta@2": -0.1, "R_a": 1.2, "k1": 0.9 * BENCH.model["k1"]}
    whole, head = (c.residuals(stage)(values) for c in (chains, chains.head(10**6)))
    assert list(whole) == list(head)
    for channel, r in whole.items():
        np.testing.assert_array_equal(r, head[channel])


@pytest.mark.parametrize("channels", [(), ("omega", "i_a")])
def test_chains_that_keep_their_last_runs_give_what_new_ones_give(channels):
    signals = [recorded(4, duration=6.0, without=channels)]
    chains = CutChains(BENCH, signals)
    tried = [{}, {"R_a": 1.2}, {"voltage_offset.bias": 0.2}, {"current_gain.gain": 0.1}, {}, {"angle_offset.bias": 0.1},
             {"initial.theta": 0.2}, {"sensing.angle_filter_tau": 0.02}, {"c_over_J": 0.5}, {"initial.omega": 30.0},
             {"command_delay.delay": 0.03}, {"encoder_eccentricity.amplitude": 0.1}, {}]
    for described in ({}, {"k1": 0.9 * BENCH.model["k1"]}):
        new = CutChains(BENCH, signals)
        for each in (chains, new):
            each.set_next_input("actuator", described)
            each.set_next_input("motor", {**described, "J_m": 1.1 * BENCH.model["J_m"]})
        for stage in STAGES:
            for values in tried:
                fresh = copy(new)
                fresh.each = [replace(chain) for chain in new.each]
                expected = fresh.residuals(stage)(values)
                found = chains.residuals(stage)(values)
                assert found.keys() == expected.keys()
                for channel, r in expected.items():
                    np.testing.assert_array_equal(found[channel], r)


@pytest.mark.promise("Verdict", "A large recording does not need more memory for the search of free curves")
def test_a_head_is_as_long_as_asked_for(chains):
    train = chains.each[0].signals.train
    assert [len(c.signals) for c in chains.head(train + 100).each] == [train, 100]


@pytest.mark.parametrize("speed", [0.0, 120.0])
def test_until_a_late_command_acts_the_voltage_is_what_the_rotor_begins_with(speed):
    signals = recorded(1, duration=8.0, without=("v_a", "i_a", "omega"))
    chain = CutChain.cut(BENCH, replace(signals, duty=np.full(len(signals), 0.3)))
    v = chain.actuator({"command_delay.delay": 20 * SAMPLE_PERIOD, "initial.omega": speed})
    np.testing.assert_allclose(v[:20], actuator.voltage_at(BENCH.model, speed), atol=1e-9)
    np.testing.assert_allclose(v[20:], actuator.voltage(BENCH.model, 0.3), atol=1e-9)


def test_what_each_recording_has_its_own_of_costs_no_more_runs_with_more_recordings(chains):
    runs = Counter()

    def slopes(several):
        residuals = several.residuals("arm")
        search = Search(lambda values: runs.update(n=1) or residuals(values), nominal_parameters(several, "arm"))
        runs.clear()
        search.jacobian()
        return runs["n"]

    assert slopes(chains) == slopes(chains.head(chains.each[0].signals.train))


def test_slopes_are_those_of_all_residuals_by_all_parameters(chains):
    residuals = chains.residuals("arm")
    search = Search(residuals, nominal_parameters(chains, "arm"))
    every = search.stacked(search.jacobian())
    assert every.shape == (len(search.parameters), sum(len(r) for r in search.current.values()))
    for j in range(len(search.parameters)):
        z = search.z.copy()
        z[j] -= 1e-4 * (1.0 if z[j] + 1e-4 > search.high[j] else -1.0)
        slope = (search.stack(search.at(z)) - search.stack(search.current)) / (z[j] - search.z[j])
        np.testing.assert_allclose(every[j], slope, rtol=1e-6, atol=1e-9 * np.abs(slope).max())


@pytest.mark.filterwarnings("error")
def test_a_bridge_without_slope_has_a_voltage_all_the_same(chains):
    assert np.isfinite(chains.each[0].actuator({"k1": 0.0})).all()
    assert np.isfinite(chains.each[0].actuator({"k2": 0.0})).all()


@pytest.mark.filterwarnings("error")
def test_a_channel_without_a_reading_to_fit_to_has_no_residual_and_any_delay():
    signals = recorded(1, duration=8.0)
    v_a = np.where(np.arange(len(signals)) < 20, signals.v_a, np.nan)
    chain = CutChain.cut(BENCH, replace(signals, v_a=v_a))
    assert chain.residuals("actuator")({}) == {}
    assert chain.likeliest_delay({}) > 0.0


def test_a_sample_period_above_every_delay_has_a_delay_all_the_same():
    s = recorded(1, duration=8.0)
    assert CutChain.cut(BENCH, replace(s, period=1.0)).likeliest_delay({}) == 0.5


def test_a_motor_that_is_faster_than_any_is_not_simulated_and_no_result(chains):
    chain, fast = chains.each[0], {"J_m": 1e-12}
    assert np.isnan(chain.motor(fast)[0]).all()
    assert np.isfinite(chain.motor({"J_m": 1e-7})[0]).all()
    assert _possible(BENCH, chains.recordings) is BENCH
    with pytest.raises(RecordingError, match="no motor has the speed, current and voltage"):
        _possible(chain.valued(fast), chains.recordings)
