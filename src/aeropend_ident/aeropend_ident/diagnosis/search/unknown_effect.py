# SPDX-License-Identifier: Apache-2.0
"""Whether an effect is there that the catalogue does not know: no other form of a known one would leave as much."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import Chains, of_recording
from aeropend_ident.diagnosis.chain.priors import free_swinging, nominal_unknowns
from aeropend_ident.diagnosis.search import speed_spikes
from aeropend_ident.diagnosis.search.free_curves import Shape, shapes
from aeropend_ident.diagnosis.search.search import Findings, not_strayed
from aeropend_ident.diagnosis.search.selection import GOOD_ENOUGH
from aeropend_ident.estimation.map_fit import Fit

Array = NDArray[np.float64]

FORM = 0.12
"""Share of the misfit that an effect may leave because a real one has another form than the catalogue's."""

FORM_ELSEWHERE, FORM_OF_SEVERAL = 0.025, 0.01
"""As `FORM`, where free curves at another place, or at one place instead of effects at several, explain more."""

FORMS_UNKNOWN, FORMS_SWINGING = (0.2, 0.08, 0.08, 0.25), (0.6, 0.6, 0.6, 0.6)
"""As these three and `KEPT`, of a rig whose numbers nobody knows, and of an arm that swings freely: its form differs
from the model file's in more than one way, and its noise is not only that of its sensor."""

NOTICEABLE = 1.05
"""Mean square residual, in units of a reading's noise, from which on a misfit is counted, if it is not by chance."""

BY_CHANCE = 3.0
"""Standard deviations of a mean square that pass as chance."""

KEPT, VISIBLE = 0.25, 0.005
"""Share of a channel's own misfit that may stay, and what it must amount to, relative to the channel's spread."""


@dataclass(frozen=True)
class UnknownEffect:
    """Something that the catalogue does not explain: its likeliest shape, and whether it is the largest finding."""

    shape: Shape
    first: bool

    def document(self) -> dict[str, object]:
        """Place and curves, for `diagnosis.json`."""
        return {"place": self.shape.place,
                "curves": [{"variable": c.variable, "unit": c.unit, "at": c.knot.tolist(), "value": c.value.tolist()}
                           for c in self.shape.curves]}


def found(chains: Chains, findings: Mapping[str, Findings], torque: bool, spikes: bool) -> UnknownEffect | None:
    """Whether a part of the chain keeps more of its misfit than another form of a known effect would leave.

    What was found there is then taken back: it only stands in for what is not known.
    """
    def misfits(f: Fit) -> dict[str, Misfit]:
        return {c: _misfit(chains, c, r) for c, r in f.residuals.items()
                # false captures that were not found out, and chance, are no misfit of the model
                if not (spikes and c.startswith("omega")) and not (torque and c.startswith("theta"))}

    known = {b: [u for u in nominal_unknowns(chains, b) if u.name in f.base.values] for b, f in findings.items()}
    base = {b: misfits(f.base) for b, f in findings.items()}
    # what numbers that strayed absorb is no misfit of the base, yet an effect explains it
    held = {b: misfits(not_strayed(chains, b, f.base, known[b])) for b, f in findings.items()}
    left = {b: misfits(f.final) for b, f in findings.items()}
    amount = {b: sum(m.amount for m in left[b].values()) for b in findings}
    captures = speed_spikes.gap(chains) if spikes else 0.0

    def share(b: str, of: Mapping[str, Mapping[str, Misfit]]) -> float:
        total = sum(m.amount for each in of.values() for m in each.values()) + captures
        return amount[b] / total if total > 0.0 else 0.0

    form, form_elsewhere, form_of_several, own = FORM, FORM_ELSEWHERE, FORM_OF_SEVERAL, KEPT
    if chains.fit_nominal:
        swinging = free_swinging(chains.recordings)
        form, form_elsewhere, form_of_several, own = FORMS_SWINGING if swinging else FORMS_UNKNOWN
    shaped: dict[str, Shape] = {}
    for b, f in findings.items():
        if not any(m.amount > 0.0 for m in base[b].values()):
            continue
        shape = shapes(chains, b, f.base, known[b])[0]
        elsewhere = bool(f.found) and shape.place not in {h.place for h in f.effects}
        # several of one place may be one effect of another form; a number has no form
        several = len({h.place for h in f.effects}) > 1 or any(h.number for h in f.effects)
        simpler = several and shape.left < f.final.mean_square
        kept = share(b, base)
        if (share(b, held) > form or (kept > form_elsewhere and elsewhere) or (kept > form_of_several and simpler)
                or any(m.remains(held[b][c], own) for c, m in left[b].items())):
            shaped[b] = shape
    if not shaped:
        return None
    worst = max(shaped, key=lambda b: amount[b])
    if worst == "motor":
        f = findings[worst]
        place = shapes(chains, worst, f.base, known[worst], any_time=True)[0].place
        shaped[worst] = next(s for s in shapes(chains, worst, f.base, known[worst]) if s.place == place)
    explained = max((sum(m.amount for m in base[b].values()) - amount[b] for b in findings
                     if b not in shaped and findings[b].found), default=0.0)
    explained = max(explained, captures)
    for b in shaped:
        findings[b].found.clear()
        findings[b].rivals.clear()
        findings[b].final = findings[b].base
    return UnknownEffect(shaped[worst], sum(m.amount for m in base[worst].values()) > explained)


@dataclass(frozen=True)
class Misfit:
    """What a fit leaves in a channel: mean square in units of a reading's noise; that; and the channel's spread.

    `count` readings were fitted; up to `unseen` the mean square passes as noise.
    """

    square: float
    noise: float
    spread: float
    count: int
    unseen: float = NOTICEABLE

    @property
    def amount(self) -> float:
        """Squared gap above the noise, in units of the spread squared; 0 if it passes as noise."""
        shows = max(self.square - 1.0, 0.0) * (self.noise / self.spread) ** 2
        return shows if self.square > self.unseen + BY_CHANCE * math.sqrt(2.0 / self.count) else 0.0

    def remains(self, base: Misfit, kept: float = KEPT) -> bool:
        """Whether too much of a channel's own misfit is left, of a size that matters."""
        return (self.square > GOOD_ENOUGH**2 and self.square - 1.0 > kept * (base.square - 1.0)
                and math.sqrt(self.square) * self.noise > VISIBLE * self.spread)


def _misfit(chains: Chains, channel: str, r: Array) -> Misfit:
    name, k = of_recording(channel)
    s = chains.each[k].signals
    noise = s.sigma[name]
    if name == "omega" and s.pulses:
        noise = float(np.sqrt(np.mean(s.pulses.sigma[s.pulses.index < s.train] ** 2)))
    unseen = GOOD_ENOUGH**2 if chains.fit_nominal else NOTICEABLE  # the noise too is only what the recording shows
    return Misfit(float(np.mean(r * r)), noise, max(float(np.nanstd(s.channel(name)[:s.train])), noise), len(r), unseen)
