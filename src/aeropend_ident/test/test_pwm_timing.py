# SPDX-License-Identifier: Apache-2.0
"""A board that takes a duty half a period before the sample that reports it."""

from dataclasses import replace

import numpy as np
import pytest

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.pwm_timing import with_pwm_timing
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.testing.rigs import BENCH, recorded
from aeropend_sim.model.parameters import SAMPLE_PERIOD

HALF = 0.5 * SAMPLE_PERIOD
EARLY = {"command_delay": {"delay": -HALF}}


@pytest.mark.promise("Hardware", "A phase-correct PWM is recognised, and is no gap")
@pytest.mark.parametrize("seed", [1, 2])
def test_an_early_duty_is_told_from_the_recording(seed):
    result = diagnose(BENCH, [recorded(seed, EARLY)], 1)
    assert result.body["which"]["verdict"] == "none"
    assert result.augmented.effects["command_delay"]["delay"] == pytest.approx(-HALF)
    assert any("phase-correct PWM" in note for note in result.signals[0].notes)


@pytest.mark.parametrize(("effect", "parameters"), [
    ("coulomb_friction", {"accel": 0.8}), ("current_offset", {"bias": 0.05}), ("voltage_offset", {"bias": 0.08}),
    ("winding_heating", {"gain": 0.1}),
])
def test_effects_are_found_beside_it(effect, parameters):
    body = diagnose(BENCH, [recorded(3, {**EARLY, effect: parameters})], 1).body
    assert body["which"]["effects"] == [effect]


@pytest.mark.parametrize("effects", [
    {}, {"command_delay": {"delay": 0.0112}}, {"command_delay": {"delay": 0.001}}, {"brush_drop": {}},
    {"current_gain": {}}, {"winding_heating": {}}, {"supply_sag": {}}, {"rotor_friction": {}}, {"speed_spikes": {}},
    {"current_offset": {}}, {"rotor_friction": {"torque": 3e-4}, "brush_drop": {}},
], ids=str)
def test_other_recordings_keep_their_time(effects):
    chains = CutChains(BENCH, [recorded(4, effects)])
    assert with_pwm_timing(chains) is chains


@pytest.mark.parametrize("number", ["L_a", "R_a", "K_e", "k1", "J_m"])
@pytest.mark.parametrize("factor", [0.7, 1.4])
def test_a_wrong_number_is_no_early_duty(number, factor):
    wrong = replace(BENCH, model={**BENCH.model, number: factor * BENCH.model[number]})
    chains = CutChains(wrong, [recorded(5, {}, off=0.0)])
    assert with_pwm_timing(chains) is chains


def test_a_slow_recording_keeps_its_time():
    """Its current is read too seldom to show when a duty began to act, and a fit would take minutes."""
    s = recorded(1, EARLY, duration=20.0)
    slow = replace(s, period=0.1, pulses=None, omega=np.full(len(s), np.nan))
    early = CutChains(BENCH.with_effects({"command_delay": {"delay": -0.05}}), [slow])
    chains = CutChains(BENCH, [replace(slow, i_a=early.each[0].motor({})[0])])
    assert with_pwm_timing(chains) is chains
