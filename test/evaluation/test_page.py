# SPDX-License-Identifier: Apache-2.0
"""The page of a blind check holds every figure of the run, and the misses as misses."""

import json

import pytest
from evaluation import results
from evaluation.blind import page, score

FIGURES = [score.share("right effect first", [True] * 9 + [False], at_least=0.75),
           score.share("claimed", [True, False], at_most=0.03),
           score.Figure("seconds | median", 4.6, count=12, share=False)]
CONDITIONS = {"date": "2026-01-02", "count": 12, "seed": 5,
              "machine": {"commit": "abc", "cpu": "a CPU", "cores": 2, "python": "3.12.1"}}
DOCUMENT = {"conditions": CONDITIONS, "figures": [f.document() for f in FIGURES],
            "peers": {"BIC": {"recordings": 3, "figures": [score.share("claimed", [True]).document()]}}}


@pytest.fixture
def tree(tmp_path, monkeypatch):
    """A page in place of the real one, and a folder with the results of a run."""
    monkeypatch.setattr(results, "ROOT", tmp_path)
    (tmp_path / "docs" / "results").mkdir(parents=True)
    begin, end = results.marks("blind")
    (tmp_path / "docs" / "results" / "blind.md").write_text(f"# Head\n\n{begin}\nold\n{end}\n\nTail.\n")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "results.json").write_text(json.dumps(DOCUMENT))
    return tmp_path


def test_the_page_has_each_figure_with_its_target_and_the_conditions(tree):
    page.write(tree / "run", "blind")
    text = (tree / "docs" / "results" / "blind.md").read_text()
    head, table, tail = text.partition("| figure")[0], text.partition("-->")[2], text.rpartition("-->")[2]
    assert (head[:8], tail, "old" in table) == ("# Head\n\n", "\n\nTail.\n", False)
    assert "| right effect first | 90.0 % | 59.6 to 98.2 | 10 | at least 75 % | yes |  |" in text
    assert "| claimed | 50.0 % | 9.5 to 90.5 | 2 | at most 3 % | **no** | 100.0 % |" in text
    assert "| seconds \\| median | 4.6 |  | 12 |  |  |  |" in text
    assert "Measured on 2026-01-02: 12 recordings, seed 5, commit abc, a CPU, 2 cores, Python 3.12.1. BIC was" in text


def test_a_line_tells_the_figure_with_its_interval_and_its_target():
    lines = [page.line(f.document()) for f in [*FIGURES, score.share("nothing", [], at_least=0.5)]]
    assert lines == ["right effect first: 90.0 % (95 %: 59.6 to 98.2) of 10, at least 75 %: met",
                     "claimed: 50.0 % (95 %: 9.5 to 90.5) of 2, at most 3 %: MISSED",
                     "seconds | median: 4.6 of 12", "nothing: nothing to measure"]


def test_without_a_run_or_a_place_for_the_table_there_is_one_line(tree):
    with pytest.raises(SystemExit, match=r"^blind: .*none/results.json does not exist: run make blind first$"):
        page.write(tree / "none", "blind")
    (tree / "docs" / "results" / "blind.md").write_text("no marks\n")
    with pytest.raises(SystemExit, match=r"^blind: .*blind\.md: the lines .* must be in it"):
        page.write(tree / "run", "blind")


@pytest.mark.parametrize("name", ["blind", "uncalibrated"])
def test_the_pages_have_a_place_for_the_table(name):
    text = (results.ROOT / "docs" / "results" / f"{name}.md").read_text()
    assert "| new |" in results.put(text, name, "| new |")
