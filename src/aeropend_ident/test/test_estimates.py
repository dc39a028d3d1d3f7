# SPDX-License-Identifier: Apache-2.0
"""The estimators of bench tests: tables of the thesis and known rigs."""


import numpy as np
import pytest
from bench_readings import BENCH, blocked, holds, recorded, table

from aeropend_ident.bench_tests import estimates
from aeropend_ident.bench_tests.estimates import BenchTestError, Estimate
from aeropend_ident.studies.thesis import TABLE_4_1, TABLE_4_2
from aeropend_sim.model.excitation import Excitation


@pytest.mark.promise("Identification", "The tables of the thesis are recomputed beside the printed values")
def test_table_4_1_gives_the_resistance_the_thesis_prints():
    found = estimates.blocked_rotor(TABLE_4_1).numbers["R_a"]
    assert f"{found.value:.2f} {found.scatter:.2f}" == "1.08 0.04"


def test_table_4_2_gives_the_constant_the_thesis_prints_in_volts_per_rpm():
    found = estimates.steady(TABLE_4_2, Estimate(1.08, 0.0, "Ω", "Table 4.1"))
    printed = found.others["K_e in V/RPM"]
    assert printed.value == pytest.approx(6.606442526e-4, rel=2e-4)
    assert printed.scatter == pytest.approx(1.377310893e-5, rel=1e-2)
    assert found.numbers["K_e"].value == pytest.approx(6.309e-3, rel=1e-3)


def test_equation_4_5_is_the_inverse_of_4_4():
    p, q, r, s = estimates.thrust_to_voltage(0.054, 0.0435, 0.0029)
    assert [round(x, 4) for x in (p, q, r, s)] == [-0.4028, 9.2593, 0.0013, 0.216]
    v = np.linspace(0.1, 2.3, 20)
    assert p + q * np.sqrt(r + s * (0.054 * v**2 + 0.0435 * v + 0.0029)) == pytest.approx(v)
    with pytest.raises(ValueError, match="inverse"):
        estimates.thrust_to_voltage(-1.0, 1.0, 0.0)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("early", [0.0, -0.00102])
def test_a_blocked_rotor_gives_resistance_and_inductance_wherever_in_the_period_the_duty_acts(seed, early):
    found = estimates.blocked_recording(blocked(seed, {"command_delay": {"delay": early}} if early else {}), "bag")
    assert holds(found.numbers["L_a"], BENCH.model["L_a"])
    assert found.numbers["R_a"].value == pytest.approx(BENCH.model["R_a"], rel=1e-3)


def test_another_exponent_of_the_thrust_is_said():
    w = np.linspace(60.0, 220.0, 12)
    f = 7.67e-6 * 150.0**2 * (w / 150.0) ** 1.8 * (1.0 + 0.01 * np.random.default_rng(0).standard_normal(12))
    found = estimates.thrust_curve(table({"omega": w, "thrust": f}), BENCH.model)
    assert holds(found.others["exponent of ω"], 1.8)
    assert "rather than" in found.notes[0]


def test_a_current_step_gives_its_time_constant():
    t = np.arange(0.0, 0.05, 2e-4)
    noise = 2e-3 * np.random.default_rng(0).standard_normal(len(t))
    i = np.where(t > 0.0101, 0.9 * -np.expm1(-(t - 0.0101) / 0.002), 0.0) + noise
    found = estimates.current_step(table({"t": t, "i_a": i}), Estimate(1.08, 0.01, "Ω", ""))
    assert holds(found.others["τ_e"], 0.002)
    assert holds(found.numbers["L_a"], 0.00216)
    assert not found.notes
    rough = estimates.current_step(table({"t": t[::30], "i_a": i[::30]}), Estimate(1.08, 0.01, "Ω", ""))
    assert "sample faster" in rough.notes[0]


def test_an_offset_of_a_reading_is_said():
    i = np.linspace(0.3, 2.0, 15)
    v = 1.08 * i + 0.1 + 1e-3 * np.random.default_rng(0).standard_normal(15)
    assert "0.1 V" in estimates.blocked_rotor(table({"v_a": v, "i_a": i})).notes[0]


def test_recordings_that_say_nothing_are_refused():
    moved = recorded(BENCH, Excitation("steps", duration=4.0, hold_max=1.0).series())
    with pytest.raises(BenchTestError, match="the rotor turned"):
        estimates.blocked_recording(moved, "bag")
    with pytest.raises(BenchTestError, match="settle"):
        estimates.plateaus(moved, ("theta",), "bag")
    with pytest.raises(BenchTestError, match="no current"):
        estimates.blocked_recording(blocked(0, high=1e-9), "bag")


@pytest.mark.filterwarnings("error")
def test_holds_of_which_a_channel_was_not_read_do_not_count():
    read = recorded(BENCH, Excitation("staircase", duration=60.0).series())
    every = estimates.plateaus(read, ["v_a", "i_a"], "bag")
    read.i_a[len(read) // 2:] = np.nan
    some = estimates.plateaus(read, ["v_a", "i_a"], "bag")
    assert 3 <= len(some.columns["v_a"]) < len(every.columns["v_a"])


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("change", "says"), [
    (lambda x: x[:1], "1 sample; give 30 or more"),
    (lambda x: -x, "the current flows against the voltage"),
])
def test_a_winding_that_cannot_be_fitted_is_refused_in_one_line(change, says):
    read = blocked(0)
    kept = slice(0, len(change(read.i_a)))
    for name in ("t", "v_a", "duty", "omega", "theta"):
        setattr(read, name, getattr(read, name)[kept])
    read.i_a = change(read.i_a)
    with pytest.raises(BenchTestError, match=says):
        estimates.blocked_recording(read, "bag")


def test_rows_of_one_speed_show_no_viscous_load_and_warn_of_nothing():
    rows = estimates.Rows("same", {"v_a": np.full(12, 3.0), "i_a": np.full(12, 0.3), "omega": np.full(12, 50.0)})
    with np.errstate(all="raise"):
        found = estimates.steady(rows, Estimate(1.08, 0.0, "Ω", "Table 4.1"))
    assert found.numbers["B_m"].how == "not seen"


def test_too_few_rows_say_how_a_recording_gets_more():
    rows = estimates.Rows("few", {"v_a": np.ones(2), "i_a": np.ones(2), "omega": np.ones(2)})
    with pytest.raises(estimates.BenchTestError, match=r"2 rows hold .*each held for some seconds \(excite"):
        rows.take("v_a", "i_a", "omega")
