# SPDX-License-Identifier: Apache-2.0
"""Signals of holds, the limit of a duty's rate, and the file of a signal."""

import numpy as np
import pytest

from aeropend_sim.errors import UserError
from aeropend_sim.model import excitation_file
from aeropend_sim.model.excitation import KINDS, Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD


def test_each_duty_is_held_for_its_own_time():
    series = Excitation("holds", 3.0, sequence=(0.2, 0.5, 0.0), holds=(0.5, 1.0, 0.25)).series()
    at = (np.arange(len(series)) + 0.5) * SAMPLE_PERIOD
    for begin, end, duty in ((0.0, 0.5, 0.2), (0.5, 1.5, 0.5), (1.5, 1.75, 0.0), (1.75, 2.25, 0.2), (2.25, 3.0, 0.5)):
        assert (series[(at > begin) & (at < end)] == duty).all()


@pytest.mark.parametrize("kind", KINDS)
def test_no_kind_is_faster_than_the_rate_allows(kind):
    free = Excitation(kind, 10.0)
    slow = Excitation(kind, 10.0, duty_rate=0.5)
    steps = np.diff(slow.series(), prepend=0.0)
    assert np.abs(steps).max() <= 0.5 * SAMPLE_PERIOD * (1.0 + 1e-9)
    assert np.abs(np.diff(free.series(), prepend=0.0)).max() > 0.5 * SAMPLE_PERIOD
    assert np.abs(slow.series() - free.series()).max() > 0.0


def test_a_rate_that_is_never_reached_changes_nothing():
    slow = {"kind": "multisine", "duration": 5.0, "frequencies": (0.2, 0.5)}
    one, other = Excitation(**slow).series(), Excitation(**slow, duty_rate=100.0).series()
    assert np.array_equal(one[5:], other[5:])  # from duty 0 to the first value the signal may jump


@pytest.mark.parametrize("x", [
    Excitation("holds", 12.5, sequence=(0.1, 0.55, 0.0), holds=(0.5, 1.25, 3.0), duty_rate=2.0),
    Excitation("latin_hypercube", 30.0, seed=7, duty_max=0.4), Excitation("multisine", frequencies=(0.2, 1.3))])
def test_a_file_holds_the_signal(tmp_path, x):
    excitation_file.save(x, tmp_path / "x.yaml", "a comment")
    assert excitation_file.load(tmp_path / "x.yaml") == x


@pytest.mark.parametrize(("text", "said"), [
    ("", "no signal"), ("/**: {ros__parameters: {kind: nonsense}}", "kind is 'nonsense'"),
    ("/**: {ros__parameters: {loudness: 3}}", "'loudness' is no parameter"),
    ("/**: {ros__parameters: {duration: long}}", "duration: give a number"),
    ("/**: {ros__parameters: {levels: .inf}}", "levels: give a number"),
    ("/**: {ros__parameters: {levels: 10.9}}", "levels: give a whole number"),
    ("/**: {ros__parameters: {seed: 1.7}}", "seed: give a whole number"),
    (f"/**: {{ros__parameters: {{rest: !!int 1{'0' * 400}}}}}", "rest: give a number"),
    ("/**: {ros__parameters: {sequence: 0.3}}", "sequence: give a list of numbers"),
    ("/**: {ros__parameters: {sequence: []}}", "sequence: give a list of numbers"),
    ("/**: {ros__parameters: {kind: holds, sequence: [0.3], holds: [1.0, 2.0]}}", "give as many of each"),
    ("[", "not valid YAML")])
def test_a_file_without_a_signal_is_refused_in_one_line(tmp_path, text, said):
    (tmp_path / "x.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(UserError, match=r"x\.yaml") as refused:
        excitation_file.load(tmp_path / "x.yaml")
    assert said in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(UserError, match="cannot be read"):
        excitation_file.load(tmp_path / "nowhere.yaml")
