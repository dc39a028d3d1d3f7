# SPDX-License-Identifier: Apache-2.0
"""The scoring, on made-up verdicts: each figure is met by a perfect diagnosis and missed by one that earns it."""

import copy
import io
import json
from collections.abc import Callable

import pytest
from evaluation.blind import report, score
from rich.console import Console

from aeropend_sim.model.effects import CATALOGUE, PARAMETER_MISMATCH

SINGLES = [*CATALOGUE, PARAMETER_MISMATCH]


def truth(effect: str) -> dict:
    if effect == PARAMETER_MISMATCH:
        return {"effect": effect, "place": "rotor", "parameters": {"J_m": 2.2e-5}}
    e = CATALOGUE[effect]
    return {"effect": effect, "place": e.place, "parameters": {k: p.default for k, p in e.parameters.items()}}


def label(name: str, kind: str, effects: list[dict], form: str = "table", size: float = 3.0) -> dict:
    return {"name": name, "kind": kind, "form": form, "effects": effects, "size": size}


def verdict(effects: list[dict], first: str | None = None, place: str = "") -> dict:
    """The verdict of a perfect diagnosis of these effects."""
    candidates = [{"effect": e["effect"], "place": e["place"], "probability": 0.99, "found": True,
                   "parameters": {k: {"value": v, "low": v - 1e-9, "high": v + 1e-9}
                                  for k, v in e["parameters"].items()}, "gap_after": None} for e in effects]
    return {"format": 1, "bags": ["bag"], "model": "bench", "duration_s": 40.0, "samples": 19600,
            "train_s": [0.0, 28.0], "held_out_s": [28.0, 40.0], "channels": {},
            "where": {"place": place or (effects[0]["place"] if effects else "none"), "share": {}, "regions": []},
            "which": {"verdict": first or (effects[0]["effect"] if effects else "none"),
                      "effects": [e["effect"] for e in effects], "candidates": candidates, "numbers": {},
                      "residuals": {}, "unexplained": [], "unknown": None, "not_separable": [],
                      "next_experiment": None},
            "shrink": {"gap": 0.5, "gap_after": 0.02, "floor": 0.01, "closed": 0.97 if effects else None,
                       "low": None, "high": None},
            "notes": [], "seconds": 5.0}


def perfect() -> tuple[list[dict], dict[str, dict]]:
    labels, verdicts = [], {}
    for k in range(4):
        for j, effect in enumerate(SINGLES):
            labels.append(label(f"s-{effect}-{k}", "single", [truth(effect)], size=1.5 + 8.5 * (j % 6) / 6.0))
    labels += [label(f"n{k}", "none", [], size=0.0) for k in range(20)]
    labels += [label(f"t{k}", "two", [truth(SINGLES[k]), truth(SINGLES[k + 9])]) for k in range(10)]
    labels += [label(f"o{k}", "outside", [{"effect": "backlash", "place": "arm", "parameters": {"gap": 0.01}}])
               for k in range(10)]
    for t in labels:
        outside = t["kind"] == "outside"
        verdicts[t["name"]] = verdict([] if outside else t["effects"], "unknown" if outside else None,
                                      "arm" if outside else "")
    holding = 0
    for v in verdicts.values():  # 95 % intervals miss now and then
        for c in v["which"]["candidates"]:
            for p in c["parameters"].values():
                holding += 1
                p["high"] += 1.0 if holding % 20 == 0 else 0.0
                p["low"] += 1.0 if holding % 20 == 0 else 0.0
    return labels, verdicts


def judged(labels: list[dict], verdicts: dict[str, dict]) -> dict[str, score.Figure]:
    figures = score.figures(score.pair(labels, verdicts, score.answer_of_diagnosis))
    return {f.name.partition(", worst effect:")[0] + (" (worst)" if "worst" in f.name else ""): f for f in figures}


def names(verdicts: dict[str, dict], start: str, every: int) -> list[str]:
    return [n for n in verdicts if n.startswith(start)][::every]


def retitle(body: dict, effect: str) -> None:
    body["which"]["verdict"], body["which"]["effects"] = effect, [effect]


def wrong_first(v: dict[str, dict]) -> None:
    for n in names(v, "s-", 9):
        retitle(v[n], "gust" if "gust" not in n else "supply_sag")


def one_effect_wrong(v: dict[str, dict]) -> None:
    for n in names(v, "s-thrust_lag", 2):
        retitle(v[n], "encoder_lag")


def not_named(v: dict[str, dict]) -> None:
    for n in names(v, "s-", 20):
        retitle(v[n], "none")


def all_named(v: dict[str, dict]) -> None:
    for n in names(v, "s-", 1):
        first = v[n]["which"]["verdict"]
        v[n]["which"]["not_separable"] = [[first, "gear_lash"], ["spring", first]]


def wrong_place(v: dict[str, dict]) -> None:
    for n in names(v, "s-", 16):
        v[n]["where"]["place"] = "nowhere"


def false_alarm(v: dict[str, dict]) -> None:
    retitle(v["n3"], "gust")


def one_of_two(v: dict[str, dict]) -> None:
    for n in names(v, "t", 3):
        v[n]["which"]["effects"] = v[n]["which"]["effects"][:1]


def outside_named(v: dict[str, dict]) -> None:
    for n in names(v, "o", 4):
        retitle(v[n], "gust")


def outside_misplaced(v: dict[str, dict]) -> None:
    for n in names(v, "o", 6):
        v[n]["where"]["place"] = "rotor"


def move_intervals(by: float, every: int) -> Callable[[dict[str, dict]], None]:
    def change(v: dict[str, dict]) -> None:
        for n in names(v, "s-", every):
            for p in v[n]["which"]["candidates"][0]["parameters"].values():
                p["low"], p["high"] = p["low"] - by, p["high"] + by
    return change


def empty_intervals(v: dict[str, dict]) -> None:
    for n in names(v, "s-", 8):
        v[n]["which"]["candidates"][0]["parameters"] = {}


def little_closed(v: dict[str, dict]) -> None:
    for body in v.values():
        body["shrink"]["closed"] = 0.85


def slow(v: dict[str, dict]) -> None:
    for body in v.values():
        body["seconds"] = 10.5


@pytest.mark.promise("Measurements", "Each figure of the blind check can fail")
@pytest.mark.parametrize(("spoil", "missed"), [
    (wrong_first, "right effect first"),
    (one_effect_wrong, "right effect first (worst)"),
    (not_named, "right effect first or named with the first"),
    (all_named, "names given, median"),
    (wrong_place, "right place"),
    (false_alarm, "none: an effect claimed"),
    (one_of_two, "both of two"),
    (outside_named, "outside: unknown"),
    (outside_misplaced, "outside: right place"),
    (move_intervals(10.0, 1), "95 % intervals that hold the truth"),
    (empty_intervals, "95 % intervals that hold the truth"),
    (little_closed, "share of the closable gap closed, median"),
    (slow, "seconds, median"),
])
def test_each_figure_can_fail(spoil: Callable[[dict[str, dict]], None], missed: str) -> None:
    labels, verdicts = perfect()
    before = judged(labels, verdicts)
    assert [n for n, f in before.items() if f.judged and not f.met] == []
    spoil(verdicts)
    after = judged(labels, verdicts)
    assert not after[missed].met
    assert after[missed].value != before[missed].value


def test_a_missing_verdict_is_a_miss_everywhere() -> None:
    labels, verdicts = perfect()
    figures = judged(labels, {})
    assert all(not f.met for n, f in figures.items() if f.judged and n not in (
        "names given, median", "none: an effect claimed"))
    assert figures["no verdict at all"].value == 1.0
    refused = {n: {"error": "cannot tell", "seconds": 1.0} for n in verdicts}
    assert judged(labels, refused)["no verdict at all"].value == 1.0


def test_another_number_is_wrong() -> None:
    t = label("a", "single", [truth(PARAMETER_MISMATCH)])
    body = verdict(t["effects"])
    (right,) = score.pair([t], {"a": body}, score.answer_of_diagnosis)
    assert score.right_first(*right)
    body["which"]["candidates"][0]["parameters"] = {"K_t": {"value": 7e-3, "low": 6e-3, "high": 8e-3}}
    (wrong,) = score.pair([t], {"a": body}, score.answer_of_diagnosis)
    assert not score.right_first(*wrong)
    assert not score.right_named(*wrong)
    matrix = score.confusion([wrong])
    assert matrix.counts[0][matrix.columns.index(score.OTHER_NUMBER)] == 1


@pytest.mark.parametrize("entry", [PARAMETER_MISMATCH, f"{PARAMETER_MISMATCH}:J_m"])
def test_a_number_that_is_not_separable_counts_as_named(entry: str) -> None:
    t = label("a", "single", [truth(PARAMETER_MISMATCH)])
    body = verdict([truth("rotor_friction"), *t["effects"]])
    body["which"]["effects"] = ["rotor_friction"]
    body["which"]["candidates"][1]["found"] = False
    ((_, before),) = score.pair([t], {"a": body}, score.answer_of_diagnosis)
    assert not score.right_named(score.Label.read(t), before)
    body["which"]["not_separable"] = [["gust", "mast_flex"], ["rotor_friction", entry]]
    ((_, after),) = score.pair([t], {"a": body}, score.answer_of_diagnosis)
    assert after.named == ("rotor_friction", "parameter_mismatch:J_m")
    assert score.right_named(score.Label.read(t), after)
    assert not score.right_first(score.Label.read(t), after)


def test_an_angle_holds_the_truth_in_any_turn() -> None:
    effect = truth("encoder_eccentricity")
    effect["parameters"]["phase"] = -3.1
    t = label("a", "single", [effect])
    body = verdict([effect])
    body["which"]["candidates"][0]["parameters"]["phase"] = {"value": 3.2, "low": 3.1, "high": 3.3}
    assert score.intervals_held(score.pair([t], {"a": body}, score.answer_of_diagnosis), "table") == [True, True]
    body["which"]["candidates"][0]["parameters"]["phase"] = {"value": 3.1, "low": 3.0, "high": 3.15}
    assert score.intervals_held(score.pair([t], {"a": body}, score.answer_of_diagnosis), "table") == [True, False]


def test_forms_are_told_apart_and_what_has_no_size_is_in_no_class() -> None:
    labels, verdicts = perfect()
    for t in labels[:12]:
        t["form"] = "other"
    labels[20]["size"] = 0.0
    figures = judged(labels, verdicts)
    assert figures["right effect first, another form"].count == 12
    assert figures["right effect first, form of the table"].count == 4 * len(SINGLES) - 12
    classes = score.by_size(score.pair(labels, verdicts, score.answer_of_diagnosis))
    assert sum(f.count for f in classes) == 4 * len(SINGLES) - 1


def test_calibration_tells_overconfidence() -> None:
    labels, verdicts = perfect()
    honest = score.calibration(score.pair(labels, verdicts, score.answer_of_diagnosis))
    assert honest.brier == pytest.approx(1e-4)
    wrong_first(verdicts)
    for body in verdicts.values():
        for c in body["which"]["candidates"]:
            if c["effect"] != body["which"]["verdict"] and body["which"]["verdict"] in CATALOGUE:
                c["effect"], c["parameters"] = body["which"]["verdict"], {}
    sure = score.calibration(score.pair(labels, verdicts, score.answer_of_diagnosis))
    assert sure.brier is not None
    assert sure.brier > 0.05
    top = sure.classes[-1]
    assert top.value is not None
    assert sure.stated[-1] == pytest.approx(0.99)
    assert top.value < 0.95


def test_intervals_are_those_of_the_books() -> None:
    assert score.wilson(9, 10) == pytest.approx((0.5958, 0.9821), abs=1e-4)  # Wilson (1927), as in Newcombe (1998)
    f = score.median("x", range(1, 101))
    assert (f.value, f.low, f.high) == (50.5, 40.0, 61.0)  # order statistics 40 and 61 of 100
    assert not score.share("x", [], at_least=0.5).met
    assert not score.median("x", [], at_most=0.5).met


@pytest.mark.parametrize("bad", [
    {"kind": "two"}, {"kind": "single", "effects": []}, {"kind": "none"}, {"form": "lugre"}, {"kind": "strange"}])
def test_labels_that_make_no_sense_are_refused(bad: dict) -> None:
    with pytest.raises(ValueError, match="label of a"):
        score.Label.read(label("a", "single", [truth("gust")]) | bad)


def test_answers_without_labels_are_refused() -> None:
    labels, verdicts = perfect()
    with pytest.raises(ValueError, match="no label"):
        score.pair(labels[1:], verdicts, score.answer_of_diagnosis)
    with pytest.raises(ValueError, match="one name"):
        score.pair([labels[0], *labels], verdicts, score.answer_of_diagnosis)


def test_report_writes_figures_and_pictures(tmp_path) -> None:
    labels, verdicts = perfect()
    some = [t["name"] for t in labels[:30]]
    peers = {"blind guess": {n: {"effects": ["gust"], "place": "arm", "seconds": 0.1} for n in some}}
    limits = {n: {"accuracy": 1.0, "hardest": "gust", "distance": 50.0} for n in some}
    text = io.StringIO()
    result = report.report(labels, verdicts, peers, tmp_path / "out", limits, Console(file=text, width=140))
    assert result["passed"]
    assert json.loads((tmp_path / "out" / "results.json").read_text()) == result
    assert result["misses"] == []
    assert result["peers"]["blind guess"]["recordings"] == 30
    assert result["peers"]["blind guess"]["figures"][0]["value"] < 0.1
    assert result["peers"]["blind guess"]["diagnose"][0]["value"] == 1.0
    for picture in ("confusion", "size", "calibration"):
        assert (tmp_path / "out" / f"{picture}.png").read_bytes().startswith(b"\x89PNG")
    assert "missed" not in text.getvalue()
    worse = copy.deepcopy(verdicts)
    for n in some[:2]:
        retitle(worse[n], "none")
    result = report.report(labels, worse, peers, tmp_path / "out", limits, Console(file=text, width=140))
    assert not result["passed"]
    assert [f["met"] for f in result["figures"] if f["name"] == "below the limit"] == [False]
    assert [m["name"] for m in result["misses"]] == some[:2]
