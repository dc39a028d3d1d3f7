# SPDX-License-Identifier: Apache-2.0
"""The free run that simulates the motor, then the arm."""

import signal
from dataclasses import replace

import numpy as np
import pytest

from aeropend_ident.diagnosis.chain.free_run import StagedRun, free_run
from aeropend_ident.interrupt import interrupts_wait
from aeropend_ident.testing.rigs import BENCH, recorded
from aeropend_sim.model import dynamics

EFFECTS = {
    "none": {},
    "an arm that sticks": {"coulomb_friction.accel": 3.0, "thrust_lag.tau": 0.06, "mast_flex.coupling": 0.05},
    "a thrust of its own": {"thrust_exponent.n": 1.8, "ground_effect.gain": 0.2, "axial_inflow.k": 0.002},
    "a warm winding": {"winding_heating.gain": 0.004, "brush_drop.v_brush": 0.4, "rotor_friction.torque": 1e-4},
    "a weak supply": {"supply_sag.r_supply": 0.3, "supply_drift.rate": 1e-3, "command_delay.delay": 0.007},
    "readings": {"encoder_lag.tau": 0.02, "current_gain.gain": 1.1, "initial.theta": 0.2, "initial.omega": 40.0},
}


@pytest.fixture(scope="module")
def signals():
    return recorded(3, duration=12.0)


@pytest.mark.parametrize("effects", EFFECTS)
@pytest.mark.parametrize("every", [1, 10])
def test_motor_then_arm_read_as_the_whole_chain(signals, effects, every):
    s = replace(signals, period=every * signals.period)
    whole, staged = free_run(BENCH, s, EFFECTS[effects]), StagedRun(BENCH, s).readings(EFFECTS[effects])
    assert list(whole) == list(staged)
    for channel, reading in whole.items():
        np.testing.assert_allclose(staged[channel], reading, atol=0.05 * s.sigma[channel])


def test_effects_that_end_act_in_both_stages(signals):
    s = replace(signals, window=(0, 2500))
    values = {"supply_sag.r_supply": 0.3, "coulomb_friction.accel": 1.0}
    whole, staged = free_run(BENCH, s, values), StagedRun(BENCH, s).readings(values)
    np.testing.assert_allclose(staged["theta"], whole["theta"], atol=0.05 * s.sigma["theta"])
    assert np.ptp(free_run(BENCH, signals, values)["theta"] - whole["theta"]) > s.sigma["theta"]


def test_the_motor_runs_again_only_for_its_own_values(signals, monkeypatch):
    runs, run_motor = [], dynamics.run_motor
    monkeypatch.setattr(dynamics, "run_motor", lambda *arguments: runs.append(1) or run_motor(*arguments))
    run = StagedRun(BENCH, signals)
    for values in ({}, {"c_over_J": 0.5}, {"thrust_lag.tau": 0.1}, {"angle_offset.offset": 0.1}):
        run.readings(values)
    assert len(runs) == 1
    run.readings({"R_a": 1.2})
    run.readings({"supply_sag.r_supply": 0.3})
    assert len(runs) == 3


@pytest.mark.parametrize("simulate", [free_run, lambda model, signals: StagedRun(model, signals).readings({})])
def test_ctrl_c_takes_effect_before_a_run(signals, simulate):
    def interrupted():
        with interrupts_wait():
            signal.raise_signal(signal.SIGINT)
            simulate(BENCH, signals)
            pytest.fail("it was simulated")

    with pytest.raises(KeyboardInterrupt):
        interrupted()
