# SPDX-License-Identifier: Apache-2.0
"""Experiments by design: the criterion, the limits, the search, and the command."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aeropend_ident.commands.design import main
from aeropend_ident.design.design import design
from aeropend_ident.design.exchange import SHORTEST, TICK, Exchange, Holds, changed, of_series
from aeropend_ident.design.goals import NOTHING, Numbers, Separate, any_effect, between, score
from aeropend_ident.design.limits import LimitError, Limits, crossings
from aeropend_ident.design.responses import Rows, after, asked
from aeropend_ident.diagnosis.isolation.planned import planned
from aeropend_sim.model import excitation_file, rig
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import load

BENCH = load("bench")
LIMITS = Limits(theta=(-0.6, 1.0), i_a=2.0)
FEW = ("coulomb_friction", "cable_torque", "thrust_lag", "encoder_lag", "mast_flex")
SIGNALS = planned(BENCH, Excitation(duration=10.0).series())


def rows_of(*names, sizes=None):
    every = asked(BENCH, sizes=sizes)
    return Rows(BENCH, SIGNALS, {n: every[n] for n in names})


@pytest.fixture(scope="module")
def rows():
    return rows_of(*FEW)


@pytest.fixture(scope="module")
def products(rows):
    return rows.under(Excitation(duration=6.0).series()).products


def test_a_distance_is_what_the_best_fit_of_the_rival_leaves(rows, products):
    """Beside the closed form: an explicit least-squares fit of everything but the effect."""
    effect, rival = "thrust_lag", "encoder_lag"
    ((_, distance),) = Separate(rows, [(effect, rival)]).distances(products).items()
    root = np.linalg.cholesky(products + 1e-6 * np.trace(products) / len(products) * np.eye(len(products)))
    sd = rows.background.copy()
    sd[rows.index(rival)] = rows.wide(rival)
    others = [k for k in range(len(sd)) if k != rows.index(effect)]
    fitted = np.vstack([root[others].T * sd[others], np.eye(len(others))])
    goal = np.concatenate([root[rows.index(effect)], np.zeros(len(others))])
    left = goal - fitted @ np.linalg.lstsq(fitted, goal, rcond=None)[0]
    assert distance == pytest.approx(np.linalg.norm(left), rel=0.02)


def test_a_rival_can_only_bring_an_effect_closer(rows, products):
    found = any_effect(rows, list(rows.effects)).distances(products)
    for effect in FEW:
        assert max(d for (e, r), d in found.items() if e == effect and r != NOTHING) <= found[effect, NOTHING] * 1.0001


def test_twice_the_size_is_twice_as_far(products, rows):
    small = rows_of(*FEW, sizes={"angle_offset": 0.03, "coulomb_friction": 0.4})
    at = Excitation(duration=6.0).series()
    one = Separate(small, [("coulomb_friction", NOTHING)]).distances(small.under(at).products)
    two = Separate(rows, [("coulomb_friction", NOTHING)]).distances(products)
    assert next(iter(two.values())) == pytest.approx(2.0 * next(iter(one.values())), rel=0.15)


def test_a_number_becomes_better_known_with_time(rows):
    short, long_ = (Numbers(rows, ["k_thrust"]).answers(rows.under(Excitation(duration=t).series()).products)[0]
                    for t in (5.0, 20.0))
    assert 1.0 < short.value < long_.value


@pytest.mark.promise("Verdict", "A designed signal keeps its limits on every rig within the uncertainty")
def test_no_rig_within_the_uncertainty_crosses_a_limit(rows):
    found = design(rows, between(rows, ["cable_torque", "coulomb_friction"]), LIMITS, 8.0, tries=40)
    signals = after(SIGNALS, found.excitation.series())
    effects = [e.values for e in rows.effects.values()]
    assert crossings(BENCH, signals, LIMITS, effects, 400, seed=91) == 0
    assert LIMITS.excess(found.reach) <= 0.0
    # the limit is felt: with a tenth more of angle for every duty some rig would cross it
    tight = replace(LIMITS, theta=(LIMITS.theta[0], 0.6 * found.reach["theta"][1]))
    assert crossings(BENCH, signals, tight, effects, 400, seed=91) > 0


def test_the_reach_is_wider_than_any_corner_of_the_tolerance(rows):
    """All numbers at an end of their tolerance at once, in 40 random corners."""
    duty = Excitation(duration=6.0, duty_max=0.4).series()
    low, high = rows.under(duty).reach["theta"]
    rng = np.random.default_rng(3)
    for _ in range(40):
        numbers = {n: x * (1.0 + 0.05 * rng.choice([-1.0, 1.0])) for n, x in BENCH.model.items()}
        _, truth = rig.record(replace(BENCH, model=numbers), duty, 0)
        assert low <= truth["theta"].min()
        assert truth["theta"].max() <= high


def test_limits_that_no_signal_keeps_are_refused(rows):
    with pytest.raises(LimitError, match="no signal keeps the limits"):
        design(rows, between(rows, ["cable_torque"]), Limits(theta=(-1e-4, 1e-4)), 5.0, tries=4)


@pytest.mark.parametrize(("wrong", "said"), [
    ({"theta": (0.1, 1.0)}, "angle 0.1 to 1"), ({"duty": (-0.2, 1.5)}, "within -1 to 1"),
    ({"i_a": 0.0}, "above 0"), ({"duty_rate": -1.0}, "duty rate -1")])
def test_limits_that_make_no_sense_are_refused(wrong, said):
    with pytest.raises(LimitError, match=said):
        Limits(**wrong)


@pytest.mark.promise("Verdict", "A designed signal shows more than the signals that `diagnose` proposes")
def test_the_search_beats_every_signal_it_starts_from(rows):
    goal = between(rows, ["thrust_lag", "encoder_lag"])
    found = design(rows, goal, LIMITS, 8.0, tries=120)
    assert score(found.answers) > score(found.answers_before)
    assert min(a.value for a in found.answers) > 1.2 * min(a.value for a in found.answers_before)


def test_the_number_of_threads_changes_nothing(rows):
    goal = between(rows, ["thrust_lag", "encoder_lag"])
    one, two = (design(rows, goal, LIMITS, 5.0, tries=16, jobs=jobs).excitation for jobs in (1, 3))
    assert one == two


def test_a_signal_gets_no_longer_than_is_needed(rows):
    found = design(rows, between(rows, ["coulomb_friction", "mast_flex"]), LIMITS, tries=8)
    assert found.excitation.duration == 10.0  # the shortest that is tried: both are far above what is needed
    assert all(a.reached >= 1.0 for a in found.answers)


@pytest.mark.parametrize("low", [-0.5, 0.0])
@pytest.mark.parametrize("least", [-0.6, -0.01, 0.0])
@pytest.mark.parametrize("greatest", [0.9, 1.1])
def test_what_exceeds_a_limit_crosses_it(low, least, greatest):
    limits = Limits(theta=(low, 1.0))
    reach = {"theta": (least, greatest), "omega": (0.0, 9.0), "i_a": (0.0, 9.0)}
    assert (limits.excess(reach) > 0.0) == limits.crossed(reach)


@given(st.integers(0, 2**32 - 1))
@settings(deadline=None, derandomize=True)
def test_a_change_keeps_length_grid_and_limits(seed):
    rng = np.random.default_rng(seed)
    limits = Limits(duty=(0.0, 0.5))
    holds = of_series(Excitation(duration=6.0, seed=seed % 1000, hold_min=0.1, hold_max=0.6).series(), limits)
    for _ in range(20):
        holds = changed(holds, limits, rng)
        assert holds.seconds == pytest.approx(6.0, abs=TICK)
        assert min(holds.times) >= SHORTEST - 1e-9
        assert 0.0 <= min(holds.duties) <= max(holds.duties) <= 0.5


def test_a_signal_within_the_limits_is_left_as_it_is(rows):
    exchange = Exchange(rows, between(rows, ["mast_flex"]), LIMITS)
    small = Holds((0.1, 0.0), (3.0, 2.0))
    assert exchange.within(small).holds == small
    large = exchange.within(Holds((0.6, 0.0), (3.0, 2.0)))
    assert 0.1 < max(large.holds.duties) < 0.6


def test_the_command_writes_a_signal_that_excite_plays(tmp_path, capsys):
    out, html = tmp_path / "mine.yaml", tmp_path / "mine.html"
    arguments = ["--separate", "thrust_lag", "encoder_lag", "--duration", "6", "--tries", "8", "--theta", "-0.6", "1.0",
                 "--duty-rate", "2", "--out", str(out), "--html", str(html)]
    assert main(arguments) == 0
    said = capsys.readouterr()
    assert "thrust_lag" in said.out
    assert "mine.yaml: play it with" in said.out
    signal = excitation_file.load(out)
    assert signal.kind == "holds"
    assert signal.duration == 6.0
    assert signal.duty_rate == 2.0
    assert np.abs(np.diff(signal.series())).max() <= 2.0 * SIGNALS.period * 1.000001
    page = html.read_text(encoding="utf-8")
    assert page.count("<svg") == 4
    assert "NaN" not in page
    assert "http" not in page.replace("http://www.w3.org", "")
    assert main(arguments) == 2
    assert "is there already" in capsys.readouterr().err


def test_the_command_prints_json(tmp_path, capsys):
    out = str(tmp_path / "x.yaml")
    assert main(["--fix", "k_thrust", "--duration", "5", "--tries", "4", "--out", out, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["answers"][0]["of"] == "k_thrust"
    assert found["answers"][0]["value"] > 1.0


@pytest.mark.parametrize(("arguments", "said"), [
    (["--separate", "nonsense"], "'nonsense' is no effect"), (["--tries", "0"], "give 1 or more"),
    (["--theta", "0.2", "1"], "angle 0.2 to 1"), (["--duration", "3"], "a time between 5"),
    (["--verdict", "nowhere"], "nowhere"), (["--namespace", "/rig1"], "name a BAG")])
def test_what_cannot_be_designed_is_said_in_one_line(tmp_path, capsys, arguments, said):
    try:
        code = main([*arguments, "--out", str(tmp_path / "x.yaml")])
    except SystemExit as ended:
        code = ended.code
    lines = capsys.readouterr().err.strip().splitlines()
    assert code == 2
    assert len(lines) == 1
    assert said in lines[0]
