# SPDX-License-Identifier: Apache-2.0
"""Every effect against a table of its own: it changes what it should and nothing else, and nothing at no size."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeropend_sim.model.dynamics import Trajectory
from aeropend_sim.model.effects import CATALOGUE, PARAMETER_MISMATCH, PLACES, is_active, values
from aeropend_sim.model.parameters import MODEL_NAMES, SAMPLE_PERIOD, Model, load
from aeropend_sim.model.rig import Sample, record

CONTRACT = {
    "bridge_drop": ("actuator", "v_drop V"), "supply_sag": ("actuator", "r_supply Ω"),
    "supply_drift": ("actuator", "rate 1/s"), "command_delay": ("actuator", "delay s"),
    "brush_drop": ("electrical", "v_brush V"), "winding_heating": ("electrical", "gain 1/A²s, tau s"),
    "rotor_friction": ("rotor", "torque N·m"), "thrust_lag": ("thrust", "tau s, fall -"),
    "thrust_exponent": ("thrust", "n -"), "axial_inflow": ("thrust", "k N·s²/rad²"),
    "ground_effect": ("thrust", "gain -, width rad"), "coulomb_friction": ("arm", "accel rad/s²"),
    "quadratic_drag": ("arm", "k 1/rad"), "cable_torque": ("arm", "k 1/s², theta0 rad"),
    "mast_flex": ("arm", "coupling -, omega rad/s, zeta -"), "gust": ("arm", "sigma rad/s², tau s"),
    "angle_offset": ("sensing", "bias rad"), "encoder_lag": ("sensing", "tau s"),
    "encoder_eccentricity": ("sensing", "amplitude rad, phase rad"), "current_gain": ("sensing", "gain -"),
    "current_offset": ("sensing", "bias A"), "voltage_offset": ("sensing", "bias V"),
    "speed_spikes": ("sensing", "rate 1/s"),
}

MOTOR = {"i_a", "omega", "rotor_angle"}
ARM = {"theta", "theta_dot"}
EVERYTHING = set(Trajectory._fields)
ANGLE = {"theta"}
NOT_VOLTAGE = set(Sample._fields) - {"v_a"}

# What changes of the true states and of the readings; all else stays as it is to the last bit.
CHANGES = {
    "bridge_drop": (EVERYTHING, set(Sample._fields)), "supply_sag": (EVERYTHING, set(Sample._fields)),
    "supply_drift": (EVERYTHING, set(Sample._fields)), "command_delay": (EVERYTHING, set(Sample._fields)),
    "brush_drop": (EVERYTHING - {"v_a"}, NOT_VOLTAGE), "winding_heating": (EVERYTHING - {"v_a"}, NOT_VOLTAGE),
    "rotor_friction": (EVERYTHING - {"v_a"}, NOT_VOLTAGE),
    "thrust_lag": (ARM | {"thrust"}, ANGLE), "thrust_exponent": (ARM | {"thrust"}, ANGLE),
    "axial_inflow": (ARM, ANGLE), "ground_effect": (ARM, ANGLE),
    "coulomb_friction": (ARM, ANGLE), "quadratic_drag": (ARM, ANGLE), "cable_torque": (ARM, ANGLE),
    "mast_flex": (ARM, ANGLE), "gust": (ARM, ANGLE),
    "angle_offset": (set(), ANGLE), "encoder_lag": (set(), ANGLE), "encoder_eccentricity": (set(), ANGLE),
    "current_gain": (set(), {"i_a"}), "current_offset": (set(), {"i_a"}), "voltage_offset": (set(), {"v_a"}),
    "speed_spikes": (set(), {"omega"}),
}

NUMBERS = {
    "reverse": (set(), set()),
    **dict.fromkeys(("k0", "k1", "k2", "k3", "v_full"), (EVERYTHING, set(Sample._fields))),
    **dict.fromkeys(("R_a", "L_a", "K_e", "K_t", "J_m", "B_m", "k_load"), (EVERYTHING - {"v_a"}, NOT_VOLTAGE)),
    "k_thrust": (ARM | {"thrust"}, ANGLE),
    **dict.fromkeys(("mgd_over_J", "c_over_J", "L_over_J"), (ARM, ANGLE)),
}


def duty():
    """12 s of steps that do not lift the arm over the top."""
    return np.repeat(np.random.default_rng(1).uniform(0.0, 0.45, 24), 245)


def default(id_):
    return {id_: {name: p.default for name, p in CATALOGUE[id_].parameters.items()}}


def neutral(id_):
    """The effect at no size, its other parameters as if it were there."""
    return {id_: {**default(id_)[id_], CATALOGUE[id_].size: CATALOGUE[id_].parameters[CATALOGUE[id_].size].neutral}}


@pytest.fixture(scope="module")
def nominal():
    return record(load("bench"), duty(), seed=3)


def changed(before, after):
    return {name for name in before if not np.array_equal(before[name], after[name])}


def test_catalogue_is_the_table_of_effects():
    found = {id_: (e.place, ", ".join(f"{name} {p.unit}" for name, p in e.parameters.items()))
             for id_, e in CATALOGUE.items()}
    assert found == CONTRACT


def test_entries_are_in_the_order_of_the_chain():
    places = [PLACES.index(effect.place) for effect in CATALOGUE.values()]
    assert places == sorted(places)


@pytest.mark.parametrize("id_", CATALOGUE)
def test_entry_is_complete(id_):
    effect = CATALOGUE[id_]
    assert effect.id == id_
    assert effect.physics
    for name, p in effect.parameters.items():
        assert p.low <= p.neutral <= p.high
        assert p.low <= p.default <= p.high
        assert p.description
        assert name != effect.size or p.default != p.neutral


@pytest.mark.parametrize("id_", CATALOGUE)
def test_effect_changes_what_it_should_and_nothing_else(id_, nominal):
    read, truth = nominal
    with_read, with_truth = record(load("bench").with_effects(default(id_)), duty(), seed=3)
    states, readings = CHANGES[id_]
    assert changed(truth, with_truth) == states
    assert changed(read, with_read) == readings


@pytest.mark.parametrize("name", MODEL_NAMES)
def test_mismatch_changes_what_its_number_should_and_nothing_else(name, nominal):
    read, truth = nominal
    base = load("bench")
    off = 1.05 * base.model[name] if base.model[name] else 1e-6
    model = base.with_effects({PARAMETER_MISMATCH: {name: off}})
    with_read, with_truth = record(model, duty(), seed=3)
    states, readings = NUMBERS[name]
    assert changed(truth, with_truth) == states
    assert changed(read, with_read) == readings
    replaced = type(base)("same", {**base.model, name: off}, base.sensing)
    again, _ = record(replaced, duty(), seed=3)
    assert not changed(again, with_read)


@pytest.mark.parametrize("id_", CATALOGUE)
def test_effect_of_no_size_is_the_nominal_model_to_the_last_bit(id_, nominal):
    read, truth = nominal
    assert not is_active(id_, neutral(id_)[id_])
    with_read, with_truth = record(load("bench").with_effects(neutral(id_)), duty(), seed=3)
    assert not changed(truth, with_truth)
    assert not changed(read, with_read)


def test_mismatch_of_no_size_is_the_nominal_model_to_the_last_bit(nominal):
    read, truth = nominal
    model = load("bench").with_effects({PARAMETER_MISMATCH: dict(load("bench").model)})
    with_read, with_truth = record(model, duty(), seed=3)
    assert not changed(truth, with_truth)
    assert not changed(read, with_read)


@pytest.mark.parametrize("other", ["supply_sag", "brush_drop", "rotor_friction", "thrust_lag", "coulomb_friction",
                                   "mast_flex", "encoder_lag", "speed_spikes"])
def test_effect_of_no_size_changes_no_bit_beside_another(other):
    short = duty()[:1500]
    read, truth = record(load("bench").with_effects(default(other)), short, seed=3)
    for id_ in CATALOGUE:
        if id_ == other:
            continue
        with_read, with_truth = record(load("bench").with_effects({**default(other), **neutral(id_)}), short, seed=3)
        assert not changed(truth, with_truth), id_
        assert not changed(read, with_read), id_


@pytest.mark.parametrize("other", ["thrust_exponent", "angle_offset"])
def test_effect_beside_another_changes_only_what_it_should(other):
    """What is upstream of an effect stays as it is, also when the compiled equations hold another effect."""
    short = duty()[:1500]
    base = default(other)
    read, truth = record(load("bench").with_effects(base), short, seed=3)
    for id_ in CATALOGUE:
        if id_ == other:
            continue
        with_read, with_truth = record(load("bench").with_effects({**base, **default(id_)}), short, seed=3)
        assert changed(truth, with_truth) <= CHANGES[id_][0], id_
        assert changed(read, with_read) <= CHANGES[id_][1], id_


@pytest.mark.parametrize("id_", CATALOGUE)
def test_default_size_is_visible(id_):
    """More than three times the resolution and the noise, in at least one channel; a speed has about 0.5 rad/s."""
    base = load("bench")
    s = base.sensing
    quiet = {**s, "angle_noise": 0.0, "angle_lsb": 0.0, "current_noise": 0.0, "current_lsb": 0.0, "voltage_noise": 0.0,
             "voltage_lsb": 0.0, "speed_pulses_per_rev": 0.0}
    read, with_read = (record(Model("quiet", base.model, quiet, effects), duty(), seed=3)[0]
                       for effects in ({}, default(id_)))
    floor = {"theta": max(s["angle_lsb"], s["angle_noise"]), "omega": 0.5,
             "i_a": max(s["current_lsb"], s["current_noise"]), "v_a": max(s["voltage_lsb"], s["voltage_noise"])}
    visible = {name for name in read if np.abs(with_read[name] - read[name]).max() > 3.0 * floor[name]}
    assert visible


def test_values_hold_the_active_effects_of_the_equations():
    assert values({}) is None
    assert values(neutral("thrust_lag")) is None
    assert values(default("angle_offset")) is None
    assert values({PARAMETER_MISMATCH: {"R_a": 2.0}}) is None
    found = values({**default("winding_heating"), **neutral("thrust_lag")})
    assert found.winding_heating_gain == 0.02
    assert found.thrust_lag_tau == 0.0
    assert found.thrust_exponent_n == 2.0


def any_effects():
    one = {id_: st.fixed_dictionaries({name: st.floats(p.low, p.high) for name, p in effect.parameters.items()})
           for id_, effect in CATALOGUE.items()}
    return st.fixed_dictionaries({}, optional=one)


@settings(max_examples=200)
@given(effects=any_effects(), seed=st.integers(0, 2**32 - 1), period=st.sampled_from([SAMPLE_PERIOD, 0.02, 0.05]),
       hold=st.integers(1, 60), preset=st.sampled_from(["bench", "thesis"]))
def test_any_effects_at_any_size_give_finite_numbers(effects, seed, period, hold, preset):
    series = np.repeat(np.random.default_rng(seed).uniform(0.0, 1.0, 600 // hold + 1), hold)[:600]
    read, truth = record(load(preset).with_effects(effects), series, seed, period)
    for name, channel in [*read.items(), *truth.items()]:
        assert np.isfinite(channel).all(), name
