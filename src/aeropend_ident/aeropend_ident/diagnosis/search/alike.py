# SPDX-License-Identifier: Apache-2.0
"""Effects that close as much of the gap: significance does not decide between them where neither explains all."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.values import CHANNELS_OF
from aeropend_ident.diagnosis.policy import CALIBRATED, MATERIAL_SHARE
from aeropend_ident.diagnosis.search.findings import Findings, RankedHypothesis
from aeropend_ident.diagnosis.search.search import refit
from aeropend_ident.diagnosis.search.selection import FORM_SHOWS, mean_square, squared_gap
from aeropend_ident.estimation.map_fit import Fit


class _Rival(NamedTuple):
    """A rival in the place of an effect found: its fit, and what that leaves of the gap beyond the effect's."""

    ranked: RankedHypothesis
    fit: Fit
    more: float


def closing_as_much(chains: CutChains, findings: Findings, before: Fit, first: RankedHypothesis,
                    rivals: Sequence[RankedHypothesis]) -> set[str]:
    """Names of the rivals of an effect found that close as much of the gap, while neither explains all.

    What both leave may then decide between them, if it is more than that by which they differ.

    Args:
        chains: cut.
        findings: of the stage.
        before: the fit before the effect was found.
        first: the effect.
        rivals: of the same selection.
    """
    if mean_square(first.fit, findings.stage) < FORM_SHOWS:
        return set()
    least, alike = _alike(chains, findings, before, first, rivals)
    return {r.ranked.hypothesis.name for r in alike if r.more < least}


def _alike(chains: CutChains, findings: Findings, before: Fit, first: RankedHypothesis,
           rivals: Sequence[RankedHypothesis]) -> tuple[float, list[_Rival]]:
    """What an effect leaves of the gap, and the rivals that close as much but for less than a material share.

    A parameter that is off only stands in for an effect. Of several effects of a stage, each rival is fitted beside
    the others.
    """
    stage, best = findings.stage, first.fit
    rivals = [r for r in rivals if not r.hypothesis.parameter]
    fits = [r.fit for r in rivals]
    if len(findings.effects) > 1:
        beside = [h for h in findings.effects if h is not first.hypothesis]
        rivals = [r for r in rivals if r.gain > 0.0 and r.hypothesis.family not in {h.family for h in beside}]
        best, now = findings.final, findings.final.values
        fits = [refit(chains, stage, [*beside, r.hypothesis],
                      {**now, **{p.name: r.fit.values[p.name] for p in r.hypothesis.own}}) for r in rivals]
        before = refit(chains, stage, beside, now) if rivals else before
    open_, least, *left = (squared_gap(chains, f, CHANNELS_OF[stage]) for f in (before, best, *fits))
    found = [_Rival(r, f, x - least) for r, f, x in zip(rivals, fits, left, strict=True)]
    return least, [r for r in found if r.more < MATERIAL_SHARE * (open_ - least)]


def with_simpler(chains: CutChains, findings: Findings, imperfect: Collection[str] = ()) -> Findings:
    """The findings of a stage with the simplest of the effects that close as much, each in the place of the one found.

    An effect with more parameters takes up some of what neither explains. So one with fewer comes first if the evidence
    does not decide against it, or if what both leave is more than that by which they differ. The two are then said to
    be as probable as each other.

    Args:
        chains: cut.
        findings: of the stage.
        imperfect: names of effects for which the evidence does not count: there are small imperfections beside them,
            and their further parameters describe some of those.
    """
    if not chains.policy.calibrated or chains.known is not None:
        return findings
    before = findings.base
    for selection in findings.found:
        first, *rest = selection
        no_evidence = first.hypothesis.name in imperfect
        shows = no_evidence or mean_square(first.fit, findings.stage) >= FORM_SHOWS
        simpler = [r for r in rest if len(r.hypothesis.own) < len(first.hypothesis.own)
                   and (shows or r.probability > CALIBRATED.undecided)]
        least, alike = _alike(chains, findings, before, first, simpler)
        alike = [r for r in alike
                 if no_evidence or r.ranked.probability > CALIBRATED.undecided or r.more < least]
        before = first.fit
        if alike:
            best = min(alike, key=lambda r: len(r.ranked.hypothesis.own))
            even = 0.5 * (first.probability + best.ranked.probability)
            swapped = (replace(best.ranked, probability=even), replace(first, probability=even),
                       *(r for r in rest if r is not best.ranked))
            findings = replace(findings, final=best.fit, sets=(), found=tuple(
                swapped if s is selection else s for s in findings.found))
            if set(best.fit.residuals) != set(findings.base.residuals):  # it was fitted to later stages too
                findings = replace(findings, final=refit(chains, findings.stage, findings.effects, best.fit.values))
    return findings
