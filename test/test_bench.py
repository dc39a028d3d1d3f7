# SPDX-License-Identifier: Apache-2.0
"""What `make bench` does with its figures; the measuring itself is not repeated here."""

import json
import math
import re
from dataclasses import asdict
from pathlib import Path

import pytest
from evaluation import bench, results
from evaluation.benchmarks import first_use, growth, history, readme
from evaluation.benchmarks.measure import Figure, Spread, Target

from aeropend_ident.diagnosis.search.hypotheses import hypotheses
from aeropend_sim.model.parameters import load

MACHINE = {"cpu": "one", "cores": 2, "python": "3.12.1", "numba": "1.0", "commit": "abc"}
HERE = Path(__file__).parent
BEGIN, END = results.marks("bench")


def figure(median, q1=None, q3=None, name="reading", target=None, **more):
    ratio = Spread(median, q1 or median, q3 or median, q1 or median, q3 or median, 9)
    return Figure(name, "s", Spread.of(0.5), target, "rosbags", Spread.of(1.0), ratio, **more)


def document(*figures, date="2026-01-01T10:00:00+00:00", full=True, machine=MACHINE, load=0.1):
    listed = [{**asdict(one), "target": one.target and str(one.target), "met": one.met} for one in figures]
    return {"format": 1, "names": ["read"], "date": date, "quick": False, "full": full, "machine": machine,
            "load_before": load, "figures": listed, "not_measured": [], "again": [],
            "missed": [one.name for one in figures if one.met is False]}


@pytest.mark.parametrize(("now", "then", "told"), [
    (figure(1.3), figure(1.0), True),
    (figure(1.15), figure(1.0), False),
    (figure(0.5), figure(1.0), False),
    (figure(1.3, 0.9, 1.7), figure(1.0), False),  # within the spread
    (figure(1.3, 1.2, 1.4), figure(1.0, 0.9, 1.1), True),
    (figure(0.7, target=Target(0.1, at_least=True)), figure(1.0), True),
    (figure(1.3, target=Target(0.1, at_least=True)), figure(1.0), False),
    (figure(1.3, name="other"), figure(1.0), False),
])  # fmt: skip
def test_a_ratio_that_got_worse_by_more_than_a_fifth_and_its_spread_is_told(now, then, told):
    lines = history.worse(document(now), document(then))
    assert bool(lines) is told
    if told:
        assert "reading: " in lines[0]
        assert "was 1 " in lines[0]


def test_what_changed_is_told_with_versions_commit_and_load():
    now = document(machine={**MACHINE, "numba": "1.1", "commit": "def"}, load=3.2)
    assert history.changed(now, document()) == "numba 1.0 -> 1.1, commit abc -> def, load 0.1 -> 3.2"


def test_compared_is_with_the_last_full_run_of_the_same_machine(tmp_path):
    assert results.full(tmp_path, MACHINE) is None
    for name, one in {
        "2026-01-01-10-00-00": document(date="first"),
        "2026-01-02-10-00-00": document(date="second"),
        "2026-01-03-10-00-00": document(date="quick", full=False),
        "2026-01-04-10-00-00": document(date="elsewhere", machine={**MACHINE, "cpu": "two"}),
        "2026-01-05-10-00-00": document(date="other python", machine={**MACHINE, "python": "3.13.0"}),
    }.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(one))
    (tmp_path / "2026-01-06-10-00-00.json").write_text('{"format": 1, "da')
    assert results.full(tmp_path, MACHINE)["date"] == "second"
    assert results.full(tmp_path)["date"] == "other python"


def test_what_was_measured_again_takes_the_place_of_what_a_full_run_found(tmp_path):
    whole = document(figure(0.1, name="kept"), figure(0.2, target=Target(0.1, "ratio")), date="2026-01-02")
    for name, one in {
        "2026-01-01-10-00-00": document(figure(0.3), date="2026-01-01", full=False),
        "2026-01-02-10-00-00": {**whole, "not_measured": ["read: not measured: why", "plant: not measured"]},
        "2026-01-03-10-00-00": document(figure(0.05, target=Target(0.1, "ratio")), figure(1.0, name="new"),
                                        date="2026-01-03", full=False, machine={**MACHINE, "commit": "def"}),
        "2026-01-04-10-00-00": {**document(figure(0.4), date="2026-01-04", full=False), "quick": True},
        "2026-01-05-10-00-00": document(figure(0.5), date="2026-01-05", full=False, machine={**MACHINE, "cpu": "two"}),
        "2026-01-06-10-00-00": {k: v for k, v in document(figure(0.6), date="2026-01-06", full=False).items()
                                if k != "names"},
    }.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(one))
    found = history.renewed(tmp_path)
    assert [(one["name"], one["ratio"]["median"]) for one in found["figures"]] == [
        ("kept", 0.1), ("reading", 0.05), ("new", 1.0)]
    assert (found["missed"], found["not_measured"]) == ([], ["plant: not measured"])
    assert found["again"] == ["read on 2026-01-03, commit def"]
    assert "Measured again since: read on 2026-01-03, commit def." in readme.table(found)


class TestReadme:
    def test_the_table_has_the_main_figures_with_all_that_belongs_to_them(self):
        met = figure(0.1, 0.09, 0.11, target=Target(0.2, "ratio"), main=True)
        missed = figure(3.0, name="a | b", target=Target(0.1), main=True, note="s: 1: 2.0 s")
        lines = readme.table(document(met, missed, figure(1.0, name="not shown", note="nor this"))).splitlines()
        assert lines[2] == "| reading | 0.5 s | rosbags: 1 s | 0.1 [0.09 .. 0.11] | ≤ 0.2 x peer | yes |"
        assert lines[3] == r"| a \| b | 0.5 s | rosbags: 1 s | 3 [3 .. 3] | ≤ 0.1 | **no** |"
        assert lines[4] == ""
        for said in ("one, 2 cores", "Python 3.12.1", "2026-01-01", "commit abc", "1 of 2 are met; not: a | b."):
            assert said in lines[5]
        assert lines[6:] == ["", "- a | b: s: 1: 2.0 s"]

    def test_a_copy_of_the_readme_changes_between_the_marks_only(self, tmp_path):
        results.write(document(figure(0.1, main=True)), tmp_path)
        copy = tmp_path / "README.md"
        whole = (HERE.parent / "README.md").read_text().replace(BEGIN, "").replace(END, "")
        copy.write_text(f"{whole}\n{BEGIN}\nold\n{END}\nrest\n")
        for _ in range(2):
            assert bench.main(["--readme", str(copy)], tmp_path) == 0
            table = readme.table(history.renewed(tmp_path))
            assert copy.read_text() == f"{whole}\n{BEGIN}\n{table}\n{END}\nrest\n"

    @pytest.mark.parametrize("text", [
        "no marks", BEGIN, f"{END} {BEGIN}", f"{BEGIN} {BEGIN} {END}"])
    def test_without_its_marks_it_stays_as_it_is(self, tmp_path, capsys, text):
        results.write(document(figure(0.1, main=True)), tmp_path)
        (tmp_path / "copy.md").write_text(text)
        with pytest.raises(SystemExit) as ended:
            bench.main(["--readme", str(tmp_path / "copy.md")], tmp_path)
        assert ended.value.code == 2
        assert "copy.md" in capsys.readouterr().err
        assert (tmp_path / "copy.md").read_text() == text

    def test_without_a_full_run_it_says_what_to_do(self, tmp_path, capsys):
        with pytest.raises(SystemExit) as ended:
            bench.main(["--readme", str(tmp_path / "copy.md")], tmp_path)
        assert ended.value.code == 2
        assert "run make bench" in capsys.readouterr().err


def test_figures_that_a_document_names_are_measured():
    pages = (*HERE.parent.glob("*.md"), *HERE.parent.glob("docs/**/*.md"))
    texts = [path.read_text(encoding="utf-8") for path in pages]
    named = {word for text in texts for words in re.findall(r'ARGS="--only ([^"]+)"', text) for word in words.split()}
    assert {"plant", "sparse-rig"} <= named <= bench.FIGURES.keys()


def test_a_ratio_of_medians_stands_in_where_none_is_measured():
    assert Figure("one", "%", Spread.of([1.0, 2.0, 3.0]), peer_name="p", peer=Spread.of(4.0)).ratio == Spread.of(0.5)
    assert Figure("count", "of 9", Spread.of(1.0), peer_name="p", peer=Spread.of(4.0)).ratio is None
    assert Figure("none", "%", Spread.of(1.0), peer_name="p", peer=Spread.of(0.0)).ratio is None


def test_the_exponent_is_that_of_the_end_of_the_curve():
    x = (10.0, 60.0, 600.0)
    assert growth.exponent(x, [v**2 for v in x]) == pytest.approx(2.0)
    assert growth.exponent(x, [5.0, 6.0, 60.0]) == pytest.approx(1.0)


def test_what_never_ends_is_infinite_in_a_spread():
    assert Spread.of(math.inf) == Spread(*[math.inf] * 5, 1)
    assert Spread.of([1.0, math.inf, math.inf]).median == math.inf


def test_a_point_that_is_never_done_is_a_miss():
    runs = {1.0: growth.Run(3.0, 3.0, 1e8), 10.0: growth.Run(math.inf, math.inf, math.inf)}
    one, done = growth.curve("size", "pieces", (1.0, 10.0, 100.0), runs.__getitem__, 1.0)
    assert one.met is False
    assert list(done) == [1.0, 10.0]
    assert re.search("10: > [0-9]+ s", one.note)


@pytest.mark.parametrize("effects", [(), growth.THREE])
def test_a_narrowed_model_leaves_these_effects_to_consider_and_is_otherwise_nominal(tmp_path, effects):
    model = load(growth.narrowed(tmp_path / "model.yaml", effects))
    assert {one.effect for one in hypotheses(model, mismatches=False)} == set(effects)
    assert model.model == load("bench").model
    assert model.sensing == load("bench").sensing


def test_the_first_use_runs_every_kernel_and_tells_the_time(capsys):
    first_use.main()
    assert float(capsys.readouterr().out) > 0.0
