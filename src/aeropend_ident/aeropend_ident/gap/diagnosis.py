# SPDX-License-Identifier: Apache-2.0
"""The whole diagnosis of one rig: gap, place, effects, numbers, and how far the gap closes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from aeropend_ident.gap import identified, random_torque, shrink, where
from aeropend_ident.gap.chain import BLOCKS, PLACE_OF_NUMBER, Chain, Chains, difference, with_values
from aeropend_ident.gap.experiment import EXPERIMENTS, next_experiment, within
from aeropend_ident.gap.fit import Fit, Unknown, fit
from aeropend_ident.gap.hypotheses import EFFECT_ODDS, Hypothesis
from aeropend_ident.gap.shape import Shape, shapes
from aeropend_ident.gap.signals import CHANNELS, Signals
from aeropend_ident.gap.thrift import ThriftyChains
from aeropend_ident.gap.timing import timed
from aeropend_ident.gap.unknowns import (
    ARM,
    GUESS_SD,
    NUMBER_SD,
    ZERO,
    angle_only,
    basis,
    free_swinging,
    nominal_unknowns,
    number_unknowns,
)
from aeropend_ident.gap.weighing import GOOD_ENOUGH, Weighed
from aeropend_ident.gap.which import Findings, not_strayed, refit, search
from aeropend_sim.effects import CATALOGUE
from aeropend_sim.excitation import Excitation
from aeropend_sim.parameters import MODEL_NAMES, PARAMETERS, Model

Array = NDArray[np.float64]

Z95 = 1.959964
PLAIN = 15.0
"""Log evidence from which on an effect is there in an unknown rig, however unsure its size is."""

SURE = 2.5
"""Standard deviations by which an effect must differ from none, and a number from nominal, after the joint fit."""

WIDER = 1.2
"""Factor on the standard deviations of a fit: its inputs are measured too, and quantisation is not white. From rigs
simulated for the purpose (seeds 11 to 13 of the blind check); intervals are judged on others."""

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

DETERMINED = 0.5
"""Share of a prior's width from which on the data have not fixed a number."""

UNDECIDED = 0.05
"""Probability from which on a rival is not ruled out."""

UNDECIDED_UNKNOWN = 0.01
"""As `UNDECIDED`, of a rival in a rig whose numbers nobody knows: they may stand in for more of an effect."""

FALSE_CAPTURES = 0.02
"""1/s of false speed periods that any rig may show."""


@dataclass(frozen=True)
class Diagnosis:
    """What was found.

    Attributes:
        model: the nominal model, of a rig whose numbers nobody knows the identified one.
        augmented: with refitted numbers and found effects.
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
    if fit_nominal:
        progress("identifying the nominal model", 0.0)
        with threadpool_limits(1):
            model, recordings = identified.identify(model, recordings)
    with threadpool_limits(1):  # the matrices are narrow: threads of the linear algebra only get in each other's way
        chains = ThriftyChains(model, recordings) if fit_nominal else Chains(model, recordings)
        return _diagnose(timed(chains), jobs, progress)


def _diagnose(chains: Chains, jobs: int, progress: Progress) -> Diagnosis:
    model, recordings = chains.model, chains.recordings
    fitted = chains
    if chains.fit_nominal and free_swinging(recordings):  # few swings: what brakes them shows in the last ones too
        chains = Chains(model, [replace(s, train=len(s)) for s in recordings], fit_nominal=True)
    findings = search(chains, jobs, lambda block, share: progress(f"weighing effects of the {block}", 0.7 * share))
    if any(f.cut_short for f in findings.values()):
        said = ("the search was cut short to bound its time: an effect beside the first, or a rival close to it, may "
                "have been missed")
        recordings = [replace(s, notes=(*s.notes, said)) for s in recordings]
    progress("looking for chance", 0.7)
    spikes = _spikes(recordings)
    torque = random_torque.found(chains, findings["arm"])
    misfit, variables = _misfit_signal(chains, findings)
    strange = _strange(chains, findings, torque is not None, bool(spikes))
    progress("fitting the whole chain", 0.75)
    values, sd = _joint(chains, findings)
    while weak := _weakest(model, findings, values, sd, fit_nominal=chains.fit_nominal):
        findings[weak[0]].found.remove(weak[1])
        values, sd = _joint(chains, findings)
    checks = _checks(chains, findings)

    def widened() -> dict[str, float]:
        return _widened(chains, findings, values, sd, {b: c for b, c in checks.items() if b != "arm" or torque is None})

    while chains.fit_nominal and (weak := _least_needed(model, findings, values, widened())):
        f = findings[weak[0]]
        f.found.remove(weak[1])
        f.final = refit(chains, f.block, f.effects, f.final.values)
        values, sd = _joint(chains, findings)
        checks = _checks(chains, findings)
    sd = widened()
    # of an unknown rig the identified numbers, those of each run, are the nominal model
    base_values = {n: v for f in findings.values() for n, v in f.base.values.items()
                   if n.startswith("initial.") or chains.fit_nominal}
    progress("measuring the gap", 0.9)
    judged = values
    if fitted is not chains:
        base_values, judged = (refit(fitted, "arm", effects, start).values for start, effects in (
            (base_values, []), (values, findings["arm"].effects)))
    before = [shrink.free_run(model, s, chains.own(base_values, k)) for k, s in enumerate(recordings)]
    after = [shrink.free_run(model, s, chains.own(judged, k)) for k, s in enumerate(recordings)]
    found = [h for f in findings.values() for h in f.effects]
    scorer = _Scorer(chains, model, recordings, bool(spikes))
    gap_before, gap_after = scorer.gap(before, known=False), scorer.gap(after)
    floors = scorer.floors()
    share, low, high = shrink.closed(gap_before, gap_after, floors)

    unexplained = _unexplained(findings, gap_after, floors)
    if strange is not None and unexplained:
        unexplained = {strange.shape.place: sum(unexplained.values())}
    amounts = _amounts(found, values, scorer, torque, spikes, before, unexplained)
    candidates = _candidates(findings, values, sd, torque, spikes, scorer, gap_after.total)
    reasons = [f"{c} is off by {x:.1f} times a reading's noise"
               for c, x in _left(findings, torque is not None).items() if x > GOOD_ENOUGH]
    parts = where.shares((place, amount) for _, place, amount in amounts)
    ranked = sorted((a for a in amounts if a[0]), key=lambda a: -a[2])
    effects = list(dict.fromkeys(name.partition(":")[0] for name, _, _ in ranked))
    verdict, place = (effects[0], ranked[0][1]) if ranked else ("none", "none")
    if strange is not None and (strange.first or not effects):
        verdict, place = "unknown", strange.shape.place

    undecided = _not_separable(findings, UNDECIDED_UNKNOWN if chains.fit_nominal else UNDECIDED)
    tried = within(max(float(s.duty.max()) for s in recordings)) if chains.fit_nominal else EXPERIMENTS
    augmented = _augmented(model, values, torque, spikes)
    names = [c for c in CHANNELS if c in gap_before.rms]
    body: dict[str, object] = {
        "channels": {c: {"unit": CHANNELS[c], "gap": gap_before.rms[c], "floor": floors[c],
                         "gap_after": gap_after.rms[c]} for c in names},
        "where": {"place": place, "share": parts, "regions": where.regions(misfit, variables)},
        "which": {"verdict": verdict, "effects": effects, "candidates": candidates,
                  "numbers": _numbers(chains, values, sd),
                  "residuals": {channel: {"rms": check.rms[channel], "white": check.white[channel],
                                          "dependence": check.dependence}
                                for check in checks.values() for channel in check.rms},
                  "unexplained": reasons, "unknown": strange.document() if strange is not None else None,
                  "not_separable": [[a.hypothesis.effect, b.hypothesis.effect] for a, b in undecided],
                  "next_experiment": _next_experiment(model, recordings[0], undecided, values, tried)},
        "shrink": {"gap": gap_before.total, "gap_after": gap_after.total, "floor": scorer.bottom(gap_before, floors),
                   "closed": share, "low": low, "high": high},
    }
    if chains.fit_nominal:
        body["identified"] = _identified(chains, values, sd)
        model = with_values(model, identified.shared(base_values))
    progress("done", 1.0)
    return Diagnosis(model, augmented, recordings, before, after, body, {"misfit": misfit, **variables})


@dataclass(frozen=True)
class Strange:
    """Something that the catalogue does not explain: its likeliest shape, and whether it is the largest finding."""

    shape: Shape
    first: bool

    def document(self) -> dict[str, object]:
        """Place and curves, for `diagnosis.json`."""
        return {"place": self.shape.place,
                "curves": [{"variable": c.variable, "unit": c.unit, "at": c.knot.tolist(), "value": c.value.tolist()}
                           for c in self.shape.curves]}


def _strange(chains: Chains, findings: Mapping[str, Findings], torque: bool, spikes: bool) -> Strange | None:
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
    captures = _false_captures(chains) if spikes else 0.0

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
        simpler = several and shape.left < _mean_square(f.final)
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
    return Strange(shaped[worst], sum(m.amount for m in base[worst].values()) > explained)


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


def _false_captures(chains: Chains) -> float:
    """Squared gap that false captures make in the speed, in units of its spread squared."""
    gaps = [float(np.nanmean((c.signals.omega - c.speed) ** 2)) / max(float(np.nanvar(c.speed)), 1e-12)
            for c in chains.each if c.signals.has("omega")]
    return float(np.mean(gaps))


def _misfit(chains: Chains, channel: str, r: Array) -> Misfit:
    name, _, k = channel.partition("@")
    s = chains.each[int(k or 0)].signals
    noise = float(np.sqrt(np.mean(s.pulses.sigma**2))) if name == "omega" and s.pulses else s.sigma[name]
    unseen = GOOD_ENOUGH**2 if chains.fit_nominal else NOTICEABLE  # the noise too is only what the recording shows
    return Misfit(float(np.mean(r * r)), noise, max(float(np.nanstd(s.channel(name))), noise), len(r), unseen)


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
        # a false period takes a pulse: while the rotor stands there is none
        time += float(s.pulses.period[s.pulses.index < s.train].sum()) if s.pulses else s.train * s.period
    if count < 3:
        return None
    expected = FALSE_CAPTURES * time
    gain = count * math.log(count / expected) - (count - expected) + math.log(EFFECT_ODDS)
    if gain < 0.0:
        return None
    name = "speed_spikes.rate"
    rate, sd = count / time, math.sqrt(count) / time
    return Weighed(Hypothesis("speed_spikes"), Fit({name: rate}, {name: sd}, {}, {}, {}, 0.0, {}), gain,
                   1.0 / (1.0 + math.exp(-min(gain, 500.0))))


def _misfit_signal(chains: Chains, findings: Mapping[str, Findings]) -> tuple[Array, dict[str, Array]]:
    """What the part that explains least leaves of its signal, and what regions may be drawn in, each (M,)."""
    block = max(BLOCKS, key=lambda b: _misfit_of(findings[b].base))
    chain, arm = chains.each[0], findings["arm"]
    s = chain.signals
    if block == "actuator":
        misfit, index = s.v_a - chain.actuator(chains.own(arm.final.values, 0)), np.arange(len(s))
    elif block == "motor":
        misfit = s.i_a - chain.motor(chains.own(findings["motor"].base.values, 0))[0]
        index = np.arange(len(s))
    else:
        g = random_torque.tracked(chains, arm.final, arm.base)
        misfit, index = g.torque, g.index
    theta = random_torque.angle(chains, s)
    rate = np.gradient(random_torque.calm(theta), s.period)
    seen = theta if chains.fit_nominal else s.theta
    variables: dict[str, Array] = {"theta": seen[index], "theta_dot": rate[index], "omega": chain.speed[index],
                 "i_a": s.i_a[index], "duty": s.duty[index], "t": np.asarray(index * s.period, dtype=float)}
    return misfit[: len(index)], variables


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
        for u in nominal_unknowns(chains, block):
            unknowns[u.name] = u
        for h in f.effects:
            unknowns.update({u.name: u for u in h.starts[0]})
        start.update(f.final.values)

    def residuals(chain: Chain, values: Mapping[str, float]) -> dict[str, Array]:
        s = chain.signals.head(chain.signals.train)
        readings = shrink.free_run(chains.model, s, values)
        out: dict[str, Array] = {}
        for channel in ("theta", "i_a", "v_a"):
            part = slice(s.after_unseen if channel == "v_a" else 0, None)
            out[channel] = difference(s.channel(channel)[part], readings[channel][part]) / s.sigma[channel]
        p = s.pulses
        if p is not None:
            use = p.index[~p.false]
            out["omega"] = (s.omega[use] - readings["omega"][use]) / p.sigma[~p.false]
        elif s.has("omega"):
            out["omega"] = difference(s.true_speed, readings["omega"]) / s.sigma["omega"]
        return out

    begun = [Unknown(u.name, u.mean, u.sd, u.low, u.high, start.get(u.name, u.start), u.log)
             for u in unknowns.values()]
    joint = fit(chains.joined(residuals), begun)
    return joint.values, {name: WIDER * sd for name, sd in joint.sd.items()}


@dataclass(frozen=True)
class Check:
    """Tests of what the final fit of a part of the chain leaves.

    Attributes:
        rms: channel -> RMS in units of a reading's noise. white: channel -> share of its samples that are independent.
        dependence: share of the mean square that curves over inputs and states explain, beyond chance.
        form: what that is relative to what was explained: by so much the found may be off, relative to its size.
    """

    rms: dict[str, float]
    white: dict[str, float]
    dependence: float
    form: float


def _checks(chains: Chains, findings: Mapping[str, Findings]) -> dict[str, Check]:
    """Test the residuals of each part for whiteness and for independence of inputs and states."""
    checks = {}
    for block, f in findings.items():
        if not f.final.residuals:
            continue
        own = {u.name for h in f.effects for u in h.starts[0]}
        known = [u for u in nominal_unknowns(chains, block) if u.name in f.final.values and u.name not in own]
        best = shapes(chains, block, f.final, known)[0]
        left = best.explained
        form = math.sqrt(left / max(_mean_square(f.base) - best.left, left, 1e-12))
        rms = {c: float(np.sqrt(np.mean(r * r))) for c, r in f.final.residuals.items()}
        white = {c: f.final.independent[c] / len(r) for c, r in f.final.residuals.items()}
        checks[block] = Check(rms, white, left / best.before if best.before > 0.0 else 0.0, form)
    return checks


def _widened(chains: Chains, findings: Mapping[str, Findings], values: Mapping[str, float], sd: Mapping[str, float],
             checks: Mapping[str, Check]) -> dict[str, float]:
    """Standard deviations with what the form of an effect leaves in doubt.

    A real effect that is not quite of the catalogue's form leaves something that curves at some place still explain.
    What it may have moved the effect's parameters by is of the size of what is left, relative to what was explained.
    """
    wider = dict(sd)
    for block, check in checks.items():
        for name in {u.name for h in findings[block].effects for u in h.starts[0]}:
            wider[name] = math.hypot(sd[name], check.form * (values[name] - _neutral(chains.model, name)))
    return wider


def _mean_square(f: Fit) -> float:
    """Mean square residual over all channels, in units of a reading's noise."""
    return float(np.mean(np.concatenate(list(f.residuals.values())) ** 2))


def _weakest(model: Model, findings: Mapping[str, Findings], values: Mapping[str, float], sd: Mapping[str, float], *,
             fit_nominal: bool = False) -> tuple[str, list[Weighed]] | None:
    """The finding (block, round) whose size the whole chain leaves least sure, if it is too unsure to be claimed."""
    sure = []
    for block, f in findings.items():
        for round_ in f.found:
            if fit_nominal and round_[0].gain > PLAIN:
                continue  # what it does is sure, only not how much of it another of its parameters or a number does
            size = round_[0].hypothesis.starts[0][0].name
            spread = max(sd[size], NUMBER_SD * abs(model.model[size]) if size in model.model else 0.0)
            sure.append((abs(values[size] - _neutral(model, size)) / spread, block, round_))
    worst = min(sure, key=lambda s: s[0], default=None)
    return worst[1:] if worst is not None and worst[0] < SURE else None


def _least_needed(model: Model, findings: Mapping[str, Findings], values: Mapping[str, float], sd: Mapping[str, float]
                  ) -> tuple[str, list[Weighed]] | None:
    """The finding besides the main one whose size may as well be none, given what the form of all leaves in doubt."""
    rounds = [(block, round_) for block, f in findings.items() for round_ in f.found]
    main = max((round_[0].gain for _, round_ in rounds), default=0.0)
    sure = []
    for block, round_ in rounds:
        size = round_[0].hypothesis.starts[0][0].name
        if round_[0].gain < main:
            sure.append((abs(values[size] - _neutral(model, size)) / max(sd[size], 1e-300), block, round_))
    least = min(sure, key=lambda s: s[0], default=None)
    return least[1:] if least is not None and least[0] < Z95 else None


def _neutral(model: Model, name: str) -> float:
    """The value at which something found is absent."""
    owner, _, parameter = name.partition(".")
    return CATALOGUE[owner].parameters[parameter].neutral if parameter else model.model[owner]


def _interval(value: float, sd: float, low: float = -math.inf, high: float = math.inf) -> dict[str, float]:
    return {"value": value, "low": max(value - Z95 * sd, low), "high": min(value + Z95 * sd, high)}


def _numbers(chains: Chains, values: Mapping[str, float], sd: Mapping[str, float]) -> dict[str, dict[str, object]]:
    """The model's numbers that were refitted; of an unknown rig all, with what the recordings cannot fix marked so."""
    nominal = chains.model.model
    if not chains.fit_nominal:
        return {n: {"nominal": nominal[n], **_interval(values[n], sd[n])} for n in MODEL_NAMES if n in values}
    fitted = {u.name: u for block in BLOCKS for u in number_unknowns(chains, block)}
    alone = angle_only(chains.recordings)
    rows: dict[str, dict[str, object]] = {}
    for n in MODEL_NAMES:
        p = PARAMETERS[f"model.{n}"]
        u = fitted.get(n, Unknown(n, nominal[n], GUESS_SD, p.low, p.high, log=nominal[n] > 0.0))
        # of a curve from duty to lift that only acts as a whole no single number is known
        known = n in fitted and (n in ARM or not alone)
        value = values.get(n, nominal[n])
        spread = sd[n] if known else GUESS_SD * abs(value)
        prior = u.sd * (value if u.log else 1.0)
        if u.log and value > 0.0:
            reach = math.exp(Z95 * spread / value)
            between = {"value": value, "low": max(value / reach, p.low), "high": min(value * reach, p.high)}
        else:
            between = _interval(value, spread, u.low, u.high)
        rows[n] = {"nominal": nominal[n], **between, "determined": known and spread < DETERMINED * prior}
        runs = [n, *(f"{n}@{k}" for k in range(1, len(chains.each)))]
        if known and len(runs) > 1 and runs[-1] in values:
            rows[n] |= _over_runs([values[r] for r in runs], [sd[r] for r in runs])
    return rows


def _over_runs(values: Sequence[float], sd: Sequence[float]) -> dict[str, object]:
    """A number that each run has its own of: mean, values, and how much more they scatter than they are unsure."""
    spread = math.sqrt(max(float(np.var(values, ddof=1)) - float(np.mean(np.square(sd))), 0.0))
    mean, unsure = float(np.mean(values)), math.sqrt(float(np.var(values, ddof=1)) / len(values))
    unsure = max(unsure, math.sqrt(float(np.sum(np.square(sd)))) / len(sd))
    return {**_interval(mean, unsure), "runs": [_interval(v, s) for v, s in zip(values, sd, strict=True)],
            "run_to_run": spread}


def _identified(chains: Chains, values: Mapping[str, float], sd: Mapping[str, float]) -> dict[str, object]:
    """What the nominal model of an unknown rig was identified from, and what of it stays open."""
    recordings = chains.recordings
    numbers = _numbers(chains, values, sd)
    said: dict[str, object] = {"from": basis(recordings),
                               "not_determined": [n for n, row in numbers.items() if not row["determined"]]}
    if "k3" in values and angle_only(recordings):
        said["lift"] = identified.lift(with_values(chains.model, chains.own(values, 0)), recordings)
    if ZERO in values:
        said["hangs_at"] = _interval(values[ZERO], sd[ZERO])
    return said


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


def _not_separable(findings: Mapping[str, Findings], least: float = UNDECIDED) -> list[tuple[Weighed, Weighed]]:
    """Pairs that this recording cannot tell apart: the first of a round and rivals of `least` probability."""
    return [(round_[0], w) for f in findings.values() for round_ in [*f.found, f.rivals]
            if round_ and round_[0].probability > UNDECIDED for w in round_[1:]
            if w.probability > least and w.hypothesis.effect != round_[0].hypothesis.effect]


def _next_experiment(model: Model, signals: Signals, pairs: Sequence[tuple[Weighed, Weighed]],
                     values: Mapping[str, float], tried: Sequence[Excitation]) -> dict[str, object] | None:
    """The experiment that would tell the closest pair apart; None where nothing is open."""
    if not pairs:
        return None
    if not signals.driven:
        return {"why": "let the arm go from higher and record until it rests: what brakes it shows in how its swings "
                       "shrink; drive it and record the command as well to tell more", "excite": {}}
    first, second = max(pairs, key=lambda pair: pair[1].probability)
    own = {u.name: _neutral(model, u.name) for w in (first, second) for u in w.hypothesis.starts[0]}
    one, other = ({**values, **own, **w.fit.values} for w in (first, second))
    if any("@" in n for n in values):
        one, other = identified.shared(one), identified.shared(other)
    return next_experiment(model, signals, one, other, (first.hypothesis.effect, second.hypothesis.effect), tried)


def _augmented(model: Model, values: Mapping[str, float], torque: Weighed | None, spikes: Weighed | None) -> Model:
    """The model with all that was found, ready for the plant node."""
    extra = {n: v for w in (torque, spikes) if w is not None for n, v in w.fit.values.items()}
    m = with_values(model, {**identified.shared(values), **extra})
    return Model(f"{model.name}, augmented", m.model, m.sensing, m.effects)
