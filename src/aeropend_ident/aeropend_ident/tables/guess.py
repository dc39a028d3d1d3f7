# SPDX-License-Identifier: Apache-2.0
"""Guesses of the meaning of the columns, from their names, their units and their numbers.

The evidence is added up as log odds (naive Bayes): what a name says, and what the numbers say. Angle and command are
looked for together, because the angle follows the command. A guess is sure if the next best one is far behind and name
and numbers do not contradict each other. Only what is sure is used without asking.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np

from aeropend_ident.tables import scales
from aeropend_ident.tables.computed import FOLLOWS, explain
from aeropend_ident.tables.names import STRONG, WEAK, Meaning
from aeropend_ident.tables.seen import Seen, look_at, says
from aeropend_ident.tables.table import Column, Floats, Table
from aeropend_ident.tables.traits import Traits, gain, tracks
from aeropend_ident.tables.units import CLOCK, RPM, UNITS, known

SURE = 2.5
"""[nats] Least distance of a sure guess from the next (choice: 12 to 1)."""

SURE_UNNAMED = 3.0
"""[nats] Likewise of an angle where no name says what angle and command are (choice: 20 to 1)."""

MOST = 14
"""Greatest number of columns whose relations are examined (choice: all pairs are)."""

FILLED = 0.1
"""Least share of cells with a number, for a column and not notes beside a table (choice: a log of changes has more)."""

MUCH, SOME, LITTLE = 1.0, 0.5, 0.2
"""[nats] Edges of the classes of `gain` (choices)."""

BACK = 0.8
"""Least ratio of the gains backward and forward for a column that rather follows the angle (choice)."""

ANGLE = {"jumps and holds": -4.7, "noisy": -2.3, "rough": -0.4, "smooth": 0.9}
COMMAND = {"jumps and holds": 1.4, "noisy": -1.5, "rough": -0.1, "smooth": -0.4}
ONE_WAY = -1.5
"""[nats] Log odds of a command that jumps and holds, and goes one way only (choice: a step test does, 1 in 4)."""

PAIR = {"much": 0.7, "much back": -0.9, "some": 0.0, "some back": -1.4, "little": -1.4, "little back": -2.2,
        "none": -3.3, "none back": -3.1}
CHAIN = {"followed": -2.6, "followed a little": -1.0, "alone": -4.4, "last": 1.4}
BEHIND = {"behind": -1.5, "first": 0.3}
"""[nats] Log odds of what is seen in the angle, in the command, in both, and in the chain of columns that predict each
other, of which the angle is the last and the command the first (measured: `make habits ARGS=--weights`)."""

AGAINST = -3.5
"""[nats] Log odds of the numbers below which they contradict the name (choice: 33 to 1)."""

MOVED = -3.0
"""[nats] Log odds of no command where a column predicts the angle and does not follow from it (measured with free
swings: fewer than one column in 100)."""

COMMANDED = math.log(0.85 / 0.15)
"""[nats] Log odds that a table holds a command (choice: most arms are driven)."""

OF_THE_ARM = ("angle rate", "acceleration", "filtered")
"""Quantities that predict the angle because they are its motion."""

SAID = {"jumps and holds": "it jumps and holds", "noisy": "it is noisy", "rough": "", "smooth": "it moves smoothly"}


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


@dataclass(frozen=True)
class Given:
    """What the user says that no file contains.

    Attributes:
        supply: the voltage of the supply, so that a command in volts can be used.
        both_ways: what a command below 0 does.
    """

    supply: bool = False
    both_ways: bool = False


def guess(table: Table, given: Given | None = None) -> list[Guess]:
    """A guess for each column of a table.

    Args:
        table: the table.
        given: what the user says.
    """
    return _guess(table, given or Given())[0]


def log_odds(table: Table) -> float:
    """[nats] How well the best guess of time, angle and command explains the names and the numbers."""
    return _guess(table, Given())[1]


def _guess(table: Table, given: Given) -> tuple[list[Guess], float]:
    """A guess for each column, and the log odds of time, angle and command together."""
    table = table.possible()
    seen = look_at(table)
    found = [_nothing(one) for one in seen]
    clock, odds = _clock(table, seen, found)
    odds += _arm(table, seen, found, clock, given)
    for k, one in enumerate(seen):
        if not found[k].quantity and not found[k].why:
            found[k] = _rest(one, seen, found)
    return found, odds


def _nothing(one: Seen) -> Guess:
    column, named = one.column, one.meaning
    if one.traits.constant and _is_named(one, "theta") and np.isfinite(column.values).sum() > 2:
        return Guess(why=f"its name says the angle, but it is {np.nanmax(column.values):.6g} all the time: constant")
    if column.is_text:
        needed = named.quantity in ("time", "theta", "duty") and named.odds >= STRONG
        return Guess(named.quantity if needed else "", why=f"text: {column.complaint.split(': ', 2)[-1]}")
    share = float(np.isfinite(column.values).mean()) if len(column.values) else 0.0
    return Guess(why="no numbers" if share == 0.0 else "hardly any numbers" if share < FILLED else "")


# The clock


def time_of(table: Table) -> tuple[int, float | None] | None:
    """The column of the time, and the size of its unit [s], None if that is not clear; None without a time."""
    table = table.possible()
    seen = look_at(table)
    found = [_nothing(one) for one in seen]
    k, _ = _clock(table, seen, found)
    if k is None:
        return None
    column = table.columns[k]
    unit = CLOCK if column.is_clock else found[k].unit or _unit(column, "time")
    return k, UNITS["time"][unit] if unit and found[k].sure else None


def _clock(table: Table, seen: list[Seen], found: list[Guess]) -> tuple[int | None, float]:
    """Find the time; returns its column and its log odds [nats]."""
    odds = {k: _clock_odds(one) for k, one in enumerate(seen) if not found[k].why}
    best = max(odds, key=lambda k: (odds[k], len(np.unique(table.columns[k].values)), -k), default=None)
    if best is None or odds[best] < WEAK:
        return None, 0.0
    one = seen[best]
    others = [k for k in odds if k != best and odds[k] >= WEAK]
    unit, why, sure = ("", "times of day", True) if one.column.is_clock else scales.of_time(
        one.column.values, _unit(one.column, "time"), list(one.words))
    if one.meaning.quantity == "time":
        why = f"its name, {why}" if why.startswith("in ") else f"its name; {why}"
    elif not one.column.is_clock:
        why = f"it rises evenly, {why}"
    if sure and not one.column.is_clock and not one.traits.ramp:
        why, sure = f"{why}; but it does not rise evenly", _rises(one.column.values)
        why = why if not sure else why.split(";")[0]
    for k in others:
        if _agree(one.column, unit, seen[k].column):
            found[k] = Guess(why=f"time too, as column {table.label(best)}")
        elif odds[k] > odds[best] - SURE:
            why, sure = f"{why}; or column {table.label(k)}?", False
    found[best] = Guess("time", unit, why, sure)
    for k, other in enumerate(seen):
        if k != best and not found[k].why and other.traits.ramp:
            found[k] = Guess(why="it rises evenly, as a counter of rows")
    return best, odds[best]


def _clock_odds(one: Seen) -> float:
    if one.column.is_clock:
        return 2.0 * STRONG
    if one.traits.constant:
        return -STRONG
    odds = STRONG if one.traits.ramp else 0.0 if _rises(one.column.values) else -2.0 * STRONG
    if one.meaning.quantity == "time":
        odds += one.meaning.odds
    elif one.meaning.quantity == "index":
        odds -= WEAK
    elif one.meaning.quantity:
        odds -= one.meaning.odds
    if one.column.unit:
        odds += STRONG if known("time", one.column.unit) else -STRONG
    return odds


def _rises(x: Floats) -> bool:
    """Whether numbers never decrease, but for few restarts."""
    steps = np.diff(x[np.isfinite(x)])
    return bool(len(steps) and (steps > 0.0).mean() > 0.02 and (steps < 0.0).mean() <= 0.02)


def _agree(one: Column, unit: str, other: Column) -> bool:
    """Whether two clocks run alike: the one is the other in another unit."""
    both = np.isfinite(one.values) & np.isfinite(other.values)
    x, y = one.values[both], other.values[both]
    if len(x) < 3 or np.ptp(x) == 0.0 or np.ptp(y) == 0.0:
        return False
    size = UNITS["time"].get(unit or known("time", one.unit) or CLOCK, 1.0)
    theirs = UNITS["time"].get(known("time", other.unit) or "", 0.0) or (1.0 if other.is_clock else 0.0)
    line = np.polyfit(x, y, 1)
    straight = float(np.std(y - np.polyval(line, x))) <= 1e-3 * float(np.std(y))
    return straight and (not theirs or abs(line[0] * theirs / size - 1.0) < 0.01)


# The arm


def about_angle(x: Traits) -> str:
    """What is seen in a column that may be the angle or the command: a key of `ANGLE` and `COMMAND`."""
    return "jumps and holds" if x.holds else "noisy" if x.noisy else "rough" if x.rough else "smooth"


def about_pair(forth: float, back: float) -> str:
    """What is seen in an angle and its command: a key of `PAIR`.

    Args:
        forth: gain of the angle by the command.
        back: gain of the command by the angle.
    """
    how = "much" if forth >= MUCH else "some" if forth >= SOME else "little" if forth >= LITTLE else "none"
    return how + " back" * (back > BACK * forth)


def about_chain(others: list[tuple[float, float]], elsewhere: float = 0.0) -> str:
    """What is seen in the angle and all other columns: a key of `CHAIN`.

    Args:
        others: gains of each other column by the angle, and of the angle by it.
        elsewhere: greatest gain of another column by any column but the angle.
    """
    followed = max((theirs for theirs, own in others if own < 0.5 * theirs), default=0.0)
    if followed >= SOME:
        return "followed" if followed >= MUCH else "followed a little"
    alone = max((own for _, own in others), default=0.0) < LITTLE
    return "alone" if alone and elsewhere >= MUCH else "last"


def about_command(others: list[tuple[float, float]]) -> str:
    """What is seen in the command and all other columns but the angle: a key of `BEHIND`.

    Args:
        others: gains of the command by each other column, and of it by the command.
    """
    return "behind" if any(own >= SOME and theirs < 0.5 * own for own, theirs in others) else "first"


def _arm(table: Table, seen: list[Seen], found: list[Guess], clock: int | None, given: Given) -> float:
    """Find angle and command together; returns their log odds [nats]."""
    free = [k for k, one in enumerate(seen) if not found[k].quantity and not found[k].why and not one.traits.constant]
    free = sorted(sorted(free, key=lambda k: -abs(seen[k].meaning.odds))[:MOST])
    every = max(len(table) // 2000, 1)
    numbers = {k: np.nan_to_num(table.columns[k].values[::every]) for k in free}
    explained = explain(table, seen, numbers)
    follows, loops = explained.odds, explained.loops
    for k, why in explained.why.items():
        found[k] = Guess(why=why)
    named = {k: (says(seen[k], "theta"), says(seen[k], "duty")) for k in free}
    still = any(one.traits.constant and _is_named(one, "theta") for one in seen)
    other = {k for k in free if _is_no_angle(seen[k]) or (still and not _is_named(seen[k], "theta"))}
    angle = {k: ANGLE[about_angle(seen[k].traits)] + follows.get(k, 0.0) for k in free}
    command = {k: COMMAND[about_angle(seen[k].traits)] + ONE_WAY * seen[k].traits.one_way + follows.get(k, 0.0)
               for k in free}
    gains = {(a, b): gain(seen[a].traits, seen[b].traits) for a in free for b in free if a != b}
    for k in free:
        rest = [j for j in free if j != k and j not in follows]
        angle[k] += CHAIN[about_chain([(gains[j, k], gains[k, j]) for j in rest],
                                      max((gains[j, i] for j in rest for i in rest if i != j), default=0.0))]
    in_units = {k for k in free if known("theta", table.columns[k].unit)}
    for k in free if in_units else ():
        angle[k] -= WEAK * (not table.columns[k].unit) + STRONG * (k in in_units and not _angle_scale(seen[k])[2])
    for k in free if len(loops) == 1 else ():  # reference, angle and error: the command is another one
        if k in loops[0]:
            command[k] += FOLLOWS
        else:
            angle[k] += FOLLOWS
    for k in other:
        angle[k] = -math.inf
    prior = COMMANDED - math.log(max(len(free) - 1, 1))
    tracked = {(k, j) for k, j in gains
               if named[j][1] <= 0.0
               and tracks(table.columns[k].values, table.columns[j].values, seen[k].traits.block)}
    both: dict[tuple[int, int | None], float] = {}
    for k in free:
        moved = any(gains[k, j] >= SOME and j not in follows and (k, j) not in tracked
                    and seen[j].meaning.quantity not in OF_THE_ARM for j in free if j != k)
        both[k, None] = angle[k] + named[k][0] + MOVED * (moved or bool(loops))
    likely = {k: angle[k] + named[k][0] for k in free}
    for k, j in gains:
        pair = PAIR[about_pair(gains[k, j], gains[j, k])]
        behind = BEHIND[about_command([(gains[j, i], gains[i, j]) for i in free if i not in (j, k, *follows)])]
        both[k, j] = (angle[k] + named[k][0] + command[j] + named[j][1] + pair + behind + prior
                      + FOLLOWS * any(goal == j and likely[i] >= likely[k] for i, goal in tracked))
    if not both:
        return 0.0
    a, b = max(both, key=lambda pair: both[pair])
    if both[a, b] == -math.inf or (both[a, b] < 0.0 and clock is None):
        return 0.0
    same = {k for k in free if found[k].why.startswith("the same as")}
    rivals = {pair: odds for pair, odds in both.items() if not same & set(pair) - {a, b}}
    first, second = _contradictions(seen, found, angle, named, a, b)
    unnamed = named[a][0] <= 0.0 and (b is None or named[b][1] <= 0.0)
    least = both[a, b] - (SURE_UNNAMED if unnamed else SURE)
    rival = _rival(least, {pair[0]: odds for pair, odds in sorted(rivals.items(), key=lambda one: one[1])
                                if pair[0] != a})
    if rival is None and named[a][0] <= 0.0:  # the angle is a late copy of its reference, if the loop is good
        rival = next((k for k, of in explained.late.items() if of == a), None)
    doubt = first or ("" if rival is None else f"or column {table.label(rival)}?")
    unit, scale, clear = _angle_scale(seen[a])
    found[a] = Guess("theta", unit, _reason(seen[a], "theta", scale, doubt), clear and not doubt)
    others = {pair[1]: odds for pair, odds in rivals.items() if pair[0] == a and pair[1] != b}
    if b is None:
        others = {k: odds for k, odds in others.items() if k is not None and (
            (gains[a, k] >= LITTLE and named[k][1] > -STRONG and k not in follows) or named[k][1] > 0.0)}
        rival = _rival(least, others)
        movers = [k for k in free if k != a and gains[a, k] >= LITTLE and k not in follows and (a, k) not in tracked
                  and named[k][1] >= (0.0 if gains[a, k] < SOME else -WEAK)]
        if rival is None and movers:
            rival = max(movers, key=lambda k: both[a, k])
        if rival is None:
            _constant_command(seen, found)
        else:
            unit, scale, _ = _command_scale(seen[rival], seen[a], given)
            found[rival] = Guess("duty", unit, f"perhaps; {scale}", False)
        return both[a, b]
    if named[b][1] >= WEAK:  # its owner calls it a command, and others something else
        others = {k: odds for k, odds in others.items() if k is not None and named[k][1] >= 0.0}
    if gains[a, b] < LITTLE:
        second = second or f"but column {table.label(a)} does not follow it"
    rival = _rival(both[a, b] - SURE, others, none=-1)
    doubt = second or ("" if rival is None else "or no command?" if rival < 0 else f"or column {table.label(rival)}?")
    unit, scale, clear = _command_scale(seen[b], seen[a], given)
    how = "" if gains[a, b] < SOME else f"column {table.label(a)} follows it"
    volts = bool(_unit(seen[b].column, "voltage")) or seen[b].meaning == Meaning("voltage", STRONG)
    if volts and not given.supply and not doubt and np.nanmin(seen[b].column.values) >= 0.0:
        found[b] = Guess("voltage", unit, _reason(seen[b], "voltage", how, "the input, in V"), True)
        return both[a, b]
    found[b] = Guess("duty", unit, _reason(seen[b], "duty", how, scale, doubt), clear and not doubt)
    return both[a, b]


def _rival(least: float, others: dict[Any, float], none: int | None = None) -> int | None:
    """The column that may be meant as well, with log odds above `least`; `none` stands for no column."""
    if not others:
        return None
    k = max(others, key=lambda key: others[key])
    return (none if k is None else k) if others[k] > least else None


def _contradictions(seen: list[Seen], found: list[Guess], angle: dict[int, float],
                    named: dict[int, tuple[float, float]], a: int, b: int | None) -> tuple[str, str]:
    """Where names and numbers contradict each other, of angle and command; "" if they do not."""
    first = second = ""
    if named[a][0] < 0.0 or seen[a].meaning.quantity not in ("", "theta"):
        first = f"but its name says {seen[a].meaning.quantity or seen[a].column.unit}"
    elif angle[a] < AGAINST:
        first = "but it does not move as an arm"
    else:
        first = _also(seen, found, named, a, "theta")
    if b is not None and named[b][1] < 0.0:
        second = f"but its name says {seen[b].meaning.quantity or seen[b].column.unit}"
    elif b is not None:
        second = _also(seen, found, named, b, "duty")
    return first, second


def _is_named(one: Seen, quantity: str) -> bool:
    """Whether the name of a column says a quantity."""
    return one.meaning == Meaning(quantity, STRONG)


def _is_no_angle(one: Seen) -> bool:
    """Whether the unit of a column is that of a speed or a current, and of no angle."""
    return bool(_unit(one.column, "omega") or _unit(one.column, "current")) and not _unit(one.column, "theta")


def _also(seen: list[Seen], found: list[Guess], columns: Collection[int], chosen: int, quantity: str) -> str:
    """Whether another column has the name of a quantity too, and is not computed from others."""
    for k in columns:
        if k != chosen and seen[k].meaning == Meaning(quantity, STRONG) and not found[k].why:
            return f"but the name of column {k + 1} says {quantity}" + " too" * (
                seen[chosen].meaning == Meaning(quantity, STRONG))
    return ""


def _reason(one: Seen, quantity: str, *more: str) -> str:
    name = "its name" if one.meaning.quantity == quantity else ""
    unit = f"its unit, {one.column.unit}" if not name and known(quantity, one.column.unit) else ""
    said = SAID[about_angle(one.traits)]
    if quantity == "theta" and said != SAID["smooth"]:
        said = ""
    if quantity != "theta" and not one.traits.holds:
        said = ""
    return "; ".join(x for x in (name or unit, said, *more) if x)


def _unit(column: Column, quantity: str) -> str:
    return known(quantity, column.unit) or "" if column.unit else ""


def _angle_scale(one: Seen) -> scales.Scale:
    said = _unit(one.column, "theta")
    named = not {"enc", "encoder", "pot", "adc", "potentiometer", "sensor", "raw", "counts"} & set(one.words)
    unit, why, sure = scales.of_angle(one.column.values, counts=one.counts,
                                      named=named and one.meaning.quantity == "theta")
    if said:
        span = UNITS["theta"][said] * float(np.ptp(one.column.values[np.isfinite(one.column.values)]))
        possible = 0.01 < span < 4.0 * math.pi
        return "", f"in {said}" if possible else f"in {said}, {why.partition(':')[0]}: did the arm go round?", possible
    return unit, why, sure


def _is_voltage(one: Seen) -> bool:
    return one.meaning.quantity == "voltage" or bool(_unit(one.column, "voltage"))


def _command_scale(one: Seen, angle: Seen, given: Given) -> scales.Scale:
    x = one.column.values[np.isfinite(one.column.values)]
    low, top = float(x.min()), float(x.max())
    said = _unit(one.column, "duty")
    if _is_voltage(one):
        unit, why, sure = "" if _unit(one.column, "voltage") else "V", "in V", given.supply
        why += "" if sure else f", {low:.4g} to {top:.4g}: of which supply? add --supply 12V"
    elif said:
        unit, why, sure = "", f"in {said}", 0.02 < UNITS["duty"][said] * top <= 1.005
        why += "" if sure else f", {low:.4g} to {top:.4g}?"
    else:
        unit, why, sure = scales.of_command(np.abs(x) if low < 0.0 else x, list(one.words), counts=one.counts,
                                           units=bool(angle.column.unit))
    if low < 0.0 and -low > 0.005 * top:
        why += f"; it goes both ways, {low:.4g} to {top:.4g}" + (
            ": add --both-ways reverse, brake or clip; if its least value is the motor off, shift it in the file first"
            ) * (not given.both_ways)
        sure = sure and given.both_ways
    return unit, why, sure


def _constant_command(seen: list[Seen], found: list[Guess]) -> None:
    """A command that never changes, as in a free swing."""
    for k, one in enumerate(seen):
        if one.traits.constant and not found[k].why and one.meaning == Meaning("duty", STRONG):
            zero = not np.nan_to_num(one.column.values).any()
            found[k] = Guess("duty", "" if _unit(one.column, "duty") else "1", "its name; always 0" if zero else
                             "its name; it never changes", zero)
            return


# The other columns


def _rest(one: Seen, seen: list[Seen], found: list[Guess]) -> Guess:
    """A guess for a column that is neither time nor angle nor command."""
    if one.traits.constant:
        return Guess(why="it never changes")
    quantity, unit = one.meaning.quantity, one.column.unit
    if quantity not in ("reference", "omega", "current", "voltage") or one.meaning.odds < STRONG:
        by_unit = next((q for q in ("omega", "current") if unit and known(q, unit)), "")
        speed = by_unit == "omega" and UNITS["omega"][known("omega", unit) or ""] == RPM
        if not by_unit or (quantity in ("angle rate", "filtered", "error") and not speed):
            return Guess(why=f"{quantity}, by its name" if quantity and quantity not in UNITS else "")
        return Guess(by_unit, "", f"its unit, {unit}", speed or not quantity)
    if any(other.quantity == quantity for other in found):
        return Guess(why=f"{quantity}? one is there already")
    if unit and known(quantity, unit):
        return Guess(quantity, "", f"its name, in {unit}", sure=True)
    if quantity == "reference":
        return _reference(one, seen, found)
    if quantity == "omega":
        rpm = bool({"rpm", "drehzahl", "giri", "obroty", "обороты", "转速"} & set(one.words))
        return Guess(quantity, "rpm" if rpm else "", "its name" if rpm else "its name; rad/s or rpm?", rpm)
    scale, why, sure = scales.of_electric(quantity, one.column.values)
    return Guess(quantity, scale, f"its name; {why}", sure)


def _reference(one: Seen, seen: list[Seen], found: list[Guess]) -> Guess:
    """A reference has the unit of the angle if it is near it."""
    for other, its in zip(seen, found):
        if its.quantity == "theta":
            x, y = one.column.values, other.column.values
            near = abs(np.nanmedian(x) - np.nanmedian(y)) <= np.nanmax(y) - np.nanmin(y)
            unit = its.unit or _unit(other.column, "theta")
            if near and unit:
                return Guess("reference", unit, "its name; in the unit of the angle, which it is near", its.sure)
    return Guess("reference", "", "its name; in which unit?", False)


# Options


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
    unit = table.columns[k].unit
    has_unit = table.columns[k].is_clock or known(one.quantity, unit) or (
        one.quantity == "duty" and known("voltage", unit))
    return name if has_unit else f"{name}:UNIT"


def is_obvious(chosen: dict[str, str], found: list[Guess]) -> bool:
    """Whether time and angle are found, and the command is certain, if there is one.

    Args:
        chosen: options by quantity.
        found: a guess for each column.
    """
    needed = ("time", "theta", "duty")
    return {"time", "theta"} <= chosen.keys() and not any(one.quantity in needed and not one.sure for one in found)
