# SPDX-License-Identifier: Apache-2.0
"""Experiments one after another, on simulated rigs: when they end, and with what verdict."""

from pathlib import Path

import pytest

from aeropend_ident.commands.investigate import _left, main, parse
from aeropend_ident.design.design import LENGTH
from aeropend_ident.design.investigation import Investigation
from aeropend_ident.design.limits import Limits
from aeropend_ident.diagnosis.isolation.planned import planned
from aeropend_ident.diagnosis.results import document
from aeropend_ident.signals.signals import from_arrays
from aeropend_sim.cli.command import called
from aeropend_sim.model import rig
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD, load

BENCH = load("bench")
LIMITS = Limits(theta=(-0.8, 1.2))


SIGNALS = planned(BENCH, Excitation(duration=10.0).series())


@pytest.fixture(scope="module")
def first():
    """The first experiment, which is the same for all rigs."""
    return Investigation(BENCH, SIGNALS, LIMITS, 120.0, tries=24, jobs=2).next().designed


def investigated(first, effects, most, seed=5):
    """The inquiry on a rig with some effects, played on the simulated rig, and its verdicts."""
    inquiry, verdicts = Investigation(BENCH, SIGNALS, LIMITS, most, tries=8, first=first, jobs=2), []
    while (proposal := inquiry.next()) is not None:
        duty = proposal.designed.excitation.series()
        read, truth = rig.record(BENCH.with_effects(effects), duty, seed + len(verdicts))
        assert LIMITS.theta[0] < truth["theta"].min()
        assert truth["theta"].max() < LIMITS.theta[1]
        recording = from_arrays({**read, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)
        found = inquiry.add(recording, lambda d: document(d, ["bag"] * (len(verdicts) + 1), "bench", 1.0))
        verdicts.append(found.conclusions.which)
    return inquiry, verdicts


@pytest.mark.promise("Verdict", "`investigate` makes one experiment after another until the verdict is sure")
def test_a_clear_effect_needs_one_experiment(first):
    inquiry, verdicts = investigated(first, {"coulomb_friction": {"accel": 0.4}}, 120.0)
    assert [w.verdict for w in verdicts] == ["coulomb_friction"]
    assert inquiry.sure
    assert inquiry.moved == pytest.approx(LENGTH, abs=0.1)


def test_what_one_experiment_leaves_open_another_one_is_for(first):
    inquiry, verdicts = investigated(first, {"cable_torque": {"k": 0.25, "theta0": 0.4}}, 120.0)
    assert verdicts[0].not_separable
    assert len(verdicts) > 1
    assert inquiry.sure
    assert verdicts[-1].verdict == "cable_torque"


def test_it_ends_when_the_time_is_over(first):
    inquiry, verdicts = investigated(first, {"thrust_lag": {"tau": 0.008}}, 30.0)
    assert len(verdicts) == 1
    assert not inquiry.sure
    assert "apart" in inquiry.ended or "not sure after 20 s" in inquiry.ended


@pytest.mark.parametrize(("recorded", "judged", "said"), [
    (0, 0, ""), (1, 1, "; out/verdict has the verdict so far"),
    (2, 0, "; diagnose what is recorded: COMMAND out/1/b out/2/b --model rig.yaml")])
def test_the_line_of_an_inquiry_that_is_broken_off_says_what_is_left(recorded, judged, said):
    bags = [f"out/{k}/b" for k in range(1, recorded + 1)]
    line = _left(Path("out"), bags, judged, parse(["--model", "rig.yaml"]))
    assert line == said.replace("COMMAND", called("diagnose", "aeropend_ident"))


def test_without_a_terminal_nobody_can_agree(capsys, monkeypatch):
    monkeypatch.setattr("sys.stdin.isatty", lambda: False)
    assert main([]) == 2
    assert "give --yes" in capsys.readouterr().err
