# SPDX-License-Identifier: Apache-2.0
"""Which effect: every hypothesis is fitted to the part of the cut chain that it changes, and weighed."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from aeropend_ident.gap.chain import BLOCKS, PLACE_OF_NUMBER, Chains
from aeropend_ident.gap.fit import Fit, Unknown, fit, independent_samples, screen
from aeropend_ident.gap.shape import shapes
from aeropend_ident.gap.thrift import ThriftyChains
from aeropend_ident.gap.unknowns import NUMBER_SD, free_swinging, initial_unknowns, nominal_unknowns
from aeropend_sim.effects import CATALOGUE, PARAMETER_MISMATCH
from aeropend_sim.parameters import PARAMETERS, Model

MISMATCH_SD = 0.3
"""As `NUMBER_SD`, for the number that `parameter_mismatch` blames."""

EFFECT_ODDS = 1.0 / 50.0
"""Prior odds of one given effect against none further; `parameter_mismatch` shares them among its numbers."""

MATERIAL = 0.3
"""What an effect must explain in one channel at least, RMS in units of a reading's noise, to be worth a word."""

UNSURE = 0.75
"""As `MATERIAL`, of a rig whose noise is only what the recording shows: it may be a seventh larger."""

SHORTLIST = 8
"""How many hypotheses are fitted in full after the screening."""

STRAYED = 3.0
"""Standard deviations by which a number must leave its prior to count as strayed."""

FIRST_LOOK, ROUNDS = 2, 10
"""Rounds of a fit for all of the shortlist, and for the likeliest of them."""

FIRST_LOOK_UNKNOWN = 1
"""As `FIRST_LOOK`, for a rig whose numbers nobody knows: its rounds are longer."""

STEPS, STEPS_UNKNOWN = 4, 12
"""Steps in each round; numbers that nobody knows lie in long valleys."""

CONTENDERS = 4
"""How many of the likeliest are fitted to the end, and compared closely when none of them explains all."""

MOST_RUNS = 3500
"""Simulations of an unknown rig after which no further effect is looked for, and no fit is taken to the end."""

CLOSE = 1.5
"""Rivals are close when their mean square residuals are within this factor."""

FORM_SHOWS = 1.2
"""Mean square residual, in units of a reading's noise, from which on an effect must have another form."""

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
        # an arm that nothing drives must at least be let go
        state = {u.name: u.mean for u in initial_unknowns(chains, block)} if chains.fit_nominal else {}
        before, after = chains.residuals(block)(state), chains.residuals(block)({**state, **values})
        if any(len(r) and not np.array_equal(r, after[k]) and not (
                chains.fit_nominal and np.allclose(r, after[k], rtol=0.0, atol=1e-6)) for k, r in before.items()):
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
        current = findings.final
        if _passes_as_noise(current, UNSURE if thrifty else MATERIAL) and not strayed(chains, block, current) and (
                not swinging):
            break
        if thrifty is not None and thrifty.runs > MOST_RUNS:
            findings.cut_short = True
            break
        open_ = [h for h in candidates if h.name not in {g.name for g in findings.effects}]
        chosen = _shortlist(chains, block, open_, known, current)
        look = FIRST_LOOK if thrifty is None else FIRST_LOOK_UNKNOWN
        work = [pool.submit(_try, chains, block, h, start, known, current, downstream, where[h.name], look)
                for h, start in chosen]
        tried = [(h, w.result()) for (h, _), w in zip(chosen, work, strict=True)]
        done: list[Hypothesis] = []
        if thrifty is not None:
            tried, done = _led(chains, block, tried, current, downstream, where, known, pool)
        # the likeliest are fitted to the end
        likeliest = [w.hypothesis for w in _weigh(block, tried, current, downstream, where)[:CONTENDERS]]
        findings.cut_short |= thrifty is not None and thrifty.runs > MOST_RUNS
        rounds = FIRST_LOOK if findings.cut_short else ROUNDS
        further = [pool.submit(_try, chains, block, h, 0, known, current, downstream, where[h.name], rounds, f)
                   if h in likeliest and h not in done else None for h, f in tried]
        tried = [(h, w.result() if w else f) for (h, f), w in zip(tried, further, strict=True)]
        rivals = _weigh(block, tried, current, downstream, where)
        if not rivals:
            break
        rivals = _told_apart_by_place(chains, block, rivals, known)
        # the numbers that a rival was led to may serve as well without it
        again = fit(chains.residuals(block), _started(known, rivals[0].fit.values))
        counts = counts_of([current, again])
        if again.evidence(counts) > current.evidence(counts) + 1.0:
            current = findings.final = again
            findings.base = findings.base if findings.found else again
            rivals = _told_apart_by_place(chains, block, _weigh(block, tried, current, downstream, where), known)
        best = rivals[0]
        matters = best.hypothesis.number or _material(current, best.fit) or strayed(chains, block, current)
        if swinging and findings.found:  # what leaves a narrow band seems to leave many independent samples
            odds = [against(current, w.fit) + _log_odds(w.hypothesis) for w in rivals]
            rivals = [replace(w, probability=min(w.probability, _sure(x))) for w, x in zip(rivals, odds, strict=True)]
        if sum(w.probability for w in rivals) < 0.5 or not matters:
            findings.rivals = rivals
            break
        findings.found.append(rivals)
        known = _adopt(known, best.hypothesis)
        findings.final = best.fit if set(best.fit.residuals) == set(base.residuals) else fit(
            chains.residuals(block), _started(known, best.fit.values))
    _swap(chains, findings, nominal)
    _prune(chains, findings, nominal)
    return findings


def _led(chains: Chains, block: str, tried: list[tuple[Hypothesis, Fit]], current: Fit, downstream: Mapping[str, Fit],
         where: Mapping[str, tuple[str, ...]], known: list[Unknown], pool: ThreadPoolExecutor
         ) -> tuple[list[tuple[Hypothesis, Fit]], list[Hypothesis]]:
    """The best fitted to the end, and the others begun anew from its numbers: those that nobody knows lead astray.

    Returns:
        Each with the better of its fits, and which of them need no further one.
    """
    lead = _weigh(block, tried, current, downstream, where)[0]
    if lead.gain <= 0.0:
        return tried, []

    def go(h: Hypothesis, rounds: int, begun: Fit) -> Future[Fit]:
        return pool.submit(_try, chains, block, h, 0, known, current, downstream, where[h.name], rounds, begun)

    best = go(lead.hypothesis, ROUNDS, lead.fit).result()
    led = [None if h is lead.hypothesis else go(h, FIRST_LOOK_UNKNOWN, best) for h, _ in tried]
    anew = [best if one is None else one.result() for one in led]
    counts = counts_of([*anew, *(f for _, f in tried)])
    better = [(h, max(f, g, key=lambda x: x.evidence(counts))) for (h, f), g in zip(tried, anew, strict=True)]
    return better, [lead.hypothesis]


def _swap(chains: Chains, findings: Findings, nominal: list[Unknown]) -> None:
    """Replace what was found first, and only stood in for what was not yet known of the others, by a close rival."""
    if len(findings.found) < 2:
        return
    for k, round_ in enumerate(findings.found):
        known = nominal
        for h in findings.effects:
            if h is not round_[0].hypothesis:
                known = _adopt(known, h)
        taken = {h.name for h in findings.effects}
        for rival in round_[1:CONTENDERS]:
            if rival.gain <= 0.0 or rival.hypothesis.name in taken:
                continue
            begun = {**findings.final.values, **{u.name: rival.fit.values[u.name] for u in rival.hypothesis.starts[0]}}
            f = fit(chains.residuals(findings.block), _started(_adopt(known, rival.hypothesis), begun))
            counts = counts_of([findings.final, f])
            odds = _log_odds(rival.hypothesis) - _log_odds(findings.found[k][0].hypothesis)
            gain = f.evidence(counts) - findings.final.evidence(counts) + odds
            if gain > 0.0:
                sure = 1.0 / (1.0 + math.exp(-min(gain, 500.0)))
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
    """Take out again what was found first and is not needed beside what was found later, the least needed first."""
    while len(findings.found) > 1:
        without = []
        for round_ in findings.found:
            known = nominal
            for h in findings.effects:
                if h is not round_[0].hypothesis:
                    known = _adopt(known, h)
            f = fit(chains.residuals(findings.block), _started(known, findings.final.values))
            counts = counts_of([findings.final, f])
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
         downstream: Mapping[str, Fit], blocks: tuple[str, ...], rounds: int, begun: Fit | None = None) -> Fit:
    """Fit a hypothesis on top of what is known, on every part of the chain that it changes; goes on from `begun`."""
    parts = [chains.residuals(block)]
    unknowns = _started(known, current.values)
    for other in blocks:
        if other != block:
            parts.append(chains.residuals(other))
            extra = nominal_unknowns(chains, other)
            unknowns += _started(extra, downstream[other].values)

    def residuals(values: dict[str, float]) -> dict[str, np.ndarray]:
        return {k: r for part in parts for k, r in part(values).items()}

    swinging = chains.fit_nominal and free_swinging(chains.recordings)
    steps = STEPS_UNKNOWN if chains.fit_nominal and not swinging else STEPS
    if begun is not None:
        return fit(residuals, _started(_adopt(unknowns, hypothesis), begun.values), rounds, steps)
    if not hypothesis.number and CATALOGUE[hypothesis.effect].linear_in:
        first = fit(lambda values: residuals(from_linear(hypothesis.effect, values)),
                    [*unknowns, *linear_unknowns(hypothesis.effect)], rounds=3)
        own = from_linear(hypothesis.effect, first.values)
        size, second = (f"{hypothesis.effect}.{name}" for name in list(CATALOGUE[hypothesis.effect].parameters)[:2])
        bounds = CATALOGUE[hypothesis.effect].parameters[second.partition(".")[2]]
        # of an unknown rig the product alone may be sure: a search that begins at a bound would stay there
        inside = chains.fit_nominal and CATALOGUE[hypothesis.effect].linear_in == "product"
        reach = 0.3 if inside else 1.0
        own[size] *= max(1.0, own[second] / (reach * bounds.high), own[second] / (reach * bounds.low))
        if inside:
            own[second] = min(max(own[second], reach * bounds.low), reach * bounds.high)
        return fit(residuals, _started(_adopt(unknowns, hypothesis), own), rounds, steps)
    return fit(residuals, _adopt(unknowns, hypothesis, start), rounds, steps)


def linear_unknowns(id_: str) -> list[Unknown]:
    """Two unknowns in which an effect is linear, in place of its size and second parameter; both 0 without it."""
    size, second = list(CATALOGUE[id_].parameters.values())[:2]
    if CATALOGUE[id_].linear_in == "polar":
        return [Unknown(f"{id_}.cosine", 0.0, 3.0 * size.default), Unknown(f"{id_}.sine", 0.0, 3.0 * size.default)]
    return [Unknown(f"{id_}.slope", 0.0, 3.0 * size.default, size.low, size.high),
            Unknown(f"{id_}.product", 0.0, 3.0 * size.default * second.default)]


def from_linear(id_: str, values: Mapping[str, float]) -> dict[str, float]:
    """Values with the unknowns of `linear_unknowns` turned into the effect's own parameters."""
    (size_name, size), (second_name, _) = list(CATALOGUE[id_].parameters.items())[:2]
    own = dict(values)
    if CATALOGUE[id_].linear_in == "polar":
        x, y = own.pop(f"{id_}.cosine"), own.pop(f"{id_}.sine")
        pair = math.hypot(x, y), math.atan2(y, x)
    else:
        x, y = own.pop(f"{id_}.slope"), own.pop(f"{id_}.product")
        x = max(x, 1e-6 * size.default)  # so that the product alone can act
        pair = x, y / x
    own[f"{id_}.{size_name}"], own[f"{id_}.{second_name}"] = pair
    return own


def _weigh(block: str, tried: list[tuple[Hypothesis, Fit]], current: Fit, downstream: Mapping[str, Fit],
           where: Mapping[str, tuple[str, ...]]) -> list[Weighed]:
    """Log evidence of each against none further, and probabilities; best first."""
    if not tried:
        return []
    counts = counts_of([current, *downstream.values(), *(f for _, f in tried)])
    gains = [f.evidence(counts) - current.evidence(counts) + _log_odds(h)
             - sum(downstream[b].evidence(counts) for b in where[h.name] if b != block) for h, f in tried]
    weights = np.array([*gains, 0.0])
    weights = np.exp(weights - weights.max())
    probability = weights / weights.sum()
    weighed = [Weighed(h, f, g, float(p)) for (h, f), g, p in zip(tried, gains, probability, strict=False)]
    return sorted(weighed, key=lambda w: -w.gain)


def _told_apart_by_place(chains: Chains, block: str, rivals: list[Weighed], known: list[Unknown]) -> list[Weighed]:
    """Decide between rivals of which none explains all: an effect of another form than the catalogue's is among them.

    Each is given free curves at its own place. The right one needs them for its form alone; a wrong one, which only
    borrows the gap of a neighbour, cannot mend it from where it lives.
    """
    best = _mean_square(rivals[0].fit, block)
    close = [w for w in rivals[:CONTENDERS] if w.gain > 0.0 and _mean_square(w.fit, block) < CLOSE * best]
    if best < FORM_SHOWS or len({w.hypothesis.place for w in close}) < 2:
        return rivals
    left: list[tuple[float, float]] = []
    for w in close:
        own = [s for s in shapes(chains, block, w.fit, _adopt(known, w.hypothesis)) if s.place == w.hypothesis.place]
        left += [(s.left, s.independent) for s in own] or [(_mean_square(w.fit, block), 1.0)]
    count = max(n for _, n in left)
    evidence = np.array([-0.5 * count * math.log(max(x, 1.0)) for x, _ in left])
    weights = np.exp(evidence - evidence.max())
    weights *= sum(w.probability for w in close) / weights.sum()
    again = [replace(w, probability=float(p)) for w, p in zip(close, weights, strict=True)]
    order = {id(w): -float(e) for w, e in zip(again, evidence, strict=True)}
    rest = [w for w in rivals if all(w is not c for c in close)]
    return [*sorted(again, key=lambda w: order[id(w)]), *rest]


def _mean_square(f: Fit, block: str) -> float:
    """Mean square residual of a fit in the channels of a block, in units of a reading's noise."""
    home = {"actuator": ("v_a",), "motor": ("i_a", "omega"), "arm": ("theta",)}[block]
    own = [r for k, r in f.residuals.items() if k.partition("@")[0] in home]
    return float(np.mean(np.concatenate(own) ** 2)) if own else 0.0


def counts_of(fits: Iterable[Fit]) -> dict[str, float]:
    """Independent samples of each channel, one count for all fits that are compared: the whitest residual's."""
    counts: dict[str, float] = {}
    for f in fits:
        for channel, n in f.independent.items():
            counts[channel] = max(counts.get(channel, 0.0), n)
    return counts


def against(f: Fit, other: Fit) -> float:
    """Log evidence of `other` over `f`, with as many independent samples as one of these two leaves.

    A third fit, which leaves more, says nothing of how surely these two are told apart; and a narrow band, in which
    autocorrelations of either sign cancel, is worth fewer than it seems.
    """
    counts: dict[str, float] = {}
    for each in (f, other):
        for channel, r in each.residuals.items():
            own = min(each.independent[channel], independent_samples(r, power=2))
            counts[channel] = max(counts.get(channel, 0.0), own)
    return other.evidence(counts) - f.evidence(counts)


def _sure(log_odds: float) -> float:
    return 1.0 / (1.0 + math.exp(-min(max(log_odds, -500.0), 500.0)))


def _log_odds(hypothesis: Hypothesis) -> float:
    """Prior log odds of a hypothesis against none further."""
    return math.log(EFFECT_ODDS / (sum(map(len, BLOCKS.values())) if hypothesis.number else 1))


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


def _passes_as_noise(f: Fit, material: float = MATERIAL) -> bool:
    """Whether so little is left that nothing could explain a material part of it."""
    return all(float(np.mean(r * r)) < 1.0 + 0.5 * material**2 for r in f.residuals.values())


def _material(before: Fit, after: Fit) -> bool:
    """Whether an effect explains enough of some channel to matter."""
    return any(float(np.mean(r * r)) - float(np.mean(after.residuals[k] ** 2)) > MATERIAL**2
               for k, r in before.residuals.items() if len(r))
