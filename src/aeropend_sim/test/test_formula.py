# SPDX-License-Identifier: Apache-2.0
"""Formulas: what is read, what is refused in one line, units, and values."""

import ctypes
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aeropend_sim.model.compiled_formula import compiled
from aeropend_sim.model.formula import FUNCTIONS, QUANTITIES, FormulaError, dimension, parse

KNOWN = [*QUANTITIES, "k", "at"]
UNITS = {**QUANTITIES, "k": "1/s", "at": "rad"}


def value(text, **known):
    """Value of a formula with the parameters k and at."""
    numbers = np.array([known.pop("k", 0.0), known.pop("at", 0.0)])
    given_ = [float(known.get(name, 0.0)) for name in [*QUANTITIES, "z"]]
    pointer = numbers.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
    parse(text, [*KNOWN, "z"])
    return compiled(text, ("k", "at"), "z").ctypes(*given_, pointer)


@pytest.mark.parametrize(("text", "known", "expected"), [
    ("-k * theta_dot * abs(theta_dot)", {"k": 2.0, "theta_dot": -3.0}, 18.0),
    ("k*(theta - at)**2 / 2 + 1", {"k": 4.0, "theta": 1.5, "at": 1.0}, 1.5),
    ("exp(-((theta - at) / 0.5)**2)", {"theta": 1.0, "at": 0.5}, math.exp(-1.0)),
    ("1 / 4 + 2 * pi", {}, 0.25 + 2 * math.pi),
    ("min(omega, 3) + max(i_a, v) + clip(t, 1, 2)", {"omega": 5.0, "i_a": 1.0, "v": 2.0, "t": 9.0}, 7.0),
    ("sign(theta) + 10*step(theta)", {"theta": 0.0}, 10.0),
    ("sign(theta) + 10*step(theta)", {"theta": -0.1}, -1.0),
    ("table(theta, 0, 1, 1, 3, 2, -1)", {"theta": 0.25}, 1.5),
    ("table(theta, 0, 1, 1, 3, 2, -1)", {"theta": -9.0}, 1.0),
    ("table(theta, 0, 1, 1, 3, 2, -1)", {"theta": 9.0}, -1.0),
    ("sqrt(k) * z - thrust", {"k": 9.0, "z": 2.0, "thrust": 1.0}, 5.0),
])
def test_a_formula_has_its_value(text, known, expected):
    assert value(text, **known) == pytest.approx(expected, rel=1e-12)


@given(st.sampled_from(sorted(FUNCTIONS)), st.lists(st.integers(-6, 6), min_size=7, max_size=7))
def test_a_compiled_function_gives_what_the_function_gives(name, whole):
    x = [0.5 * each for each in whole]
    if name in {"log", "sqrt"}:
        x[0] = abs(x[0]) + 0.5
    if name == "table":
        x[1::2] = sorted(x[1::2])
    own = x[:FUNCTIONS[name].arguments or 7]
    names = [*QUANTITIES][:len(own)]
    got = value(f"{name}({', '.join(names)})", **dict(zip(names, own, strict=True)))
    assert got == pytest.approx(FUNCTIONS[name].call(*own), rel=1e-15, abs=1e-300)


@pytest.mark.parametrize("text", ["1/(k - k)", "log(-1)", "sqrt(-1)", "9.0**9**9**9", "exp(exp(99))", "0/(k - k)"])
def test_what_has_no_value_raises_nothing(text):
    assert not math.isfinite(value(text))


@pytest.mark.parametrize(("text", "why"), [
    ("", "a formula is missing"), ("thet", "did you mean theta?"), ("sinn(theta)", "did you mean sin?"),
    ("theta^2", "write ** for a power"), ("sin(theta, 1)", "sin takes 1 argument, not 2"),
    ("table(theta, 1, 2)", "at least two points"), ("theta.real", "is not allowed"), ("[1][0]", "is not allowed"),
    ("(lambda: 1)()", "is not allowed"), ("__import__('os').system('true')", "is not allowed"),
    ("theta if k else at", "is not allowed"), ("theta < at", "is not allowed"), ("max(theta, *[k])", "is not allowed"),
    ("max(theta, b=k)", "is not allowed"), ("k := 3", "is no formula"), ("1; 2", "is no formula"),
    ("True", "is no number"), ("'a'", "is no number"), ("1e999", "is no number"), ("9" * 1000, "is no number"),
    ("1" + "+1" * 900, "operators, numbers and names"), ("(" * 900 + "1" + ")" * 900, "is no formula"),
    ("-" * 1900 + "1", "operators, numbers and names"), ("1" * 3000, "3000 characters"), ("_", "is not known here"),
    ("p_[0]", "is not allowed"), ("f_sin(k)", "there is no function f_sin"), ("k\0", "is no formula"),
])
def test_what_is_no_formula_is_refused_in_a_line(text, why):
    with pytest.raises(FormulaError) as caught:
        parse(text, KNOWN)
    assert why in str(caught.value)
    assert "\n" not in str(caught.value)


PIECES = st.sampled_from([*KNOWN, *FUNCTIONS, "+", "-", "*", "/", "**", "(", ")", ",", "1", "2.5", "1e9", " ", ".", "[",
                          "]", "'", '"', "lambda", "__class__", "\n", "{", "}", ":", "=", "@", "é", "²", "\\", "#"])


@given(st.lists(PIECES, max_size=25).map("".join) | st.text(max_size=40))
def test_any_text_is_a_formula_or_refused(text):
    try:
        parse(text, KNOWN)
    except FormulaError as error:
        message = str(error)
    else:
        assert isinstance(value(text), float)
        message = ""
    assert "\n" not in message


@pytest.mark.parametrize(("unit", "same"), [
    ("rad/s²", "1/s^2"), ("N·m·s²/rad²", "kg·m²"), ("1/A²s", "1/(A²·s)"), ("V·s/rad", "N·m/A"), ("Ω", "V/A"),
    ("H", "Ω·s"), ("-", "rad"), ("rad/s/s", "rad/s²"), ("W", "V·A"), ("Hz", "1/s"), ("F", "s/Ω"),
])
def test_units_that_are_the_same(unit, same):
    assert dimension(unit) == dimension(same)


@pytest.mark.parametrize(("text", "unit", "why"), [
    ("theta + omega", "rad", "cannot be added or compared"), ("sin(omega)", "-", "sin needs a pure number"),
    ("k * theta_dot", "N", "is needed"), ("3 * theta_dot", "rad/s²", "is needed"),
    ("k ** theta_dot", "-", "raise it to a number"), ("max(theta, v)", "rad", "cannot be added or compared"),
    ("table(theta, 0, k, omega, k)", "1/s", "cannot be added or compared"), ("exp(t)", "-", "exp needs a pure number"),
])
def test_a_formula_of_the_wrong_unit_is_refused(text, unit, why):
    with pytest.raises(FormulaError, match=why):
        parse(text, KNOWN).check_units(unit, UNITS)


@pytest.mark.parametrize(("text", "unit"), [
    ("-k * theta_dot", "rad/s²"), ("sqrt(k**2) * omega", "rad/s²"), ("(1 + 0.3*theta) * v", "V"), ("2.5", "N"),
    ("table(theta, 0, k, 1, 2)", "1/s"), ("sign(omega) * thrust", "N"), ("omega**2 * exp(-theta / at)", "1/s²"),
])
def test_a_formula_of_the_right_unit_passes(text, unit):
    parse(text, KNOWN).check_units(unit, UNITS)
