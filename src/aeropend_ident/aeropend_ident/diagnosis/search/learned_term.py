# SPDX-License-Identifier: Apache-2.0
"""The learned term: what no effect of the catalogue explains, as smooth curves that the plant can run.

The term is a sum of curves at one place of the chain, each of one quantity, some times a second quantity. Places and
curves are chosen by cross-validation over blocks of time, with all that is linear: the response of the readings to each
point of each curve is simulated, and so is that to the parameters of the model. Then all points are fitted together
with the parameters (MAP estimate with a smooth prior). The result is an effect by formula like any other.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from aeropend_ident.diagnosis.chain.chain import CutChain, CutChains
from aeropend_ident.diagnosis.chain.priors import nominal_parameters
from aeropend_ident.diagnosis.chain.values import stage_at
from aeropend_ident.diagnosis.policy import GOOD_ENOUGH
from aeropend_ident.diagnosis.search.findings import Findings, RankedHypothesis
from aeropend_ident.diagnosis.search.free_curves import FOLDS, MOST_SAMPLES, knots_of
from aeropend_ident.diagnosis.search.hypotheses import Hypothesis
from aeropend_ident.estimation.levenberg_marquardt import Search
from aeropend_ident.estimation.map_fit import Fit, fit, largest_ess
from aeropend_ident.estimation.parallel import parallel
from aeropend_ident.estimation.parameter import Parameter, key, started
from aeropend_ident.estimation.residuals import finite
from aeropend_sim.model import actuator, effect_file
from aeropend_sim.model.terms import along

Array = NDArray[np.float64]

POINTS = 16
"""Points of a curve, at quantiles of its quantity (choice: more than a picture needs, as the plant runs it)."""

MOST_CURVES = 3
"""Curves of a term (choice: a person has to understand it)."""

STIFFNESSES = (1e-4, 1e-3, 1e-2, 0.1, 1.0)
"""Weights of the bends of curves, per reading, of which cross-validation chooses one (choice: free to straight)."""

RIDGE = 1e-6
"""The same for the size of curves (choice: it only decides what no data decide)."""

WORTH = 0.05
"""Share of what is left that a further curve must explain of blocks it was not fitted to (choice)."""

ABOUT = 3.0
"""Ratio of what curves leave at two places up to which both are fitted (choice: far from the fit a line is rough)."""

SMOOTH = 1.5
"""Points over which the prior of a curve is correlated (choice: a curve bends, but not at each point)."""

WIDE = 3.0
"""Standard deviation of that prior, over the RMS of the linear solution (choice)."""

REACH = 30.0
"""Bounds of a point, in standard deviations of its prior (choice: out of the way)."""

FIXED = 1e-6
"""Standard deviation of the gain of the term, which is 1: its points have the size (choice: it does not move)."""

ALIKE = 1.0
"""Difference of log evidence up to which the stage hardly tells two places apart (derived: odds of e to 1).

For the stage of the actuator an error of the voltage's reading is one of the voltage; all stages together tell them
apart."""

SURE = 1e6
"""Log evidence of a term that is needed in any case (choice: far above any, the verdict is `unknown` already)."""

NAME = "learned"
"""The beginning of the id of a learned term."""


@dataclass(frozen=True)
class Form:
    """A curve before it has points.

    Attributes:
        place: of the chain.
        of: the quantity that it depends on, as a formula.
        unit: of that quantity.
        value_unit: of its values.
        factor: formula that its value is multiplied by; "" for none.
        rate: formula of the derivative of the memory z that `of` uses, with the time constant tau; "" for none.
        tau: [s] where the search of that time constant starts.
        reading: that it is an error of, at place sensing.
    """

    place: str
    of: str
    unit: str
    value_unit: str
    factor: str = ""
    rate: str = ""
    tau: float = 0.0
    reading: str = ""


def _relaxing(form: Form, times: Sequence[float]) -> list[Form]:
    """A form with a memory, at several time constants."""
    return [replace(form, tau=tau) for tau in times]


FORMS = {
    "actuator": [Form("actuator", "v", "V", "V"), Form("actuator", "i_a", "A", "V"),
                 Form("sensing", "v", "V", "V", reading="v_a")],
    "motor": [Form("electrical", "i_a", "A", "V"), Form("electrical", "omega", "rad/s", "V"),
              Form("electrical", "omega", "rad/s", "Ω", "i_a"), Form("rotor", "omega", "rad/s", "N·m"),
              Form("rotor", "i_a", "A", "N·m"), Form("sensing", "i_a", "A", "A", reading="i_a"),
              *_relaxing(Form("electrical", "z", "A", "Ω", "i_a", "(i_a - z) / tau"), (3.0, 30.0))],
    "arm": [Form("thrust", "omega", "rad/s", "N"), Form("thrust", "theta", "rad", "-", "thrust"),
            Form("thrust", "theta_dot", "rad/s", "-", "thrust"), Form("arm", "theta", "rad", "rad/s²"),
            Form("arm", "theta_dot", "rad/s", "rad/s²"), Form("arm", "theta", "rad", "1/s", "theta_dot"),
            Form("sensing", "theta", "rad", "rad", reading="theta"),
            Form("sensing", "theta_dot", "rad/s", "rad", reading="theta"),
            *_relaxing(Form("thrust", "omega - z", "rad/s", "N", "", "(omega - z) / tau"), (0.1, 0.5, 2.0)),
            *_relaxing(Form("arm", "z", "rad", "rad/s²", "", "theta_dot - z / tau"), (0.1, 0.5, 2.0))],
}
"""Stage of the chain -> the curves that may be missing in it."""


@dataclass(frozen=True)
class Curve:
    """A curve with its points.

    Attributes:
        form: of the curve.
        knot: (K,) values of its quantity.
        letter: the beginning of the names of its values.
    """

    form: Form
    knot: Array
    letter: str = "a"

    @property
    def names(self) -> list[str]:
        """The names of its values."""
        return [f"{self.letter}{k + 1}" for k in range(len(self.knot))]

    @property
    def text(self) -> str:
        """It as a formula."""
        points = ", ".join(f"{x:.6g}, {name}" for x, name in zip(self.knot.tolist(), self.names, strict=True))
        return f"{self.form.factor}{' * ' * bool(self.form.factor)}table({self.form.of}, {points})"


def definition(curves: Sequence[Curve]) -> dict[str, object]:
    """The effect by formula that is the sum of curves at one place."""
    first = curves[0].form
    parameters: dict[str, object] = {
        "gain": {"unit": "-", "neutral": 0.0, "default": 1.0, "low": 0.0, "high": 2.0, "description": "1: as learned"}}
    tree: dict[str, object] = {"place": first.place, "physics": "a term that was learned from recordings"}
    if memory := next((c.form for c in curves if c.form.rate), None):
        tree["memory"] = {"name": "z", "unit": memory.unit, "rate": memory.rate}
        parameters["tau"] = {"unit": "s", "default": memory.tau, "low": 0.02 * memory.tau, "high": 50.0 * memory.tau,
                             "description": "time constant of the memory"}
    for c in curves:
        for name, x in zip(c.names, c.knot.tolist(), strict=True):
            parameters[name] = {"unit": c.form.value_unit, "default": 0.0, "low": -1e9, "high": 1e9,
                                "description": f"at {c.form.of} = {x:.4g} {c.form.unit}"}
    if first.reading:
        tree["reading"] = first.reading
    return {**tree, "term": f"gain * ({' + '.join(c.text for c in curves)})", "parameters": parameters}


def id_of(curves: Sequence[Curve]) -> str:
    """The id of a learned term, which no other term has."""
    mark = hashlib.blake2b(repr(definition(curves)).encode(), digest_size=3).hexdigest()
    return f"{NAME}_{curves[0].form.place}_{mark}"


def defined(curves: Sequence[Curve]) -> str:
    """Make a learned term known; returns its id."""
    id_ = id_of(curves)
    effect_file.define({id_: definition(curves)}, NAME)
    return id_


@dataclass(frozen=True)
class Learned:
    """A learned term.

    Attributes:
        id: of the effect by formula.
        place: of the chain.
        curves: their sum is the term.
        findings: of the stage, with the term as its last effect.
        without: of the stage, without the term.
    """

    id: str
    place: str
    curves: tuple[Curve, ...]
    findings: Findings
    without: Findings

    def values_of(self, curve: Curve, values: Mapping[str, float]) -> list[float]:
        """Values of a curve at its knots, from those of a fit by name."""
        return [values[f"{self.id}.{name}"] for name in curve.names]


def learn(chains: CutChains, findings: Findings, jobs: int) -> list[Learned]:
    """Learn the term that a stage lacks.

    The first curve is fitted at each place where it predicts about as well; the evidence decides between these. Further
    curves at that place are chosen around the fit with those before.

    Args:
        chains: cut.
        findings: of the stage, with the effects that stay.
        jobs: processes.

    Returns:
        The term; several at different places if the stage hardly tells these apart; none if no curve predicts blocks of
        time that it was not fitted to.
    """
    system = _System.of(chains, findings, (), jobs)
    begun = [((system.curves[j],), values) for j, values in system.first()]
    for curves, _ in begun:
        defined(curves)  # here, so that it is known beyond the copies of this process that fit
    first = parallel(jobs, lambda one: _fitted(chains, findings, *one), begun)
    ess = largest_ess(one.fit for one in first)
    evidence = [one.fit.log_evidence(ess) for one in first]
    best = [one for one, its in zip(first, evidence, strict=True) if its >= max(evidence) - ALIKE]
    for one in first:
        if one not in best:
            effect_file.forget(one.id)
    return [_with_further_curves(chains, findings, one, jobs) for one in best]


def _with_further_curves(chains: CutChains, findings: Findings, best: _Fitted, jobs: int) -> Learned:
    """The term with as many curves as are worth it."""
    while len(best.curves) < MOST_CURVES and best.fit.mean_square > GOOD_ENOUGH**2:
        system = _System.of(chains, replace(findings, final=best.fit), best.curves, jobs)
        following = system.next()
        if following is None:
            break
        j, values = following
        more = replace(system.curves[j], letter="abc"[len(best.curves)])
        known = [[best.fit.values[f"{best.id}.{name}"] for name in c.names] for c in best.curves]
        effect_file.forget(best.id)
        best = _fitted(chains, findings, (*best.curves, more), *map(np.array, known), values)
    stage = replace(findings, found=(*findings.found, (RankedHypothesis(best.hypothesis, best.fit, SURE, 1.0),)),
                    final=best.fit)
    return Learned(best.id, best.curves[0].form.place, best.curves, stage, findings)


@dataclass(frozen=True, eq=False)
class _Fitted:
    """A term with its fit."""

    id: str
    curves: tuple[Curve, ...]
    hypothesis: Hypothesis
    fit: Fit


def _fitted(chains: CutChains, findings: Findings, curves: tuple[Curve, ...], *values: Array) -> _Fitted:
    """Fit a term with all that is known of a stage, from values of its curves."""
    id_ = defined(curves)
    own = _parameters(id_, curves, values)
    known = [*nominal_parameters(chains, findings.stage), *(p for h in findings.effects for p in h.own)]
    final = fit(chains.residuals(findings.stage), [*started(known, findings.final.values), *own],
                least_ess=chains.policy.least_ess)
    return _Fitted(id_, curves, Hypothesis(id_, starts=(tuple(own),)), final)


def _parameters(id_: str, curves: Sequence[Curve], values: Sequence[Array]) -> list[Parameter]:
    """The parameters of a learned term, which start at values."""
    found = [Parameter(f"{id_}.gain", 1.0, FIXED, 0.0, 2.0)]
    if memory := next((c.form for c in curves if c.form.rate), None):
        found.append(Parameter(f"{id_}.tau", memory.tau, 1.0, 0.02 * memory.tau, 50.0 * memory.tau, log=True))
    for c, y in zip(curves, values, strict=True):
        sd = WIDE * max(float(np.sqrt(np.mean(y**2))), 1e-12)
        names = [f"{id_}.{name}" for name in c.names]
        alike = np.exp(-0.5 * (np.subtract.outer(range(len(y)), range(len(y))) / SMOOTH) ** 2)
        found += [Parameter(name, 0.0, sd, -REACH * sd, REACH * sd, float(x), correlation=tuple(
            (other, float(r)) for other, r in zip(names, row, strict=True) if other != name))
            for name, x, row in zip(names, y, alike, strict=True)]
    return found


@dataclass(frozen=True)
class _System:
    """The linear system of a stage around a fit: products of the responses of its readings, by block of time.

    Attributes:
        curves: that may be missing.
        rows: of each curve, a slice of the matrices; before the first are the parameters of the fit.
        size: of each curve, the RMS of its response to one unit, by which its rows are divided.
        z: (P,) parameters of the fit in standard units.
        prior: (P, P) information of their prior.
        products: (F, R, R) of the responses in each block.
        gradient: (F, R) of the responses with the residual, which counts as in a fit.
        squares: (F,) of the residual.
        count: readings.
    """

    curves: list[Curve]
    rows: list[slice]
    size: list[float]
    z: Array
    prior: Array
    products: Array
    gradient: Array
    squares: Array
    count: int

    @classmethod
    def of(cls, chains: CutChains, findings: Findings, there: tuple[Curve, ...], jobs: int) -> _System:
        """The system around the final fit of a stage.

        Args:
            chains: cut.
            findings: of the stage.
            there: curves that the fit holds already; others at their place are tried.
            jobs: processes.
        """
        chains, stage, base = chains.head(MOST_SAMPLES), findings.stage, findings.final.values
        residuals = chains.residuals(stage)
        known = [*nominal_parameters(chains, stage), *(p for h in findings.effects for p in h.own)]
        if there:
            known += _parameters(id_of(there), there, [
                np.array([base[f"{id_of(there)}.{name}"] for name in c.names]) for c in there])
        here = [p for p in known if key(p.name).recording < len(chains.each)]
        search = Search(lambda values: residuals({**base, **values}), started(here, base), chains.policy.least_ess)
        r = search.stack(search.current)
        fold = np.concatenate([np.arange(len(x)) * FOLDS // len(x) for x in search.current.values()])
        jacobian = search.stacked(search.jacobian())
        curves = [c for form in FORMS[stage] if _may_follow(form, there)
                  and (c := _curve(chains, form, base)) is not None]

        def response(c: Curve) -> Array:
            return np.array([search.stack(x) - r for x in _raised(residuals, base, c)])

        responses = parallel(jobs, response, curves)
        size = [max(float(np.sqrt(np.mean(b * b))), 1e-300) for b in responses]
        rows, at = [], len(jacobian)
        for c in curves:
            rows.append(slice(at, at + len(c.knot)))
            at += len(c.knot)
        matrix = np.vstack([jacobian, *(b / s for b, s in zip(responses, size, strict=True))])
        parts = [fold == k for k in range(FOLDS)]
        return cls(curves, rows, size, search.z, search.prior, np.array([matrix[:, p] @ matrix[:, p].T for p in parts]),
                   np.array([matrix[:, p] @ r[p] for p in parts]), np.array([r[p] @ r[p] for p in parts]), len(r))

    def first(self) -> list[tuple[int, Array]]:
        """The best curve of each place, with its values, where it predicts about as well as the best of all."""
        best: dict[tuple[str, str], tuple[float, float, int]] = {}
        for j, c in enumerate(self.curves):
            mine = (*self._predicted(j), j)
            best[c.form.place, c.form.reading] = min(best.get((c.form.place, c.form.reading), mine), mine)
        limit = min((1.0 - WORTH) * self._nothing(), ABOUT * min((left for left, *_ in best.values()), default=0.0))
        return [(j, self._solution(j, stiffness)) for left, stiffness, j in sorted(best.values()) if left <= limit]

    def next(self) -> tuple[int, Array] | None:
        """The curve that predicts best, with its values; None if it is not worth it."""
        left, stiffness, j = min(((*self._predicted(j), j) for j in range(len(self.curves))),
                                 default=(np.inf, 0.0, 0))
        return (j, self._solution(j, stiffness)) if left <= (1.0 - WORTH) * self._nothing() else None

    def _nothing(self) -> float:
        """Mean square that no curve leaves of blocks that the parameters were not fitted to."""
        return self._left(np.arange(len(self.z)), self.prior)

    def _predicted(self, j: int) -> tuple[float, float]:
        """Mean square that a curve leaves of such blocks, and the weight of its bends that does best."""
        return min((self._left(*self._with(j, stiffness)), stiffness) for stiffness in STIFFNESSES)

    def _left(self, at: NDArray[np.intp], prior: Array) -> float:
        products, gradient, pull = self.products[:, at][:, :, at], self.gradient[:, at], self._pull(at)
        whole, all_ = products.sum(axis=0), gradient.sum(axis=0)
        left = 0.0
        for own, g, square in zip(products, gradient, self.squares, strict=True):
            x = -np.linalg.solve(whole - own + prior, all_ - g + pull)
            left += float(square + 2.0 * x @ g + x @ own @ x)
        return left / self.count

    def _with(self, j: int, stiffness: float) -> tuple[NDArray[np.intp], Array]:
        """Rows of the parameters and of a curve, and the information of their prior."""
        rows = self.rows[j]
        bends = np.diff(np.eye(rows.stop - rows.start), 2, axis=0)
        prior = self.count * (stiffness * bends.T @ bends + RIDGE * np.eye(bends.shape[1]))
        return np.r_[np.arange(len(self.z)), np.arange(rows.start, rows.stop)], block_diag(self.prior, prior)

    def _pull(self, at: NDArray[np.intp]) -> Array:
        """Gradient of the prior."""
        return np.r_[self.prior @ self.z, np.zeros(len(at) - len(self.z))]

    def _solution(self, j: int, stiffness: float) -> Array:
        """Values of a curve, fitted to all blocks."""
        at, prior = self._with(j, stiffness)
        whole = self.products.sum(axis=0)[np.ix_(at, at)]
        x = -np.linalg.solve(whole + prior, self.gradient.sum(axis=0)[at] + self._pull(at))
        return np.asarray(x[len(self.z):] / self.size[j], dtype=np.float64)


def _may_follow(form: Form, there: Sequence[Curve]) -> bool:
    """Whether a curve may be added to others: at their place, another one, and no second memory."""
    return not there or ((form.place, form.reading) == (there[0].form.place, there[0].form.reading)
                         and form not in [c.form for c in there]
                         and not (form.rate and any(c.form.rate for c in there)))


def _curve(chains: CutChains, form: Form, base: Mapping[str, float]) -> Curve | None:
    """A form with its knots over all recordings; None if its quantity hardly varies."""
    seen = [quantity(chain, form, chains.values_of(base, k)) for k, chain in enumerate(chains.each)]
    known = np.concatenate([x[:chain.signals.train] for x, chain in zip(seen, chains.each, strict=True)])
    knot = knots_of(known, POINTS)
    if not len(knot):
        return None
    even = np.linspace(knot[0], knot[-1], len(knot))
    return Curve(form, 0.5 * (knot + even))  # where there are few readings a curve needs points too


def quantity(chain: CutChain, form: Form, values: Mapping[str, float]) -> Array:
    """The quantity of a form along a recording.

    Args:
        chain: of the recording.
        form: of a curve.
        values: of a fit, for this recording.

    Returns:
        (N,) in the unit of the form.
    """
    s = chain.signals
    known: dict[str, Array] = {}
    stage = stage_at(form.place, form.reading)
    if stage == "actuator":
        n = chain.valued(values).numbers()
        known = {"v": actuator.voltage(n, s.duty), "i_a": np.nan_to_num(chain.current)}
    elif stage == "motor":
        i, omega, _ = chain.motor(values)
        known = {"i_a": i, "omega": omega}
    else:
        theta, rate = chain.arm_motion(values)
        n = chain.valued(values).numbers()
        known = {"theta": theta, "theta_dot": rate, "omega": chain.speed, "thrust": actuator.thrust(n, chain.speed)}
    return along(form.of, {"tau": form.tau or 1.0}, len(s), s.period, "z" if form.rate else "", form.rate, **known)


def _raised(residuals: Callable[[dict[str, float]], Mapping[str, Array]], base: Mapping[str, float], c: Curve
            ) -> Iterator[Mapping[str, Array]]:
    """Residuals with each point of a curve raised by one unit in turn, extrapolated from a small rise."""
    id_ = defined([c])
    own = {f"{id_}.{name}": 0.0 for name in c.names} | {f"{id_}.gain": 1.0}
    if c.form.rate:
        own[f"{id_}.tau"] = c.form.tau

    def at(values: dict[str, float]) -> dict[str, Array]:
        return {k: finite(np.asarray(r)) for k, r in residuals({**base, **own, **values}).items() if len(r)}

    still = at({})
    for name in c.names:
        moved = at({f"{id_}.{name}": RISE[c.form.value_unit]})
        yield {k: r + (moved[k] - r) / RISE[c.form.value_unit] for k, r in still.items()}
    effect_file.forget(id_)


RISE = {"V": 1e-3, "Ω": 1e-3, "N·m": 1e-6, "A": 1e-3, "N": 1e-4, "-": 1e-3, "rad/s²": 1e-2, "1/s": 1e-2, "rad": 1e-4}
"""Rise of a point by which a response is taken, by unit (choice: a thousandth of what effects have on a bench)."""
