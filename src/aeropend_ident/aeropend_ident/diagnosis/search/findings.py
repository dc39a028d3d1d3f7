# SPDX-License-Identifier: Apache-2.0
"""What the search found in each stage of the chain. Nothing here is changed in place."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

from aeropend_ident.diagnosis.search.hypotheses import Hypothesis
from aeropend_ident.estimation.map_fit import Fit
from aeropend_ident.estimation.parallel import parallel
from aeropend_ident.estimation.parameter import Parameter


@dataclass(frozen=True)
class RankedHypothesis:
    """A hypothesis after its fit.

    Attributes:
        hypothesis: what was fitted.
        fit: of the hypothesis on top of what was found before.
        gain: log evidence over no further effect, prior odds included.
        probability: among the hypotheses of its selection round; of all forms of its effect.
        others: the other forms of its effect that were fitted, each with its probability among all of them.
    """

    hypothesis: Hypothesis
    fit: Fit
    gain: float
    probability: float
    others: tuple[RankedHypothesis, ...] = ()

    @property
    def forms(self) -> dict[str, float]:
        """Form of its effect -> probability among them, the best first; empty if only one was fitted."""
        first = {self.hypothesis.effect: 1.0 - sum(r.probability for r in self.others)}
        return {**first, **{r.hypothesis.effect: r.probability for r in self.others}} if self.others else {}


@dataclass(frozen=True)
class LikelySet:
    """A set of effects of a stage: their ids or names, and its probability among sets that differ by one effect."""

    effects: tuple[str, ...]
    probability: float


Selection = tuple[RankedHypothesis, ...]
"""The hypotheses of one selection round, the best first."""


@dataclass(frozen=True)
class Findings:
    """What was found in one stage of the chain.

    Attributes:
        stage: its name.
        base: the fit with the nominal structure.
        final: the fit with all that was found.
        found: a selection for each effect found, in the order found; its first entry is the effect.
        rivals: the selection in which nothing was found.
        cut_short: the search was ended by its budget.
        sets: the sets of effects that are likely, the best first; empty if sets were not compared.
    """

    stage: str
    base: Fit
    final: Fit
    found: tuple[Selection, ...] = ()
    rivals: Selection = ()
    cut_short: bool = False
    sets: tuple[LikelySet, ...] = ()

    @property
    def effects(self) -> list[Hypothesis]:
        """The hypotheses found."""
        return [selection[0].hypothesis for selection in self.found]

    @property
    def selections(self) -> list[Selection]:
        """All selections, that in which nothing was found last."""
        return [*self.found, self.rivals]

    def without(self, selection: Selection, final: Fit | None = None) -> Findings:
        """The findings without one of the effects; the last one stays as what was tried.

        Args:
            selection: of the effect.
            final: the fit of the others.
        """
        found = tuple(s for s in self.found if s is not selection)
        return replace(self, found=found, rivals=self.rivals or (() if found else _ruled_out(selection)),
                       final=final or self.final, sets=())

    def nothing(self) -> Findings:
        """The findings with all effects taken back; those of the first round stay as what was tried."""
        tried = _ruled_out(self.found[0] if self.found else self.rivals)
        return replace(self, found=(), rivals=tried, final=self.base, sets=())


def _ruled_out(selection: Selection) -> Selection:
    return tuple(replace(r, probability=0.0) for r in selection)


def adopted(known: list[Parameter], hypothesis: Hypothesis, start: int = 0) -> list[Parameter]:
    """The known parameters with those of a hypothesis; where both name one, the hypothesis' counts."""
    own = hypothesis.starts[start]
    return [*(p for p in known if p.name not in {o.name for o in own}), *own]


def drop_unneeded(findings: Findings, without: Callable[[Findings, Selection], Findings],
                  lost: Callable[[Findings, Findings], float], least: int = 0, jobs: int = 1) -> Findings:
    """Take out effects that are not needed beside the others, the least needed first (backward elimination).

    Args:
        findings: of a stage.
        without: the findings without one effect, the others fitted again.
        lost: log evidence that these have less, without prior odds.
        least: number of effects that stay in any case.
        jobs: processes.
    """
    while len(findings.found) > least:
        odds = sum(h.log_odds for h in findings.effects)
        fewer = parallel(jobs, partial(without, findings), findings.found)
        needed = [lost(findings, f) + odds - sum(h.log_odds for h in f.effects) for f in fewer]
        k = needed.index(min(needed))
        if needed[k] > 0.0:
            break
        findings = fewer[k]
    return findings


def places(findings: Mapping[str, Findings]) -> list[str]:
    """The places of all effects found."""
    return [h.place for f in findings.values() for h in f.effects]
