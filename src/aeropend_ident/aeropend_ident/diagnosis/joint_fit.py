# SPDX-License-Identifier: Apache-2.0
"""Everything found and every number fitted together on the whole chain, and how sure each then is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis import free_run_gap
from aeropend_ident.diagnosis.chain.chain import Chain, Chains, difference
from aeropend_ident.diagnosis.chain.priors import NUMBER_SD, nominal_unknowns
from aeropend_ident.diagnosis.search.free_curves import shapes
from aeropend_ident.diagnosis.search.search import Findings, refit
from aeropend_ident.diagnosis.search.selection import Weighed
from aeropend_ident.estimation.map_fit import Unknown, fit
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import Model

Array = NDArray[np.float64]

Z95 = 1.959964

PLAIN = 15.0
"""Log evidence from which on an effect is there in an unknown rig, however unsure its size is."""

SURE = 2.5
"""Standard deviations by which an effect must differ from none, and a number from nominal, after the joint fit."""

WIDER = 1.2
"""Factor on the standard deviations of a fit: its inputs are measured too, and quantisation is not white. From rigs
simulated for the purpose (seeds 11 to 13 of the blind check); intervals are judged on others."""


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


@dataclass(frozen=True)
class Joint:
    """What all recordings say of everything found.

    Attributes:
        values, sd: name -> estimate, standard deviation with what the form of an effect leaves in doubt.
        checks: part of the chain -> tests of what is left of it.
    """

    values: dict[str, float]
    sd: dict[str, float]
    checks: dict[str, Check]


def settle(chains: Chains, findings: Mapping[str, Findings], random: bool) -> Joint:
    """Fit all together until each effect that is left is sure enough to be claimed; others leave `findings`.

    Args:
        chains, findings: the cut chains, and what was found in each part.
        random: the arm is moved by a random torque too: what it leaves does not speak against the form of an effect.
    """
    model = chains.model
    values, sd = _fitted(chains, findings)
    while weak := _weakest(model, findings, values, sd, fit_nominal=chains.fit_nominal):
        findings[weak[0]].found.remove(weak[1])
        values, sd = _fitted(chains, findings)
    checks = _checks(chains, findings)

    def widened() -> dict[str, float]:
        formed = {b: c for b, c in checks.items() if b != "arm" or not random}
        return _widened(chains, findings, values, sd, formed)

    while chains.fit_nominal and (weak := _least_needed(model, findings, values, widened())):
        f = findings[weak[0]]
        f.found.remove(weak[1])
        f.final = refit(chains, f.block, f.effects, f.final.values)
        values, sd = _fitted(chains, findings)
        checks = _checks(chains, findings)
    return Joint(values, widened(), checks)


def _fitted(chains: Chains, findings: Mapping[str, Findings]) -> tuple[dict[str, float], dict[str, float]]:
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
        readings = free_run_gap.free_run(chains.model, s, values)
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
        form = math.sqrt(left / max(f.base.mean_square - best.left, left, 1e-12))
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
            wider[name] = math.hypot(sd[name], check.form * (values[name] - neutral(chains.model, name)))
    return wider


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
            sure.append((abs(values[size] - neutral(model, size)) / spread, block, round_))
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
            sure.append((abs(values[size] - neutral(model, size)) / max(sd[size], 1e-300), block, round_))
    least = min(sure, key=lambda s: s[0], default=None)
    return least[1:] if least is not None and least[0] < Z95 else None


def neutral(model: Model, name: str) -> float:
    """The value at which something found is absent."""
    owner, _, parameter = name.partition(".")
    return CATALOGUE[owner].parameters[parameter].neutral if parameter else model.model[owner]
