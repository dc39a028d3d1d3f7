# SPDX-License-Identifier: Apache-2.0
"""The report of real diagnoses: what it says, that it stands alone, and that everybody can read it."""

import base64
import json
import math
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise

import numpy as np
import one_way_arm
import pytest

from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.document import Across, Curve, Identified, UnknownEffect, from_json, to_json
from aeropend_ident.diagnosis.report import candidates, curves, drawing, number_format, parameters, traces
from aeropend_ident.diagnosis.report import page as report_page
from aeropend_ident.diagnosis.results import document, verdict_lines
from aeropend_ident.signals.signals import from_arrays
from aeropend_ident.testing.rigs import BENCH, recorded
from aeropend_sim.model.effects import CATALOGUE, PLACES
from aeropend_sim.model.parameters import SAMPLE_PERIOD

VOID = {"area", "base", "br", "col", "embed", "hr", "img", "input", "link", "meta", "source", "track", "wbr"}
HOSTILE = "</script><script>alert('1')</script>\"><img src=x onerror=alert(2)>{{ 7 * 7 }}"


class Page(HTMLParser):
    """A page that is well formed: every tag is closed where it was opened."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.ids, self.texts, self.open = [], Counter(), [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        assert len(attributes) == len(attrs), f"{tag} with an attribute twice"
        self.tags.append((tag, attributes, tuple(self.open)))
        self.ids.update([attributes["id"]] if "id" in attributes else [])
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append((tuple(self.open), data))

    def all(self, tag):
        return [attributes for name, attributes, _ in self.tags if name == tag]

    def text(self, *within):
        """What a person reads inside all of these tags, with single plain spaces."""
        shown = "".join(text for stack, text in self.texts
                        if set(within) <= set(stack) and not {"script", "style"} & set(stack))
        return " ".join(shown.split())

    def data(self):
        return [json.loads(text) for (stack, text), attributes in zip(
            [t for t in self.texts if t[0][-1:] == ("script",)], self.all("script"), strict=True)
            if attributes.get("type") == "application/json"]


def documented(diagnosis, bags=("my_bag",), model="bench", **which):
    """The document of a diagnosis, with other entries in `which`."""
    made = to_json(document(diagnosis, list(bags), model, 2.5))
    return from_json({**made, "which": {**made["which"], **which}})


def rendered(diagnosis, bags=("my_bag",), model="bench", command="diagnose my_bag", **which):
    return report_page.render(diagnosis, documented(diagnosis, bags, model, **which), command)


@pytest.fixture(scope="module")
def friction():
    """Diagnose 16 s of a rig with dry friction."""
    return diagnose(BENCH, [recorded(11, {"coulomb_friction": {}}, duration=16.0)])


@pytest.fixture(scope="module")
def nominal():
    """Diagnose 15 s of a rig that lacks nothing."""
    return diagnose(BENCH, [recorded(2, duration=15.0)])


@pytest.fixture(scope="module")
def several():
    """Diagnose 20 s of a rig with two effects."""
    return diagnose(BENCH, [recorded(71, {"coulomb_friction": {}, "brush_drop": {}}, duration=20.0)])


@pytest.fixture(scope="module")
def angle_only():
    """Diagnose 15 s in which nothing but the angle was measured."""
    return diagnose(BENCH, [recorded(95, {"coulomb_friction": {"accel": 1.5}}, 15.0, 0.005,
                                     ("omega", "i_a", "v_a"))], 2)


@pytest.fixture(scope="module")
def two():
    """Diagnose two recordings of one rig."""
    return diagnose(BENCH, [recorded(12, {"coulomb_friction": {}}, duration=t) for t in (15.0, 18.0)])


@pytest.fixture(scope="module")
def strange():
    """Diagnose 24 s of a rig whose arm is braked while it rises only: no effect of the catalogue."""
    columns = one_way_arm.recorded_columns(1, 24.0, 1.5)
    return diagnose(BENCH, [from_arrays(columns, SAMPLE_PERIOD, BENCH.sensing)])


@pytest.fixture(scope="module", params=["friction", "nominal", "several", "angle_only", "two", "strange"])
def page(request):
    diagnosis = request.getfixturevalue(request.param)
    bags = [f"bag_{k}" for k in range(len(diagnosis.signals))]
    return Page(rendered(diagnosis, bags))


def test_needs_nothing_from_elsewhere(page):
    for tag, attributes, _ in page.tags:
        for name in ("src", "srcset", "data", "action", "poster", "xlink:href"):
            assert name not in attributes, (tag, attributes)
        assert attributes.get("href", "#").startswith(("#", "data:,")), (tag, attributes)
    style = "".join(text for stack, text in page.texts if "style" in stack)
    assert "{" in style
    assert not [word for word in ("url(", "@import", "http:", "https:", "//") if word in style]
    policy = [m["content"] for m in page.all("meta") if m.get("http-equiv") == "Content-Security-Policy"]
    assert len(policy) == 1
    assert policy[0].startswith("default-src 'none'")


def test_everybody_can_read_it(page):
    assert page.all("html") == [{"lang": "en"}]
    assert "width=device-width" in next(m["content"] for m in page.all("meta") if m.get("name") == "viewport")
    headings = [int(tag[1]) for tag, _, _ in page.tags if tag in {"h1", "h2", "h3", "h4"}]
    assert headings.count(1) == 1
    assert headings[0] == 1
    assert all(b <= a + 1 for a, b in pairwise(headings))
    pictures = page.all("svg")
    assert len(pictures) > 20
    for picture in pictures:
        named = picture.get("role") == "img" and len(picture.get("aria-label", "")) > 10
        assert named or picture.get("aria-hidden") == "true", picture
    inside = [(stack, tag) for tag, _, stack in page.tags if tag in {"caption", "thead", "tbody"}]
    assert Counter(tag for _, tag in inside) == dict.fromkeys(("caption", "thead", "tbody"), len(page.all("table")))
    assert all(attributes.get("scope") in {"col", "row"} for attributes in page.all("th"))


def test_what_is_referred_to_is_there(page):
    assert set(page.ids.values()) == {1}
    wanted = [a["aria-labelledby"] for _, a, _ in page.tags if "aria-labelledby" in a]
    wanted += [a["href"][1:] for a in page.all("a")]
    wanted += [a["data-traces"] for a in page.all("figure") if "data-traces" in a]
    assert set(wanted) <= set(page.ids)


def test_traces_are_drawn_and_can_be_zoomed(page):
    figures = page.data()
    assert figures
    paths = [a for a in page.all("path") if "data-series" in a]
    assert len(paths) == sum(len(f["series"]) for f in figures)
    assert all(path["d"].startswith("M") for path in paths)
    for figure in figures:
        assert figure["stop"] > figure["start"]
        lengths = {len(base64.b64decode(s["data"])) for s in figure["series"]}
        assert len(lengths) == 1
        assert lengths.pop() > 2 * 1000


def test_one_effect(friction):
    page = Page(rendered(friction))
    assert page.text("h1") == f"The model lacks coulomb_friction: {CATALOGUE['coulomb_friction'].physics}."
    assert "closes" in page.text("header")
    assert "accel 0.8" in page.text("header")
    assert "rad/s²" in page.text("header")
    assert page.text("title") == "coulomb_friction · diagnose"
    for place in PLACES:
        assert place in page.text("ol")
    body = friction.body
    assert number_format.percent(body["where"]["share"]["arm"]).replace("\N{NO-BREAK SPACE}", " ") in page.text("ol")
    for row in body["channels"].values():
        for key in ("gap", "gap_after", "floor"):
            said = number_format.quantity(row[key], row["unit"]).replace("\N{NO-BREAK SPACE}", " ")
            assert said in page.text("table")
    for name in body["which"]["numbers"]:
        assert name in page.text("table")


def test_nothing_missing(nominal):
    page = Page(rendered(nominal))
    assert page.text("h1") == "The model lacks nothing that this recording shows."
    assert page.text("title") == "nothing missing · diagnose"
    assert "found" not in page.text("table", "span")


def test_several_effects(several):
    assert set(several.body["which"]["effects"]) == {"coulomb_friction", "brush_drop"}
    page = Page(rendered(several))
    first, second = several.body["which"]["effects"]
    assert page.text("h1") == f"The model lacks 2 effects: {first} and {second}."
    for effect in (first, second):
        assert CATALOGUE[effect].physics in page.text("header")
    assert page.text("table", "span").count("found") == 2


def test_unknown(friction):
    rows = [{**r, "found": False} for r in friction.body["which"]["candidates"]]
    page = Page(rendered(friction, verdict="unknown", effects=[], candidates=rows,
                         unexplained=["theta is off by 9.1 times the noise"]))
    assert page.text("h1") == "The model lacks an effect that the catalogue does not contain, at this place: arm."
    assert "theta is off by 9.1 times the noise" in page.text("header")
    assert page.text("title") == "unknown effect · diagnose"


@pytest.mark.parametrize(("reasons", "said"), [
    ([], "(arm). No effect of the catalogue explains the misfit."),
    (["theta is off", "omega is"], "explains the misfit: theta is off; omega is.")])
def test_reasons_for_an_unknown_are_said_where_there_are_any(friction, reasons, said):
    made = documented(friction, verdict="unknown", effects=[], unexplained=reasons)
    assert verdict_lines(made)[0].endswith(said)


def test_what_an_unknown_looks_like(strange):
    unknown = strange.body["which"]["unknown"]
    assert (strange.body["which"]["verdict"], unknown["place"]) == ("unknown", "arm")
    page = Page(rendered(strange))
    assert page.text("h1").endswith("at this place: arm.")
    assert "#unknown" in [a["href"] for a in page.all("a")]
    drawn = [a for a in page.all("path") if a.get("class") == "knots"]
    assert len(drawn) == len(unknown["curves"])
    beyond = sum(t > strange.signals[0].train * SAMPLE_PERIOD for c in unknown["curves"] if c["variable"] == "t"
                 for t in c["at"])
    assert sum(a["d"].count("M") for a in drawn) == sum(len(c["at"]) for c in unknown["curves"]) - beyond + bool(beyond)
    names = page.text("figure", "p").split("torque on the arm")
    assert names[1].strip().startswith(", as acceleration, rad/s² against the arm rate")
    captions = page.text("figcaption")
    assert captions.startswith("Fit of the angle in a free run of the augmented model: ")
    assert "What could be closed of the squared gap" in captions
    assert "Peaks at" in captions
    assert captions.count(".") >= len(drawn)


def test_an_unknown_beside_what_was_found(friction, strange):
    unknown = {**strange.body["which"]["unknown"], "place": "rotor"}
    page = Page(rendered(friction, unknown=unknown))
    assert page.text("h1").startswith("The model lacks coulomb_friction")
    assert "does not contain acts at this place: rotor." in page.text("header")
    assert "unknown" in page.ids
    assert "unknown" not in Page(rendered(friction)).ids


def of(variable, at, value, unit="rad/s²"):
    return Curve(variable, unit, tuple(float(x) for x in at), tuple(float(v) for v in value))


def plain(text):
    return text.replace("\N{NO-BREAK SPACE}", " ")


FACTORS = curves.Factors(thrust=10.0, rate=0.5, current=0.4, step=0.3)
NINE = np.linspace(-2.0, 2.0, 9)


def test_curves_are_drawn_without_what_a_number_does():
    drawn = curves.draw(UnknownEffect("arm", (
        of("theta", NINE / 4, 5.0 * NINE + 3.0),
        of("theta_dot", NINE, -np.abs(NINE) - 2.0 * NINE + 7.0))), FACTORS, 49.0).pictures
    assert [c.variable.phrase for c in drawn] == ["the arm rate", "the arm angle"]
    first, second = (plain(c.text) for c in drawn)
    assert first == ("Peaks at 0 rad/s² near 0 rad/s, from −2.0 rad/s² at −2.0 rad/s to −2.0 rad/s² at 2.0 rad/s; "
                     "in addition a straight line, −8.0 rad/s² from end to end, that parameters of the model can "
                     "describe.")
    assert second == ("Almost zero; in addition a straight line, 20 rad/s² from end to end, that parameters of the "
                      "model can describe.")
    heights = [float(p.split()[1]) for p in drawn[1].curve[1:].split("L")]
    assert max(heights) - min(heights) <= 1.0


def test_curves_that_are_multiplied_keep_their_slope():
    late = [of(f"step of the duty, {k} samples ago", [0.0, 1.0], v, "V")
            for k, v in enumerate(([-2.0], [0.0, -1.0], [-0.5]))]
    slow = of("omega, slowly (share of the thrust)", 50.0 + NINE, -NINE / 20.0, "-")
    (share,) = curves.draw(UnknownEffect("thrust", (slow,)), FACTORS, 49.0).pictures
    assert share.unit == "%"
    assert "falls from 0 % at 48 rad/s to −20 % at 52 rad/s" in plain(share.label)
    (steps,) = curves.draw(UnknownEffect("actuator", tuple(late)), FACTORS, 49.0).pictures
    assert steps.variable.phrase == "samples after a step of the duty"
    assert steps.knots.count("M") == 3
    assert steps.unit == "V per unit of duty"


def test_a_share_of_the_thrust_ends_where_no_thrust_is_left():
    wild = of("omega (share of the thrust)", [1.0, 20.0, 40.0, 60.0], [-63.0, -0.2, -0.1, 0.0], "-")
    (share,) = curves.draw(UnknownEffect("thrust", (wild,)), FACTORS, 49.0).pictures
    assert plain(share.text).startswith("Rises from −100 % at 0 rad/s to 15 % at 60 rad/s")
    assert plain(share.text).endswith("it is cut off at 100 %, where there is too little thrust to show it.")


def test_a_curve_over_time_ends_with_the_data():
    over_time = of("t", [0.0, 20.0, 40.0, 60.0, 70.0], [1.0, 2.0, 4.0, 0.0, 0.0])
    (made,) = curves.draw(UnknownEffect("arm", (over_time, of("theta", [], []))), FACTORS, 49.0).pictures
    assert plain(made.text) == "Rises from 0 rad/s² at 0 s to 3.0 rad/s² at 49 s."
    assert curves.draw(UnknownEffect("arm", ()), FACTORS, 49.0) is None


@pytest.mark.parametrize(("y", "text"), [
    ([0, 0, 0, 0, 3, 3, 3, 3, 3], "rises from 0 V at −2.0 A to 3.0 V at 2.0 A, most of it between −0.50 A and 0 A"),
    ([0, 1, 2, 1, 0, -1, -2, -1, 0], "goes up and down, highest at 2.0 V near −1.0 A, lowest at −2.0 V near 1.0 A"),
    ([4, 3, 2, 1, 0, 1, 2, 3, 4], "dips at 0 V near 0 A, from 4.0 V at −2.0 A to 4.0 V at 2.0 A"),
])
def test_shapes_in_words(y, text):
    assert plain(curves._shape(NINE, np.array(y, dtype=float), "A", "V")) == text


def test_regions_are_marked_where_the_misfit_is_drawn(several, nominal):
    regions = several.body["where"]["regions"]
    assert regions
    page = Page(rendered(several))
    marked = [a for a in page.all("rect") if a.get("class") == "range"]
    assert len(marked) == len(regions)
    assert all(0.0 <= float(a["x"]) <= float(a["x"]) + float(a["width"]) <= drawing.WIDTH + 0.2 for a in marked)
    said = [a["aria-label"] for a in page.all("svg") if a.get("aria-label", "").startswith("Misfit")]
    assert len(said) == 6
    assert sum("stands out" in text for text in said) == len(regions)
    if not nominal.body["where"]["regions"]:
        assert "Misfit" not in rendered(nominal)


@pytest.mark.promise("Verdict", "The report says when to read it with care")
def test_reasons_for_care(friction, angle_only):
    def care(diagnosis, **which):
        page = Page(rendered(diagnosis, **which))
        return page.text("header", "div")

    assert "Only 11 s of data were fitted" in care(friction)
    assert "Not measured: rotor speed, armature current, armature voltage." in care(angle_only)
    both = ["coulomb_friction", next(r["effect"] for r in friction.body["which"]["candidates"]
                                     if r["effect"] not in {"coulomb_friction", "parameter_mismatch"})]
    rows = [{**r, "found": r["effect"] in both, "probability": min(r["probability"], 0.8), "place": "arm"}
            for r in friction.body["which"]["candidates"]]
    unsure = care(friction, candidates=rows, effects=both)
    assert f"Probability below 95 %: {', '.join(both)}." in unsure
    assert f"No signal is measured between these: {', '.join(both)}." in unsure
    numbers = friction.body["which"]["numbers"]
    moved = {**numbers, "R_a": {"nominal": 1.0, "value": 1.2, "low": 1.1, "high": 1.3}}
    assert "not part of the verdict: R_a. Check them in the model file." in care(friction, numbers=moved)
    still = replace(friction.signals[0], duty=np.full(len(friction.signals[0]), 0.3))
    assert "The duty stayed the same" in care(replace(friction, signals=[still]))
    calm = replace(still, duty=np.linspace(0.3, 0.4, len(still)))
    assert "The duty varied by only 0.10" in care(replace(friction, signals=[calm]))
    noted = replace(friction.signals[0], notes=("not measured: v_a", "2 samples are missing in 1 gap"))
    assert "1 note describes" in care(replace(friction, signals=[noted]))
    assert "note" not in care(friction)
    conclusions = friction.conclusions
    open_ = replace(conclusions, closure=replace(conclusions.closure, closed=0.6))
    assert "Only 60 % of the gap closes" in care(replace(friction, conclusions=open_))


@pytest.mark.promise("Verdict", "The report says when to read it with care")
def test_a_good_recording_needs_no_care(friction):
    long = replace(friction.signals[0], period=4.0 * SAMPLE_PERIOD)
    assert "with care" not in rendered(replace(friction, signals=[long]))


def test_a_number_that_is_off(friction):
    refitted = friction.body["which"]["numbers"]["R_a"]["value"]
    rows = [{"effect": "parameter_mismatch", "place": "electrical", "probability": p, "gap_after": 0.1, "found": mine,
             "parameters": {"R_a": {"value": value, "low": 1.0, "high": 2.0}}}
            for p, value, mine in ((0.9, refitted, True), (0.1, 7.0, False))]
    page = Page(rendered(friction, verdict="parameter_mismatch", effects=["parameter_mismatch"], candidates=rows))
    assert page.text("h1") == "The structure of the model is right, but R_a (armature resistance) is off."
    assert "nominal 1.08 Ω" in page.text("header")
    assert page.text("table", "span").count("found") == 1


def test_effects_and_a_number_together(friction):
    rows = [r for r in friction.body["which"]["candidates"] if r["effect"] == "coulomb_friction"]
    value = friction.body["which"]["numbers"]["J_m"]["value"]
    rows += [{"effect": "parameter_mismatch", "place": "rotor", "probability": 1.0, "gap_after": 0.1, "found": True,
              "parameters": {"J_m": {"value": value, "low": 0.9 * value, "high": 1.1 * value}}}]
    page = Page(rendered(friction, effects=["coulomb_friction", "parameter_mismatch"], candidates=rows))
    assert page.text("h1") == "The model lacks coulomb_friction, and J_m is off."


def test_what_is_open(friction):
    advice = {"why": "slow ramps tell them apart", "excite": {"kind": "steps", "duration": 60, "sequence": [0.1, 0.2]}}
    page = Page(rendered(friction, not_separable=[["coulomb_friction", "quadratic_drag"]], next_experiment=advice))
    assert "cannot separate coulomb_friction from quadratic_drag: either explains it" in page.text("main")
    assert "(coulomb_friction: probability > 99.9 %, gap after 1.2 %; quadratic_drag: " in page.text("main")
    assert "slow ramps tell them apart" in page.text("main")
    assert page.text("main", "pre") == (
        "excite --ros-args -p kind:=steps -p duration:=60 -p 'sequence:=[0.1, 0.2]'"
        "design --model bench --separate coulomb_friction quadratic_drag")
    assert "cannot separate" not in Page(rendered(friction, not_separable=[], next_experiment=None)).text("main")


@pytest.mark.promise("Verdict", "Pairs that cannot be separated are named where one of them is part of the verdict")
def test_a_pair_that_does_not_concern_the_verdict_is_not_named(friction):
    advice = {"why": "slow ramps tell them apart", "excite": {}}
    which = {"not_separable": [["thrust_lag", "encoder_lag"]], "next_experiment": advice}
    page = Page(rendered(friction, **which))
    assert "cannot separate" not in page.text("main")
    assert "slow ramps" not in page.text("main")
    assert not [line for line in verdict_lines(documented(friction, **which)) if "separable" in line or "next" in line]


@pytest.mark.promise("Verdict", "The report lists every hypothesis that was tried, how far it came and why it lost")
def test_what_was_tried_is_listed_with_the_reason_why_it_lost(friction, strange):
    page = Page(rendered(friction))
    assert "part of the verdict" in page.text("table")
    assert page.text("table").count("less evidence than coulomb_friction; leaves a larger gap") >= 5
    page = Page(rendered(strange))
    assert "no more evidence than without it" in page.text("table")
    for c in strange.conclusions.which.candidates:
        assert c.effect in page.text("table")
        assert number_format.percent(c.gap_after).replace("\N{NO-BREAK SPACE}", " ") in page.text("table")


def test_nothing_tried_is_said(nominal):
    assert "No effect was tried: refitted parameters leave too little" in Page(rendered(nominal)).text("main")
    failed = Page(rendered(nominal, verdict="cannot_tell"))
    assert "No effect was tried, since the nominal model could not be identified." in failed.text("main")


@pytest.mark.parametrize(("changes", "reason"), [
    ({"found": True}, ""),
    ({"share": {"value": 0.2, "low": -0.1, "high": 0.4}}, "its share of the squared gap is not surely above 0"),
    ({"share": {"value": 0.01, "low": 0.005, "high": 0.02}},
     "its share of the squared gap is too small or too unsure, or other effects could close it"),
    ({"gap_after": 0.2}, "less evidence than thrust_lag; does not make the gap smaller"),
    ({"gap_after": 0.0122, "behind": "parameter_mismatch:R_a"}, "less evidence than R_a"),
    ({"gap_after": None, "behind": None, "evidence": -3.0}, "no more evidence than without it"),
    ({"gap_after": None, "behind": None, "evidence": 3.0}, "too improbable"),
    ({"parameters": {"tau": {"value": 10.0, "low": 9.0, "high": 10.0}}, "gap_after": None},
     "tau is at the end of its range; less evidence than thrust_lag"),
])
def test_reasons_why_a_hypothesis_lost(friction, changes, reason):
    row = {"effect": "gust", "place": "arm", "probability": 0.1, "parameters": {}, "found": False, "gap_after": 0.05,
           "evidence": 1.0, "behind": "thrust_lag", **changes}
    if "parameters" in changes:
        end = CATALOGUE["gust"].parameters["tau"].high
        row["parameters"] = {"tau": {"value": end, "low": 0.9 * end, "high": end}}
    made = documented(friction, candidates=[row])
    assert candidates.why_lost(made, made.which.candidates[0]) == reason


def test_a_rival_has_the_gap_of_a_model_without_what_was_found(friction):
    found, *rivals = friction.conclusions.which.candidates
    assert len(rivals) >= 5
    assert all(r.behind == "coulomb_friction" and r.gap_after > 3.0 * found.gap_after for r in rivals)


@pytest.mark.promise("Verdict", "A report without a verdict says so at the top, in red")
def test_a_failed_diagnosis_says_so_at_the_top(friction, strange):
    why = "the model does not predict the rig: it is off; record more"
    page = Page(rendered(strange, verdict="cannot_tell", effects=[], unexplained=[why]))
    assert page.text("h1") == "Cannot tell: the model does not predict the rig."
    assert "It is off. Record more." in page.text("header")
    assert page.all("body") == [{"class": "subdued"}]
    (banner,) = [a for a in page.all("p") if a.get("role") == "alert"]
    assert banner["class"] == "failed"
    assert "unknown" not in page.ids
    assert Page(rendered(friction)).all("body") == [{}]


@pytest.mark.promise("Verdict", "The report shows what test recordings say")
def test_test_recordings_are_in_the_report(friction):
    tests = (Across("tuesday", 0.12, 0.013, 0.011, 0.981, 0.97, 0.99),
             Across("wednesday", 0.1, 0.3, 0.01, -2.0, -3.0, 0.1))
    made = document(friction, ["monday"], "bench", 2.5, tests)
    page = Page(report_page.render(friction, made, "diagnose monday --test tuesday --test wednesday"))
    assert "On 2 test recordings, which no fit has used, none to 98 % of the gap closes." in page.text("header")
    assert "tuesday12 %1.3 %1.1 %98 %(97 % to 99 %)" in page.text("table")
    assert "wednesday10 %30 %1.0 %none" in page.text("table")


def test_the_subtitle_of_an_identified_rig_names_no_preset(friction):
    assert "model bench" in Page(rendered(friction)).text("header")
    made = replace(documented(friction), identified=Identified("the angle", ()))
    page = Page(report_page.render(friction, made, "diagnose my_bag --uncalibrated"))
    assert "model identified from this recording" in page.text("header")
    assert "bench" not in page.text("header")


def test_the_whole_recording_is_drawn_and_the_held_out_part_is_marked(friction):
    page = Page(rendered(friction))
    (data,) = page.data()
    s = friction.signals[0]
    assert (data["start"], data["unseen"], data["stop"]) == (0.0, s.train * s.period, len(s) * s.period)
    marked = [a for a in page.all("rect") if a.get("class") == "unseen"]
    assert len(marked) == 1 + 2 * 4
    for a in marked:
        assert float(a["x"]) == pytest.approx(0.7 * drawing.WIDTH, abs=1.0)
        assert float(a["x"]) + float(a["width"]) == pytest.approx(drawing.WIDTH, abs=0.2)
    assert "99 % on the fitted part, 99 % on the held-out one." in page.text("figcaption")


def test_a_model_that_runs_away_does_not_hide_the_readings(friction):
    s = friction.signals[0]
    away = [{**readings, "theta": readings["theta"] + np.geomspace(1e-3, 1e9, len(s))} for readings in friction.after]
    strips = traces.section(replace(friction, after=away), documented(friction)).full[0].strips
    low, high = next(strip.within for strip in strips if strip.variable.name == "arm angle")
    assert high - low == pytest.approx(3.0 * np.nanmax(s.theta) - 3.0 * np.nanmin(s.theta))
    heights = [float(y) for strip in strips for line in strip.lines for y in line.path[1:].split("l")[0].split()[1:]]
    assert all(0.0 <= y <= drawing.HEIGHT for y in heights)


def test_a_number_that_moved_is_marked(friction):
    numbers = friction.body["which"]["numbers"]
    moved = {"R_a": {"nominal": 1.0, "value": 1.2, "low": 1.1, "high": 1.3},
             "L_a": {"nominal": 1.0, "value": 0.96, "low": 0.95, "high": 0.97}}
    page = Page(rendered(friction, numbers={**numbers, **moved}))
    marked = [text for stack, text in page.texts if stack[-2:] == ("td", "span")]
    assert "+20\N{NO-BREAK SPACE}%" in marked
    off = [a for tag, a, stack in page.tags if a.get("class") == "off"]
    assert len(off) == 1 + sum(abs(n["value"] / n["nominal"] - 1.0) > parameters.OFF
                               for name, n in numbers.items() if name not in moved)


def test_missing_channels_are_said(angle_only):
    page = Page(rendered(angle_only))
    assert "Not measured: rotor speed, armature current, armature voltage." in page.text("main")
    assert len(page.data()[0]["series"]) == 1 + 3 + 2


def test_a_short_free_decay_is_drawn_without_what_it_lacks(angle_only):
    s = angle_only.signals[0]
    read = np.arange(len(s)) % 20 == 0
    still = replace(s, duty=np.zeros(len(s)), theta=np.where(read, s.theta, math.nan))
    page = Page(rendered(replace(angle_only, signals=[still])))
    assert len(page.data()[0]["series"]) == 3 + 2
    assert "duty, applied" not in page.text("main")
    assert "too few readings for these pictures" in page.text("main")


def test_several_recordings_are_told_apart(two):
    page = Page(rendered(two, ["monday", "tuesday"]))
    captions = page.text("figcaption")
    assert captions.index("monday. Fit") < captions.index("tuesday. Fit")
    assert len(page.data()) == 2
    assert "the last part of each recording" in page.text("header")


def test_notes_of_several_recordings_name_their_recording(two):
    noted = replace(two, signals=[replace(s, notes=(f"{k} samples are missing",)) for k, s in enumerate(two.signals)])
    made = document(noted, ["monday", "tuesday"], "bench", 1.0)
    assert made.notes == ("monday: 0 samples are missing", "tuesday: 1 samples are missing")
    assert document(replace(noted, signals=noted.signals[:1]), ["monday"], "bench", 1.0).notes == (
        "0 samples are missing",)


def test_names_cannot_inject(friction):
    signals = [replace(friction.signals[0], notes=(HOSTILE,))]
    text = rendered(replace(friction, signals=signals), [HOSTILE], HOSTILE, f"diagnose {HOSTILE}",
                    unexplained=[HOSTILE], next_experiment={"why": HOSTILE, "excite": {HOSTILE: HOSTILE}})
    page, harmless = Page(text), Page(rendered(friction, next_experiment={"why": "", "excite": {"a": "b"}}))
    assert len(page.all("script")) == len(harmless.all("script")) == 2
    assert page.all("img") == []
    assert page.text("body").count(HOSTILE) >= 6
    assert not [a for _, a, _ in page.tags if any(name.startswith("on") for name in a)]


def test_a_long_recording_stays_small(friction):
    rng = np.random.default_rng(0)
    n = 100_000
    one = friction.signals[0]
    noise = {c: rng.standard_normal(n) for c in ("theta", "omega", "i_a", "v_a")}
    long = replace(one, duty=rng.random(n), train=30_000, **noise)
    far = [{c: x + rng.standard_normal(n) for c, x in noise.items()}] * 5
    text = rendered(replace(friction, signals=[long] * 5, before=far, after=far), list("abcde"))
    assert len(text.encode()) < 1_500_000
    page = Page(text)
    assert len(page.data()) == 4
    assert "The arm angle of the other recordings" in page.text("main")
    captions = page.text("figcaption")
    assert all(f"{bag}. Fit of the angle" in captions for bag in "abcde")
