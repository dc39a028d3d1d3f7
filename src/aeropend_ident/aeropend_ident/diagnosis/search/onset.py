# SPDX-License-Identifier: Apache-2.0
"""Effects that begin or end during a recording.

Where a stage is not explained, each effect is tried as if it acted only from an instant on, or only until then. To
first order this is one least-squares solve for each instant; cumulative sums make it as cheap as one. If an instant
stands out, the whole search is made again with effects that act only there, and the better search counts. If none is
better, the part that the nominal model explains alone gives an instant: it needs no effect that is nearly linear.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import CutChain, CutChains
from aeropend_ident.diagnosis.chain.priors import nominal_parameters
from aeropend_ident.diagnosis.chain.values import STAGES
from aeropend_ident.diagnosis.document import Interval
from aeropend_ident.diagnosis.policy import GOOD_ENOUGH, MATERIAL
from aeropend_ident.diagnosis.search.findings import Findings, adopted
from aeropend_ident.diagnosis.search.free_curves import missing_terms
from aeropend_ident.diagnosis.search.hypotheses import (
    EFFECT_ODDS,
    Hypothesis,
    delay_from_voltage,
    hypotheses,
    stages_of,
)
from aeropend_ident.diagnosis.search.search import passes_as_noise
from aeropend_ident.diagnosis.search.selection import CLOSE_GAIN, FORM_SHOWS, squared_gap
from aeropend_ident.estimation.levenberg_marquardt import Search
from aeropend_ident.estimation.map_fit import Fit, fit
from aeropend_ident.estimation.parameter import Parameter, key, started

Array = NDArray[np.float64]
Window = tuple[int, int]
"""First sample at which an effect acts, and the first at which it acts no more."""

GRID = 0.25
"""[s] Distance of the instants that are tried first (choice: the fit then moves the best one)."""

SHORTEST = 2.0
"""[s] Shortest time with and without the effect (choice: some time constants of the arm)."""

STANDS_OUT = 5.0
"""Log likelihood by which an effect with an instant must beat what the search found for the search to be made again.

Choice: the search itself decides; this only saves time."""

CLOSES = 0.5
"""Share of the misfit left that an effect with an instant must explain for the search to be made again.

Choice: the larger part. Among many small imperfections some instant always explains a little."""

FOLLOWED, PASSES, ROUNDS = 4, 2, 2
"""Effects that are fitted with their windows, how often the window is moved, and rounds of each fit (choice)."""

FOUND = 0.5
"""[s] Distance of two windows' instants above which both are searched (choice: what counts as found)."""

UNDISTURBED = 0.25
"""Least share of what is fitted that must be without the effect for a window that no effect was fitted in (choice)."""

NEAR = 0.05
"""[s] Distance of an instant from its estimate within which the search is not made again (choice: a tenth of what
counts as found)."""

WIDE, PIECES = 2.0, 16
"""[s] Distance over which the instant is moved at first, and into how many pieces it is divided on each side (choice).

An arm that swings gives a minimum of the misfit in each swing."""

WITHIN = 1.92
"""Log likelihood below its maximum at the ends of a 95 % interval (derived: half the 95 % quantile of χ² of one)."""


@dataclass(frozen=True)
class Onset:
    """When an effect begins or ends.

    Attributes:
        window: in which the effects found act.
        since: [s] when they begin; None: from the start.
        until: [s] when they end; None: to the end.
    """

    window: Window
    since: Interval | None
    until: Interval | None


def search_within_windows(chains: CutChains, findings: dict[str, Findings],
                          searched: Callable[[CutChains], dict[str, Findings]]
                          ) -> tuple[CutChains, dict[str, Findings], Onset | None]:
    """Search again with effects that begin or end, if an instant stands out.

    Args:
        chains: cut.
        findings: of the search with effects that act all the time.
        searched: makes a search.

    Returns:
        The chains, the findings and the onset of the better search; without an onset those that were given.
    """
    def searches(windows: Iterable[Window]) -> Iterator[_Within]:
        each = (_searched_within(chains, findings, window, searched) for window in windows)
        return (one for one in each if one is not None)

    found = _best(searches(suspected(chains, findings))) or _best(
        one for one in searches(departures(chains, findings)) if _explains(one))
    return found or (chains, findings, None)


_Within = tuple[CutChains, dict[str, Findings], Onset]
"""Chains with a window, what was found within it, and when that begins or ends."""


def _searched_within(chains: CutChains, findings: Mapping[str, Findings], window: Window,
                     searched: Callable[[CutChains], dict[str, Findings]]) -> _Within | None:
    """Search within a window, and again where the instant moves; None: the search without an instant is better."""
    found: _Within | None = None
    for _ in range(PASSES):
        again = with_window(chains, window)
        within = searched(again)
        if not is_better(findings, within, chains):
            return None
        found = again, within, located(again, within)
        moved = found[2].window
        if abs(sum(moved) - sum(window)) * chains.recordings[0].period < NEAR:
            break
        window = moved
    return found


def _best(each: Iterable[_Within]) -> _Within | None:
    """The search of several whose window fits best; None of none."""
    best: _Within | None = None
    for one in each:
        if best is None or _fits_better(best, one):
            best = one
    return best


def _explains(found: _Within) -> bool:
    """Whether no effect is missing in the stages with effects: an unlisted one may act now and then, too."""
    return all(max(f.final.scale.values()) <= GOOD_ENOUGH for f in found[1].values() if f.found)


def _fits_better(one: _Within, other: _Within) -> bool:
    """Whether another window is the better one: by log evidence, or by free curves where no effect's form fits.

    The right effect needs free curves at its own place for its form only; a wrong one needs them at another place.
    """
    (_, once, _), (_, again, _) = one, other
    open_ = [b for b in once if once[b].found and again[b].found
             and min(once[b].final.mean_square, again[b].final.mean_square) > FORM_SHOWS]
    if not open_ or once[open_[0]].effects[0].place == again[open_[0]].effects[0].place:
        return gained(once, again) > 0.0
    return _left_at_its_place(other, open_[0]) < _left_at_its_place(one, open_[0])


def _left_at_its_place(found: _Within, stage: str) -> float:
    """Mean square that the first effect of a stage leaves with free curves at its place, all within its window."""
    chains, findings, _ = found
    best = findings[stage].found[0][0]
    terms = missing_terms(chains, stage, best.fit, adopted(nominal_parameters(chains, stage), best.hypothesis))
    return min((t.left for t in terms if t.place == best.hypothesis.place), default=best.fit.mean_square)


def suspected(chains: CutChains, findings: Mapping[str, Findings]) -> list[Window]:
    """The windows that explain most in the first stage that is not explained and where one stands out.

    Two effects that are alike may fit about as well, each within a window of its own.

    Args:
        chains: cut; of several recordings, and of an uncalibrated rig, whose searches are long, none is suspected.
        findings: what the search found with effects that act all the time.
    """
    open_ = _not_explained(chains, findings)
    if not open_:
        return []
    every = hypotheses(chains.model, chains.further, chains.left_out, mismatches=False)
    changed = stages_of(chains, every)
    each = (_best_windows(chains, b, findings[b], [h for h in every if changed[h.name][:1] == (b,)]) for b in open_)
    return next((windows for windows in each if windows), [])


def departures(chains: CutChains, findings: Mapping[str, Findings]) -> list[Window]:
    """The windows outside of which the nominal model explains a stage, of the first stage that has some.

    They take no effect for linear in its size. A dry friction is not: an arm that sticks stays where it is.

    Args:
        chains: as for `suspected`.
        findings: as for `suspected`.
    """
    each = (_departures(chains, b, findings[b].base) for b in _not_explained(chains, findings))
    return next((windows for windows in each if windows), [])


def _not_explained(chains: CutChains, findings: Mapping[str, Findings]) -> list[str]:
    """The stages in which an effect with an instant may be."""
    if len(chains.each) > 1 or not chains.policy.calibrated:
        return []
    return [b for b in STAGES if findings[b].base.residuals and not passes_as_noise(findings[b].final, MATERIAL)]


def _departures(chains: CutChains, stage: str, base: Fit) -> list[Window]:
    """The windows outside of which the nominal model, fitted to what is outside alone, explains a stage."""
    chain, signals = chains.each[0], chains.recordings[0]
    known = [p for p in nominal_parameters(chains, stage) if p.name in base.values]
    residuals, rows = chain.residuals(stage), {c: rows_of(chain, key(c).name) for c in base.residuals}

    def explained(first: int, last: int) -> bool:
        part = {c: slice(*np.searchsorted(at, (first, last))) for c, at in rows.items()}
        f = fit(lambda values: {c: r[part[c]] for c, r in residuals(values).items()}, known, ROUNDS)
        return max(f.scale.values()) <= GOOD_ENOUGH

    n, least, near = signals.train, round(UNDISTURBED * signals.train), round(GRID / signals.period)
    if explained(0, n):
        return []
    ends = range(least, n, near)
    before = bisect_left(ends, True, key=lambda k: not explained(0, k))  # number of ends up to which it is explained
    after = bisect_left(ends, True, key=lambda k: not explained(n - k, n))
    return [*([(ends[before - 1], len(signals))] if before else []), *([(0, n - ends[after - 1])] if after else [])]


def with_window(chains: CutChains, window: Window) -> CutChains:
    """The chains of one recording cut again, with effects that act only within a window."""
    (signals,) = chains.recordings
    return chains.anew([replace(signals, window=window)])


def is_better(once: Mapping[str, Findings], again: Mapping[str, Findings], chains: CutChains) -> bool:
    """Whether a search with a window closes most of what one without leaves, and has more evidence.

    Its instant and its prior odds are included.
    """
    signals = chains.recordings[0]
    tried = 2.0 * signals.train * signals.period / GRID
    left, before = (sum(squared_gap(chains, f.final) for f in each.values()) for each in (again, once))
    enough = left < (1.0 - CLOSES) * before and any(f.found for f in again.values())
    return enough and math.log(EFFECT_ODDS / tried) + gained(once, again) > 0.0


def gained(once: Mapping[str, Findings], again: Mapping[str, Findings]) -> float:
    """Log evidence that another search of the same recording has more."""
    return sum(f.final.evidence_over(once[stage].final) for stage, f in again.items())


def located(chains: CutChains, findings: Mapping[str, Findings]) -> Onset:
    """Move the instant of a window to where the findings fit best, with its interval by the profile likelihood.

    Args:
        chains: of one recording, cut with a window.
        findings: of the search with this window.
    """
    window, (low, high) = _located(chains.each[0], {b: f.final for b, f in findings.items() if f.found})
    period = chains.each[0].signals.period
    begins = window[0] > 0
    at = Interval(window[not begins] * period, low * period, high * period)
    return Onset(window, at if begins else None, None if begins else at)


def _located(chain: CutChain, fits: Mapping[str, Fit]) -> tuple[Window, tuple[int, int]]:
    """The window whose instant fits best, and the ends of its 95 % interval: the nearest that were tried outside."""
    window = chain.signals.window
    assert window is not None
    begins = window[0] > 0

    def cost(k: int) -> float:
        moved = _windowed(chain, _moved(window, k, begins=begins))
        return sum(0.5 * f.ess[channel] * float(np.mean(r * r)) / f.scale[channel] ** 2
                   for b, f in fits.items() for channel, r in moved.residuals(b)(f.values).items())

    edge = round(SHORTEST / chain.signals.period)
    first, last = edge, max(chain.signals.train - edge, window[not begins])
    best, reach, costs = window[not begins], round(WIDE / chain.signals.period), dict[int, float]()
    while True:
        step = max(reach // PIECES, 1)
        near = range(max(best - reach, first), min(best + reach, last) + 1, step)
        costs.update({k: cost(k) for k in near if k not in costs})
        best = min(costs, key=lambda k: costs[k])
        if not (near[0] < best < near[-1] or best - step < first or best + step > last):
            continue  # it may lie beyond what was tried
        if step == 1:
            break
        reach = 2 * step
    inside = [k for k, c in costs.items() if c < costs[best] + WITHIN]
    low = max((k for k in costs if k < min(inside)), default=min(inside))
    high = min((k for k in costs if k > max(inside)), default=max(inside))
    return _moved(window, best, begins=begins), (low, high)


def _windowed(chain: CutChain, window: Window) -> CutChain:
    return replace(chain, signals=replace(chain.signals, window=window))


def _moved(window: Window, k: int, *, begins: bool) -> Window:
    return (k, window[1]) if begins else (window[0], k)


def _best_windows(chains: CutChains, stage: str, f: Findings, candidates: Sequence[Hypothesis]) -> list[Window]:
    """The windows in which an effect explains most of the misfit, if it stands out."""
    chain = chains.each[0]
    signals = chain.signals
    known = [p for p in nominal_parameters(chains, stage) if p.name in f.base.values]
    residuals = chains.residuals(stage)
    search = Search(lambda values: residuals({**f.base.values, **values}), started(known, f.base.values))
    weight = np.concatenate([np.full(len(search.current[k]), w) for k, w in search.weight.items()])
    jacobian = search.stacked(search.jacobian()) / weight
    r = np.concatenate([search.current[k] for k in search.weight])
    at = np.concatenate([rows_of(chain, key(k).name) for k in search.weight])
    order = np.argsort(at, kind="stable")
    edge = round(SHORTEST / signals.period)
    instants = np.arange(edge, signals.train - edge, max(round(GRID / signals.period), 1))
    if not len(instants):
        return []
    cuts = np.searchsorted(at[order], instants)
    information = jacobian @ jacobian.T + search.prior
    try:
        inverse = np.linalg.inv(information)
    except np.linalg.LinAlgError:  # a run that runs away: nothing stands out of it
        return []
    pull = inverse @ (jacobian @ r + search.z)

    def gains(column: Array) -> tuple[Array, Array]:
        """Cost explained by a column that acts from each instant on, and until each instant."""
        products = np.vstack([column * r, column * column, jacobian * column])[:, order]
        total = products.sum(axis=1, keepdims=True)
        before = np.concatenate([np.zeros((len(products), 1)), np.cumsum(products, axis=1)], axis=1)[:, cuts]

        def explained(p: Array) -> Array:
            cross = p[0] - pull @ p[2:]
            size = p[1] - np.einsum("jk,jl,lk->k", p[2:], inverse, p[2:])
            return np.where(size > 1e-9 * total[1], cross**2 / np.maximum(size, 1e-300), 0.0)

        return explained(total - before), explained(before)

    found: list[tuple[float, Window, Hypothesis]] = []
    for h in candidates:
        for own in h.starts:
            moved = residuals({**f.base.values, **{p.name: p.begin for p in own}})
            column = np.concatenate([moved[k] for k in search.weight]) - r
            if not np.isfinite(column).all() or not column.any():
                continue
            since, until = gains(column)
            for gain, begins in ((since, True), (until, False)):
                k = int(np.argmax(gain))
                window = (int(instants[k]), len(signals)) if begins else (0, int(instants[k]))
                found.append((float(gain[k]), window, replace(h, starts=(own,))))
    found.sort(key=lambda one: -one[0])
    tried = [_fitted(chain, stage, f.base, known, window, h) for _, window, h in found[:FOLLOWED]]
    open_ = (1.0 - CLOSES) * (f.final.mean_square - 1.0)
    likely = sorted(((one.log_likelihood, window) for one, window in tried
                     if one.mean_square - 1.0 < open_), reverse=True)
    least = f.final.log_likelihood + STANDS_OUT
    windows: list[Window] = []
    for likelihood, window in likely:
        apart = all(max(abs(a - b) for a, b in zip(window, w, strict=True)) * signals.period > FOUND for w in windows)
        if apart and likelihood > max(least, likely[0][0] - CLOSE_GAIN):
            windows.append(window)
    return windows


def _fitted(chain: CutChain, stage: str, base: Fit, known: Sequence[Parameter], window: Window,
            effect: Hypothesis) -> tuple[Fit, Window]:
    """Fit an effect that acts within a window, from the first of its starts, and move the window."""
    f = base
    for _ in range(PASSES):
        within = _windowed(chain, window)
        begun = replace(effect, starts=(tuple(started(effect.starts[0], f.values)),))
        own = delay_from_voltage(within, begun, f.values).starts[0]
        f = fit(within.residuals(stage), [*started(known, f.values), *own], ROUNDS)
        window, _ = _located(within, {stage: f})
    return f, window


def rows_of(chain: CutChain, channel: str) -> NDArray[np.intp]:
    """The sample of each row of a channel's residual."""
    s = chain.signals
    if channel == "omega" and s.pulses is not None:
        p = s.pulses
        return np.asarray(p.index[(p.index < s.train) & ~p.false])
    start = s.after_unseen if channel == "v_a" else 0
    measured = s.true_speed if channel == "omega" else s.channel(channel)
    return start + np.flatnonzero(np.isfinite(measured[start:s.train]))

