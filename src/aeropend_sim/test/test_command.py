# SPDX-License-Identifier: Apache-2.0
import pytest

from aeropend_sim.cli.command import Parser, between


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
