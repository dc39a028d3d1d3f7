# SPDX-License-Identifier: Apache-2.0
"""Free runs of a sparse model, their sensitivities, and the fit of its coefficients to what was measured.

A model is dx/dt = Σ c f(x, u) over entries (equation, term, coefficient). The input is held from sample to sample. A
recording is run in one or more shots, each from an initial state of its own that is fitted along: with noise on the
readings alone this is the maximum-likelihood fit (Ljung, System Identification, 1999, ch. 7; multiple shooting: Bock
1983). Noise in the states, which biases a regression, does not: no noisy state enters the terms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dsyrk

from aeropend_ident.identification.terms import Array, Indices, Library, Table, terms_at
from aeropend_sim.compiled import njit

Flags = NDArray[np.bool_]
Weights = tuple[dict[str, float], dict[str, float]]
"""Channel -> size of its noise; channel -> how coloured it is."""

MOST_STEPS = 16
"""Steps of integration in a sample at most."""

NEGLIGIBLE = 0.02
"""Error of integration, in units of the noise, that is none."""

SLOWEST = 100
"""Lines of a residual's spectrum, from the slowest on, that tell how coloured it is where terms move."""

FAR = 1e3
"""Spreads of a state from its middle at which a run counts as run away."""


@njit(cached=False, inline="always", error_model="numpy")  # for the reason that the terms are
def _rates(x: Array, n: int, which: Indices, table: Table, equation: Indices, term: Indices, c: Array, value: Array,
           slope: Array, rate: Array, jacobian: Array) -> None:
    """Right-hand side and, where slope has rows, its Jacobian at variables x."""
    terms_at(x, which, table, value, slope)
    with_slope = slope.shape[0] > 0
    for i in range(n):
        rate[i] = 0.0
        if with_slope:
            for k in range(n):
                jacobian[i, k] = 0.0
    for k in range(len(c)):
        rate[equation[k]] += c[k] * value[term[k]]
        if with_slope:
            for i in range(n):
                jacobian[equation[k], i] += c[k] * slope[term[k], i]


@njit(error_model="numpy", nogil=True)
def _advance(y: Array, phi: Array, s: float, steps: int, which: Indices, table: Table, equation: Indices,
             term: Indices, c: Array, value: Array, slope: Array, x: Array, rate: Array, j: Array, total: Array,
             turn: Array, now: Array, moved: Array) -> None:
    """Advance the state y (n,), and its derivatives phi (n, n) where they have rows, by steps of s (Runge-Kutta, 4).

    x holds the inputs behind the states; value to moved are room to work in.
    """
    n, m = len(y), phi.shape[0]
    for _ in range(steps):
        for i in range(n):
            x[i] = y[i]
            total[i] = 0.0
        for i in range(m):
            for k in range(m):
                now[i, k] = phi[i, k]
                turn[i, k] = 0.0
        for stage in range(4):
            _rates(x, n, which, table, equation, term, c, value, slope, rate, j)
            weight = s / 3.0 if stage in (1, 2) else s / 6.0
            ahead = s if stage == 2 else 0.5 * s
            for i in range(n):
                total[i] += weight * rate[i]
                x[i] = y[i] + ahead * rate[i]
            for i in range(m):
                for k in range(m):
                    moved[i, k] = 0.0
                for q in range(m):
                    a = j[i, q]
                    if a != 0.0:  # few states act on a state
                        for k in range(m):
                            moved[i, k] += a * now[q, k]
            for i in range(m):
                for k in range(m):
                    turn[i, k] += weight * moved[i, k]
                    now[i, k] = phi[i, k] + ahead * moved[i, k]
        for i in range(n):
            y[i] += total[i]
        for i in range(m):
            for k in range(m):
                phi[i, k] += turn[i, k]


@njit(error_model="numpy", nogil=True)
def _run(x0: Array, u: Array, h: float, steps: int, which: Indices, table: Table, equation: Indices, term: Indices,
         c: Array, low: Array, high: Array, out: Array) -> bool:
    """Run over the samples of u (N, inputs); fills out (N, states). False when a state leaves low..high."""
    n = len(x0)
    x, value, none = np.empty(n + u.shape[1]), np.empty(len(table.first) - 1), np.empty((0, 0))
    rate, total = np.empty(n), np.empty(n)
    y = x0.copy()
    for k in range(len(u)):
        for i in range(n):
            out[k, i] = y[i]
        for i in range(u.shape[1]):
            x[n + i] = u[k, i]
        _advance(y, none, h / steps, steps, which, table, equation, term, c, value, none, x, rate, none, total, none,
                 none, none)
        for i in range(n):
            if not low[i] < y[i] < high[i]:
                return False
    return True


@njit(error_model="numpy", nogil=True)
def _sensitivities(states: Array, u: Array, h: float, steps: int, which: Indices, table: Table, equation: Indices,
                   term: Indices, c: Array, wanted: Indices, p_equation: Indices, p_term: Indices, outputs: Indices,
                   carry: Array, out: Array) -> None:
    """Derivatives of a run's states by coefficients and initial states.

    Args:
        states: (N, n) the run. carry: (n, P + I), derivatives at its first sample, replaced by those after its last.
        wanted: the terms of p_term, without repeats. p_equation, p_term: (P,) the coefficients.
        outputs: (O,) states whose derivatives are kept in out (N, O, P + I).

    What a coefficient adds over a sample is integrated by Simpson's rule.
    """
    n, columns, params = states.shape[1], carry.shape[1], len(p_term)
    terms, variables = len(table.first) - 1, states.shape[1] + u.shape[1]
    value, slope, x, none = np.empty(terms), np.empty((terms, variables)), np.empty(variables), np.empty((0, 0))
    f0, fm, f1 = np.zeros(terms), np.zeros(terms), np.zeros(terms)
    rate, total, j, moved = np.empty(n), np.empty(n), np.empty((n, n)), np.empty((n, n))
    turn, now = np.empty((n, n)), np.empty((n, n))
    first, second, whole, y = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty(n)
    new = np.empty_like(carry)
    half = steps // 2
    for k in range(len(u)):
        for o in range(len(outputs)):
            for p in range(columns):
                out[k, o, p] = carry[outputs[o], p]
        for i in range(n):
            y[i] = x[i] = states[k, i]
            for q in range(n):
                first[i, q] = second[i, q] = 1.0 if i == q else 0.0
        for i in range(u.shape[1]):
            x[n + i] = u[k, i]
        terms_at(x, wanted, table, f0, none)
        _advance(y, first, h / steps, half, which, table, equation, term, c, value, slope, x, rate, j, total, turn, now,
                 moved)
        for i in range(n):
            x[i] = y[i]
        terms_at(x, wanted, table, fm, none)
        _advance(y, second, h / steps, half, which, table, equation, term, c, value, slope, x, rate, j, total, turn,
                 now, moved)
        for i in range(n):
            x[i] = y[i]
        terms_at(x, wanted, table, f1, none)
        for i in range(n):
            for q in range(n):
                whole[i, q] = 0.0
                for r in range(n):
                    whole[i, q] += second[i, r] * first[r, q]
        for i in range(n):
            for p in range(params):
                e, t = p_equation[p], p_term[p]
                push = whole[i, e] * f0[t] + 4.0 * second[i, e] * fm[t]
                if i == e:
                    push += f1[t]
                new[i, p] = h / 6.0 * push
            for p in range(params, columns):
                new[i, p] = 0.0
            for q in range(n):
                a = whole[i, q]
                if a != 0.0:
                    for p in range(columns):
                        new[i, p] += a * carry[q, p]
        carry[:, :] = new


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

    def __len__(self) -> int:
        return len(self.value)

    def and_(self, other: Entries) -> Entries:
        """Both."""
        return Entries(np.concatenate([self.equation, other.equation]), np.concatenate([self.term, other.term]),
                       np.concatenate([self.value, other.value]))


NOTHING = Entries(np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0))


@dataclass(frozen=True)
class Output:
    """What was measured of one state at the samples: `value` (N,), NaN where missing, noise of scale `sigma`."""

    name: str
    state: int
    value: Array
    sigma: float


@dataclass(frozen=True)
class Means:
    """Mean rates of one state over intervals: ends (M,) and lengths (M,) in s, rates (M,), their noise (M,)."""

    name: str
    state: int
    end: Array
    length: Array
    value: Array
    sigma: Array


@dataclass(frozen=True)
class Experiment:
    """What a model is run on and compared with.

    Attributes:
        library: terms over all states and inputs.
        inputs: (N, inputs), each held until the next sample. period: s.
        guess: (N, states) a description of the states, for initial ones.
        outputs, means: what was measured.
        fixed: entries that are not fitted, such as the measurement chain's.
        free_states: how many states, from the first on, have an initial value to be fitted.
        follows: state k > free_states starts at the value of state follows[k - free_states], or at 0 (-1).
    """

    library: Library
    inputs: Array
    period: float
    guess: Array
    outputs: tuple[Output, ...]
    means: tuple[Means, ...] = ()
    fixed: Entries = NOTHING
    free_states: int = 0
    follows: tuple[int, ...] = ()

    @property
    def n(self) -> int:
        """Number of states."""
        return self.guess.shape[1]

    def __len__(self) -> int:
        return len(self.inputs)

    def part(self, start: int, stop: int) -> Experiment:
        """Samples start to stop, as an experiment of its own."""
        first, last = start * self.period, (stop - 1) * self.period
        means = []
        for m in self.means:
            use = (m.end - m.length >= first) & (m.end <= last)
            means.append(replace(m, end=m.end[use] - first, length=m.length[use], value=m.value[use],
                                 sigma=m.sigma[use]))
        return replace(self, inputs=self.inputs[start:stop], guess=self.guess[start:stop],
                       outputs=tuple(replace(o, value=o.value[start:stop]) for o in self.outputs), means=tuple(means))


@dataclass(frozen=True)
class Normal:
    """Normal equations of one linearisation, initial states eliminated: ½δ'Hδ - g'δ + ½ cost over coefficients.

    `blocks` are H and g of equal stretches of time, at the initial states of the whole; they add up to H and g.
    """

    H: Array
    g: Array
    cost: float
    count: int
    blocks: tuple[tuple[Array, Array], ...] = ()


class Fitter:
    """Fits entries to an experiment run in shots.

    Attributes:
        experiment, model: what is fitted to, and the entries with their present values.
        starts: first samples of the shots. initial: (shots, free_states).
        scale: channel -> size of its residual; inflation: channel -> samples one independent sample stands for.
    """

    def __init__(self, experiment: Experiment, model: Entries, length: int = 0, floor: float = 0.0) -> None:
        self.experiment, self.model = experiment, model
        self.floor = floor
        middle = np.median(experiment.guess, axis=0)
        spread = np.ptp(experiment.guess, axis=0) + 1e-12
        self.low, self.high = middle - FAR * spread, middle + FAR * spread
        for k, follows in enumerate(experiment.follows, experiment.free_states):
            if follows < 0:
                self.low[k], self.high[k] = -np.inf, np.inf
        names = [*(o.name for o in experiment.outputs), *(m.name for m in experiment.means)]
        self.scale = dict.fromkeys(names, 1.0)
        self.inflation = dict.fromkeys(self.scale, 1.0)
        self.steps = 2
        self.cut(length)

    def cut(self, length: int) -> None:
        """Cut the experiment into shots of `length` samples (0: one); initial states from the guess."""
        n = len(self.experiment)
        length = n if length <= 0 else min(length, n)
        shots = max(1, round(n / length))
        edges = np.rint(np.linspace(0, n, shots + 1)).astype(int)
        self.starts = edges[:-1]
        self.parts = [self.experiment.part(a, b) for a, b in pairwise(edges)]
        self.initial = self.experiment.guess[self.starts, : self.experiment.free_states].copy()

    def merge(self, length: int) -> None:
        """Cut into longer shots, starting from where the present ones start."""
        starts, initial = self.starts, self.initial
        self.cut(length)
        nearest = np.abs(self.starts[:, None] - starts[None, :]).argmin(axis=1)
        same = starts[nearest] == self.starts
        self.initial[same] = initial[nearest[same]]

    @property
    def state(self) -> tuple[Entries, Array, list[Experiment], Array]:
        """The model, and how and from where it is run; can be put back."""
        return self.model, self.starts, self.parts, self.initial

    @state.setter
    def state(self, value: tuple[Entries, Array, list[Experiment], Array]) -> None:
        self.model, self.starts, self.parts, self.initial = value

    @property
    def point(self) -> tuple[Entries, Array]:
        """The model and its initial states."""
        return self.model, self.initial

    # --- running

    def _start(self, initial: Array) -> Array:
        e = self.experiment
        return np.concatenate([initial, [initial[k] if k >= 0 else 0.0 for k in e.follows]])

    def run(self, model: Entries, initial: Array) -> list[Array] | None:
        """The states (N, n) of each shot, or None when one runs away."""
        every = model.and_(self.experiment.fixed)
        which = np.unique(every.term)
        found = []
        for part, x0 in zip(self.parts, initial):
            out = np.empty((len(part), part.n))
            if not _run(self._start(x0), part.inputs, part.period, self.steps, which, part.library.table,
                        every.equation, every.term, every.value, self.low, self.high, out):
                return None
            found.append(out)
        return found

    def residuals(self, states: Sequence[Array]) -> dict[str, list[Array]]:
        """Measured minus run, in units of the stated noise, by channel and shot."""
        out: dict[str, list[Array]] = {name: [] for name in self.scale}
        for part, x in zip(self.parts, states):
            for o in part.outputs:
                known = np.isfinite(o.value)
                out[o.name].append((o.value[known] - x[known, o.state]) / o.sigma)
            grid = np.arange(len(part)) * part.period
            for m in part.means:
                angle = x[:, m.state]
                mean = (np.interp(m.end, grid, angle) - np.interp(m.end - m.length, grid, angle)) / m.length
                out[m.name].append((m.value - mean) / m.sigma)
        return out

    def cost(self, residuals: dict[str, list[Array]], weights: Weights | None = None) -> float:
        """Sum of squares with these weights, or with those that are in force."""
        scale, inflation = weights or self.weights
        return sum(float(r @ r) / (scale[name] ** 2 * inflation[name])
                   for name, shots in residuals.items() for r in shots)

    @property
    def weights(self) -> Weights:
        """Those that are in force, as they are now."""
        return dict(self.scale), dict(self.inflation)

    def misfit(self, weights: Weights) -> float:
        """The cost of the model as it is, with weights of another; infinite when it runs away."""
        states = self.run(self.model, self.initial)
        return np.inf if states is None else self.cost(self.residuals(states), weights)

    def reweigh(self, residuals: dict[str, list[Array]], *, coloured: bool = True) -> None:
        """Take the size of each channel's noise, and how coloured it is, from its residuals."""
        from aeropend_ident.signals.statistics import effective_sample_size

        for name, shots in residuals.items():
            r = np.concatenate(shots)
            if len(r) == 0:
                continue
            self.scale[name] = max(float(np.sqrt(np.mean(r * r))), self.floor, 1e-300)
            self.inflation[name] = max(1.0, len(r) / effective_sample_size(r), slow_share(r)) if coloured else 1.0

    # --- linearised

    def normal(self, states: Sequence[Array], wanted: Entries, residuals: dict[str, list[Array]],
               *, initial: bool = True, blocks: int = 1) -> tuple[Normal, list[tuple[Array, Array, Array]]]:
        """The normal equations over `wanted` at a run, and for each shot what gives its initial state back.

        Args:
            states: of each shot. wanted: coefficients to take derivatives by; their values do not matter.
            residuals: of the run. initial: whether initial states are fitted along. blocks: stretches of time.
        """
        every = self.model.and_(self.experiment.fixed)
        which, terms = np.unique(every.term), np.unique(wanted.term)
        e = self.experiment
        free = e.free_states
        total = len(wanted) + free
        outputs = [o.state for o in e.outputs] + [m.state for m in e.means]
        H, g = np.zeros((blocks, len(wanted), len(wanted))), np.zeros((blocks, len(wanted)))
        backs = []
        edges = np.rint(np.linspace(0, len(e), blocks + 1)).astype(int)
        for shot, (part, x) in enumerate(zip(self.parts, states)):
            carry = np.zeros((e.n, total))
            carry[:free, len(wanted):] = np.eye(free)
            for k, follows in enumerate(e.follows):
                if follows >= 0:
                    carry[free + k, len(wanted) + follows] = 1.0
            A, b = np.zeros((blocks, total, total)), np.zeros((blocks, total))
            first = int(self.starts[shot])
            turned = np.empty((len(part), len(e.means), total))
            chunk = max(1, 4_000_000 // (total * max(len(outputs), 1) * 8))
            z = 0
            while z < len(part):
                a, block = z, int(np.searchsorted(edges, first + z, side="right")) - 1
                z = min(a + chunk, len(part), int(edges[block + 1]) - first)
                J = np.empty((z - a, len(outputs), total))
                _sensitivities(x[a:z], part.inputs[a:z], part.period, self.steps, which, part.library.table,
                               every.equation, every.term, every.value, terms, wanted.equation, wanted.term,
                               np.array(outputs, dtype=np.int64), carry, J)
                for k, o in enumerate(part.outputs):
                    weight = 1.0 / (o.sigma * self.scale[o.name] * np.sqrt(self.inflation[o.name]))
                    known = np.isfinite(o.value[a:z])
                    rows = J[:, k] if known.all() else J[known, k]
                    rows = rows * weight
                    A[block] += _squared(rows)
                    b[block] += rows.T @ ((o.value[a:z] - x[a:z, o.state])[known] * weight)
                if e.means:
                    turned[a:z] = J[:, len(part.outputs):]
            grid = np.arange(len(part), dtype=float) * part.period
            for k, m in enumerate(part.means):
                weight = 1.0 / (m.sigma * self.scale[m.name] * np.sqrt(self.inflation[m.name]))
                rows = (_between(m.end, grid, turned[:, k]) - _between(m.end - m.length, grid, turned[:, k]))
                rows = np.asarray(rows * (weight / m.length)[:, None])
                right = residuals[m.name][shot] * m.sigma * weight
                at = np.searchsorted(edges, first + m.end / part.period, side="left") - 1
                for block in range(blocks):
                    own = np.flatnonzero(np.clip(at, 0, blocks - 1) == block)
                    A[block] += _squared(np.ascontiguousarray(rows[own]))
                    b[block] += rows[own].T @ right[own]
            p = len(wanted)
            if initial:
                whole, right = A.sum(axis=0), b.sum(axis=0)
                corner = whole[p:, p:] + 1e-12 * np.diag(np.diag(whole[p:, p:])) + 1e-300 * np.eye(free)
                back = np.asarray(np.linalg.solve(corner, np.column_stack([whole[p:, :p], right[p:]])))
                backs.append((back[:, :p], back[:, p], np.asarray(corner)))
                # every row less what the initial states take of it
                lead = np.vstack([np.eye(p), -back[:, :p]])
                H += np.einsum("ip,kij,jq->kpq", lead, A, lead, optimize=True)
                g += (b - A[:, :, p:] @ back[:, p]) @ lead
            else:
                H += A[:, :p, :p]
                g += b[:, :p]
        count = sum(len(r) for shots in residuals.values() for r in shots)
        H = 0.5 * (H + H.transpose(0, 2, 1))
        return Normal(H.sum(axis=0), g.sum(axis=0), self.cost(residuals), count, tuple(zip(H, g))), backs

    def fit(self, rounds: int = 30, tolerance: float = 1e-3) -> bool:
        """Gauss-Newton with damping (Levenberg-Marquardt) over coefficients and initial states.

        Ends when a step is small beside the standard deviations of what is fitted.

        Returns:
            Whether the model can be run at all.
        """
        states = self.run(self.model, self.initial)
        if states is None:
            return False
        damping = 0.0
        for _ in range(rounds):
            residuals = self.residuals(states)
            self.reweigh(residuals)
            cost = self.cost(residuals)
            normal, backs = self.normal(states, self.model, residuals)
            moved = None
            while damping < 1e9:
                lifted = normal.H + damping * np.diag(np.diag(normal.H))
                try:
                    step = scaled_solve(lifted, normal.g)
                except np.linalg.LinAlgError:
                    damping = max(10.0 * damping, 1e-6)
                    continue
                model = replace(self.model, value=self.model.value + step)
                initial = self.initial + np.array([
                    (own - cross @ step) / (1.0 + damping) for cross, own, _ in backs])
                trial = self.run(model, initial)
                if trial is not None:
                    new = self.cost(self.residuals(trial))
                    if new <= cost * (1.0 + 1e-12) + 1e-9:
                        moved = cost - new
                        break
                damping = max(10.0 * damping, 1e-4)
            if moved is None:
                return True
            assert trial is not None
            self.model, self.initial, states = model, initial, trial
            damping = 0.0 if damping < 1e-3 else 0.1 * damping
            if float(step @ normal.H @ step) < tolerance and moved < tolerance:
                break
        return True

    def refine_steps(self) -> None:
        """Shorten the steps of integration until they are no source of error beside the noise."""
        states = self.run(self.model, self.initial)
        while states is not None and self.steps < MOST_STEPS:
            self.steps *= 2
            finer = self.run(self.model, self.initial)
            if finer is None:
                break
            off = 0.0
            for o in self.experiment.outputs:
                apart = np.concatenate([a[:, o.state] - b[:, o.state] for a, b in zip(states, finer)])
                off = max(off, float(np.sqrt(np.mean(apart**2))) / (o.sigma * self.scale[o.name]))
            if off < NEGLIGIBLE:
                self.steps //= 2
                break
            states = finer

    def covariance(self) -> Array:
        """Covariance (E, E) of the coefficients at the present model."""
        states = self.run(self.model, self.initial)
        assert states is not None
        residuals = self.residuals(states)
        self.reweigh(residuals)
        normal, _ = self.normal(states, self.model, residuals)
        d = 1.0 / np.sqrt(np.maximum(np.diag(normal.H), 1e-300))
        return d[:, None] * np.linalg.pinv(d[:, None] * normal.H * d, hermitian=True) * d


def slow_share(r: Array) -> float:
    """Power of a residual (N,) in the slowest band over what it would be were it white; terms move in that band.

    An error of the input, constant while that is held, hardly shows in the correlation of neighbours; here it does.
    """
    bins = min(SLOWEST, len(r) // 8)
    power = np.abs(np.fft.rfft(r - r.mean())[1 : bins + 1]) ** 2
    return float(power.mean() / max(float(r @ r), 1e-300)) if bins else 1.0


def _squared(rows: Array) -> Array:
    """rows'rows, at half the cost of a product."""
    low = dsyrk(1.0, rows.T, lower=1)
    return np.asarray(low + np.tril(low, -1).T)


def scaled_solve(H: Array, g: Array) -> Array:
    """Solve H x = g for a symmetric positive H whose rows have very different sizes.

    Raises:
        numpy.linalg.LinAlgError: it is not positive definite.
    """
    d = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    low = np.linalg.cholesky(d[:, None] * H * d)
    return np.asarray(d * np.linalg.solve(low.T, np.linalg.solve(low, d * g)))


def _between(time: Array, grid: Array, rows: NDArray[Any]) -> Array:
    """Rows (M, P) at times between those of a grid, linear."""
    at = np.clip(time / (grid[1] - grid[0]), 0.0, len(grid) - 1.000001)
    k = at.astype(int)
    part = (at - k)[:, None]
    return np.asarray(rows[k] * (1.0 - part) + rows[k + 1] * part)
