# SPDX-License-Identifier: Apache-2.0
"""A small blind check: the same steps as `make blind`, on a seed that nothing was developed with."""

import zlib

import numpy as np
import pytest
from evaluation.blind import __main__ as check
from evaluation.blind import cases, folder, plant, score

from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.signals.signals import from_arrays
from aeropend_ident.testing.rigs import BENCH
from aeropend_sim.model.parameters import SAMPLE_PERIOD

SEED, COUNT, DURATION, PROCESSES = 4242, 24, 18.0, 1

pytestmark = pytest.mark.timeout(1200)


@pytest.fixture(scope="module")
def checked(tmp_path_factory):
    """Labels and verdicts; the labels are in another folder while verdicts are made."""
    out = tmp_path_factory.mktemp("blind")
    check.make(out / "made", COUNT, SEED, DURATION, PROCESSES)
    sealed = out / "made" / folder.SEALED
    sealed.rename(out / "elsewhere")
    folder.diagnose_all(out / "made", PROCESSES)
    (out / "elsewhere").rename(sealed)
    return out / "made", *folder.opened(out / "made")


@pytest.fixture(scope="module")
def pairs(checked):
    """Label and answer of each recording."""
    _, labels, verdicts = checked
    return score.pair(labels, verdicts, score.answer_of_diagnosis)


def test_every_recording_got_a_verdict(checked):
    _, labels, verdicts = checked
    assert len(labels) == len(verdicts) == len(check.plan(COUNT, SEED)) > 20
    assert {label["kind"] for label in labels} == set(score.KINDS)
    assert not [v["error"] for v in verdicts.values() if "error" in v]


@pytest.mark.promise("Measurements", "Few blind recordings reach the figures of the README")
def test_the_right_effect_comes_first(pairs):
    assert np.mean([score.right_first(*pair) for pair in score.of_kind(pairs, "single")]) >= 0.75


@pytest.mark.promise("Verdict", "Parameters within 5 % are refitted and count as no effect")
def test_no_effect_is_claimed_where_there_is_none(pairs):
    assert sum(answer.claims for _, answer in score.of_kind(pairs, "none")) <= 1


def test_what_is_outside_the_catalogue_is_placed_and_not_always_claimed(pairs):
    """Three recordings give no rate, and two of these resemble an effect of the catalogue most.

    A harmonic of the encoder over a short recording is hardly told from a cable.
    """
    outside = score.of_kind(pairs, "outside")
    assert len(outside) == 3
    assert sum(score.right_place(*pair) for pair in outside) >= 2
    assert any(answer.first == "unknown" for _, answer in outside)


@pytest.mark.promise("Measurements", "The blind check opens the labels after the last verdict")
def test_labels_open_only_after_the_last_verdict(checked):
    out, labels, _ = checked
    content = (out / folder.SEALED).read_bytes()
    effects = [e["effect"] for label in labels for e in label["effects"]]
    assert len(effects) > 15
    assert not any(effect.encode() in content for effect in effects)
    assert all(effect.encode() in zlib.decompress(content) for effect in effects)
    last = sorted((out / "verdicts").iterdir())[-1]
    last.rename(out / "away")
    with pytest.raises(SystemExit, match=f"^1 of {len(labels)} verdicts are missing .*{last.stem}"):
        folder.opened(out)
    (out / "away").rename(last)


@pytest.mark.parametrize("count", [COUNT, 312])
def test_each_kind_and_each_effect_has_its_share(count):
    rows = check.plan(count, 1)
    assert len(rows) == pytest.approx(count, abs=1)
    for kind, share in check.SHARES.items():
        assert sum(row[0] == kind for row in rows) == round(share * count)
    for kind, pool in (("single", [*plant.EFFECTS, "parameter_mismatch"]), ("outside", list(plant.OUTSIDE))):
        times = [sum(row[:2] == (kind, [effect]) for row in rows) for effect in pool]
        assert max(times) - min(times) <= 1
    assert check.plan(count, 1) == rows != check.plan(count, 2)


def test_an_effect_whose_search_may_end_in_a_false_valley_is_begun_elsewhere():
    """Of its five beginnings three end at 12 rad/s, where a tenth of the gap's evidence is."""
    case, columns = cases.draw("rig", "single", ["mast_flex"], "table", BENCH.model, BENCH.sensing, 3141594320, 70.0)
    body = diagnose(BENCH, [from_arrays(columns, SAMPLE_PERIOD, BENCH.sensing)]).body
    assert body["which"]["effects"] == ["mast_flex"]
    mast_flex = next(c for c in body["which"]["candidates"] if c["effect"] == "mast_flex")
    for name, true in case.effects[0]["parameters"].items():
        found = mast_flex["parameters"][name]
        assert found["low"] < true < found["high"], name
