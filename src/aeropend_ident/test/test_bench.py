# SPDX-License-Identifier: Apache-2.0
"""The command bench_test: known rigs give their parameters, and bad tables give one clear line."""

import json
import math

import numpy as np
import pytest
from bench_readings import BENCH, blocked, holds, recorded

from aeropend_ident.commands import bench
from aeropend_sim.model import actuator
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import Model, load


@pytest.mark.promise("Identification", "`bench_test` gives parameters from tables and recordings, with their source")
@pytest.mark.parametrize("seed", range(3))
def test_the_stairs_of_a_recording_give_the_numbers_of_its_rig(seed):
    rng = np.random.default_rng(seed)
    names = ("R_a", "K_e", "k_load", "k_thrust", "k0", "k2")
    numbers = {**BENCH.model, **{k: BENCH.model[k] * rng.uniform(0.9, 1.1) for k in names}}
    numbers["K_t"] = numbers["K_e"]
    duty = Excitation("staircase", duration=160.0, duty_max=0.5).series()
    read = recorded(Model("rig", numbers, BENCH.sensing, {}), duty, seed)
    base = Model("bench", {**BENCH.model, "R_a": numbers["R_a"]}, BENCH.sensing, {})
    found = bench.work_out({"steady": read, "duty-map": read, "thrust": read}, base)
    assert holds(found["steady"].numbers["K_e"], numbers["K_e"])
    assert holds(found["steady"].numbers["k_load"], numbers["k_load"])
    assert found["steady"].numbers["B_m"].value == 0.0
    assert holds(found["thrust"].numbers["k_thrust"], numbers["k_thrust"])
    assert holds(found["thrust"].others["exponent of ω"], 2.0)
    assert not any("rather than" in note for note in found["thrust"].notes)
    model = bench.augmented(base, found)
    x = np.linspace(0.05, 0.5, 50)
    assert actuator.voltage(model.model, x) == pytest.approx(actuator.voltage(numbers, x), abs=2e-3)


def write(path, text):
    path.write_text(text, encoding="utf-8")
    return str(path)


@pytest.mark.promise("Identification", "`bench_test` gives parameters from tables and recordings, with their source")
def test_the_command_writes_a_model_that_says_where_its_numbers_come_from(tmp_path, capsys):
    pairs = write(tmp_path / "pairs.csv", "v_a [V];i_a [mA]\n0,48;440\n1,42;1300\n0,89;850\n# a comment\n2,44;2280\n")
    speeds = write(tmp_path / "speeds.csv", "omega [rpm],v_a [V],i_a [A]\n1158,1.08,0.29\n1402,1.377,0.4\n1638,1.666,"
                   "0.55\n1885,1.974,0.7\n")
    out = tmp_path / "out"
    assert bench.main(["--blocked-rotor", pairs, "--steady", speeds, "--out", str(out)]) == 0
    body = json.loads((out / "bench_tests.json").read_text())
    r = np.mean([0.48 / 0.44, 1.42 / 1.3, 0.89 / 0.85, 2.44 / 2.28])
    assert body["blocked-rotor"]["numbers"]["R_a"]["value"] == pytest.approx(r)
    model = load(out / "bench.yaml")
    assert model.model["R_a"] == pytest.approx(r)
    w = np.array([1158, 1402, 1638, 1885]) * 2.0 * math.pi / 60.0
    v, i = np.array([1.08, 1.377, 1.666, 1.974]), np.array([0.29, 0.4, 0.55, 0.7])
    assert model.model["K_e"] == model.model["K_t"] == pytest.approx(np.mean((v - r * i) / w))
    assert model.model["k_thrust"] == BENCH.model["k_thrust"]
    head = (out / "bench.yaml").read_text()
    assert "pairs.csv, 4 rows" in head
    assert "all others: bench" in head
    assert (out / "bench_tests.svg").read_text().count("<circle") == 12
    said = capsys.readouterr().out
    assert "R_a = " in said
    assert bench.main(["--blocked-rotor", pairs, "--out", str(out)]) == 2
    assert "--overwrite" in capsys.readouterr().err


@pytest.mark.parametrize(("option", "text", "said"), [
    ("--steady", "v_a [V],i_a [A],omega\n1,1,1\n", "omega needs its unit"),
    ("--steady", "v_a [V],i_a [A],speed [rpm]\n1,1,1\n", "'speed [rpm]' names no column"),
    ("--steady", "v_a [kV],i_a [A],omega [rpm]\n1,1,1\n", "'kV' is no unit of voltage"),
    ("--steady", "v_a [V],i_a [A],omega [rpm]\n1,1,1\n1,,2\n", "1 rows hold"),
    ("--steady", "v_a [V],i_a [A],omega [rpm]\n1,1,x\n", "'x' is not a number"),
    ("--steady", "v_a [V],i_a [A],omega [rpm]\n1,1,1\n1,1,1\n1,1\n", "2 rows hold"),
    ("--steady", "v_a [V],i_a [A],omega [rpm]\n1,0.1,100\n1,0.1,0\n1,.1,100\n", "omega = 0 in row 2"),
    ("--steady", "v_a [V],i_a [A],omega [rpm]\n.1,1,100\n.1,1,99\n.1,1,98\n", "exceeds v_a"),
    ("--blocked-rotor", "v_a [V],i_a [A],omega [rpm]\n1,1,100\n1,1,99\n1,1,98\n", "the rotor turned"),
    ("--blocked-rotor", "v_a [V],v_a [V]\n1,1\n", "v_a is there twice"),
    ("--blocked-rotor", "", "the file is empty"),
    ("--duty-map", "duty [%],v_a [V]\n0,0\n10,0\n50,1\n100,2\n", "duties give a voltage"),
    ("--duty-map", "duty [1],v_a [V]\n0,0\n10,0\n50,1\n100,2\n", "give it as 0..1"),
    ("--thrust", "v_a [V],thrust [N]\n1,0\n2,0\n3,0\n4,0\n", "0 rows hold"),
    ("--thrust", "v_a [V],omega [rpm],thrust [N]\n1.5,0.1\n2.5,0.2\n3.5,0.3\n",
     "3 names (v_a [V], omega [rpm], thrust [N])"),
    ("--thrust", "v_a [V],omega [rpm]\n1,0\n2,0\n3,0\n4,0\n", "neither thrust nor theta"),
    ("--current-step", "t [ms],i_a [A]\n" + "".join(f"{k},0\n" for k in range(9)), "does not rise"),
])
def test_bad_tables_give_one_line(option, text, said, tmp_path, capsys):
    path = write(tmp_path / "table.csv", text)
    assert bench.main([option, path, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_the_command_takes_bags(bags, tmp_path):
    stairs = recorded(BENCH, Excitation("staircase", duration=60.0, duty_max=0.5, levels=6).series())
    paths = {}
    for name, read in (("blocked_bag", blocked(0)), ("stairs_bag", stairs)):
        columns = {c: getattr(read, c) for c in ("theta", "omega", "i_a", "v_a", "duty")}
        paths[name] = str(bags.write(tmp_path / name, bags.content(len(read), columns=columns)))
    out = tmp_path / "out"
    assert bench.main(["--blocked-rotor", paths["blocked_bag"], "--steady", paths["stairs_bag"], "--duty-map",
                            paths["stairs_bag"], "--out", str(out), "--model", "thesis"]) == 0
    found = load(out / "bench.yaml").model
    for name in ("R_a", "L_a", "K_e", "k_load"):
        assert found[name] == pytest.approx(BENCH.model[name], rel=0.01)
    x = np.linspace(0.1, 0.5, 20)
    assert actuator.voltage(found, x) == pytest.approx(actuator.voltage(BENCH.model, x), abs=5e-3)
    assert "stairs_bag" in (out / "bench.yaml").read_text()
