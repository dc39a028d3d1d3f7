# SPDX-License-Identifier: Apache-2.0
"""The command as a person runs it: a bag in, three files out, or one line that says why not."""

import json
import shlex
from pathlib import Path

import numpy as np
import pytest
from commands import Command

from aeropend_ident.diagnosis.document import NextExperiment
from aeropend_ident.diagnosis.results import experiment
from aeropend_ident.testing.rigs import BENCH, drawn_rig, steps
from aeropend_sim.model import rig
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import load

KEYS = ["format", "bags", "model", "duration_s", "samples", "train_s", "held_out_s", "channels", "where", "which",
        "shrink", "estimates", "notes", "seconds"]


COMMAND = Command("aeropend_ident.commands.diagnose")
run, here, refused = COMMAND.run, COMMAND.here, COMMAND.refused


@pytest.fixture(scope="module")
def bag(bags, tmp_path_factory):
    """20 s of a rig with dry friction."""
    duty = steps(20.0, 11)
    columns, _ = rig.record(drawn_rig(11, {"coulomb_friction": {}}), duty, 11)
    made = bags.content(len(duty), columns={**columns, "duty": duty})
    return bags.write(tmp_path_factory.mktemp("made") / "my_bag", made)


@pytest.fixture(scope="module")
def verdict(bag, tmp_path_factory):
    """The folder with the results, what the command said, and the page that the browser was given."""
    folder = tmp_path_factory.mktemp("results")
    browser = folder / "browser"
    browser.write_text(f'#!/bin/sh\necho "$1" > {folder}/opened\n')
    browser.chmod(0o755)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("BROWSER", f"{browser} %s")
        result = run(bag, "--out", folder / "verdict", "--open")
    return folder / "verdict", result, (folder / "opened").read_text().strip()


@pytest.mark.promise("Verdict", "Gaps are measured in free runs on held-out data that no fit has used")
def test_a_bag_gives_a_verdict(bag, verdict):
    out, result, _ = verdict
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


@pytest.mark.promise("Verdict", "`--open` shows the report in the browser")
def test_the_report_is_given_to_the_browser(verdict):
    out, result, opened = verdict
    assert result.stderr == ""
    assert opened == (out / "report.html").as_uri()


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
    (["BAG", "--test", "no_such_bag"], "no_such_bag"),
    (["BAG", "--test", "BAG"], "fitted to"),
    (["BAG", "--test", "BAG/my_bag.mcap"], "fitted to"),
    (["BAG", "other", "BAG/"], "my_bag/ is given twice"),
    (["BAG/my_bag.mcap", "BAG"], "my_bag is given twice"),
    (["BAG", "--test", "t", "--test", "./t"], "--test ./t is given twice"),
    (["BAG", "--since", "monday", "--since", "monday/"], "--since monday/ is given twice"),
    (["--each", "BAG", "--test", "no_such_bag"], "--each"),
    (["--each", "BAG", "--open"], "--open"),
])
def test_a_wrong_command_line_is_one_line(bag, tmp_path, arguments, words):
    message = refused(*[a.replace("BAG", str(bag)) for a in arguments], "--out", tmp_path / "out")
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


@pytest.mark.promise("Commands", "`--help` of each command shows examples and exit codes")
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
    said = here(path, "--out", tmp_path / "out").stdout
    assert said.startswith("verdict: none")
    assert "  would have shown, the hardest first: " in said
    body = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert body["shrink"]["gap"] < 1.5 * body["shrink"]["floor"]
    assert np.isfinite(body["seconds"])
    assert {w["effect"] for w in body["which"]["would_show"]} == set(CATALOGUE) - {"parameter_mismatch"}
    assert "What would have shown" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_the_verdict_does_not_depend_on_the_number_of_threads(tmp_path, bags):
    """One rig, two recordings: the same to the last bit."""
    model = drawn_rig(13, {"coulomb_friction": {}})
    paths = []
    for seed in (13, 14):
        duty = steps(8.0, seed)
        columns, _ = rig.record(model, duty, seed)
        paths.append(bags.write(tmp_path / f"bag{seed}", bags.content(len(duty), columns={**columns, "duty": duty})))
    found = []
    for jobs in (1, 3):
        result = here(*paths, "--out", tmp_path / f"out{jobs}", "--jobs", jobs)
        assert result.returncode == 0, result.stderr
        body = json.loads((tmp_path / f"out{jobs}" / "diagnosis.json").read_text())
        body.pop("seconds")
        model_file = (tmp_path / f"out{jobs}" / "augmented.yaml").read_text().splitlines()
        found.append((body, [line for line in model_file if line[0] != "#"]))
    assert found[0] == found[1]


def test_what_one_recording_says_is_shown_on_others(tmp_path, bags):
    """Fitted on random steps, shown on a slow staircase: by the right amount, and by nothing for another rig."""
    model = drawn_rig(15, {"coulomb_friction": {}})
    other = drawn_rig(16, {"quadratic_drag": {"k": 3.0}})
    stairs = Excitation("staircase", 20.0, duty_max=0.5).series()
    paths = []
    for name, of, duty in (("fitted", model, steps(20.0, 15)), ("same", model, stairs), ("other", other, stairs)):
        columns, _ = rig.record(of, duty, len(paths))
        paths.append(bags.write(tmp_path / name, bags.content(len(duty), columns={**columns, "duty": duty})))
    fitted, same, different = paths
    result = here(fitted, "--test", same, "--test", different, "--out", tmp_path / "out")
    assert result.returncode == 0, result.stderr
    body = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert list(body) == KEYS
    assert body["bags"] == [str(fitted)]
    first, second = body["shrink"]["across"]
    assert set(first) == {"bag", "gap", "gap_after", "floor", "closed", "low", "high"}
    assert (first["bag"], second["bag"]) == (str(same), str(different))
    assert first["gap"] > 3.0 * first["floor"]
    assert first["gap_after"] < 1.3 * first["floor"]
    assert first["low"] <= first["closed"] <= first["high"] <= 1.0
    assert first["low"] > 0.9
    assert second["closed"] < 0.8
    lines = [line for line in result.stdout.splitlines() if "not fitted to" in line]
    assert [str(p) in line for p, line in zip((same, different), lines)] == [True, True]
    assert f"{100 * first['gap']:.1f} %" in lines[0]
    # what is fitted does not change by being shown
    plain = here(fitted, "--out", tmp_path / "plain")
    assert plain.returncode == 0, plain.stderr
    alone = json.loads((tmp_path / "plain" / "diagnosis.json").read_text())
    assert "across" not in alone["shrink"]
    assert alone["which"] == body["which"]


@pytest.mark.promise(
    "Verdict", "Effects that the recording cannot separate are both named, with the experiment that separates them")
def test_the_advised_experiment_can_be_pasted_into_a_shell():
    advice = NextExperiment("w", {"kind": "steps", "duration": 60.0, "sequence": (0.1, 0.5)})
    words = shlex.split(experiment(advice).removesuffix(" (w)"))
    assert words == ["excite", "--ros-args", "-p", "kind:=steps", "-p", "duration:=60.0", "-p", "sequence:=[0.1, 0.5]"]
