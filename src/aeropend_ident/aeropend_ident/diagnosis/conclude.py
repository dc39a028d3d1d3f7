# SPDX-License-Identifier: Apache-2.0
"""What `diagnosis.json` tells of a diagnosis: numbers, candidates, close pairs and the next experiment."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from aeropend_ident.diagnosis import experiment_design
from aeropend_ident.diagnosis.chain import nominal_fit
from aeropend_ident.diagnosis.chain.chain import BLOCKS, Chains, of_recording, with_values
from aeropend_ident.diagnosis.chain.priors import ARM, GUESS_SD, ZERO, angle_only, basis, number_unknowns
from aeropend_ident.diagnosis.free_run_gap import Scorer
from aeropend_ident.diagnosis.joint_fit import Z95, neutral
from aeropend_ident.diagnosis.search.search import Findings
from aeropend_ident.diagnosis.search.selection import Weighed
from aeropend_ident.estimation.map_fit import Unknown
from aeropend_ident.signals.signals import Signals
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import MODEL_NAMES, PARAMETERS, Model

DETERMINED = 0.5
"""Share of a prior's width from which on the data have not fixed a number."""

UNDECIDED = 0.05
"""Probability from which on a rival is not ruled out."""

UNDECIDED_UNKNOWN = 0.01
"""As `UNDECIDED`, of a rival in a rig whose numbers nobody knows: they may stand in for more of an effect."""


def numbers(chains: Chains, values: Mapping[str, float], sd: Mapping[str, float]) -> dict[str, dict[str, object]]:
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
        if known:
            rows[n] |= _over_runs(n, values, sd)
    return rows


def _over_runs(name: str, of_all: Mapping[str, float], sd_of_all: Mapping[str, float]) -> dict[str, object]:
    """A number, if each run has its own: mean, values, and how much more they scatter than they are unsure."""
    runs = sorted((n for n in of_all if of_recording(n)[0] == name), key=lambda n: of_recording(n)[1])
    if len(runs) < 2:
        return {}
    values, sd = [of_all[r] for r in runs], [sd_of_all[r] for r in runs]
    spread = math.sqrt(max(float(np.var(values, ddof=1)) - float(np.mean(np.square(sd))), 0.0))
    mean, unsure = float(np.mean(values)), math.sqrt(float(np.var(values, ddof=1)) / len(values))
    unsure = max(unsure, math.sqrt(float(np.sum(np.square(sd)))) / len(sd))
    return {**_interval(mean, unsure), "runs": [_interval(v, s) for v, s in zip(values, sd, strict=True)],
            "run_to_run": spread}


def identified_model(chains: Chains, values: Mapping[str, float], sd: Mapping[str, float],
                     rows: Mapping[str, Mapping[str, object]]) -> dict[str, object]:
    """What the nominal model of an unknown rig was identified from, and what of it (`rows`: `numbers`) stays open."""
    recordings = chains.recordings
    said: dict[str, object] = {"from": basis(recordings),
                               "not_determined": [n for n, row in rows.items() if not row["determined"]]}
    if "k3" in values and angle_only(recordings):
        said["lift"] = nominal_fit.lift(with_values(chains.model, chains.own(values, 0)), recordings)
    if ZERO in values:
        said["hangs_at"] = _interval(values[ZERO], sd[ZERO]) | _over_runs(ZERO, values, sd)
    return said


def candidates(findings: Mapping[str, Findings], values: Mapping[str, float], sd: Mapping[str, float],
               torque: Weighed | None, spikes: Weighed | None, scorer: Scorer, gap_after: float
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


def not_separable(findings: Mapping[str, Findings], least: float = UNDECIDED) -> list[tuple[Weighed, Weighed]]:
    """Pairs that this recording cannot tell apart: the first of a round and rivals of `least` probability."""
    return [(round_[0], w) for f in findings.values() for round_ in [*f.found, f.rivals]
            if round_ and round_[0].probability > UNDECIDED for w in round_[1:]
            if w.probability > least]


def names(first: Weighed, second: Weighed) -> tuple[str, str]:
    """What two rivals are called: their effects, or, of two numbers that may be off, `parameter_mismatch:NUMBER`."""
    a, b = first.hypothesis, second.hypothesis
    return (a.effect, b.effect) if a.effect != b.effect else (a.name, b.name)


def next_experiment(model: Model, signals: Signals, pairs: Sequence[tuple[Weighed, Weighed]],
                    values: Mapping[str, float], tried: Sequence[Excitation]) -> dict[str, object] | None:
    """The experiment that would tell the closest pair apart; None where nothing is open."""
    if not pairs:
        return None
    if not signals.driven:
        return {"why": "let the arm go from higher and record until it rests: what brakes it shows in how its swings "
                       "shrink; drive it and record the command as well to tell more", "excite": {}}
    first, second = max(pairs, key=lambda pair: pair[1].probability)
    own = {u.name: neutral(model, u.name) for w in (first, second) for u in w.hypothesis.starts[0]}
    one, other = ({**values, **own, **w.fit.values} for w in (first, second))
    if any("@" in n for n in values):
        one, other = nominal_fit.shared(one), nominal_fit.shared(other)
    return experiment_design.next_experiment(model, signals, one, other, names(first, second), tried)


def _interval(value: float, sd: float, low: float = -math.inf, high: float = math.inf) -> dict[str, float]:
    return {"value": value, "low": max(value - Z95 * sd, low), "high": min(value + Z95 * sd, high)}
