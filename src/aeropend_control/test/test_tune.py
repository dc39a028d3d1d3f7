# SPDX-License-Identifier: Apache-2.0
import re

import pytest

from aeropend_control.commands.tune import main
from aeropend_control.laws.registry import LAWS


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


def test_a_wrong_command_line_is_one_line(capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["pid"])
    assert len(capsys.readouterr().err.splitlines()) == 1
