# SPDX-License-Identifier: Apache-2.0
"""The decision thresholds: each has an origin, and a change of one reaches every module that holds it."""

import ast
import importlib.util

import pytest
from evaluation.sensitivity import page, reads, recordings
from evaluation.sensitivity.changed import changed, new_constant
from evaluation.sensitivity.thresholds import Threshold, modules, thresholds, thresholds_of, tree

from aeropend_ident.diagnosis import conclude, policy, regions
from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.search import search, speed_spikes

FOUND = {t.id: t for t in thresholds()}


def test_thresholds_of_every_kind_are_found():
    for name, value in (("search.search.MOST_EFFECTS", 3), ("search.gust.LIKE_RANDOM[1]", 5.0),
                        ("policy.MATERIAL", 0.3), ("policy.CALIBRATED.undecided", 0.05),
                        ("policy.FREE_DECAY.unknown.kept", 0.6), ("chain.pwm_timing.HINT", 0.3)):
        assert FOUND[f"diagnosis.{name}"].value == value
    assert FOUND["signals.grid.PAUSE"].unit == "s"
    assert "diagnosis.document.FORMAT" not in FOUND


def test_every_threshold_has_an_origin():
    """Write (derived ...), (measured ...), (convention ...) or (choice ...) into the docstring of a new threshold."""
    assert [t.id for t in FOUND.values() if not t.origins] == []


def test_a_threshold_without_an_origin_is_seen(tmp_path):
    file = tmp_path / "new.py"
    file.write_text('A = 0.5\n"""[s] Time (choice)."""\nB: int = 3\n"""A choice nobody named."""\nC = 1.0\n'
                    'D = 2\n"""Format (format)."""\nE = "text"\n')
    spec = importlib.util.spec_from_file_location("new", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert [(t.name, t.unit, t.origins) for t in thresholds_of(module)] == [
        ("A", "s", ("choice",)), ("B", "", ()), ("C", "", ())]


def test_a_change_reaches_importers_defaults_and_policies():
    t = FOUND["diagnosis.policy.MATERIAL"]
    with changed(t.module, t.constant, new_constant(t, 0.4)):
        assert policy.MATERIAL == search.MATERIAL == policy.CALIBRATED.noise_margin == 0.4
        assert conclude.CALIBRATED is policy.CALIBRATED
        assert CutChains.__init__.__defaults__ == (policy.CALIBRATED,)
    assert policy.MATERIAL == search.MATERIAL == policy.CALIBRATED.noise_margin == 0.3
    t = FOUND["diagnosis.regions.MOST"]
    with changed(t.module, t.constant, new_constant(t, 5)):
        assert regions.regions.__defaults__ == (5,)
    assert regions.regions.__defaults__ == (3,)


def test_a_field_and_a_limit_change_alone():
    t = FOUND["diagnosis.policy.FREE_DECAY.unknown.kept"]
    new = new_constant(t, 0.7)
    assert new.unknown.kept == 0.7
    assert new.unknown.form == policy.FREE_DECAY.unknown.form
    assert new_constant(FOUND["diagnosis.search.gust.LIKE_RANDOM[0]"], 0.5) == (0.5, 5.0)


@pytest.mark.parametrize(("value", "text", "factor", "scaled"), [
    (2.0, "Time", 1.3, 2.6), (10, "Samples", 0.7, 7), (2, "Rounds", 0.7, 1), (1, "Rounds", 0.7, 0),
    (1, "Rounds", 1.3, 2),
    (0.9, "Share of readings", 1.3, 0.87), (0.9, "Share of readings", 0.7, 0.93), (0.2, "Probability", 0.7, 0.14)])
def test_scaling(value, text, factor, scaled):
    assert Threshold("m", "T", value, "", text, ()).scaled(factor) == pytest.approx(scaled)


def test_no_compiled_function_reads_a_threshold():
    names = {t.constant for t in FOUND.values()}
    for module in modules():
        for node in ast.walk(tree(module)):
            if isinstance(node, ast.FunctionDef) and any("njit" in ast.dump(d) for d in node.decorator_list):
                assert not names & {n.id for n in ast.walk(node) if isinstance(n, ast.Name)}, module.__name__


def test_a_diagnosis_reads_a_threshold_and_follows_it(tmp_path):
    name = next(n for n, r in zip(recordings.NAMES, recordings.RECORDINGS) if r[2] == ("speed_spikes",))
    recordings.make(tmp_path, name)
    with reads.watched() as seen:
        before = recordings.diagnosed(tmp_path, name)
    assert before["right"]
    fewest = FOUND["diagnosis.search.speed_spikes.FEWEST"]
    assert reads.lines_of(fewest) & seen[reads.AFTER]
    assert ("CALIBRATED.unknown.noticeable", 0) in seen[reads.AFTER]
    assert not reads.lines_of(FOUND["signals.free_decay.GROWTH"]) & (seen[reads.BEFORE] | seen[reads.AFTER])
    with changed(speed_spikes.__name__, "FEWEST", 10**6):
        after = recordings.diagnosed(tmp_path, name)
    assert "speed_spikes" not in after["answer"][1]
    rows = {(fewest.id, f): {"considered": [name], "verdicts": {name: verdict}}
            for f, verdict in zip(page.FACTORS, (before, after))}
    text = page.page(list(FOUND.values()), {"date": "2026-01-01", "commit": "0", "recordings": {
        name: {"verdict": before}}}, rows)
    row = next(line for line in text.splitlines() if f"| `{fewest.id}` |" in line)
    assert "| 1 of 1 | 1 / 1 / 0 | 0 / 1 |" in row
