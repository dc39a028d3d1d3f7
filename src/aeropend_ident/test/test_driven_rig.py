# SPDX-License-Identifier: Apache-2.0
"""The nominal model of a driven rig with angle and command alone, in the rig's own units."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from aeropend_ident.diagnosis.chain.driven_rig import Units, fit_driven_rig, fit_own, units_of
from aeropend_ident.diagnosis.chain.hanging import mounted
from aeropend_ident.diagnosis.chain.priors import DAMPING_RATIO
from aeropend_ident.diagnosis.chain.values import AT_REST, at_rest, with_values
from aeropend_ident.diagnosis.chain.weak_start import FULL, curve
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.signals.from_bag import end_of_motion
from aeropend_ident.signals.signals import Signals, from_arrays
from aeropend_ident.testing.rigs import BENCH
from aeropend_sim.model import actuator, dynamics
from aeropend_sim.model.parameters import DUTY_MAP, Model

PERIOD, NOISE = 0.01, 0.001


def driven(numbers=None, effects=None, seconds=25.0, hold=(0.5, 3.0), seed=0, sign=1.0, zero=0.0) -> Signals:
    """Angle and command of a rig that steps of the duty drive."""
    rng = np.random.default_rng(seed)
    model = Model("rig", {**BENCH.model, **(numbers or {})}, BENCH.sensing, effects or {})
    duty = np.zeros(round(seconds / PERIOD))
    k = round(hold[0] / PERIOD)
    while k < len(duty):
        n = round(rng.uniform(*hold) / PERIOD)
        duty[k:k + n] = rng.choice([0.0, 1.0], p=[0.2, 0.8]) * rng.uniform(0.1, 0.5)
        k += n
    theta = dynamics.simulate(model, duty, PERIOD).theta + zero + NOISE * rng.standard_normal(len(duty))
    return recorded(sign * theta, duty)


def recorded(theta, duty) -> Signals:
    nothing = np.full(len(duty), np.nan)
    columns = {"theta": theta, "omega": nothing, "i_a": nothing, "v_a": nothing, "duty": duty}
    return from_arrays(columns, PERIOD, {**BENCH.sensing, "angle_lsb": 0.0})


def test_a_model_comes_back_from_other_units_as_it_was():
    units = Units(3.0, 0.4)
    model = BENCH.with_effects({"coulomb_friction": {"accel": 0.8}, "command_delay": {"delay": 0.03}})
    back = units.model(units.model(model), back=True)
    assert back.model == pytest.approx(model.model)
    assert {e: dict(p) for e, p in back.effects.items()} == {
        "coulomb_friction": pytest.approx({"accel": 0.8}), "command_delay": pytest.approx({"delay": 0.03})}


@cache
def with_friction() -> tuple[Signals, Model]:
    """Angle and command of a rig with dry friction, and the model that is fitted to them."""
    s = driven(effects={"coulomb_friction": {"accel": 0.8}})
    return s, fit_driven_rig(BENCH, [s]).model


@pytest.mark.promise("Uncalibrated rigs", "The scale of the duty column and that of time do not change what is found")
@pytest.mark.parametrize(("time", "duty"), [(4.0, 0.1), (0.25, 1.8)])
def test_the_scale_of_duty_and_time_changes_the_units_alone(time, duty):
    s, one = with_friction()
    other = replace(s, period=time * s.period, duty=duty * s.duty)
    two = fit_driven_rig(BENCH, [other]).model
    assert two.model["mgd_over_J"] * time**2 == pytest.approx(one.model["mgd_over_J"], rel=0.03)
    assert two.model["c_over_J"] * time == pytest.approx(one.model["c_over_J"], rel=0.06)
    assert two.effect("coulomb_friction", "accel") * time**2 == pytest.approx(0.8, rel=0.05)
    assert units_of(BENCH, [other]).time * time == pytest.approx(units_of(BENCH, [s]).time, rel=0.3)


@pytest.mark.parametrize("friction", [0.0, 0.6, 1.0])
def test_dry_friction_does_not_hide_gravity_when_the_scale_of_time_is_found(friction):
    numbers = {"mgd_over_J": 8.5, "c_over_J": 1.0, "L_over_J": BENCH.model["L_over_J"] * 8.5 / 33.8}
    s = driven(numbers, {"coulomb_friction": {"accel": friction}}, seconds=60.0, hold=(1.0, 4.0))
    assert 33.8 * units_of(BENCH, [s]).time ** 2 == pytest.approx(8.5, rel=0.3)


@pytest.mark.promise("Uncalibrated rigs", "Dry friction of a slow rig is found within some percent")
@pytest.mark.parametrize(("gravity", "friction"), [(1.7, 0.03), (4.3, 0.05)])
def test_dry_friction_of_a_slow_rig_is_found(gravity, friction):
    numbers = {"mgd_over_J": gravity, "c_over_J": 0.2, "L_over_J": BENCH.model["L_over_J"] * gravity / 33.8}
    s = driven(numbers, {"coulomb_friction": {"accel": friction}}, seconds=60.0, hold=(2.0, 9.0))
    found = diagnose(BENCH, [s], fit_nominal=True)
    assert found.body["which"]["effects"] == ["coulomb_friction"]
    assert found.augmented.effect("coulomb_friction", "accel") == pytest.approx(friction, rel=0.05)
    assert found.augmented.model["mgd_over_J"] == pytest.approx(gravity, rel=0.02)


@pytest.mark.promise("Uncalibrated rigs", "Dry friction that the search does not confirm stays in the model")
def test_dry_friction_that_is_not_found_as_an_effect_stays_in_the_model():
    s, _ = with_friction()
    found = diagnose(BENCH, [s], fit_nominal=True, left_out=["coulomb_friction"])
    assert found.body["which"]["verdict"] == "none"
    assert found.body["identified"]["own"]["coulomb_friction.accel"]["value"] == pytest.approx(0.8, rel=0.05)
    assert found.body["channels"]["theta"]["fit_unseen"] > 0.95


@pytest.mark.promise("Uncalibrated rigs", "Delay and zero of a rig are its own model and no effect")
def test_delay_and_zero_are_the_rigs_own():
    s = driven({}, {"command_delay": {"delay": 0.1}}, zero=0.08)
    body = diagnose(BENCH, [s], fit_nominal=True).body
    assert body["which"]["verdict"] == "none"
    assert body["identified"]["own"]["command_delay.delay"]["value"] == pytest.approx(0.1, abs=0.02)
    assert body["identified"]["hangs_at"]["value"] == pytest.approx(0.08, abs=0.005)


@pytest.mark.parametrize(("delay", "zero"), [(0.1, 0.08), (0.15, 0.05), (0.08, -0.1)])
def test_terms_that_the_static_curve_could_stand_in_for_are_found_to_the_noise(delay, zero):
    (s,) = mounted(BENCH, [driven({}, {"command_delay": {"delay": delay}}, zero=zero)])
    rig = fit_driven_rig(BENCH, [s])
    assert fit_own(rig.model, [s], state=rig.state).mean_square < 1.1
    assert set(rig.model.effects) == {"command_delay", "angle_offset"}
    assert rig.model.effect("command_delay", "delay") == pytest.approx(delay, abs=0.02)


def test_the_map_gives_nothing_at_a_duty_of_0_wherever_a_fit_goes():
    moved = with_values(BENCH, {AT_REST: -0.2, "k3": 3.0 * BENCH.model["k3"]})
    assert at_rest(moved) == pytest.approx(-0.2)
    assert actuator.voltage(moved.model, 0.0) == 0.0
    assert with_values(BENCH, {AT_REST: at_rest(BENCH)}).model == pytest.approx(BENCH.model)


LAGS = {"command_delay": {"delay": 0.1}, "thrust_lag": {"tau": 0.1}}


@pytest.mark.promise("Uncalibrated rigs", "A delay and a lag that a recording does not tell apart are said")
@pytest.mark.parametrize("id_", LAGS)
def test_a_delay_and_a_lag_that_slow_commands_do_not_tell_apart_are_said(id_):
    assert fit_driven_rig(BENCH, [driven(effects={id_: LAGS[id_]})]).notes == ()
    t = PERIOD * np.arange(2500)
    duty = 0.3 + 0.06 * np.sin(1.3 * t) + 0.05 * np.sin(2.9 * t + 1.0) + 0.04 * np.sin(0.5 * t)
    model = BENCH.with_effects({id_: LAGS[id_]})
    theta = dynamics.simulate(model, duty, PERIOD).theta + 0.02 * np.random.default_rng(0).standard_normal(len(t))
    (note,) = fit_driven_rig(BENCH, [recorded(theta, duty)]).notes
    assert all(e in note for e in LAGS)


def test_a_term_that_the_free_run_does_not_need_is_left_out():
    found = fit_driven_rig(BENCH, [driven()]).model
    assert "coulomb_friction" not in found.effects
    assert fit_own(found, [driven()]).mean_square < 1.2


@pytest.mark.promise("Uncalibrated rigs", "Zero and sign of the angle, whatever they are, are found from the motion")
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("zero", [-1.45, 0.8, 2.9, 6.9])
def test_zero_and_sign_of_the_angle_are_found_from_the_motion(sign, zero):
    s = driven(sign=sign)
    (found,) = mounted(BENCH, [replace(s, theta=s.theta + zero)])
    assert found.mounting.flipped == (sign < 0.0)
    assert found.mounting.zero == pytest.approx(zero, abs=0.05)
    assert any("hangs at a reading of" in note for note in found.notes)
    assert any("its sign is turned" in note for note in found.notes) == (sign < 0.0)
    assert np.abs(found.theta - driven().theta).max() < 0.06


def test_an_angle_that_is_read_as_it_should_be_is_not_touched():
    s = driven()
    (found,) = mounted(BENCH, [s])
    assert np.array_equal(found.theta, s.theta)
    assert found.notes == s.notes


def test_a_rig_read_upside_down_gives_the_verdict_of_the_rig():
    effects = {"coulomb_friction": {"accel": 0.8}}
    s = driven(effects=effects, sign=-1.0)
    found = diagnose(BENCH, [replace(s, theta=s.theta - 1.45)], fit_nominal=True)
    assert found.conclusions.which.effects == ("coulomb_friction",)
    identified = found.conclusions.identified
    assert identified.mounting.flipped
    assert identified.mounting.reading(0.0) == pytest.approx(-1.45, abs=0.05)


@pytest.mark.promise("Uncalibrated rigs", "A model that does not predict the unseen part names no effect")
def test_no_effect_is_named_where_the_unseen_part_is_not_predicted():
    s = driven(effects={"coulomb_friction": {"accel": 0.8}})
    other = s.theta.copy()
    other[s.train:] = 2.0 * np.mean(other[s.train:]) - other[s.train:]
    body = diagnose(BENCH, [replace(s, theta=other)], fit_nominal=True).body
    assert (body["which"]["verdict"], body["which"]["effects"]) == ("cannot_tell", [])
    assert "does not predict the rig" in body["which"]["unexplained"][0]
    assert not any(c["found"] for c in body["which"]["candidates"])


def test_a_rest_at_the_end_is_left_out_and_one_between_is_not():
    duty = np.repeat([0.0, 0.4, 0.0], [100, 400, 500])
    theta = np.where(duty > 0.0, 0.5, 0.0) + 0.001 * np.random.default_rng(0).standard_normal(1000)
    assert end_of_motion(theta, duty, 0.001, 0.3) == pytest.approx(525, abs=2)
    assert end_of_motion(theta[:560], duty[:560], 0.001, 0.3) == 0
    assert end_of_motion(np.roll(theta, 400), np.roll(duty, 400), 0.001, 0.3) == 0


def test_an_arm_that_lies_at_the_end_of_its_range_rests_whatever_the_duty_does():
    """A motor that turns backward presses the arm onto its rest: the duty has a ramp there."""
    duty = np.concatenate([np.repeat([0.0, 0.4], [100, 400]), np.linspace(-0.4, 0.0, 500)])
    theta = np.where(duty > 0.0, 0.5, 0.0) + 0.001 * np.random.default_rng(0).standard_normal(1000)
    assert end_of_motion(theta, duty, 0.001, 0.3) == pytest.approx(525, abs=2)
    held = np.concatenate([0.25 + 0.25 * np.cos(np.linspace(0.0, 20.0, 500)), np.full(500, 0.25)])  # between the ends
    assert end_of_motion(held, duty, 0.001, 0.3) == 0


@pytest.mark.promise("Uncalibrated rigs", "A thrust that falls more slowly than it rises is the rig's own model")
def test_a_lag_that_differs_between_rise_and_fall_is_found():
    s = driven({}, {"thrust_lag": {"tau": 0.1, "fall": 4.0}}, seconds=40.0)
    body = diagnose(BENCH, [s], fit_nominal=True).body
    assert body["which"]["verdict"] == "none"
    assert body["identified"]["own"]["thrust_lag.fall"]["value"] == pytest.approx(4.0, rel=0.3)
    assert body["channels"]["theta"]["fit_unseen"] > 0.95


def test_little_is_simulated_once_the_time_is_up(monkeypatch):
    runs, run_arm = [], dynamics.run_arm
    monkeypatch.setattr(dynamics, "run_arm", lambda *arguments: runs.append(1) or run_arm(*arguments))
    found = diagnose(BENCH, [driven(effects={"coulomb_friction": {"accel": 0.8}})], 1, fit_nominal=True, seconds=0.0)
    assert len(runs) < 1000  # six thousand without a limit
    assert any(note.startswith("the nominal model was identified without dry friction")
               for note in found.signals[0].notes)
    assert found.body["which"]["verdict"] == "cannot_tell"


def test_an_arm_that_rests_at_first_gives_its_zero_to_a_reading():
    s = driven()
    rest = round(0.5 / s.period)
    theta = np.concatenate([np.zeros(rest), s.theta]) + 1.2
    resting = recorded(theta, np.concatenate([np.zeros(rest), s.duty]))
    (found,) = mounted(BENCH, [resting])
    assert found.mounting.zero == 1.2


def test_a_command_that_explains_nothing_does_not_turn_the_sign():
    s = driven()
    other = replace(s, duty=0.3 + 0.1 * np.sin(5.0 * np.arange(len(s)) * s.period))
    (found,) = mounted(BENCH, [other])
    assert not found.mounting.flipped


@pytest.mark.parametrize("own", [{}, {**dict.fromkeys(DUTY_MAP, 0.0), "v_full": 3.0}])
def test_a_static_curve_is_that_of_its_duties_also_of_a_model_without_a_map(own):
    numbers = curve({**BENCH.model, **own}, 0.2, 0.1, 0.5, 0.1)
    assert actuator.voltage(numbers, np.array([0.2, 1.0])) == pytest.approx([0.0, FULL], abs=1e-12)


def test_an_arm_that_rests_at_first_tells_its_zero_also_where_few_samples_hold_a_reading():
    s = driven(zero=0.06)
    theta = np.where(np.arange(len(s)) % 5 == 0, s.theta, np.nan)
    (found,) = mounted(BENCH, [replace(s, theta=theta)])
    assert found.hanging == pytest.approx(0.06, abs=0.002)


def in_closed_loop(damping: float, seed: int, size: float = 2.0, correlated: float = 0.5) -> Signals:
    """Angle and command of an arm in a gust of `size` rad/s² that a controller answers; no equation of the package."""
    rng = np.random.default_rng(seed)
    theta = speed = lift = integral = gust = 0.0
    angles, duties = [], []
    for k in range(2500):
        reading = theta + NOISE * rng.standard_normal()
        error = (0.0 if k < 50 else 0.5 if k < 1200 else 0.7) - reading
        integral += PERIOD * error
        duty = min(max(0.25 * error + 0.3 * integral - 0.05 * speed, 0.0), 1.0)
        angles.append(reading)
        duties.append(duty)
        gust += -PERIOD / correlated * gust + size * np.sqrt(2.0 * PERIOD / correlated) * rng.standard_normal()
        lift += PERIOD * (duty - lift) / 0.15
        acts = gust if k >= 50 else 0.0
        speed += PERIOD * (-33.8 * np.sin(theta) - damping * speed + 60.0 * lift + acts)
        theta += PERIOD * speed
    return recorded(np.array(angles), np.array(duties))


@pytest.mark.promise("Uncalibrated rigs", "A disturbance that a controller answers does not make the damping 0")
@pytest.mark.parametrize("seed", [0, 2])
def test_a_disturbance_that_a_controller_answers_does_not_make_the_damping_zero(seed):
    (s,) = mounted(BENCH, [in_closed_loop(0.8, seed)])
    found = fit_driven_rig(BENCH, [s]).model.model
    assert found["c_over_J"] > 2.0 * 0.1 * DAMPING_RATIO * math.sqrt(found["mgd_over_J"])  # 95 % of the prior
