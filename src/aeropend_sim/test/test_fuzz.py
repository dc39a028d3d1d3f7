# SPDX-License-Identifier: Apache-2.0
"""Model files from strangers: a model, or one line that says why not. `FUZZ=100` tries a hundred times as much."""

import os
import resource
import tempfile
from contextlib import suppress
from pathlib import Path

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from aeropend_sim.errors import UserError
from aeropend_sim.model.parameters import PARAMETERS, SECTIONS, Model, ModelError, load, save
from aeropend_sim.ros.parameter_files import readable_parameter_files
from aeropend_sim.untrusted import LONGEST_MESSAGE, check_yaml, printable

FUZZ = int(os.environ.get("FUZZ", "1"))
HEAVY = 300_000
"""Kilobytes that reading a file of a few kilobytes may take at most."""

BENCH = load("bench")
NAMES = ["/**", "ros__parameters", *SECTIONS, *(name.split(".")[1] for name in PARAMETERS), "gust", "sigma", "<<"]
SCALARS = st.one_of(
    st.sampled_from(["1e999", "-.inf", ".nan", "0x10", "0b1", "1:1:1", "1_0", "2001-99-99", "~", "yes", "", "=", "<<",
                     "!!python/object/apply:os.system [touch pwned]", "!!int x", "!!float ''", "!!binary é", "*a",
                     "&a b", "!!timestamp no", "!!bool maybe", "!!set {a}", "!!omap [a]", "? [1]", "9" * 5000,
                     "'\\0'", "\x1b[31m"]),
    st.floats().map(repr), st.integers().map(str), st.text(max_size=20))


def tree(depth):
    """YAML in flow style, good or bad."""
    if depth == 0:
        return SCALARS
    inner = tree(depth - 1)
    return st.one_of(SCALARS, st.lists(st.tuples(st.sampled_from(NAMES) | SCALARS, inner), max_size=4).map(
        lambda pairs: "{" + ", ".join(f"{key}: {value}" for key, value in pairs) + "}"),
        st.lists(inner, max_size=3).map(lambda items: f"[{', '.join(items)}]"))


def good():
    """A good file as bytes."""
    with tempfile.TemporaryDirectory() as folder:
        save(BENCH.with_effects({"gust": {"sigma": 1.0, "tau": 2.0}}), Path(folder) / "good.yaml", "a comment")
        return (Path(folder) / "good.yaml").read_bytes()


GOOD = good()
EDITS = st.lists(st.tuples(st.integers(0, len(GOOD)), st.integers(0, 30), st.one_of(
    st.binary(max_size=8), SCALARS.map(lambda text: text.encode("utf-8", "surrogatepass")))), min_size=1, max_size=5)


def edited(edits):
    data = GOOD
    for at, left_out, put in edits:
        data = data[:at] + put + data[at + left_out:]
    return data


def read(data):
    """Read a file by the model's reader and by the nodes': each gives a result, or one line."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.yaml"
        path.write_bytes(data)
        said = ""
        try:
            assert isinstance(load(path), Model)
        except ModelError as error:
            said = str(error)
        assert said.isprintable()
        assert len(said) <= LONGEST_MESSAGE + 2
        with suppress(UserError):
            readable_parameter_files(["--params-file", str(path)], folder)
        assert {file.name for file in Path(folder).iterdir()} <= {"model.yaml", "0.yaml"}


@settings(max_examples=150 * FUZZ)
@given(EDITS)
def test_a_damaged_file_is_a_model_or_one_line(edits):
    read(edited(edits))


@settings(max_examples=100 * FUZZ)
@given(tree(4))
def test_any_yaml_is_a_model_or_one_line(text):
    read(f"/**:\n  ros__parameters: {text}\n".encode("utf-8", "surrogatepass"))


def levels(form, first):
    """Ten times the level before, nine levels deep."""
    lines = [f"a0: &a0 {first}"]
    lines += [f"a{k}: &a{k} {form.format(', '.join([f'*a{k - 1}'] * 10))}" for k in range(1, 10)]
    return "\n".join(lines)


BOMBS = {
    "lists of aliases": levels("[{}]", "[x]"),
    "merged aliases": levels("{{<<: [{}]}}", "{x: 1}"),
    "nested lists": "[" * 100_000,
    "nested mappings": "{a: " * 100_000,
    "nested blocks": "- " * 100_000,
    "endless number": "a: " + "9" * 1_000_000,
    "endless sum": "a: 1" + ":59" * 300_000,
}


@pytest.mark.parametrize("bomb", BOMBS)
def test_what_grows_is_refused_before_it_does(bomb):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(yaml.YAMLError):
        check_yaml(BOMBS[bomb])
    read(BOMBS[bomb].encode())
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < HEAVY


def test_no_tag_runs_code(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for tag in ("object/apply:os.system [touch pwned]", "object/new:os.system [touch pwned]", "name:os.system ''",
                "module:antigravity ''", "object:aeropend_sim.model.parameters.Model {}"):
        with pytest.raises(yaml.YAMLError):
            yaml.load(f"!!python/{tag}", yaml.SafeLoader)
        read(b"/**:\n  ros__parameters:\n    model: !!python/" + tag.encode())
    assert list(tmp_path.iterdir()) == []


@settings(max_examples=100 * FUZZ)
@given(st.text(st.characters(), max_size=60))
def test_any_comment_leaves_a_file_that_is_read_back(comment):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.yaml"
        save(BENCH, path, f"diagnose 'a{comment}b'")
        assert load(path).model == BENCH.model


@given(st.text(st.characters()))
def test_printable_text_is_that_and_says_the_same(text):
    assert printable(text).isprintable()
    assert printable(text) == text or not text.isprintable()
    printable(text).encode()
