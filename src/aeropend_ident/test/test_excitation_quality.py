# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from commands import Command

from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.commands.excitation_quality import main
from aeropend_ident.identification.excitation_quality import planned, quality
from aeropend_sim.model import rig
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import load

COMMAND = Command("aeropend_ident.commands.excitation_quality")

BENCH = load("bench")


@pytest.mark.promise("Identification", "`excitation_quality` finds terms that an input does not excite")
def test_a_rich_input_excites_every_term():
    rich = quality(BENCH, planned(BENCH, Excitation(duration=20.0).series()))
    assert {(e.equation, e.term) for e in rich} == {
        ("theta_dot", "sin(theta)"), ("theta_dot", "theta_dot"), ("theta_dot", "omega*omega"), ("i_a", "i_a"),
        ("i_a", "omega"), ("i_a", "v_a"), ("omega", "i_a"), ("omega", "omega*omega")}
    assert not any(e.poor for e in rich)


@pytest.mark.promise("Identification", "`excitation_quality` finds terms that an input does not excite")
def test_a_single_step_leaves_terms_undetermined(capsys):
    assert main(["--kind", "hold", "--duration", "10"]) == 0
    said = capsys.readouterr().out
    assert "cannot be distinguished from" in said
    assert "would stay undetermined" in said


def test_an_input_that_does_nothing_is_refused(capsys):
    with pytest.raises(RecordingError):
        planned(BENCH, np.zeros(5000))
    assert main(["--duration", "1"]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


@pytest.mark.parametrize(("arguments", "said"), [
    (["my_bag", "--kind", "hold", "--duration", "20", "--seed", "1"], "leave --kind, --duration and --seed out"),
    (["my_bag", "--rest", "0"], "a bag has its own duty: leave --rest out"),
    (["--namespace", "/rig1"], "--namespace tells the rigs of a recording apart")])
def test_an_option_without_influence_is_refused_in_one_line(arguments, said):
    assert said in COMMAND.refused(*arguments)


def test_a_bag_tells_what_it_excites(bags, tmp_path, capsys):
    said = []
    for name, duty in {"rich": Excitation(duration=8.0, hold_max=1.0).series(),
                       "step": np.repeat([0.0, 0.3], [1000, 2000])}.items():
        columns, _ = rig.record(BENCH, duty, 0)
        bag = bags.write(tmp_path / name, bags.content(len(duty), columns={**columns, "duty": duty}))
        assert main([str(bag)]) == 0
        said.append(capsys.readouterr().out)
    assert "every term is excited" in said[0]
    assert "would stay undetermined" in said[1]
