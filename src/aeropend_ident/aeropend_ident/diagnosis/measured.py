# SPDX-License-Identifier: Apache-2.0
"""What was found, fitted jointly, with the gap that it leaves and the parts of that gap."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis import gap_share, regions
from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.values import PLACE_OF_PARAMETER, neutral
from aeropend_ident.diagnosis.document import GapBudget, Interval
from aeropend_ident.diagnosis.free_run_gap import Gap, HeldOut
from aeropend_ident.diagnosis.gap_budget import Repeats, budget
from aeropend_ident.diagnosis.gap_share import Part
from aeropend_ident.diagnosis.joint_fit import JointFit, fit_jointly
from aeropend_ident.diagnosis.policy import MATERIAL_SHARE, angle_only
from aeropend_ident.diagnosis.search.findings import Findings, RankedHypothesis
from aeropend_ident.diagnosis.search.free_curves import Repeatable
from aeropend_ident.diagnosis.search.learned_term import Learned
from aeropend_ident.diagnosis.search.onset import Onset
from aeropend_ident.diagnosis.search.search import refit
from aeropend_ident.diagnosis.search.unknown_effect import ONE_TERM, UnknownEffect
from aeropend_ident.estimation.parameter import key
from aeropend_ident.signals.signals import Signals

Array = NDArray[np.float64]

Progress = Callable[[str, float], None]
"""Called with the present step and the share (0 to 1) of the work that is done."""


@dataclass(frozen=True)
class Statistical:
    """Effects that were detected by their statistics, not fitted.

    Attributes:
        gust: a random torque on the arm.
        spikes: false captures of the speed.
    """

    gust: RankedHypothesis | None
    spikes: RankedHypothesis | None

    @property
    def found(self) -> list[RankedHypothesis]:
        """Those that were detected."""
        return [e for e in (self.gust, self.spikes) if e is not None]


@dataclass(frozen=True)
class Settings:
    """What a person may set.

    Attributes:
        jobs: processes.
        material: share of the gap from which an effect is claimed.
        deadline: [s] of `time.monotonic` after which nothing more is looked for; None: a budget of simulations bounds
            the search where it may be long.
    """

    jobs: int = 1
    material: float = MATERIAL_SHARE
    deadline: float | None = None


@dataclass(frozen=True)
class Found:
    """What the search and the detectors found.

    Attributes:
        chains: cut, with the inputs that the search has set.
        stages: stage -> what was found.
        statistical: effects that were detected by their statistics.
        unknown: an effect that the catalogue does not hold.
        misfit: of the nominal structure where it fits worst.
        recordings: with the notes of the search.
        failed: why the nominal model could not be identified; "" if it was.
        onset: when the effects begin or end; None: they act all the time.
        learned: the term that is learned in place of the unknown effect.
    """

    chains: CutChains
    stages: Mapping[str, Findings]
    statistical: Statistical
    unknown: UnknownEffect | None
    misfit: regions.Misfit
    recordings: Sequence[Signals]
    failed: str = ""
    onset: Onset | None = None
    learned: Learned | None = None


@dataclass(frozen=True)
class Gaps:
    """The gap before and after, with everything that measures it.

    Attributes:
        held_out: measures gaps.
        base: values of the nominal model by name, with the initial states.
        runs_before: free runs of the nominal model, one a recording.
        runs_after: the same of the augmented model.
        before: gap of the nominal model.
        after: gap of the augmented model.
        floors: channel -> floor.
        repeats: how much of the rest of each stage repeats.
    """

    held_out: HeldOut
    base: Mapping[str, float]
    runs_before: Sequence[Mapping[str, Array]]
    runs_after: Sequence[Mapping[str, Array]]
    before: Gap
    after: Gap
    floors: Mapping[str, float]
    repeats: Repeats

    @cached_property
    def fitted(self) -> Gap:
        """The gap of the augmented model on the fitted parts."""
        return self.held_out.fitted().gap(self.runs_after)

    def fits(self, channel: str) -> tuple[float, float]:
        """Fit of the augmented model's free run, on the fitted parts and on the held-out ones."""
        there, here = self.fitted, self.after
        return 1.0 - there.rms[channel] / there.spread[channel], 1.0 - here.rms[channel] / here.spread[channel]

    def budget(self, *, gust: bool, jobs: int) -> GapBudget | None:
        """What could be closed of the gap, measured where the arm moves."""
        moving = self.held_out.in_motion()
        return budget(moving.gap(self.runs_before), moving.gap(self.runs_after), self.floors, self.repeats, gust=gust,
                      jobs=jobs)


class Measured(NamedTuple):
    """Findings, fitted jointly, with the gap that they leave and its parts."""

    found: Found
    joint: JointFit
    gaps: Gaps
    parts: list[Part]

    @property
    def open_(self) -> float:
        """The squared gap that effects close, or leave and could be closed."""
        return sum(max(p.amount, 0.0) for p in self.parts)

    @property
    def excess(self) -> float:
        """What is left of the squared gap above the floor."""
        after = self.gaps.after
        return max(gap_share.squared(after) - after.total_floor(self.gaps.floors)**2, 0.0)

    def closes_more(self, other: Measured, material: float) -> bool:
        """Whether this leaves less than other findings, by a material share of what is open."""
        less = gap_share.squared(other.gaps.after) - gap_share.squared(self.gaps.after)
        return less > material * other.open_ and not self.gaps.after.diverges

    def shows_approximation(self, known: Measured, material: float) -> bool:
        """Whether this, with one unknown term, leaves so little that known effects only approximate that term."""
        return self.closes_more(known, material) and known.excess > ONE_TERM * self.excess


def fit_and_measure(fitted: CutChains, found: Found, progress: Progress) -> tuple[Found, JointFit, Gaps]:
    """Fit all that was found jointly, and measure the gap before and after; the findings are those still claimed."""
    progress("fitting all jointly", 0.75)
    joint = fit_jointly(found.chains, found.stages, gust=found.statistical.gust is not None)
    found = replace(found, stages=joint.findings)
    progress("measuring the gap", 0.9)
    return found, joint, _measure(fitted, found, joint)


def measured(fitted: CutChains, found: Found, settings: Settings, progress: Progress) -> Measured:
    """As `fit_and_measure`, with the parts of the gap."""
    found, joint, gaps = fit_and_measure(fitted, found, progress)
    return Measured(found, joint, gaps, parts_of(found, joint, gaps, settings))


def _measure(fitted: CutChains, found: Found, joint: JointFit) -> Gaps:
    """The gap on held-out data before and after."""
    chains, model = found.chains, found.chains.model
    # the identified parameters of an uncalibrated rig, and unknown ones of a variant, are its nominal model
    unknown = {n for s in chains.recordings for n in s.variant.unknown}
    base = {n: v for f in found.stages.values() for n, v in f.base.values.items()
            if key(n).is_initial or not chains.policy.calibrated or key(n).plain in unknown}
    values: Mapping[str, float] = joint.values
    if not chains.policy.driven:  # what was selected on the whole decay is fitted again to its training part
        base = refit(fitted, "arm", [], base).values
        values = refit(fitted, "arm", found.stages["arm"].effects, values).values
    elif chains.policy.wide_search and angle_only(chains.recordings):  # a search counts slow misfits for more
        base = refit(chains, "arm", [], base).values
    held_out = HeldOut(chains, model, found.recordings, spikes=found.statistical.spikes is not None)
    before, after = held_out.runs(base), held_out.runs(values)
    return Gaps(held_out, base, before, after, held_out.gap(before, known=False), held_out.gap(after),
                 held_out.floors(), Repeats(chains, values))


def parts_of(found: Found, joint: JointFit, gaps: Gaps, settings: Settings) -> list[Part]:
    """The parts of the gap: of each effect, and of what stays unexplained."""
    statistical, parts = found.statistical, _parts_with_learned(found, joint, gaps, settings)
    if (learned := found.learned) is not None:  # what it closes, and what it leaves, is of the unknown effect
        its = [p for p in parts if p.name in (learned.id, gap_share.UNKNOWN)]
        one = Part(gap_share.UNKNOWN, learned.place, sum(max(p.amount, 0.0) for p in its),
                   np.sum([p.windows for p in its], axis=0))
        parts = [*(p for p in parts if all(p is not q for q in its)), one]
    if statistical.spikes is not None:  # they are few: the held-out part may hold none
        whole = gaps.held_out.everywhere()
        parts.append(gap_share.part_of_spikes(statistical.spikes, whole.gap(gaps.runs_before, known=False),
                                              whole.gap(gaps.runs_before)))
    return parts


def share_of_learned(now: Measured, learned: Learned, settings: Settings) -> Interval | None:
    """The share of the gap that a learned term closes."""
    return gap_share.shares(_parts_with_learned(now.found, now.joint, now.gaps, settings)).get(learned.id)


def _parts_with_learned(found: Found, joint: JointFit, gaps: Gaps, settings: Settings) -> list[Part]:
    """The same with a learned term like another effect, and without false captures."""
    held_out, unknown = gaps.held_out.in_motion(), None
    # a learned term follows what it was fitted to
    judged = held_out if found.learned is not None else gaps.held_out.for_shares()
    parts = gap_share.parts_of_effects(joint, judged, judged.gap(gaps.runs_before), settings.material, settings.jobs)
    if found.unknown is not None:
        # of a calibrated rig the noise is known: what exceeds it is missing in the model, though it may not repeat
        share = 1.0 if found.chains.policy.calibrated else gaps.repeats.of_stage(found.unknown.stage).share
        unknown = Repeatable(found.unknown.term.place, share)
    after = held_out.gap(gaps.runs_after)
    return parts + gap_share.unexplained(after, gaps.floors, found.statistical.gust, unknown)


def parts_of_parameters(joint: JointFit, gaps: Gaps) -> list[Part]:
    """The part of each place in the gap that nominal parameters leave."""
    held_out = gaps.held_out
    parts = []
    for place in dict.fromkeys(PLACE_OF_PARAMETER.values()):
        back = {n: neutral(held_out.model, n) for n in joint.values if PLACE_OF_PARAMETER.get(n) == place}
        parts.append(Part("", place, held_out.gap_of({**joint.values, **back}).total ** 2 - gaps.after.total**2,
                          np.zeros(0)))
    return parts
