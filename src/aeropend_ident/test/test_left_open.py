# SPDX-License-Identifier: Apache-2.0
"""What a verdict leaves open, as the question of the next experiment."""

from dataclasses import replace

import pytest

from aeropend_ident.design.responses import asked
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.document import Since
from aeropend_ident.diagnosis.left_open import as_refitted, design_command, left_open
from aeropend_ident.diagnosis.results import document, verdict_lines
from aeropend_ident.signals.signals import from_arrays
from aeropend_sim.model import effect_file, rig
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD, load

BENCH = load("bench")


@pytest.fixture(scope="module")
def lag():
    """A short lag of the thrust, which one of the encoder imitates."""
    duty = Excitation(duration=15.0, seed=4).series()
    read, _ = rig.record(BENCH.with_effects({"thrust_lag": {"tau": 0.012}}), duty, 3)
    found = diagnose(BENCH, [from_arrays({**read, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)])
    return document(found, ["bag"], "bench", 1.0)


@pytest.mark.promise("Verdict", "What is not separable comes with the command that designs an experiment for it")
def test_what_is_not_separable_is_asked_next(lag):
    open_ = left_open(lag)
    assert set(open_.names) == {"thrust_lag", "encoder_lag"}
    assert open_.sizes["thrust_lag"] == pytest.approx(0.012, rel=0.3)
    command = design_command(lag)
    assert command.startswith("design --model bench --separate ")
    assert any(line.endswith(command) for line in verdict_lines(lag))


def test_where_nothing_is_open_nothing_is_asked(lag):
    closed = replace(lag, which=replace(lag.which, not_separable=()))
    assert left_open(closed).names == ()
    assert design_command(closed) == ""


def test_no_command_is_given_for_a_rig_without_a_model_file_or_an_effect_of_a_file(lag):
    """After --since the model is that of an earlier verdict; `design` knows the effects of the catalogue."""
    assert design_command(replace(lag, since=Since(("monday",), (), {}, ()))) == ""
    row = next(c for c in lag.which.candidates if c.effect == "encoder_lag")
    others = [c for c in lag.which.candidates if c.effect != "encoder_lag"]
    of_a_file = replace(lag.which, not_separable=(("thrust_lag", "my_hose"),),
                        candidates=(*others, replace(row, effect="my_hose")))
    effect_file.define({"my_hose": {"place": "arm", "physics": "a hose", "term": "-k * theta", "parameters": {
        "k": {"unit": "1/s²", "default": 1.0, "low": 0.0, "high": 9.0}}}}, "here")
    try:
        assert set(left_open(replace(lag, which=of_a_file)).names) == {"thrust_lag", "my_hose"}
        assert design_command(replace(lag, which=of_a_file)) == ""
    finally:
        effect_file.forget("my_hose")


def test_an_experiment_is_designed_for_a_rig_that_has_what_is_sure():
    """Friction that nothing imitates, beside a lag that something does."""
    duty = Excitation(duration=20.0, seed=4).series()
    both = {"thrust_lag": {"tau": 0.008}, "coulomb_friction": {"accel": 0.4}}
    read, _ = rig.record(BENCH.with_effects(both), duty, 3)
    found = diagnose(BENCH, [from_arrays({**read, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)])
    made = document(found, ["bag"], "bench", 1.0)
    assert "coulomb_friction" not in left_open(made).names
    model = as_refitted(BENCH, made)
    assert set(model.effects) == {"coulomb_friction"}
    assert model.effects["coulomb_friction"]["accel"] == pytest.approx(0.4, rel=0.1)
    effects = asked(model, sizes=left_open(made).sizes)
    assert "coulomb_friction" not in effects
    assert set(left_open(made).names) <= set(effects)


def test_an_experiment_is_designed_for_the_numbers_that_were_fitted(lag):
    model = as_refitted(BENCH, lag)
    assert model.model["k_thrust"] == lag.which.numbers["k_thrust"].value
    assert model.sensing == BENCH.sensing
