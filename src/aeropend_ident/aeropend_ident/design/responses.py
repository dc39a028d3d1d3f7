# SPDX-License-Identifier: Apache-2.0
"""How the readings of a rig under a duty signal change with its numbers and with effects.

Every change is a row over all readings, in units of their noise. What a recording shows of the rows is in their
products (Gram matrix), so that each question about it is small linear algebra.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.design.limits import LimitError, Ranges, reach_of
from aeropend_ident.diagnosis.chain.free_run import StagedRun
from aeropend_ident.diagnosis.chain.priors import NOMINAL_SD, SIZE_SD, TOLERANCE, usual_size
from aeropend_ident.diagnosis.experiment_design import PlannedReadings, unread
from aeropend_ident.diagnosis.search.hypotheses import MISMATCH_SD, hypotheses
from aeropend_ident.estimation.parameter import Parameter
from aeropend_ident.signals.signals import Signals
from aeropend_sim.model.effects import DEFINED, RANDOM
from aeropend_sim.model.parameters import MODEL_NAMES, SAMPLE_PERIOD, Model

Array = NDArray[np.float64]
Readings = dict[str, Array]
"""Channel -> (N,)."""

STEP = 0.1
"""Standard deviations of its prior by which a value is varied for a derivative (choice: far above rounding)."""

IMPERFECTION = 0.05
"""Standard deviation of each effect that a rig has beside the one that is asked for, in usual sizes.

Choice: on `bench` most effects begin to show at 0.03 to 0.1 of their usual size (docs/guide/experiments.md), so that a
rig may well have them and nobody knows."""

TAIL = 3.0
"""[s] Time after the end of a signal in which limits hold too, with duty 0 (choice: the arm falls and swings back)."""


@dataclass(frozen=True)
class Asked:
    """An effect of a size that an experiment should show.

    Attributes:
        name: of the hypothesis: an effect, or `parameter_mismatch:K_t`.
        size: as a distance from the neutral one, with its sign; for a parameter the relative change.
        usual: size, as `size`.
        values: with the size.
        further: other parameters of the effect.
    """

    name: str
    size: float
    usual: float
    values: Mapping[str, float]
    further: tuple[Parameter, ...] = ()


def asked(model: Model, further: Sequence[str] = (), sizes: Mapping[str, float] | None = None) -> dict[str, Asked]:
    """Every effect that a rig like a model may have, with its usual size or another.

    Args:
        model: the nominal model.
        further: ids of effects of effect files.
        sizes: effect -> size, as a distance from the neutral one.

    Raises:
        LimitError: a size beyond the range of the effect.
    """
    found = {}
    for h in hypotheses(model, further):
        if h.parameter:
            found[h.name] = Asked(h.name, MISMATCH_SD, MISMATCH_SD,
                                  {h.parameter: (1.0 + MISMATCH_SD) * model.model[h.parameter]})
        elif h.effect not in RANDOM:
            effect = DEFINED[h.effect]
            own = {f"{effect.id}.{n}": x for n, x in effect.defaults.items()}
            neutral = effect.parameters[effect.size].neutral
            usual = usual_size(h.effect, model) - neutral
            size = float(np.copysign((sizes or {}).get(h.effect, abs(usual)), usual))
            if not h.own[0].low <= neutral + size <= h.own[0].high:
                most = (h.own[0].high - neutral) if usual > 0.0 else (neutral - h.own[0].low)
                raise LimitError(f"{h.effect} of {abs(size):g} is no size that it may have: give at most {most:g}")
            values = {**own, h.own[0].name: neutral + size}
            found[h.name] = Asked(h.name, size, usual, values, h.own[1:])
    return found


class Rows:
    """The rows of a rig: numbers of the model, effects, and further parameters of effects.

    Args:
        model: the nominal model.
        signals: a recording that gives channels, noise and pulses.
        effects: that the rig may have (`asked`).
    """

    def __init__(self, model: Model, signals: Signals, effects: Mapping[str, Asked]) -> None:
        self.model, self.signals = model, signals
        self.numbers = {n: NOMINAL_SD * abs(model.model[n]) for n in MODEL_NAMES if model.model[n] != 0.0}
        self.effects = {name: e for name, e in effects.items() if not name.partition(":")[2]}
        self.names = [*self.numbers, *self.effects]
        ends = len(self.names) + np.cumsum([len(e.further) for e in self.effects.values()])
        self.further = {name: tuple(range(end - len(e.further), end))
                        for (name, e), end in zip(self.effects.items(), ends.tolist(), strict=True)}
        self.background = np.concatenate([np.ones(len(self.numbers)), [
            IMPERFECTION * abs(e.usual / e.size) for e in self.effects.values()]])
        """(K,) Standard deviation of each number and effect that is not asked for, in units of its row."""

    def index(self, name: str) -> int:
        """The row of an effect, or of the number that a mismatch blames."""
        return self.names.index(name.partition(":")[2] or name)

    def wide(self, name: str) -> float:
        """Standard deviation of a hypothesis that is fitted, in units of its row."""
        if parameter := name.partition(":")[2]:
            return MISMATCH_SD * abs(self.model.model[parameter]) / self.numbers[parameter]
        return SIZE_SD * abs(self.effects[name].usual / self.effects[name].size)

    def under(self, duty: Array) -> Responses:
        """The responses to a duty signal.

        Args:
            duty: (N,) from rest, held for one `SAMPLE_PERIOD` each.
        """
        planned = PlannedReadings.under(self.model, self.signals, duty)
        whole = after(self.signals, duty)
        run = StagedRun(self.model, whole)
        base, others = self._with_numbers(run)
        here = planned.stacked(base)
        rows = [(planned.stacked(moved) - here) / STEP for moved in others]
        unsure = _unsure(base, others)
        reach = _around(base, unsure)
        with_ = {}
        for name, e in self.effects.items():
            moved = run.readings(e.values)
            with_[name] = planned.stacked(moved)
            rows.append(with_[name] - here)
            own = _around(moved, unsure)
            reach = {c: (min(reach[c][0], own[c][0]), max(reach[c][1], own[c][1])) for c in reach}
        for name, e in self.effects.items():
            for p in e.further:
                moved = run.readings({**e.values, p.name: _varied(p, e.values[p.name])})
                rows.append((planned.stacked(moved) - with_[name]) / STEP)
        return Responses(np.array(rows), reach)

    def band(self, signals: Signals) -> tuple[Readings, Readings]:
        """The nominal readings under a duty signal, and how far numbers in their tolerance move them, to first order.

        Args:
            signals: with the duty (`after`).
        """
        base, others = self._with_numbers(StagedRun(self.model, signals))
        return base, _unsure(base, others)

    def _with_numbers(self, run: StagedRun) -> tuple[Readings, list[Readings]]:
        """The nominal readings, and those with each number moved by a step."""
        return run.readings({}), [
            run.readings({n: self.model.model[n] + STEP * sd}) for n, sd in self.numbers.items()]


@dataclass(frozen=True)
class Responses:
    """What a duty signal shows.

    Attributes:
        rows: (R, M) changes of the readings.
        reach: what the channels reach at most, on any rig within the uncertainty, to the first order.
    """

    rows: Array
    reach: Ranges

    @cached_property
    def products(self) -> Array:
        """(R, R) of the rows."""
        return np.asarray(self.rows @ self.rows.T)


def after(signals: Signals, duty: Array, tail: float = TAIL) -> Signals:
    """A recording without readings of a duty signal and of the time after it, with duty 0.

    Args:
        signals: a recording of the rig.
        duty: (N,).
        tail: [s] that time.
    """
    return unread(signals, np.concatenate([duty, np.zeros(round(tail / SAMPLE_PERIOD))]))


def _unsure(base: Readings, others: Sequence[Readings]) -> Readings:
    """Channel -> (N,) sum of the changes by each number at the end of its tolerance."""
    return {c: TOLERANCE / STEP * np.sum([np.abs(moved[c] - base[c]) for moved in others], axis=0)
            for c in ("theta", "omega", "i_a")}


def _around(readings: Mapping[str, Array], unsure: Mapping[str, Array]) -> Ranges:
    """What the channels reach, each sample up to some value more or less."""
    low = reach_of({c: readings[c] - x for c, x in unsure.items()})
    high = reach_of({c: readings[c] + x for c, x in unsure.items()})
    return {c: (low[c][0], high[c][1]) for c in low}


def _varied(p: Parameter, value: float) -> float:
    """A value, varied by a step inside the bounds of its parameter."""
    moved = p.value(p.to_standard(value) + STEP)
    return moved if moved <= p.high else p.value(p.to_standard(value) - STEP)
