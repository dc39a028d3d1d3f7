# SPDX-License-Identifier: Apache-2.0
"""Likely mistakes of units, signs, zero and columns in a recording, by physics: what gravity, lift and the motor allow.

The model is simulated with the duty of the recording. A reading in another unit follows its simulation at the ratio of
the units, one with the wrong sign goes against it, and that of another column follows the simulation of that one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from aeropend_ident.bags.mending import mend
from aeropend_ident.signals.signals import STILL
from aeropend_sim.model.actuator import voltage
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import Model
from aeropend_sim.model.rig import record

Array = NDArray[np.float64]

TURNS = 4.0 * math.pi
"""[rad] Range of an angle from which it is not in rad (choice: an aeropendulum makes no two turns)."""

RARE = (1.0, 99.0)
"""Percentiles between which readings are for their range (choice: single false readings do not count)."""

ABSURD = 100.0
"""Ratio of the range of speed, current or voltage to the simulated one from which no result can be right (choice)."""

JUMPS = "faster than any arm turns"
"""What is said of an angle that jumps."""

FASTEST = 100.0
"""[rad/s] Speed that no arm reaches (choice: 16 turns a second)."""

SINGLE = 7
"""Readings of which the middle one is taken, so that single false ones are no jumps (choice)."""

OFF_ZERO = 0.25
"""[rad] Zero of the angle, beside the simulated one, from which it is said (choice: a smaller one is an effect)."""

ZERO = CATALOGUE["angle_offset"].parameters["bias"].high
"""[rad] Zero of the angle beyond which no effect is looked for (derived: the range of `angle_offset`)."""

FOLLOWS = 0.8
"""Least correlation of a reading with its simulation to compare their sizes.

Measured: of 60 healthy rigs of the blind check the least is 0.99, of 60 with an effect one has less than 0.8, with many
false speeds. No mistake is seen in any of the 120; of 12 mistakes made in each healthy one none is missed; that duty
and current are exchanged is missed in 4 of 60."""

CLOSE = 1.5
"""Ratio by which a unit may miss the ratio of reading and simulation (choice: a model may be as wrong)."""

OPPOSITE = 3.0
"""Likewise of a reading with the wrong sign, whose size matters less (choice)."""

FITS, BETTER = 0.5, 2.0
"""Error of a reading beside the simulation of another column, in standard deviations of it, at which it may be that
column, and the ratio by which it must be below the error beside its own (choice)."""

EXCHANGED = 10.0
"""Ratio of what the duty does not explain of the voltage to what it does not explain of the current above which the two
are exchanged.

Derived: the bridge makes the voltage from the duty; the current depends on the speed too. Measured: of 120 rigs of the
blind check the largest is 0.3, of a long delay."""

RISES = 0.3
"""Least correlation of a current with the duty; that of a supply, which sags, is below 0 (choice).

Measured: of 120 rigs of the blind check the least is 0.83."""

DRIVEN = 0.2
"""Share of the voltage, or speed, of full duty by which they vary only if the duty does (choice: no supply sags so)."""

RUN_UP = 3.0
"""[s] Time after the first sample in which a rotor may still run up or down (choice: that of a large rotor)."""

STEADY = 0.2
"""Range of the voltage of a supply, over its median (choice: no supply sags more; that of a motor begins at 0)."""

LATE = {"v_a": 0.1, "omega": 0.3}
"""[s] Least time by which a reading is ahead of its simulation where the duty is late, by channel (choice: a rotor of
another inertia is ahead too; a voltage never is).

Measured: of 72 rigs, healthy ones and one of each effect and seed, none is called late."""

LATE_MOST = 2.0
"""[s] Greatest time that is tried (choice)."""

LATE_STEP = 0.01
"""[s] Step of the times that are tried (choice)."""

LATE_LEFT = 0.1
"""Share of the variance that may be left at the best time (choice)."""

LATE_BETTER = 4.0
"""Ratio by which what is left at the best time must be below that without a shift (choice)."""

LEAST = 100
"""Readings with which a channel is compared (choice)."""


@dataclass(frozen=True)
class Unit:
    """A unit that somebody may have sent instead of that of docs/interfaces.md.

    Attributes:
        name: as `import` knows it.
        ratio: its number for 1 of the right unit.
        sure: whether no rig with the right unit reads as much; else it is sure if the angle fits the model, which the
            speed makes.
    """

    name: str
    ratio: float
    sure: bool = True


UNITS = {
    "theta": (Unit("deg", 180.0 / math.pi), Unit("turn", 1.0 / math.tau)),
    "omega": (Unit("rpm", 60.0 / math.tau, sure=False), Unit("turn/s", 1.0 / math.tau, sure=False),
              Unit("deg/s", 180.0 / math.pi, sure=False)),
    "i_a": (Unit("mA", 1e3),),
    "v_a": (Unit("mV", 1e3),),
}
TURN_COUNTS = (256, 360, 400, 512, 1000, 1024, 2000, 2048, 2400, 3600, 4000, 4096, 8192, 10000, 16384)
"""Counts of a turn of common encoders and converters (choice)."""
OWN = {"theta": "rad", "omega": "rad/s", "i_a": "A", "v_a": "V"}
NAMES = {"theta": "angle", "omega": "speed", "i_a": "current", "v_a": "voltage"}
OPTIONS = {"theta": "theta", "omega": "omega", "i_a": "current", "v_a": "voltage"}
"""Channel -> option of `import`."""


@dataclass(frozen=True)
class Mistake:
    """A likely mistake.

    Attributes:
        what: what it looks like.
        sure: whether no verdict can be right.
        options: those of `import` that mend it; none if nothing does.
    """

    what: str
    sure: bool
    options: tuple[str, ...] = ()


def said(likely: Sequence[Mistake]) -> str:
    """One line on mistakes, at least one, with the command that mends all of them."""
    what = "; ".join(one.what for one in likely)
    options = [option for one in likely for option in one.options]
    return f"{what}: {mend(*options)}" if options else what


def without_model(theta: Array, duty: Array, i_a: Array, v_a: Array) -> list[Mistake]:
    """Mistakes that show whatever the parameters of the rig are.

    Args:
        theta: [rad] (N,) angle, NaN where missing; likewise:
        duty: (N,) duty.
        i_a: [A] (N,) armature current.
        v_a: [V] (N,) armature voltage.
    """
    out = []
    known = theta[np.isfinite(theta)]
    span = _span(known) if len(known) else 0.0
    if span > TURNS:
        out.append(Mistake(f"the angle spans {span:.3g} rad, more than two turns, and may be in degrees", sure=False,
                           options=("--theta theta:deg",)))
    of_voltage, of_current = (_beside_duty(x, duty) for x in (v_a, i_a))
    if of_voltage > EXCHANGED * of_current and _correlation(v_a, duty) > RISES:
        out.append(replace(_exchanged("i_a", "v_a", "the current depends on the duty alone, the voltage does not"),
                           sure=False))
    return out


def _correlation(x: Array, duty: Array) -> float:
    """Correlation of a reading (N,) with the duty (N,), where both are there; both vary."""
    both = np.isfinite(x) & np.isfinite(duty)
    return float(np.corrcoef(x[both], duty[both])[0, 1])


def _beside_duty(x: Array, duty: Array) -> float:
    """Share of the variance of a reading (N,) that no function of the duty (N,) explains; NaN if it is not measured."""
    both = np.isfinite(x) & np.isfinite(duty)
    y = x[both]
    if len(y) < LEAST or np.ptp(y) == 0.0 or np.ptp(duty[both]) < STILL:
        return math.nan
    _, level = np.unique(np.round(duty[both] / STILL), return_inverse=True)
    mean = np.bincount(level, y) / np.bincount(level)
    return float(np.var(y - mean[level]) / np.var(y))


def found(readings: Mapping[str, Array], duty: Array, period: float, model: Model) -> list[Mistake]:
    """Mistakes in the readings of a calibrated rig.

    Args:
        readings: channel -> (N,) on a uniform grid, NaN where missing.
        duty: (N,) -1 to 1, held where a sample is missing.
        period: [s] of the grid.
        model: the nominal model.
    """
    if not np.isfinite(duty).all() or len(duty) < LEAST:
        return []
    if (wrong := _not_the_duty(readings, duty, period, model)) is not None:
        return [wrong]
    simulated = record(model, duty, period=period)[0]
    if (name := _exchanged_with_duty(readings, duty, period, model, simulated)) is not None:
        return [Mistake(f"it looks as if duty and {NAMES[name]} are exchanged (the rig follows {name} as its duty)",
                        sure=True, options=(f"--duty {name}:1", f"--{OPTIONS[name]} duty:{OWN[name]}"))]
    if (wrong := _turned_duty(readings, duty, period, model, simulated)) is not None:
        return [wrong]
    if _of_the_supply(readings["v_a"], simulated["v_a"], float(voltage(model.model, 1.0))):
        return [Mistake("it looks as if the voltage is that of the supply, not that at the motor (it does not follow "
                        "the duty): publish NaN as the voltage, or measure it behind the bridge", sure=True)]
    pairs = {}
    for name in OWN:
        x, y = simulated[name], readings[name]
        both = np.isfinite(x) & np.isfinite(y)
        if both.sum() >= LEAST and np.ptp(x[both]) > 0.0 and np.ptp(y[both]) > 0.0:
            pairs[name] = x[both], y[both]
    twos = [two for two in combinations(pairs, 2) if _are_exchanged(readings, simulated, *two)]
    out: list[Mistake | None] = [_exchanged(a, b, f"{a} fits the simulated {b}, {b} the simulated {a}")
                                 for a, b in twos]
    driven = np.ptp(duty) >= STILL
    same_rig = "theta" in pairs and _fits(*pairs["theta"])
    for name, pair in pairs.items():
        if not any(name in two for two in twos):
            out.append(_of_channel(name, *pair, same_rig=same_rig) or (_absurd(name, *pair) if driven else None))
    if not any(out):
        out += [_slipped(readings["theta"], period), _late(readings, simulated, period)]
    return [one for one in out if one is not None]


def _not_the_duty(readings: Mapping[str, Array], duty: Array, period: float, model: Model) -> Mistake | None:
    """Whether the motor is driven although the duty (N,) stays where it is; a rotor runs up, or down, at first."""
    if np.ptp(duty) >= STILL:
        return None
    full = float(voltage(model.model, 1.0))
    for name, most in (("v_a", full), ("omega", full / model.model["K_e"])):
        later = readings[name][round(RUN_UP / period):]
        known = later[np.isfinite(later)]
        if len(known) >= LEAST and (span := _span(known)) > DRIVEN * most:
            return Mistake(f"the duty stays at {float(duty[-1]):.2g}, but the {NAMES[name]} varies by {span:.3g} "
                           f"{OWN[name]}: another duty drove the motor; record armature or duty_command with it",
                           sure=True)
    return None


def _exchanged_with_duty(readings: Mapping[str, Array], duty: Array, period: float, model: Model,
                         simulated: Mapping[str, Array]) -> str | None:
    """The column that is the duty, whose own readings are in the column of the duty; None if the duty is right."""
    own = _largest_error(readings, simulated)
    for name in OWN:
        x = readings[name]
        if not np.isfinite(x).all() or np.abs(x).max() > 1.0 or np.ptp(x) < STILL:
            continue
        other = record(model, x, period=period)[0]
        if _largest_error({**readings, name: duty}, other) < min(FITS, own / BETTER):
            return name
    return None


def _turned_duty(readings: Mapping[str, Array], duty: Array, period: float, model: Model,
                 simulated: Mapping[str, Array]) -> Mistake | None:
    """Whether the rig follows the duty turned over, or what the duty lacks to 1."""
    own = _largest_error(readings, simulated)
    if np.ptp(duty) < STILL or not own > FITS:
        return None
    for other, what, options in (
            (-duty, "turned over (the rig follows it with the other sign)", ("--duty duty:-100%",)),
            (1.0 - duty, "inverted (the rig follows 1 - duty)", ("--duty duty:counts:1..0",)),
            (0.5 * (1.0 + duty), "-1 without drive (the rig follows half of 1 + duty)", ("--duty duty:counts:-1..1",))):
        if np.abs(other).max() <= 1.0 and _largest_error(
                readings, record(model, other, period=period)[0]) < min(FITS, own / BETTER):
            return Mistake(f"it looks as if the duty is {what}", sure=True, options=options)
    return None


def _of_the_supply(y: Array, x: Array, full: float) -> bool:
    """Whether a voltage (N,) stays near one value that is well above 0, where the simulated one (N,) varies.

    Args:
        y: [V] as read.
        x: [V] simulated.
        full: [V] of full duty.
    """
    both = np.isfinite(x) & np.isfinite(y)
    if both.sum() < LEAST or not (typical := float(np.median(y[both]))) > 0.0:
        return False
    return 0.0 < _span(y[both]) < STEADY * typical and _span(x[both]) > DRIVEN * full


def _largest_error(readings: Mapping[str, Array], simulated: Mapping[str, Array]) -> float:
    """The error of the channel that follows its simulation worst, of those that were measured."""
    return max((e for c in OWN if not math.isnan(e := _error(readings[c], simulated[c]))), default=math.nan)


def _are_exchanged(readings: Mapping[str, Array], simulated: Mapping[str, Array], a: str, b: str) -> bool:
    """Whether two columns fit the simulations of each other, and not their own."""
    return all(_error(readings[x], simulated[y]) < min(FITS, _error(readings[x], simulated[x]) / BETTER)
               for x, y in ((a, b), (b, a)))


def _error(y: Array, x: Array) -> float:
    """RMS of a reading (N,) minus a simulation (N,), in standard deviations of the simulation."""
    both = np.isfinite(x) & np.isfinite(y)
    if not both.any():
        return math.nan
    return float(np.sqrt(np.mean((y[both] - x[both]) ** 2)) / max(float(np.std(x[both])), 1e-12))


def _exchanged(a: str, b: str, why: str) -> Mistake:
    return Mistake(f"it looks as if {NAMES[a]} and {NAMES[b]} are exchanged ({why})", sure=True,
                   options=(f"--{OPTIONS[a]} {b}:{OWN[a]}", f"--{OPTIONS[b]} {a}:{OWN[b]}"))


def _slipped(theta: Array, period: float) -> Mistake | None:
    """Whether an angle (N,) jumps to stay, faster than an arm turns."""
    inner = slice(SINGLE // 2, -(SINGLE // 2))
    known = np.flatnonzero(np.isfinite(theta))
    if len(known) <= SINGLE:
        return None
    steps = np.diff(median_filter(theta[known], SINGLE)[inner])
    known = known[inner]
    jumps = np.flatnonzero(np.abs(steps) > np.maximum(FASTEST * period * np.diff(known), OFF_ZERO))
    if not len(jumps):
        return None
    at = jumps[0]
    return Mistake(f"the angle jumps by {steps[at]:.2g} rad at {known[at] * period:.1f} s, {JUMPS}: "
                   "its zero was set there, or it slipped; record again", sure=True)


def _late(readings: Mapping[str, Array], simulated: Mapping[str, Array], period: float) -> Mistake | None:
    """Whether the motor acts before its duty says so, which no effect does."""
    every = max(round(LATE_STEP / period), 1)
    most = round(LATE_MOST / (every * period))
    for name, least in LATE.items():
        x, y = simulated[name][::every], readings[name][::every]
        if np.isfinite(y).sum() < LEAST or len(y) <= 2 * most:
            continue
        left = {k: _unexplained(x[max(k, 0):len(x) + min(k, 0)], y[max(-k, 0):len(y) - max(k, 0)])
                for k in range(-most, most + 1)}
        best = min(left, key=lambda k: left[k])
        lead = best * every * period
        if lead >= least and left[best] < LATE_LEFT and left[best] < left[0] / LATE_BETTER:
            return Mistake(f"it looks as if the duty were stamped {lead:.2f} s late: the {NAMES[name]} changes before "
                           "it, as with no effect; stamp it with the instant from which it acts, and record again",
                           sure=name == "v_a")
        return None
    return None


def _unexplained(x: Array, y: Array) -> float:
    """Share of the variance of y (N,) that x (N,) does not explain; 1 if they go against each other."""
    both = np.isfinite(x) & np.isfinite(y)
    if both.sum() < LEAST or np.ptp(x[both]) == 0.0 or np.ptp(y[both]) == 0.0:
        return 1.0
    r = float(np.corrcoef(x[both], y[both])[0, 1])
    return 1.0 - max(r, 0.0) ** 2


def _span(x: Array) -> float:
    """Range of readings (N,) without rare ones."""
    return float(np.ptp(np.percentile(x, RARE)))


def _absurd(name: str, x: Array, y: Array) -> Mistake | None:
    """Whether a reading (N,) of the motor has another size than any rig, beside its simulation (N,)."""
    if name == "theta" or not _span(y) > ABSURD * _span(x) > 0.0:
        return None
    return Mistake(f"the {NAMES[name]} spans {_span(y):.3g} {OWN[name]}, {_span(y) / _span(x):.3g} times as far as in "
                   "the model with the same duty: check its unit, or give the model file of the rig", sure=True)


def _follows(x: Array, y: Array) -> tuple[float, float]:
    """Correlation of readings y (N,) with their simulation x (N,), and how many times as far they go."""
    sx, sy = float(np.std(x)), float(np.std(y))
    r = float(np.mean((x - x.mean()) * (y - y.mean()))) / (sx * sy)
    return r, sy / sx * abs(r)


def _fits(x: Array, y: Array) -> bool:
    """Whether readings y (N,) go as their simulation x (N,) does, in the unit of the model or in another."""
    r, ratio = _follows(x, y)
    return abs(r) >= FOLLOWS and any(1.0 / CLOSE < ratio / size < CLOSE
                                     for size in (1.0, *(unit.ratio for unit in UNITS["theta"])))


def _of_channel(name: str, x: Array, y: Array, *, same_rig: bool) -> Mistake | None:
    """The mistake that the readings y (N,) beside their simulation x (N,) show.

    Args:
        name: of the channel.
        x: (N,) simulated.
        y: (N,) read.
        same_rig: whether the angle shows that the model is of this rig.
    """
    r, ratio = _follows(x, y)
    if abs(r) < FOLLOWS:
        return None
    unit = next((u for u in UNITS[name] if 1.0 / CLOSE < ratio / u.ratio < CLOSE), None)
    if name == "theta" and ratio > CLOSE and (y == np.rint(y)).all():
        most = min(TURN_COUNTS, key=lambda n: abs(math.log(ratio * math.tau / n)))
        counts = Unit(f"counts:{most}", most / math.tau)
        if unit is None or abs(math.log(ratio / unit.ratio)) > abs(math.log(ratio / counts.ratio)):
            unit = counts
    turned = r < 0.0
    against = f"it goes {'against' if turned else 'with'} the simulated one, {ratio:.3g} times as far"
    size = 1.0 if unit is None else unit.ratio
    zero = float(np.median(y - (-size if turned else size) * x))
    off = name == "theta" and 1.0 / CLOSE < ratio / size < CLOSE and abs(zero) > OFF_ZERO * size
    hangs = (f"{zero:.3f}rad" if unit is None else f"{zero:.0f}" if unit.name.startswith("counts")
             else f"{zero:.3g}{unit.name}")
    options = (f"--zero {hangs}",) if off else ()
    if unit is not None:
        what = f"is in {unit.name}{' and turned over' * turned}"
    elif turned and 1.0 / OPPOSITE < ratio < OPPOSITE:
        what = "is turned over"
    elif off and not turned:
        return Mistake(f"it looks as if the arm hung at a reading of about {zero:.3f} rad, not 0 (let it hang, and "
                       "give what is read then)", abs(zero) > ZERO, options)
    else:
        return None
    if name == "theta":
        options = (*(f"--theta theta:{one.name}" for one in [unit] if one), *["--flip"] * turned, *options)
    else:
        options = (f"--{OPTIONS[name]} {name}:{'-1' * turned}{OWN[name] if unit is None else unit.name}",)
    also = f", and as if the arm hung at a reading of {hangs}, not 0" if off else ""
    return Mistake(f"it looks as if the {NAMES[name]} {what} ({against}){also}",
                   turned or (unit is not None and (unit.sure or same_rig)), options)
