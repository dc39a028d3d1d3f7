# SPDX-License-Identifier: Apache-2.0
"""The verdict `unknown`: whether a stage keeps more of its misfit than another form of a known effect would leave."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.priors import nominal_parameters
from aeropend_ident.diagnosis.policy import CERTAIN, GOOD_ENOUGH, MATERIAL_SHARE
from aeropend_ident.diagnosis.search import speed_spikes
from aeropend_ident.diagnosis.search.findings import Findings
from aeropend_ident.diagnosis.search.free_curves import MissingTerm, missing_terms
from aeropend_ident.diagnosis.search.selection import noise_over_spread
from aeropend_ident.estimation.map_fit import Fit
from aeropend_ident.estimation.parameter import Parameter, key
from aeropend_ident.signals.statistics import effective_sample_size

Array = NDArray[np.float64]

BY_CHANCE = 3.0
"""Standard deviations of a mean square that pass as chance (convention: 99.7 %)."""

ONE_TERM = 4.0
"""Ratio of what effects leave to what one missing term leaves above which they only approximate that term.

Choice: the term leaves half as much (RMS). With many small imperfections effects and one term leave about the same."""

MOSTLY_LEFT = 0.5
"""Share of the misfit that effects of a stage leave above which they only approximate an unknown one.

Derived: they explain less than they leave."""

WHITE = 0.5
"""Effective sample size, over the samples, above which a residual is white noise (choice).

A white excess is noise that was not seen before: readings at unsteady instants, or a coarser resolution."""

VISIBLE = 0.005
"""RMS of a channel's misfit, relative to the channel's spread, above which it matters (choice)."""


@dataclass(frozen=True)
class UnknownEffect:
    """An effect that the catalogue does not hold.

    Attributes:
        stage: of the chain in which it acts.
        term: the missing term at its likeliest place.
        instead: whether the effects found in this stage may only approximate it: one term explains far more, they leave
            most, or none of them is certain.
    """

    stage: str
    term: MissingTerm
    instead: bool


@dataclass(frozen=True)
class Misfit:
    """What a fit leaves in a channel.

    Attributes:
        square: mean square residual, in units of a reading's noise.
        noise: standard deviation of a reading, in units of that of the channel.
        count: readings that were fitted.
        white: whether it is white noise: small, or following neither inputs nor states.
        noticeable: mean square above which a misfit counts.
    """

    square: float
    noise: float
    count: int
    white: bool
    noticeable: float

    @property
    def amount(self) -> float:
        """Squared gap above the noise, in units of the spread squared; 0 if it passes as noise."""
        if self.white:
            return 0.0
        shows = max(self.square - 1.0, 0.0) * self.noise**2
        return shows if self.square > self.noticeable + BY_CHANCE * math.sqrt(2.0 / self.count) else 0.0

    def remains(self, base: Misfit, kept: float) -> bool:
        """Whether too much of a channel's own misfit is left.

        Args:
            base: misfit of the nominal structure.
            kept: share of it that may stay.
        """
        return (self.square > GOOD_ENOUGH**2 and self.square - 1.0 > kept * (base.square - 1.0)
                and math.sqrt(self.square) * self.noise > VISIBLE)


Misfits = Mapping[str, Mapping[str, Misfit]]
"""Stage -> channel -> misfit."""


def judge(chains: CutChains, findings: Mapping[str, Findings], *, gust: bool, spikes: bool,
          closed: Collection[str] = ()) -> UnknownEffect | None:
    """The unknown effect, if there is one.

    Args:
        chains: cut.
        findings: stage -> what was found.
        gust: whether `gust` was detected: the rest of the angle is then no misfit of the model.
        spikes: whether `speed_spikes` was detected: false captures that were not recognised are then no misfit.
        closed: stages in which the joint fit has closed the gap.
    """
    limits = chains.policy.unknown
    known = {b: [p for p in nominal_parameters(chains, b) if p.name in f.base.values] for b, f in findings.items()}
    fits = {"base": {b: f.base for b, f in findings.items()}, "final": {b: f.final for b, f in findings.items()}}

    @cache
    def missing(which: str, b: str) -> MissingTerm:
        return missing_terms(chains, b, fits[which][b], known[b])[0]

    def misfits(which: str) -> Misfits:
        return {b: {c: _misfit(chains, c, r, partial(missing, which, b)) for c, r in f.residuals.items()
                    if not (spikes and key(c).name == "omega") and not (gust and key(c).name == "theta")}
                for b, f in fits[which].items()}

    base, left = misfits("base"), misfits("final")
    amount = {b: sum(m.amount for m in left[b].values()) for b in findings}
    captures = speed_spikes.squared_gap(chains) if spikes else 0.0

    total = sum(m.amount for each in base.values() for m in each.values()) + captures

    def share(b: str) -> float:
        return amount[b] / total if total > 0.0 else 0.0

    terms: dict[str, MissingTerm] = {}
    instead: set[str] = set()
    for b, f in findings.items():
        if b in closed or not any(m.amount > 0.0 for m in base[b].values()):
            continue
        term = missing("base", b)
        elsewhere = bool(f.found) and term.place not in {h.place for h in f.effects}
        # several effects of one place may be one effect of another form; a parameter has no form
        several = len({h.place for h in f.effects}) > 1 or any(h.parameter for h in f.effects)
        simpler = f.final.mean_square - 1.0 > ONE_TERM * max(term.left - 1.0, 0.0)
        kept = share(b)
        if (kept > limits.form or (kept > limits.form_elsewhere and elsewhere)
                or (kept > limits.form_of_several and several and simpler)
                or any(m.amount > MATERIAL_SHARE * total and m.remains(base[b][c], limits.kept)
                       for c, m in left[b].items())):
            terms[b] = term
            certain = any(selection[0].gain > CERTAIN for selection in f.found)
            if (simpler and kept > limits.instead) or not certain:
                instead.add(b)
    if not terms:
        return None
    worst = max(terms, key=lambda b: amount[b])
    if share(worst) > MOSTLY_LEFT:
        instead.add(worst)
    term = terms[worst]
    if worst == "motor" and any(key(c).recording == 0 for c, r in findings[worst].base.residuals.items() if len(r)):
        term = _placed(chains, worst, findings[worst].base, known[worst])
    return UnknownEffect(worst, term, instead=worst in instead)


def _placed(chains: CutChains, stage: str, base: Fit, known: list[Parameter]) -> MissingTerm:
    """The missing term at the place that a term free in time fits best: it need not know what the term depends on."""
    place = missing_terms(chains, stage, base, known, any_time=True)[0].place
    return next(t for t in missing_terms(chains, stage, base, known) if t.place == place)


def _misfit(chains: CutChains, channel: str, r: Array, missing: Callable[[], MissingTerm]) -> Misfit:
    """The misfit of a channel; `missing`: the likeliest missing term of its stage."""
    square = float(np.mean(r * r))
    white = effective_sample_size(r) > WHITE * len(r) and (square < GOOD_ENOUGH**2 or not missing().follows)
    return Misfit(square, noise_over_spread(chains, channel), len(r), white, chains.policy.unknown.noticeable)
