# SPDX-License-Identifier: Apache-2.0
"""Sparse identification of a recording: `identify BAG --method weak`.

A regression chooses terms and first coefficients (weak form, or derivatives), free runs have the last word.
Exit code 0 with equations, 2 with one line on standard error when the input cannot be used.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from aeropend_ident.bags import recording
from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.diagnosis.batch import names
from aeropend_ident.identification import dataset
from aeropend_ident.identification.dataset import Dataset
from aeropend_ident.identification.discrepancy import Equations, nominal
from aeropend_ident.identification.output_error import Entries, Experiment, Fitter
from aeropend_ident.identification.output_error_selection import MOST, STABLE, Refined, follows, refine
from aeropend_ident.identification.picture import draw
from aeropend_ident.identification.sindy import DERIVATIVES, Regression, regress
from aeropend_ident.identification.subset_selection import Sums, select
from aeropend_ident.identification.terms import Array, Library, TermError, thesis_terms
from aeropend_ident.identification.weak import NUMERIC, Weak, half_width, sided
from aeropend_ident.result_folder import OutputError, check, whole
from aeropend_sim.cli.command import Parser, between, interruptible
from aeropend_sim.cli.progress import Show, nothing, progress
from aeropend_sim.model.parameters import PRESETS, ModelError, load

FORMAT = 1
METHODS = ("sindy", "weak", "discrepancy-sindy", "discrepancy-weak")
FILES = ("identified.json", "identified.svg")

SWEEPS = 3
"""Times that each group of states is refined between the others."""

EXPLAINED = 3.0
"""Free-run error on held-out data, in units of the noise, from which on something is said to be missing."""


@dataclass(frozen=True)
class Alternative:
    """A term that could as well be another: exchanging it changes the criterion by `worse` only."""

    equation: str
    term: str
    instead: str
    worse: float


@dataclass(frozen=True)
class FreeRun:
    """How a free run compares with the held-out readings of one channel: RMS of the difference, and its floor."""

    gap: float
    floor: float


@dataclass(frozen=True)
class Identified:
    """What was found.

    Attributes:
        method: one of `METHODS`. terms: the candidates.
        equations, sigma: state -> term -> coefficient, and its 1 sigma (0: exact by what the state is).
        stability: state -> term -> share of resamples in which the term is chosen; empty where nothing was refined.
        unstable: equation, term, share: left out, because few resamples choose it.
        alternatives: terms that the data cannot tell from those found.
        held_out_mse: state -> mean squared error of the derivative on held-out data (SI).
        free_run: channel -> free run from the training data on through the held-out data; empty where shots were
            needed. shots: free runs the recording was cut into.
        seconds: of work. notes: what a person should know.
        refined: the fit behind it. data: what it was made from. regression: what the regression alone found.
        derivatives: (N, states) from the readings, and of the equations. run: (N, states) the free run, if any.
    """

    method: str
    terms: tuple[str, ...]
    equations: dict[str, dict[str, float]]
    sigma: dict[str, dict[str, float]]
    stability: dict[str, dict[str, float]]
    unstable: tuple[tuple[str, str, float], ...]
    alternatives: tuple[Alternative, ...]
    held_out_mse: dict[str, float]
    free_run: dict[str, FreeRun]
    shots: int
    seconds: float
    notes: tuple[str, ...]
    refined: Refined | None
    data: Dataset
    regression: dict[str, dict[str, float]]
    derivatives: tuple[Array, Array]
    run: Array | None


@threadpool_limits.wrap(limits=1)  # its matrices are too small for threads: they would take three times as long
def identify(data: Dataset, method: str = "weak", terms: Sequence[str] | None = None, known: Equations | None = None,
             derivative: str = "smoothed", show: Show = nothing) -> Identified:
    """Find sparse equations of a dataset.

    Args:
        data: the recording. method: one of `METHODS`. terms: candidates (the thesis' library by default).
        known: for the discrepancy methods, the equations to which terms are added.
        derivative: for the SINDy methods, how derivatives are taken (`sindy.DERIVATIVES`).
        show: how far it is, up to 1.

    Raises:
        TermError: a term cannot be read. RecordingError: no model could be run on the data.
    """
    started = time.perf_counter()
    if method.startswith("discrepancy"):
        if known is None:
            raise ValueError(f"{method} needs the equations of a model")
    else:
        known = None
    library = list(terms if terms is not None else thesis_terms(data.variables))
    if not library:
        raise TermError("no terms are given: name at least one, as in sin(theta),theta_dot,omega*omega")
    problem = Problem(data, library, known)
    show(0.05, "choosing terms by regression")
    regression = problem.regress(method.endswith("weak"), derivative)
    refined = None
    if data.derivatives is None:
        refined = problem.refine(regression, show)
        if refined is None:
            raise RecordingError(f"{data.name}: the equations found at first run away, so none are told; record "
                                 "longer, with more motion, or give fewer terms")
        matrix, sigma = problem.take(refined.matrix), problem.take(refined.sigma)
    else:
        matrix, sigma = regression, problem.regression_sigma(regression)
    free, notes = problem.free_run(refined)
    often = np.zeros(matrix.shape) if refined is None else problem.take(refined.stability)
    found, spread, first, stability = (
        {s: {library[j]: float(values[k, j]) for j in np.flatnonzero(which[k])} for k, s in enumerate(data.states)}
        for values, which in ((matrix, matrix), (sigma, matrix), (regression, regression), (often, matrix)))
    for k, equation in problem.exact.items():
        found[data.states[k]] = dict(equation)
        spread[data.states[k]] = dict.fromkeys(equation, 0.0)
        stability[data.states[k]] = dict.fromkeys(equation, 1.0)
    rivals = () if refined is None else tuple(
        Alternative(data.states[e], library[a], library[b], w) for e, a, b, w in refined.alternatives)
    unstable = () if refined is None else tuple((data.states[e], library[t], o) for e, t, o in refined.unstable)
    shots = 1 if refined is None else len(refined.fitter.parts)
    return Identified(method, tuple(library), found, spread, {} if refined is None else stability, unstable,
                      rivals, problem.held_out_mse(matrix, derivative), free, shots, time.perf_counter() - started,
                      (*data.notes, *notes), refined, data, first, problem.derivative_traces(matrix, derivative),
                      problem.states)


class Problem:
    """A dataset with its library, as the regression and the free runs need it."""

    def __init__(self, data: Dataset, names: list[str], known: Equations | None) -> None:
        self.data, self.names = data, names
        Library.of(data.variables, names)  # a term that cannot be read is told with the variables it may have
        n = len(data.states)
        self.exact: dict[int, dict[str, float]] = {
            data.states.index(s[: -len(dataset.RATE)]): {s: 1.0} for s in data.derived
            if s.endswith(dataset.RATE) and s[: -len(dataset.RATE)] in data.states}
        fixed: dict[int, dict[str, float]] = {k: dict(e) for k, e in self.exact.items()}
        for s, equation in (known or {}).items():
            if s in data.states:
                fixed.setdefault(data.states.index(s), {}).update(equation)
        if known is not None:
            self.exact = {k: {} for k in self.exact}
        self.own = fixed
        for k, link in enumerate(data.chain):
            fixed = {**fixed, n + k: dict(link.rate)}
        extra = [t for e in fixed.values() for t in e if t not in names]
        extra = list(dict.fromkeys(extra))
        self.library = Library.of((*data.states, *(link.name for link in data.chain), *data.inputs), [*names, *extra])
        every = np.zeros((n + len(data.chain), len(self.library)))
        for e, equation in fixed.items():
            for t, c in equation.items():
                every[e, self.library.names.index(t)] = c
        self.fixed_matrix = every
        self.candidates = np.zeros(every.shape, dtype=bool)
        for k in range(n):
            self.candidates[k, : len(names)] = k not in self.exact
        self.small = Library.of(data.variables, names)
        self.shot = 1
        self.states: Array | None = None
        self.weak, self.derivative = True, "smoothed"

    def regress(self, weak: bool, derivative: str) -> Array:
        """First coefficients (states, terms), from the training part."""
        d = self.data
        x, u = d.values[: d.train], d.held[: d.train]
        problem: Weak | Regression
        self.weak, self.derivative = weak, derivative
        if weak:
            problem = Weak(self.small, x, u, d.period, d.noise, d.coarse)
        else:
            known = None if d.derivatives is None else d.derivatives[: d.train]
            problem = Regression(self.small, x, u, d.period, known, derivative)
        self.shot = 2 * max(half_width(column) for column in x.T)
        self.problem = problem
        matrix = np.zeros((len(d.states), len(self.names)))
        for k in range(len(d.states)):
            if k in self.exact:
                continue
            matrix[k] = regress(problem, k, self.known_rate(k, x, u, mean=weak))
        return matrix

    def known_rate(self, equation: int, x: Array, u: Array, *, mean: bool) -> Array | None:
        """The known part (N,) of a derivative; at a step of the input the mean of both sides, if asked for."""
        terms = self.own.get(equation, {})
        if not terms:
            return None
        library = Library.of(self.data.variables, list(terms))
        values = sided(library, x, u) if mean else library(np.column_stack([x, u]))
        return np.asarray(values @ np.array(list(terms.values())))

    def regression_sigma(self, matrix: Array) -> Array:
        """1 sigma (states, terms) of coefficients of a regression."""
        d, out = self.data, np.zeros(matrix.shape)
        for k in range(len(d.states)):
            s = np.flatnonzero(matrix[k])
            if len(s):
                known = self.known_rate(k, d.values[: d.train], d.held[: d.train], mean=False)
                sums = Sums.total(self.problem.blocks(k, matrix[k], known))
                variance = sums.misfit(matrix[k]) / max(sums.n - len(s), 1.0)
                out[k, s] = np.sqrt(variance * np.diag(np.linalg.pinv(sums.H[np.ix_(s, s)], hermitian=True)))
        return out

    def fill(self, matrix: Array) -> Array:
        """A matrix (states, terms) over all states and terms, those of the measurement chain included."""
        out = np.zeros(self.candidates.shape)
        out[: matrix.shape[0], : matrix.shape[1]] = matrix
        return out

    def take(self, matrix: Array) -> Array:
        """The inverse of `fill`."""
        return matrix[: len(self.data.states), : len(self.names)]

    def experiment(self, stop: int, group: Sequence[str] = (), described: Array | None = None) -> Experiment:
        """The first samples as an experiment.

        Args:
            stop: number of samples. group: states that run; the others, as they are described, are inputs. All: ().
            described: (stop, states); as they were read by default.
        """
        d = self.data
        values = d.values[:stop] if described is None else described
        group = list(group) or list(d.states)
        near = {*group, *(link.name for link in d.chain if link.follows in group)}
        links = [link for link in d.chain if near & set(link.rate)]
        running = [*group, *(link.name for link in links)]
        other = [k for k, s in enumerate(d.states) if s not in group]
        idle = [link.name for link in d.chain if link not in links]
        library = Library.of((*running, *(d.states[k] for k in other), *idle, *d.inputs), self.library.names)
        at = {name: k for k, name in enumerate(running)}
        follows = tuple(at[link.follows] if link.follows else -1 for link in links)
        own = values[:, self.indices(group)]
        guess = np.column_stack([own, *(own[:, f] if f >= 0 else np.zeros(stop) for f in follows)])
        between = values[:, other]
        between = 0.5 * (between + np.vstack([between[1:], between[-1:]]))  # not held: the mean over a sample
        inputs = np.column_stack([between, np.zeros((stop, len(idle))), d.held[:stop]])
        outputs = tuple(replace(o, state=at[name], value=o.value[:stop]) for name, o in d.outputs if name in at)
        means = tuple(replace(m, state=at[name]) for name, m in d.means if name in at)
        whole = Experiment(library, np.ascontiguousarray(inputs), d.period, guess, outputs,
                           means, Entries.of(self.fixed_matrix[self.indices(running)]), len(group), follows)
        return whole.part(0, stop)

    @property
    def groups(self) -> list[list[str]]:
        """States that are derivatives of each other go together, others alone."""
        d = self.data
        rates = {s + dataset.RATE for s in d.states} & set(d.states)
        return [[s, s + dataset.RATE] if s + dataset.RATE in rates else [s] for s in d.states if s not in rates]

    def refine(self, first: Array, show: Show = nothing) -> Refined | None:
        """Terms and coefficients by free runs, from a first matrix (states, terms).

        Where that does not follow the recording, every group of states is run alone at first, between the others as
        they were read, and what comes of it is the start.
        """
        d, start = self.data, self.fill(first)
        whole = self.experiment(d.train)
        show(0.1, "fitting free runs")
        fitter = Fitter(whole, Entries.of(start), 0, floor=1.0)
        if not (fitter.fit(rounds=15) and follows(fitter)):
            better = self.alone(start.copy())
            fitter = Fitter(whole, Entries.of(better), 0, floor=1.0)
            if d.chain or (fitter.fit(rounds=15) and follows(fitter)):
                return refine(whole, better, self.candidates, self.shot, follow=False, score=self.held_out_misfit,
                              show=show)
        return refine(whole, start, self.candidates, self.shot, score=self.held_out_misfit, show=show)

    def alone(self, start: Array) -> Array:
        """Refine the groups of states one by one, between the others; the runs then describe the states better."""
        d = self.data
        described, noise = d.values[: d.train].copy(), None if d.noise is None else d.noise.copy()
        size: dict[str, float] = {}
        for sweep in range(SWEEPS):
            if sweep > 1 and len(size) == len(self.groups):
                break
            for group in self.groups:
                experiment = self.experiment(d.train, group, described)
                rows = self.indices(experiment.library.variables[: experiment.n])
                tries: Iterable[Array] = [start] if group[0] in size else chain(
                    (self.fill(self.first(group, most, described, noise)) for most in (MOST, 5, 3, 2, 1)),
                    (self.fill(self.stepped(group[0], most, described)) for most in (5, 3, 2) if len(group) == 1))
                for trial in tries:
                    found = refine(experiment, trial[rows], self.candidates[rows], self.shot, follow=False)
                    left = np.inf if found is None else max(found.fitter.scale.values())
                    if found is not None and follows(found.fitter) and left < size.get(group[0], np.inf):
                        size[group[0]] = left
                        start[rows] = found.matrix
                        states = found.fitter.run(*found.fitter.point)
                        assert states is not None
                        own = self.indices(group)
                        described[:, own] = states[0][:, : len(group)]
                        if noise is not None:
                            noise[own] = NUMERIC * described[:, own].std(axis=0)
                        break
        return start

    def first(self, group: Sequence[str], most: int, described: Array, noise: Array | None) -> Array:
        """First coefficients (states, terms) of the equations of a group, with few terms, from described states."""
        d = self.data
        x, u = described, d.held[: d.train]
        problem: Weak | Regression
        if self.weak:
            problem = Weak(self.small, x, u, d.period, noise, None if d.coarse is None else np.zeros(len(d.coarse)))
        else:
            problem = Regression(self.small, x, u, d.period, None, self.derivative)
        matrix = np.zeros((len(d.states), len(self.names)))
        for k in self.indices(group):
            if k not in self.exact:
                matrix[k] = regress(problem, k, self.known_rate(k, x, u, mean=self.weak), most=most)
        return matrix

    def stepped(self, state: str, most: int, described: Array) -> Array:
        """First coefficients (states, terms) of a state that settles within a few samples, from step to step.

        x' = λ x + Σ c f with f held makes x(k+1) = a x(k) + Σ b f with a = exp(λ h), b = c (a - 1)/λ: exact where
        derivatives say nothing, because the state is done before they can be seen.
        """
        d = self.data
        own = [j for j, name in enumerate(self.names) if name == state]
        others = [j for j, name in enumerate(self.names) if not re.search(rf"\b{state}\b", name)]
        matrix = np.zeros((len(d.states), len(self.names)))
        if not own:
            return matrix
        k = d.states.index(state)
        between = 0.5 * (described[:-1] + described[1:])  # not held: the mean over a sample
        terms = self.small(np.column_stack([between, d.held[: d.train][:-1]]))[:, [*own, *others]]
        terms[:, 0] = described[:-1, k]
        sums = Sums.of(terms, described[1:, k])
        chosen = sums.solve(sorted({0, *select(sums, most)}))
        a = float(np.clip(chosen[0], 1e-6, 1.0 - 1e-6))
        rate = math.log(a) / d.period
        matrix[k, [*own, *others]] = chosen * rate / (a - 1.0)
        matrix[k, own[0]] = rate
        return matrix

    def indices(self, names: Sequence[str]) -> list[int]:
        """The rows of states, those of the measurement chain included."""
        every = [*self.data.states, *(link.name for link in self.data.chain)]
        return [every.index(s) for s in names]

    def derivative_traces(self, matrix: Array, derivative: str) -> tuple[Array, Array]:
        """Derivatives (N, states): known or smoothed, and those of the equations."""
        d = self.data
        problem = Regression(self.small, d.values, d.held, d.period, d.derivatives, derivative)
        rate = problem.terms @ matrix.T
        for k in range(len(d.states)):
            known = self.known_rate(k, d.values, d.held, mean=False)
            rate[:, k] += 0.0 if known is None else known
        return problem.left, rate

    def held_out_mse(self, matrix: Array, derivative: str) -> dict[str, float]:
        """Mean squared error of each derivative on held-out data, beside the known or the smoothed derivative."""
        late = slice(self.data.train, None)
        seen, told = self.derivative_traces(matrix, derivative)
        return {s: float(np.mean((told - seen)[late, k] ** 2)) for k, s in enumerate(self.data.states)}

    def run_on(self, fitted: Fitter) -> tuple[Fitter, list[Array]] | None:
        """A fitted model run freely from the start of the recording to its end; None where shots were needed."""
        if len(fitted.parts) > 1 or self.data.train >= len(self.data):
            return None
        fitter = Fitter(self.experiment(len(self.data)), fitted.model, 0)
        fitter.steps = fitted.steps
        states = fitter.run(fitter.model, fitted.initial)
        return None if states is None else (fitter, states)

    def held_out_residuals(self, fitter: Fitter, states: list[Array]) -> dict[str, tuple[Array, Array]]:
        """Residuals of each channel on held-out data, and their standard deviations, of a run over all of it."""
        d, found = self.data, {}
        for o in fitter.experiment.outputs:
            left = (o.value - states[0][:, o.state])[d.train:]
            found[o.name] = left[np.isfinite(left)], np.array([o.sigma])
        residuals = fitter.residuals(states)
        for m in fitter.experiment.means:
            late = m.end > d.train * d.period
            if late.any():
                found[m.name] = (residuals[m.name][0] * m.sigma)[late], m.sigma[late]
        return found

    def held_out_misfit(self, fitted: Fitter) -> float:
        """Mean square of the held-out residuals over their variances, summed over the channels; inf without a run."""
        run = self.run_on(fitted)
        if run is None:
            return np.inf
        return sum(float(np.mean((left / sigma) ** 2)) for left, sigma in self.held_out_residuals(*run).values())

    def free_run(self, refined: Refined | None) -> tuple[dict[str, FreeRun], list[str]]:
        """The model run freely from the start of the recording, compared where nothing was fitted to."""
        d = self.data
        if refined is None or d.train >= len(d):
            return {}, []
        if len(refined.fitter.parts) > 1:
            said = f"the recording was run in {len(refined.fitter.parts)} shots"
            return {}, [f"{said}: a free run over all of it does not stay with the readings"]
        run = self.run_on(refined.fitter)
        if run is None:
            return {}, ["the equations run away on the held-out data"]
        self.states = run[1][0][:, : len(d.states)]
        found = {c: FreeRun(float(np.sqrt(np.mean(left**2))), float(np.sqrt(np.mean(sigma**2))))
                 for c, (left, sigma) in self.held_out_residuals(*run).items()}
        notes = []
        worst = max(found, key=lambda c: found[c].gap / found[c].floor, default=None)
        if worst is not None and found[worst].gap > EXPLAINED * found[worst].floor:
            times = found[worst].gap / found[worst].floor
            notes.append(f"the free run misses held-out {worst} by {times:.1f} times its noise: something in it is no "
                         "sum of these terms")
        return found, notes


def document(found: Identified, bag: str, model: str, seconds: float) -> dict[str, object]:
    """The content of `identified.json` (contract section 6, and what the program knows besides)."""
    d = found.data
    return {"format": FORMAT, "method": found.method, "terms": list(found.terms), "equations": found.equations,
            "sigma": found.sigma, "held_out_mse": found.held_out_mse, "seconds": round(seconds, 2),
            "bag": bag, "model": model, "states": list(d.states), "inputs": list(d.inputs),
            "duration_s": round(len(d) * d.period, 3), "samples": len(d),
            "train_s": [0.0, round(d.train * d.period, 3)],
            "held_out_s": [round(d.train * d.period, 3), round(len(d) * d.period, 3)],
            "stability": found.stability,
            "undetermined": [{"equation": a.equation, "term": a.term, "or": a.instead, "worse": round(a.worse, 2)}
                             for a in found.alternatives]
            + [{"equation": s, "term": t, "stability": often} for s, terms in found.stability.items()
               for t, often in terms.items() if often < STABLE]
            + [{"equation": s, "term": t, "stability": often, "left_out": True} for s, t, often in found.unstable],
            "free_run": {c: {"gap": r.gap, "floor": r.floor} for c, r in found.free_run.items()},
            "shots": found.shots, "notes": list(found.notes)}


def lines(found: Identified) -> list[str]:
    """The equations for a person."""
    out = [f"note: {note}" for note in found.notes]
    out += [f"note: d({s})/dt: {term} is left out: only {100.0 * often:.0f} % of resamples of the recording choose it"
            for s, term, often in found.unstable]
    what = "to add to d({})/dt: " if found.method.startswith("discrepancy") else "d({})/dt = "
    for s, equation in found.equations.items():
        parts = []
        for term, c in sorted(equation.items(), key=lambda pair: list(found.terms).index(pair[0])):
            rivals = [a.instead for a in found.alternatives if (a.equation, a.term) == (s, term)]
            doubts = [f"or {', '.join(rivals)}"] if rivals else []
            often = found.stability.get(s, {}).get(term, 1.0)
            doubts += [f"in {100.0 * often:.0f} % of resamples"] if often < STABLE else []
            shown = f"{term} [undetermined: {'; '.join(doubts)}]" if doubts else term
            one = " constant" if term == "1" else f" {shown}"
            sd = found.sigma[s][term]
            size = f"{abs(c):.6g}" if sd == 0.0 else f"({abs(c):.6g} ± {sd:.2g})"
            parts.append(("- " if c < 0.0 else "+ ") + size + one)
        text = " ".join(parts).removeprefix("+ ") or ("nothing" if found.method.startswith("discrepancy") else "0")
        out.append(what.format(s) + text)
    for channel, run in found.free_run.items():
        out.append(f"free run on held-out data, {channel}: RMS {run.gap:.3g}, noise {run.floor:.3g} "
                   f"({run.gap / run.floor:.2f} times)")
    return out


EXAMPLES = """examples:
  identify my_bag --method weak                          the equations of a rig from its recording
  identify my_bag --method discrepancy-weak --model thesis      what must be added to a model
  identify my_bag --method weak --terms 'sin(theta),theta_dot,omega^1.8,i_a,omega,v_a'     candidates of your own

exit codes: 0 equations were written, 2 the input cannot be used (one line says why), 130 interrupted"""


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line; exits with 2 and one line where it is wrong."""
    parser = Parser(prog="identify", epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter,
                    description="Find sparse equations of motion in a recording, or what must be added to a model's.")
    parser.add_argument("bag", metavar="BAG", help="a recording (folder, .mcap or .db3)")
    parser.add_argument("--method", choices=METHODS, default="weak", help="default: weak")
    parser.add_argument("--model", default="bench", metavar="PRESET|FILE",
                        help="whose measurement chain the recording went through, and to which discrepancy methods "
                             f"add: {' or '.join(PRESETS)}, or a model file (default: bench)")
    parser.add_argument("--states", default=",".join(dataset.STATES), metavar="NAMES",
                        help=f"states, separated by commas (default: {','.join(dataset.STATES)})")
    parser.add_argument("--input", default="v_a", metavar="NAMES", help="inputs, separated by commas (default: v_a)")
    parser.add_argument("--terms", metavar="TERMS", help="candidate terms, separated by commas (default: the thesis' "
                        "library: 1, all, products of two, sin and cos of all)")
    parser.add_argument("--derivative", choices=DERIVATIVES, default="smoothed",
                        help="how the SINDy methods take derivatives (default: smoothed)")
    parser.add_argument("--out", metavar="DIR", help="folder for the results (default: identified_<name of the bag>)")
    parser.add_argument("--namespace", metavar="NS", help="namespace of the rig, when a bag holds several")
    parser.add_argument("--held-out", type=between(0.05, 0.8, "a share"), default=0.25, metavar="SHARE",
                        help="share at the end kept for testing (default: 0.25)")
    parser.add_argument("--overwrite", action="store_true", help="replace results that are in the folder already")
    return parser.parse_args(arguments)


def run(options: argparse.Namespace) -> None:
    """Identify and write the results.

    Raises:
        RecordingError, ModelError, OutputError, TermError: the input or the output cannot be used.
    """
    started = time.monotonic()
    out = Path(options.out or f"identified_{names([options.bag])[0]}")
    check(out, FILES, overwrite=options.overwrite)
    model = load(options.model)
    known = nominal(model) if options.method.startswith("discrepancy") else None
    with progress("reading") as show:
        data = dataset.from_bag(recording.read(options.bag, options.namespace), model.sensing, _listed(options.states),
                                _listed(options.input), options.held_out)
        found = identify(data, options.method, None if options.terms is None else _listed(options.terms), known,
                         options.derivative, show)
    body = document(found, options.bag, options.model, time.monotonic() - started)
    with whole(out, FILES) as place:
        (place / FILES[0]).write_text(json.dumps(body, indent=1, allow_nan=False) + "\n", encoding="utf-8")
        (place / FILES[1]).write_text(draw(found), encoding="utf-8")
    print("\n".join(lines(found)))
    print(f"{out / FILES[0]}   {out / FILES[1]}   {body['seconds']} s")


def _listed(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


@interruptible
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code."""
    options = parse(arguments)
    try:
        run(options)
    except (RecordingError, ModelError, OutputError, TermError) as error:
        print(f"identify: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
