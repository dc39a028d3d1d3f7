# SPDX-License-Identifier: Apache-2.0
import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from commands import Command
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import structural_rank

from aeropend_ident.commands.isolate import main
from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.isolation import chance, structure
from aeropend_ident.diagnosis.isolation.isolate import isolate, judge_of, would_show
from aeropend_ident.diagnosis.isolation.judge import Judge, Rival, _distinct
from aeropend_ident.diagnosis.isolation.linear import Column, bounded
from aeropend_ident.diagnosis.isolation.planned import PlanError, like, planned
from aeropend_ident.diagnosis.isolation.sizes import smallest
from aeropend_ident.diagnosis.report import isolation as page
from aeropend_ident.diagnosis.search import speed_spikes
from aeropend_ident.diagnosis.search.hypotheses import hypotheses
from aeropend_ident.diagnosis.search.search import unsearched
from aeropend_ident.signals.signals import CHANNELS, from_arrays
from aeropend_sim.model import effect_file, rig
from aeropend_sim.model.effects import DEFINED
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD, load

COMMAND = Command("aeropend_ident.commands.isolate")

BENCH = load("bench")
DUTY = Excitation(duration=10.0, duty_max=0.6).series()


FEW = ("coulomb_friction", "thrust_lag", "mast_flex", "current_gain")


def judged(model=BENCH, channels=tuple(CHANNELS), effects=FEW, further=()):
    """A judge of a few effects, without rivals of no interest."""
    chains = CutChains(model, [planned(model, DUTY, channels)])
    return Judge(chains, [h for h in hypotheses(model, further) if h.effect in (*effects, *further)])


def of(judge, effect):
    return judge.truth(next(h for h in judge.hypotheses if h.effect == effect))


@pytest.fixture(scope="module")
def judge():
    return judged()


@pytest.mark.promise("Verdict", "`isolate` says before a recording from which size on an effect would be seen")
def test_half_the_noise_shows_half_the_size(judge):
    quiet = {f"angle_{n}": 0.5 * BENCH.sensing[f"angle_{n}"] for n in ("noise", "lsb")}
    other = judged(replace(BENCH, sensing={**BENCH.sensing, **quiet}))
    for effect in ("coulomb_friction", "mast_flex"):  # no number of the model imitates these
        seen, less = (smallest(j, of(j, effect), name=False).seen for j in (judge, other))
        assert less / seen == pytest.approx(0.5, abs=0.1), effect


def test_an_effect_on_a_channel_that_is_not_read_is_not_seen_at_all(judge):
    assert smallest(judge, of(judge, "current_gain"), name=False).seen is not None
    alone = judged(channels=("theta", "omega"))
    found = smallest(alone, of(alone, "current_gain"))
    assert (found.seen, found.named) == (None, None)


def test_the_margin_grows_with_the_size_and_is_zero_at_the_size_seen(judge):
    truth = of(judge, "coulomb_friction")
    seen = smallest(judge, truth, name=False).seen
    low, at, high = (judge.margin(truth, x * seen) for x in (0.5, 1.0, 2.0))
    assert low < -0.5 < high
    assert abs(at) < 0.1


@pytest.mark.promise("Verdict", "`isolate` says before a recording which effects it would not tell apart")
def test_look_alikes_are_not_told_apart_and_others_are(tmp_path):
    (tmp_path / "alike.yaml").write_text("""
double_drag:
  place: arm
  physics: the same as quadratic_drag, under another name
  term: "-k * theta_dot * abs(theta_dot)"
  parameters:
    k: {unit: 1/rad, neutral: 0.0, default: 0.6, low: 0.0, high: 20.0, description: drag}
""")
    further = tuple(effect_file.load(tmp_path / "alike.yaml"))
    judge = judged(effects=("quadratic_drag", "cable_torque"), further=further)
    truth = of(judge, "quadratic_drag")
    found = judge.probabilities(truth, abs(truth.usual))
    assert found["double_drag"] == pytest.approx(0.5, abs=0.05)
    assert judge.rivals_of(truth, abs(truth.usual)) != {}
    assert smallest(judge, truth).named is None
    other = of(judge, "cable_torque")
    assert judge.rivals_of(other, abs(other.usual)) == {}


def test_linear_fits_are_those_of_the_diagnosis(judge):
    nominal = unsearched(CutChains(BENCH, [planned(BENCH, DUTY)]))
    for stage, findings in nominal.items():
        mine = judge.linear.fit({c: x for c, x in judge.linear.noise.items() if judge.linear.stage_of[c] == stage})
        for c, r in findings.base.residuals.items():
            assert np.mean(mine.residuals[c] ** 2) == pytest.approx(np.mean(r * r), abs=0.02), c


def test_the_screening_ranks_as_the_fits_do(judge):
    truth = of(judge, "thrust_lag")
    change = judge.linear.change(truth.values(0.3 * truth.usual), ("arm",))
    r = {"theta": judge.linear.noise["theta"] - change["theta"]}
    base = judge.linear.fit(r)
    rivals, screening = judge.rivals["arm"]
    explained = screening.explained(r, base)
    for k in range(0, len(rivals), 4):
        f = judge.linear.fit(r, rivals[k].columns)
        weight = base.ess["theta"] / len(r["theta"]) / base.scale["theta"] ** 2
        left = weight * np.sum(f.residuals["theta"] ** 2) - 2.0 * f.log_prior
        before = weight * np.sum(base.residuals["theta"] ** 2) - 2.0 * base.log_prior
        assert before - left <= explained[k] * 1.05 + 1.0


def test_bounds_hold_in_a_linear_fit():
    a = np.array([[2.0, 1.0], [1.0, 2.0]])
    assert bounded(a, np.array([3.0, 3.0]), np.full(2, -9.0), np.full(2, 9.0)) == pytest.approx([1.0, 1.0])
    assert bounded(a, np.array([3.0, 0.0]), np.zeros(2), np.full(2, 9.0)) == pytest.approx([1.5, 0.0])


def test_false_captures_show_as_often_as_not_at_their_smallest_rate(judge):
    rate = chance.spikes(judge)
    time = speed_spikes.searched_time(judge.chains.recordings[0])
    counts = np.random.default_rng(1).poisson(rate * time, 4000)
    found = np.mean([n >= speed_spikes.FEWEST and speed_spikes.log_odds(int(n), time) >= 0.0 for n in counts])
    assert found == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize("channels", [("theta",), ("theta", "omega"), ("theta", "i_a", "v_a"), tuple(CHANNELS)])
def test_the_overdetermined_part_is_that_of_structural_ranks(channels):
    """An equation is in it if and only if the rank stays without it; scipy computes ranks in another way."""
    of_ = structure.equations(channels)
    unknowns = sorted(set().union(*of_.values()))

    def rank(names):
        return structural_rank(csr_matrix([[u in of_[e] for u in unknowns] for e in names], dtype=int))

    assert structure.overdetermined(of_) == {e for e in of_ if rank([k for k in of_ if k != e]) == rank(of_)}


def test_structure_separates_equations_between_readings_alone():
    wrong = {e: structure.equation_of(e) for e in ("bridge_drop", "brush_drop", "coulomb_friction", "voltage_offset")}
    every = structure.isolable(structure.equations(CHANNELS), wrong)
    alone = structure.isolable(structure.equations(["theta"]), wrong)
    assert every["bridge_drop"] == {"", "brush_drop", "coulomb_friction", "voltage_offset"}
    assert alone["bridge_drop"] == {"", "voltage_offset"}
    assert alone["voltage_offset"] == frozenset()


def test_isolate_says_all_at_once_and_draws_it(monkeypatch):
    few = [h for h in hypotheses(BENCH) if h.effect in ("coulomb_friction", "current_gain", "speed_spikes")]
    monkeypatch.setattr("aeropend_ident.diagnosis.isolation.isolate.hypotheses", lambda *_, **__: few)
    monkeypatch.setattr("aeropend_ident.diagnosis.isolation.isolate.other_forms", lambda *_: [])
    found = isolate(BENCH, partial(planned, BENCH, DUTY), ("theta", "omega", "i_a"))
    assert [e.effect for e in found.effects] == [h.effect for h in few]
    by = {s.channel: s for s in found.sensors}
    assert (by["v_a"].added, by["i_a"].added) == (True, False)
    assert by["i_a"].factor["current_gain"] is None
    assert by["i_a"].factor["coulomb_friction"] == pytest.approx(1.0, abs=0.3)
    html = page.render(found, "isolate")
    assert html.count("<td class=\"self\"") == len(found.at_size)


@pytest.mark.parametrize(("arguments", "said"), [
    (["--channels", "omega"], "add theta"), (["--size", "x=1"], "is no effect"),
    (["--size", "coulomb_friction=nan"], "give a number above 0"),
    (["--duration", "5", "--kind", "hold", "--duty-max", "1e-4"], "nothing happens")])
def test_an_experiment_that_cannot_be_planned_is_one_line(arguments, said, capsys):
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()[-1:]
    assert said in line


@pytest.mark.parametrize(("arguments", "said"), [
    (["my_bag", "--duration", "60", "--seed", "1"], "a bag has its own duty: leave --duration and --seed out"),
    (["my_bag", "--kind", "hold", "--duty-max", "0.3"], "a bag has its own duty: leave --kind and --duty-max out"),
    (["my_bag", "--experiment", "7"], "a bag has its own duty: leave --experiment out"),
    (["my_bag", "--signal", "x.yaml"], "a bag has its own duty: leave --signal out"),
    (["--signal", "x.yaml", "--seed", "0"], "--signal is a signal: leave --seed out"),
    (["--experiment", "7", "--kind", "hold"], "--experiment is a signal: leave --kind out"),
    (["--experiment", "7", "--signal", "x.yaml"], "are two signals"),
    (["--namespace", "/rig1"], "--namespace tells the rigs of a recording apart")])
def test_an_option_without_influence_is_refused_in_one_line(arguments, said):
    assert said in COMMAND.refused(*arguments)


def test_an_unknown_channel_is_refused():
    with pytest.raises(PlanError, match="no channel"):
        planned(BENCH, DUTY, ("theta", "theta_dot"))


def test_the_command_prints_a_table_json_and_a_page(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("aeropend_ident.commands.isolate.isolate", _small)
    assert main(["--duration", "10", "--html", str(tmp_path / "pairs.html")]) == 0
    said = capsys.readouterr().out
    assert "coulomb_friction" in said
    assert "seen from" in said
    assert main(["--html", str(tmp_path / "pairs.html")]) == 2
    capsys.readouterr()
    assert main(["--duration", "10", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["effects"][0]["seen"] < document["effects"][0]["usual"]


_KEPT = {}


def _small(model, recorded, channels, *_, **__):
    """What `isolate` says of one effect."""
    if not _KEPT:
        whole = judge_of
        try:
            isolate.__globals__["judge_of"] = lambda *a: judged(effects=("coulomb_friction",))
            _KEPT["found"] = isolate(model, recorded, channels, sensors=False)
        finally:
            isolate.__globals__["judge_of"] = whole
    return _KEPT["found"]


def test_a_rival_whose_second_parameter_changes_nothing_has_one_column(judge):
    """The products of two such columns leave nothing of the prior, and cannot be solved."""
    h = next(h for h in judge.hypotheses if h.effect == "mast_flex")
    noise = judge.linear.noise["theta"]
    rows = 1e9 * np.linspace(0.0, 1.0, len(noise))
    columns = (Column({"theta": rows}, 0.0, 5.0), Column({"theta": rows + 1e-9}, 0.0, 5.0))
    same = _distinct(Rival(h, ("arm",), columns, (h.own, h.own)))
    assert len(same.columns) == len(same.starts) == 1
    assert np.isfinite(judge.linear.fit({"theta": noise}, same.columns).log_prior)
    apart = replace(same, columns=(columns[0], Column({"theta": rows[::-1]}, 0.0, 5.0)), starts=(h.own, h.own))
    assert _distinct(apart) is apart


@pytest.mark.promise("Verdict", "A verdict of `none` says from which size on each effect would have shown")
def test_what_would_have_shown_does_and_what_would_not_does_not():
    """Recordings of other rigs and other noise, with twice and with two fifths of the size that is said."""
    duty = Excitation(duration=20.0, duty_max=0.55, seed=8).series()
    read, _ = rig.record(BENCH, duty, 21)
    nothing = from_arrays({**read, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)
    smallest_of = {w.effect: w.smallest for w in would_show(BENCH, [nothing])}
    for effect in ("coulomb_friction", "voltage_offset", "ground_effect"):
        verdicts = []
        for factor in (0.4, 2.0):
            e = DEFINED[effect]
            size = e.parameters[e.size]
            own = {**e.defaults, e.size: size.neutral + factor * smallest_of[effect]}
            read, _ = rig.record(BENCH.with_effects({effect: own}), duty, 22)
            recording = from_arrays({**read, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)
            verdicts.append(diagnose(BENCH, [recording]).conclusions.which.verdict)
        assert verdicts[0] == "none", effect
        assert verdicts[1] != "none", effect


def test_a_recording_at_another_rate_keeps_its_length():
    duty = np.where(np.arange(2000) // 200 % 2, 0.3, 0.1)
    read, _ = rig.record(BENCH, duty, 1, period=0.01)
    s = from_arrays({**read, "duty": duty}, 0.01, BENCH.sensing)
    again = like(BENCH, s)
    assert (again.period, len(again)) == (s.period, len(s))
    assert np.nanstd(again.theta - s.theta) < 0.1 * np.nanstd(s.theta)
