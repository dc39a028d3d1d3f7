# SPDX-License-Identifier: Apache-2.0
"""The whole diagnosis of one rig: gap, place, effects, numbers, and how far the gap closes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from aeropend_ident.gap import gust as gusts
from aeropend_ident.gap import shrink, where
from aeropend_ident.gap.chain import BLOCKS, PLACE_OF_NUMBER, Chains, difference, with_values
from aeropend_ident.gap.experiment import next_experiment
from aeropend_ident.gap.fit import Fit, Unknown, fit
from aeropend_ident.gap.signals import CHANNELS, Signals
from aeropend_ident.gap.which import (
    EFFECT_ODDS,
    NUMBER_SD,
    Findings,
    Hypothesis,
    Weighed,
    initial_unknowns,
    number_unknowns,
    search,
)
from aeropend_sim.effects import CATALOGUE
from aeropend_sim.parameters import MODEL_NAMES, Model

Array = NDArray[np.float64]

Z95 = 1.959964
GOOD_ENOUGH = 1.3
"""RMS of a residual, in units of a reading's noise, up to which the model explains a channel."""

RANDOM_TORQUE = 0.35
"""A torque on the arm passes as random while the state explains less than this share of it."""

SURE = 2.5
"""Standard deviations by which an effect must differ from none, and a number from nominal, after the joint fit."""

UNDECIDED = 0.05
"""Probability from which on a rival is not ruled out."""

FALSE_CAPTURES = 0.02
"""1/s of false speed periods that any rig may show."""


@dataclass(frozen=True)
class Diagnosis:
    """What was found.

    Attributes:
        model: the nominal model. augmented: with refitted numbers and found effects.
        signals: the recordings. before, after: channel -> (N,) free-run readings, per recording.
        body: the content of `diagnosis.json` from `channels` on (contract section 5).
        misfit: what the nominal structure leaves where it fits worst, and the variables beside it, name -> (M,).
    """

    model: Model
    augmented: Model
    signals: Sequence[Signals]
    before: Sequence[Mapping[str, Array]]
    after: Sequence[Mapping[str, Array]]
    body: dict[str, object]
    misfit: Mapping[str, Array]


Progress = Callable[[str, float], None]
"""Called with what is being done and the share (0..1) that is behind."""


def diagnose(model: Model, recordings: Sequence[Signals], jobs: int = 1, progress: Progress = lambda *_: None, *,
             fit_nominal: bool = False) -> Diagnosis:
    """Find where a model and a rig part, by which effect, and how far the gap closes.

    Args:
        model: the nominal model, with effects already known to be there.
        recordings: one or more of one rig.
        jobs: threads.
        progress: told how far it is.
        fit_nominal: the model's numbers are only a guess, good to a factor of three.
    """
    with threadpool_limits(1):  # the matrices are narrow: threads of the linear algebra only get in each other's way
        return _diagnose(Chains(model, recordings, fit_nominal=fit_nominal), jobs, progress)


def _diagnose(chains: Chains, jobs: int, progress: Progress) -> Diagnosis:
    model, recordings = chains.model, [chain.signals for chain in chains.each]
    findings = search(chains, jobs, lambda block, share: progress(f"weighing effects of the {block}", 0.7 * share))
    progress("looking for chance", 0.7)
    spikes = _spikes(recordings)
    torque, misfit, variables = _random_torque(chains, findings)
    progress("fitting the whole chain", 0.75)
    values, sd = _joint(chains, findings)
    while weak := _weakest(model, findings, values, sd):
        findings[weak[0]].found.remove(weak[1])
        values, sd = _joint(chains, findings)
    base_values = {n: v for f in findings.values() for n, v in f.base.values.items() if n.startswith("initial.")}
    progress("measuring the gap", 0.9)
    before = [shrink.free_run(model, s, chains.own(base_values, k)) for k, s in enumerate(recordings)]
    after = [shrink.free_run(model, s, chains.own(values, k)) for k, s in enumerate(recordings)]
    found = [h for f in findings.values() for h in f.effects]
    scorer = _Scorer(chains, model, recordings, bool(spikes))
    gap_before, gap_after = scorer.gap(before, known=False), scorer.gap(after)
    floors = scorer.floors()
    share, low, high = shrink.closed(gap_before, gap_after, floors)

    amounts = _amounts(found, values, scorer, torque, spikes, before, _unexplained(findings, gap_after, floors))
    candidates = _candidates(findings, values, sd, torque, spikes, scorer, gap_after.total)
    reasons = [f"{c} is off by {x:.1f} times a reading's noise"
               for c, x in _left(findings, torque is not None).items() if x > GOOD_ENOUGH]
    parts = where.shares((place, amount) for _, place, amount in amounts)
    ranked = sorted((a for a in amounts if a[0]), key=lambda a: -a[2])
    effects = list(dict.fromkeys(name.partition(":")[0] for name, _, _ in ranked))
    verdict, place = (effects[0], ranked[0][1]) if ranked else ("none", "none")
    predictable = not (torque or spikes)
    if reasons and (not effects or (share is not None and share < 0.5 and predictable)):
        verdict, place = "unknown", max(parts, key=lambda p: parts[p])

    undecided = _not_separable(findings)
    augmented = _augmented(model, values, torque, spikes)
    names = [c for c in CHANNELS if c in gap_before.rms]
    body: dict[str, object] = {
        "channels": {c: {"unit": CHANNELS[c], "gap": gap_before.rms[c], "floor": floors[c],
                         "gap_after": gap_after.rms[c]} for c in names},
        "where": {"place": place, "share": parts, "regions": where.regions(misfit, variables)},
        "which": {"verdict": verdict, "effects": effects, "candidates": candidates,
                  "numbers": {n: {"nominal": model.model[n], **_interval(values[n], sd[n])}
                              for n in MODEL_NAMES if n in values},
                  "unexplained": reasons,
                  "not_separable": [[a.hypothesis.effect, b.hypothesis.effect] for a, b in undecided],
                  "next_experiment": _next_experiment(model, recordings[0], undecided, values)},
        "shrink": {"gap": gap_before.total, "gap_after": gap_after.total, "floor": scorer.bottom(gap_before, floors),
                   "closed": share, "low": low, "high": high},
    }
    progress("done", 1.0)
    return Diagnosis(model, augmented, recordings, before, after, body, {"misfit": misfit, **variables})


def _amounts(found: Sequence[Hypothesis], values: Mapping[str, float], scorer: _Scorer, torque: Weighed | None,
             spikes: Weighed | None, before: Sequence[Mapping[str, Array]], unexplained: dict[str, float]
             ) -> list[tuple[str, str, float]]:
    """(name, place, squared gap) of each finding: what comes back when it is taken out; no name for what is not one."""
    model, best = scorer.model, scorer.squared(values)

    def comes_back(nominal: Mapping[str, float]) -> float:
        return max(scorer.squared({**values, **nominal}) - best, 0.0)

    amounts = [(h.name, h.place, comes_back({u.name: _neutral(model, u.name) for u in h.starts[0]})) for h in found]
    if torque is not None:
        amounts.append((torque.hypothesis.name, torque.hypothesis.place, unexplained.pop("arm", 0.0)))
    if spikes is not None:
        with_, without = scorer.gap(before, known=False), scorer.gap(before)
        amounts.append((spikes.hypothesis.name, spikes.hypothesis.place, max(with_.total**2 - without.total**2, 0.0)))
    amounts += [("", place, amount) for place, amount in unexplained.items()]
    if not amounts:  # nothing but numbers within their uncertainty: how the gap that they leave is shared
        for place in dict.fromkeys(PLACE_OF_NUMBER.values()):
            back = {n: model.model[n] for n in values if PLACE_OF_NUMBER.get(n) == place}
            amounts.append(("", place, comes_back(back)))
    return amounts


class _Scorer:
    """Measures the gap of models on the held-out part of every recording."""

    def __init__(self, chains: Chains, model: Model, recordings: Sequence[Signals], spikes: bool) -> None:
        self.chains, self.model, self.recordings, self.spikes = chains, model, recordings, spikes

    def gap(self, readings: Sequence[Mapping[str, Array]], known: bool = True) -> shrink.Gap:
        """The gap over all recordings; `known`: false periods of the speed are told apart if they were found."""
        gaps = [shrink.gap(r, s, s.train, len(s), s.false_speed if known and self.spikes else None)
                for r, s in zip(readings, self.recordings, strict=True)]
        if len(gaps) == 1:
            return gaps[0]
        channels = [c for c in CHANNELS if all(c in g.rms for g in gaps)]
        rms = {c: math.sqrt(float(np.mean([g.rms[c] ** 2 for g in gaps]))) for c in channels}
        spread = {c: math.sqrt(float(np.mean([g.spread[c] ** 2 for g in gaps]))) for c in channels}
        columns = [[list(g.rms).index(c) for c in channels] for g in gaps]
        windows = np.concatenate([g.windows[:, i] for g, i in zip(gaps, columns, strict=True)])
        return shrink.Gap(rms, spread, windows)

    def of(self, values: Mapping[str, float]) -> shrink.Gap:
        """The gap of the model with these values."""
        return self.gap([shrink.free_run(self.model, s, self.chains.own(values, k))
                         for k, s in enumerate(self.recordings)])

    def squared(self, values: Mapping[str, float]) -> float:
        """The squared total gap of the model with these values."""
        return self.of(values).total ** 2

    def floors(self) -> dict[str, float]:
        """The floor by channel over all recordings."""
        each = [shrink.floor(s, s.train, len(s)) for s in self.recordings]
        return {c: math.sqrt(float(np.mean([f[c] ** 2 for f in each]))) for c in CHANNELS}

    @staticmethod
    def bottom(gap: shrink.Gap, floors: Mapping[str, float]) -> float:
        """The floor of the total gap."""
        return math.sqrt(float(np.mean([(floors[c] / gap.spread[c]) ** 2 for c in gap.rms])))


def _spikes(recordings: Sequence[Signals]) -> Weighed | None:
    """Whether false speed periods come more often than any rig may show."""
    count, time = 0, 0.0
    for s in recordings:
        count += int(np.sum(np.diff(s.false_speed[: s.train].astype(int)) == 1))
        time += s.train * s.period
    if count < 3:
        return None
    expected = FALSE_CAPTURES * time
    gain = count * math.log(count / expected) - (count - expected) + math.log(EFFECT_ODDS)
    if gain < 0.0:
        return None
    name = "speed_spikes.rate"
    rate, sd = count / time, math.sqrt(count) / time
    return Weighed(Hypothesis("speed_spikes"), Fit({name: rate}, {name: sd}, {}, {}, {}, 0.0), gain,
                   1.0 / (1.0 + math.exp(-min(gain, 500.0))))


def _random_torque(chains: Chains, findings: Mapping[str, Findings]) -> tuple[Weighed | None, Array, dict[str, Array]]:
    """Judge `gust` on what the arm leaves, and the unexplained signal that regions are drawn from."""
    block = max(BLOCKS, key=lambda b: _misfit_of(findings[b].base))
    chain = chains.each[0]
    s = chain.signals
    final = findings["arm"].final
    torque: Weighed | None = None
    own = chains.own(final.values, 0)
    n = with_values(chains.model, own).numbers()

    def fitted(values: Mapping[str, float]) -> gusts.Gust:
        return gusts.fit_gust((s.theta - chain.arm(values))[: s.train], s.theta[: s.train], n["mgd_over_J"],
                              n["c_over_J"], s.sigma["theta"], s.period)

    if final.scale.get("theta", 1.0) > GOOD_ENOUGH:
        g = fitted(own)
        theta, speed = np.nan_to_num(s.theta[g.index]), chain.speed[g.index]
        rate = np.gradient(_calm(theta), g.index * s.period)
        columns = [np.sin(theta), theta, np.abs(theta), rate, np.abs(rate) * rate, np.tanh(rate / 0.05), speed,
                   speed**2, speed * rate, np.gradient(speed, g.index * s.period)]
        if g.gain > 0.0 and gusts.follows_state(g.torque, columns) < RANDOM_TORQUE:
            values = {"gust.sigma": g.sigma, "gust.tau": g.tau}
            sd = {"gust.sigma": g.sigma * g.sigma_sd, "gust.tau": g.tau * g.tau_sd}
            torque = Weighed(Hypothesis("gust"), Fit(values, sd, {}, {}, {}, 0.0), g.gain, 1.0)
    if block == "actuator":
        misfit, index = s.v_a - chain.actuator(own), np.arange(len(s))
    elif block == "motor":
        misfit = s.i_a - chain.motor(chains.own(findings["motor"].base.values, 0))[0]
        index = np.arange(len(s))
    else:
        g = fitted(chains.own(findings["arm"].base.values, 0))
        misfit, index = g.torque, g.index
    rate = np.gradient(_calm(np.nan_to_num(s.theta)), s.period)
    variables: dict[str, Array] = {"theta": s.theta[index], "theta_dot": rate[index], "omega": chain.speed[index],
                 "i_a": s.i_a[index], "duty": s.duty[index], "t": np.asarray(index * s.period, dtype=float)}
    return torque, misfit[: len(index)], variables


def _calm(x: Array) -> Array:
    """A moving mean long enough to take a derivative of quantised angles."""
    kernel = np.hanning(27)[1:-1]
    return np.convolve(np.pad(x, 12, mode="edge"), kernel / kernel.sum(), mode="valid")


def _misfit_of(f: Fit) -> float:
    return max((float(np.mean(r * r)) for r in f.residuals.values()), default=0.0)


def _left(findings: Mapping[str, Findings], torque: bool) -> dict[str, float]:
    """Channel -> RMS of what is left in its part of the cut chain, in units of a reading's noise."""
    left: dict[str, float] = {}
    for block, f in findings.items():
        for channel, r in f.final.residuals.items():
            if not (torque and block == "arm"):
                name = channel.partition("@")[0]
                left[name] = max(left.get(name, 0.0), float(np.sqrt(np.mean(r * r))))
    return left


def _unexplained(findings: Mapping[str, Findings], after: shrink.Gap, floors: Mapping[str, float]) -> dict[str, float]:
    """Place -> squared gap that is left there: what the cut chain leaves above the floor."""
    home = {"v_a": "actuator", "i_a": "electrical", "omega": "rotor", "theta": "arm"}
    left: dict[str, float] = {}
    for f in findings.values():
        for channel, r in f.final.residuals.items():
            name = channel.partition("@")[0]
            excess = float(np.mean(r * r)) - GOOD_ENOUGH**2
            if excess > 0.0 and name in after.spread:
                left[home[name]] = excess * (floors[name] / after.spread[name]) ** 2 / len(after.spread)
    return left


def _joint(chains: Chains, findings: Mapping[str, Findings]) -> tuple[dict[str, float], dict[str, float]]:
    """Fit everything found and every number together, on the whole chain from the duty to all channels."""
    unknowns: dict[str, Unknown] = {}
    start: dict[str, float] = {}
    for block, f in findings.items():
        for u in [*initial_unknowns(chains, block), *number_unknowns(chains, block)]:
            unknowns[u.name] = u
        for h in f.effects:
            unknowns.update({u.name: u for u in h.starts[0]})
        start.update(f.final.values)

    def residuals(values: dict[str, float]) -> dict[str, Array]:
        out: dict[str, Array] = {}
        for k, chain in enumerate(chains.each):
            s = chain.signals
            readings = shrink.free_run(chains.model, s, chains.own(values, k))
            suffix = f"@{k}" if k else ""
            for channel in ("theta", "i_a", "v_a"):
                part = slice(s.after_unseen if channel == "v_a" else 0, s.train)
                out[channel + suffix] = difference(s.channel(channel)[part], readings[channel][part]) / s.sigma[channel]
            p = s.pulses
            if p is not None:
                use = p.index[(p.index < s.train) & ~p.false]
                sigma = p.sigma[(p.index < s.train) & ~p.false]
                out["omega" + suffix] = (s.omega[use] - readings["omega"][use]) / sigma
            elif s.has("omega"):
                speed = difference(s.true_speed[: s.train], readings["omega"][: s.train])
                out["omega" + suffix] = speed / s.sigma["omega"]
        return out

    begun = [Unknown(u.name, u.mean, u.sd, u.low, u.high, start.get(u.name, u.start), u.log)
             for u in unknowns.values()]
    joint = fit(residuals, begun)
    return joint.values, joint.sd


def _weakest(model: Model, findings: Mapping[str, Findings], values: Mapping[str, float], sd: Mapping[str, float]
             ) -> tuple[str, list[Weighed]] | None:
    """The finding (block, round) whose size the whole chain leaves least sure, if it is too unsure to be claimed."""
    sure = []
    for block, f in findings.items():
        for round_ in f.found:
            size = round_[0].hypothesis.starts[0][0].name
            spread = max(sd[size], NUMBER_SD * abs(model.model[size]) if size in model.model else 0.0)
            sure.append((abs(values[size] - _neutral(model, size)) / spread, block, round_))
    worst = min(sure, key=lambda s: s[0], default=None)
    return worst[1:] if worst is not None and worst[0] < SURE else None


def _neutral(model: Model, name: str) -> float:
    """The value at which something found is absent."""
    owner, _, parameter = name.partition(".")
    return CATALOGUE[owner].parameters[parameter].neutral if parameter else model.model[owner]


def _interval(value: float, sd: float, low: float = -math.inf, high: float = math.inf) -> dict[str, float]:
    return {"value": value, "low": max(value - Z95 * sd, low), "high": min(value + Z95 * sd, high)}


def _candidates(findings: Mapping[str, Findings], values: Mapping[str, float], sd: Mapping[str, float],
                torque: Weighed | None, spikes: Weighed | None, scorer: _Scorer, gap_after: float
                ) -> list[dict[str, object]]:
    """Every hypothesis that was weighed, the most probable first; a found one with its intervals of the joint fit."""
    rows: dict[str, dict[str, object]] = {}
    for f in findings.values():
        accepted = {h.name for h in f.effects}
        for round_ in [*f.found, f.rivals]:
            for w in round_:
                h = w.hypothesis
                mine = h.name in accepted
                if h.name in rows and (rows[h.name]["probability"] >= w.probability or mine):  # type: ignore[operator]
                    continue
                if mine and w is not round_[0]:
                    continue
                source, spread = (values, sd) if mine else (w.fit.values, w.fit.sd)
                whole = {**values, **w.fit.values}
                rows[h.name] = {
                    "effect": h.effect, "place": h.place, "probability": w.probability,
                    "parameters": {u.name.rpartition(".")[2]:
                                   _interval(source[u.name], spread[u.name], u.low, u.high) for u in h.starts[0]},
                    "found": mine,
                    "gap_after": gap_after if mine else scorer.of(whole).total if w.probability > 1e-3 else None}
    for extra in (torque, spikes):
        if extra is not None:
            rows[extra.hypothesis.name] = {
                "effect": extra.hypothesis.effect, "place": extra.hypothesis.place, "probability": extra.probability,
                "parameters": {n.partition(".")[2]: _interval(v, extra.fit.sd[n], 0.0)
                               for n, v in extra.fit.values.items()},
                "found": True, "gap_after": gap_after}
    return sorted(rows.values(), key=lambda row: -row["probability"])  # type: ignore[operator]


def _not_separable(findings: Mapping[str, Findings]) -> list[tuple[Weighed, Weighed]]:
    """Pairs that this recording cannot tell apart: the first of a round and rivals nearly as probable."""
    return [(round_[0], w) for f in findings.values() for round_ in [*f.found, f.rivals]
            if round_ and round_[0].probability > UNDECIDED for w in round_[1:]
            if w.probability > UNDECIDED and w.hypothesis.effect != round_[0].hypothesis.effect]


def _next_experiment(model: Model, signals: Signals, pairs: Sequence[tuple[Weighed, Weighed]],
                     values: Mapping[str, float]) -> dict[str, object] | None:
    """The experiment that would tell the closest pair apart; None where nothing is open."""
    if not pairs:
        return None
    first, second = max(pairs, key=lambda pair: pair[1].probability)
    own = {u.name: _neutral(model, u.name) for w in (first, second) for u in w.hypothesis.starts[0]}
    one, other = ({**values, **own, **w.fit.values} for w in (first, second))
    return next_experiment(model, signals, one, other, (first.hypothesis.effect, second.hypothesis.effect))


def _augmented(model: Model, values: Mapping[str, float], torque: Weighed | None, spikes: Weighed | None) -> Model:
    """The model with all that was found, ready for the plant node."""
    extra = {n: v for w in (torque, spikes) if w is not None for n, v in w.fit.values.items()}
    m = with_values(model, {**{n: v for n, v in values.items() if not n.startswith("initial.")}, **extra})
    return Model(f"{model.name}, augmented", m.model, m.sensing, m.effects)
