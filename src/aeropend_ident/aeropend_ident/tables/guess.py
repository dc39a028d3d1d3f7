# SPDX-License-Identifier: Apache-2.0
"""Guesses of the meaning of the columns, by their names in many languages, their units and their numbers.

A guess is a proposal to the user. It is used only if the user asks for it.
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass

import numpy as np

from aeropend_ident.tables.table import Column, Floats, Table
from aeropend_ident.tables.units import CLOCK, UNITS, known, split_name

WORDS: dict[str, str] = {
    "reference": "reference ref setpoint sp soll sollwert sollwinkel target consigna consigne consegna desired "
                 "referencia riferimento borve zadana уставка задание 目标 设定",
    "time": "t time zeit zeitpunkt zeitstempel uhrzeit tiempo temps tempo tid tijd czas cas aika ido vreme zaman "
            "timestamp stamp millis micros hora heure seconds sec sekunden segundos secondes время 时间 時間 시간",
    "theta": "theta th θ ϑ angle ang angulo angolo winkel vinkel hoek kat uhel kut aci pitch position pos posicion "
             "posizione lage phi φ alpha α arm arma pendel pendulo pendulum угол 角度 각도",
    "duty": "duty pwm throttle tastgrad tastverhaltnis stellgrosse stellgroesse ciclo gas gaz control cmd command "
            "comando commande kommando esc stellwert steuer скважность шим 占空比",
    "omega": "omega ω w rpm drehzahl rotor velocidad vitesse velocita giri umdrehungen otacky hastighet varvtal "
             "toerental obroty speed обороты скорость 转速 回転数",
    "current": "current i strom motorstrom corriente courant corrente stroom prad proud amp amps strøm ток 电流 電流 "
               "전류",
    "voltage": "voltage v spannung motorspannung voltaje tension tensione tensao spanning spenning napiecie napeti "
               "volt напряжение 电压 電圧 전압",
}
"""Quantity -> words for it, in lower case without accents. The first quantity with a word in the name counts."""

OF_UNIT = ("time", "theta", "omega", "current", "voltage", "duty")
"""Quantities that can be identified by the unit alone, in order of preference if several have the unit."""

FEWEST = 20
"""Least number of rows for a rising column without a name to be the time (choice)."""

_SPLIT = re.compile(r"[^\w°]+|_|(?<=[a-zäöüа-я])(?=\d)|(?<=[a-z])(?=[A-Z])")


@dataclass(frozen=True)
class Guess:
    """A guess of the meaning of a column.

    Attributes:
        quantity: the quantity; "" if there is no guess.
        unit: the unit for the option; "" if the file has it.
        why: the reason, in words.
        sure: whether quantity and unit are unambiguous.
    """

    quantity: str = ""
    unit: str = ""
    why: str = ""
    sure: bool = False


def guess(table: Table) -> list[Guess]:
    """A guess for each column of a table."""
    found = [_of_column(column) for column in table.columns]
    if not any(one.quantity == "time" for one in found):
        found = _unnamed_time(table, found)
    nameless = [k for k, one in enumerate(found) if not one.quantity and not table.columns[k].is_text]
    if not any(one.quantity == "theta" for one in found) and any(one.quantity == "time" for one in found) and len(
            nameless) == 1 and not any(column.name for column in table.columns):
        k = nameless[0]
        unit, why, sure_ = _unit_of_angle(table.columns[k].values)
        found[k] = Guess("theta", unit, f"the only other column; {why}", sure_)
    for quantity in UNITS:
        same = [k for k, one in enumerate(found) if one.quantity == quantity]
        sure = [k for k in same if found[k].sure] or same
        if quantity == "time" and _agree(table, found, sure):
            sure = sure[:1]
        for k in same:
            if k not in sure:
                found[k] = Guess(why=f"{quantity}? Column {table.label(sure[0])} rather")
            elif len(sure) > 1:
                found[k] = Guess(quantity, found[k].unit, f"one of {len(sure)} such columns")
    return found


def _agree(table: Table, found: list[Guess], columns: list[int]) -> bool:
    """Whether columns of time are equal in different units."""
    sizes = [UNITS["time"].get(found[k].unit or table.columns[k].unit or CLOCK, 0.0) for k in columns]
    times = [size * table.columns[k].values for k, size in zip(columns, sizes)]
    return len(columns) > 1 and all(bool(np.isclose(one, times[0], atol=1e-6, equal_nan=True).all()) for one in times)


def options(table: Table, found: list[Guess]) -> dict[str, str]:
    """Options for the columns whose quantity and unit are unambiguous: quantity -> "COLUMN:UNIT".

    Args:
        table: the table.
        found: a guess for each column.
    """
    out = {one.quantity: option(table, k, one) for k, one in enumerate(found) if one.quantity and one.sure}
    return {quantity: out[quantity] for quantity in UNITS if quantity in out}


def option(table: Table, k: int, one: Guess) -> str:
    """A guess as an option of the command line: "COLUMN:UNIT".

    Args:
        table: the table.
        k: number of the column, from 0.
        one: the guess.
    """
    name = table.columns[k].name
    if not name or [column.name for column in table.columns].count(name) > 1:
        name = f"{k + 1}"
    if one.unit:
        return f"{name}:{one.unit}"
    has_unit = table.columns[k].is_clock or known(one.quantity, table.columns[k].unit)
    return name if has_unit else f"{name}:UNIT"


def is_obvious(chosen: dict[str, str], found: list[Guess]) -> bool:
    """Whether time and angle are found and no other guess is uncertain.

    Args:
        chosen: options by quantity.
        found: a guess for each column.
    """
    return {"time", "theta"} <= chosen.keys() and not any(one.quantity and not one.sure for one in found)


def _words(text: str) -> set[str]:
    plain = unicodedata.normalize("NFKD", text)
    plain = "".join(letter for letter in plain if not unicodedata.combining(letter)).replace("ß", "ss")
    return {word.casefold() for word in _SPLIT.split(plain) if word}


def _of_column(column: Column) -> Guess:
    if column.is_text:
        return Guess(why=f"text: {column.complaint.split(': ', 2)[-1]}")
    if not np.isfinite(column.values).any():
        return Guess(why="no numbers")
    if column.is_clock:
        return Guess("time", "", "times of day", sure=True)
    unit = column.unit
    words = _words(split_name(column.name)[0] if unit and split_name(column.name)[0] != unit else column.name)
    named = next((quantity for quantity, known_ in WORDS.items() if words & set(known_.split())), "")
    by_unit = [quantity for quantity in OF_UNIT if unit and known(quantity, unit)]
    if named == "reference" and unit and known("reference", unit):
        return Guess(named, "", f"its name, in {unit}", sure=True)
    if named in by_unit:
        return Guess(named, "", f"its name, in {unit}", sure=True)
    if by_unit and unit not in ("1", "-") and (not named or named != "reference"):
        # name and unit contradict each other (a speed in degrees): the unit decides, but the guess is not sure
        return Guess(by_unit[0], "", f"its unit, {unit}", sure=not named)
    if not named:
        return Guess()
    unit, why, sure = _unit_of(named, column.values, words)
    return Guess(named, unit, f"its name; {why}" if why else "its name", sure)


def _unit_of(quantity: str, values: Floats, words: set[str]) -> tuple[str, str, bool]:
    """Unit of a column by its numbers: the unit, the reason, and whether it is unambiguous."""
    x = values[np.isfinite(values)]
    whole = bool((x == np.rint(x)).all())
    if quantity == "time":
        step = float(np.median(np.abs(np.diff(x)))) if len(x) > 1 else 1.0
        step = step or float(np.mean(np.abs(np.diff(x))))
        if whole and step >= 500.0:
            return "us", f"whole numbers, {step:g} apart", True
        if whole and step >= 1.0 and (np.ptp(x) > 1000.0 or "ms" in words or "millis" in words):
            return "ms", f"whole numbers, {step:g} apart", True
        return ("s", f"{step:.3g} apart", True) if step < 1.0 else ("", "its unit is not clear", False)
    if quantity in ("theta", "reference"):
        return _unit_of_angle(values)
    top = float(np.abs(x).max())
    if quantity == "duty":
        low = float(x.min())
        if low >= 0.0 and top <= 1.0:
            return "1", f"up to {top:g}", True
        if whole and low >= 900.0 and top <= 2100.0:
            return "counts:1000..2000", f"{low:g} to {top:g}, as pulses in µs", True
        if low >= 0.0 and top <= 100.0:
            return "%", f"up to {top:g}", True
        counts = next((n for n in (255, 1023, 4095, 65535) if top <= n), None)
        return (f"counts:{counts}", f"whole numbers up to {top:g}", False) if whole and counts and low >= 0.0 else (
            "", "its unit is not clear", False)
    if quantity == "omega":
        return ("rpm", "its name", True) if words & {"rpm", "drehzahl", "giri", "obroty", "обороты", "转速"} else (
            "", "rad/s or rpm?", False)
    small, large = ("A", "mA") if quantity == "current" else ("V", "mV")
    limit = 40.0 if quantity == "current" else 100.0
    return (small, f"up to {top:.3g}", True) if top < limit else (large, f"up to {top:.3g}", top > 10.0 * limit)


def _unit_of_angle(values: Floats) -> tuple[str, str, bool]:
    x = values[np.isfinite(values)]
    low, high = float(x.min()), float(x.max())
    if high - low > 720.0:
        return "", f"{low:.4g} to {high:.4g}: counts of what?", False
    if high - low > 7.0:
        return "deg", f"{low:.4g} to {high:.4g}", True
    return "rad", f"{low:.4g} to {high:.4g}: rad or deg?", False


def _unnamed_time(table: Table, found: list[Guess]) -> list[Guess]:
    """Take the only column without a name that never decreases as the time."""
    rising = []
    for k, (column, one) in enumerate(zip(table.columns, found)):
        x = column.values[np.isfinite(column.values)]
        if not one.quantity and not column.is_text and not column.name and len(x) >= FEWEST:
            steps = np.diff(x)
            if (steps >= 0.0).all() and steps.max() < 0.3 * np.ptp(x) and np.ptp(x) > 0.0:
                rising.append(k)
    if len(rising) == 1:
        k = rising[0]
        unit, why, sure = _unit_of("time", table.columns[k].values, set())
        found = [*found]
        found[k] = Guess("time", unit, f"it only rises; {why}", sure)
    return found
