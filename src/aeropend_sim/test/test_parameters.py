# SPDX-License-Identifier: Apache-2.0
import json
import os
import subprocess
import sys
from importlib.resources import files

import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeropend_sim.model import effect_file
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import (
    MODEL_NAMES,
    PARAMETERS,
    PRESETS,
    SENSING_NAMES,
    Model,
    ModelError,
    from_flat,
    load,
    save,
    to_flat,
    with_definitions,
)

BENCH = (files("aeropend_sim") / "config" / "bench.yaml").read_text(encoding="utf-8")
MISMATCH = {"parameter_mismatch": {"R_a": 1.3}}


def numbers(model):
    return model.model, model.sensing, model.effects


def in_range(low, high):
    return st.floats(low, high, allow_nan=False)


def effect_sets():
    """Any number of effects, every parameter anywhere in its range."""
    one = {id_: st.fixed_dictionaries({name: in_range(p.low, p.high) for name, p in effect.parameters.items()})
           for id_, effect in CATALOGUE.items()}
    return st.fixed_dictionaries({}, optional=one)


@st.composite
def models(draw):
    base = {key: draw(in_range(p.low, p.high)) for key, p in PARAMETERS.items()}
    model = from_flat(base)
    return Model("any", model.model, model.sensing, draw(effect_sets()))


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_load(preset):
    model = load(preset)
    assert model.name == preset
    assert set(model.model) == set(MODEL_NAMES)
    assert set(model.sensing) == set(SENSING_NAMES)
    assert not model.effects


def test_every_number_has_a_unit_a_range_and_a_meaning():
    for key, p in PARAMETERS.items():
        assert key.split(".")[0] in ("model", "sensing")
        assert p.unit
        assert p.description
        assert p.low < p.high


@given(model=models())
def test_save_and_load_keep_every_bit(model, tmp_path_factory):
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    save(model, path, "a comment\nof two lines")
    assert path.read_text(encoding="utf-8").startswith("# a comment\n# of two lines\n/**:\n")
    assert numbers(load(path)) == numbers(model)


@given(model=models())
def test_flat_and_back(model):
    assert numbers(from_flat(to_flat(model))) == numbers(model)


def test_save_keeps_a_mismatch(tmp_path):
    model = load("bench").with_effects(MISMATCH)
    save(model, tmp_path / "m.yaml")
    again = load(tmp_path / "m.yaml")
    assert again.effects == MISMATCH
    assert again.numbers()["R_a"] == 1.3
    assert again.model["R_a"] == 1.08


def test_a_bridge_without_losses_needs_no_duty_map(tmp_path):
    path = tmp_path / "m.yaml"
    save(from_flat({"model.v_full": 12.0}, base=load("bench")), path)
    text = path.read_text(encoding="utf-8")
    assert "v_full: 12.0" in text
    assert not [name for name in ("k0", "k1", "k2", "k3", "reverse") if f"{name}:" in text]
    again = load(path)
    assert [again.model[name] for name in ("k0", "v_full", "reverse")] == [0.0, 12.0, 0.0]
    save(load("bench"), path)
    assert "v_full" not in path.read_text(encoding="utf-8")


def test_save_replaces_in_one_step_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "m.yaml"
    save(load("bench"), path)
    save(load("thesis"), path)
    assert load(path).model == load("thesis").model
    assert [entry.name for entry in tmp_path.iterdir()] == ["m.yaml"]
    assert path.stat().st_mode & 0o777 == 0o644


def test_save_that_fails_says_where_and_leaves_nothing(tmp_path):
    path = tmp_path / "there"
    path.mkdir()
    with pytest.raises(ModelError) as caught:
        save(load("bench"), path)
    assert str(caught.value) == f"{path}: the model file cannot be written: Is a directory"
    assert [entry.name for entry in tmp_path.iterdir()] == ["there"]
    with pytest.raises(ModelError, match=r"nowhere/m[.]yaml: the model file cannot be written: No such file"):
        save(load("bench"), tmp_path / "nowhere" / "m.yaml")


def test_missing_parameters_of_an_effect_take_the_defaults():
    model = from_flat({"effects.winding_heating.gain": 0.1}, base=load("bench"))
    assert model.effects == {"winding_heating": {"gain": 0.1, "tau": 30.0}}


def test_base_supplies_what_is_left_out():
    base = load("bench").with_effects({"supply_sag": {"r_supply": 0.2}})
    model = from_flat({"model.R_a": 2.0}, base=base)
    assert model.model == {**base.model, "R_a": 2.0}
    assert model.effects == base.effects
    assert base.model["R_a"] == 1.08


@pytest.mark.parametrize("text", ["", "    effects: {}\n", "    effects:\n", "    seed: 3\n    truth: true\n",
                                  "    qos_overrides: {a: {b: 3}}\n"])
def test_files_without_effects(tmp_path, text):
    path = tmp_path / "m.yaml"
    path.write_text(BENCH + text)
    assert numbers(load(path)) == numbers(load("bench"))


@pytest.mark.parametrize("written", ["1e0", "1", "1.0", "+1.", "0.1e+1", "10.0E-1"])
def test_numbers_as_rcl_reads_them(tmp_path, written):
    path = tmp_path / "m.yaml"
    path.write_text(BENCH.replace("R_a: 1.08", f"R_a: {written}"))
    value = load(path).model["R_a"]
    assert value == 1.0
    assert isinstance(value, float)


def test_dotted_names_in_a_file(tmp_path):
    path = tmp_path / "m.yaml"
    path.write_text(BENCH + "    effects.supply_sag.r_supply: 0.1\n")
    assert load(path).effects == {"supply_sag": {"r_supply": 0.1}}


AFTER_R_A = BENCH[:BENCH.index("R_a: ")].count("\n") + 2
EFFECTS = BENCH + "    effects:\n"
NO_PARAMETER = "effects.coulomb_friction has no parameter; give at least one, as in coulomb_friction: {accel: 0.8}"
NO_NUMBER = "effects.parameter_mismatch has no parameter; give at least one, as in parameter_mismatch: {R_a: 1.2}"
KNOWN = ", ".join([*CATALOGUE, "parameter_mismatch"])

BAD = {
    "effect": (EFFECTS + "      coulomb_fricton: {accel: 1.0}\n",
               "unknown effect 'coulomb_fricton'; did you mean coulomb_friction?"),
    "effect like no other": (EFFECTS + "      xyz: {a: 1.0}\n", f"unknown effect 'xyz'; known: {KNOWN}"),
    "parameter of an effect": (EFFECTS + "      winding_heating: {gian: 1.0}\n",
                               "unknown parameter of winding_heating 'gian'; did you mean gain?"),
    "parameter of the model": (BENCH.replace("R_a: 1.08", "Ra: 1.08"),
                               "unknown parameter 'model.Ra'; did you mean model.R_a?"),
    "parameter of a mismatch": (EFFECTS + "      parameter_mismatch: {Ra: 1.0}\n",
                                "unknown number in parameter_mismatch 'Ra'; did you mean R_a?"),
    "section": (BENCH.replace("    sensing:", "    sensng:"), "unknown section 'sensng'; did you mean sensing?"),
    "section of effects": (BENCH + "    effect:\n      thrust_lag: {tau: 0.1}\n",
                           "unknown section 'effect'; did you mean effects?"),
    "dotted section": (BENCH + "    effect.thrust_lag.tau: 0.1\n", "unknown section 'effect'; did you mean effects?"),
    "NaN": (BENCH.replace("R_a: 1.08", "R_a: .nan"), "model.R_a = nan Ω is out of range; give 0.001 to 1000"),
    "infinite": (BENCH.replace("R_a: 1.08", "R_a: .inf"), "model.R_a = inf Ω is out of range; give 0.001 to 1000"),
    "negative": (BENCH.replace("R_a: 1.08", "R_a: -1.08"),
                 "model.R_a = -1.08 Ω is out of range; give 0.001 to 1000"),
    "out of an effect's range": (EFFECTS + "      mast_flex: {coupling: 1.0}\n",
                                 "effects.mast_flex.coupling = 1 is out of range; give 0 to 0.9"),
    "out of a mismatch's range": (EFFECTS + "      parameter_mismatch: {R_a: 0.0}\n",
                                  "effects.parameter_mismatch.R_a = 0 Ω is out of range; give 0.001 to 1000"),
    "word": (BENCH.replace("R_a: 1.08", "R_a: yes"), "model.R_a is 'yes'; give a number in Ω"),
    "list": (BENCH.replace("R_a: 1.08", "R_a: [1.08]"), "model.R_a is [1.08]; give a number in Ω"),
    "nothing": (BENCH.replace("R_a: 1.08", "R_a:"), "model.R_a is None; give a number in Ω"),
    "missing number": (BENCH.replace("      R_a: 1.08", ""),
                       "model.R_a is missing (1 in all); a model file gives all parameters that the presets give"),
    "effect without parameters": (EFFECTS + "      coulomb_friction: {}\n", NO_PARAMETER),
    "effect as a number": (EFFECTS + "      coulomb_friction: 0.8\n", NO_PARAMETER),
    "effect of nothing": (EFFECTS + "      coulomb_friction:\n", NO_PARAMETER),
    "mismatch without a number": (EFFECTS + "      parameter_mismatch: {}\n", NO_NUMBER),
    "effects as a word": (BENCH + "    effects: thrust_lag\n",
                          "'effects' is 'thrust_lag'; give its parameters by name, one per line"),
    "name given twice": (BENCH.replace("R_a: 1.08", "R_a: 1.08\n      R_a: 1.2"),
                         f"not valid YAML at line {AFTER_R_A}: R_a is given twice; see the presets for the form"),
    "YAML": (BENCH.replace("R_a: 1.08", "R_a: *x"),
             (f"not valid YAML at line {AFTER_R_A - 1}: an alias (*name) is not read here: write its value out; "
              "see the presets for the form")),
    "key that is a list": ("? [1, 2]\n: 3\n",
                           "not valid YAML at line 1: found unhashable key; see the presets for the form"),
    "too deep": ("[" * 3000, "not valid YAML at line 1: nested deeper than 50; see the presets for the form"),
    "empty": ("", "not a model file; it starts with '/**:' and 'ros__parameters:' (see the presets)"),
    "other YAML": ("a: [b]\n", "not a model file; it starts with '/**:' and 'ros__parameters:' (see the presets)"),
    "binary": (b"\xff\xfe\x00\x01", "the model file cannot be read: not a text file"),
    "zeros": (b"\0" * 100, "not a model file; see the presets for the form"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_file_gives_one_line_with_its_name(tmp_path, what):
    content, message = BAD[what]
    path = tmp_path / "m.yaml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(ModelError) as caught:
        load(path)
    assert str(caught.value) == f"{path}: {message}"


def test_bad_sources_give_one_line(tmp_path):
    for source, message in ((tmp_path / "no.yaml", "no such model file; give a file or a preset (bench, thesis)"),
                            ("benhc", "no such model file; give a file or a preset (bench, thesis)"),
                            (tmp_path, "the model file cannot be read: Is a directory")):
        with pytest.raises(ModelError) as caught:
            load(source)
        assert str(caught.value) == f"{source}: {message}"


READ_WITH_RCL = """
import json, sys
import rclpy
rclpy.init(args=["--ros-args", "--params-file", sys.argv[1]])
node = rclpy.create_node("any", automatically_declare_parameters_from_overrides=True)
found = {name: p.value for name, p in node.get_parameters_by_prefix("").items()}
print(json.dumps({name: value for name, value in found.items() if "." in name}))
node.destroy_node()
rclpy.try_shutdown()
"""


def read_with_rcl(path):
    environment = {**os.environ, "ROS_DOMAIN_ID": str(os.getpid() % 102), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    done = subprocess.run([sys.executable, "-c", READ_WITH_RCL, path], capture_output=True, text=True, check=True,
                          env=environment)
    return json.loads(done.stdout.splitlines()[-1])


def test_rcl_reads_a_saved_file_to_the_last_bit(tmp_path):
    base = load("bench")
    effects = {id_: {name: p.neutral + (p.default - p.neutral) / 3.0 for name, p in effect.parameters.items()}
               for id_, effect in CATALOGUE.items()}
    effects["command_delay"] = {"delay": 1e-05}
    effects["parameter_mismatch"] = {"R_a": 1.2, "J_m": 1e-05}
    model = Model("any", {name: value / 3.0 for name, value in base.model.items()}, base.sensing, effects)
    path = tmp_path / "m.yaml"
    save(model, path, "all effects")
    assert numbers(load(path)) == numbers(model)
    assert read_with_rcl(path) == to_flat(model)


def test_rcl_reads_the_definition_of_an_effect(tmp_path):
    size = {"unit": "1/s²", "default": 1, "low": 0, "high": 9}
    effect_file.define({"rcl_detent": {"place": "arm", "physics": "it's \"held\": -", "term": "- k * theta",
                                       "parameters": {"k": size}}}, "a test")
    path = tmp_path / "m.yaml"
    save(load("bench").with_effects({"rcl_detent": {"k": 2.0}}), path)
    found = read_with_rcl(path)
    assert found["effects.rcl_detent.k"] == 2.0
    assert with_definitions(found, "rcl") == to_flat(load(path))
    assert found["definitions.rcl_detent.term"] == "- k * theta"


def test_rcl_reads_a_preset_and_a_file_without_effects(tmp_path):
    path = tmp_path / "m.yaml"
    path.write_text(BENCH.replace("R_a: 1.08", "R_a: 108e-2"))
    assert read_with_rcl(path) == to_flat(load("bench"))
    save(load("bench"), path)
    assert read_with_rcl(path) == to_flat(load("bench"))


def test_a_parameter_of_an_effect_is_neutral_in_a_model_without_the_effect():
    model = load("bench").with_effects({"thrust_exponent": {"n": 1.8}})
    assert model.effect("thrust_exponent", "n") == 1.8
    assert load("bench").effect("thrust_exponent", "n") == 2.0
    assert model.effect("command_delay", "delay") == 0.0
