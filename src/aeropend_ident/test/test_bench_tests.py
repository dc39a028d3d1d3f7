# SPDX-License-Identifier: Apache-2.0
"""Bench tests: the thesis' tables give its numbers, known rigs give theirs, and bad tables one clear line."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest

from aeropend_ident.bench_tests import estimates
from aeropend_ident.bench_tests.estimates import BenchTestError, Estimate, Rows
from aeropend_ident.commands import bench
from aeropend_ident.studies import thesis
from aeropend_ident.studies.thesis import TABLE_4_1, TABLE_4_2
from aeropend_sim.model import actuator, rig
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model, load

BENCH = load("bench")


class Read(SimpleNamespace):
    """What the bench tests use of a recording."""

    def __len__(self):
        return len(self.t)


def recorded(model, duty, seed=0, **changed):
    read, _ = rig.record(model, duty, seed)
    columns = {c: read[c] for c in ("theta", "omega", "i_a", "v_a")}
    return Read(path="bag", notes=(), t=np.arange(len(duty)) * SAMPLE_PERIOD, period=SAMPLE_PERIOD, duty=duty,
                **columns, gaps=np.zeros((0, 2), int), channels=("theta", "omega", "i_a", "v_a", "duty"), **changed)


def blocked(seed, effects=None, high=0.6):
    model = Model("blocked", {**BENCH.model, "B_m": 10.0}, BENCH.sensing, effects or {})
    return recorded(model, Excitation("steps", duration=10.0, hold_max=1.0, sequence=(0.0, 0.5 * high, high)).series(),
                    seed)


def holds(estimate, true, times=4.0):
    """Whether the truth is within so many standard deviations, which are small."""
    assert 0.0 < estimate.sigma < 0.1 * abs(estimate.value)
    return abs(estimate.value - true) < times * estimate.sigma


def table(columns, name="table"):
    return Rows(name, {k: np.asarray(v, float) for k, v in columns.items()})


def test_table_4_1_gives_the_resistance_the_thesis_prints():
    found = estimates.blocked_rotor(TABLE_4_1).numbers["R_a"]
    assert f"{found.value:.2f} {found.scatter:.2f}" == "1.08 0.04"


def test_table_4_2_gives_the_constant_the_thesis_prints_in_volts_per_rpm():
    found = estimates.steady(TABLE_4_2, Estimate(1.08, 0.0, "Ω", "Table 4.1"))
    printed = found.others["K_e in V/RPM"]
    assert printed.value == pytest.approx(6.606442526e-4, rel=2e-4)
    assert printed.scatter == pytest.approx(1.377310893e-5, rel=1e-2)
    assert found.numbers["K_e"].value == pytest.approx(6.309e-3, rel=1e-3)


def test_chapter_4_is_printed_beside_what_comes_out(capsys):
    assert thesis.main(["4"]) == 0
    said = capsys.readouterr().out
    (constant,) = (line for line in said.splitlines() if "K_ω, Table 4.3" in line)
    assert "6.6e-4 Vs/rad" in constant
    assert "0.0063" in constant
    assert "wrong unit: Table 4.2's speeds are RPM" in said
    for table in ("R_a, Table 4.1", "L_a, 4.4.2", "v_a(τ), (4.3)", "v_a(f), (4.5)", "K_q, Table 4.3"):
        assert table in said
    assert [thesis.FIGURES[figure][2] for figure in ("5.7", "5.9")] == [85, 34]  # terms too many


def test_equation_4_5_is_the_inverse_of_4_4():
    p, q, r, s = estimates.thrust_to_voltage(0.054, 0.0435, 0.0029)
    assert [round(x, 4) for x in (p, q, r, s)] == [-0.4028, 9.2593, 0.0013, 0.216]
    v = np.linspace(0.1, 2.3, 20)
    assert p + q * np.sqrt(r + s * (0.054 * v**2 + 0.0435 * v + 0.0029)) == pytest.approx(v)
    with pytest.raises(ValueError, match="inverse"):
        estimates.thrust_to_voltage(-1.0, 1.0, 0.0)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("early", [0.0, -0.00102])
def test_a_blocked_rotor_gives_resistance_and_inductance_wherever_in_the_period_the_duty_acts(seed, early):
    found = estimates.blocked_recording(blocked(seed, {"command_delay": {"delay": early}} if early else {}), "bag")
    assert holds(found.numbers["L_a"], BENCH.model["L_a"])
    assert found.numbers["R_a"].value == pytest.approx(BENCH.model["R_a"], rel=1e-3)


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


def test_another_exponent_of_the_thrust_is_said():
    w = np.linspace(60.0, 220.0, 12)
    f = 7.67e-6 * 150.0**2 * (w / 150.0) ** 1.8 * (1.0 + 0.01 * np.random.default_rng(0).standard_normal(12))
    found = estimates.thrust_curve(table({"omega": w, "thrust": f}), BENCH.model)
    assert holds(found.others["exponent of ω"], 1.8)
    assert "rather than" in found.notes[0]


def test_a_current_step_gives_its_time_constant():
    t = np.arange(0.0, 0.05, 2e-4)
    noise = 2e-3 * np.random.default_rng(0).standard_normal(len(t))
    i = np.where(t > 0.0101, 0.9 * -np.expm1(-(t - 0.0101) / 0.002), 0.0) + noise
    found = estimates.current_step(table({"t": t, "i_a": i}), Estimate(1.08, 0.01, "Ω", ""))
    assert holds(found.others["τ_e"], 0.002)
    assert holds(found.numbers["L_a"], 0.00216)
    assert not found.notes
    rough = estimates.current_step(table({"t": t[::30], "i_a": i[::30]}), Estimate(1.08, 0.01, "Ω", ""))
    assert "sample faster" in rough.notes[0]


def test_an_offset_of_a_reading_is_said():
    i = np.linspace(0.3, 2.0, 15)
    v = 1.08 * i + 0.1 + 1e-3 * np.random.default_rng(0).standard_normal(15)
    assert "0.1 V" in estimates.blocked_rotor(table({"v_a": v, "i_a": i})).notes[0]


def write(path, text):
    path.write_text(text, encoding="utf-8")
    return str(path)


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


def test_recordings_that_say_nothing_are_refused():
    moved = recorded(BENCH, Excitation("steps", duration=4.0, hold_max=1.0).series())
    with pytest.raises(BenchTestError, match="the rotor turned"):
        estimates.blocked_recording(moved, "bag")
    with pytest.raises(BenchTestError, match="settle"):
        estimates.plateaus(moved, ("theta",), "bag")
    with pytest.raises(BenchTestError, match="no current"):
        estimates.blocked_recording(blocked(0, high=1e-9), "bag")


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
