# SPDX-License-Identifier: Apache-2.0
"""Effect files: what is read, what is refused in one line, and their way through a model file."""

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from aeropend_sim.model import effect_file
from aeropend_sim.model.effect_file import EffectError
from aeropend_sim.model.effects import CATALOGUE, DEFINED
from aeropend_sim.model.parameters import ModelError, load, save

SPRING = """
file_spring:
  place: arm
  physics: a spring
  term: -k * (theta - at)
  parameters:
    k: {unit: 1/s^2, default: 4, low: 0, high: 60, description: stiffness}
    at: {unit: rad, default: 0.4, low: -2, high: 2}
"""
HOSE = """
file_hose:
  place: arm
  physics: a hose that relaxes
  term: -k * z
  memory: {name: z, unit: rad, rate: theta_dot - z / tau}
  parameters:
    k: {unit: 1/s², default: 6, low: 0, high: 200}
    tau: {unit: s, default: 0.5, low: 0.02, high: 20}
"""


def written(tmp_path, text):
    path = tmp_path / "effects.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.promise("Augmented model", "An effect can be given by a formula in a file, without touching the source")
def test_an_effect_file_defines_effects(tmp_path):
    found = effect_file.load(written(tmp_path, SPRING + HOSE))
    assert list(found) == ["file_spring", "file_hose"]
    spring = found["file_spring"]
    assert (spring.size, spring.place, spring.parameters["k"].unit) == ("k", "arm", "1/s²")
    assert (spring.parameters["k"].neutral, spring.parameters["at"].neutral) == (0.0, 0.4)
    assert DEFINED["file_hose"].rate == "theta_dot - z / tau"
    assert not set(found) & set(CATALOGUE)


def changed(**parts):
    tree = yaml.safe_load(SPRING)["file_spring"]
    for key, value in parts.items():
        if value is None:
            del tree[key]
        else:
            tree[key] = value
    return tree


SIZE = {"unit": "1/s²", "default": 4.0, "low": 0.0, "high": 60.0}


@pytest.mark.parametrize(("tree", "why"), [
    ({}, "no effect in it"), ([1], "no effect in it"), ({"a b": changed()}, "not an id"),
    ({"gust": changed()}, "an effect of the catalogue has this id"), ({"x1": 3}, "give place, physics, term"),
    ({"x1": changed(place="leg")}, "its place is 'leg'; give one of actuator"),
    ({"x1": changed(place=None)}, "its place is missing"), ({"x1": changed(place="sensing")}, "its reading is missing"),
    ({"x1": changed(reading="theta")}, "only an effect at place sensing"),
    ({"x1": changed(sign=1)}, "unknown key 'sign'"),
    ({"x1": changed(term=None)}, "term is missing"), ({"x1": changed(term="-k*theta - at*theta")}, "cannot be added"),
    ({"x1": changed(term="-k*theta")}, "parameter at is in no formula"),
    ({"x1": changed(term="-k*(theta-at)*i_a")}, "'i_a' is not known here"),
    ({"x1": changed(parameters={})}, "it has no parameters"),
    ({"x1": changed(parameters={"k": 4})}, "give unit, default"),
    ({"x1": changed(parameters={"k": {**SIZE, "low": 99.0}})}, "low must be below high"),
    ({"x1": changed(parameters={"k": {**SIZE, "default": 99.0}})}, "default 99 is not between"),
    ({"x1": changed(parameters={"k": {**SIZE, "default": float("nan")}})}, "default is nan"),
    ({"x1": changed(parameters={"k": {**SIZE, "default": 0.0}})}, "its default must differ from 0"),
    ({"x1": changed(parameters={"k": {**SIZE, "unit": "foo"}, "at": {**SIZE, "unit": "rad"}})}, "'foo' is not a unit"),
    ({"x1": changed(parameters={"theta": SIZE})}, "theta has a meaning of its own"),
    ({"x1": changed(memory={"z": "1"})}, "give its memory as"),
    ({"x1": changed(memory={"name": "z", "unit": "rad", "rate": "theta_dot"})}, "does not use the memory z"),
    ({"x1": changed(memory={"name": "k", "unit": "rad", "rate": "theta_dot"})}, "k is a parameter and its memory"),
    ({f"x{k}": changed() for k in range(51)}, "51 effects"),
])
def test_a_definition_that_cannot_be_used_is_refused_in_a_line(tree, why):
    before = dict(DEFINED)
    with pytest.raises(EffectError) as caught:
        effect_file.define(tree, "my.yaml")
    assert why in str(caught.value)
    assert str(caught.value).startswith("my.yaml: ")
    assert "\n" not in str(caught.value)
    assert before == DEFINED


@pytest.mark.parametrize(("text", "why"), [
    ("a: [", "not valid YAML at line"), ("a: {}\na: {}", "a is given twice"), ("\0", "not an effect file"),
])
def test_a_file_that_cannot_be_read_is_refused_in_a_line(tmp_path, text, why):
    with pytest.raises(EffectError, match=why):
        effect_file.load(written(tmp_path, text))
    with pytest.raises(EffectError, match="cannot be read: No such file"):
        effect_file.load(tmp_path / "none.yaml")


def test_two_definitions_of_one_id_are_refused(tmp_path):
    effect_file.load(written(tmp_path, SPRING))
    effect_file.load(written(tmp_path, SPRING))
    with pytest.raises(EffectError, match="file_spring is defined otherwise"):
        effect_file.load(written(tmp_path, SPRING.replace("high: 60", "high: 61")))


def test_a_model_file_carries_the_definitions_of_its_effects(tmp_path):
    effect_file.load(written(tmp_path, SPRING + HOSE))
    model = load("bench").with_effects({"file_hose": {"k": 7.0, "tau": 0.25}, "gust": {"sigma": 1.0, "tau": 0.3}})
    save(model, tmp_path / "model.yaml")
    defined = {id_: DEFINED.pop(id_) for id_ in ("file_spring", "file_hose")}
    again = load(tmp_path / "model.yaml")
    assert again.effects == model.effects
    assert DEFINED["file_hose"] == defined["file_hose"]
    assert "file_spring" not in DEFINED


def test_a_wrong_definition_in_a_model_file_is_refused(tmp_path):
    path = tmp_path / "model.yaml"
    save(load("bench"), path)
    tree = yaml.safe_load(path.read_text())
    tree["/**"]["ros__parameters"] |= {"definitions": {"x2": {"place": "arm", "term": "-q"}},
                                       "effects": {"x2": {"q": 1}}}
    path.write_text(yaml.safe_dump(tree))
    with pytest.raises(EffectError, match=r"model\.yaml: x2: it has no parameters"):
        load(path)
    tree["/**"]["ros__parameters"]["definitions"] = {}
    path.write_text(yaml.safe_dump(tree))
    with pytest.raises(ModelError, match="unknown effect 'x2'"):
        load(path)


LEAVES = st.sampled_from(["arm", "-k*theta", "sensing", "theta", 0, 1.5, -3, float("inf"), None, True, "", "-", "1/s²",
                          "k", [], {}]) | st.text(max_size=8) | st.floats()
KEYS = st.sampled_from(["place", "physics", "term", "reading", "memory", "parameters", "unit", "default", "low", "high",
                        "neutral", "name", "rate", "k", "x3", "refines", 7])
TREES = st.recursive(LEAVES, lambda inner: st.dictionaries(KEYS, inner, max_size=6), max_leaves=20)


@given(st.dictionaries(KEYS, TREES, max_size=2) | TREES)
def test_any_tree_is_a_definition_or_refused(tree):
    try:
        message = f"{effect_file.define(tree, 'any.yaml')}"
    except EffectError as error:
        message = str(error)
    assert "\n" not in message
