# SPDX-License-Identifier: Apache-2.0
"""Sets of effects of a stage, compared with each other.

An effect that was found first may stand in for two others. Around a fit the residual is linear in all parameters, and
nearly so in the size of each further effect. So the log evidence of any set of effects follows from small matrices
(`linear_sets`), and a hill climb over sets that differ by one effect costs less than one fit. The set where it ends is
fitted; the search goes on from there until no set is better.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.values import CHANNELS_OF, neutral
from aeropend_ident.diagnosis.policy import CALIBRATED
from aeropend_ident.diagnosis.search.findings import Findings, LikelySet, RankedHypothesis, Selection, adopted
from aeropend_ident.diagnosis.search.hypotheses import Hypothesis, from_linear, linear_parameters
from aeropend_ident.diagnosis.search.selection import ALIKE, CONTENDERS, ROUNDS, squared_gap
from aeropend_ident.estimation.bounded_fit import sensitivities
from aeropend_ident.estimation.linear_sets import LinearSets
from aeropend_ident.estimation.map_fit import Fit, fit, with_posterior_slopes
from aeropend_ident.estimation.parallel import parallel
from aeropend_ident.estimation.parameter import Parameter, prior_information, started
from aeropend_ident.estimation.residuals import finite
from aeropend_sim.model.effects import DEFINED

Array = NDArray[np.float64]

LARGEST_SET = 5
"""Effects of a stage at most (choice: two more than are searched one after another)."""

TRIES = 2
"""Sets in a row that are fitted and are not better, after which the search ends (choice: the linear model errs)."""

LEAST = 1.0
"""[nats] Log evidence by which a set must be better (choice: what the log evidence of a fit is good to)."""

PROMISING = 3.0
"""[nats] Log evidence by which a set may be predicted to be worse and still be fitted.

Choice: a linear model errs by as much."""

FIRST_ROUNDS = 2
"""Rounds of the first fit of a set; one that promises is fitted to its end (choice: it starts close to its end)."""

SWAPS = 3
"""Times that a rival may take the place of an effect (choice: it seldom happens twice)."""

CLOSEST = 2
"""Rivals of an effect that are fitted although the linear model calls them unlikely (choice)."""

IMITATES = 0.5
"""Share of the log evidence of an effect that such a rival must have (choice: less is no imitation)."""

SMALL = 0.01
"""Step, in standard deviations of the prior, of the derivatives of an effect that is linear in two parameters (choice).

A swing is linear in them only near the path on which it is."""


class Term(NamedTuple):
    """A parameter of the linear model.

    Attributes:
        parameter: with its prior.
        column: index of the derivative of the residual.
        now: its value where the model is linear.
    """

    parameter: Parameter
    column: int
    now: float


@dataclass(frozen=True)
class Member:
    """An effect as a member of a set.

    Attributes:
        hypothesis: the effect.
        terms: its parameters that are estimated, its size first.
        beside: values of its other parameters.
    """

    hypothesis: Hypothesis
    terms: tuple[Term, ...]
    beside: Mapping[str, float]


Set = tuple[Member, ...]


class Predicted(NamedTuple):
    """What the linear model says of a set.

    Attributes:
        log_evidence: prior odds included, up to a constant that all sets share; -inf if a size is out of its range.
        values: name -> estimate.
    """

    log_evidence: float
    values: dict[str, float]


class LinearStage:
    """The linear model of a stage around what was found in it.

    Args:
        chains: the cut chains.
        findings: what was found.
        nominal: parameters of the stage without effects.
        candidates: effects that may be members of a set.
    """

    def __init__(self, chains: CutChains, findings: Findings, nominal: Sequence[Parameter],
                 candidates: Sequence[Hypothesis]) -> None:
        self._chains, self.findings = chains, findings
        self._residuals = chains.residuals(findings.stage)
        values = findings.final.values
        self._now = self._at(values)
        self._columns: dict[str, list[Array]] = {k: [] for k in self._now}
        known = {p.name: replace(p, start=values[p.name])
                 for p in [*nominal, *(p for h in findings.effects for p in h.own)]}
        at = self._derivatives(list(known.values()))
        self.nominal = tuple(Term(p, at[p.name], values[p.name]) for p in nominal)
        self.found: Set = tuple(Member(h, tuple(Term(p, at[p.name], values[p.name]) for p in h.own), {})
                                for h in findings.effects)
        self._removed = {m.hypothesis.name: self._change(values, {**values, **self._off(m.hypothesis)})
                         for m in self.found if not m.hypothesis.parameter}
        self.options = tuple(self._options(findings, candidates, at))
        f = findings.final
        self._linear = LinearSets({k: np.vstack([*columns, self._now[k]]) for k, columns in self._columns.items()},
                                  {k: f.ess[k] / len(r) / f.scale[k] ** 2 for k, r in self._now.items()})

    def _at(self, values: Mapping[str, float]) -> dict[str, Array]:
        return {k: finite(np.asarray(r)) for k, r in self._residuals(dict(values)).items() if len(r)}

    def _add(self, column: Mapping[str, Array]) -> int:
        for k, columns in self._columns.items():
            columns.append(column[k])
        return len(next(iter(self._columns.values()))) - 1

    def _derivatives(self, parameters: Sequence[Parameter]) -> dict[str, int]:
        """Name -> index of the derivative with respect to the value of a parameter."""
        slopes = sensitivities(self._residuals, parameters)
        at = {}
        for j, p in enumerate(parameters):
            unit = p.slope(p.to_standard(p.begin))
            column = {k: np.zeros_like(r) for k, r in self._now.items()}
            for k, s in slopes.items():
                for row in s.rows[s.by == j]:
                    column[k] = row / unit
            at[p.name] = self._add(column)
        return at

    def _change(self, start: Mapping[str, float], end: Mapping[str, float], by: float = 1.0) -> int | None:
        """Index of the change of the residual between two points, over `by`; None if there is none."""
        before = self._now if start is end else self._at(start)
        after = self._at(end)
        column = {k: (after[k] - r) / by for k, r in before.items()}
        return self._add(column) if any(np.any(x) for x in column.values()) else None

    def _off(self, h: Hypothesis) -> dict[str, float]:
        return {p.name: neutral(self._chains.model, p.name) for p in h.own}

    def _options(self, findings: Findings, candidates: Sequence[Hypothesis], at: Mapping[str, int]
                 ) -> Iterator[Member]:
        """Each effect that was not found, with its form at each start of a search, and as it was fitted so far."""
        values = findings.final.values
        found = {h.name for h in findings.effects}
        of_family = {h.family: h for h in findings.effects}
        ranked = [x for selection in findings.selections for r in selection for x in (r, *r.others)]
        ways = [(h, {p.name: p.begin for p in start}) for h in candidates for start in h.starts]
        ways += [(r.hypothesis, {p.name: r.fit.values[p.name] for p in r.hypothesis.own}) for r in ranked]
        for h, own in ways:
            size = h.own[0]
            if h.name in found:
                continue
            if h.parameter:
                yield Member(h, tuple(Term(p, at[p.name], values[p.name]) for p in h.own if p.name in at), {})
                continue
            other = of_family.get(h.family)
            start = {**values, **self._off(other)} if other else values
            if DEFINED[h.effect].linear_in:
                yield from self._linear_option(h, start)
            elif own[size.name] != size.mean:
                column = self._change(start, {**start, **own}, own[size.name] - size.mean)
                if column is not None:
                    yield Member(h, (Term(size, column, size.mean),), own)

    def _linear_option(self, h: Hypothesis, start: Mapping[str, float]) -> Iterator[Member]:
        """An effect in the two parameters in which it is linear."""
        both = linear_parameters(h.effect)
        columns = []
        for p in both:
            step = {q.name: SMALL * q.sd if q is p else 0.0 for q in both}
            columns.append(self._change(start, from_linear(h.effect, {**start, **step}), SMALL * p.sd))
        if None not in columns:
            yield Member(h, tuple(Term(p, c, p.mean) for p, c in zip(both, columns, strict=True) if c is not None), {})

    def predicted(self, members: Set) -> Predicted:
        """What the linear model says of a set."""
        terms = {t.parameter.name: t for t in (*self.nominal, *(t for m in members for t in m.terms))}
        parameters = [t.parameter for t in terms.values()]
        z = np.array([p.to_standard(t.now) for p, t in zip(parameters, terms.values(), strict=True)])
        unit = np.array([p.slope(x) for p, x in zip(parameters, z, strict=True)])
        fixed = [column for name, column in self._removed.items()
                 if column is not None and all(m.hypothesis.name != name for m in members)]
        columns, prior = [t.column for t in terms.values()], prior_information(parameters)
        own, sizes = [p for m in members for p in m.hypothesis.own], [m.hypothesis.own[0] for m in members]
        found = {m.hypothesis.own[0].name for m in members if any(m is one for one in self.found)}
        held: dict[int, float] = {}
        while True:
            step, log_evidence = self._linear.solve(columns, unit, fixed, -z, prior, held)
            values = _values_of(members, {p.name: p.value(x) for p, x in zip(parameters, z + step, strict=True)})
            beyond = {p.name: p for p in sizes if not p.low <= values[p.name] <= p.high}
            new = [j for j, name in enumerate(terms) if name in beyond and j not in held]
            if not beyond.keys() <= found:
                return Predicted(-np.inf, {})
            if not new:
                break
            for j in new:  # a fit of what was found ends at the bound
                p = parameters[j]
                held[j] = p.to_standard(min(max(values[p.name], p.low), p.high)) - z[j]
        ends = {p.name: p for p in (*parameters, *own)}
        within = {n: min(max(v, ends[n].low), ends[n].high) for n, v in values.items()}
        return Predicted(log_evidence + sum(m.hypothesis.log_odds for m in members), within)

    def fitted(self, members: Set, values: Mapping[str, float], *, first_look: bool = False) -> Fit:
        """The fit of a set, or a first look at it; `values`: where it starts."""
        parameters = reduce(adopted, [m.hypothesis for m in members], [t.parameter for t in self.nominal])
        return fit(self._residuals, started(parameters, {**self.findings.final.values, **values}),
                   FIRST_ROUNDS if first_look else ROUNDS, first_look=first_look)

    def compared(self, members: Set, f: Fit) -> Fit:
        """The fit of a set with the information of its posterior, for a comparison of log evidences."""
        parameters = reduce(adopted, [m.hypothesis for m in members], [t.parameter for t in self.nominal])
        return with_posterior_slopes(self._residuals, parameters, f)

    def neighbours(self, members: Set) -> Iterator[Set]:
        """The sets with one effect less, one more, or one in place of another."""
        smaller = [tuple(m for m in members if m is not gone) for gone in members]
        yield from smaller
        for some in [*smaller, members] if len(members) < LARGEST_SET else smaller:
            families = {m.hypothesis.family for m in some}
            yield from ((*some, m) for m in (*self.options, *self.found)
                        if m.hypothesis.family not in families and all(m is not other for other in members))

    def most_promising(self, but: set[frozenset[str]]) -> tuple[Set, Predicted] | None:
        """The set where a hill climb from what was found ends, or else the best set beside it; None: none promises.

        Args:
            but: names of sets that are left out.
        """
        here, best = self.found, self.predicted(self.found)
        least = best.log_evidence - PROMISING
        while True:
            there = [(self.predicted(s), s) for s in self.neighbours(here) if names(s) not in but]
            top, members = max(there, key=lambda one: one[0].log_evidence, default=(best, here))
            if members is here or top.log_evidence <= least:
                return None if here is self.found else (here, best)
            here, best, least = members, top, top.log_evidence + LEAST


def _values_of(members: Set, values: dict[str, float]) -> dict[str, float]:
    """All values of a set, from those that the linear model estimates."""
    for m in members:
        if m.terms[0].parameter.name not in {p.name for p in m.hypothesis.own}:
            values = from_linear(m.hypothesis.effect, values)
        values = {**m.beside, **values}
    return values


def compared(chains: CutChains, findings: Findings, nominal: Sequence[Parameter], candidates: Sequence[Hypothesis],
             jobs: int) -> Findings:
    """The findings with each effect compared with its rivals beside the others, and the sets that are likely.

    The closest rivals are fitted: a lag of the thrust and one of the reading, say, differ by the square of their size,
    which no linear model sees. A rival that is better takes the place of the effect.

    Args:
        chains: the cut chains.
        findings: of a stage.
        nominal: parameters of the stage without effects.
        candidates: effects that may be members of a set.
        jobs: processes.
    """
    for left in reversed(range(SWAPS + 1)):
        linear = LinearStage(chains, findings, nominal, candidates)
        beside = [_beside(linear, m) for m in linear.found] if len(linear.found) > 1 else []
        swaps = _swaps(linear, beside, jobs)
        best = max(swaps, key=lambda s: s.gain, default=None)
        if best is None or best.gain <= LEAST or not left:
            break
        first = RankedHypothesis(best.member.hypothesis, best.fit, findings.found[best.place][0].gain + best.gain, 1.0)
        found = [(replace(s[0], fit=best.fit), *s[1:]) for s in findings.found]
        found[best.place] = (first, *findings.found[best.place])
        findings = replace(findings, final=best.fit, found=tuple(found))
    if beside:
        findings = replace(findings, found=tuple(_ranked(selection, b, [s for s in swaps if s.place == k])
                                                 for k, (selection, b) in enumerate(zip(findings.found, beside,
                                                                                        strict=True))))
    return replace(findings, sets=_likely_sets(linear, swaps))


class _Swap(NamedTuple):
    """A set with one effect in place of another, fitted.

    Attributes:
        place: number of the effect that is replaced.
        member: what stands in its place.
        gain: log evidence over that of what was found, prior odds included.
        fit: of the set.
    """

    place: int
    member: Member
    gain: float
    fit: Fit


class _Beside(NamedTuple):
    """What the linear model says of an effect and of its rivals beside the other effects.

    Attributes:
        loss: log evidence without the effect over that with it.
        rivals: of each family that is not in the set the best member, and what is predicted with it, the best first.
        gains: log evidence with each of these over that with the effect.
    """

    loss: float
    rivals: list[tuple[Member, Predicted]]
    gains: list[float]


def _beside(linear: LinearStage, mine: Member) -> _Beside:
    """What could stand in the place of an effect that was found."""
    others = tuple(m for m in linear.found if m is not mine)
    here = linear.predicted(linear.found).log_evidence
    taken = {m.hypothesis.family for m in linear.found}
    best: dict[str, tuple[Member, Predicted]] = {}
    for m in linear.options:
        there, family = linear.predicted((*others, m)), m.hypothesis.family
        if family not in taken and there.log_evidence > (best[family][1].log_evidence if family in best else -np.inf):
            best[family] = m, there
    rivals = sorted(best.values(), key=lambda r: -r[1].log_evidence)
    return _Beside(linear.predicted(others).log_evidence - here, rivals, [t.log_evidence - here for _, t in rivals])


def _swaps(linear: LinearStage, beside: Sequence[_Beside], jobs: int) -> list[_Swap]:
    """For each effect found its closest rivals, fitted beside the others."""
    begun = []
    for k, (mine, b) in enumerate(zip(linear.found, beside, strict=False)):
        for j, ((m, there), gain) in enumerate(zip(b.rivals, b.gains, strict=True)):
            close = gain - b.loss > -IMITATES * b.loss
            if (close and j < CLOSEST) or gain > math.log(CALIBRATED.undecided):
                begun.append((k, m, tuple(m if x is mine else x for x in linear.found), there.values))
    if not begun:
        return []

    def compared(one: tuple[Set, Mapping[str, float] | None]) -> Fit:
        members, start = one
        return linear.compared(members, linear.findings.final if start is None else linear.fitted(members, start))

    now, *fits = parallel(jobs, compared, [(linear.found, None), *((members, start) for _, _, members, start in begun)])
    findings = replace(linear.findings, final=now)
    return [_Swap(k, m, _gain(findings, [x.hypothesis for x in members], f), f)
            for (k, m, members, _), f in zip(begun, fits, strict=True)]


def _ranked(selection: Selection, beside: _Beside, swaps: Sequence[_Swap]) -> Selection:
    """The selection of an effect, with the probabilities that it and its rivals have beside the others.

    Args:
        selection: of the effect.
        beside: what the linear model says of it.
        swaps: its rivals that were fitted.
    """
    fitted = {s.member.hypothesis.family: s for s in swaps}
    gains = {m.hypothesis.family: gain for (m, _), gain in zip(beside.rivals, beside.gains, strict=True)}
    gains |= {family: s.gain for family, s in fitted.items()}
    weight = {family: float(np.exp(min(gain, 0.0))) for family, gain in gains.items()}
    total = 1.0 + sum(weight.values()) + float(np.exp(min(beside.loss, 0.0)))
    first = replace(selection[0], probability=1.0 / total)
    rivals = [RankedHypothesis(s.member.hypothesis, s.fit, first.gain + s.gain, weight[family] / total)
              for family, s in fitted.items()]
    rivals += [replace(r, probability=weight.get(r.hypothesis.family, 0.0) / total) for r in selection[1:]
               if r.hypothesis.family not in {*fitted, first.hypothesis.family}]
    return (first, *sorted(rivals, key=lambda r: -r.probability))


def _likely_sets(linear: LinearStage, swaps: Sequence[_Swap]) -> tuple[LikelySet, ...]:
    """The sets of effects that are likely: of what was found, and of sets that differ by one effect.

    Sets that differ in the form of an effect are one, with the form that is likeliest.
    """
    found: dict[frozenset[str], tuple[float, tuple[str, ...]]] = {}
    here = linear.predicted(linear.found).log_evidence
    fitted = [(here + s.gain, tuple(s.member.hypothesis.family if k == s.place else m.hypothesis.family
                                    for k, m in enumerate(linear.found))) for s in swaps]
    known = {frozenset(families) for _, families in fitted}
    for members in (linear.found, *linear.neighbours(linear.found)):
        families = tuple(m.hypothesis.family for m in members)
        if frozenset(families) not in known:
            fitted.append((linear.predicted(members).log_evidence, families))
    for there, families in fitted:
        if there > found.get(frozenset(families), (-np.inf,))[0]:
            found[frozenset(families)] = there, families
    probability = softmax([e for e, _ in found.values()])
    likely = [LikelySet(families, float(p)) for (_, families), p in zip(found.values(), probability, strict=True)
              if p > CALIBRATED.undecided]
    return tuple(sorted(likely, key=lambda s: -s.probability))


def names(members: Set) -> frozenset[str]:
    """The names of the effects of a set."""
    return frozenset(m.hypothesis.name for m in members)


def with_best_set(chains: CutChains, findings: Findings, nominal: Sequence[Parameter],
                  candidates: Sequence[Hypothesis], jobs: int, *, contenders: bool = True) -> Findings:
    """The findings of a stage with the set of effects that has most log evidence.

    The search starts from what was found, and from each contender of the first round alone that closes about as much: a
    lag of the thrust and one of the reading, say, are far from linear, and no small step leads from one to the other.

    Args:
        chains: the cut chains.
        findings: what was found so far.
        nominal: parameters of the stage without effects.
        candidates: effects that may be members of a set.
        jobs: processes.
        contenders: whether to start from each contender of the first round too.
    """
    found = {h.name for h in findings.effects}
    alone = [r for r in findings.selections[0][:CONTENDERS] if r.fit.residuals.keys() == findings.base.residuals.keys()
             and r.fit.values.keys() == {p.name for p in adopted(list(nominal), r.hypothesis)}]
    left = [squared_gap(chains, r.fit, CHANNELS_OF[findings.stage]) for r in alone]
    alone = [r for r, x in zip(alone, left, strict=True)
             if {r.hypothesis.name} != found and x <= ALIKE * min(left)]
    seen: set[frozenset[str]] = set()
    best = _climbed(chains, findings, nominal, candidates, seen)

    def climbed(r: RankedHypothesis) -> Findings:
        start = replace(findings, found=((r,),), final=r.fit)
        return _climbed(chains, start, nominal, candidates, {*seen}).findings

    lead = best.findings
    for there in parallel(jobs, climbed, alone if contenders else []):
        if _gain(lead, there.effects, there.final) > LEAST:
            lead = there
    if lead is findings:
        return findings
    if lead is not best.findings:
        best = LinearStage(chains, lead, nominal, candidates)
    return replace(best.findings, rivals=findings.rivals, found=tuple(
        s if m.hypothesis.name in found else _anew(best, m, findings)
        for m, s in zip(best.found, best.findings.found, strict=True)))


def _climbed(chains: CutChains, findings: Findings, nominal: Sequence[Parameter], candidates: Sequence[Hypothesis],
             seen: set[frozenset[str]]) -> LinearStage:
    """The stage with the best set that is reached; `seen`: names of the sets that were fitted, which it extends."""
    seen.add(frozenset(h.name for h in findings.effects))
    linear, failed = LinearStage(chains, findings, nominal, candidates), 0
    while failed < TRIES:
        best = linear.most_promising(seen)
        if best is None:
            break
        members, there = best
        seen.add(names(members))
        effects = [m.hypothesis for m in members]
        f = linear.fitted(members, there.values, first_look=True)
        if _gain(findings, effects, f) > -PROMISING:
            f = linear.fitted(members, f.values)
        if _gain(findings, effects, f) <= LEAST:
            failed += 1
            continue
        findings = replace(findings, final=f, found=tuple(_before(findings, m.hypothesis, f) for m in members))
        linear, failed = LinearStage(chains, findings, nominal, candidates), 0
    return linear


def _gain(findings: Findings, effects: Sequence[Hypothesis], f: Fit) -> float:
    """Log evidence of the fit of a set over that of what was found, prior odds included."""
    return (f.evidence_over(findings.final) + sum(h.log_odds for h in effects)
            - sum(h.log_odds for h in findings.effects))


def _before(findings: Findings, h: Hypothesis, f: Fit) -> Selection:
    """The selection in which an effect was found, with the fit of a new set; of a new effect, itself alone."""
    for selection in findings.found:
        if selection[0].hypothesis.name == h.name:
            return (replace(selection[0], fit=f), *selection[1:])
    return (RankedHypothesis(h, f, 0.0, 1.0),)


def _anew(linear: LinearStage, mine: Member, begun: Findings) -> Selection:
    """The selection of an effect that only the comparison of sets found; its rivals are not known yet (`compared`).

    Args:
        linear: the stage with the best set.
        mine: the effect.
        begun: the findings before the comparison.
    """
    none = linear.predicted(tuple(m for m in linear.found if m is not mine)).log_evidence
    ranked = {r.hypothesis.family: r for s in reversed(begun.selections) for r in reversed(s)}
    was = ranked.pop(mine.hypothesis.family, None)
    forms = [] if was is None else [x for x in (was, *was.others) if x.hypothesis.name != mine.hypothesis.name]
    first = RankedHypothesis(mine.hypothesis, linear.findings.final,
                             linear.predicted(linear.found).log_evidence - none, 1.0,
                             tuple(replace(x, others=(), probability=0.0) for x in forms))
    return (first, *(replace(r, probability=0.0) for r in ranked.values()))
