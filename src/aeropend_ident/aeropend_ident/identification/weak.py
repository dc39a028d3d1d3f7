# SPDX-License-Identifier: Apache-2.0
"""The weak form: derivatives are moved from the data to smooth test functions.

Weak SINDy: Messenger & Bortz, Multiscale Modeling & Simulation 19, 2021.

∫ -φ' x dt = Σ c ∫ φ f(x, u) dt for test functions φ = (1 - s²)^p of compact support. Over such a function the
trapezoidal rule is exact to high order for smooth f. Where a held input steps, the mean of the terms on both sides of
the step is used, so that the step costs no accuracy.

The width of the functions follows from the spectrum: they pass the frequencies at which the signal exceeds the noise.
Their overlap, and the noise inside the terms, correlate the rows. So the rows are whitened (generalised least squares;
noise inside the terms as in WENDy: Bortz, Messenger & Dukic, Bulletin of Mathematical Biology 85, 2023).

The weak form of a free decay in `diagnosis.chain.nominal_fit` is another problem: of second order, with three fixed
terms and windows of fixed length. The two share no code.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky_banded, solve_banded

from aeropend_ident.identification.subset_selection import NormalEquations
from aeropend_ident.identification.terms import Array, Library
from aeropend_ident.signals.derivatives import noise_of

P = 8
"""Power of the test functions: the function and its first P - 1 derivatives are 0 at the ends. Choice."""

NARROWEST, OVERLAP = 12, 4
"""Least half-width in samples, and half the number of test functions that cover a sample. Choice."""

NUMERIC = 1e-5
"""Least noise of a signal over its standard deviation, for errors of sampling and integration. Choice: -100 dB."""

BLOCKS = 24
"""Number of blocks of rows. Choice."""

ABOVE_NOISE = 3.0
"""Ratio of a signal's power to that of its noise above which it exceeds the noise. Choice."""

NOISE_BAND = 0.7
"""Share of the spectrum above which it is noise. Choice."""

WIDEST = 20
"""A window is no wider than the recording's length over this. Choice."""


@dataclass(frozen=True)
class Windows:
    """Test functions on a grid.

    Attributes:
        half: half-width m in samples.
        first: (K,) first sample of each.
        phi: (2m + 1,) values.
        slope: [1/s] (2m + 1,) derivatives.
    """

    half: int
    first: NDArray[np.int64]
    phi: Array
    slope: Array

    @classmethod
    def over(cls, n: int, half: int, period: float) -> Windows:
        """Overlapping test functions of area 1.

        Args:
            n: number of samples.
            half: half-width in samples.
            period: [s] sample period.

        Raises:
            ValueError: there are fewer samples than a window has.
        """
        if n < 2 * half + 1:
            raise ValueError(f"{n} samples are fewer than the {2 * half + 1} of a window")
        s = np.arange(-half, half + 1) / half
        phi = (1.0 - s * s) ** P
        slope = -2.0 * P * s * (1.0 - s * s) ** (P - 1) / (half * period)
        area = phi.sum() * period
        first = np.arange(0, n - 2 * half, max(1, half // OVERLAP), dtype=np.int64)
        return cls(half, first, phi / area, slope / area)

    def project(self, values: Array, weights: Array) -> Array:
        """Sums of values (N, ...) times weights (2m + 1,) in every window: (K, ...)."""
        length, rest = 2 * self.half + 1, values.shape[1:]
        flat = np.ascontiguousarray(values).reshape(len(values), -1)
        seen = np.lib.stride_tricks.sliding_window_view(flat, length, axis=0)[self.first]
        return np.asarray(seen @ weights).reshape(len(self.first), *rest)


def corner(x: Array) -> float:
    """[cycles per sample] Frequency above which noise hides a signal (N,); 0.5 if it hides it nowhere."""
    n = len(x)
    ramp = np.linspace(x[0], x[-1], n)
    power = np.abs(np.fft.rfft((x - ramp) * np.hanning(n))) ** 2
    bins = np.unique(np.geomspace(1, len(power), 60).astype(int))
    mean = np.array([power[a:b].mean() for a, b in pairwise(bins)])
    floor = float(np.median(power[int(NOISE_BAND * len(power)):]))
    if floor <= 1e-18 * power.max():
        return 0.5
    over = np.flatnonzero(mean > ABOVE_NOISE * floor)
    return float(0.5 * bins[over[-1] + 1] / len(power)) if len(over) else 1.0 / n


def half_width(x: Array) -> int:
    """Half-width in samples of the test functions that pass a signal (N,) up to its `corner`."""
    return max(NARROWEST, round(1.5 * float(np.sqrt(2 * P + 3.0)) / (2.0 * np.pi * corner(x))))


def sided(library: Library, states: Array, inputs: Array) -> Array:
    """Terms (N, terms) at the samples; where a held input steps, the mean of both sides.

    Args:
        library: the terms.
        states: (N, S).
        inputs: (N, U), held from sample to sample.
    """
    now = library(np.column_stack([states, inputs]))
    if inputs.shape[1] == 0:
        return now
    before = library(np.column_stack([states, np.vstack([inputs[:1], inputs[:-1]])]))
    return np.asarray(0.5 * (now + before))


class Weak:
    """The weak form of a recording over a library; each equation has test functions of its own width."""

    def __init__(self, library: Library, states: Array, inputs: Array, period: float, noise: Array | None = None,
                 coarse: Array | None = None) -> None:
        """Evaluate the terms, and choose the widths.

        Args:
            library: terms over states and inputs.
            states: (N, S).
            inputs: (N, U), held from sample to sample.
            period: [s] sample period.
            noise: (S,) standard deviation of the noise of the states; None: estimated from them.
            coarse: (S,) number of samples over which a state was smoothed; no window is narrower.
        """
        self.library, self.states, self.inputs, self.period = library, states, inputs, period
        coarse = np.zeros(states.shape[1]) if coarse is None else coarse
        widest = max(len(states) // WIDEST, NARROWEST)
        self.halves = [int(min(max(half_width(x), c), widest)) for x, c in zip(states.T, coarse)]
        self.terms = sided(library, states, inputs)
        self.noise = np.hypot(noise_of(states) if noise is None else noise, NUMERIC * states.std(axis=0))
        self._windows: dict[int, tuple[Windows, Array]] = {}

    def windows(self, equation: int) -> tuple[Windows, Array]:
        """The test functions of an equation, and the terms (K, terms) integrated over them."""
        half = self.halves[equation]
        if half not in self._windows:
            windows = Windows.over(len(self.states), half, self.period)
            self._windows[half] = windows, windows.project(self.terms, windows.phi) * self.period
        return self._windows[half]

    def blocks(self, equation: int, coefficients: Array | None = None, known: Array | None = None
               ) -> list[NormalEquations]:
        """The whitened regression of one equation, in blocks of time.

        Args:
            equation: index of the state.
            coefficients: (terms,) present estimate, for the noise inside the terms.
            known: (N,) known part of the derivative (discrepancy).
        """
        windows, right = self.windows(equation)
        left = -windows.project(self.states[:, equation], windows.slope) * self.period
        off = np.zeros(len(left)) if known is None else windows.project(known, windows.phi) * self.period
        rows = self._whiten(np.column_stack([right, left - off, off]), equation, coefficients)
        parts = np.array_split(rows, min(BLOCKS, max(1, len(rows) // 8)))
        return [NormalEquations.of(p[:, :-2], p[:, -2], p[:, -1]) for p in parts]

    def _whiten(self, rows: Array, equation: int, coefficients: Array | None) -> Array:
        """Divide rows by a root of their covariance: noise of the state with φ', and of all states inside the terms."""
        w, _ = self.windows(equation)
        step = int(w.first[1] - w.first[0]) if len(w.first) > 1 else 1
        K, length = len(rows), len(w.phi)
        lags = min(K - 1, (length - 1) // step)
        band = np.zeros((lags + 1, K))
        # a residual is left - right: the noise of state j enters with weights -φ ∂f/∂x_j, and -φ' if it is its own
        slopes = np.zeros((len(self.states), self.states.shape[1]))
        if coefficients is not None and np.any(coefficients):
            slopes = self._slopes(coefficients)
        for j in range(self.states.shape[1]):
            if self.noise[j] == 0.0:
                continue
            local = w.project(slopes[:, j : j + 1], w.phi / w.phi.sum())[:, 0]  # mean slope in each window
            for lag in range(lags + 1):
                shift = lag * step
                a, b = slice(shift, length), slice(0, length - shift)
                pp = float(w.phi[a] @ w.phi[b])
                ss = float(w.slope[a] @ w.slope[b]) if j == equation else 0.0
                cross = float(w.slope[a] @ w.phi[b] - w.phi[a] @ w.slope[b]) if j == equation else 0.0
                k = K - lag
                band[lag, :k] += self.noise[j] ** 2 * (
                    ss + pp * local[lag:] * local[:k] + 0.5 * cross * (local[:k] - local[lag:]))
        band *= self.period**2
        scale = float(np.mean((rows[:, -1] + rows[:, -2]) ** 2)) + 1e-300
        band[0] += 1e-12 * scale + 1e-9 * band[0].max()
        root = cholesky_banded(band, lower=True)
        return np.asarray(solve_banded((lags, 0), root, rows))

    def _slopes(self, coefficients: Array) -> Array:
        """Derivatives (N, S) of the right-hand side by the states, by central differences."""
        used = np.flatnonzero(coefficients)
        small = Library.of(self.library.variables, [self.library.names[j] for j in used])
        out = np.empty_like(self.states)
        for j in range(self.states.shape[1]):
            step = 1e-4 * (float(np.std(self.states[:, j])) + 1e-12)
            up, down = self.states.copy(), self.states.copy()
            up[:, j] += step
            down[:, j] -= step
            difference = small(np.column_stack([up, self.inputs])) - small(np.column_stack([down, self.inputs]))
            out[:, j] = difference @ coefficients[used] / (2.0 * step)
        return out
