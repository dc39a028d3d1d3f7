# SPDX-License-Identifier: Apache-2.0
"""Numbers as page and terminal write them."""

import math

import pytest

from aeropend_ident.diagnosis.report import number_format


@pytest.mark.parametrize(("value", "unit", "text"), [
    (0.032041, "rad", "0.0320 rad"), (3.0501, "rad/s", "3.05 rad/s"), (1.7823e-5, "kg·m²", "1.78 × 10⁻⁵ kg·m²"),
    (-12345.6, "", "−12300"), (0.0, "A", "0 A"), (1e-20, "s", "0 s"), (1e40, "s", "–"),
    (2.0, "-", "2.00"), (None, "A", "–"), (math.nan, "A", "–"),
])
def test_quantities(value, unit, text):
    assert number_format.quantity(value, unit).replace("\N{NO-BREAK SPACE}", " ") == text


@pytest.mark.parametrize(("numbers", "texts"), [
    ((0.79937, 0.79810, 0.80065), ("0.7994", "0.7981 to 0.8006")),
    ((1.7823e-5, 1.6815e-5, 1.8831e-5), ("1.78 × 10⁻⁵", "1.68 to 1.88 × 10⁻⁵")),
    ((45142.4, 42099.0, 48186.0), ("45100", "42100 to 48200")),
    ((0.0, -0.0286, 0.0286), ("0", "−0.029 to 0.029")),
    ((0.004, -1.5, 1.5), ("0.004", "−1.5 to 1.5")),
    ((2.0, 2.0, 2.0), ("2.000", "2.000 to 2.000")),
    ((0.0004, 0.0, 0.31), ("< 0.31", "0 to 0.31")),
    ((1e-9, 0.0, 2e6), ("< 2.0 × 10⁶", "0 to 2.0 × 10⁶")),
    ((1.0, -1e300, 1e300), ("1.00", "– to –")),
    ((1.0, math.nan, math.inf), ("1.00", "– to –")),
])
def test_intervals(numbers, texts):
    assert tuple(t.replace("\N{NO-BREAK SPACE}", " ") for t in number_format.interval(*numbers)) == texts


@pytest.mark.parametrize(("share", "text"), [
    (1.0, "100 %"), (0.9996, "> 99.9 %"), (0.994, "99.4 %"), (0.636, "64 %"), (0.0712, "7.1 %"), (0.0004, "< 0.1 %"),
    (0.0, "0 %"), (-0.0003, "0 %"), (-0.2, "−20 %"), (None, "–"),
    (-63.0, "< −999 %"), (1e9, "> 999 %"), (math.inf, "> 999 %"), (math.nan, "–"),
])
def test_percents(share, text):
    assert number_format.percent(share).replace("\N{NO-BREAK SPACE}", " ") == text


@pytest.mark.parametrize(("value", "digits", "text"), [
    (0.79937, 4, "0.7994"), (1.23e-7, 4, "1.23e-07"), (110.4, 2, "110"), (3.2e9, 2, "3.2e+09"), (2.5e-16, 2, "0"),
    (-0.0, 4, "0"), (None, 4, "?"), (math.nan, 4, "?"), (1e300, 4, "?"),
])
def test_numbers_of_a_terminal(value, digits, text):
    assert number_format.plain(value, digits) == text


@pytest.mark.parametrize(("share", "decimals", "text"), [
    (0.876, 0, "88"), (0.1251, 1, "12.5"), (-0.001, 0, "0"), (-63.0, 0, "<-999"), (1e9, 1, ">999"), (None, 0, "?"),
])
def test_percents_of_a_terminal(share, decimals, text):
    assert number_format.plain_percent(share, decimals) == text


def test_no_probability_is_certain():
    assert number_format.probability(1.0).startswith(">")
    assert number_format.probability(0.0).startswith("<")
