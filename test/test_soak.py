# SPDX-License-Identifier: Apache-2.0
"""`make soak`, short: a loop under load, the faults that no other test has, the command itself, and how it judges."""

import json
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from evaluation import results
from evaluation.soak.__main__ import MINUTES, main, readme
from evaluation.soak.faults import FAULTS
from evaluation.soak.stand import PERIOD_NS, Clock, Promise, Stand, holes, missing
from evaluation.soak.steady import WARM_UP_S, Growth, busy, steady
from evaluation.support.graph import PATIENCE_S

SECONDS = 12.0
ALONE = ("kill_controller", "stop_controller", "clock_step")
"""Others are tested where they belong (kill -9 and full disks in test_kill.py, the board in test_swap.py, ...), or take
more than a test: `make soak`."""
ROOT = Path(__file__).parents[1]


def broken(stand):
    return [one for one in stand.promises if not one.held]


@pytest.mark.alone
def test_the_board_in_a_recorded_loop_beside_a_busy_program_loses_nothing(graph, tmp_path):
    with Stand(graph, "bridge", tmp_path, seed=1) as stand, busy():
        steady(stand, SECONDS, print)
        stand.close()
    assert not broken(stand)
    assert len(stand.ear.joints) > 400 * SECONDS


@pytest.fixture(scope="module")
def plant(graph, tmp_path_factory):
    """A plant in a recorded loop, which each fault leaves in order."""
    folder = tmp_path_factory.mktemp("stand")
    with Stand(graph, "plant", folder, 2, Clock(folder)) as stand:
        stand.follows()
        yield stand


@pytest.mark.promise("Hardware", "Board and bridge behave as specified under faults")
@pytest.mark.alone
@pytest.mark.parametrize("name", ALONE)
def test_what_is_promised_of_a_fault_is_kept(plant, name):
    plant.promises.clear()
    FAULTS[name].run(plant)
    plant.follows()
    assert not broken(plant)
    assert len(plant.promises) > 5


def processes(text):
    """The processes with a text in their command line."""

    def command(folder):
        with suppress(OSError):  # it has just ended
            return (folder / "cmdline").read_text(errors="replace")
        return ""

    return [folder for folder in Path("/proc").glob("[0-9]*") if text in command(folder)]


@pytest.mark.live
def test_ctrl_c_ends_all_that_it_started():
    soak = subprocess.Popen([sys.executable, "-m", "evaluation.soak", "--minutes", "1"], cwd=ROOT, text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.STDOUT)  # fmt: skip
    try:
        end = time.monotonic() + PATIENCE_S
        while len(processes(f"/soak_{soak.pid}_")) < 3:  # rig, controller, recorder
            assert soak.poll() is None, soak.communicate()[0]
            assert time.monotonic() < end
            time.sleep(0.02)
        soak.send_signal(signal.SIGINT)
        said, _ = soak.communicate(timeout=PATIENCE_S)
        assert soak.returncode == 130, said
        assert "Traceback" not in said
        assert not processes(f"/soak_{soak.pid}_")
    finally:
        soak.kill()
        soak.wait()


@pytest.mark.parametrize(("arguments", "expected"), [
    (["--faults", "gremlins"], "gremlins"), (["--minutes", "0"], "--minutes"), (["--seed", "x"], "--seed"),
    (["everything"], "everything")])  # fmt: skip
def test_a_wrong_command_line_ends_in_one_line_and_exit_code_2(monkeypatch, capsys, arguments, expected):
    monkeypatch.setattr(sys, "argv", ["soak", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert expected in line


def test_the_table_of_the_last_whole_run_goes_into_a_readme(tmp_path):
    begin, end = results.marks("soak")
    file = tmp_path / "README.md"
    file.write_text(f"before\n{begin}\nold\n{end}\nafter\n")
    with pytest.raises(ValueError, match="run make soak"):
        results.show(file, "soak", results.full(tmp_path), readme)
    kept = [Promise("steady", "plant", "lost ticks: none", True, "0 of 9"),
            *(Promise("unplug", "bridge", what, what == "a | b", "found") for what in ("a | b", "c"))]  # fmt: skip
    whole = {"format": 1, "full": True, "date": "2026-01-02", "minutes": MINUTES, "seed": 1, "load_before": [0.2],
             "machine": {"cpu": "one", "cores": 2, "python": "3.12", "commit": "abc"},
             "promises": [asdict(one) for one in kept], "broken": [asdict(kept[-1])]}  # fmt: skip
    for name, change in (("1", {"date": "2026-01-01"}), ("2", {}), ("3", {"full": False})):
        (tmp_path / f"{name}.json").write_text(json.dumps({**whole, **change}))
    results.show(file, "soak", results.full(tmp_path), readme)
    lines = file.read_text().splitlines()
    assert lines[:2] + lines[-2:] == ["before", begin, end, "after"]
    assert "| steady | plant | lost ticks: none | yes | 0 of 9 |" in lines
    assert f"| unplug | bridge | {FAULTS['unplug'].promise} | **no** | c: found |" in lines
    assert "2026-01-02, commit abc, load 0.2 at the start: 3 checks, 1 broken." in lines[-3]


GRID = 10**18 + PERIOD_NS * np.arange(1000)


def test_holes_are_the_samples_that_are_not_there():
    assert holes(GRID) == 0
    assert holes(np.delete(GRID, [3, 400, 401, 402])) == 4
    assert holes(GRID[::-1]) == 0  # a clock that was set back
    jitter = np.random.default_rng(1).integers(-PERIOD_NS // 5, PERIOD_NS // 5, len(GRID))
    assert holes(np.delete(GRID + jitter, slice(7, 990, 7))) == len(range(7, 990, 7))


def test_missing_is_what_was_heard_and_is_not_in_the_bag():
    one = np.zeros(len(GRID))
    assert missing(GRID, one, GRID[100:900]) == 0  # the bag begins later and ends earlier
    assert missing(GRID[100:900], one[100:900], GRID) == 0
    assert missing(GRID, one, np.delete(GRID[100:900], [5, 6])) == 2
    assert missing(GRID, one, GRID[:0]) == len(GRID)
    # another publisher takes over, and the recorder knows it 50 samples later
    two = np.where(np.arange(len(GRID)) < 500, 0, 1)
    assert missing(GRID, two, np.delete(GRID, slice(500, 550))) == 0
    assert missing(GRID, one, np.delete(GRID, slice(500, 550))) == 50
    # and the last words of the one before may be lost with it
    assert missing(GRID, two, np.delete(GRID, slice(490, 550))) == 0
    assert missing(GRID, two, np.delete(GRID, [480, 600])) == 2


@pytest.mark.parametrize("rate", [0.0, 30.0])
def test_growth_of_memory_is_found_in_its_steps(rate):
    seconds = np.arange(0.0, 600.0, 0.5)
    settling = 50.0 * (1.0 - np.exp(-seconds / 10.0))
    noise = np.random.default_rng(3).normal(0.0, 0.05, len(seconds))
    growth = Growth.of(list(seconds), list(100.0 + settling + np.floor(rate * seconds / 3600.0 * 4.0) / 4.0 + noise))
    assert growth.low <= growth.rate <= growth.high
    assert growth.rate == pytest.approx(rate, abs=2.0)
    assert seconds[-1] > WARM_UP_S
