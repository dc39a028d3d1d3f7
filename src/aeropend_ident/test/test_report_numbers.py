# SPDX-License-Identifier: Apache-2.0
"""Whatever the numbers of a diagnosis are, page and terminal show no figure that a person cannot read."""

import dataclasses
import math
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.document import (
    CANNOT_TELL,
    Across,
    Curve,
    GapBudget,
    HangingAngle,
    Identified,
    Interval,
    Lift,
    Region,
    UnknownEffect,
)
from aeropend_ident.diagnosis.report import page as report_page
from aeropend_ident.diagnosis.results import document, verdict_lines
from aeropend_ident.testing.rigs import BENCH, recorded

ODD = (0.0, -0.0, 1e-300, -1e-9, 4e-4, 0.5, 0.999999, 1.0, 2.0, 63.0, -63.0, 1e6, -16875546.0, 1e14, -1e40, 1e300,
       math.inf, -math.inf, math.nan)
"""Numbers that a failed fit may give."""

SHORT = 700
"""Samples that are drawn: enough for every picture of the page."""

UNREADABLE = {
    "no number": re.compile(r"(?i)(?<![a-z])(?:nan|[+-−]?inf|none(?= %| s\b| rad))(?![a-z])"),
    "a share of more than 999 %": re.compile(r"(?<![\d.])\d{4,}(?:\.\d+)?\s?%"),
    "more than six digits in a row": re.compile(r"(?<![\d.,])\d{7,}"),
    "a power of ten beyond measurements": re.compile(
        "10⁻?(?:¹[⁶⁷⁸⁹]|[²³⁴⁵⁶⁷⁸⁹][⁰¹²³⁴⁵⁶⁷⁸⁹]|[⁰¹²³⁴⁵⁶⁷⁸⁹]{3})|e[+-](?:1[6-9]|[2-9][0-9]|[0-9]{3})"),
    "a quantity that is rounded to nothing": re.compile(r"(?<![\d.])0\.0+\s(?:s|rad|A|V|Ω|N|1/|kg)"),
}
"""What must not stand in a text."""


@cache
def short():
    """A diagnosis of which only the first samples are drawn."""
    found = diagnose(BENCH, [recorded(11, {"coulomb_friction": {}}, duration=16.0)])
    s = replace(found.signals[0].head(SHORT), train=SHORT // 2)
    cut = [[{c: x[:SHORT] for c, x in r.items()} for r in runs] for runs in (found.before, found.after)]
    return replace(found, signals=[s], before=cut[0], after=cut[1])


def full(diagnosis):
    """A document with a value in every field."""
    made = document(diagnosis, ["bag"], "bench", 2.5, [Across("test", 0.1, 0.05, 0.01, 0.5, 0.4, 0.6)])
    one = Interval(1.0, 0.5, 1.5)
    rows = [replace(c, share=one if k < 2 else None, since=one, until=one, evidence=1.0)
            for k, c in enumerate(made.which.candidates)]
    curves = (Curve("omega (share of the thrust)", "-", (1.0, 2.0, 3.0, 4.0), (0.1, 0.2, 0.1, 0.2)),
              Curve("theta", "rad/s²", (1.0, 2.0, 3.0, 4.0), (0.1, 0.2, 0.1, 0.2)))
    pair = ("coulomb_friction", rows[1].effect)
    numbers = {n: replace(r, run_to_run=0.1) for n, r in made.which.numbers.items()}
    return replace(
        made, which=replace(made.which, candidates=tuple(rows), numbers=numbers, not_separable=(pair,),
                            unknown=UnknownEffect("thrust", curves), unexplained=("theta is off",)),
        where=replace(made.where, regions=(Region("omega", 1.0, 2.0, 0.5, 0.2),)),
        closure=replace(made.closure, low=0.9, high=1.0, budget=GapBudget(0.5, 0.3, 0.2, "arm")),
        identified=Identified("the angle", ("k0",), Lift((0.0, 0.5), (0.0, 9.0), 0.1, 0.2),
                              HangingAngle(0.1, 0.0, 0.2, (one,), 0.1), {"thrust_lag.tau": one}))


def with_numbers(thing, values):
    """The same with every float replaced by the next of endless `values`; knots of curves stay."""
    if isinstance(thing, float):
        return next(values)
    if isinstance(thing, Curve):
        return replace(thing, value=with_numbers(thing.value, values))
    if isinstance(thing, Lift):
        free = ("rad_per_s2", "dead_zone", "lag_s")
        return replace(thing, **{n: with_numbers(getattr(thing, n), values) for n in free})
    if dataclasses.is_dataclass(thing):
        return replace(thing, **{f.name: with_numbers(getattr(thing, f.name), values)
                                 for f in dataclasses.fields(thing)})
    if isinstance(thing, dict):
        return {name: with_numbers(x, values) for name, x in thing.items()}
    return tuple(with_numbers(x, values) for x in thing) if isinstance(thing, tuple) else thing


def forever(values):
    while True:
        yield from values


def words(html):
    """What a person reads or hears on a page."""
    shown = re.sub(r"(?s)<(script|style)\b.*?</\1>", " ", html)
    labels = " ".join(re.findall(r'aria-label="([^"]*)"', shown))
    return re.sub(r"<[^>]*>", " ", shown.replace("<small>", " ")) + labels


def unreadable(text):
    """What cannot be read in a text, by its kind."""
    return {kind: found.group() for kind, pattern in UNREADABLE.items() if (found := pattern.search(text))}


@pytest.mark.promise("Verdict", "No impossible figure is shown, whatever a fit gave")
@settings(max_examples=12, deadline=None, phases=(Phase.generate,))
@given(values=st.lists(st.sampled_from(ODD) | st.floats(), min_size=1, max_size=12),
       verdict=st.sampled_from(["coulomb_friction", "none", "unknown", CANNOT_TELL]),
       factor=st.sampled_from([1.0, 1e6, 1e300, math.nan]))
def test_no_number_is_unreadable(values, verdict, factor):
    numbers = forever(values)
    made = with_numbers(full(short()), numbers)
    claimed = ("coulomb_friction",) if verdict == "coulomb_friction" else ()
    rows = tuple(replace(c, found=bool(claimed) and c.effect in claimed) for c in made.which.candidates)
    made = replace(made, which=replace(made.which, verdict=verdict, effects=claimed, candidates=rows))
    runs = [{c: x * factor for c, x in r.items()} for r in short().after]
    with np.errstate(all="ignore"):
        html = report_page.render(replace(short(), after=runs), made, "diagnose bag")
    assert not re.search(r'(?i)(?:d|x|y|width|height|style|points)="[^"]*(?:nan|inf\b)', html)
    assert unreadable(words(html)) == {}
    assert unreadable("\n".join(verdict_lines(made))) == {}


def test_unreadable_figures_are_seen():
    assert unreadable("share of the thrust −6300 %")
    assert unreadable("tau 0.00 s")
    assert unreadable("differs by 16875546 times")
    assert unreadable("gap nan %")
    assert unreadable("1.0 × 10³⁰⁰ rad")
    assert unreadable("lag of inf s")
    assert not unreadable("closes 97 % of the gap (95 % interval 95 % to 98 %), the last 21 s, 1.78 × 10⁻⁵ kg·m²")
