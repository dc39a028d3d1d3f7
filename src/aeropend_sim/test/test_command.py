# SPDX-License-Identifier: Apache-2.0
import sys

import pytest

from aeropend_sim.cli.command import Parser, as_seed, between, called


@pytest.fixture
def parser():
    parser = Parser(prog="command")
    parser.add_argument("bag")
    parser.add_argument("--seed", type=as_seed)
    parser.add_argument("--rate", type=between(0.1, 1e6, "a rate", "Hz"))
    return parser


@pytest.mark.promise("Commands", "Commands leave out the arguments that ROS adds")
def test_what_ros_passes_on_is_left_out(parser):
    read = vars(parser.parse_args(["my_bag", "--ros-args", "-r", "__ns:=/rig"]))
    assert read == {"bag": "my_bag", "seed": None, "rate": None}


@pytest.mark.parametrize("text", ["0.1", "490", "1e6"])
def test_a_number_of_the_range_is_taken(parser, text):
    assert parser.parse_args(["my_bag", "--rate", text]).rate == float(text)


@pytest.mark.parametrize("text", ["0.09", "1000001", "nan", "fast", ""])
def test_any_other_is_refused_in_one_line(parser, capsys, text):
    with pytest.raises(SystemExit) as end:
        parser.parse_args(["my_bag", f"--rate={text}"])
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"'{text}' is not a rate between 0.1 and 1,000,000 Hz" in line


@pytest.mark.parametrize(("text", "value"), [("0", 0), ("2147483647", 2**31 - 1)])
def test_a_seed_is_a_whole_number_that_every_node_takes(parser, text, value):
    assert parser.parse_args(["my_bag", "--seed", text]).seed == value


@pytest.mark.parametrize("text", ["-1", "2147483648", "1.7", "x"])
def test_what_is_no_seed_is_refused_in_one_line(parser, capsys, text):
    with pytest.raises(SystemExit, match="2"):
        parser.parse_args(["my_bag", f"--seed={text}"])
    (line,) = capsys.readouterr().err.splitlines()
    assert f"'{text}' is not a seed: give a whole number, 0 to 2147483647" in line


def test_a_command_is_called_as_a_shell_finds_it(tmp_path, monkeypatch):
    """Beside the program that runs, by its path from here; where there is none, by ROS 2."""
    programs = tmp_path / "my rig" / ".venv" / "bin"
    programs.mkdir(parents=True)
    monkeypatch.setattr(sys, "argv", [str(programs / "doctor")])
    monkeypatch.setattr(sys, "prefix", sys.base_prefix)
    monkeypatch.chdir(tmp_path / "my rig")
    assert called("import", "aeropend_ident") == "ros2 run aeropend_ident import"
    (programs / "import").touch(0o755)
    assert called("import", "aeropend_ident") == ".venv/bin/import"
    monkeypatch.chdir(programs)
    assert called("import", "aeropend_ident") == "./import"
    monkeypatch.chdir(tmp_path.parent)
    assert called("import", "aeropend_ident") == f"'{tmp_path.name}/my rig/.venv/bin/import'"
    monkeypatch.chdir("/proc/self")
    assert called("import", "aeropend_ident") == f"'{programs}/import'"


def test_a_command_is_called_in_the_environment_of_this_interpreter(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["-c"])
    monkeypatch.setattr(sys, "executable", str(tmp_path / "bin" / "python"))
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "import").touch(0o755)
    monkeypatch.chdir(tmp_path)
    assert called("import", "aeropend_ident") == "bin/import"
