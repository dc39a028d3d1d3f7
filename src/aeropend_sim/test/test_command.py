# SPDX-License-Identifier: Apache-2.0
import sys

import pytest

from aeropend_sim.cli.command import Parser, between, called


@pytest.fixture
def parser():
    parser = Parser(prog="command")
    parser.add_argument("bag")
    parser.add_argument("--rate", type=between(0.1, 1e6, "a rate", "Hz"))
    return parser


@pytest.mark.promise("Commands", "Commands leave out the arguments that ROS adds")
def test_what_ros_passes_on_is_left_out(parser):
    assert vars(parser.parse_args(["my_bag", "--ros-args", "-r", "__ns:=/rig"])) == {"bag": "my_bag", "rate": None}


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
