# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from aeropend_sim.model import actuator, dynamics
from aeropend_sim.model.parameters import PRESETS, SAMPLE_PERIOD, Model, load

BENCH, THESIS = (load(preset).model for preset in ("bench", "thesis"))
presets = st.sampled_from([BENCH, THESIS])
speeds = st.floats(-400.0, 400.0)


def first_duty(numbers):
    """Below it the map gives no voltage."""
    return ((numbers["k0"] / numbers["k1"])**2 - numbers["k3"]) / numbers["k2"]


@given(numbers=presets, duty=st.floats(0.0, 1.0))
def test_duty_is_the_inverse_of_voltage(numbers, duty):
    v = float(actuator.voltage(numbers, duty))
    back = float(actuator.duty(numbers, v))
    if v > 0.0:
        assert back == pytest.approx(duty, abs=1e-12)
    else:
        assert back == 0.0
        assert duty <= first_duty(numbers) + 1e-15


@given(numbers=presets, share=st.floats(1e-6, 1.0))
def test_voltage_is_the_inverse_of_duty(numbers, share):
    v = share * float(actuator.voltage(numbers, 1.0))
    assert float(actuator.voltage(numbers, actuator.duty(numbers, v))) == pytest.approx(v, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("preset", PRESETS)
def test_dead_zone_and_limits(preset):
    numbers = load(preset).model
    edge = first_duty(numbers)
    assert 0.005 < edge < 0.02
    assert not actuator.voltage(numbers, np.array([0.0, 0.5 * edge, edge * (1.0 - 1e-9)])).any()
    assert actuator.voltage(numbers, edge * (1.0 + 1e-6)) > 0.0
    assert actuator.duty(numbers, -1.0) == actuator.duty(numbers, 0.0) == 0.0
    assert actuator.duty(numbers, 1e-9) == pytest.approx(edge, rel=1e-6)
    assert actuator.duty(numbers, 99.0) == 1.0


@given(numbers=presets, speed=speeds)
def test_speed_is_the_inverse_of_thrust(numbers, speed):
    f = actuator.thrust(numbers, speed)
    assert np.sign(f) == np.sign(speed) or f == 0.0
    assert float(actuator.speed(numbers, f)) == pytest.approx(speed, rel=1e-12, abs=1e-120)


@given(numbers=presets, speed=st.floats(0.0, 400.0))
def test_speed_at_is_the_inverse_of_voltage_at(numbers, speed):
    v = actuator.voltage_at(numbers, speed)
    assert float(actuator.speed_at(numbers, v)) == pytest.approx(speed, rel=1e-12, abs=1e-300)


@given(numbers=presets, speed=speeds)
def test_current_at_balances_the_torques(numbers, speed):
    i = float(actuator.current_at(numbers, speed))
    load_torque = numbers["B_m"] * speed + numbers["k_load"] * speed * abs(speed)
    assert numbers["K_t"] * i == pytest.approx(load_torque, rel=1e-12, abs=1e-300)


@given(numbers=presets, duty=st.floats(0.0, 1.0))
def test_static_angle_balances_the_weight(numbers, duty):
    angle = float(actuator.static_angle(numbers, duty))
    f = float(actuator.thrust(numbers, actuator.speed_at(numbers, actuator.voltage(numbers, duty))))
    lift = numbers["L_over_J"] * f
    if lift > numbers["mgd_over_J"]:
        assert math.isnan(angle)
    else:
        assert numbers["mgd_over_J"] * math.sin(angle) == pytest.approx(lift, rel=1e-9, abs=1e-12)


def test_bench_can_lift_the_arm_over_the_top_and_thesis_cannot():
    assert np.isnan(actuator.static_angle(BENCH, 1.0))
    assert actuator.static_angle(THESIS, 1.0) < 1.6


def test_scalars_and_arrays_alike():
    a = actuator
    for function, value in ((a.voltage, 0.3), (a.thrust, 99.0), (a.current_at, 99.0), (a.voltage_at, 99.0),
                            (a.speed_at, 1.1), (a.static_angle, 0.3)):
        one = function(BENCH, value)
        many = function(BENCH, np.full(6, value))
        assert np.shape(one) == ()
        assert many.shape == (6,)
        assert (many == one).all()


DUTY = np.concatenate([np.full(50, 0.1), np.full(50, 0.8), np.full(50, 0.02), np.full(50, 0.5)])


def acting(effects, **options):
    return actuator.acting_voltage(BENCH, DUTY, effects, SAMPLE_PERIOD, **options)


def test_no_effect_is_the_map():
    assert np.array_equal(acting({}), actuator.voltage(BENCH, DUTY))


def test_bridge_drop_never_turns_the_voltage():
    v = acting({"bridge_drop": {"v_drop": 0.2}})
    assert v == pytest.approx(np.maximum(0.0, actuator.voltage(BENCH, DUTY) - 0.2))
    assert v.min() == 0.0


def test_supply_drift_counts_from_the_start():
    v = acting({"supply_drift": {"rate": 0.01}}, start=1000)
    time = (1000 + np.arange(len(DUTY))) * SAMPLE_PERIOD
    assert v == pytest.approx(actuator.voltage(BENCH, DUTY) * (1.0 - 0.01 * time))


def test_supply_drift_ends_at_an_empty_battery():
    assert not acting({"supply_drift": {"rate": 0.02}}, start=100_000).any()


def current(v, delay=0.0):
    """Current at the end of each hold in a winding at rest, of its response to each step of the voltage, exactly."""
    steps, ends = np.diff(v, prepend=0.0), np.arange(1, len(v) + 1) * SAMPLE_PERIOD
    past = np.maximum(0.0, ends[:, None] - (np.arange(len(v)) * SAMPLE_PERIOD + delay))
    return -np.expm1(-past * BENCH["R_a"] / BENCH["L_a"]) @ steps / BENCH["R_a"]


@given(delay=st.floats(0.0, 0.5))
@example(delay=2.5 * SAMPLE_PERIOD)
def test_delay_leads_the_winding_where_a_switch_within_the_hold_does(delay):
    late = acting({"command_delay": {"delay": delay}})
    assert current(late) == pytest.approx(current(actuator.voltage(BENCH, DUTY), delay), abs=1e-9)


@pytest.mark.parametrize("part", [0.2, 0.5, 0.9])
def test_delay_within_a_long_hold_turns_the_rotor_as_late_as_over_short_holds(part):
    period, fine = 0.02, 40
    late = Model("late", BENCH, load("bench").sensing, {"command_delay": {"delay": (3.0 + part) * period}})
    duty = np.repeat([0.1, 0.6, 0.3], 25)
    coarse, true = (dynamics.simulate(late, np.repeat(duty, n), period / n).omega[::n] for n in (1, fine))
    of_delay = true - dynamics.simulate(late.with_effects({}), duty, period).omega
    assert np.abs(coarse - true).max() < 0.06 * np.abs(of_delay).max()


@given(whole=st.integers(0, 40), part=st.floats(0.01, 0.99), before=st.floats(0.0, 1.0))
def test_sample_within_a_delay_still_reads_the_old_voltage(whole, part, before):
    drop = {"bridge_drop": {"v_drop": 0.1}}
    late = {"command_delay": {"delay": (whole + part) * SAMPLE_PERIOD}, **drop}
    read = actuator.sampled_voltage(BENCH, DUTY, late, SAMPLE_PERIOD, before=before)
    known = np.concatenate([np.full(whole + 1, before), DUTY])[:len(DUTY)]
    assert read == pytest.approx(np.maximum(0.0, actuator.voltage(BENCH, known) - 0.1), abs=1e-12)


@pytest.mark.parametrize("effects", [{}, {"command_delay": {"delay": 7.0 * SAMPLE_PERIOD}}])
def test_sample_reads_what_acts_where_nothing_switches_within_a_hold(effects):
    assert np.array_equal(actuator.sampled_voltage(BENCH, DUTY, effects, SAMPLE_PERIOD), acting(effects))


def test_delay_of_whole_periods_shifts():
    late = acting({"command_delay": {"delay": 7.0 * SAMPLE_PERIOD}})
    assert late[7:] == pytest.approx(actuator.voltage(BENCH, DUTY)[:-7], abs=1e-12)
    assert not late[:7].any()


def test_before_is_what_acts_until_the_first_duty_comes():
    late = acting({"command_delay": {"delay": 7.0 * SAMPLE_PERIOD}, "bridge_drop": {"v_drop": 0.2}}, before=0.6)
    assert late[:6] == pytest.approx(np.full(6, float(actuator.voltage(BENCH, 0.6)) - 0.2))


def test_order_of_the_actuators_effects():
    """The duty comes late; it meets the battery as it is by then; the bridge takes its drop of what comes."""
    effects = {"command_delay": {"delay": 20.0 * SAMPLE_PERIOD}, "supply_drift": {"rate": 0.02},
               "bridge_drop": {"v_drop": 0.2}}
    k = np.arange(20, len(DUTY))
    expected = actuator.voltage(BENCH, DUTY[k - 20]) * (1.0 - 0.02 * k * SAMPLE_PERIOD) - 0.2
    assert acting(effects)[k] == pytest.approx(np.maximum(0.0, expected), abs=1e-12)


@pytest.mark.parametrize("neutral", [{"bridge_drop": {"v_drop": 0.0}}, {"supply_drift": {"rate": 0.0}},
                                     {"command_delay": {"delay": 0.0}}])
def test_effects_of_no_size_change_no_bit(neutral):
    others = {"bridge_drop": {"v_drop": 0.1}, "supply_drift": {"rate": 0.01}, "command_delay": {"delay": 0.0123}}
    assert np.array_equal(acting(neutral), acting({}))
    rest = {id_: p for id_, p in others.items() if id_ not in neutral}
    assert np.array_equal(acting({**rest, **neutral}), acting(rest))


def test_the_supply_sags_by_its_resistance_times_the_current():
    model = load("bench").with_effects({"supply_sag": {"r_supply": 0.5}})
    duty = np.repeat([0.2, 0.8, 0.4], 100)
    run = dynamics.simulate(model, duty)
    open_circuit = actuator.sampled_voltage(model.numbers(), duty, model.effects, SAMPLE_PERIOD)
    assert np.array_equal(actuator.terminal_voltage(model, open_circuit, run.i_a), run.v_a)
    assert actuator.terminal_voltage(load("bench"), 5.0, 2.0) == 5.0


LINEAR = {**BENCH, **dict.fromkeys(("k0", "k1", "k2", "k3"), 0.0), "v_full": 12.0}


def test_a_bridge_without_losses_is_a_straight_line():
    assert actuator.voltage(LINEAR, np.array([0.0, 0.25, 1.0])).tolist() == [0.0, 3.0, 12.0]
    assert [actuator.duty(LINEAR, v) for v in (0.0, 3.0, 12.0, 15.0)] == [0.0, 0.25, 1.0, 1.0]


@pytest.mark.parametrize("numbers", [BENCH, LINEAR])
def test_a_duty_below_0_brakes_or_reverses(numbers):
    forward = actuator.voltage(numbers, 0.4)
    assert actuator.voltage(numbers, -0.4) == 0.0
    assert actuator.duty(numbers, -1.0) == 0.0
    both = {**numbers, "reverse": 0.8}
    assert actuator.voltage(both, -0.4) == pytest.approx(-0.8 * forward)
    assert actuator.duty(both, -0.8 * forward) == pytest.approx(-0.4)
    assert actuator.voltage(both, 0.4) == forward


def test_the_drop_of_the_bridge_is_against_the_voltage_in_both_directions():
    both = {**LINEAR, "reverse": 1.0}
    drop = {"bridge_drop": {"v_drop": 0.5}}
    v = actuator.acting_voltage(both, np.array([0.5, -0.5, 0.02, -0.02]), drop, SAMPLE_PERIOD)
    assert v == pytest.approx([5.5, -5.5, 0.0, 0.0])


def test_steady_speed_is_odd():
    v = np.array([0.5, 2.0])
    assert actuator.speed_at(BENCH, -v).tolist() == (-actuator.speed_at(BENCH, v)).tolist()
