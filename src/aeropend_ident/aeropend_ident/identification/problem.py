# SPDX-License-Identifier: Apache-2.0
"""A dataset with its candidate terms, as the regression and the free runs need it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import NamedTuple

import numpy as np

from aeropend_ident.identification import dataset
from aeropend_ident.identification.dataset import Dataset
from aeropend_ident.identification.discrepancy import Equations
from aeropend_ident.identification.output_error import Entries, Experiment, Fitter, standard_deviations
from aeropend_ident.identification.output_error_selection import MOST, SelectedModel, select_terms, tracks
from aeropend_ident.identification.sindy import Regression, regress
from aeropend_ident.identification.subset_selection import NormalEquations, ebic_search
from aeropend_ident.identification.terms import Array, Library
from aeropend_ident.identification.weak import NUMERIC, Weak, half_width, sided
from aeropend_sim.cli.progress import Show, nothing

SWEEPS = 3
"""Passes over the groups of states that are fitted one at a time. Choice."""

EXPLAINED = 3.0
"""RMS of the free run's error on held-out data over the noise, above which a note says that a term is missing.
Choice: three standard deviations."""


@dataclass(frozen=True)
class FreeRun:
    """A free run compared with the held-out readings of one channel.

    Attributes:
        gap: RMS of the difference.
        floor: RMS of the noise of the readings.
    """

    gap: float
    floor: float


class HeldOutRun(NamedTuple):
    """A free run over the whole recording, compared with the held-out readings.

    Attributes:
        channels: the comparison by channel; empty where there is no free run.
        states: (N, states) the run; None where there is none.
        notes: remarks for the user.
    """

    channels: dict[str, FreeRun]
    states: Array | None
    notes: tuple[str, ...]


class Problem:
    """A dataset with its candidate terms. No method changes it.

    A matrix of coefficients is either narrow, (states, candidate terms), or wide: with a row for each state of the
    measurement chain as well, and a column for each term that only known equations have.

    Attributes:
        data: the dataset.
        names: the candidate terms.
        exact: row -> equation that follows from the definition of a state, such as d(theta)/dt = theta_dot.
        library: the terms of wide matrices.
        candidates: (wide) bool, the entries that may be in the model.
    """

    def __init__(self, data: Dataset, names: list[str], known: Equations | None = None, *, weak: bool = True,
                 derivative: str = "smoothed") -> None:
        """Set the problem up.

        Args:
            data: the dataset.
            names: the candidate terms.
            known: equations to which terms are added (discrepancy); None: all terms are to be found.
            weak: whether the regression is the weak form; otherwise it is SINDy.
            derivative: how SINDy takes derivatives (`sindy.DERIVATIVES`).

        Raises:
            TermError: a term cannot be read, or is too large.
        """
        self.data, self.names, self.weak, self.derivative = data, names, weak, derivative
        self._narrow = Library.of(data.variables, names)  # first: its message lists the variables that the user has
        self._narrow.check(np.column_stack([data.values, data.held]))
        n = len(data.states)
        exact: dict[int, dict[str, float]] = {
            data.states.index(s[: -len(dataset.RATE)]): {s: 1.0} for s in data.derived
            if s.endswith(dataset.RATE) and s[: -len(dataset.RATE)] in data.states}
        fixed: dict[int, dict[str, float]] = {k: dict(e) for k, e in exact.items()}
        for s, equation in (known or {}).items():
            if s in data.states:
                fixed.setdefault(data.states.index(s), {}).update(equation)
        self.exact = exact if known is None else {k: {} for k in exact}
        self._known = fixed
        fixed = {**fixed, **{n + k: dict(sensor.rate) for k, sensor in enumerate(data.sensor_states)}}
        extra = list(dict.fromkeys(t for e in fixed.values() for t in e if t not in names))
        sensors = (sensor.name for sensor in data.sensor_states)
        self.library = Library.of((*data.states, *sensors, *data.inputs), [*names, *extra])
        self._fixed_matrix = np.zeros((n + len(data.sensor_states), len(self.library)))
        for e, equation in fixed.items():
            for t, c in equation.items():
                self._fixed_matrix[e, self.library.names.index(t)] = c
        self.candidates = np.zeros(self._fixed_matrix.shape, dtype=bool)
        for k in range(n):
            self.candidates[k, : len(names)] = k not in self.exact

    # --- regression

    def regression(self) -> Weak | Regression:
        """The regression of the training part."""
        d = self.data
        x, u = d.values[: d.train], d.held[: d.train]
        if self.weak:
            return Weak(self._narrow, x, u, d.period, d.noise, d.coarse)
        known = None if d.derivatives is None else d.derivatives[: d.train]
        return Regression(self._narrow, x, u, d.period, known, self.derivative)

    def regress(self, regression: Weak | Regression) -> Array:
        """First coefficients (states, terms), by the regression of the training part."""
        d = self.data
        x, u = d.values[: d.train], d.held[: d.train]
        matrix = np.zeros((len(d.states), len(self.names)))
        for k in range(len(d.states)):
            if k not in self.exact:
                matrix[k] = regress(regression, k, self._known_rate(k, x, u, mean=self.weak))
        return matrix

    def regression_sigma(self, regression: Weak | Regression, matrix: Array) -> Array:
        """Standard deviations (states, terms) of the coefficients of a regression."""
        d, out = self.data, np.zeros(matrix.shape)
        for k in range(len(d.states)):
            s = np.flatnonzero(matrix[k])
            if len(s):
                known = self._known_rate(k, d.values[: d.train], d.held[: d.train], mean=False)
                sums = NormalEquations.total(regression.blocks(k, matrix[k], known))
                variance = sums.misfit(matrix[k]) / max(sums.n - len(s), 1.0)
                out[k, s] = math.sqrt(variance) * standard_deviations(sums.H[np.ix_(s, s)])
        return out

    def _known_rate(self, equation: int, x: Array, u: Array, *, mean: bool) -> Array | None:
        """The known part (N,) of a derivative; where the input steps, the mean of both sides if `mean`."""
        terms = self._known.get(equation, {})
        if not terms:
            return None
        library = Library.of(self.data.variables, list(terms))
        values = sided(library, x, u) if mean else library(np.column_stack([x, u]))
        return np.asarray(values @ np.array(list(terms.values())))

    def derivative_traces(self, matrix: Array) -> tuple[Array, Array]:
        """Derivatives (N, states) from the readings (exact where they are known), and those of the equations."""
        d = self.data
        problem = Regression(self._narrow, d.values, d.held, d.period, d.derivatives, self.derivative)
        rate = problem.terms @ matrix.T
        for k in range(len(d.states)):
            known = self._known_rate(k, d.values, d.held, mean=False)
            rate[:, k] += 0.0 if known is None else known
        return problem.left, rate

    # --- matrices

    def widened(self, matrix: Array) -> Array:
        """A narrow matrix as a wide one."""
        out = np.zeros(self.candidates.shape)
        out[: matrix.shape[0], : matrix.shape[1]] = matrix
        return out

    def narrowed(self, matrix: Array) -> Array:
        """The inverse of `widened`."""
        return matrix[: len(self.data.states), : len(self.names)]

    def rows(self, names: Sequence[str]) -> list[int]:
        """The rows of states in a wide matrix; the states of the measurement chain have rows, too."""
        every = [*self.data.states, *(sensor.name for sensor in self.data.sensor_states)]
        return [every.index(s) for s in names]

    # --- free runs

    def experiment(self, stop: int, group: Sequence[str] = (), described: Array | None = None) -> Experiment:
        """The first samples as an experiment.

        Args:
            stop: number of samples.
            group: states that are run; the other states are inputs. (): all states are run.
            described: (stop, states) description of the states; None: as they were read.
        """
        d = self.data
        values = d.values[:stop] if described is None else described
        group = list(group) or list(d.states)
        near = {*group, *(sensor.name for sensor in d.sensor_states if sensor.starts_as in group)}
        running_sensors = [sensor for sensor in d.sensor_states if near & set(sensor.rate)]
        running = [*group, *(sensor.name for sensor in running_sensors)]
        other = [k for k, s in enumerate(d.states) if s not in group]
        idle = [sensor.name for sensor in d.sensor_states if sensor not in running_sensors]
        library = Library.of((*running, *(d.states[k] for k in other), *idle, *d.inputs), self.library.names)
        at = {name: k for k, name in enumerate(running)}
        start_of = tuple(at[sensor.starts_as] if sensor.starts_as else -1 for sensor in running_sensors)
        own = values[:, self.rows(group)]
        guess = np.column_stack([own, *(own[:, f] if f >= 0 else np.zeros(stop) for f in start_of)])
        between = values[:, other]
        between = 0.5 * (between + np.vstack([between[1:], between[-1:]]))  # states are not held: mean over a sample
        inputs = np.column_stack([between, np.zeros((stop, len(idle))), d.held[:stop]])
        outputs = tuple(replace(o, state=at[name], value=o.value[:stop]) for name, o in d.outputs if name in at)
        means = tuple(replace(m, state=at[name]) for name, m in d.means if name in at)
        whole = Experiment(library, np.ascontiguousarray(inputs), d.period, guess, outputs,
                           means, Entries.of(self._fixed_matrix[self.rows(running)]), len(group), start_of)
        return whole.part(0, stop)

    def select_terms(self, first: Array, show: Show = nothing) -> SelectedModel | None:
        """Terms and coefficients by free runs, from a first matrix.

        Where the first model does not track the recording, each group of states is first run alone, with the other
        states as they were read. The result is the start of the common run.

        Args:
            first: (states, terms) first coefficients.
            show: progress display, from 0 to 1.

        Returns:
            None when the first model cannot be run.
        """
        d, start = self.data, self.widened(first)
        shot = self._shortest_shot()
        whole = self.experiment(d.train)
        show(0.1, "fitting free runs")
        fitter = Fitter(whole, Entries.of(start), 0, floor=1.0)
        if not (fitter.fit(rounds=15) and tracks(fitter)):
            better = self._select_by_groups(start.copy(), shot)
            fitter = Fitter(whole, Entries.of(better), 0, floor=1.0)
            if d.sensor_states or (fitter.fit(rounds=15) and tracks(fitter)):
                return select_terms(whole, better, self.candidates, shot, cut=False, score=self.held_out_misfit,
                                    show=show)
        return select_terms(whole, start, self.candidates, shot, score=self.held_out_misfit, show=show)

    def _shortest_shot(self) -> int:
        """Samples of the shortest shots: the width of the widest test function."""
        return 2 * max(half_width(column) for column in self.data.values[: self.data.train].T)

    @property
    def groups(self) -> list[list[str]]:
        """The states that are run together: a state with its derivative, every other state alone."""
        d = self.data
        rates = {s + dataset.RATE for s in d.states} & set(d.states)
        return [[s, s + dataset.RATE] if s + dataset.RATE in rates else [s] for s in d.states if s not in rates]

    def _select_by_groups(self, start: Array, shot: int) -> Array:
        """Choose the terms of each group of states alone; its run then gives a better description of its states.

        Args:
            start: (wide) first coefficients; they are replaced.
            shot: samples of the shortest shots.
        """
        d = self.data
        described, noise = d.values[: d.train].copy(), None if d.noise is None else d.noise.copy()
        size: dict[str, float] = {}
        for sweep in range(SWEEPS):
            if sweep > 1 and len(size) == len(self.groups):
                break
            for group in self.groups:
                experiment = self.experiment(d.train, group, described)
                rows = self.rows(experiment.library.variables[: experiment.n])
                tries: Iterable[Array] = [start] if group[0] in size else chain(
                    (self.widened(self._regress_group(group, most, described, noise)) for most in (MOST, 5, 3, 2, 1)),
                    (self.widened(self._regress_steps(group[0], most, described)) for most in (5, 3, 2)
                     if len(group) == 1))
                for trial in tries:
                    found = select_terms(experiment, trial[rows], self.candidates[rows], shot, cut=False)
                    left = np.inf if found is None else max(found.fitter.scale.values())
                    if found is not None and tracks(found.fitter) and left < size.get(group[0], np.inf):
                        size[group[0]] = left
                        start[rows] = found.matrix
                        states = found.fitter.run(*found.fitter.point)
                        assert states is not None
                        own = self.rows(group)
                        described[:, own] = states[0][:, : len(group)]
                        if noise is not None:
                            noise[own] = NUMERIC * described[:, own].std(axis=0)
                        break
        return start

    def _regress_group(self, group: Sequence[str], most: int, described: Array, noise: Array | None) -> Array:
        """First coefficients (states, terms) of the equations of a group.

        Args:
            group: names of its states.
            most: greatest number of terms in an equation.
            described: (N, states) description of the states.
            noise: (states,) its standard deviation; None: estimated from the description.
        """
        d = self.data
        x, u = described, d.held[: d.train]
        problem: Weak | Regression
        if self.weak:
            problem = Weak(self._narrow, x, u, d.period, noise, None if d.coarse is None else np.zeros(len(d.coarse)))
        else:
            problem = Regression(self._narrow, x, u, d.period, None, self.derivative)
        matrix = np.zeros((len(d.states), len(self.names)))
        for k in self.rows(group):
            if k not in self.exact:
                matrix[k] = regress(problem, k, self._known_rate(k, x, u, mean=self.weak), most=most)
        return matrix

    def _regress_steps(self, state: str, most: int, described: Array) -> Array:
        """First coefficients (states, terms) of a state that settles within a few samples, from sample to sample.

        With f held over a sample, x' = λ x + Σ c f gives x(k+1) = a x(k) + Σ b f, where a = exp(λ h) and
        b = c (a - 1)/λ. This is exact where derivatives fail because the state settles faster than they resolve.

        Args:
            state: its name.
            most: greatest number of terms.
            described: (N, states) description of the states.
        """
        d = self.data
        own = [j for j, name in enumerate(self.names) if name == state]
        others = [j for j, name in enumerate(self.names) if not re.search(rf"\b{state}\b", name)]
        matrix = np.zeros((len(d.states), len(self.names)))
        if not own:
            return matrix
        k = d.states.index(state)
        between = 0.5 * (described[:-1] + described[1:])  # states are not held: mean over a sample
        terms = self._narrow(np.column_stack([between, d.held[: d.train][:-1]]))[:, [*own, *others]]
        terms[:, 0] = described[:-1, k]
        sums = NormalEquations.of(terms, described[1:, k])
        chosen = sums.solve(sorted({0, *ebic_search(sums, most)}))
        a = float(np.clip(chosen[0], 1e-6, 1.0 - 1e-6))
        rate = math.log(a) / d.period
        matrix[k, [*own, *others]] = chosen * rate / (a - 1.0)
        matrix[k, own[0]] = rate
        return matrix

    # --- held-out data

    def held_out_run(self, selected: SelectedModel | None) -> HeldOutRun:
        """Run the model freely from the start of the recording, and compare it with the readings held out."""
        d = self.data
        if selected is None or d.train >= len(d):
            return HeldOutRun({}, None, ())
        if (shots := len(selected.fitter.shots)) > 1:
            note = f"the recording was run in {shots} shots: a free run over all of it does not stay with the readings"
            return HeldOutRun({}, None, (note,))
        run = self._run_on(selected.fitter)
        if run is None:
            return HeldOutRun({}, None, ("the equations diverge on the held-out data",))
        found = {c: FreeRun(float(np.sqrt(np.mean(left**2))), float(np.sqrt(np.mean(sigma**2))))
                 for c, (left, sigma) in self._held_out_residuals(*run).items()}
        notes = []
        worst = max(found, key=lambda c: found[c].gap / found[c].floor, default=None)
        if worst is not None and found[worst].gap > EXPLAINED * found[worst].floor:
            times = found[worst].gap / found[worst].floor
            notes.append(f"the free run misses held-out {worst} by {times:.1f} times its noise: these terms cannot "
                         "describe all of it")
        return HeldOutRun(found, run[1][0][:, : len(d.states)], tuple(notes))

    def held_out_misfit(self, fitted: Fitter) -> float:
        """Mean square of the held-out residuals over their variances, summed over the channels; inf without a run."""
        run = self._run_on(fitted)
        if run is None:
            return np.inf
        return sum(float(np.mean((left / sigma) ** 2)) for left, sigma in self._held_out_residuals(*run).values())

    def _run_on(self, fitted: Fitter) -> tuple[Fitter, list[Array]] | None:
        """Run a fitted model over the whole recording; None with several shots, or with nothing held out."""
        if len(fitted.shots) > 1 or self.data.train >= len(self.data):
            return None
        fitter = Fitter(self.experiment(len(self.data)), fitted.model, 0)
        fitter.steps = fitted.steps
        states = fitter.run(fitter.model, fitted.initial)
        return None if states is None else (fitter, states)

    def _held_out_residuals(self, fitter: Fitter, states: list[Array]) -> dict[str, tuple[Array, Array]]:
        """Residuals of each channel on held-out data, and their standard deviations.

        Args:
            fitter: of the whole recording.
            states: its run.
        """
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
