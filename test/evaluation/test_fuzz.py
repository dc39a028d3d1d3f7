# SPDX-License-Identifier: Apache-2.0
"""`make fuzz`, short: it runs, the same for a seed, and it reports what a command may not do."""

import json
import os
import signal
import sys

import numpy as np
import pytest
from evaluation.fuzz import __main__ as fuzz
from evaluation.fuzz.command_lines import COMMANDS, Command
from evaluation.fuzz.one import draw
from evaluation.fuzz.outcome import Outcome, judge


@pytest.fixture
def run(monkeypatch, tmp_path, capsys):
    """Runs `evaluation.fuzz` with these words for a few cases; returns its exit code, its results and what it said."""
    monkeypatch.setattr(fuzz, "RESULTS", tmp_path / "fuzz-results")
    monkeypatch.setattr(fuzz, "prepare", lambda folder: None)
    monkeypatch.setattr(fuzz, "isolate", lambda: None)

    def go(*words):
        monkeypatch.setattr(sys, "argv", ["fuzz", *words])
        code = fuzz.main()
        document = json.loads((fuzz.RESULTS / "latest.json").read_text(encoding="utf-8"))
        return code, document["commands"], capsys.readouterr().out

    return go


@pytest.mark.promise("Recordings", "A recording with any values ends a command with a result or one line")
def test_a_few_recordings_of_arbitrary_values_end_in_a_result_or_one_line(run):
    code, found, said = run("--command", "recover", "import", "--minutes", "0.03", "--seed", "5")
    assert code == 0, said
    assert all(of["runs"] >= 1 and of["failed"] == [] for of in found.values())


def traceback(_words):
    raise ValueError("not for people")


def warning(_words):
    np.sqrt(np.array(-1.0))
    return 0


def crash(_words):
    os.kill(os.getpid(), signal.SIGKILL)


def silent(_words):
    return 2


def shows_nan(_words):
    print("the gap is nan %")
    return 0


def talks(_words):
    print("recover: one\nrecover: two", file=sys.stderr)
    return 2


@pytest.mark.parametrize(("main", "words"), [
    (traceback, "ValueError: not for people"), (warning, "RuntimeWarning: invalid value"), (crash, "SIGKILL"),
    (silent, "0 lines of error"), (shows_nan, "NaN is shown"), (talks, "2 lines of error")])
def test_what_a_command_may_not_do_is_reported(run, monkeypatch, main, words):
    monkeypatch.setattr(Command, "load", lambda of, files: None)
    monkeypatch.setattr(Command, "run", lambda of, given: main(given))
    code, found, said = run("--command", "recover", "--minutes", "0.0001", "--seed", "7")
    (failed,) = found["recover"]["failed"]
    assert code == 1
    assert words in "".join(failed["wrong"])
    assert "1 failed" in said
    assert f"--case {failed['case']}" in said


def test_a_command_that_does_not_end_is_reported(run, monkeypatch):
    monkeypatch.setattr(fuzz, "PATIENCE_S", 3.0)
    monkeypatch.setattr(Command, "load", lambda of, files: None)
    monkeypatch.setattr(Command, "run", lambda of, given: signal.pause())
    code, found, _ = run("--command", "recover", "--minutes", "0.0001")
    assert code == 1
    assert "it did not end" in "".join(found["recover"]["failed"][0]["wrong"])


@pytest.mark.parametrize("command", COMMANDS)
def test_a_case_is_the_same_each_time(tmp_path, monkeypatch, command):
    made = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        monkeypatch.chdir(folder)
        words, story = draw(command, 11, tmp_path)
        made.append((words, story, {path.name: path.read_bytes() for path in sorted(folder.rglob("*.mcap"))}))
    assert made[0] == made[1]


@pytest.mark.parametrize(("name", "text", "wrong"), [
    ("diagnosis.json", '{"gap": NaN}', "no JSON"), ("augmented.yaml", "K_e: .nan", "holds NaN"),
    ("report.html", "<p>known to nan %</p>", "shows NaN"), ("a.svg", '<path d="M 0 nan"/>', "shows NaN")])
def test_results_with_nan_are_reported(tmp_path, name, text, wrong):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_text(text, encoding="utf-8")
    (line,) = judge("diagnose", Outcome(0), tmp_path)
    assert wrong in line
