# SPDX-License-Identifier: Apache-2.0
"""Conversion of the columns of a table to the samples of a rig, by the plan of the user."""

from __future__ import annotations

import math
import re
import unicodedata
from dataclasses import dataclass

import numpy as np

from aeropend_ident.bags import judging
from aeropend_ident.tables import clock
from aeropend_ident.tables.clock import ClockError, Dated
from aeropend_ident.tables.table import Column, Floats, Ints, Table, TableError
from aeropend_ident.tables.units import CLOCK, TURN, UNITS, Unit, UnitError, known, listed, parse
from aeropend_sim.wording import counted

CHANNELS = {"theta": "theta", "omega": "omega", "current": "i_a", "voltage": "v_a", "duty": "duty"}
"""Quantity (name of the option) -> channel of a recording."""

SHOWN_IN = {"theta": ("deg", 180.0 / math.pi), "omega": ("rad/s", 1.0), "current": ("A", 1.0), "voltage": ("V", 1.0),
            "duty": ("%", 100.0), "reference": ("deg", 180.0 / math.pi)}
"""Unit and factor for the ranges in messages."""

CLIPPED = 0.005
"""Amount by which a duty may be outside 0..1; it is clipped (choice)."""

REST = 1.0
"""[s] Time at the start or the end in which the arm must be at rest, for `zero` (choice)."""

STILL = math.radians(3.0)
"""[rad] Greatest range of the angle of an arm at rest (choice)."""

SLOW, FAST = 10.0, 2e4
"""[Hz] Rates below and above which a note warns that the recording is slow, or that the unit of the time may be wrong
(choices)."""

FAR = 2.0 * TURN
"""[rad] Angle from hanging above which a note warns that unit or zero may be wrong (choice)."""

LATEST = float(2**31)
"""[s] Greatest stamp: builtin_interfaces/Time has 32 bits with sign."""

_ZERO = re.compile(r"^([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*([^\d\s].*)?$")


@dataclass(frozen=True)
class Plan:
    """The user's plan for the columns of a table. A column is given as "COLUMN" or "COLUMN:UNIT".

    Attributes:
        time: column of the time.
        theta: column of the arm's angle.
        duty: column of the duty.
        omega: column of the rotor's speed.
        current: column of the motor's current.
        voltage: column of the motor's voltage.
        reference: column of the reference.
        rate: [Hz] rate of the rows, without a column of the time.
        zero: the reading of the hanging arm: "-83", "-83deg", "start" or "end".
        flip: the reading decreases when the arm is lifted.
        motor_off: the duty is always 0.
        clock: one of `clock.CLOCKS`.
        skip_bad: skip rows that cannot be read.
        supply: the voltage of the supply, "12V", for a duty in volts.
        both_ways: what a duty below 0 does: "reverse" the motor; "brake" it, or "clip": set it to 0; "" refuses it.
    """

    time: str | None = None
    theta: str | None = None
    duty: str | None = None
    omega: str | None = None
    current: str | None = None
    voltage: str | None = None
    reference: str | None = None
    rate: float | None = None
    zero: str | None = None
    flip: bool = False
    motor_off: bool = False
    clock: str = "auto"
    skip_bad: bool = False
    supply: str | None = None
    both_ways: str = ""

    def columns(self) -> dict[str, str]:
        """Quantity -> the column that is given for it."""
        return {name: said for name in UNITS if (said := getattr(self, name)) is not None}


@dataclass(frozen=True, eq=False)
class Samples:
    """The samples of a rig, on their stamps.

    Attributes:
        stamp_ns: [ns] (N,) times of sampling, rising.
        channels: (N,) each [SI], those measured of theta, omega, i_a, v_a, duty; NaN if a reading is missing.
        reference: [rad or rad/s] (N,), or None.
        rows: number of samples that are rows of the table.
        period: [s] between samples.
        mapping: the column of each quantity, one line each.
        notes: warnings and repairs, one line each.
        left_out: the unused columns.
    """

    stamp_ns: Ints
    channels: dict[str, Floats]
    reference: Floats | None
    rows: int
    period: float
    mapping: tuple[str, ...]
    notes: tuple[str, ...]
    left_out: tuple[str, ...]


def samples(table: Table, plan: Plan) -> Samples:
    """Convert a table to the samples of a rig.

    Args:
        table: the table.
        plan: the user's plan for its columns.

    Raises:
        TableError: the conversion is not possible; one line with the reason.
    """
    if plan.time is None and plan.rate is None:
        raise TableError(no_time(table))
    chosen = {name: _chosen(table, name, said, plan) for name, said in plan.columns().items()}
    if plan.supply is not None and " of " not in chosen.get("duty", (0, Unit("", 1.0)))[1].text:
        raise TableError(f"{table.path}: --supply is for a command in volts: add --duty COLUMN:V, or leave it away")
    twice = [name for name, (k, _) in chosen.items() if [j for j, _ in chosen.values()].count(k) > 1]
    if twice:
        raise TableError(f"{table.path}: column {table.label(chosen[twice[0]][0])} is given as "
                         f"{' and as '.join(twice)}: give one of them another column, or leave it away")
    notes = list(table.notes)
    keep = _readable_rows(table, [k for k, _ in chosen.values()], plan, notes)
    columns = [table.columns[k] for k, _ in chosen.values()]
    for (k, _), column in zip(chosen.values(), columns):
        if not np.isfinite(column.values[keep]).any():
            raise TableError(f"{table.path}: column {table.label(k)} holds no number: give another column")
    dated = _date(table, plan, chosen, keep)
    notes += dated.notes
    values = {name: _placed(dated, keep, table.columns[k].values) for name, (k, _) in chosen.items()}
    for name in values.keys() - {"time"}:
        missing = int(np.isnan(values[name][dated.rows >= 0]).sum())
        if missing:
            notes.append(f"{name}: {counted(missing, 'row')} without a reading")
    channels: dict[str, Floats] = {}
    offset = sign = 0.0
    if "theta" in chosen:
        channels["theta"], offset, sign = _angle(table, chosen["theta"], values["theta"], dated, plan, notes)
    for name in ("omega", "current", "voltage"):
        if name in chosen:
            channels[CHANNELS[name]] = _readings(CHANNELS[name], chosen[name][1], values[name], notes)
    if "duty" in chosen:
        channels["duty"] = _duty(table, chosen["duty"], values["duty"], plan, notes)
    elif plan.motor_off:
        channels["duty"] = np.zeros(len(dated.time))
    measured = [channels[name] for name in channels.keys() - {"duty"}]
    if not measured:
        raise TableError(f"{table.path}: nothing measured is named: give --theta at least")
    if not np.isfinite(measured).any():
        raise TableError(f"{table.path}: no reading is left: {notes[-1]}")
    reference = None
    if "reference" in chosen:
        unit = chosen["reference"][1]
        reference = _readings("reference", unit, values["reference"], notes)
        if not unit.is_speed and sign:
            reference = sign * (reference - offset)
    first = float(dated.time[0])
    if not abs(first) + float(np.ptp(dated.time)) < LATEST:
        raise TableError(f"{table.path}: its time reaches {dated.time[-1]:.4g} s: is the unit of the time right?")
    notes += _doubts(table, chosen, channels, dated)
    if first < 0.0:
        notes.append(f"time begins at {first:g} s: shifted to begin at 0")
    start = max(round(first * 1e9), 0)
    stamps = start + np.rint((dated.time - first) * 1e9).astype(np.int64)
    if not (np.diff(stamps) > 0).all():
        raise TableError(f"{table.path}: its time spans {float(np.ptp(dated.time)):.3g} s over "
                         f"{counted(len(stamps), 'row')}, less than 1 ns from row to row: is the unit of the time "
                         "right?")
    used = {k for k, _ in chosen.values()}
    return Samples(
        stamp_ns=stamps, channels=channels, reference=reference, rows=dated.measured, period=dated.period,
        mapping=tuple(_described(table, plan, chosen, channels, reference)), notes=tuple(notes),
        left_out=tuple(table.label(k) for k in range(len(table.columns)) if k not in used),
    )


def _doubts(table: Table, chosen: dict[str, tuple[int, Unit]], channels: dict[str, Floats], dated: Dated) -> list[str]:
    """Warnings of probable mistakes of the user, one line each."""
    notes = []
    rate = 1.0 / float(np.median(np.diff(dated.time[dated.rows >= 0])))
    if rate > FAST:
        notes.append(f"{rate:.4g} rows a second: is the unit of the time right?")
    if rate < SLOW:
        notes.append(f"{rate:.3g} rows a second are few: with less than {SLOW:g} little of the dynamics shows")
    if "theta" in channels and np.nanmax(np.abs(channels["theta"]), initial=0.0) > FAR:
        notes.append("theta goes round more than twice: are its unit and its zero right?")
    for name, (k, unit) in chosen.items():
        own = table.columns[k].unit
        theirs = known(name, own) if own else None
        if theirs is not None and unit.size != UNITS[name][theirs]:
            notes.append(f"{name}: you say {unit.text}, the file says {own}")
    return notes


def no_time(table: Table) -> str:
    """Message on a table without a time."""
    return (f"{table.path}: no time: give --time COLUMN, or --rate HZ for evenly spaced rows; a table of steady states "
            f"({counted(len(table), 'row')}) is no recording, but bench_test takes it")


def find(table: Table, text: str) -> list[tuple[int, str]]:
    """Columns that an option may mean; longer names are tried first.

    Args:
        table: the table.
        text: "COLUMN" or "COLUMN:UNIT".

    Returns:
        Number of each column, from 0, and the unit.
    """
    places = [len(text), *(k for k in range(len(text) - 1, 0, -1) if text[k] == ":")]
    for k in places:
        name, unit = text[:k].strip(), text[k + 1 :].strip()
        named = [(n, column) for n, column in enumerate(table.columns) if column.name]
        for found in ([n for n, column in named if column.name == name],
                      [n for n, column in named if _plain(column.name) == _plain(name)],
                      [n for n, column in named if column.unit and _plain(_bare(column)) == _plain(name)]):
            if found:
                return [(n, unit) for n in found]
        if name.isdecimal() and 1 <= int(name) <= len(table.columns):
            return [(int(name) - 1, unit)]
    return []


def _bare(column: Column) -> str:
    """The name of a column without its unit."""
    end = re.sub(r"\s*[\[(<{/_]?\s*" + re.escape(column.unit) + r"\s*[\])>}]?\s*$", "", column.name)
    return end or column.name


def _plain(text: str) -> str:
    """The text in lower case, without accents and repeated blanks."""
    letters = unicodedata.normalize("NFKD", " ".join(text.casefold().split()))
    return "".join(letter for letter in letters if not unicodedata.combining(letter))


def _chosen(table: Table, quantity: str, text: str, plan: Plan) -> tuple[int, Unit]:
    found = find(table, text)
    option = f"--{quantity} '{text}'"
    if not found:
        there = ", ".join(table.label(k) for k in range(len(table.columns)))
        raise TableError(f"{table.path}: {option}: there is no such column; its columns are {there}")
    if len(found) > 1:
        there = " and ".join(table.label(k) for k, _ in found)
        raise TableError(f"{table.path}: {option} may be column {there}: give its number")
    k, said = found[0]
    column = table.columns[k]
    if column.is_clock != (quantity == "time" and said in ("", CLOCK) and column.is_clock):
        raise TableError(f"{table.path}: {option}: column {table.label(k)} holds times of day"
                         + (": leave the unit away" if quantity == "time" else ", not numbers"))
    if said == CLOCK and not column.is_clock:
        raise TableError(f"{table.path}: {option}: column {table.label(k)} holds no times of day ({column.shown[:1]})")
    if column.is_clock:
        return k, Unit(CLOCK, 1.0)
    if quantity == "duty" and (volts := _volts(said or column.unit)):
        if plan.supply is None:
            raise TableError(f"{table.path}: {option}: a command in volts needs the voltage of the supply, which is "
                             "full duty: add --supply 12V")
        return k, Unit(f"{volts.text} of {plan.supply}", volts.size / _supply(plan.supply))
    if not said:
        unit = known(quantity, column.unit) if column.unit else None
        if unit is None:
            raise TableError(f"{table.path}: {option}: say the unit of column {table.label(k)}, as in "
                             f"--{quantity} '{text}:{next(iter(UNITS[quantity]))}'; known: {listed(quantity)}")
        return k, parse(quantity, unit)
    try:
        return k, parse(quantity, said)
    except UnitError as error:
        raise TableError(f"{table.path}: {option}: {error}") from None


def _volts(text: str) -> Unit | None:
    """A unit of a voltage; None for another."""
    try:
        return parse("voltage", text)
    except UnitError:
        return None


def _supply(text: str) -> float:
    """[V] The voltage of the supply, from "12V" or "12"."""
    unit = _volts(text) or _volts(f"{text}V")
    if unit is None or not 0.0 < unit.size < math.inf:
        raise TableError(f"--supply '{text}': give its voltage, as in --supply 12V")
    return unit.size


def _readable_rows(table: Table, used: list[int], plan: Plan, notes: list[str]) -> Ints:
    """The rows that can be read in all used columns."""
    complaints = [(int(table.bad[0]), table.complaint)] if len(table.bad) else []
    columns = [table.columns[k] for k in used]
    complaints += [(int(column.bad[0]), column.complaint) for column in columns if len(column.bad)]
    if not complaints:
        return np.arange(len(table))
    text = any(column.is_text for column in columns)
    if not plan.skip_bad or text:
        raise TableError(min(complaints)[1] + "; correct it, or give --skip-bad to leave such rows out" * (not text))
    bad = np.unique(np.concatenate([table.bad, *(table.columns[k].bad for k in used)]))
    notes.append(f"{counted(len(bad), 'row')} that cannot be read left out, first: "
                 f"{min(complaints)[1].removeprefix(f'{table.path}: ')}")
    return np.setdiff1d(np.arange(len(table)), bad)


def _date(table: Table, plan: Plan, chosen: dict[str, tuple[int, Unit]], keep: Ints) -> Dated:
    if len(keep) < 3:
        raise TableError(f"{table.path}: {counted(len(keep), 'row')}: too few for a recording, which needs 3 or "
                         "more")
    if plan.time is None:
        assert plan.rate is not None
        full = clock.at_rate(len(table), plan.rate)
        return Dated(full.time[keep], np.arange(len(keep)), full.period, ())
    number, unit = chosen["time"]
    angle = table.columns[chosen["theta"][0]].values[keep] if "theta" in chosen else np.full(len(keep), np.nan)
    column = table.columns[number]
    stamps = column.values[keep]
    if unit.size == UNITS["time"]["day"]:  # since a day long ago, as in MATLAB and Excel
        stamps = stamps - np.floor(np.nanmin(stamps))
    try:
        return clock.date(unit.size * stamps, angle, table.lines[keep], is_clock=column.is_clock,
                          tick=unit.size, repeats=_repeats(table)[keep], clock=plan.clock,
                          lengths=None if table.lengths is None else table.lengths[keep])
    except ClockError as error:
        raise TableError(f"{table.path}: {error}") from None


def _repeats(table: Table) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Whether each row is equal to the row before."""
    same = np.ones(len(table), dtype=bool)
    same[:1] = False
    for column in table.columns:
        v = column.values
        same[1:] &= (v[1:] == v[:-1]) | (np.isnan(v[1:]) & np.isnan(v[:-1]))
    return same


def _placed(dated: Dated, keep: Ints, values: Floats) -> Floats:
    """Values of the samples; NaN for a sample without a row."""
    return np.where(dated.rows >= 0, values[keep][dated.rows], np.nan)


def _readings(channel: str, unit: Unit, raw: Floats, notes: list[str]) -> Floats:
    """[SI] (N,) Readings of a channel; NaN where a number can be none."""
    with np.errstate(over="ignore"):
        return judging.channel(channel, unit.size * raw, notes)


def _angle(table: Table, chosen: tuple[int, Unit], raw: Floats, dated: Dated, plan: Plan, notes: list[str]
           ) -> tuple[Floats, float, float]:
    """The angle from hanging [rad], the offset of the readings [rad], and their sign."""
    unit = chosen[1]
    read = _readings("theta", unit, raw, notes)
    known_ = np.flatnonzero(np.isfinite(read))
    steps = np.diff(read[known_])
    wrapped = int((np.abs(steps) > 0.6 * TURN).sum())
    unwrap = wrapped > 0 and float(np.ptp(read[known_])) < 1.02 * TURN
    if unwrap:
        read[known_] = np.unwrap(read[known_])
        notes.append(f"theta passes the end of its turn {counted(wrapped, 'time')}: counted on")
    offset = 0.0 if plan.zero is None else _zero(table, plan.zero, unit, read, dated)
    sign = -1.0 if plan.flip else 1.0
    theta = sign * (read - offset)
    if unwrap:
        turns = round(float(np.median(theta[known_])) / TURN) * TURN
        theta, offset = theta - turns, offset + sign * turns
    return theta, offset, sign


def _zero(table: Table, text: str, unit: Unit, read: Floats, dated: Dated) -> float:
    """[rad] The reading of the hanging arm."""
    if text in ("start", "end"):
        near = dated.time <= dated.time[0] + REST if text == "start" else dated.time >= dated.time[-1] - REST
        part = read[near & np.isfinite(read)]
        if not len(part):
            which = "first" if text == "start" else "last"
            raise TableError(f"{table.path}: --zero {text}: there is no angle in the {which} {REST:g} s: give what is "
                             "read when it hangs")
        moved = float(np.ptp(np.percentile(part, (2, 98))))
        if moved > STILL:
            which = "first" if text == "start" else "last"
            raise TableError(f"{table.path}: --zero {text}: the arm moves by {math.degrees(moved):.1f} deg in the "
                             f"{which} {REST:g} s, in which it should rest: give what is read when it hangs")
        return float(np.median(part))
    match = _ZERO.match(text.strip())
    if match is None:
        raise TableError(f"{table.path}: --zero '{text}': give a reading, as in --zero -83deg, or start or end where "
                         "the arm hangs at rest there")
    number, own = float(match.group(1)), match.group(2)
    if own is None:
        return unit.size * number
    try:
        return parse("theta", own).size * number
    except UnitError as error:
        raise TableError(f"{table.path}: --zero '{text}': {error}") from None


def _duty(table: Table, chosen: tuple[int, Unit], raw: Floats, plan: Plan, notes: list[str]) -> Floats:
    unit = chosen[1]
    duty = unit.size * (raw - unit.low)
    backward = int((duty < -CLIPPED).sum())
    down = f"duty: {counted(backward, 'row')} of {len(duty)} below 0, down to {100.0 * float(np.nanmin(duty)):.3g} %"
    least = 0.0
    if plan.both_ways == "reverse" and backward:
        notes.append(f"{down}: they reverse the motor (as you say)")
        least = -1.0
    elif plan.both_ways and backward:
        notes.append(f"{down}, set to 0 (as you say)" + ": the motor brakes" * (plan.both_ways == "brake"))
        duty = np.maximum(duty, 0.0)
    low, high = float(np.nanmin(duty)), float(np.nanmax(duty))
    if low < least - CLIPPED or high > 1.0 + CLIPPED:
        worst = float(np.nanmin(raw)) if low < least - CLIPPED else float(np.nanmax(raw))
        turned = -1.0 - CLIPPED <= low < least - CLIPPED and high <= 1.0 + CLIPPED
        why = (f"does it reverse the motor in {counted(backward, 'row')} of {len(duty)} (--both-ways reverse), brake "
               "it (brake), or do nothing (clip)?") if turned else "is its unit right?"
        raise TableError(f"{table.path}: column {table.label(chosen[0])} as a duty in {unit.text} goes to {worst:g}, "
                         f"outside {100.0 * least:g}..100 %: {why}")
    outside = int(((duty < least) | (duty > 1.0)).sum())
    if outside:
        notes.append(f"duty: {counted(outside, 'row')} outside {100.0 * least:g}..100 % by less than "
                     f"{100.0 * CLIPPED:g} %: clipped")
    return np.clip(duty, least, 1.0)


def _described(table: Table, plan: Plan, chosen: dict[str, tuple[int, Unit]], channels: dict[str, Floats],
          reference: Floats | None) -> list[str]:
    """The column of each quantity with its range, one line each."""
    lines = []
    if plan.time is None:
        lines.append(f"time: {plan.rate:g} rows a second, as you say")
    for name, (k, unit) in chosen.items():
        said = plan.columns()[name]
        as_file = "" if find(table, said)[0][1] else ", as the file says"
        kind = ", times of day" if unit.text == CLOCK else f" in {unit.text}{as_file}"
        line = f"{name}: column {table.label(k)}{kind}"
        if name == "theta":
            line += f", hanging at {plan.zero}" * (plan.zero is not None) + ", flipped" * plan.flip
        values = reference if name == "reference" else channels.get(CHANNELS.get(name, ""))
        if values is not None and np.isfinite(values).any():
            shown, size = ("rad/s", 1.0) if unit.is_speed else SHOWN_IN[name]
            line += f"; {size * np.nanmin(values):.4g} to {size * np.nanmax(values):.4g} {shown}"
        lines.append(line)
    if plan.motor_off:
        lines.append("duty: 0 all the time, as you say")
    return lines
