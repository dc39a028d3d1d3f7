# SPDX-License-Identifier: Apache-2.0
"""What `diagnose` would say of an effect of some size: the conditions of its search and of its verdict, linearised.

The rig's numbers are drawn within their tolerance; noise is that of the planned recording. Each draw is used with its
mirror image: the mean over both has no term in which noise and effect are multiplied, so that what is said holds with a
probability of one half.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.priors import TOLERANCE, usual_size
from aeropend_ident.diagnosis.chain.values import CHANNELS_OF
from aeropend_ident.diagnosis.gap_share import headline, shares
from aeropend_ident.diagnosis.isolation.free_runs import FreeRuns
from aeropend_ident.diagnosis.isolation.linear import Column, LinearStages, Screening
from aeropend_ident.diagnosis.isolation.planned import SEED
from aeropend_ident.diagnosis.joint_fit import SURE, WIDER
from aeropend_ident.diagnosis.policy import CALIBRATED, CERTAIN, MATERIAL, MATERIAL_SHARE
from aeropend_ident.diagnosis.search.hypotheses import Hypothesis, stages_of
from aeropend_ident.diagnosis.search.selection import squared_gap
from aeropend_ident.estimation.map_fit import Fit
from aeropend_ident.estimation.parameter import Parameter
from aeropend_ident.estimation.residuals import Residuals
from aeropend_sim.model.effects import DEFINED, RANDOM

Array = NDArray[np.float64]

SIZES = (0.1, 1.0, 3.0, 10.0)
"""Sizes of a rival, in usual sizes, besides that from which a search starts, at which it is linearised (choice)."""

RIVALS = 4
"""Rivals that are fitted after the screening (choice: as many as contend in a diagnosis)."""

CLOSEST = 3
"""Rivals that are linearised again where they fit (choice: those that explain less are ruled out in any case)."""

STEPS, SETTLED = 6, 0.003
"""Times that a rival is linearised again at most, and relative change of its size that needs no further (choice)."""

RUNS_AWAY = 1e6
"""Change of a residual, in units of a reading's noise, of a run that diverges (choice: far above any reading)."""

MIRRORS = (1.0, -1.0)
"""The noise, and its mirror image."""

ALIKE = 1e-6
"""Relative difference up to which two columns are the same (choice: far above rounding, and below what noise shows)."""

LEAST = 1e-7
"""Square of a size over that wanted which counts as none (choice: far below any that matters)."""

RIGS = 2
"""Draws of the rig's numbers within their tolerance (choice: two, each with its mirror image).

They matter for effects that a number imitates until it is at the end of its prior."""


@dataclass(frozen=True)
class Truth:
    """An effect that the rig has.

    Attributes:
        hypothesis: that names it.
        usual: distance of its usual size from the neutral one, with its sign.
        stages: whose residuals it changes.
    """

    hypothesis: Hypothesis
    usual: float
    stages: tuple[str, ...]

    @property
    def size(self) -> Parameter:
        """The size."""
        return self.hypothesis.own[0]

    @property
    def unit(self) -> str:
        """Unit of the size."""
        return DEFINED[self.hypothesis.effect].parameters[DEFINED[self.hypothesis.effect].size].unit

    @property
    def largest(self) -> float:
        """The largest size, as a distance from the neutral one."""
        return self.size.high - self.size.mean if self.usual > 0.0 else self.size.mean - self.size.low

    def values(self, size: float) -> dict[str, float]:
        """Values with a size, as a distance from the neutral one; other parameters at their defaults."""
        effect = DEFINED[self.hypothesis.effect]
        own = {f"{effect.id}.{n}": x for n, x in effect.defaults.items()}
        return {**own, self.size.name: self.size.mean + math.copysign(size, self.usual)}


@dataclass(frozen=True)
class Rival:
    """A hypothesis, linearised at a point.

    Attributes:
        hypothesis: what it is.
        stages: whose residuals it changes.
        columns: one, or two between which its second parameter lies.
        starts: its parameters, of each column; none for a parameter of the model.
        instead: name of the nominal parameter that it fits in its own way.
    """

    hypothesis: Hypothesis
    stages: tuple[str, ...]
    columns: tuple[Column, ...]
    starts: tuple[tuple[Parameter, ...], ...] = ()
    instead: str = ""


class Judge:
    """Says what a diagnosis of a planned recording would say.

    Args:
        chains: cut, of the recording of a rig that is like the model.
        hypotheses: that a diagnosis would try, other forms among them.
        material: share of the gap from which an effect is claimed.
    """

    def __init__(self, chains: CutChains, hypotheses: Sequence[Hypothesis], material: float = MATERIAL_SHARE) -> None:
        self.chains, self.material = chains, material
        self.linear = LinearStages(chains)
        self.free = FreeRuns(chains, self.linear.parameters)
        changed = stages_of(self.chains, [h for h in hypotheses if not h.parameter])
        self.acts_on = {h.name: self._measured(self._shown_by(h) if h.parameter else changed[h.name])
                        for h in hypotheses}
        self.hypotheses = list(hypotheses)
        self._noise: dict[tuple[str, ...], list[dict[str, float]]] = {}
        rng = np.random.default_rng(SEED)
        rigs = rng.uniform(-TOLERANCE, TOLERANCE, (RIGS, len(self.linear.parameters)))
        self._draws = [{c: mirror * x for c, x in self.linear.of_rig(z).items()} for z in rigs for mirror in MIRRORS]

    # ---- hypotheses

    def _shown_by(self, h: Hypothesis) -> set[str]:
        """The stages whose residuals a parameter changes."""
        return {self.linear.stage_of[c] for c in self.linear.column_of(h.parameter).rows}

    def _measured(self, stages: Collection[str]) -> tuple[str, ...]:
        """Those of some stages that have a measured channel."""
        return tuple(b for b in self.linear.stages if b in stages)

    @cached_property
    def rivals(self) -> dict[str, tuple[list[Rival], Screening]]:
        """First stage that they change -> the hypotheses, linearised."""
        shown = [h for h in self.hypotheses if self.acts_on[h.name] and h.effect not in RANDOM]
        all_ = [r for h in shown for r in ([self._of_parameter(h)] if h.parameter else self._of_effect(h))]
        found = {}
        for stage in self.linear.stages:
            mine = [r for r in all_ if r.stages[0] == stage]
            found[stage] = (mine, Screening(self.linear, [r.columns for r in mine]))
        return found

    def truth(self, h: Hypothesis) -> Truth:
        """A hypothesis as the truth."""
        size = DEFINED[h.effect].parameters[DEFINED[h.effect].size]
        usual = usual_size(h.effect, self.chains.model) - size.neutral
        return Truth(h, usual, self.acts_on.get(h.name, ()))

    def _of_parameter(self, h: Hypothesis) -> Rival:
        p = h.own[0]
        column = self.linear.column_of(p.name)
        (known,) = (q for q in self.linear.parameters if q.name == p.name)
        wider = p.sd / known.sd
        own = Column({c: wider * x for c, x in column.rows.items()}, p.to_standard(p.low), p.to_standard(p.high))
        return Rival(h, self.acts_on[h.name], (own,), instead=p.name)

    def _of_effect(self, h: Hypothesis) -> list[Rival]:
        stages, usual = self.acts_on[h.name], abs(self.truth(h).usual)
        points = (h.starts[0], h.starts[-1]) if DEFINED[h.effect].linear_in else h.starts
        found: list[Rival] = []
        for share in (None, *SIZES):
            heads = [own[0].begin if share is None else own[0].mean + math.copysign(
                share * usual, own[0].begin - own[0].mean) for own in points]
            columns = [(c, own) for own, at in zip(points, heads, strict=True) if (c := self._column(h, own, at)).rows]
            found += [_distinct(Rival(h, stages, (a, b), (one, other))) for (a, one), (b, other) in pairwise(columns)]
            if len(columns) == 1:
                found.append(Rival(h, stages, (columns[0][0],), (columns[0][1],)))
        return found

    def _column(self, h: Hypothesis, own: tuple[Parameter, ...], size: float) -> Column:
        """The column of an effect with a value of its size."""
        head = own[0]
        size = min(max(size, head.low), head.high)
        change = self.linear.change({**{p.name: p.begin for p in own}, head.name: size}, self.acts_on[h.name])
        if any(np.abs(x).max() > RUNS_AWAY for x in change.values()):
            change = {}
        free = DEFINED[h.effect].linear_in == "polar"
        return Column({c: x / head.to_standard(size) for c, x in change.items()},
                      -np.inf if free else head.to_standard(head.low), np.inf if free else head.to_standard(head.high))

    def _again(self, rival: Rival, r: Residuals) -> Rival:
        """A rival, linearised at the size with which it fits residuals (Gauss-Newton steps)."""
        before = math.inf
        for _ in range(STEPS if rival.starts and not DEFINED[rival.hypothesis.effect].linear_in else 0):
            f = self.linear.fit(r, rival.columns)
            z = sum(f.values[f"own{j}"] for j in range(len(rival.columns)))
            if abs(z - before) <= SETTLED * abs(z) or abs(z) < LEAST:
                break
            columns = tuple(self._column(rival.hypothesis, own, own[0].value(z)) for own in rival.starts)
            if not all(c.rows for c in columns):
                break
            rival, before = _distinct(replace(rival, columns=columns)), z
        return rival

    # ---- one effect at one size

    def margin(self, truth: Truth, size: float, *, roughly: bool = False) -> float:
        """Log of the size over that from which a stage is searched and an effect is accepted: the median over rigs.

        Args:
            truth: the effect.
            size: of it, as a distance from the neutral one.
            roughly: whether one rig is enough.
        """
        change = self.linear.change(truth.values(size), truth.stages[:1])
        margins = []
        rigs = len(self._draws) if not roughly else 1
        rs = self._residuals(change, truth.stages[:1], rigs)
        for r, noise in zip(rs, self._alone(truth.stages[:1]), strict=False):
            left = _squares(self.linear.fit(r))
            searched = max(left[c] - 1.0 for c in left) / (0.5 * MATERIAL**2)
            explained = max(left[c] - noise[c] for c in left) / MATERIAL**2
            margins.append(0.5 * math.log(max(min(searched, explained), LEAST)))
        return float(np.median(margins))

    def _alone(self, stages: tuple[str, ...]) -> list[dict[str, float]]:
        """Channel -> mean square that the nominal model leaves of noise alone, for each rig."""
        if stages not in self._noise:
            self._noise[stages] = [_squares(self.linear.fit(r)) for r in self._residuals({}, stages, len(self._draws))]
        return self._noise[stages]

    def is_sure(self, truth: Truth, size: float) -> bool:
        """Whether an effect that the search accepts has evidence, is certain after the joint fit, and is claimed."""
        values = truth.values(size)
        rs = self._residuals(change := self.linear.change(values, truth.stages), truth.stages)
        own, z = self._own(truth, size, change)
        base, fitted = [self.linear.fit(r) for r in rs], [self.linear.fit(r, own) for r in rs]
        gain = _mean([g.evidence_over(f) for f, g in zip(base, fitted, strict=True)]) + truth.hypothesis.log_odds
        unsure = WIDER * fitted[0].sd["own0"] / z
        if gain <= 0.0 or (gain <= CERTAIN and unsure * SURE > 1.0):
            return False
        rest = self.free.rest_of(self.free.change(values))
        h = truth.hypothesis
        said = [headline([part, *self.free.rest], shares([part, *self.free.rest]), self.material).verdict
                for part in (self.free.part(h.name, h.place, rest, mirror, unsure) for mirror in MIRRORS)]
        return any(verdict != "none" for verdict in said)

    def _residuals(self, change: Residuals, stages: Collection[str], rigs: int = len(MIRRORS)) -> tuple[Residuals, ...]:
        """Residuals of some of the rigs, with a change; by default one rig and its mirror image."""
        return tuple({c: e - change.get(c, 0.0) for c, e in draw.items() if self.linear.stage_of[c] in stages}
                     for draw in self._draws[:rigs])

    def _own(self, truth: Truth, size: float, change: Residuals) -> tuple[tuple[Column, ...], float]:
        """The column of an effect at its size, and that size in standard deviations of its prior."""
        z = abs(truth.size.to_standard(truth.size.mean + math.copysign(size, truth.usual)))
        return (Column({c: x / z for c, x in change.items()}),), z

    # ---- rivals

    def probabilities(self, truth: Truth, size: float) -> dict[str, float]:
        """Family -> probability in the first stage that the effect changes, of those that are compared to their end.

        Args:
            truth: the effect.
            size: of it, as a distance from the neutral one.
        """
        change = self.linear.change(truth.values(size), truth.stages)
        first = truth.stages[0]
        rivals, screening = self.rivals[first]
        stages = tuple({b: None for r in rivals for b in r.stages} | dict.fromkeys(truth.stages))
        rs = self._residuals(change, stages)
        base = [self.linear.fit(r) for r in rs]
        short = self._short(truth, rivals, screening.explained(rs[0], base[0]))
        tried = [(truth.hypothesis, [self.linear.fit(r, self._own(truth, size, change)[0]) for r in rs])]
        for k, one in enumerate(short):
            again = self._again(one, rs[0]) if k < CLOSEST else one
            tried.append((one.hypothesis, [self.linear.fit(r, again.columns, instead=again.instead) for r in rs]))
        gains = [_mean([f.evidence_over(b) for b, f in zip(base, fits, strict=True)]) + h.log_odds for h, fits in tried]
        open_, *left = (_mean([squared_gap(self.chains, f, CHANNELS_OF[first]) for f in fits])
                        for fits in (base, *(fits for _, fits in tried)))
        most = min(left) + MATERIAL_SHARE * open_
        best: dict[str, float] = {}
        for (h, _), gain, x in zip(tried, gains, left, strict=True):
            if x <= most:
                best[h.family] = max(best.get(h.family, -np.inf), gain)
        total = np.logaddexp.reduce([0.0, *best.values()])
        return {name: math.exp(gain - total) for name, gain in best.items()}

    @staticmethod
    def _short(truth: Truth, rivals: Sequence[Rival], explained: Array) -> list[Rival]:
        """The rivals of the other families that explain most, with their forms, each at its best alternative."""
        best: dict[str, Rival] = {}
        families: set[str] = {truth.hypothesis.family}
        for k in np.argsort(-explained):
            h = rivals[k].hypothesis
            if h.name not in best and h.family != truth.hypothesis.family and (
                    h.family in families or len(families) <= RIVALS):
                families.add(h.family)
                best[h.name] = rivals[k]
        return list(best.values())

    def rivals_of(self, truth: Truth, size: float) -> dict[str, float] | None:
        """Family of each rival that is not ruled out -> its probability; None if the verdict names another effect."""
        found = self.probabilities(truth, size)
        own = truth.hypothesis.family
        if max(found, key=lambda n: found[n], default="") != own:
            return None
        return {name: p for name, p in found.items() if name != own and p > CALIBRATED.undecided}


def _distinct(rival: Rival) -> Rival:
    """A rival with one column where its two are the same: its second parameter changes nothing there."""
    first, *others = (c.rows for c in rival.columns)
    same = others and first.keys() == others[0].keys() and all(
        np.linalg.norm(x - first[c]) <= ALIKE * np.linalg.norm(first[c]) for c, x in others[0].items())
    return replace(rival, columns=rival.columns[:1], starts=rival.starts[:1]) if same else rival


def _squares(f: Fit) -> dict[str, float]:
    """Channel -> mean square of what a fit leaves."""
    return {c: float(np.mean(r * r)) for c, r in f.residuals.items()}


def _mean(x: Sequence[float]) -> float:
    return float(np.mean(x))
