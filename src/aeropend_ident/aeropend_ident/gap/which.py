# SPDX-License-Identifier: Apache-2.0
"""Which effect: every hypothesis is fitted to the part of the cut chain that it changes, and weighed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from aeropend_ident.gap.chain import BLOCKS, PLACE_OF_NUMBER, Chains
from aeropend_ident.gap.fit import Fit, Unknown, fit, screen
from aeropend_sim.effects import CATALOGUE, PARAMETER_MISMATCH
from aeropend_sim.parameters import PARAMETERS, Model

NUMBER_SD = 0.05
"""Relative standard deviation of a nominal number, unless it is known better."""

GUESS_SD = 0.55
"""Standard deviation of the logarithm of a number that is only a guess: a factor of three either way is two of it."""

MISMATCH_SD = 0.3
"""As `NUMBER_SD`, for the number that `parameter_mismatch` blames."""

EFFECT_ODDS = 1.0 / 50.0
"""Prior odds of one given effect against none further; `parameter_mismatch` shares them among its numbers."""

MATERIAL = 0.3
"""What an effect must explain in one channel at least, RMS in units of a reading's noise, to be worth a word."""

SHORTLIST = 8
"""How many hypotheses are fitted in full after the screening."""

MOST_EFFECTS = 3
"""How many effects are looked for in one part of the chain."""


@dataclass(frozen=True)
class Hypothesis:
    """One effect of the catalogue, or one number that is off.

    Attributes:
        effect: id. number: the number blamed, for `parameter_mismatch`.
        starts: where searches begin, each the effect's own unknowns.
    """

    effect: str
    number: str = ""
    starts: tuple[tuple[Unknown, ...], ...] = ()

    @property
    def name(self) -> str:
        """A name that no other hypothesis has."""
        return f"{self.effect}:{self.number}" if self.number else self.effect

    @property
    def place(self) -> str:
        """Where in the chain it lives."""
        return PLACE_OF_NUMBER[self.number] if self.number else CATALOGUE[self.effect].place


@dataclass(frozen=True)
class Weighed:
    """A hypothesis after its fit: log evidence over the best without it, and probability in its round."""

    hypothesis: Hypothesis
    fit: Fit
    gain: float
    probability: float


@dataclass
class Findings:
    """What was found in one part of the chain.

    Attributes:
        block: name of the part.
        base: the fit with the nominal structure. final: the fit with all that was found.
        found: the effects, in the order found, each with its rivals of that round (itself first).
    """

    block: str
    base: Fit
    final: Fit
    found: list[list[Weighed]] = field(default_factory=list)
    rivals: list[Weighed] = field(default_factory=list)

    @property
    def effects(self) -> list[Hypothesis]:
        """The hypotheses found."""
        return [round_[0].hypothesis for round_ in self.found]


def number_unknowns(chains: Chains, block: str) -> list[Unknown]:
    """The numbers of a block with their priors; a number that is nominally 0 stays 0."""
    unknowns = []
    for name in BLOCKS[block]:
        nominal, p = chains.model.model[name], PARAMETERS[f"model.{name}"]
        if nominal > 0.0 and chains.fit_nominal:
            unknowns.append(Unknown(name, nominal, GUESS_SD, max(p.low, 1e-12), p.high, log=True))
        elif nominal != 0.0:
            sd = (GUESS_SD if chains.fit_nominal else NUMBER_SD) * abs(nominal)
            unknowns.append(Unknown(name, nominal, sd, p.low, p.high))
    return unknowns


def initial_unknowns(chains: Chains, block: str) -> list[Unknown]:
    """The state at the first sample of each recording, as far as a block needs it."""
    unknowns = []
    for suffix, s in chains.named():
        if block == "motor" and s.has("omega"):
            first = float(s.omega[np.isfinite(s.omega)][0])
            unknowns.append(Unknown(f"initial.omega{suffix}", first, 10.0, 0.0, 2000.0))
        if block == "arm":
            start = float(np.mean(s.theta[np.isfinite(s.theta)][:10]))
            unknowns += [Unknown(f"initial.theta{suffix}", start, 0.1), Unknown(f"initial.theta_dot{suffix}", 0.0, 1.0)]
    return unknowns


def hypotheses(model: Model, *, numbers: bool = True) -> list[Hypothesis]:
    """Every effect of the catalogue that the model lacks, and every of its `numbers` as a mismatch."""
    all_ = [Hypothesis(id_, starts=tuple(_starts(id_))) for id_ in CATALOGUE if id_ not in model.effects]
    if not numbers:
        return all_
    for block in BLOCKS.values():
        for name in block:
            nominal = model.model[name]
            if nominal != 0.0:
                p = PARAMETERS[f"model.{name}"]
                unknown = Unknown(name, nominal, MISMATCH_SD * abs(nominal), p.low, p.high, start=1.1 * nominal)
                all_.append(Hypothesis(PARAMETER_MISMATCH, name, ((unknown,),)))
    return all_


def _starts(id_: str) -> Iterable[tuple[Unknown, ...]]:
    """Searches for an effect: its size from a third of the default, each other parameter from several places."""
    effect = CATALOGUE[id_]
    size = effect.parameters[effect.size]
    step = size.default - size.neutral
    head = Unknown(f"{id_}.{effect.size}", size.neutral, 3.0 * abs(step), size.low, size.high,
                   start=size.neutral + 0.3 * step)
    others = [(name, p) for name, p in effect.parameters.items() if name != effect.size]
    if not others:
        return [(head,)]
    grids: list[list[Unknown]] = []
    for name, p in others:
        full = f"{id_}.{name}"
        if p.low > 0.0:
            spread = 0.5 * math.log(p.high / p.low)
            places = [p.default * math.exp(f * spread) for f in (-0.7, -0.35, 0.0, 0.35, 0.7)]
            grids.append([Unknown(full, p.default, 0.6 * spread, p.low, p.high, min(max(x, p.low), p.high), log=True)
                          for x in places])
        else:
            middle, half = 0.5 * (p.low + p.high), 0.5 * (p.high - p.low)
            grids.append([Unknown(full, middle, half, p.low, p.high, middle + f * half) for f in (-0.6, 0.05, 0.65)])
    # the second parameter is searched, any third starts in its middle
    return [(head, first, *(g[len(g) // 2] for g in grids[1:])) for first in grids[0]]


def blocks_of(chains: Chains, hypothesis: Hypothesis) -> tuple[str, ...]:
    """The parts of the cut chain whose readings a hypothesis changes, found by trying it."""
    values: dict[str, float]
    if hypothesis.number:
        values = {hypothesis.number: 1.2 * chains.model.model[hypothesis.number]}
    else:
        values = {f"{hypothesis.effect}.{k}": p.default for k, p in CATALOGUE[hypothesis.effect].parameters.items()}
    changed = []
    for block in BLOCKS:
        before, after = chains.residuals(block)({}), chains.residuals(block)(values)
        if any(len(r) and not np.array_equal(r, after[k]) for k, r in before.items()):
            changed.append(block)
    return tuple(changed)


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
    known: list[Unknown] = [*initial_unknowns(chains, block), *number_unknowns(chains, block), *carried]
    base = fit(chains.residuals(block), known)
    findings = Findings(block, base, base)
    if not base.residuals:
        return findings
    downstream = {}
    for other in {b for h in candidates for b in where[h.name] if b != block}:
        downstream[other] = fit(chains.residuals(other), [*initial_unknowns(chains, other),
                                                         *number_unknowns(chains, other)])
    nominal = known
    while len(findings.found) < MOST_EFFECTS:
        current = findings.final
        open_ = [h for h in candidates if h.name not in {g.name for g in findings.effects}]
        chosen = _shortlist(chains, block, open_, known, current)
        work = [pool.submit(_try, chains, block, h, start, known, current, downstream, where[h.name])
                for h, start in chosen]
        tried = [(h, w.result()) for (h, _), w in zip(chosen, work, strict=True)]
        rivals = _weigh(block, tried, current, downstream, where)
        if not rivals:
            break
        # the numbers that a rival was led to may serve as well without it
        again = fit(chains.residuals(block), _started(known, rivals[0].fit.values))
        counts = _counts([current, again])
        if again.evidence(counts) > current.evidence(counts) + 1.0:
            current = findings.final = again
            findings.base = findings.base if findings.found else again
            rivals = _weigh(block, tried, current, downstream, where)
        best = rivals[0]
        if best.probability < 0.5 or not (best.hypothesis.number or _material(current, best.fit)):
            findings.rivals = rivals
            break
        findings.found.append(rivals)
        known = _adopt(known, best.hypothesis)
        findings.final = best.fit if set(best.fit.residuals) == set(base.residuals) else fit(
            chains.residuals(block), _started(known, best.fit.values))
    _prune(chains, findings, nominal)
    return findings


def _prune(chains: Chains, findings: Findings, nominal: list[Unknown]) -> None:
    """Take out again what was found first and is not needed beside what was found later, the least needed first."""
    while len(findings.found) > 1:
        without = []
        for round_ in findings.found:
            known = nominal
            for h in findings.effects:
                if h is not round_[0].hypothesis:
                    known = _adopt(known, h)
            f = fit(chains.residuals(findings.block), _started(known, findings.final.values))
            counts = _counts([findings.final, f])
            gain = findings.final.evidence(counts) - f.evidence(counts) + _log_odds(round_[0].hypothesis)
            without.append((gain, round_, f))
        gain, round_, f = min(without, key=lambda w: w[0])
        if gain > 0.0:
            break
        findings.found.remove(round_)
        findings.final = f


def _shortlist(chains: Chains, block: str, candidates: list[Hypothesis], known: list[Unknown], current: Fit
               ) -> list[tuple[Hypothesis, int]]:
    """The candidates that linear algebra leaves standing, each with the start that did best."""
    groups = [(h, j) for h in candidates for j in range(len(h.starts))]
    left = screen(chains.residuals(block), current, known, [h.starts[j] for h, j in groups])
    best: dict[str, tuple[float, Hypothesis, int]] = {}
    for (h, j), x in zip(groups, left, strict=True):
        if h.name not in best or x < best[h.name][0]:
            best[h.name] = (x, h, j)
    ranked = [(h, j) for _, h, j in sorted(best.values(), key=lambda item: item[0])]
    nominal = chains.model.model
    # a number that has strayed far explains nothing more as a mismatch; it is only less surprising
    strayed = [(h, j) for h, j in ranked[SHORTLIST:] if h.number and not chains.fit_nominal
               and abs(current.values[h.number] - nominal[h.number]) > 2.0 * NUMBER_SD * abs(nominal[h.number])]
    return ranked[:SHORTLIST] + strayed


def _started(unknowns: Iterable[Unknown], values: Mapping[str, float]) -> list[Unknown]:
    return [Unknown(u.name, u.mean, u.sd, u.low, u.high, values.get(u.name, u.start), u.log) for u in unknowns]


def _adopt(known: list[Unknown], hypothesis: Hypothesis, start: int = 0) -> list[Unknown]:
    own = hypothesis.starts[start]
    return [*(u for u in known if u.name not in {o.name for o in own}), *own]


def _try(chains: Chains, block: str, hypothesis: Hypothesis, start: int, known: list[Unknown], current: Fit,
         downstream: Mapping[str, Fit], blocks: tuple[str, ...]) -> Fit:
    """Fit a hypothesis on top of what is known, on every part of the chain that it changes."""
    parts = [chains.residuals(block)]
    unknowns = _started(known, current.values)
    for other in blocks:
        if other != block:
            parts.append(chains.residuals(other))
            extra = [*initial_unknowns(chains, other), *number_unknowns(chains, other)]
            unknowns += _started(extra, downstream[other].values)

    def residuals(values: dict[str, float]) -> dict[str, np.ndarray]:
        return {k: r for part in parts for k, r in part(values).items()}

    return fit(residuals, _adopt(unknowns, hypothesis, start))


def _weigh(block: str, tried: list[tuple[Hypothesis, Fit]], current: Fit, downstream: Mapping[str, Fit],
           where: Mapping[str, tuple[str, ...]]) -> list[Weighed]:
    """Log evidence of each against none further, and probabilities; best first."""
    if not tried:
        return []
    counts = _counts([current, *downstream.values(), *(f for _, f in tried)])
    gains = [f.evidence(counts) - current.evidence(counts) + _log_odds(h)
             - sum(downstream[b].evidence(counts) for b in where[h.name] if b != block) for h, f in tried]
    weights = np.array([*gains, 0.0])
    weights = np.exp(weights - weights.max())
    probability = weights / weights.sum()
    weighed = [Weighed(h, f, g, float(p)) for (h, f), g, p in zip(tried, gains, probability, strict=False)]
    return sorted(weighed, key=lambda w: -w.gain)


def _counts(fits: Iterable[Fit]) -> dict[str, float]:
    """Independent samples of each channel, one count for all fits that are compared: the whitest residual's."""
    counts: dict[str, float] = {}
    for f in fits:
        for channel, n in f.independent.items():
            counts[channel] = max(counts.get(channel, 0.0), n)
    return counts


def _log_odds(hypothesis: Hypothesis) -> float:
    """Prior log odds of a hypothesis against none further."""
    return math.log(EFFECT_ODDS / (sum(map(len, BLOCKS.values())) if hypothesis.number else 1))


def _material(before: Fit, after: Fit) -> bool:
    """Whether an effect explains enough of some channel to matter."""
    return any(float(np.mean(r * r)) - float(np.mean(after.residuals[k] ** 2)) > MATERIAL**2
               for k, r in before.residuals.items() if len(r))
