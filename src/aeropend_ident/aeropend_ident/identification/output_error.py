# SPDX-License-Identifier: Apache-2.0
"""The fit of a sparse model's coefficients to readings, by free runs (output-error method).

A recording is run in one shot or in several, each from its own initial state, which is fitted as well. If only the
readings are noisy, this is the maximum-likelihood fit (Ljung, System Identification, 1999, ch. 7; multiple shooting:
Bock 1983). Noisy states bias a regression; here no noisy state enters the terms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dsyrk

from aeropend_ident.estimation.residuals import finite
from aeropend_ident.identification.free_run import RightHandSide, Wanted, run, sensitivities
from aeropend_ident.identification.terms import Array, Indices, Library
from aeropend_ident.signals.statistics import effective_sample_size

MOST_STEPS = 16
"""Greatest number of integration steps per sample. Choice."""

NEGLIGIBLE = 0.02
"""RMS error of integration over the RMS of the residual below which the steps are short enough. Choice: it adds 0.04 %
to the variance."""

SLOWEST = 100
"""Number of the lowest lines of a residual's spectrum in which its power is measured: terms act there. Choice."""

FAR = 1e3
"""Distance of a state from its median, over the range of its readings, at which a run counts as diverged. Choice."""

LARGEST = 1e30
"""Largest sensitivity (choice: one beyond it is of an unstable model, and products of it are still numbers)."""

CHUNK_BYTES = 4_000_000
"""[B] Greatest size of the array of sensitivities that is held at a time. Choice: as large as a processor's cache."""


class Weights(NamedTuple):
    """Weights of the channels in the sum of squares.

    Attributes:
        scale: channel -> RMS of its residual, in units of its stated noise.
        variance_inflation: channel -> number of its samples that are worth one independent sample.
    """

    scale: dict[str, float]
    variance_inflation: dict[str, float]


@dataclass(frozen=True)
class Entries:
    """The coefficients of a model: equation (E,), term (E,) and value (E,)."""

    equation: Indices
    term: Indices
    value: Array

    @classmethod
    def of(cls, matrix: Array) -> Entries:
        """The non-zero entries of a matrix (equations, terms)."""
        equation, term = np.nonzero(matrix)
        return cls(equation.astype(np.int64), term.astype(np.int64), matrix[equation, term])

    @classmethod
    def candidates(cls, allowed: Array) -> Entries:
        """An entry of value 0 for each true element of a matrix (equations, terms)."""
        equation, term = np.nonzero(allowed)
        return cls(equation.astype(np.int64), term.astype(np.int64), np.zeros(len(term)))

    def __len__(self) -> int:
        return len(self.value)

    def and_(self, other: Entries) -> Entries:
        """These entries and others."""
        return Entries(np.concatenate([self.equation, other.equation]), np.concatenate([self.term, other.term]),
                       np.concatenate([self.value, other.value]))

    def subset(self, indices: Sequence[int]) -> Entries:
        """The entries with these indices."""
        s = np.array(indices, dtype=int)
        return Entries(self.equation[s], self.term[s], self.value[s])


NO_ENTRIES = Entries(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0))


@dataclass(frozen=True)
class Output:
    """Readings of one state at the samples.

    Attributes:
        name: of the channel.
        state: index of the state.
        value: (N,) the readings, NaN where missing.
        sigma: standard deviation of their noise.
    """

    name: str
    state: int
    value: Array
    sigma: float


@dataclass(frozen=True)
class Means:
    """Mean rates of change of one state over intervals.

    Attributes:
        name: of the channel.
        state: index of the state.
        end: [s] (M,) ends of the intervals.
        length: [s] (M,) their lengths.
        value: (M,) the rates.
        sigma: (M,) standard deviations of their noise.
    """

    name: str
    state: int
    end: Array
    length: Array
    value: Array
    sigma: Array


@dataclass(frozen=True)
class Experiment:
    """The inputs on which a model is run, and the readings with which the run is compared.

    Attributes:
        library: terms over all states and inputs.
        inputs: (N, inputs), each held until the next sample.
        period: [s] sample period.
        guess: (N, states) a description of the states, for the first initial states.
        outputs: readings at the samples.
        means: mean rates over intervals.
        fixed: entries that are not fitted, such as those of the measurement chain.
        free_states: number of states, from the first on, whose initial value is fitted.
        initial_from: state free_states + k starts at the value of state initial_from[k], or at 0 (-1).
    """

    library: Library
    inputs: Array
    period: float
    guess: Array
    outputs: tuple[Output, ...]
    means: tuple[Means, ...] = ()
    fixed: Entries = NO_ENTRIES
    free_states: int = 0
    initial_from: tuple[int, ...] = ()

    @property
    def n(self) -> int:
        """Number of states."""
        return self.guess.shape[1]

    def __len__(self) -> int:
        return len(self.inputs)

    def part(self, start: int, stop: int) -> Experiment:
        """The samples from start to stop as an experiment."""
        first, last = start * self.period, (stop - 1) * self.period
        means = []
        for m in self.means:
            use = (m.end - m.length >= first) & (m.end <= last)
            means.append(replace(m, end=m.end[use] - first, length=m.length[use], value=m.value[use],
                                 sigma=m.sigma[use]))
        return replace(self, inputs=self.inputs[start:stop], guess=self.guess[start:stop],
                       outputs=tuple(replace(o, value=o.value[start:stop]) for o in self.outputs), means=tuple(means))


@dataclass(frozen=True)
class ReducedNormalEquations:
    """Normal equations of one linearisation over coefficients, with the initial states eliminated.

    Around a model, a step δ of its coefficients changes the sum of squares from `cost` by δ'Hδ - 2 g'δ.

    Attributes:
        H: (P, P) matrix.
        g: (P,) right-hand side.
        cost: weighted sum of squares of the residuals.
        count: number of residuals.
        blocks: H and g of equal stretches of time, at the initial states of the whole; their sum is H and g.
    """

    H: Array
    g: Array
    cost: float
    count: int
    blocks: tuple[tuple[Array, Array], ...] = ()


class InitialStep(NamedTuple):
    """The step of a shot's initial state that belongs to a step δ of the coefficients: constant - slope δ.

    Attributes:
        slope: (free states, P).
        constant: (free states,).
    """

    slope: Array
    constant: Array

    def __call__(self, step: Array) -> Array:
        """The step of the initial state for a step (P,) of the coefficients."""
        return np.asarray(self.constant - self.slope @ step)


class FitterState(NamedTuple):
    """All that a `Fitter` changes; see there."""

    model: Entries
    starts: Array
    shots: list[Experiment]
    initial: Array
    weights: Weights
    steps: int


class Fitter:
    """Fits entries to an experiment that is run in shots.

    The method is Gauss-Newton with damping (Levenberg-Marquardt). The initial states are eliminated from the normal
    equations of each shot by their Schur complement, and the Jacobian is summed up in chunks: it is never held as a
    whole.

    Why not `scipy.optimize.least_squares`: the selection of terms needs these normal equations in any case, in blocks
    of time, and each step renews the weights. With the same residuals, Jacobian and minimum, a fit of 9 coefficients to
    34,313 samples of 4 states takes 0.7 of scipy's CPU time in one shot (method `lm`) and 0.3 of it in 34 shots (`trf`,
    sparse Jacobian), measured by the benchmark `sparse-fit`.

    Attributes:
        experiment: inputs and readings.
        model: the entries with their present values.
        starts: first samples of the shots.
        shots: the experiment of each shot.
        initial: (shots, free_states) initial states.
        weights: weights of the channels, from the residuals that were weighed last.
        steps: integration steps per sample.
    """

    def __init__(self, experiment: Experiment, model: Entries, length: int = 0, floor: float = 0.0) -> None:
        """Start from a model.

        Args:
            experiment: inputs and readings.
            model: the entries to fit, with first values.
            length: samples of a shot; 0: one shot.
            floor: lower limit of the weights' scale, in units of the stated noise.
        """
        self.experiment, self.model = experiment, model
        self._floor = floor
        middle = np.median(experiment.guess, axis=0)
        spread = np.ptp(experiment.guess, axis=0) + 1e-12
        self._low, self._high = middle - FAR * spread, middle + FAR * spread
        for k, source in enumerate(experiment.initial_from, experiment.free_states):
            if source < 0:
                self._low[k], self._high[k] = -np.inf, np.inf
        names = [*(o.name for o in experiment.outputs), *(m.name for m in experiment.means)]
        self.weights = Weights(dict.fromkeys(names, 1.0), dict.fromkeys(names, 1.0))
        self.steps = 2
        self._cut_into_shots(length)

    @property
    def scale(self) -> dict[str, float]:
        """RMS of the residual of each channel, in units of its stated noise."""
        return self.weights.scale

    def _cut_into_shots(self, length: int) -> None:
        """Cut the experiment into shots of `length` samples (0: one shot); initial states come from the guess."""
        n = len(self.experiment)
        length = n if length <= 0 else min(length, n)
        shots = max(1, round(n / length))
        edges = np.rint(np.linspace(0, n, shots + 1)).astype(int)
        self.starts = edges[:-1]
        self.shots = [self.experiment.part(a, b) for a, b in pairwise(edges)]
        self.initial = self.experiment.guess[self.starts, : self.experiment.free_states].copy()

    def merge_shots(self, length: int) -> None:
        """Cut into longer shots of `length` samples; a shot that starts where one started keeps its initial state."""
        starts, initial = self.starts, self.initial
        self._cut_into_shots(length)
        nearest = np.abs(self.starts[:, None] - starts[None, :]).argmin(axis=1)
        same = starts[nearest] == self.starts
        self.initial[same] = initial[nearest[same]]

    @property
    def state(self) -> FitterState:
        """All that fitting changes; assign it to restore it."""
        return FitterState(self.model, self.starts, self.shots, self.initial, self.weights, self.steps)

    @state.setter
    def state(self, value: FitterState) -> None:
        self.model, self.starts, self.shots, self.initial, self.weights, self.steps = value

    @property
    def point(self) -> tuple[Entries, Array]:
        """The model and its initial states."""
        return self.model, self.initial

    # --- running

    def _right_hand_side(self, model: Entries) -> RightHandSide:
        every = model.and_(self.experiment.fixed)
        return RightHandSide(np.unique(every.term), self.experiment.library.table, every.equation, every.term,
                             every.value)

    def _start(self, initial: Array) -> Array:
        e = self.experiment
        return np.concatenate([initial, [initial[k] if k >= 0 else 0.0 for k in e.initial_from]])

    def run(self, model: Entries, initial: Array) -> list[Array] | None:
        """The states (N, n) of each shot, or None when one diverges."""
        right = self._right_hand_side(model)
        found = []
        for shot, x0 in zip(self.shots, initial):
            out = np.empty((len(shot), shot.n))
            if not run(self._start(x0), shot.inputs, shot.period, self.steps, right, self._low, self._high, out):
                return None
            found.append(out)
        return found

    def residuals(self, states: Sequence[Array]) -> dict[str, list[Array]]:
        """Readings minus run, in units of the stated noise, by channel and shot."""
        out: dict[str, list[Array]] = {name: [] for name in self.scale}
        for shot, x in zip(self.shots, states):
            for o in shot.outputs:
                known = np.isfinite(o.value)
                out[o.name].append((o.value[known] - x[known, o.state]) / o.sigma)
            grid = np.arange(len(shot)) * shot.period
            for m in shot.means:
                angle = x[:, m.state]
                mean = (np.interp(m.end, grid, angle) - np.interp(m.end - m.length, grid, angle)) / m.length
                out[m.name].append((m.value - mean) / m.sigma)
        return out

    def cost(self, residuals: dict[str, list[Array]], weights: Weights | None = None) -> float:
        """Weighted sum of squares, with the present weights if none are given."""
        scale, inflation = weights or self.weights
        return sum(float(r @ r) / (scale[name] ** 2 * inflation[name])
                   for name, shots in residuals.items() for r in shots)

    def misfit(self, weights: Weights) -> float:
        """Weighted sum of squares of the present model; inf when it diverges."""
        states = self.run(self.model, self.initial)
        return np.inf if states is None else self.cost(self.residuals(states), weights)

    def reweigh(self, residuals: dict[str, list[Array]]) -> None:
        """Renew the weights: the size of each channel's noise, and its colour, from the residuals."""
        scale, inflation = dict(self.weights.scale), dict(self.weights.variance_inflation)
        for name, shots in residuals.items():
            r = np.concatenate(shots)
            if len(r) == 0:
                continue
            scale[name] = max(float(np.sqrt(np.mean(r * r))), self._floor, 1e-300)
            inflation[name] = max(1.0, len(r) / effective_sample_size(r), low_frequency_power_ratio(r))
        self.weights = Weights(scale, inflation)

    # --- linearised

    def normal_equations(self, states: Sequence[Array], wanted: Entries, residuals: dict[str, list[Array]],
                         blocks: int = 1) -> tuple[ReducedNormalEquations, list[InitialStep]]:
        """Linearise a run.

        Args:
            states: the run of each shot.
            wanted: coefficients with respect to which the run is differentiated; their values do not matter.
            residuals: of the run.
            blocks: number of stretches of time whose equations are returned as well.

        Returns:
            The normal equations over `wanted`, and for each shot the step of its initial state.
        """
        p = len(wanted)
        H, g = np.zeros((blocks, p, p)), np.zeros((blocks, p))
        edges = np.rint(np.linspace(0, len(self.experiment), blocks + 1)).astype(int)
        initial_steps = []
        for shot, x in enumerate(states):
            A, b = self._shot_equations(shot, x, wanted, residuals, edges)
            step = _initial_step(A.sum(axis=0), b.sum(axis=0), p)
            initial_steps.append(step)
            # the Schur complement, as a product with A from both sides: it can be split into blocks
            lead = np.vstack([np.eye(p), -step.slope])
            H += np.einsum("ip,kij,jq->kpq", lead, A, lead, optimize=True)
            g += (b - A[:, :, p:] @ step.constant) @ lead
        count = sum(len(r) for shots in residuals.values() for r in shots)
        H = 0.5 * (H + H.transpose(0, 2, 1))
        return ReducedNormalEquations(H.sum(axis=0), g.sum(axis=0), self.cost(residuals), count,
                                      tuple(zip(H, g))), initial_steps

    def _shot_equations(self, shot: int, x: Array, wanted: Entries, residuals: dict[str, list[Array]], edges: Indices
                        ) -> tuple[Array, Array]:
        """Normal equations of one shot over coefficients and initial states.

        Args:
            shot: its index.
            x: (N, n) its run.
            wanted: the coefficients.
            residuals: of the run, by channel and shot.
            edges: (blocks + 1,) first samples of the stretches of time, and the end.

        Returns:
            Matrices (blocks, P + I, P + I) and right-hand sides (blocks, P + I), for I free initial states.
        """
        e, part, first = self.experiment, self.shots[shot], int(self.starts[shot])
        outputs = np.array([o.state for o in e.outputs] + [m.state for m in e.means], dtype=np.int64)
        model, columns = self._right_hand_side(self.model), Wanted(np.unique(wanted.term), wanted.equation, wanted.term,
                                                                   outputs)
        total, blocks = len(wanted) + e.free_states, len(edges) - 1
        carry = np.zeros((e.n, total))
        carry[:e.free_states, len(wanted):] = np.eye(e.free_states)
        for k, source in enumerate(e.initial_from):
            if source >= 0:
                carry[e.free_states + k, len(wanted) + source] = 1.0
        A, b = np.zeros((blocks, total, total)), np.zeros((blocks, total))
        turned = np.empty((len(part), len(e.means), total))
        chunk = max(1, CHUNK_BYTES // (8 * total * max(len(outputs), 1)))
        z = 0
        while z < len(part):
            a, block = z, int(np.searchsorted(edges, first + z, side="right")) - 1
            z = min(a + chunk, len(part), int(edges[block + 1]) - first)
            J = np.empty((z - a, len(outputs), total))
            sensitivities(x[a:z], part.inputs[a:z], part.period, self.steps, model, columns, carry, J)
            J = finite(J, LARGEST)
            for k, o in enumerate(part.outputs):
                weight = 1.0 / (o.sigma * self.weights.scale[o.name] * np.sqrt(self.weights.variance_inflation[o.name]))
                known = np.isfinite(o.value[a:z])
                rows = J[:, k] if known.all() else J[known, k]
                rows = rows * weight
                A[block] += _squared(rows)
                b[block] += rows.T @ ((o.value[a:z] - x[a:z, o.state])[known] * weight)
            if e.means:
                turned[a:z] = J[:, len(part.outputs):]
        grid = np.arange(len(part), dtype=float) * part.period
        for k, m in enumerate(part.means):
            weights = 1.0 / (m.sigma * self.weights.scale[m.name] * np.sqrt(self.weights.variance_inflation[m.name]))
            rows = (_interpolated(m.end, grid, turned[:, k]) - _interpolated(m.end - m.length, grid, turned[:, k]))
            rows = np.asarray(rows * (weights / m.length)[:, None])
            right = residuals[m.name][shot] * m.sigma * weights
            at = np.searchsorted(edges, first + m.end / part.period, side="left") - 1
            for block in range(blocks):
                own = np.flatnonzero(np.clip(at, 0, blocks - 1) == block)
                A[block] += _squared(np.ascontiguousarray(rows[own]))
                b[block] += rows[own].T @ right[own]
        return A, b

    # --- fitting

    def fit(self, rounds: int = 30, tolerance: float = 1e-3) -> bool:
        """Fit the coefficients and the initial states.

        Args:
            rounds: greatest number of steps.
            tolerance: ends the fit when a step is shorter than √tolerance standard deviations of the coefficients, and
                lowers the weighted sum of squares by less than `tolerance`.

        Returns:
            False when the first model diverges.
        """
        states = self.run(self.model, self.initial)
        if states is None:
            return False
        damping = 0.0
        for _ in range(rounds):
            residuals = self.residuals(states)
            self.reweigh(residuals)
            normal, initial_steps = self.normal_equations(states, self.model, residuals)
            found = self._step(normal, initial_steps, damping)
            if found is None:
                return True
            step, decrease, damping, states = found
            damping = 0.0 if damping < 1e-3 else 0.1 * damping
            if float(step @ normal.H @ step) < tolerance and decrease < tolerance:
                break
        return True

    def _step(self, normal: ReducedNormalEquations, initial_steps: list[InitialStep], damping: float
              ) -> tuple[Array, float, float, list[Array]] | None:
        """Take the first step that lowers the cost, with as much damping as that needs.

        Args:
            normal: the linearised problem.
            initial_steps: of each shot.
            damping: to start with.

        Returns:
            The step, the decrease of the cost, the damping and the new run; None when no step lowers the cost.
        """
        while damping < 1e9:
            lifted = normal.H + damping * np.diag(np.diag(normal.H))
            try:
                step = scaled_solve(lifted, normal.g)
            except np.linalg.LinAlgError:
                damping = max(10.0 * damping, 1e-6)
                continue
            model = replace(self.model, value=self.model.value + step)
            initial = self.initial + np.array([own(step) / (1.0 + damping) for own in initial_steps])
            trial = self.run(model, initial)
            if trial is not None:
                new = self.cost(self.residuals(trial))
                if new <= normal.cost * (1.0 + 1e-12) + 1e-9:  # rounding is no increase
                    self.model, self.initial = model, initial
                    return step, normal.cost - new, damping, trial
            damping = max(10.0 * damping, 1e-4)
        return None

    def refine_steps(self) -> None:
        """Shorten the integration steps until their error is negligible beside the noise."""
        states = self.run(self.model, self.initial)
        while states is not None and self.steps < MOST_STEPS:
            self.steps *= 2
            finer = self.run(self.model, self.initial)
            if finer is None:
                break
            error = 0.0
            for o in self.experiment.outputs:
                apart = np.concatenate([a[:, o.state] - b[:, o.state] for a, b in zip(states, finer)])
                error = max(error, float(np.sqrt(np.mean(apart**2))) / (o.sigma * self.scale[o.name]))
            if error < NEGLIGIBLE:
                self.steps //= 2
                break
            states = finer

    def deviations(self) -> Array:
        """Standard deviations (E,) of the coefficients at the present model; infinite for one that nothing shows."""
        states = self.run(self.model, self.initial)
        assert states is not None
        residuals = self.residuals(states)
        self.reweigh(residuals)
        normal, _ = self.normal_equations(states, self.model, residuals)
        return standard_deviations(normal.H)


def low_frequency_power_ratio(r: Array) -> float:
    """Power of a residual (N,) at its lowest frequencies, where terms act, over that of white noise of its variance.

    The error of an input that is held changes rarely. It hardly shows in the correlation of neighbouring samples, but
    it shows here.
    """
    bins = min(SLOWEST, len(r) // 8)
    power = np.abs(np.fft.rfft(r - r.mean())[1 : bins + 1]) ** 2
    return float(power.mean() / max(float(r @ r), 1e-300)) if bins else 1.0


def _initial_step(A: Array, b: Array, p: int) -> InitialStep:
    """Eliminate the unknowns behind the first p from normal equations (P + I, P + I)."""
    corner = A[p:, p:] + 1e-12 * np.diag(np.diag(A[p:, p:])) + 1e-300 * np.eye(len(b) - p)
    back = np.asarray(np.linalg.solve(corner, np.column_stack([A[p:, :p], b[p:]])))
    return InitialStep(back[:, :p], back[:, p])


def _squared(rows: Array) -> Array:
    """rows'rows, at half the cost of a product."""
    low = dsyrk(1.0, rows.T, lower=1)
    return np.asarray(low + np.tril(low, -1).T)


def to_unit_diagonal(H: Array) -> Array:
    """(P,) Factors of rows and columns that make the diagonal 1; 1 where an element is 0, or below it by rounding."""
    diagonal = np.diag(H)
    return np.where(diagonal > 0.0, 1.0 / np.sqrt(np.maximum(diagonal, 1e-300)), 1.0)


def standard_deviations(H: Array) -> Array:
    """Standard deviations (P,) of coefficients with the information matrix H (P, P); infinite where it holds nothing.

    The variance of a coefficient is at least what it is while the others are known: in the scaled matrix, 1. Less, or
    below 0, is of rounding where coefficients cannot be told apart.
    """
    d = to_unit_diagonal(H)
    variances = np.diag(np.linalg.pinv(d[:, None] * H * d, hermitian=True))
    return np.where(np.diag(H) > 0.0, d * np.sqrt(np.maximum(variances, 1.0)), np.inf)


def scaled_solve(H: Array, g: Array) -> Array:
    """Solve H x = g for a symmetric positive definite H whose rows have very different sizes.

    Raises:
        numpy.linalg.LinAlgError: H is not positive definite.
    """
    d = to_unit_diagonal(H)
    low = np.linalg.cholesky(d[:, None] * H * d)
    return np.asarray(d * np.linalg.solve(low.T, np.linalg.solve(low, d * g)))


def _interpolated(time: Array, grid: Array, rows: NDArray[Any]) -> Array:
    """Rows (M, P) at times (M,) between those of a grid (N,), linearly."""
    at = np.clip(time / (grid[1] - grid[0]), 0.0, len(grid) - 1.000001)
    k = at.astype(int)
    part = (at - k)[:, None]
    return np.asarray(rows[k] * (1.0 - part) + rows[k + 1] * part)
