# SPDX-License-Identifier: Apache-2.0
"""Columns are recognised by names and numbers together, and what is in doubt is asked."""

from pathlib import Path

import numpy as np
import pytest
from arm_tables import DRIVEN, LONG, PUSH, RATE, driven

from aeropend_ident.tables.guess import Given, guess, options
from aeropend_ident.tables.names import meaning
from aeropend_ident.tables.sparkline import sparkline
from aeropend_ident.tables.table import Column, Table
from aeropend_ident.tables.traits import _origin, traits
from aeropend_ident.tables.units import split_name

RNG = np.random.default_rng(5)
NOISY = DRIVEN + 0.05 * RNG.standard_normal(len(DRIVEN))
FILTERED = np.convolve(NOISY, np.ones(9) / 9.0)[: len(NOISY)]
GOAL = np.repeat(RNG.uniform(5.0, 40.0, 6), 100)


def loop(seed=3):
    """Angle [deg] and command [%] of an arm in a loop that follows `GOAL`."""
    theta = speed = thrust = total = before = 0.0
    angle, command = [], []
    rng = np.random.default_rng(seed)
    for goal in GOAL:
        shown = np.degrees(theta)
        total = min(max(total + 2.0 * (goal - shown) / RATE, 0.0), 100.0)
        u = min(max(1.0 * (goal - shown) + total - 0.3 * RATE * (shown - before), 0.0), 100.0)
        before = shown
        angle.append(shown)
        command.append(u + 0.05 * rng.standard_normal() if 0.0 < u < 100.0 else u)
        for _ in range(20):
            thrust += (u / 100.0 - thrust) / 0.1 / RATE / 20.0
            speed += (36.0 * (thrust * thrust - np.sin(theta)) - 1.5 * speed) / RATE / 20.0
            theta += speed / RATE / 20.0
    return np.array(angle), np.array(command)


HELD, CONTROLLED = loop()


def found(given=None, **columns):
    """The guesses for a table, by the names of its columns, and the sure options."""
    table = Table(Path("run.csv"), tuple(Column(name, np.asarray(x, float), split_name(name)[1])
                                         for name, x in columns.items()), np.arange(len(LONG)))
    guesses = guess(table, given)
    return dict(zip(columns, guesses)), options(table, guesses)


@pytest.mark.promise("Tables", "`import` recognises columns by their numbers, too")
def test_columns_without_a_telling_name_are_recognised_by_their_numbers():
    _, sure = found(c1=LONG, c2=PUSH / 100.0, c3=NOISY)
    assert sure == {"time": "c1:s", "theta": "c3:deg", "duty": "c2:1"}
    _, sure = found(ch0=1e3 * LONG + 7.0, ch1=np.radians(DRIVEN), ch2=PUSH / 200.0)
    assert sure == {"time": "ch0:ms", "theta": "ch1:rad", "duty": "ch2:1"}


@pytest.mark.parametrize(("t", "y", "u", "r", "e"), [
    ("t", "y", "u", "r", "e"), ("Zeit", "Istwert", "Stellwert", "Sollwert", "Regelabweichung"),
    ("Tiempo", "ANGULO", "CONTROL", "REFERENCIA", "ERROR"), ("tempo", "saída", "entrada", "referência", "erro"),
    ("temps", "sortie", "commande", "consigne", "écart"), ("tempo", "uscita", "ingresso", "riferimento", "errore"),
    ("czas", "kąt", "sterowanie", "zadana", "uchyb"), ("zaman", "açı", "kontrol", "hedef", "hata"),
    ("time", "PV", "CO", "SP", "err"), ("time", "pitch", "U_PITCH", "pitch_ref", "pitch error"),
    ("t", "theta", "u(t)", "theta_d", "e_theta"), ("time", "output", "input", "setpoint", "error"),
])  # fmt: skip
def test_names_of_many_habits_in_a_loop(t, y, u, r, e):
    guesses, sure = found(**{t: LONG, y: HELD, u: CONTROLLED, r: GOAL, e: GOAL - HELD})
    assert sure["time"] == f"{t}:s"
    assert sure["theta"] == f"{y}:deg"
    assert sure["duty"] == f"{u}:%"
    assert guesses[e].quantity == ""
    assert "difference" in guesses[e].why


@pytest.mark.promise("Tables", "What `import` is not sure of is asked, and never used")
@pytest.mark.parametrize(("columns", "quantity", "why"), [
    ({"t": LONG, "angle": PUSH, "pwm": DRIVEN}, "theta", "does not move as an arm"),
    ({"t": LONG, "PITCH": DRIVEN, "E_PITCH": PUSH / 4.0}, "duty", "its name says error"),
    ({"t": LONG, "a": DRIVEN, "b": driven(PUSH[::-1])}, "theta", "or column"),
    ({"t [s]": 1e3 * LONG, "angle": DRIVEN}, "time", "20 apart?"),
    ({"t": LONG, "angle": np.rint(512.0 + DRIVEN * 2.84)}, "theta", "counts of a turn?"),
    ({"t": LONG, "angle": DRIVEN, "pwm": np.rint(9.0 * PUSH)}, "duty", "or of others?"),
    ({"t": LONG, "angle": DRIVEN, "v": PUSH / 10.0}, "duty", "of which supply?"),
    ({"t": LONG, "angle": DRIVEN, "u": PUSH - 10.0}, "duty", "it goes both ways, -10 to 70"),
    ({"t": LONG, "angle": DRIVEN, "u": np.rint(1054.0 + 8.0 * PUSH)}, "duty", "as pulses in µs?"),
    ({"time": np.arange(len(LONG)), "angle": DRIVEN, "u [%]": PUSH}, "time", "a counter of rows, or ms?"),
    ({"t": LONG, "angle [deg]": DRIVEN, "pwr": np.rint(PUSH * 100.0 / PUSH.max())}, "duty", "%, or counts of 255?"),
])  # fmt: skip
def test_what_is_in_doubt_is_not_sure(columns, quantity, why):
    guesses, sure = found(**columns)
    assert quantity not in sure
    assert [one.why for one in guesses.values() if one.quantity == quantity and why in one.why]


def test_a_reference_is_not_taken_for_a_command_that_is_not_there():
    _, sure = found(x1=LONG, x2=HELD, x3=GOAL)
    assert "duty" not in sure
    _, sure = found(x1=LONG, x2=HELD, x3=GOAL - HELD)
    assert "duty" not in sure


def test_a_loop_without_names_is_understood_by_its_error():
    _, sure = found(x1=LONG, x2=HELD, x3=CONTROLLED, x4=GOAL, x5=GOAL - HELD)
    assert sure == {"time": "x1:s", "theta": "x2:deg", "duty": "x3:%"}


def test_a_command_that_a_controller_makes_of_the_angle_is_not_left_out():
    guesses, sure = found(t=LONG, angle=HELD, control=80.0 - 1.5 * HELD)
    assert guesses["control"].quantity == "duty"
    assert "angle" not in sure.get("duty", "")


def test_a_motor_that_follows_its_command_is_not_the_command():
    speed, w = [], 0.0
    for u in PUSH / 100.0:
        w += (u - w) / 0.3 / RATE
        speed.append(w)
    noisy = np.array(speed) + 0.01 * RNG.standard_normal(len(LONG))
    _, sure = found(x1=LONG, x2=DRIVEN, x3=noisy, x4=PUSH / 100.0)
    assert sure["duty"] == "x4:1"


def test_a_name_of_a_motor_speed_says_nothing_where_no_propeller_turns_so_slowly():
    _, sure = found(zaman=LONG, angle=DRIVEN, giri=PUSH / 100.0)  # giriş, an input, without its last letter
    assert sure["duty"] == "giri:1"
    _, sure = found(zaman=LONG, angle=DRIVEN, giri=30.0 * PUSH)
    assert "duty" not in sure


def test_a_command_in_phase_with_a_sine_is_no_second_derivative_of_it():
    sine = 40.0 + 12.0 * np.sin(2.0 * np.pi * 0.4 * LONG)
    assert _origin(traits(60.0 + 1.5 * sine + 3.0 * np.sin(2.0 * np.pi * 2.0 * LONG)), traits(sine))[1] != "derivative"
    assert _origin(traits(np.gradient(sine, LONG)), traits(sine))[1] == "derivative"


def test_a_command_is_no_copy_of_the_motor_that_follows_it():
    speed = np.convolve(DRIVEN, np.exp(-0.2 * np.arange(30)) * 0.18)[: len(LONG)]
    guesses, sure = found(**{"Tiempo [s]": LONG, "pitch [deg]": driven(DRIVEN), "E_PITCH": DRIVEN / 10.0,
                             "motor [rpm]": 90.0 * speed})
    assert sure["omega"] == "motor [rpm]"
    assert "copy" not in guesses["E_PITCH"].why


def test_a_smoothed_angle_is_not_the_angle():
    smoothed, y = [], NOISY[0]
    for x in NOISY:
        y += 0.15 * (x - y)
        smoothed.append(y)
    guesses, sure = found(x1=LONG, x2=np.array(smoothed), x3=NOISY, x4=PUSH / 100.0)
    assert guesses["x2"].why.startswith("a filtered copy of column")
    assert sure["theta"] == "x3:deg"


def test_a_temperature_and_a_switch_are_no_commands():
    warm, on = np.round(24.0 + 0.02 * LONG, 1), (LONG > 2.0).astype(float)
    _, sure = found(x1=LONG, x2=DRIVEN, x3=warm, x4=on, x5=PUSH / 100.0)
    assert sure["duty"] == "x5:1"


def test_milliseconds_that_do_not_begin_at_zero_are_no_counter_of_rows():
    _, sure = found(x1=512401.0 + np.arange(len(LONG)), x2=DRIVEN, x3=PUSH / 100.0)
    assert sure["time"] == "x1:ms"


def test_columns_that_follow_from_others_are_said_to():
    guesses, sure = found(t=LONG, x=DRIVEN, x_=FILTERED, z=np.gradient(DRIVEN, LONG), turned=np.radians(DRIVEN),
                          u=PUSH / 100.0)
    assert guesses["x_"].why.startswith("a late copy of column")
    assert guesses["z"].why.startswith("a derivative of column")
    assert "the same as column" in guesses["turned"].why
    assert sure == {"time": "t:s", "theta": "x:deg", "duty": "u:1"}


def test_what_the_user_says_makes_volts_and_both_ways_sure():
    volts = {"t": LONG, "angle": DRIVEN, "u [V]": PUSH / 10.0 - 1.0}
    assert "duty" not in found(**volts)[1]
    assert "duty" not in found(Given(supply=True), **volts)[1]
    assert found(Given(supply=True, both_ways=True), **volts)[1]["duty"] == "u [V]"


def test_the_scales_do_not_matter_for_what_a_column_is():
    one, other = traits(DRIVEN), traits(1e6 + 1e-3 * DRIVEN)
    assert (one.block, one.holds, one.rough, one.noisy) == (other.block, other.holds, other.rough, other.noisy)


@pytest.mark.parametrize("odd", [1e300, -1.7e308, 5e-324])
def test_numbers_that_can_be_no_reading_change_no_guess(odd):
    rows = np.arange(len(LONG)) % 97 == 50
    columns = {"t": LONG, "angle": np.where(rows, odd, DRIVEN), "pwm": np.where(rows, odd, PUSH)}
    with np.errstate(all="raise"):
        assert [g.quantity for g in found(**columns)[0].values()] == ["time", "theta", "duty"]


@pytest.mark.parametrize(("name", "quantity"), [
    ("theta_ref", "reference"), ("Winkelgeschwindigkeit", "angle rate"), ("θ", "theta"), ("pwmOut", "duty"),
    ("kąt", "theta"), ("Führungsgröße", "reference"), ("angle_filt", "filtered"), ("battery", "supply"),
    ("y(t)", "theta"), ("u_t", "duty"), ("k*Ts", "time"), ("ch3", ""), ("motor current", "current"),
    ("ScopeData.posici_n.values", "theta"), ("s_re", "time"), ("V_p", "voltage"),
])  # fmt: skip
def test_meanings_of_names(name, quantity):
    assert meaning(name).quantity == quantity


@pytest.mark.parametrize(("name", "unit", "quantity"), [
    ("E_PITCH", "V", "voltage"), ("U_PITCH", "V", "duty"), ("VBUS", "V", "supply"), ("e", "deg", "error"),
    ("motor", "rpm", "omega"),
])  # fmt: skip
def test_a_unit_decides_between_meanings_of_a_name(name, unit, quantity):
    assert meaning(name, unit).quantity == quantity


def test_a_small_picture_of_a_column():
    assert sparkline(np.repeat([0.0, 1.0], 12)) == "▁" * 12 + "█" * 12
    assert sparkline(np.repeat([0.0, 1.0], 12), "ascii") == "_" * 12 + "#" * 12
    assert sparkline(np.repeat([np.nan, 1.0], 12)) == " " * 12 + "▁" * 12
    assert sparkline(np.full(9, np.nan)) == ""
