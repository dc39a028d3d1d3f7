# SPDX-License-Identifier: Apache-2.0
"""Ends of a sensor's range are found where they are, and nowhere else; so are single readings that jump out."""

import numpy as np
import pytest

from aeropend_ident.signals.outliers import jumps_out, saturated
from aeropend_ident.testing.rigs import BENCH, drawn_rig, steps
from aeropend_sim.model import rig
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import SAMPLE_PERIOD

N = round(25.0 / SAMPLE_PERIOD)
TIME = np.arange(N) * SAMPLE_PERIOD
DUTIES = {
    "steps": steps(25.0, 1)[:N], "square": np.where(np.sin(1.3 * TIME) > 0.0, 0.4, 0.2), "ramp": 0.5 * TIME / TIME[-1],
    "on and off": 0.4 * (np.sin(0.8 * TIME) > 0.3), "constant": np.full(N, 0.3),
    "triangle": 0.5 * (1.0 - np.abs(2.0 * TIME / TIME[-1] - 1.0)),
}
SIGMA = {"theta": 2.7e-3, "i_a": 5e-3, "v_a": 5.2e-3}


def readings(duty, effects, seed=1, model=BENCH):
    columns, _ = rig.record(drawn_rig(seed, effects) if model is BENCH else model, duty, seed)
    return columns


@pytest.mark.parametrize("duty", DUTIES)
def test_a_sound_recording_has_neither(duty):
    for effect in (None, *CATALOGUE):
        columns = readings(DUTIES[duty], {effect: {}} if effect else {})
        for channel, sigma in SIGMA.items():
            assert not saturated(columns[channel], SAMPLE_PERIOD, smooth=channel == "theta").any(), (effect, channel)
            assert not jumps_out(columns[channel], sigma).any(), (effect, channel)


@pytest.mark.parametrize(("channel", "low", "high"), [
    ("theta", None, 0.5), ("theta", None, 0.3), ("theta", -0.05, None), ("i_a", None, 0.6), ("i_a", None, 0.4),
    ("i_a", 0.0, None), ("v_a", None, 1.0), ("v_a", 0.4, 1.2)])
def test_the_end_of_a_range_is_found_to_the_sample(channel, low, high):
    x = np.clip(readings(DUTIES["steps"], {})[channel], low, high)
    x[::97] = np.nan
    at = (x == low if low is not None else False) | (x == high if high is not None else False)
    assert at.mean() > 0.005
    np.testing.assert_array_equal(saturated(x, SAMPLE_PERIOD, smooth=channel == "theta"), at)


def test_an_angle_without_noise_hits_a_limit_suddenly_and_comes_to_rest_slowly():
    time = np.arange(5000) * SAMPLE_PERIOD
    lsb = BENCH.sensing["angle_lsb"]
    swinging = lsb * np.round(0.6 * np.sin(3.0 * time) / lsb)
    settling = lsb * np.round(0.5 * (1.0 - np.exp(-((time - 1.0).clip(0.0) / 1.5) ** 2)) / lsb)
    assert not saturated(swinging, SAMPLE_PERIOD, smooth=True).any()
    assert not saturated(settling, SAMPLE_PERIOD, smooth=True).any()
    clipped = np.minimum(swinging, 0.4)
    np.testing.assert_array_equal(saturated(clipped, SAMPLE_PERIOD, smooth=True), clipped == 0.4)


@pytest.mark.parametrize("every", [1, 10])
def test_an_arm_that_rests_at_exactly_0_before_it_moves_is_at_no_limit(every):
    time = np.arange(0.0, 30.0, every * SAMPLE_PERIOD)
    swing = np.where(time > 5.0, 0.6 * (1.0 - np.cos(2.0 * (time - 5.0))), 0.0)
    x = 0.001 * np.round(swing / 0.001)
    assert not saturated(x, every * SAMPLE_PERIOD, smooth=True).any()


@pytest.mark.parametrize("channel", SIGMA)
def test_single_readings_that_jump_out_are_found(channel):
    x = readings(DUTIES["steps"], {"coulomb_friction": {}})[channel]
    rng = np.random.default_rng(2)
    hit = rng.random(N) < 0.005
    x[hit] += rng.choice([-1.0, 1.0], int(hit.sum())) * np.ptp(x)
    found = jumps_out(x, SIGMA[channel])
    assert not (found & ~hit).any()
    assert (found & hit).sum() > 0.95 * hit.sum()


@pytest.mark.parametrize("x", [np.zeros(0), np.full(50, np.nan), np.full(50, 0.3), np.arange(5.0)])
def test_what_holds_too_little_has_neither(x):
    assert not saturated(x, SAMPLE_PERIOD, smooth=True).any()
    assert not jumps_out(x, 1e-3).any()
    assert len(saturated(x, SAMPLE_PERIOD)) == len(jumps_out(x, 1e-3)) == len(x)
