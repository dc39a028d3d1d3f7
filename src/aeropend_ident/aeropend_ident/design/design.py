# SPDX-License-Identifier: Apache-2.0
"""Design of an experiment: from what is asked and what must hold to a signal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from aeropend_ident.design.exchange import Exchange, Holds, Tried, of_series
from aeropend_ident.design.goals import Answer, Goal
from aeropend_ident.design.limits import LimitError, Limits, Ranges, crossings
from aeropend_ident.design.responses import Rows, after
from aeropend_ident.diagnosis.experiment_design import EXPERIMENTS
from aeropend_sim.model.excitation import Excitation

Progress = Callable[[str, float], None]
"""Called with the present step and the share (0 to 1) of the work that is done."""

LENGTH = 20.0
"""[s] Length of an experiment if none is given (choice: the search of a longer one takes long)."""

DURATIONS = (10.0, 15.0, 20.0, 30.0, 45.0, 60.0)
"""[s] Lengths that are tried in turn until all that is asked is reached (choice)."""

EFFORT = 12_000.0
"""[s] Length of all signals that are tried for one length (choice: 600 signals of 20 s; more hardly helps)."""

OUT_OF_REACH = 0.25
"""Share of what is asked below which a length is left out, if no start reaches more.

Choice: a search gains a factor of two or three."""

DRAWS = 1000
"""Rigs that are drawn to check the limits (choice: one in a thousand is seen)."""

DOWN = 0.98
"""Factor on the duties after a drawn rig crossed a limit (choice)."""

LEAST_MOTION = 0.05
"""Factor on the duties below which no signal is left (choice)."""


@dataclass(frozen=True)
class Designed:
    """An experiment.

    Attributes:
        excitation: the signal, as `excite` plays it.
        answers: to what is asked.
        limits: that hold.
        reach: what the channels reach at most on any rig within the uncertainty, to the first order.
        draws: rigs that were drawn, all of which kept the limits.
        best_before: the best of the signals that `diagnose` proposes, of the same length and within the same limits.
        answers_before: to what is asked, with that signal.
    """

    excitation: Excitation
    answers: tuple[Answer, ...]
    limits: Limits
    reach: Ranges
    draws: int
    best_before: str
    answers_before: tuple[Answer, ...]


def proposed(seconds: float, limits: Limits) -> dict[str, Holds]:
    """The signals that `diagnose` proposes, by number and kind; not those that are no holds.

    Args:
        seconds: length.
        limits: of the duty.
    """
    return {f"{k} {e.kind}": of_series(replace(e, duration=seconds).series(), limits)
            for k, e in enumerate(EXPERIMENTS, 1) if e.kind != "multisine"}


def random_holds(seconds: float, limits: Limits, seed: int) -> dict[str, Holds]:
    """Random signals, fast and slow, from which a search starts too; arguments as of `proposed`, and a seed."""
    drawn = [Excitation("latin_hypercube", seconds, seed + k, duty_max=max(limits.duty[1], 0.02), hold_min=0.1,
                        hold_max=longest, rest=longest) for k, longest in enumerate((0.5, 1.0, 2.0, 4.0))]
    return {f"random {k}": of_series(e.series(), limits) for k, e in enumerate(drawn)}


def design(rows: Rows, goal: Goal, limits: Limits, seconds: float | None = None, *, tries: int | None = None,
           seed: int = 0, jobs: int = 1, progress: Progress = lambda *_: None) -> Designed:
    """Design an experiment.

    Args:
        rows: of the rig.
        goal: of the experiment.
        limits: that hold for every rig within the uncertainty.
        seconds: its length; None: the shortest of `DURATIONS` with which all that is asked is reached, or the longest.
        tries: signals that are tried for one length; None: as many as `EFFORT` allows.
        seed: of the search.
        jobs: processes.
        progress: of the search.

    Raises:
        LimitError: no signal keeps the limits.
    """
    exchange = Exchange(rows, goal, limits, jobs)
    for length in DURATIONS if seconds is None else (seconds,):
        known = proposed(length, limits)
        begun = exchange.begin({**known, **random_holds(length, limits, seed)})
        if not begun:
            raise LimitError("no signal keeps the limits on every rig within the uncertainty: even 5 % of the duties "
                             "exceed one of them; allow more")
        if seconds is None and length < DURATIONS[-1] and all(
                min(a.reached for a in t.answers) < OUT_OF_REACH for t in begun.values()):
            continue
        best = exchange.improve(list(begun.values()), tries or round(EFFORT / length), seed, enough=seconds is None,
                                progress=partial(progress, f"signals of {length:g} s"))
        if best.enough:
            break
    progress("limits", 0.0)
    safe = _checked(exchange, best, seed)
    before = max((name for name in begun if name in known), key=lambda n: begun[n].score, default="")
    return Designed(safe.holds.excitation, safe.answers, limits, safe.reach, DRAWS, before,
                    begun[before].answers if before else ())


def prolonged(rows: Rows, goal: Goal, best: Designed, times: int) -> Designed:
    """An experiment that is repeated; its duties are lowered if an arm that already moves would cross a limit.

    Args:
        rows: of the rig.
        goal: of the experiment.
        best: the experiment.
        times: that it is played.
    """
    exchange = Exchange(rows, goal, best.limits)
    x = best.excitation
    within = exchange.within(Holds(x.sequence * times, x.holds * times, x.duty_rate))
    if within is None:
        return best
    safe = _checked(exchange, within, 0)
    return replace(best, excitation=safe.holds.excitation, answers=safe.answers, reach=safe.reach)


def _checked(exchange: Exchange, best: Tried, seed: int) -> Tried:
    """A signal with its duties lowered until no drawn rig crosses a limit."""
    rows, limits, factor = exchange.rows, exchange.limits, 1.0
    effects = [e.values for e in rows.effects.values()]
    tried = best
    while factor > LEAST_MOTION:
        experiment = after(rows.signals, tried.holds.excitation.series())
        if not crossings(rows.model, experiment, limits, effects, DRAWS, seed):
            return tried
        factor *= DOWN
        tried = exchange.tried(best.holds.scaled(factor, limits))
    raise LimitError("no signal keeps the limits on every rig within the uncertainty; allow more")
