# SPDX-License-Identifier: Apache-2.0
"""The command as a person runs it: a bag in, three files out, or one line that says why not."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rigs import BENCH, drawn_rig, steps

from aeropend_sim import rig
from aeropend_sim.parameters import load

KEYS = ["format", "bags", "model", "duration_s", "samples", "train_s", "held_out_s", "channels", "where", "which",
        "shrink", "notes", "seconds"]


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "aeropend_ident.diagnose", *map(str, arguments)], capture_output=True,
                          text=True, check=False, timeout=280)


def refused(*arguments: object) -> str:
    result = run(*arguments)
    assert (result.returncode, result.stdout) == (2, "")
    assert len(result.stderr.strip().splitlines()) == 1, result.stderr
    return result.stderr


@pytest.fixture(scope="module")
def bag(bags, tmp_path_factory):
    """20 s of a rig with dry friction."""
    duty = steps(20.0, 11)
    columns, _ = rig.record(drawn_rig(11, {"coulomb_friction": {}}), duty, 11)
    made = bags.content(len(duty), columns={**columns, "duty": duty})
    return bags.write(tmp_path_factory.mktemp("made") / "my_bag", made)


def test_a_bag_gives_a_verdict(bag, tmp_path):
    out = tmp_path / "verdict"
    result = run(bag, "--out", out)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("verdict: coulomb_friction (arm)\n")
    body = json.loads((out / "diagnosis.json").read_text())
    assert list(body) == KEYS
    assert body["bags"] == [str(bag)]
    assert body["held_out_s"][1] == pytest.approx(20.0, abs=0.01)
    assert body["train_s"][1] == pytest.approx(14.0, abs=0.01)
    assert set(body["channels"]) == {"theta", "omega", "i_a", "v_a"}
    assert sum(body["where"]["share"].values()) == pytest.approx(1.0)
    assert (out / "report.html").read_text().startswith("<!DOCTYPE html>")
    augmented = load(out / "augmented.yaml")
    assert augmented.effects["coulomb_friction"]["accel"] == pytest.approx(0.8, rel=0.05)
    assert sorted(p.name for p in out.iterdir()) == ["augmented.yaml", "diagnosis.json", "report.html"]


def test_results_are_not_overwritten_unasked(bag, tmp_path):
    out = tmp_path / "verdict"
    out.mkdir()
    (out / "report.html").write_text("mine")
    assert "--overwrite" in refused(bag, "--out", out)
    assert (out / "report.html").read_text() == "mine"
    assert len(list(out.iterdir())) == 1


@pytest.mark.parametrize(("arguments", "words"), [
    (["no_such_bag"], "no_such_bag"),
    ([], "BAG"),
    (["BAG", "--model", "bemch"], "bemch"),
    (["BAG", "--held-out", "1.5"], "--held-out"),
    (["BAG", "--jobs", "0"], "--jobs"),
    (["BAG", "--namespace", "/other"], "/other"),
    (["BAG", "--colour"], "--colour"),
])
def test_a_wrong_command_line_is_one_line(bag, tmp_path, arguments, words):
    message = refused(*[bag if a == "BAG" else a for a in arguments], "--out", tmp_path / "out")
    assert words in message
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("text", "words"), [
    ("/**:\n  ros__parameters:\n    effects:\n      columb_friction:\n        accel: 1.0\n", "coulomb_friction"),
    ("/**:\n  ros__parameters:\n    model:\n      R_a: .nan\n", "R_a"),
    ("just text", "not a model file"),
    ("a: [", "YAML"),
])
def test_a_wrong_model_file_is_one_line(bag, tmp_path, text, words):
    model = tmp_path / "model.yaml"
    model.write_text(text)
    assert words in refused(bag, "--model", model, "--out", tmp_path / "out")


def test_an_output_that_is_a_file_is_one_line(bag, tmp_path):
    (tmp_path / "out").write_text("x")
    assert "folder" in refused(bag, "--out", tmp_path / "out")


def test_a_broken_bag_is_read_or_refused_in_one_line(bag, tmp_path):
    broken = tmp_path / "broken"
    broken.mkdir()
    data = next(Path(bag).glob("*.mcap")).read_bytes()
    (broken / "broken_0.mcap").write_bytes(data[:200])
    assert "broken" in refused(broken, "--out", tmp_path / "out")


def test_help_shows_examples_and_exit_codes():
    result = run("--help")
    assert result.returncode == 0
    assert "examples:" in result.stdout
    assert "exit codes:" in result.stdout


def test_the_preset_is_a_model_of_itself(tmp_path, bags):
    """Without chance and error the nominal model closes on itself: nothing is found."""
    duty = steps(20.0, 12)
    columns, _ = rig.record(BENCH, duty, 12)
    path = bags.write(tmp_path / "own", bags.content(len(duty), columns={**columns, "duty": duty}))
    assert run(path, "--out", tmp_path / "out").stdout.startswith("verdict: none")
    body = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert body["shrink"]["gap"] < 1.5 * body["shrink"]["floor"]
    assert np.isfinite(body["seconds"])
