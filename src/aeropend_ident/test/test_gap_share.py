# SPDX-License-Identifier: Apache-2.0
"""The verdict goes by the parts of the gap."""

from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace

import numpy as np
import pytest

from aeropend_ident.diagnosis import gap_share
from aeropend_ident.diagnosis.free_run_gap import Gap
from aeropend_ident.diagnosis.gap_share import UNKNOWN, Part, headline, shares, unexplained
from aeropend_ident.diagnosis.search.free_curves import Repeatable


def part(name, amount, place="arm", unsure=0.0, windows=10):
    return Part(name, place, amount, np.full(windows, float(amount)), unsure)


def test_shares_are_parts_of_the_whole_gap_the_unexplained_rest_included():
    found = shares([part("coulomb_friction", 3.0), part("brush_drop", 1.0), part("", 1.0)])
    assert {name: s.value for name, s in found.items()} == {"coulomb_friction": 0.6, "brush_drop": 0.2}
    found = shares([part("coulomb_friction", 3.0), part("brush_drop", 1.0), part("", 1.0)], shared=0.0)
    assert all(s.low == pytest.approx(s.value) == pytest.approx(s.high) for s in found.values())


def test_what_is_unexplained_widens_the_interval_of_a_share():
    widths = [(s := shares([part("gust", 1.0), part("", rest)])["gust"]).high - s.low for rest in (0.0, 0.05, 0.5)]
    assert widths[0] < 1e-9 < 0.05 < widths[1] < widths[2] < 1.0
    # the amplitude is sqrt(2/3), give or take 1.96 times half of sqrt(1/3)
    found = shares([part("gust", 1.0), part("", 0.5)])["gust"]
    assert found.low == pytest.approx((np.sqrt(2 / 3) - 0.98 * np.sqrt(1 / 3)) ** 2, abs=0.03)


def test_an_uncertain_size_and_a_gap_that_varies_widen_the_interval():
    steady, unsure = part("a", 1.0), part("a", 1.0, unsure=0.2)
    varying = Part("a", "arm", 1.0, np.tile([0.0, 2.0], 5))
    widths = [(s := shares([one, part("b", 1.0)])["a"]).high - s.low for one in (steady, unsure, varying)]
    assert widths[0] < 1e-9 < widths[1]
    assert 0.1 < widths[2] < 1.0


def test_effects_that_stand_in_for_each_other_have_parts_that_add_up_to_what_they_close_together():
    alike = [part("quadratic_drag", 0.5), part("coulomb_friction", 1.5), part("gust", -0.1)]
    assert [p.amount for p in gap_share._adding_up(alike, 4.0)] == pytest.approx([1.0, 3.0, -0.1])
    assert [p.windows[0] for p in gap_share._adding_up(alike, 4.0)] == pytest.approx([1.0, 3.0, -0.1])
    assert [p.amount for p in gap_share._adding_up(alike, 1.0)] == pytest.approx([0.25, 0.75, -0.1])
    assert [p.amount for p in gap_share._adding_up(alike, -1.0)] == [p.amount for p in alike]
    alone = part("gust", -0.1)
    assert [p.amount for p in gap_share._adding_up([alone], -0.1)] == [-0.1]


def test_what_another_effect_could_close_is_not_claimed():
    imitates, real = replace(part("angle_offset", 3.0), unique=0.01), replace(part("thrust_lag", 1.0), unique=2.0)
    parts = [imitates, real]
    head = headline(parts, shares(parts), 0.03)
    assert (head.verdict, head.effects, head.small) == ("thrust_lag", ["thrust_lag"], ["angle_offset"])
    parts = [imitates, replace(real, unique=0.01)]  # each could close what the other does
    assert headline(parts, shares(parts), 0.03).effects == ["angle_offset"]


class Fitted:
    """A joint fit and its gaps: squared gap by the effects that are left out, whether the others are fitted again."""

    def __init__(self, stages, fixed, again):
        self.findings = {f"stage {k}": SimpleNamespace(effects=effects) for k, effects in enumerate(stages)}
        self.chains = SimpleNamespace(known=None, policy=SimpleNamespace(calibrated=True))
        self.fixed, self.again = fixed, again
        self.values = {p.name: 1.0 for effects in stages for h in effects for p in h.own}
        self.before = 2.0

    def unsure(self, effect, form):
        return 0.2 * form

    def fit_without(self, wanted, jobs=1):
        pass

    def without(self, effects, *, others=False):
        names = "".join(sorted(h.name for h in effects))
        return self.again.get(names, self.fixed.get(names)) if others else self.fixed[names]

    def gap_of(self, square):
        square = self.fixed[""] if square is self.values else square
        return Gap({"theta": np.sqrt(square)}, {"theta": 1.0}, np.full((4, 1), square))

    def floors(self):
        return {"theta": 0.0}

    def parts(self):
        return {p.name: p for p in gap_share.parts_of_effects(self, self, self.gap_of(self.before), 0.03)}


def effect(name, parameter=""):
    return SimpleNamespace(name=name, place="arm", parameter=parameter, own=[SimpleNamespace(name=f"{name}.size")])


def stand_ins():
    """Effects a and b, each of which could close what the other does; and c, which no other imitates."""
    fixed = {"": 0.1, "a": 0.5, "b": 0.7, "c": 0.2, "bc": 0.9, "ac": 0.6, "ab": 0.8, "abc": 1.0}
    return Fitted([[effect("a"), effect("b"), effect("c")]], fixed, {"a": 0.11, "b": 0.12, "c": 0.2, "ab": 0.6})


def test_beside_small_imperfections_one_of_two_effects_that_stand_in_for_each_other_is_unique(monkeypatch):
    monkeypatch.setattr(gap_share, "SEVERAL", 0)
    parts = stand_ins().parts()
    assert [parts[n].unique for n in "abc"] == pytest.approx([0.01, 0.49, 0.1])
    assert [parts[n].instead_of for n in "abc"] == ["b", "", ""]
    head = headline(list(parts.values()), shares(list(parts.values())), 0.03)
    assert set(head.effects) == {"b", "c"}
    assert head.small == ["a"]


def test_without_small_imperfections_the_evidence_tells_effects_apart_that_stand_in_for_each_other():
    fitted = stand_ins()
    parts = list(fitted.parts().values())
    assert not any(p.instead_of for p in parts)
    assert set(headline(parts, shares(parts), 0.03).effects) == {"a", "b", "c"}
    fitted.again["a"] = 0.09  # less is left without it
    parts = list(fitted.parts().values())
    assert headline(parts, shares(parts), 0.03).small == ["a"]
    fitted.chains.policy.calibrated = False
    parts = list(fitted.parts().values())
    assert headline(parts, shares(parts), 0.03).small == ["a"]


@pytest.mark.parametrize(("small", "claimed"), [("", {"a", "b"}), ("c", {"a", "b"}), ("cd", {"b"})])
def test_small_imperfections_are_several_effects_of_less_than_a_material_share(small, claimed):
    names = "ab" + small
    gone = ["".join(c) for n in range(len(names) + 1) for c in combinations(names, n)]
    fixed = {g: 0.1 + sum(0.4 if n in "ab" else 0.002 for n in g) for g in gone}
    again = {"a": 0.11, "b": 0.12, "ab": 0.6, "c": 0.1, "d": 0.1}
    parts = list(Fitted([[effect(n) for n in names]], fixed, again).parts().values())
    assert set(headline(parts, shares(parts), 0.03).effects) == claimed


def test_a_parameter_that_is_off_stands_in_for_an_effect_and_not_the_effect_for_it():
    fixed = {"": 0.1, "a": 0.5, "b": 0.7, "ab": 1.0}
    parts = Fitted([[effect("a"), effect("b", "k0")]], fixed, {"a": 0.11, "b": 0.12}).parts()
    assert [parts[n].unique for n in "ab"] == pytest.approx([0.88, 0.02])
    assert parts["b"].instead_of == "a"
    assert [parts[n].ends[1] for n in "ab"] == pytest.approx([0.9, 0.9])
    head = headline(list(parts.values()), shares(list(parts.values())), 0.03)
    assert (head.effects, head.small) == (["a"], ["b"])


def test_effects_that_cancel_each_other_have_the_parts_of_others_fitted_again():
    a, b, c = effect("a"), effect("b"), effect("c")
    fixed = {"": 0.1, "a": 8.0, "b": 15.0, "c": 0.2, "bc": 9.0, "ac": 14.0, "ab": 0.9, "abc": 1.0}
    parts = Fitted([[a, b, c]], fixed, {"a": 1.2, "b": 0.12, "c": 0.2, "bc": 0.2, "ac": 1.1}).parts()
    scale = 0.9 / (0.95 + 0.1)
    assert [parts[n].amount for n in "abc"] == pytest.approx([scale * 0.95, -0.04, scale * 0.1])
    assert parts["a"].ends == pytest.approx((0.8, 1.1))


def test_an_effect_closes_no_more_than_the_nominal_model_leaves():
    fitted = Fitted([[effect("a")]], {"": 0.1, "a": 0.5}, {})
    assert fitted.parts()["a"].amount == pytest.approx(0.4)
    fitted.before = 0.09
    assert fitted.parts()["a"].amount == pytest.approx(-0.01)
    assert fitted.parts()["a"].unique == pytest.approx(-0.01)


def test_of_an_uncalibrated_rig_all_of_the_error_from_another_form_counts():
    fitted = Fitted([[effect("a")]], {"": 0.0, "a": 1.0}, {})
    assert fitted.parts()["a"].unsure == pytest.approx(0.1)
    fitted.chains.policy.calibrated = False
    assert fitted.parts()["a"].unsure == pytest.approx(0.2)


def test_an_effect_whose_size_may_be_nothing_is_no_claim():
    for unsure, effects in ((0.4, ["cable_torque"]), (0.6, [])):
        parts = [part("cable_torque", 1.0, unsure=unsure), part("", 0.1)]
        assert headline(parts, shares(parts), 0.03).effects == effects


def test_an_effect_whose_size_may_be_nothing_is_doubtful_where_most_stays_unexplained():
    for unsure, rest, doubtful in ((0.6, 2.0, {"cable_torque"}), (0.6, 0.5, set()), (0.4, 2.0, set())):
        assert gap_share.doubtful([part("cable_torque", 1.0, unsure=unsure), part("", rest)]) == doubtful
    assert gap_share.doubtful([part("cable_torque", 1.0, unsure=0.6), part(UNKNOWN, 2.0)]) == set()


def test_false_captures_do_not_count_in_the_shares_of_others():
    found = shares([part(gap_share.CAPTURES, 1000.0), part("gust", 1.0), part("", 1.0)])
    assert found["gust"].value == 0.5
    assert found[gap_share.CAPTURES].value == 1.0


@pytest.mark.parametrize(("parts", "verdict", "effects", "small"), [
    ([], "none", [], []),
    ([part("", 1.0)], "none", [], []),
    ([part("gust", 2.0), part("brush_drop", 3.0)], "brush_drop", ["brush_drop", "gust"], []),
    ([part("gust", 2.0), part("brush_drop", 0.01)], "gust", ["gust"], ["brush_drop"]),
    ([part("gust", 2.0), part("brush_drop", -1.0)], "gust", ["gust"], ["brush_drop"]),
    ([part("gust", 2.0), part(UNKNOWN, 1.0, "thrust")], "gust", ["gust"], []),
    ([part("gust", 1.0), part(UNKNOWN, 2.0, "thrust")], "unknown", [], ["gust"]),
    ([part("gust", 0.6), part("brush_drop", 0.6), part(UNKNOWN, 1.3, "thrust")], "unknown", [], ["gust", "brush_drop"]),
    ([part(UNKNOWN, 0.0, "thrust")], "none", [], []),
])
def test_the_verdict_is_the_largest_part(parts, verdict, effects, small):
    head = headline(parts, shares(parts), 0.03)
    assert (head.verdict, head.effects, head.small) == (verdict, effects, small)
    if verdict == "unknown":
        assert head.place == "thrust"


def test_an_effect_whose_share_may_be_nothing_is_no_claim():
    varying = Part("gust", "arm", 1.0, np.tile([-6.0, 8.0], 5))
    found = shares([varying, part("", 1.0)])
    assert found["gust"].low < 0.0 < found["gust"].value
    head = headline([varying, part("", 1.0)], found, 0.03)
    assert (head.verdict, head.effects, head.small) == ("none", [], ["gust"])
    said = gap_share.why_unsure(found, 0.03)
    assert said.startswith("no effect brings the model surely closer")
    assert "gust, has 50%" in said
    assert gap_share.why_unsure(shares([part("gust", 0.01), part("", 1.0)]), 0.03) == ""
    head = headline([varying, part("brush_drop", 0.5)], shares([varying, part("brush_drop", 0.5)]), 0.03)
    assert head.verdict == "brush_drop"


def test_mismatches_of_two_parameters_are_one_effect():
    parts = [part("parameter_mismatch:R_a", 2.0, "electrical"), part("parameter_mismatch:J_m", 1.0, "rotor")]
    head = headline(parts, shares(parts), 0.03)
    assert (head.verdict, head.place, head.effects) == ("parameter_mismatch", "electrical", ["parameter_mismatch"])


def test_what_is_left_above_the_floor_lies_where_its_channel_shows_it_or_at_the_unknown_effect():
    after = Gap({"theta": 0.2, "i_a": 0.1}, {"theta": 1.0, "i_a": 1.0}, np.full((4, 2), [0.04, 0.01]))
    floors = {"theta": 0.1, "i_a": 0.1}
    (arm,) = unexplained(after, floors, None, None)
    assert (arm.name, arm.place, arm.amount) == ("", "arm", pytest.approx(0.015))
    np.testing.assert_allclose(arm.windows, 0.015)
    arm, unknown = unexplained(after, floors, None, Repeatable("thrust", 0.75))
    assert (arm.name, arm.place, arm.amount) == ("", "arm", pytest.approx(0.25 * 0.015))
    assert (unknown.name, unknown.place, unknown.amount) == (UNKNOWN, "thrust", pytest.approx(0.75 * 0.015))
