# SPDX-License-Identifier: Apache-2.0
"""Rigs whose motor is driven both ways, and rigs whose input is a voltage."""

from dataclasses import replace

import numpy as np
import pytest
from readings import recording

from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.signals.from_bag import RecordingError, as_signals
from aeropend_sim.model import rig
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD, from_flat, load

BENCH = load("bench")
LINEAR = from_flat({"model.v_full": 2.4, "model.reverse": 1.0}, base=BENCH)
DUTY = Excitation(duration=36.0, seed=4, duty_min=-0.5, duty_max=0.6).series()
T = np.arange(len(DUTY)) * SAMPLE_PERIOD
FRICTION = 0.8


def off(model, seed):
    """A rig whose numbers are up to 3 % off those of its model file."""
    rng = np.random.default_rng(seed)
    return replace(model, model={name: value * (1.0 + 0.03 * rng.uniform(-1.0, 1.0)) if name != "reverse" else value
                                 for name, value in model.model.items()})


@pytest.fixture(scope="module")
def driven():
    """Readings of a rig with dry friction that is driven both ways, by channel."""
    true = off(LINEAR, 3).with_effects({"coulomb_friction": {"accel": FRICTION}})
    read, _ = rig.record(true, DUTY, 5)
    return read


def found(driven, channels, model, *, fit_nominal=False):
    """What a diagnosis says if only some channels were recorded; "duty" is one of them."""
    given = {name: DUTY if name == "duty" else driven[name] for name in channels}
    s = as_signals(recording(T, driven["theta"], given.pop("duty", None), **given), model, fit_nominal=fit_nominal)
    diagnosis = diagnose(model, [s], fit_nominal=fit_nominal)
    return s, diagnosis.conclusions


def assert_friction(conclusions, rel=0.03):
    which = conclusions.which
    assert which.effects == ("coulomb_friction",)
    (size,) = [c.parameters["accel"] for c in which.candidates if c.found]
    assert size.value == pytest.approx(FRICTION, rel=rel)
    return size


@pytest.mark.promise("Verdict", "A motor that is driven both ways, and a bridge without losses, are part of the model")
def test_an_effect_of_a_rig_that_is_driven_both_ways(driven):
    s, conclusions = found(driven, ("duty", "i_a", "v_a", "omega"), LINEAR)
    assert_friction(conclusions)
    assert not s.has("omega")
    assert any("driven both ways, and its speed is read without a sign" in note for note in s.notes)


@pytest.mark.promise("Verdict", "A measured voltage is the input of a calibrated rig whose model has `v_full`")
def test_a_measured_voltage_is_the_input_of_a_calibrated_rig(driven):
    s, conclusions = found(driven, ("v_a", "i_a"), LINEAR)
    assert_friction(conclusions)
    np.testing.assert_allclose(s.duty, driven["v_a"] / 2.4, atol=1e-12)


def test_a_voltage_beyond_full_duty_is_refused_in_one_line(driven):
    weak = from_flat({"model.v_full": 1.0}, base=LINEAR)
    with pytest.raises(RecordingError, match=r"reaches .* V, more than the 1 V of full duty: correct v_full"):
        found(driven, ("v_a",), weak)


@pytest.mark.parametrize("channels", [("duty", "i_a", "v_a"), ("duty",), ("v_a",)])
def test_a_rig_that_nobody_calibrated_is_identified_both_ways(driven, channels):
    _, conclusions = found(driven, channels, BENCH, fit_nominal=True)
    size = assert_friction(conclusions, rel=0.02)  # of six seeds of the noise each is 0.1 to 0.5 % too large
    assert size.low < FRICTION < size.high
    numbers = conclusions.which.numbers
    assert numbers["reverse"].value == pytest.approx(1.0, abs=0.05)
    if "i_a" in channels:
        assert numbers["v_full"].value == pytest.approx(off(LINEAR, 3).model["v_full"], rel=1e-3)


def test_a_rig_that_nobody_calibrated_is_identified_both_ways_by_a_speed_with_a_sign():
    true = off(LINEAR, 3).with_effects({"coulomb_friction": {"accel": FRICTION}})
    read, truth = rig.record(true, DUTY, 5)
    speed = truth["omega"] + 0.5 * np.random.default_rng(0).standard_normal(len(T))
    _, conclusions = found({**read, "omega": speed}, ("duty", "omega"), BENCH, fit_nominal=True)
    assert_friction(conclusions)


def test_a_speed_may_have_the_sign_of_the_command_though_it_is_held_from_pulse_to_pulse():
    read, truth = rig.record(off(LINEAR, 3).with_effects({"coulomb_friction": {"accel": FRICTION}}), DUTY, 5)
    signed = np.copysign(read["omega"], truth["omega"])
    s, conclusions = found({**read, "omega": signed}, ("duty", "i_a", "v_a", "omega"), LINEAR)
    assert s.pulses is not None
    assert not s.pulses.false.any()
    assert_friction(conclusions)
    sampled = as_signals(recording(T, read["theta"], DUTY, omega=truth["omega"]), LINEAR)
    assert sampled.pulses is None
    assert any("omega goes below 0 and is not held" in note for note in sampled.notes)


def test_a_duty_below_0_brakes_where_the_model_does_not_reverse(driven):
    one_way = from_flat({"model.reverse": 0.0}, base=LINEAR)
    s = as_signals(recording(T, driven["theta"], DUTY, v_a=driven["v_a"]), one_way)
    assert any("the bridge of this model brakes there" in note for note in s.notes)
