# SPDX-License-Identifier: Apache-2.0
"""Recordings of known variants of a rig in one fit: with a payload, with another propeller."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from commands import Command

from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.results import document, verdict_lines
from aeropend_ident.signals.signals import from_arrays
from aeropend_ident.signals.variants import Variant, VariantError, read
from aeropend_ident.testing.rigs import BENCH, drawn_rig, steps
from aeropend_sim.model import rig
from aeropend_sim.model.parameters import SAMPLE_PERIOD, save

EFFECTS = {"coulomb_friction": {"accel": 0.8}}
PAYLOAD = Variant("payload", {"mgd_over_J": 1.3, "L_over_J": 0.8, "c_over_J": 0.8})
PROPELLER = {"k_thrust": 0.8, "k_load": 0.75}
COMMAND = Command("aeropend_ident.commands.diagnose")
here, refused = COMMAND.here, COMMAND.refused


def columns(seed, factor, duration=30.0):
    """What a variant of one rig records."""
    model = Variant("", factor).of(drawn_rig(70, EFFECTS))
    duty = steps(duration, seed)
    return {**rig.record(model, duty, seed)[0], "duty": duty}


@pytest.fixture(scope="module")
def found():
    """One rig as its model states it, with a payload that is known, and with a propeller that is not."""
    empty, loaded, other = (from_arrays(columns(seed, factor), SAMPLE_PERIOD, BENCH.sensing)
                            for seed, factor in ((1, {}), (2, PAYLOAD.factor), (3, PROPELLER)))
    return diagnose(BENCH, [empty, replace(loaded, variant=PAYLOAD),
                            replace(other, variant=Variant("propeller", unknown=tuple(PROPELLER)))], 2)


@pytest.mark.promise("Verdict", "Recordings of known variants of a rig are fitted together: `--variants` says which "
                     "numbers differ, known or unknown; effects are shared")
def test_variants_share_the_effects(found):
    which, closure = found.conclusions.which, found.conclusions.closure
    assert which.effects == ("coulomb_friction",)
    (friction,) = (c for c in which.candidates if c.effect == "coulomb_friction")
    assert friction.parameters["accel"].value == pytest.approx(0.8, rel=0.02)
    assert friction.run_to_run["accel"] < 0.02
    assert closure.gap_after < 1.1 * closure.floor


def test_the_numbers_of_a_variant_are_those_that_differ(found):
    true = drawn_rig(70, EFFECTS).model
    loaded, other = found.conclusions.variants
    assert (loaded.name, loaded.recordings) == ("payload", (1,))
    assert set(loaded.numbers) == set(PAYLOAD.factor)
    assert loaded.numbers["mgd_over_J"].value == pytest.approx(1.3 * true["mgd_over_J"], rel=0.01)
    assert (other.name, set(other.numbers)) == ("propeller", set(PROPELLER))
    assert other.numbers["k_load"].value == pytest.approx(0.75 * true["k_load"], rel=0.05)
    rows = found.conclusions.which.numbers
    lift = [rows["k_thrust"].runs[k].value / rows["k_thrust"].runs[0].value for k in (1, 2)]
    assert lift == pytest.approx([1.0, 0.8], rel=0.02)
    assert rows["k_thrust"].run_to_run is None


@pytest.mark.promise("Verdict", "Several recordings of one rig say of every shared number how far it differs from run "
                     "to run")
def test_every_shared_number_has_its_spread_from_run_to_run(found):
    rows = found.conclusions.which.numbers
    shared = {n: row for n, row in rows.items() if n not in PROPELLER}
    assert all(row.run_to_run >= 0.0 and len(row.runs) == 3 for row in shared.values())
    assert rows["mgd_over_J"].runs[1].value == pytest.approx(1.3 * rows["mgd_over_J"].runs[0].value, rel=0.01)


def test_the_augmented_model_is_that_of_the_rig_without_a_variant(found):
    rows = found.conclusions.which.numbers
    for name in (*PAYLOAD.factor, *PROPELLER):
        assert found.augmented.model[name] == pytest.approx(rows[name].value)
    text = "\n".join(verdict_lines(document(found, ["empty", "loaded", "other"], "bench", 1.0)))
    assert "variant payload (1 recording): mgd_over_J = 43" in text


def test_a_file_of_variants_is_read_with_the_recordings(tmp_path, bags):
    made = {name: columns(seed, factor, 15.0) for seed, (name, factor) in enumerate(
        (("loaded", PAYLOAD.factor), ("empty", {}), ("again", PAYLOAD.factor)))}
    paths = [bags.write(tmp_path / name, bags.content(len(c["duty"]), columns=c)) for name, c in made.items()]
    numbers = {n: x * BENCH.model[n] for n, x in PAYLOAD.factor.items()}
    file = tmp_path / "variants.yaml"
    file.write_text(yaml.safe_dump({"payload": {"recordings": ["loaded", str(paths[2])], "numbers": numbers}}))
    result = here(*paths[:2], "--test", paths[2], "--variants", file, "--out", tmp_path / "out")
    assert result.returncode == 0, result.stderr
    body = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert [Path(bag).name for bag in body["bags"]] == ["empty", "loaded"]
    assert body["variants"][0]["recordings"] == [1]
    assert body["which"]["effects"] == ["coulomb_friction"]
    (across,) = body["shrink"]["across"]
    assert across["gap_after"] < 1.3 * across["floor"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Variant <code>payload</code>" in page
    assert "run to run" in page or all(n["run_to_run"] == 0.0 for n in body["which"]["numbers"].values())


GIVEN = "recordings: [loaded]"


@pytest.mark.parametrize(("text", "words"), [
    ("", "no variant in it"),
    ("payload: 3", "has no recordings"),
    ("payload: {numbers: {R_a: 1.0}}", "has no recordings"),
    (f"payload: {{{GIVEN}, weight: 3}}", "unknown key 'weight'"),
    (f"payload: {{{GIVEN}}}", "of no number that it differs"),
    (f"payload: {{{GIVEN}, numbers: {{mass: 1.0}}}}", "unknown number 'mass'"),
    (f"payload: {{{GIVEN}, numbers: {{R_a: heavy}}}}", "R_a is 'heavy'"),
    (f"payload: {{{GIVEN}, numbers: {{R_a: -1.0}}}}", "R_a is -1.0"),
    (f"payload: {{{GIVEN}, numbers: {{R_a: .nan}}}}", "R_a is nan"),
    (f"payload: {{{GIVEN}, numbers: [R_a]}}", "give numbers of the model with their values"),
    (f"payload: {{{GIVEN}, unknown: R_a}}", "give a list"),
    (f"payload: {{{GIVEN}, unknown: [R_a], numbers: {{R_a: 1.0}}}}", "known and unknown"),
    (f"payload: {{{GIVEN}, unknown: [B_m]}}", "B_m is 0 in the model"),
    (f"payload: {{{GIVEN}, model: no_such.yaml}}", "no_such.yaml"),
    ("payload: {recordings: [monday], unknown: [R_a]}", "monday, which is not given"),
    ("payload: {recordings: loaded, unknown: [R_a]}", "give a list"),
    (f"one: {{{GIVEN}, unknown: [R_a]}}\nother: {{{GIVEN}, unknown: [K_t]}}", "of the variants one and other"),
    ("payload: [", "not valid YAML"),
    ("&a [*a]", "alias")])
def test_a_wrong_file_is_refused_in_one_line(text, words, tmp_path):
    file = tmp_path / "variants.yaml"
    file.write_text(text)
    with pytest.raises(Exception, match=words.replace("'", ".")) as caught:
        read(file, ["bags/loaded"], BENCH)
    assert "\n" not in str(caught.value)
    assert str(file) in str(caught.value) or "no_such" in str(caught.value)


def test_a_model_file_says_what_differs(tmp_path):
    save(PAYLOAD.of(BENCH), tmp_path / "payload.yaml")
    (tmp_path / "variants.yaml").write_text("payload: {recordings: [a], model: payload.yaml}")
    assert read(tmp_path / "variants.yaml", ["a"], BENCH)["a"].factor == pytest.approx(PAYLOAD.factor)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(VariantError, match=r"nowhere\.yaml: the file of variants cannot be read"):
        read(tmp_path / "nowhere.yaml", ["a"], BENCH)


@pytest.mark.parametrize("other", ["--each", "--uncalibrated"])
def test_what_contradicts_variants_is_refused(other):
    assert "--variants" in refused("a_bag", "--variants", "variants.yaml", other)
