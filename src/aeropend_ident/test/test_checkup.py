# SPDX-License-Identifier: Apache-2.0
"""The check-up: good recordings, models and installations are ok; each fault is found, with what to do."""

from dataclasses import replace

import numpy as np
import pytest

from aeropend_ident.bags.recording import RecordingError, read
from aeropend_ident.checkup import bag as of_bag
from aeropend_ident.checkup import installation, model_file
from aeropend_ident.commands.doctor import main
from aeropend_ident.signals.from_bag import as_signals
from aeropend_ident.testing.rigs import BENCH, drawn_rig
from aeropend_sim.model import rig
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import load, save

SECONDS = 32.0


@pytest.fixture(scope="module")
def columns():
    """32 s of a rig whose arm rests for a second first."""
    duty = np.concatenate([np.zeros(500), Excitation(duration=SECONDS - 1.0).series()])
    return {**rig.record(drawn_rig(21, {}), duty, 21)[0], "duty": duty}


@pytest.fixture(scope="module")
def path(bags, tmp_path_factory, columns):
    """A good recording."""
    made = bags.content(len(columns["duty"]), columns=columns)
    return str(bags.write(tmp_path_factory.mktemp("good") / "bag", made))


@pytest.fixture(scope="module")
def good(path):
    return read(path)


def bad(checks):
    """Level and text of what is not ok."""
    return [(c.level, c.text) for c in checks if c.level != "ok"]


def test_a_good_recording_is_ok(path):
    found = list(of_bag.checks(path, BENCH))
    assert bad(found) == []
    assert found[0].text.endswith("s, 490.2 samples/s, with theta, omega, i_a, v_a, duty")
    assert found[-1].text == "diagnose can use it; every term of the model is excited"


@pytest.mark.parametrize(("change", "level", "words"), [
    (lambda r: {"theta": r.theta * 180.0 / np.pi}, "warning", "bag bag_mended --theta theta:deg` writes a mended copy"),
    (lambda r: {"theta": -r.theta}, "warning", "import bag bag_mended --flip` writes a mended copy to bag_mended"),
    (lambda r: {"theta": np.roll(r.theta, len(r) // 2)}, "warning", "hardly follows the duty"),
    (lambda r: {"theta": r.theta + 0.4}, "warning", "bag bag_mended --zero start` writes a mended copy"),
    (lambda r: {"theta": r.theta * 1e-3}, "warning", "the arm hardly moves"),
    (lambda r: {"theta": np.full(len(r), np.nan)}, "error", "no arm angle"),
    (lambda r: {"duty": np.full(len(r), 0.3)}, "warning", "the duty stays at 0.3"),
    (lambda r: {"duty": np.full(len(r), np.nan), "v_a": np.full(len(r), np.nan)}, "warning", "only a free decay"),
    (lambda r: {"t": 0.5 * r.t}, "warning", "only 16 s long"),
    (lambda r: {"gaps": np.array([[k, 10] for k in range(200)])}, "warning", "11.3 % of the samples are lost"),
])
def test_each_fault_of_a_recording_is_found(good, change, level, words):
    assert bad(of_bag.contents("bag", good)) == []
    assert [text for one, text in bad(of_bag.contents("bag", replace(good, **change(good))))
            if one == level and words in text]


@pytest.mark.parametrize(("change", "words"), [
    ({"theta": 180.0 / np.pi}, "the angle is in deg"), ({"omega": 30.0 / np.pi}, "the speed is in rpm")])
def test_what_the_model_shows_is_said_first_with_the_command_that_mends_it(bags, tmp_path, columns, change, words):
    changed = {name: factor * columns[name] for name, factor in change.items()}
    bag = bags.write(tmp_path / "bag", bags.content(len(columns["duty"]), columns=columns | changed))
    (first, *more) = bad(of_bag.checks(str(bag), BENCH))
    assert words in first[1]
    assert f"import {bag} {bag}_mended --" in first[1]
    assert [text for _, text in more] == [
        "diagnose refuses it until this is mended; diagnose --uncalibrated needs no model"]


def test_a_reading_that_is_left_out_is_no_ok(bags, tmp_path, columns):
    theta = columns["theta"].copy()
    theta[5000] = np.inf
    bag = bags.write(tmp_path / "bag", bags.content(len(theta), columns=columns | {"theta": theta}))
    ((level, text),) = bad(of_bag.checks(str(bag), BENCH))
    assert level == "warning"
    assert text.startswith("1 reading of theta is no possible number")


def test_a_recording_that_is_broken_off_is_said(bags, tmp_path):
    bag = bags.write(tmp_path / "bag", bags.content(3000))
    (data,) = bag.glob("*.mcap")
    data.write_bytes(data.read_bytes()[:-20_000])
    assert any("recover" in text for _, text in bad(of_bag.checks(str(bag), BENCH)))


def test_a_recording_that_no_diagnosis_can_use_is_an_error(bags, tmp_path):
    bag = bags.write(tmp_path / "bag", bags.content(20))
    assert "too few" in bad(of_bag.checks(str(bag), BENCH))[-1][1]


def test_a_file_that_is_no_recording_is_one_line(tmp_path):
    (tmp_path / "x.mcap").write_text("nothing")
    (found,) = of_bag.checks(str(tmp_path / "x.mcap"), BENCH)
    assert found.level == "error"
    assert "\n" not in str(found)


def test_good_models_are_ok(tmp_path):
    assert bad(model_file.checks("bench")) == []
    save(drawn_rig(1, {"coulomb_friction": {}}), tmp_path / "rig.yaml")
    (found,) = model_file.checks(str(tmp_path / "rig.yaml"))
    assert found.text == "a model with 1 effect: coulomb_friction"


@pytest.mark.parametrize(("changes", "words"), [
    ({"K_t": 0.66}, "K_t is 1e+02 times K_e"), ({"R_a": 1e3}, "model.R_a = 1000 is at the limit of its range")])
def test_each_fault_of_a_model_is_found(tmp_path, changes, words):
    save(replace(BENCH, model={**BENCH.model, **changes}), tmp_path / "rig.yaml")
    ((level, text),) = bad(model_file.checks(str(tmp_path / "rig.yaml")))
    assert level == "warning"
    assert words in text


def test_a_model_that_does_not_load_is_one_line(tmp_path):
    (tmp_path / "rig.yaml").write_text("a: [")
    (found,) = model_file.checks(str(tmp_path / "rig.yaml"))
    assert (found.level, "YAML" in found.text) == ("error", True)


@pytest.mark.parametrize(("environment", "level", "words"), [
    ({"ROS_DOMAIN_ID": "300", "ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}, "error", "give a number from 0 to 101"),
    ({"ROS_DOMAIN_ID": "150", "ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}, "warning", "another program may have its ports"),
    ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCAL"}, "error", "give LOCALHOST or"),
    ({}, "warning", "every machine of this network"),
    ({"ROS_DISTRO": "humble", "ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}, "warning", "tested with jazzy"),
    ({"AMENT_PREFIX_PATH": "/opt/ros/jazzy", "ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF"}, "warning", "sourced"),
])
def test_each_fault_of_the_ros_environment_is_found(environment, level, words):
    assert [text for one, text in bad(installation.ros(environment)) if one == level and words in text]


def test_a_good_installation_is_ok(tmp_path):
    assert bad(installation.ros({"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": "7"})) == []
    assert bad(installation.serial_ports([])) == []
    assert installation.compiler_cache(lambda: str(tmp_path / "cache")).level == "ok"
    assert installation.disk(tmp_path, 50e9).level == "ok"


def test_faults_of_the_machine_are_found(tmp_path):
    def without_cache():
        raise RuntimeError("no locator available")

    assert "NUMBA_CACHE_DIR" in installation.compiler_cache(without_cache).text
    (tmp_path / "file").touch()
    assert installation.compiler_cache(lambda: str(tmp_path / "file")).level == "warning"
    assert [installation.disk(tmp_path, free).level for free in (1e9, 1e6)] == ["warning", "error"]
    assert "dialout" in bad(installation.serial_ports([tmp_path / "no_such_port"]))[0][1]


def test_packages_are_compared_with_those_that_were_tested():
    numpy = np.__version__
    both = f'numpy==0.1; python_version < "3.1"\nnumpy=={numpy}; python_version >= "3.10"\n'
    assert bad(installation.packages(both)) == []
    (older,) = bad(installation.packages("numpy==0.1\n"))
    assert older == ("warning", f"numpy is {numpy}, tested with 0.1: pip install -r requirements.txt")
    (gone,) = bad(installation.packages("no-such-package==1.0\n"))
    assert gone[0] == "error"


@pytest.mark.promise("Commands", "`aeropend doctor` checks the installation, recordings and model files")
def test_doctor_says_one_line_for_each_finding(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    save(load("bench"), "rig.yaml")
    assert main(["rig.yaml"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert all(line.startswith(("ok ", "warning ")) for line in lines)
    assert {line[9:].partition(":")[0] for line in lines} >= {"packages", "serial port", "compiler cache", "disk",
                                                             "rig.yaml"}
    assert main(["no_such_bag"]) == 2
    assert "error    no_such_bag: " in capsys.readouterr().out


@pytest.mark.promise("Commands", "`doctor` ends with exit code 2 where `diagnose` would refuse the recording")
@pytest.mark.parametrize(("factors", "code"), [({}, 0), ({"theta": 180.0 / np.pi}, 2), ({"theta": 0.0}, 2)])
def test_doctor_ends_as_diagnose_does(bags, tmp_path, monkeypatch, columns, factors, code):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    changed = {name: factor * columns[name] for name, factor in factors.items()}
    bag = bags.write(tmp_path / "bag", bags.content(len(columns["duty"]), columns=columns | changed))
    assert main([str(bag)]) == code
    try:
        as_signals(read(bag), BENCH)
    except RecordingError:
        assert code == 2
    else:
        assert code == 0


def test_recordings_are_checked_with_the_model_file_that_is_named_beside_them(bags, tmp_path, monkeypatch, capsys):
    other = replace(BENCH, model={**BENCH.model, "mgd_over_J": 6.0 * BENCH.model["mgd_over_J"]})
    duty = np.concatenate([np.zeros(500), Excitation(duration=12.0).series()])
    columns = {**rig.record(other, duty, 1)[0], "duty": duty}
    bag = bags.write(tmp_path / "bag", bags.content(len(duty), columns=columns))
    save(other, tmp_path / "rig.yaml")
    said = []
    for words in ([], [str(tmp_path / "rig.yaml")]):
        main([str(bag), *words])
        said.append([line for line in capsys.readouterr().out.splitlines() if "it looks as if" in line])
    assert said[0]
    assert not said[1]


@pytest.mark.parametrize("effect", [None, "coulomb_friction", "cable_torque"])
def test_an_effect_does_not_make_a_good_excitation_poor(bags, tmp_path, effect):
    duty = Excitation(duration=SECONDS).series()
    columns = {**rig.record(drawn_rig(3, {effect: {}} if effect else {}), duty, 1)[0], "duty": duty}
    found = list(of_bag.checks(str(bags.write(tmp_path / "bag", bags.content(len(duty), columns=columns))), BENCH))
    assert found[-1].text == "diagnose can use it; every term of the model is excited"


def test_a_single_step_excites_little(bags, tmp_path):
    duty = np.repeat([0.0, 0.3], [1000, 6000])
    columns = {**rig.record(BENCH, duty, 1)[0], "duty": duty}
    found = list(of_bag.checks(str(bags.write(tmp_path / "bag", bags.content(len(duty), columns=columns))), BENCH))
    assert found[-1].level == "warning"
    assert "it hardly excites" in found[-1].text
