# SPDX-License-Identifier: Apache-2.0
"""The command as a person runs it: a bag in, equations and a picture out, or one line that says why not."""

import json

import numpy as np
import pytest
from commands import Command

from aeropend_ident.commands.identify import lines
from aeropend_ident.identification.identify import Identified
from aeropend_ident.testing.rigs import BENCH
from aeropend_sim.model import parameters, rig
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import Model

KEYS = ["format", "method", "terms", "equations", "sigma", "held_out_mse", "seconds"]


COMMAND = Command("aeropend_ident.commands.identify")
run, here, refused = COMMAND.run, COMMAND.here, COMMAND.refused


def columns(seconds, seed=0):
    duty = Excitation(duration=seconds, seed=seed).series().astype(np.float32).astype(float)
    read, _ = rig.record(BENCH, duty, seed)
    return {**read, "duty": duty}


@pytest.fixture(scope="module")
def made(bags, tmp_path_factory):
    """Write a bag of columns."""
    def write(name, read):
        return bags.write(tmp_path_factory.mktemp(name) / "my_bag", bags.content(len(read["duty"]), columns=read))
    return write


@pytest.fixture(scope="module")
def bag(made):
    """30 s of the rig with its whole measurement chain."""
    return made("good", columns(30.0))


@pytest.fixture(scope="module")
def identified(bag, tmp_path_factory):
    """Output of the command, and its folder."""
    out = tmp_path_factory.mktemp("identified") / "out"
    result = run(bag, "--method", "weak", "--out", out)
    assert result.returncode == 0, result.stderr
    return result.stdout, out


@pytest.mark.promise(
    "Identification", "`identify` finds the equations of the simulated rig through its measurement chain")
def test_the_equations_of_a_rig_are_found_through_its_measurement_chain(identified):
    said, out = identified
    assert said.startswith("d(theta)/dt = 1 theta_dot\nd(theta_dot)/dt = ")
    body = json.loads((out / "identified.json").read_text())
    assert list(body)[: len(KEYS)] == KEYS
    assert (len(body["terms"]), body["terms"][:3]) == (31, ["1", "theta", "theta_dot"])
    n = BENCH.numbers()
    found, sigma = body["equations"]["theta_dot"], body["sigma"]["theta_dot"]
    true = {"sin(theta)": -n["mgd_over_J"], "theta_dot": -n["c_over_J"], "omega*omega": n["L_over_J"] * n["k_thrust"]}
    assert set(found) == set(true)
    for term, value in true.items():
        assert abs(found[term] - value) < 5.0 * sigma[term]
        assert found[term] == pytest.approx(value, rel=0.01)
    assert set(body["equations"]["omega"]) == {"i_a", "omega*omega"}
    for channel in ("theta", "i_a", "omega"):
        assert body["free_run"][channel]["gap"] < 2.0 * body["free_run"][channel]["floor"]
    assert set(body["held_out_mse"]) == {"theta", "theta_dot", "i_a", "omega"}
    assert (out / "identified.svg").read_text().startswith("<svg ")


def test_a_state_is_printed_by_its_definition_where_the_candidate_terms_lack_it():
    found = Identified("weak", ("sin(theta)",), {"theta": {"theta_dot": 1.0}}, {"theta": {"theta_dot": 0.0}}, {}, (),
                       (), {}, {}, 1, 0.0, ())
    assert lines(found) == ["d(theta)/dt = 1 theta_dot"]


def test_bad_input_gives_one_line_and_no_numbers(bag, made, tmp_path):
    good = columns(12.0)
    still = {**good, "duty": np.full_like(good["duty"], 0.0), "v_a": np.zeros_like(good["v_a"])}
    holed = {**good, "theta": np.where(np.arange(len(good["theta"])) == 1000, np.nan, good["theta"])}
    for what, arguments in {
        "no_such_bag": ["no_such_bag"],
        "unknown_state": [bag, "--states", "theta,phi"],
        "4.0 s": [made("short", columns(4.0))],
        "the duty stays at 0": [made("still", still)],
        "1 of": [made("holed", holed)],
        "omega was not measured": [made("no_speed", {**good, "omega": np.full_like(good["omega"], np.nan)})],
        "not understood": [bag, "--terms", "sin(theta)), theta_dot"],
        "no terms are given": [bag, "--terms", ""],
        "at least one state": [bag, "--states", "theta,theta"],
        "theta_dot is not measured": [bag, "--states", "theta_dot"],
    }.items():
        said = refused(*arguments, "--out", tmp_path / "out")
        if what != "unknown_state":
            assert what in said
        else:
            assert "'phi'" in said
        assert not (tmp_path / "out").exists()


def test_a_bag_with_a_gap_is_refused(bags, tmp_path):
    good = columns(12.0)
    content = bags.content(len(good["duty"]), columns=good)
    start = min(stamp for _, _, stamp, _ in content.messages)
    kept = [m for m in content.messages if not 3_000_000_000 < m[2] - start < 3_020_000_000]
    gap = bags.write(tmp_path / "gap", bags.Content(kept, content.arrays))
    assert "missing" in refused(gap, "--out", tmp_path / "out")


@pytest.mark.promise("Identification", "It uses no parameter of the model file but the measurement chain")
def test_the_model_file_is_asked_for_the_measurement_chain_alone(bag, identified, tmp_path):
    numbers, effects = {n: 1.3 * x for n, x in BENCH.model.items()}, {"coulomb_friction": {"accel": 0.8}}
    other = Model("other", numbers, BENCH.sensing, effects)
    parameters.save(other, tmp_path / "other.yaml", "numbers and an effect that are not the rig's")
    result = here(bag, "--method", "weak", "--model", tmp_path / "other.yaml", "--out", tmp_path / "out")
    assert result.returncode == 0, result.stderr
    by_bench, by_other = (json.loads((o / "identified.json").read_text()) for o in (identified[1], tmp_path / "out"))
    assert by_bench["equations"] == by_other["equations"]
    assert by_bench["sigma"] == by_other["sigma"]
