# SPDX-License-Identifier: Apache-2.0
"""The comparison of two trees: it passes equal results, and names each number that differs."""

import json

import numpy as np
import pytest
from evaluation import regression

RESULT = {"verdict": "none", "notes": ["a sentence"], "gap": {"theta": 0.25, "omega": float("nan")},
          "steps": [1.0, 2.0], "sha256": "a"}


@pytest.fixture
def trees(tmp_path):
    """Write the result of the old tree and a new one; returns the folder."""
    def write(new):
        for name, result in (("old", RESULT), ("new", new)):
            (tmp_path / name).mkdir()
            (tmp_path / name / "c000.json").write_text(json.dumps(result))
        return tmp_path
    return write


def test_equal_results_and_other_sentences_pass(trees, capsys):
    assert regression.compare(trees(RESULT | {"notes": ["another", "two"]}), "old", "new", 0.0, 5) == 0
    assert capsys.readouterr().out == "1 results compared, 0 differ\n"


def test_the_last_bit_differs_and_passes_with_a_tolerance(trees, capsys):
    folder = trees(RESULT | {"gap": {"theta": float(np.nextafter(0.25, 1.0)), "omega": float("nan")}, "sha256": "b"})
    assert regression.compare(folder, "old", "new", 0.0, 5) == 1
    assert capsys.readouterr().out.startswith("c000.json/gap/theta: 0.25, now 0.25000000000000006 (2.2e-16 relative)\n")
    assert regression.compare(folder, "old", "new", 1e-12, 5) == 0


@pytest.mark.parametrize(("change", "line"), [
    ({"verdict": "gust"}, "/verdict: 'none', now 'gust'"),
    ({"steps": [1.0]}, "/steps: 2 entries, now 1"),
    ({"more": 1}, "/more: only in the new results"),
    ({"gap": {"theta": 0.25, "omega": 1.0}}, "/gap/omega: nan, now 1.0"),
])
def test_each_difference_is_a_line(trees, capsys, change, line):
    assert regression.compare(trees(RESULT | change), "old", "new", 0.1, 5) == 1
    assert capsys.readouterr().out.startswith(f"c000.json{line}")


def test_results_that_were_not_run_are_counted(trees, capsys):
    folder = trees(RESULT)
    (folder / "old" / "c001.json").write_text("{}")
    assert regression.compare(folder, "old", "new", 0.0, 5) == 0
    assert capsys.readouterr().out.endswith("0 differ, 1 not run\n")
