# SPDX-License-Identifier: Apache-2.0
"""What has changed since an earlier verdict: a number, an effect, a mass, or nothing."""

import json
from dataclasses import replace

import numpy as np
import pytest

from aeropend_ident.commands import diagnose as command
from aeropend_ident.diagnosis import since
from aeropend_ident.diagnosis.chain.known import Known, pooled, stage_of
from aeropend_ident.diagnosis.diagnosis import Diagnosis, diagnose
from aeropend_ident.diagnosis.document import DocumentError
from aeropend_ident.diagnosis.report import changes
from aeropend_ident.diagnosis.results import Results, document
from aeropend_ident.estimation.map_fit import fit
from aeropend_ident.estimation.parameter import Parameter, prior_information
from aeropend_ident.signals.signals import Signals, from_arrays
from aeropend_ident.testing import bags
from aeropend_ident.testing.rigs import BENCH, drawn_rig, steps
from aeropend_sim.model import effect_file, rig
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model

FRICTION = 0.5
WITH_A_MASS = {"mgd_over_J": 1.06, "c_over_J": 0.9, "L_over_J": 0.9}


def columns_of(model: Model, seed: int, seconds: float = 40.0) -> dict[str, np.ndarray]:
    duty = steps(seconds, seed)
    columns, _ = rig.record(model, duty, seed)
    return {**columns, "duty": duty}


def recorded(model: Model, seed: int) -> Signals:
    return from_arrays(columns_of(model, seed), SAMPLE_PERIOD, BENCH.sensing)


RIG = drawn_rig(3, {"coulomb_friction": {"accel": FRICTION}})


@pytest.fixture(scope="module")
def monday(tmp_path_factory):
    folder = tmp_path_factory.mktemp("verdicts") / "monday"
    found = diagnose(BENCH, [recorded(RIG, 3)])
    Results.of(found, document(found, ["monday"], "bench", 1.0), "diagnose monday").write(folder, overwrite=False)
    return folder


def tuesday(monday, model: Model, seed: int = 503) -> Diagnosis:
    nominal, known, _ = since.read([monday])
    return diagnose(nominal, [recorded(model, seed)], known=known)


@pytest.mark.promise("Verdict", "Nothing is claimed of a rig that has not changed")
def test_nothing_has_changed(monday):
    found = tuesday(monday, RIG).conclusions
    assert found.which.verdict == "none"
    assert found.since.changes == ()
    assert found.since.verdicts == ("monday",)
    for name in ("mgd_over_J", "R_a", "coulomb_friction.accel"):
        assert max(abs(found.since.unchanged[name].low), abs(found.since.unchanged[name].high)) < 0.02


@pytest.mark.promise("Verdict", "An effect that was perhaps there before, and not seen, is no change")
@pytest.mark.parametrize(("damping", "hidden"), [(0.12, True), (-0.12, False), (0.0, False)])
def test_an_effect_whose_place_a_parameter_had_taken_is_no_change(damping, hidden):
    """Viscous damping had taken the place of drag, or rose beside it, or stayed."""
    plain = drawn_rig(3, {})
    before = replace(plain, model={**plain.model, "c_over_J": plain.model["c_over_J"] + damping})
    monday = diagnose(BENCH, [recorded(before, 3)])
    e = monday.conclusions.estimates
    known = Known(e.names, np.array(e.values), np.array(e.covariance), ("monday",))
    after = plain.with_effects({"quadratic_drag": {"k": 0.3}})
    found = diagnose(monday.augmented, [recorded(after, 503)], known=known).conclusions.since
    both = ["quadratic_drag.k", "c_over_J"]
    assert list(found.perhaps_before) == (both if hidden else [])
    assert found.claimed == ([] if hidden else both if damping else both[:1])
    said = "seen now, but perhaps there before" if hidden else "changed: quadratic_drag.k appeared"
    assert changes.lines(found)[0].startswith(f"  {said}")


@pytest.mark.promise("Verdict", "An effect that grew is named, with its size before and after")
def test_friction_that_grew_is_named(monday):
    found = tuesday(monday, RIG.with_effects({"coulomb_friction": {"accel": 2.0 * FRICTION}})).conclusions
    (change,) = [c for c in found.since.changes if c.claimed]
    assert change.name == "coulomb_friction.accel"
    assert change.before.low < FRICTION < change.before.high
    assert change.change.low < FRICTION < change.change.high
    assert found.which.effects == ("coulomb_friction",)
    assert changes.lines(found.since)[0].startswith("  changed: coulomb_friction.accel 0.4")


@pytest.mark.promise("Verdict", "A mass on the arm is named by weight, lever and damping over its inertia")
def test_a_mass_on_the_arm_is_named(monday):
    heavier = replace(RIG, model={k: v * WITH_A_MASS.get(k, 1.0) for k, v in RIG.model.items()})
    found = tuesday(monday, heavier).conclusions.since
    assert {c.name for c in found.changes if c.claimed} == set(WITH_A_MASS)
    for c in found.changes:
        assert c.change.value / c.before.value == pytest.approx(WITH_A_MASS[c.name] - 1.0, abs=0.01)
    assert any("a mass put on the arm" in line for line in changes.lines(found))


def test_a_verdict_that_leaves_parameters_undetermined_can_be_compared_with(tmp_path):
    bags.write(tmp_path / "bag", columns_of(drawn_rig(3, {}), 3, 8.0), round(SAMPLE_PERIOD * 1e9))
    assert command.main([str(tmp_path / "bag"), "--uncalibrated", "--out", str(tmp_path / "monday")]) == 0
    _, known, (verdict,) = since.read([tmp_path / "monday"])
    assert "k2" in verdict.identified.not_determined
    assert (known.covariance == known.covariance.T).all()


@pytest.mark.parametrize(("reading", "built_in", "stage"), [
    ("v_a", "voltage_offset.bias", "actuator"), ("i_a", "current_gain.gain", "motor"),
    ("theta", "angle_offset.bias", "arm")])
def test_what_a_reading_gets_by_formula_has_the_stage_of_that_reading(reading, built_in, stage):
    id_ = f"test_since_{reading}"
    effect_file.define({id_: {"place": "sensing", "reading": reading, "physics": "an error", "term": "bias",
                              "parameters": {"bias": {"unit": effect_file.unit_of("sensing", reading), "default": 0.1,
                                                      "low": -1.0, "high": 1.0}}}}, "here")
    try:
        assert stage_of(f"{id_}.bias") == stage_of(built_in) == stage
    finally:
        effect_file.forget(id_)


def test_a_product_is_known_although_its_factors_are_not(monday):
    _, known, _ = since.read([monday])
    at = [known.names.index(n) for n in ("k_thrust", "L_over_J")]
    relative = known.covariance[np.ix_(at, at)] / np.outer(known.values[at], known.values[at])
    assert np.sqrt(relative[0, 0]) > 0.01
    assert np.sqrt(relative.sum()) < 0.003


@pytest.mark.promise("Verdict", "Several earlier verdicts show how far the rig differs from run to run")
def test_scatter_between_verdicts_widens_what_is_known():
    one, two = (Known(("R_a", "K_e"), np.array([r, 0.006]), np.diag([1e-6, 1e-12]), (name,))
                for r, name in ((1.00, "monday"), (1.10, "wednesday")))
    both = pooled([one, two])
    assert both.values == pytest.approx([1.05, 0.006])
    assert both.sd("R_a") == pytest.approx(0.1 / np.sqrt(2.0), rel=0.01)
    assert both.sd("K_e") == pytest.approx(1e-6, rel=0.01)
    assert both.verdicts == ("monday", "wednesday")


def test_a_fit_uses_the_correlations_of_its_prior():
    pair = [Parameter("a", 0.0, 1.0, correlation=(("b", 0.9),)), Parameter("b", 0.0, 1.0, correlation=(("a", 0.9),))]
    found = fit(lambda v: {"x": np.full(4000, v["a"]) - 1.0 + np.random.default_rng(1).standard_normal(4000)}, pair)
    assert found.values["b"] == pytest.approx(0.9 * found.values["a"], rel=0.01)
    assert found.sd["b"] == pytest.approx(np.sqrt(1.0 - 0.9**2), rel=0.02)


def test_a_parameter_that_replaces_another_is_not_correlated():
    replaced = [Parameter("a", 0.0, 1.0), Parameter("b", 0.0, 1.0, correlation=(("a", 0.9),))]
    assert prior_information(replaced) == pytest.approx(np.eye(2))


@pytest.mark.promise("Verdict", "`diagnose --since` takes the folder of an earlier verdict")
def test_the_command_says_what_has_changed(monday, tmp_path, capsys):
    bag = tmp_path / "tuesday"
    stronger = RIG.with_effects({"coulomb_friction": {"accel": 2.0 * FRICTION}})
    bags.write(bag, columns_of(stronger, 503), round(SAMPLE_PERIOD * 1e9))
    out = tmp_path / "verdict"
    assert command.main([str(bag), "--since", str(monday), "--out", str(out)]) == 0
    assert "since monday, this has changed: coulomb_friction.accel (arm)" in capsys.readouterr().out
    body = json.loads((out / "diagnosis.json").read_text())
    assert [c["name"] for c in body["since"]["changes"] if c["claimed"]] == ["coulomb_friction.accel"]
    assert body["model"] == str(monday)
    page = (out / "report.html").read_text()
    assert "Since monday, this has changed" in page
    assert "What has changed since monday" in page


def test_a_verdict_without_estimates_is_refused_in_one_line(monday, tmp_path):
    folder = tmp_path / "older"
    folder.mkdir()
    body = json.loads((monday / "diagnosis.json").read_text())
    del body["estimates"]
    (folder / "diagnosis.json").write_text(json.dumps(body))
    (folder / "augmented.yaml").write_text((monday / "augmented.yaml").read_text())
    with pytest.raises(DocumentError, match="diagnose the recording again"):
        since.read([folder])


@pytest.mark.parametrize("harm", [
    {"names": ["colour"], "values": [1.0], "covariance": [[1.0]]},
    {"names": ["R_a", "K_e"], "values": [1.0], "covariance": [[1.0]]},
    {"names": ["R_a"], "values": [1.0], "covariance": [[-1.0]]},
    {"names": ["R_a", "R_a"], "values": [1.0, 1.0], "covariance": [[1.0, 0.0], [0.0, 1.0]]},
    {"names": ["coulomb_friction.colour"], "values": [1.0], "covariance": [[1.0]]},
    {"names": ["R_a", "K_e"], "values": [1.0, 1.0], "covariance": [[1.0], [0.0, 1.0]]}])
def test_estimates_that_make_no_sense_are_refused_in_one_line(monday, tmp_path, harm):
    body = json.loads((monday / "diagnosis.json").read_text())
    (tmp_path / "diagnosis.json").write_text(json.dumps({**body, "estimates": harm}))
    (tmp_path / "augmented.yaml").write_text((monday / "augmented.yaml").read_text())
    with pytest.raises(DocumentError, match=r"diagnosis\.json: estimates: .*diagnose the recording again") as error:
        since.read([tmp_path])
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("other", [["--model", "thesis"], ["--uncalibrated"], ["--each"]])
def test_since_and_another_model_contradict_each_other(other, capsys):
    with pytest.raises(SystemExit):
        command.parse(["bag", "--since", "monday", *other])
    assert "contradict each other" in capsys.readouterr().err


@pytest.mark.promise("Verdict", "A gust that was not there is a change; one that was there is none")
def test_a_gust_that_was_not_there_has_appeared(monday):
    windy = RIG.with_effects({**RIG.effects, "gust": {"sigma": 1.5, "tau": 0.3}})
    found = tuesday(monday, windy)
    assert [(c.name, c.before) for c in found.conclusions.since.changes if c.claimed] == [("gust.sigma", None)]
    e = found.conclusions.estimates
    assert e.values[e.names.index("gust.sigma")] == pytest.approx(1.5, rel=0.2)
    known = Known(e.names, np.array(e.values), np.array(e.covariance), ("windy",))
    again = diagnose(found.augmented, [recorded(windy, 504)], known=known).conclusions
    assert [c.name for c in again.since.changes if c.claimed] == []


@pytest.mark.promise("Verdict", "Zero and sign that were found from the motion serve the next recording too")
def test_the_next_recording_of_a_rig_that_is_read_upside_down(tmp_path, capsys):
    for day, seed in (("monday", 3), ("tuesday", 503)):
        columns = columns_of(RIG, seed, 20.0)
        missing = np.full(len(columns["duty"]), np.nan)
        bags.write(tmp_path / day, {"theta": -1.4 - columns["theta"], "duty": columns["duty"], "omega": missing,
                                    "i_a": missing, "v_a": missing}, round(SAMPLE_PERIOD * 1e9))
    out = tmp_path / "verdict"
    assert command.main([str(tmp_path / "monday"), "--uncalibrated", "--out", str(out)]) == 0
    assert "hangs at a reading of -80" in capsys.readouterr().out
    assert command.main([str(tmp_path / "tuesday"), "--since", str(out), "--out", str(tmp_path / "since")]) == 0
    assert "nothing has changed since verdict" in capsys.readouterr().out
    model = str(out / "augmented.yaml")
    assert command.main([str(tmp_path / "tuesday"), "--model", model, "--out", str(tmp_path / "model")]) == 0
    said = capsys.readouterr()
    assert "every parameter counts as known to 5 %" in said.err
    assert "its sign is turned" not in said.err
