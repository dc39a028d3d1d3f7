# SPDX-License-Identifier: Apache-2.0
"""Effects by formula in the simulation: as those of the catalogue that have the same equation."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from aeropend_sim.errors import UserError
from aeropend_sim.model import actuator, dynamics, effect_file, sensing
from aeropend_sim.model.coefficients import prepare
from aeropend_sim.model.dynamics import simulate
from aeropend_sim.model.effects import DEFINED
from aeropend_sim.model.parameters import SAMPLE_PERIOD, load
from aeropend_sim.model.rig import record
from aeropend_sim.model.state import State
from aeropend_sim.model.terms import SLOTS, along, series, terms

BENCH = load("bench")
DUTY = np.repeat(np.random.default_rng(3).uniform(0.1, 0.6, 8), 500)
HIGH = {"low": 0.0, "high": 100.0}

effect_file.define({
    "as_drag": {"place": "arm", "term": "-k * theta_dot * abs(theta_dot)",
                "parameters": {"k": {"unit": "1/rad", "default": 0.6, **HIGH}}},
    "as_sag": {"place": "actuator", "term": "-r_supply * i_a",
               "parameters": {"r_supply": {"unit": "Ω", "default": 0.15, **HIGH}}},
    "as_inflow": {"place": "thrust", "term": "-k * omega * theta_dot",
                  "parameters": {"k": {"unit": "N·s²/rad²", "default": 1e-4, **HIGH}}},
    "as_resistance": {"place": "electrical", "term": "-r * i_a",
                      "parameters": {"r": {"unit": "Ω", "default": 0.2, **HIGH}}},
    "as_load": {"place": "rotor", "term": "-b * omega * abs(omega)",
                "parameters": {"b": {"unit": "N·m·s²/rad²", "default": 1e-7, **HIGH}}},
    "as_eccentricity": {"place": "sensing", "reading": "theta", "term": "amplitude * sin(theta + phase)",
                        "parameters": {"amplitude": {"unit": "rad", "default": 0.06, **HIGH},
                                       "phase": {"unit": "rad", "default": 0.5, **HIGH}}},
    "as_gain": {"place": "sensing", "reading": "i_a", "term": "gain * i_a",
                "parameters": {"gain": {"unit": "-", "default": 0.3, **HIGH}}},
    "as_offset": {"place": "sensing", "reading": "v_a", "term": "bias * (1 + 0.3 * v / one)",
                  "parameters": {"bias": {"unit": "V", "default": 0.1, **HIGH},
                                 "one": {"unit": "V", "default": 1.0, "low": 0.5, "high": 2.0}}},
    "bending_friction": {"place": "arm", "term": "-f * tanh(theta_dot / bend)",
                         "parameters": {"f": {"unit": "rad/s²", "default": 3.0, **HIGH},
                                        "bend": {"unit": "rad/s", "default": 0.003, "low": 1e-4, "high": 1.0}}},
    "relaxing_hose": {"place": "arm", "term": "-k * z",
                      "memory": {"name": "z", "unit": "rad", "rate": "theta_dot - z / tau"},
                      "parameters": {"k": {"unit": "1/s²", "default": 6.0, **HIGH},
                                     "tau": {"unit": "s", "default": 0.5, "low": 1e-3, "high": 20.0}}},
    "rising": {"place": "arm", "term": "rate * t",
               "parameters": {"rate": {"unit": "rad/s³", "default": 0.05, **HIGH}}},
}, "test_terms")


def with_(*ids):
    return BENCH.with_effects({id_: {n: p.default for n, p in DEFINED[id_].parameters.items()} for id_ in ids})


@pytest.mark.parametrize(("formula", "built_in", "within"), [
    ("as_drag", "quadratic_drag", 1e-13), ("as_sag", "supply_sag", 1e-12), ("as_inflow", "axial_inflow", 1e-13)])
def test_a_formula_acts_as_the_same_equation_of_the_catalogue(formula, built_in, within):
    found, expected, nominal = (simulate(m, DUTY) for m in (with_(formula), with_(built_in), BENCH))
    for a, b in zip(found, expected, strict=True):
        assert np.abs(a - b).max() <= within * max(np.abs(b).max(), 1.0)
    assert np.abs(expected.theta - nominal.theta).max() > 0.02


@pytest.mark.parametrize(("formula", "number", "more"), [("as_resistance", "R_a", 0.2), ("as_load", "k_load", 1e-7)])
def test_a_formula_acts_as_another_number_of_the_model(formula, number, more):
    found = simulate(with_(formula), DUTY)
    other = type(BENCH)("other", {**BENCH.model, number: BENCH.model[number] + more}, BENCH.sensing)
    expected = simulate(other, DUTY)
    for a, b in zip(found, expected, strict=True):
        assert np.abs(a - b).max() <= 1e-7 * max(np.abs(b).max(), 1.0)


@pytest.mark.parametrize(("formula", "built_in"), [("as_eccentricity", "encoder_eccentricity"),
                                                   ("as_gain", "current_gain")])
def test_an_error_of_a_reading_acts_as_that_of_the_catalogue(formula, built_in):
    (found, _), (expected, _) = (record(with_(id_), DUTY, seed=1) for id_ in (formula, built_in))
    for channel, values in expected.items():
        assert np.array_equal(found[channel], values), channel


def test_the_true_voltage_is_the_inverse_of_its_reading():
    volts = np.linspace(-2.0, 6.0, 50)
    model = with_("as_offset")
    assert sensing.true_voltage(model, sensing.read_voltage(model, volts)) == pytest.approx(volts, abs=1e-9)
    assert sensing.read_voltage(model, 2.0) == pytest.approx(2.0 + 0.1 * 1.6)


def test_the_true_voltage_is_that_of_an_error_which_depends_on_the_time():
    effect_file.define({"creeping": {"place": "sensing", "reading": "v_a", "term": "k * t * v", "parameters": {
        "k": {"unit": "1/s", "default": 0.01, "low": 0.0, "high": 1.0}}}}, "test")
    model, time, volts = with_("creeping"), np.linspace(0.0, 20.0, 50), np.linspace(1.0, 6.0, 50)
    read = sensing.read_voltage(model, volts, time)
    assert read == pytest.approx(volts * (1.0 + 0.01 * time))
    assert sensing.true_voltage(model, read, time) == pytest.approx(volts, abs=1e-9)
    effect_file.forget("creeping")


@pytest.mark.parametrize("id_", ["bending_friction", "relaxing_hose", "rising"])
def test_the_simulation_agrees_with_an_integrator_of_scipy(id_):
    model, n = with_(id_), BENCH.numbers()
    start = State(theta=1.0)
    found = simulate(model, np.zeros(1500), state=start)
    p = model.effects[id_]

    def slope(t, y):
        theta, rate, z = y
        more = {"bending_friction": lambda: -p["f"] * np.tanh(rate / p["bend"]), "relaxing_hose": lambda: -p["k"] * z,
                "rising": lambda: p["rate"] * t}[id_]()
        z_dot = rate - z / p["tau"] if id_ == "relaxing_hose" else 0.0
        return [rate, -n["mgd_over_J"] * np.sin(theta) - n["c_over_J"] * rate + more, z_dot]

    t = np.arange(1500) * SAMPLE_PERIOD
    exact = solve_ivp(slope, (0.0, t[-1]), [1.0, 0.0, 0.0], "Radau", t, rtol=1e-9, atol=1e-11).y
    assert np.abs(found.theta - exact[0]).max() < 2e-5


def test_a_series_in_parts_is_the_whole_series():
    effects, rate, memory = with_("relaxing_hose", "rising").effects, np.sin(np.arange(1000) * 0.01), np.zeros(SLOTS)
    parts = [series(effects, "arm", 250, 1e-3, k * 1e-3, memory, theta_dot=rate[k:k + 250])
             for k in range(0, 1000, 250)]
    assert np.concatenate(parts) == pytest.approx(series(effects, "arm", 1000, 1e-3, theta_dot=rate), abs=1e-12)


def test_a_run_in_parts_is_the_whole_run():
    model = with_("relaxing_hose", "rising", "as_sag")
    prepared = prepare(model)
    v = actuator.acting_voltage(model.numbers(), DUTY, model.effects, SAMPLE_PERIOD)
    whole, parts, state = np.empty((7, len(v))), np.empty((7, len(v))), State()
    dynamics.run(v, np.zeros(len(v)), State(), *prepared, whole)
    for part in (slice(0, 777), slice(777, 778), slice(778, len(v))):
        out = np.empty((7, part.stop - part.start))
        state = dynamics.run(v[part], np.zeros(out.shape[1]), state, *prepared, out)
        parts[:, part] = out
    assert np.array_equal(whole, parts)


def test_the_stages_of_the_chain_alone_agree_with_the_whole():
    model = with_("as_drag", "as_inflow", "as_load", "as_resistance")
    whole, prepared = simulate(model, DUTY), prepare(model)
    motor, arm = np.empty((3, len(DUTY))), np.empty((2, len(DUTY)))
    dynamics.run_motor(whole.v_a, State(), *prepared, motor)
    dynamics.run_arm(whole.omega, State(), 1, *prepared, (prepared[0], prepared[2]), arm)
    assert motor[1] == pytest.approx(whole.omega, abs=1e-9)
    assert arm[0] == pytest.approx(whole.theta, abs=2e-4)


def test_an_effect_of_size_zero_is_absent():
    absent = BENCH.with_effects({"as_drag": {"k": 0.0}})
    assert terms(absent.effects) is None
    assert np.array_equal(simulate(absent, DUTY).theta, simulate(BENCH, DUTY).theta)


def test_the_terminal_voltage_holds_a_formula_of_the_supply():
    model = with_("as_sag")
    run = simulate(model, DUTY)
    bridge = actuator.acting_voltage(model.numbers(), DUTY, model.effects, SAMPLE_PERIOD)
    assert actuator.terminal_voltage(model, bridge, run.i_a) == pytest.approx(run.v_a, abs=1e-12)
    assert not actuator.behind_terminals(model).effects


def test_a_series_follows_the_memory():
    rate = np.ones(2000)
    out = series({"relaxing_hose": {"k": 6.0, "tau": 0.5}}, "arm", 2000, 1e-3, theta_dot=rate)
    t = np.arange(2000) * 1e-3
    assert out == pytest.approx(-6.0 * 0.5 * (1.0 - np.exp(-t / 0.5)), abs=1e-4)


def test_too_many_memories_are_refused():
    hose = effect_file.definitions(["relaxing_hose"])["relaxing_hose"]
    effect_file.define({f"hose_{k}": hose for k in range(5)}, "test_terms")
    with pytest.raises(UserError, match="5 effects by formula with a memory"):
        terms(with_(*(f"hose_{k}" for k in range(5))).effects)
    four = [f"hose_{k}" for k in range(4)]
    assert simulate(with_(*four, "as_drag"), DUTY).theta[-1] != simulate(with_(*four), DUTY).theta[-1]


def test_what_is_no_formula_is_never_called():
    with pytest.raises(ValueError, match="no formula"):
        along("", {"delay": 0.1}, 10, 1e-3)
