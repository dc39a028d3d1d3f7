# SPDX-License-Identifier: Apache-2.0
"""Formulas in place of a learned term: those proposed are fitted to the recordings as effects like any other."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.priors import nominal_parameters
from aeropend_ident.diagnosis.search.learned_term import Curve, Learned, quantity
from aeropend_ident.diagnosis.search.proposed_formula import Proposal, definition, propose
from aeropend_ident.estimation.map_fit import Fit, fit
from aeropend_ident.estimation.parallel import parallel
from aeropend_ident.estimation.parameter import Parameter, started
from aeropend_sim.model import effect_file
from aeropend_sim.model.effects import DEFINED
from aeropend_sim.model.formula import QUANTITIES

Array = NDArray[np.float64]

AS_MUCH = 1.05
"""Ratio of mean squares up to which two formulas leave as much (choice: a twentieth of the noise is no reason)."""

TRIED = 5
"""Proposals that are fitted to the recordings (choice: each takes about a second)."""

THIN = 10
"""One sample in so many is used for proposals (choice: neighbours hardly differ)."""

COMPOSED = "u"
"""Name that a quantity has in proposals which is a formula itself."""


@dataclass(frozen=True)
class FittedFormula:
    """A formula in place of a learned term, fitted to the stage.

    Attributes:
        id: of the effect; its estimates are its defaults.
        values: name -> estimate, of everything in the stage.
        fit: of the stage.
    """

    id: str
    values: dict[str, float]
    fit: Fit


def fitted_formulas(chains: CutChains, learned: Learned, values: Mapping[str, float], sd: Mapping[str, float],
                    jobs: int) -> list[FittedFormula]:
    """Formulas for a learned term: those that leave least first, and of these the shortest.

    Args:
        chains: cut.
        learned: the term.
        values: of the joint fit, with the term.
        sd: their standard deviations.
        jobs: processes.
    """
    proposals = _proposals(chains, learned, values, sd)[:TRIED]
    fitted = parallel(jobs, lambda p: _fitted(chains, learned, p, values), proposals)
    found = [_known(f, tree, learned.place) for f, tree in zip(fitted, proposals, strict=True) if f is not None]
    least = min((f.fit.mean_square for f in found), default=0.0)

    def rank(f: FittedFormula) -> tuple[int, float]:
        alike = f.fit.mean_square <= AS_MUCH * least
        return (0, len(DEFINED[f.id].parameters)) if alike else (1, f.fit.mean_square)

    return sorted(found, key=rank)


def _proposals(chains: CutChains, learned: Learned, values: Mapping[str, float], sd: Mapping[str, float]
               ) -> list[dict[str, object]]:
    """Definitions of formulas that are like the learned curves."""
    forms = [c.form for c in learned.curves]
    quantities = {_name(f.of): f for f in forms}  # two curves may be of one: itself, and times a factor
    names = dict.fromkeys(n for f in forms for n in (_name(f.of), f.factor) if n)
    units = {n: QUANTITIES[n] if n in QUANTITIES else next(f.unit for f in forms if _name(f.of) == n) for n in names}
    variables: dict[str, list[Array]] = {n: [] for n in names}
    target: list[Array] = []
    unsure: list[Array] = []
    for k, chain in enumerate(chains.each):
        own = chains.values_of(values, k)
        use = slice(0, chain.signals.train, THIN)
        tau = own.get(f"{learned.id}.tau", 1.0)
        for n, form in quantities.items():
            variables[n].append(quantity(chain, replace(form, tau=tau), own)[use])
        for factor in {f.factor for f in forms if f.factor} - quantities.keys():
            variables[factor].append(quantity(chain, replace(forms[0], of=factor, rate=""), own)[use])
        parts = [_along(c, learned, variables, own, sd) for c in learned.curves]
        target.append(sum((part for part, _ in parts), np.zeros(len(parts[0][0]))))
        unsure.append(np.sqrt(sum((s**2 for _, s in parts), np.zeros(len(parts[0][0])))))
    joined = {n: np.concatenate(x) for n, x in variables.items()}
    knots = {n: np.concatenate([c.knot for c in learned.curves if _name(c.form.of) == n]) for n in quantities}
    place, reading = forms[0].place, forms[0].reading
    unit = effect_file.unit_of(place, reading)
    found = propose(joined, units, np.concatenate(target), np.concatenate(unsure), unit, knots=knots)
    return [_with_memory(definition(_composed(p, learned), place, reading), learned, values) for p in found]


def _name(of: str) -> str:
    return of if of in QUANTITIES or of == "z" else COMPOSED


def _along(c: Curve, learned: Learned, variables: Mapping[str, list[Array]], own: Mapping[str, float],
           sd: Mapping[str, float]) -> tuple[Array, Array]:
    """A curve and its standard deviation along the last recording."""
    x = variables[_name(c.form.of)][-1]
    factor = variables[c.form.factor][-1] if c.form.factor else np.ones(len(x))
    spread = [sd.get(f"{learned.id}.{name}", 0.0) for name in c.names]
    return factor * np.interp(x, c.knot, learned.values_of(c, own)), np.abs(factor) * np.interp(x, c.knot, spread)


def _composed(p: Proposal, learned: Learned) -> Proposal:
    """The proposal with what a composed quantity stands for."""
    of = next((c.form.of for c in learned.curves if _name(c.form.of) == COMPOSED), "")
    return replace(p, term=re.sub(rf"\b{COMPOSED}\b", f"({of})", p.term)) if of else p


def _with_memory(tree: dict[str, object], learned: Learned, values: Mapping[str, float]) -> dict[str, object]:
    """The definition with the memory of the learned term."""
    form = next((c.form for c in learned.curves if c.form.rate), None)
    if form is None or not re.search(r"\bz\b", str(tree["term"])):
        return tree
    tau, parameters = values[f"{learned.id}.tau"], dict(tree["parameters"])  # type: ignore[call-overload]
    parameters["tau"] = {"unit": "s", "default": tau, "low": 0.1 * tau, "high": 10.0 * tau,
                         "description": "time constant of the memory"}
    return {**tree, "memory": {"name": "z", "unit": form.unit, "rate": form.rate}, "parameters": parameters}


def _fitted(chains: CutChains, learned: Learned, tree: dict[str, object], values: Mapping[str, float]
            ) -> FittedFormula | None:
    """Fit a formula in place of the learned term, under an id that is forgotten; None if nothing of it is left."""
    id_ = _defined(tree, learned.place)
    findings, effect = learned.without, DEFINED[id_]
    known = [*nominal_parameters(chains, findings.stage), *(p for h in findings.effects for p in h.own)]
    own = [_parameter(f"{id_}.{n}", p.default, p.low, p.high) for n, p in effect.parameters.items()]
    residuals = chains.residuals(findings.stage)
    found = fit(residuals, [*started(known, values), *own], least_ess=chains.policy.least_ess)
    effect_file.forget(id_)
    size = effect.parameters[effect.size]
    if min(max(found.values[f"{id_}.{effect.size}"], size.low), size.high) == size.neutral:
        return None
    return FittedFormula(id_, found.values, found)


def _known(f: FittedFormula, tree: dict[str, object], place: str) -> FittedFormula:
    """Make a fitted formula known, with its estimates as defaults."""
    parameters = {n: {**old, "default": min(max(f.values[f"{f.id}.{n}"], old["low"]), old["high"])}
                  for n, old in tree["parameters"].items()}  # type: ignore[attr-defined]
    final = _defined({**tree, "parameters": parameters}, place)
    return FittedFormula(final, {n.replace(f"{f.id}.", f"{final}."): v for n, v in f.values.items()}, f.fit)


def _defined(tree: dict[str, object], place: str) -> str:
    """Make a formula known; returns its id, which no other one has."""
    id_ = f"formula_{place}_{hashlib.blake2b(repr(tree).encode(), digest_size=3).hexdigest()}"
    effect_file.define({id_: tree}, "a proposal")
    return id_


def _parameter(name: str, start: float, low: float, high: float) -> Parameter:
    """A constant of a proposal: it is about right."""
    sd = 0.5 * max(abs(start), 0.1 * (high - low))
    return Parameter(name, start, sd, low, high)
