# SPDX-License-Identifier: Apache-2.0
import re

import pytest

from aeropend_control.commands.tune import main
from aeropend_control.laws.registry import LAWS, Requirements
from aeropend_sim.model.parameters import load


def test_it_prints_gains_answers_and_margins(capsys):
    assert main(["feedback_linearization", "--model", "bench", "--t-s", "3"]) == 0
    said = capsys.readouterr().out
    for name in LAWS["feedback_linearization"].parameters:
        assert re.search(rf"^ *{name} +[\d.]", said, re.MULTILINE)
    rows = re.findall(r"^ +0\.[247] +(.*)$", said, re.MULTILINE)
    assert len(rows) == 3
    for row in rows:
        rise, peak, settling, overshoot, gain, phase, *_ = map(float, row.split())
        assert rise < peak < 0.9
        assert settling < 3.0
        assert 0.0 < overshoot < 20.0
        assert gain > 1.5
        assert phase > 30.0


@pytest.mark.parametrize(("arguments", "said"), [
    (["--gains", "mine"], "give one of thesis"), (["--t-r", "0.01"], "not that quick"), (["--m-p", "7"], "overshoot"),
    (["--model", "no.yaml"], "no.yaml")])
def test_what_cannot_be_is_said_in_one_line(arguments, said, capsys):
    assert main(["small_signal", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert said in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize(("arguments", "said"), [
    (["cascade", "--t-r", "0"], "t_r is 0; give a number above 0"),
    (["cascade", "--t-r", "-1"], "t_r is -1; give a number above 0"),
    (["cascade", "--t-s", "nan"], "t_s is nan; give a number above 0"),
    (["feedback_linearization_cascade", "--t-s", "0"], "t_s is 0; give a number above 0"),
    (["cascade", "--t-p", "1", "--m-p", "0.1"], "cascade is tuned by t_r and t_s alone: leave --t-p and --m-p out"),
    (["feedback_linearization_cascade", "--m-p", "0.1"], "tuned by t_r, t_p and t_s alone: leave --m-p out"),
    (["cascade", "--gains", "thesis", "--t-r", "1"], "--gains thesis is shown as it is: leave --t-r out")])
def test_a_requirement_that_no_law_can_heed_is_said_in_one_line(arguments, said, capsys):
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert said in err


@pytest.mark.parametrize("law", LAWS)
def test_the_requirements_that_a_law_uses_change_its_gains_and_others_do_not(law):
    model, wide = load("bench"), Requirements(10.0, 10.0, 10.0, 0.2)
    tighter = {"t_r": 0.4, "t_p": 0.7, "t_s": 1.5, "M_p": 0.1}
    at = LAWS[law].tune(model, wide)
    assert LAWS[law].uses == tuple(
        name for name, value in tighter.items() if LAWS[law].tune(model, wide._replace(**{name: value})) != at)


def test_a_wrong_command_line_is_one_line(capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["pid"])
    assert len(capsys.readouterr().err.splitlines()) == 1
