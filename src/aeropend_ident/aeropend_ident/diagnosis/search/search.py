# SPDX-License-Identifier: Apache-2.0
"""Which effects: part by part, round by round, until what is left passes as noise or nothing explains it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import expit

from aeropend_ident.diagnosis.chain.cached_chain import ThriftyChains
from aeropend_ident.diagnosis.chain.chain import BLOCKS, Chains
from aeropend_ident.diagnosis.chain.priors import NUMBER_SD, free_swinging, nominal_unknowns
from aeropend_ident.diagnosis.search.free_curves import shapes
from aeropend_ident.diagnosis.search.hypotheses import Hypothesis, blocks_of, hypotheses, log_odds
from aeropend_ident.diagnosis.search.selection import (
    CONTENDERS,
    FIRST_LOOK,
    ROUNDS,
    Round,
    Weighed,
    adopted,
    against,
    counts_of,
    started,
)
from aeropend_ident.estimation.map_fit import Fit, Unknown, fit

MATERIAL = 0.3
"""What an effect must explain in one channel at least, RMS in units of a reading's noise, to be worth a word."""

UNSURE = 0.75
"""As `MATERIAL`, of a rig whose noise is only what the recording shows: it may be a seventh larger."""

FOLLOWS = 0.01
"""Share of a mean square that free curves over inputs and states must explain, beyond chance, to be no noise."""

STRAYED = 3.0
"""Standard deviations by which a number must leave its prior to count as strayed."""

MOST_RUNS = 3500
"""Simulations of an unknown rig after which no further effect is looked for, and no fit is taken to the end."""

MOST_EFFECTS = 3
"""How many effects are looked for in one part of the chain."""


@dataclass
class Findings:
    """What was found in one part of the chain.

    Attributes:
        block: name of the part.
        base: the fit with the nominal structure. final: the fit with all that was found.
        found: the effects, in the order found, each with its rivals of that round (itself first).
        cut_short: the search was ended by what it may cost, not by what it found.
    """

    block: str
    base: Fit
    final: Fit
    found: list[list[Weighed]] = field(default_factory=list)
    rivals: list[Weighed] = field(default_factory=list)
    cut_short: bool = False

    @property
    def effects(self) -> list[Hypothesis]:
        """The hypotheses found."""
        return [round_[0].hypothesis for round_ in self.found]


def search(chains: Chains, jobs: int = 1, progress: Callable[[str, float], None] = lambda *_: None
           ) -> dict[str, Findings]:
    """Look for effects part by part, in the direction of the chain; each part is fed as the one before was explained.

    Args:
        chains: the cut chains; their inner signals are renewed.
        jobs: threads. progress: told the part and the share of parts behind.

    Returns:
        Block -> what was found.
    """
    findings: dict[str, Findings] = {}
    everything = hypotheses(chains.model, numbers=not chains.fit_nominal)
    where = {h.name: blocks_of(chains, h) for h in everything}
    carried: dict[str, Unknown] = {}
    with ThreadPoolExecutor(jobs) as pool:
        for done, block in enumerate(BLOCKS):
            progress(block, done / len(BLOCKS))
            mine = [h for h in everything if where[h.name][:1] == (block,)]
            f = _search_block(chains, block, mine, where, list(carried.values()), pool)
            findings[block] = f
            # what was found here and shows further down goes along, as sure as it is
            for h in f.effects:
                if len(where[h.name]) > 1:
                    for u in h.starts[0]:
                        carried[u.name] = Unknown(u.name, f.final.values[u.name], max(f.final.sd[u.name], 1e-12),
                                                  u.low, u.high)
            chains.feed_next(block, f.final.values)
    return findings


def _search_block(chains: Chains, block: str, candidates: list[Hypothesis], where: Mapping[str, tuple[str, ...]],
                  carried: list[Unknown], pool: ThreadPoolExecutor) -> Findings:
    known: list[Unknown] = [*nominal_unknowns(chains, block), *carried]
    base = fit(chains.residuals(block), known)
    findings = Findings(block, base, base)
    if not base.residuals:
        return findings
    candidates = [_started_late(chains, h, base.values) if h.effect == "command_delay" else h for h in candidates]
    downstream = {}
    for other in {b for h in candidates for b in where[h.name] if b != block}:
        downstream[other] = fit(chains.residuals(other), nominal_unknowns(chains, other))
    nominal = known
    # what brakes a free swing is told by the evidence alone: its noise is known but roughly, and its readings are few
    swinging = chains.fit_nominal and free_swinging(chains.recordings)
    thrifty = chains if isinstance(chains, ThriftyChains) and not swinging else None
    while len(findings.found) < MOST_EFFECTS:
        here = Round(chains, block, where, downstream, known, findings.final, pool)
        if not swinging and _explained(here):
            break
        if thrifty is not None and thrifty.runs > MOST_RUNS:
            findings.cut_short = True
            break
        open_ = [h for h in candidates if h.name not in {g.name for g in findings.effects}]
        tried, lead = here.first_look(open_), None
        if not tried:
            break
        if thrifty is not None:
            tried, lead = here.led(tried)
            findings.cut_short |= thrifty.runs > MOST_RUNS
        tried = here.to_the_end(tried, FIRST_LOOK if findings.cut_short else ROUNDS, but=lead)
        if not here.guessed and not any(_passes_as_noise(f, MATERIAL) for _, f in tried):
            tried = here.from_elsewhere(tried)
        if not findings.found:
            tried = here.identified_anew(open_, tried)
        rivals = here.weighed(tried)
        # the numbers that a rival was led to may serve as well without it
        again = fit(chains.residuals(block), started(known, rivals[0].fit.values))
        counts = counts_of([here.current, again])
        if again.evidence(counts) > here.current.evidence(counts) + 1.0:
            here, findings.final = replace(here, current=again), again
            findings.base = findings.base if findings.found else again
            rivals = here.weighed(tried)
        best = rivals[0]
        matters = best.hypothesis.number or _material(here.current, best.fit) or strayed(chains, block, here.current)
        if swinging and findings.found:  # what leaves a narrow band seems to leave many independent samples
            sure = [float(expit(against(here.current, w.fit) + log_odds(w.hypothesis))) for w in rivals]
            rivals = [replace(w, probability=min(w.probability, p)) for w, p in zip(rivals, sure, strict=True)]
        if sum(w.probability for w in rivals) < 0.5 or not matters:
            findings.rivals = rivals
            break
        findings.found.append(rivals)
        known = adopted(known, best.hypothesis)
        findings.final = best.fit if set(best.fit.residuals) == set(base.residuals) else fit(
            chains.residuals(block), started(known, best.fit.values))
    _swap(chains, findings, nominal)
    _prune(chains, findings, nominal)
    return findings


def _beside(findings: Findings, nominal: list[Unknown], hypothesis: Hypothesis) -> list[Unknown]:
    """The unknowns of all that was found but one."""
    known = nominal
    for h in findings.effects:
        if h is not hypothesis:
            known = adopted(known, h)
    return known


def _swap(chains: Chains, findings: Findings, nominal: list[Unknown]) -> None:
    """Replace what was found first, and only stood in for what was not yet known of the others, by a close rival."""
    if len(findings.found) < 2:
        return
    for k, round_ in enumerate(findings.found):
        known = _beside(findings, nominal, round_[0].hypothesis)
        taken = {h.name for h in findings.effects}
        for rival in round_[1:CONTENDERS]:
            if rival.gain <= 0.0 or rival.hypothesis.name in taken:
                continue
            begun = {**findings.final.values, **{u.name: rival.fit.values[u.name] for u in rival.hypothesis.starts[0]}}
            f = fit(chains.residuals(findings.block), started(adopted(known, rival.hypothesis), begun))
            counts = counts_of([findings.final, f])
            odds = log_odds(rival.hypothesis) - log_odds(findings.found[k][0].hypothesis)
            gain = f.evidence(counts) - findings.final.evidence(counts) + odds
            if gain > 0.0:
                sure = float(expit(gain))
                others = [replace(w, probability=1.0 - sure if w is round_[0] else 0.0) for w in round_
                          if w is not rival]
                findings.found[k] = [replace(rival, fit=f, gain=rival.gain + gain, probability=sure), *others]
                findings.final = f
                break


def _started_late(chains: Chains, hypothesis: Hypothesis, values: Mapping[str, float]) -> Hypothesis:
    """The delay where the voltage places it: a reading changes with the delay in jumps, which no slope leads over."""
    own = hypothesis.starts[0][0]
    if not chains.each[0].signals.has("v_a"):
        return hypothesis
    start = chains.each[0].likeliest_delay(chains.own(values, 0))
    return replace(hypothesis, starts=((replace(own, mean=start, start=start),),))


def _prune(chains: Chains, findings: Findings, nominal: list[Unknown]) -> None:
    """Take out again what was found first and is not needed beside what was found later."""
    def without(h: Hypothesis) -> Fit:
        known = _beside(findings, nominal, h)
        return fit(chains.residuals(findings.block), started(known, findings.final.values))

    def lost(f: Fit) -> float:
        counts = counts_of([findings.final, f])
        return findings.final.evidence(counts) - f.evidence(counts)

    drop_unneeded(findings, without, lost, least=1)


def drop_unneeded(findings: Findings, without: Callable[[Hypothesis], Fit], lost: Callable[[Fit], float], least: int = 0
                  ) -> None:
    """Take out what was found and is not needed, the least needed first.

    Args:
        findings: changed in place. without: fits what was found without one. lost: log evidence that such a fit has
            less than `findings.final`. least: how many are kept in any case.
    """
    while len(findings.found) > least:
        tried = [(round_, without(round_[0].hypothesis)) for round_ in findings.found]
        needed = [lost(f) + log_odds(round_[0].hypothesis) for round_, f in tried]
        k = needed.index(min(needed))
        if needed[k] > 0.0:
            break
        round_, findings.final = tried[k]
        findings.found.remove(round_)


def refit(chains: Chains, block: str, effects: Sequence[Hypothesis], start: Mapping[str, float]) -> Fit:
    """A part of the chain with these effects, fitted anew from where its values were."""
    unknowns = [*nominal_unknowns(chains, block), *(u for h in effects for u in h.starts[0])]
    return fit(chains.residuals(block), started(unknowns, start))


def strayed(chains: Chains, block: str, f: Fit) -> bool:
    """Whether a number of the block had to go where its prior does not let it, to cover for something."""
    nominal = chains.model.model
    return not chains.fit_nominal and any(
        abs(f.values[n] - nominal[n]) > STRAYED * NUMBER_SD * abs(nominal[n]) for n in BLOCKS[block] if n in f.values)


def not_strayed(chains: Chains, block: str, f: Fit, known: Iterable[Unknown]) -> Fit:
    """A fit of the nominal structure, or, where numbers strayed, one that keeps them within their uncertainty."""
    if not strayed(chains, block, f):
        return f
    reach = {u.name: STRAYED * NUMBER_SD * abs(u.mean) for u in known if u.name in BLOCKS[block]}
    held = [replace(u, low=max(u.low, u.mean - reach[u.name]), high=min(u.high, u.mean + reach[u.name]))
            if u.name in reach else u for u in known]
    carried = {n: v for n, v in f.values.items() if n not in {u.name for u in held}}
    residuals = chains.residuals(block)
    return fit(lambda values: residuals({**carried, **values}), held)


def _explained(here: Round) -> bool:
    """Whether what is left passes as noise.

    Of an unknown rig it may be more than the recording shows of noise, if it follows neither inputs nor states.
    """
    if strayed(here.chains, here.block, here.current):
        return False
    if _passes_as_noise(here.current, MATERIAL) or not here.guessed:
        return _passes_as_noise(here.current, MATERIAL)
    if not _passes_as_noise(here.current, UNSURE):
        return False
    shape = shapes(here.chains, here.block, here.current, here.known)[0]
    return shape.explained <= FOLLOWS * shape.before


def _passes_as_noise(f: Fit, material: float) -> bool:
    """Whether so little is left that nothing could explain a material part of it."""
    return all(float(np.mean(r * r)) < 1.0 + 0.5 * material**2 for r in f.residuals.values())


def _material(before: Fit, after: Fit) -> bool:
    """Whether an effect explains enough of some channel to matter."""
    return any(float(np.mean(r * r)) - float(np.mean(after.residuals[k] ** 2)) > MATERIAL**2
               for k, r in before.residuals.items() if len(r))
