# SPDX-License-Identifier: Apache-2.0
"""The presets against the thesis' own tables and equations, with the misprints corrected."""

import math

import numpy as np
import pytest

from aeropend_sim.model import actuator
from aeropend_sim.model.dynamics import simulate
from aeropend_sim.model.parameters import SAMPLE_PERIOD, load
from aeropend_sim.model.step_features import step_features

# blocked rotor: v_a in V, i_a in A
TABLE_4_1 = np.array([
    (0.48, 0.44), (0.60, 0.55), (0.29, 0.25), (1.42, 1.30), (1.47, 1.33), (0.35, 0.30), (0.89, 0.85), (0.74, 0.69),
    (1.31, 1.17), (1.54, 1.40), (0.78, 0.74), (1.58, 1.57), (0.79, 0.73), (0.99, 0.96), (1.76, 1.67), (0.57, 0.52),
    (0.37, 0.35), (1.93, 1.89), (1.37, 1.32), (2.44, 2.28), (1.09, 0.99)])

# turning: v_a in V, i_a in A, rotor speed in RPM
TABLE_4_2 = np.array([
    (1.08, 0.29, 1158), (1.182, 0.33, 1235), (1.272, 0.35, 1306), (1.377, 0.40, 1402), (1.483, 0.45, 1485),
    (1.561, 0.50, 1561), (1.666, 0.55, 1638), (1.781, 0.61, 1734), (1.864, 0.65, 1805), (1.974, 0.70, 1885)])
V, CURRENT, RPM = TABLE_4_2.T
OMEGA = RPM * 2.0 * math.pi / 60.0


def thrust_4_4(v):
    return 0.054 * v**2 + 0.0435 * v + 0.0029


def voltage_4_5(f):
    return -0.4028 + 9.2593 * np.sqrt(0.0013 + 0.2160 * f)


def test_resistance_from_table_4_1():
    resistance = TABLE_4_1[:, 0] / TABLE_4_1[:, 1]
    assert resistance.mean() == pytest.approx(1.08, abs=0.005)
    assert resistance.std(ddof=1) == pytest.approx(0.04, abs=0.005)
    assert load("bench").model["R_a"] == 1.08


def test_back_emf_constant_from_table_4_2():
    per_rpm = (V - 1.08 * CURRENT) / RPM
    assert per_rpm.mean() == pytest.approx(6.606e-4, abs=5e-8)
    assert per_rpm.std(ddof=1) == pytest.approx(1.377e-5, rel=0.01)
    si = per_rpm.mean() * 60.0 / (2.0 * math.pi)
    bench = load("bench").model
    assert bench["K_e"] == pytest.approx(si, rel=5e-4)
    assert bench["K_t"] == bench["K_e"]


def test_load_is_quadratic_in_table_4_2():
    load_factor = 6.31e-3 * CURRENT / OMEGA**2
    assert load_factor.std() / load_factor.mean() < 0.03
    bench = load("bench").model
    least_squares = np.sum(6.31e-3 * CURRENT * OMEGA**2) / np.sum(OMEGA**4)
    assert bench["k_load"] == pytest.approx(least_squares, rel=5e-3)
    assert bench["B_m"] == 0.0


def test_thrust_is_quadratic_over_the_speeds_of_table_4_2():
    factor = thrust_4_4(V) / OMEGA**2
    assert factor.std() / factor.mean() < 0.013
    assert np.abs(factor / 7.67e-6 - 1.0).max() < 0.015
    assert load("bench").model["k_thrust"] == pytest.approx(factor.mean(), rel=5e-3)


def test_bench_turns_as_table_4_2():
    bench = load("bench").model
    assert actuator.speed_at(bench, V) == pytest.approx(OMEGA, rel=0.03)
    assert actuator.current_at(bench, OMEGA) == pytest.approx(CURRENT, rel=0.065)
    assert actuator.thrust(bench, OMEGA) == pytest.approx(thrust_4_4(V), rel=0.015)


def test_4_5_is_the_inverse_of_4_4():
    v = np.linspace(0.2, 2.4, 23)
    assert voltage_4_5(thrust_4_4(v)) == pytest.approx(v, abs=3e-3)  # its numbers are printed to four places
    f = np.linspace(0.01, 0.4, 23)
    assert thrust_4_4(voltage_4_5(f)) == pytest.approx(f, abs=2e-4)


@pytest.mark.parametrize("preset", ["bench", "thesis"])
def test_duty_map(preset):
    numbers = load(preset).model
    assert actuator.voltage(numbers, 1.0) == pytest.approx(2.319, abs=5e-4)
    assert actuator.voltage(numbers, 0.0) == 0.0  # -0.2914 + 0.142 is clipped


def test_sample_period():
    assert pytest.approx(490.196, abs=5e-4) == 1.0 / SAMPLE_PERIOD
    assert pytest.approx(2.040e-3, abs=1e-15) == SAMPLE_PERIOD


def test_thesis_preset_is_the_reference_equations():
    n = load("thesis").model
    coefficients = {
        "sin": n["mgd_over_J"], "theta_dot": n["c_over_J"], "omega^2": n["L_over_J"] * n["k_thrust"],
        "i": n["R_a"] / n["L_a"], "omega": n["K_e"] / n["L_a"], "v": 1.0 / n["L_a"],
        "torque": n["K_t"] / n["J_m"], "friction": n["B_m"] / n["J_m"], "load": n["k_load"],
    }
    printed = {"sin": 131.75, "theta_dot": 13.82, "omega^2": 1.7285, "i": 8.6957, "omega": 1.0217, "v": 4.3478,
               "torque": 4519.2, "friction": 192.31, "load": 0.0}
    assert coefficients == pytest.approx(printed, rel=4e-5)
    assert 1.729 / (n["L_over_J"] * (55.0 / 9.0)**2) == pytest.approx(1e-4, rel=1e-3)


def test_step_of_the_thesis_preset():
    model = load("thesis")
    n = 1500
    theta = simulate(model, np.full(n, 0.4314)).theta
    found = step_features(np.arange(n) * SAMPLE_PERIOD, theta, float(theta[-1]))
    assert found.final == pytest.approx(0.264, abs=6e-4)
    assert found.peak_time == pytest.approx(0.40, abs=5e-3)
    assert found.rise_time == pytest.approx(0.18, abs=5e-3)
    assert found.settling_time == pytest.approx(0.57, abs=6e-3)
    assert theta[-1] == pytest.approx(float(actuator.static_angle(model.model, 0.4314)), abs=1e-6)
