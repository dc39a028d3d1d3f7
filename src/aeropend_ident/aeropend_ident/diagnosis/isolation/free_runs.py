# SPDX-License-Identifier: Apache-2.0
"""The share of an effect in the gap of a planned recording, as the verdict would measure it, linear in the numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.free_run import StagedRun
from aeropend_ident.diagnosis.chain.priors import TOLERANCE
from aeropend_ident.diagnosis.free_run_gap import WINDOW, HeldOut
from aeropend_ident.diagnosis.gap_share import Part, unexplained
from aeropend_ident.estimation.parameter import Parameter, key

Array = NDArray[np.float64]

STEP = 0.1
"""Standard deviations of its prior by which a parameter is varied for a derivative (choice: far above rounding)."""

RIDGE = 1e-9
"""Relative ridge that keeps a matrix regular (choice: far below any information)."""


class FreeRuns:
    """Free runs of a planned recording.

    Args:
        chains: cut, of one recording.
        parameters: of the nominal model.
    """

    def __init__(self, chains: CutChains, parameters: Sequence[Parameter]) -> None:
        self.model = chains.model
        (self.signals,) = chains.recordings
        s = self.signals
        held_out = HeldOut(chains, self.model, [s], spikes=False).for_shares()
        self.judged = slice(s.train if held_out.part == "held out" else 0, len(s))
        self._run = StagedRun(self.model, s)
        self.readings = self._run.readings({})
        gap = held_out.gap([self.readings])
        self.spread = gap.spread
        self.rest = unexplained(gap, held_out.floors(), None, None)
        self._known = {c: np.isfinite(s.channel(c)) & ~(s.false_speed if c == "omega" else np.zeros(len(s), bool))
                       for c in self.spread}
        self.noise = self._over_spread({c: s.channel(c) for c in self.spread})
        numbers = [p for p in parameters if not key(p.name).is_initial]
        self._rows = np.array([self.change({p.name: p.mean + STEP * p.sd}) / STEP for p in numbers])
        used = np.hstack([self._weighted(row) for row in self._rows]).reshape(len(numbers), -1)
        self._q, self._r = np.linalg.qr(used.T)

    def _over_spread(self, readings: Mapping[str, Array]) -> Array:
        """(C, N) Difference from the nominal free run, in units of each channel's spread; 0 where nothing was read."""
        return np.array([np.where(self._known[c], np.nan_to_num(readings[c]) - self.readings[c], 0.0) / self.spread[c]
                         for c in self.spread])

    def change(self, values: Mapping[str, float]) -> Array:
        """(C, N) Change of the readings by some values, in units of each channel's spread.

        Args:
            values: of parameters and effects.
        """
        return self._over_spread(self._run.readings(values))

    def _weighted(self, change: Array) -> Array:
        """(M,) A change (C, N) over the fitted part; each channel counts alike."""
        part = slice(0, self.signals.train)
        return np.concatenate([x[part] / math.sqrt(max(int(k[part].sum()), 1))
                               for x, k in zip(change, self._known.values(), strict=True)])

    def rest_of(self, change: Array) -> Array:
        """(C, N) What the parameters, within their tolerances, leave of a change: fitted where a diagnosis fits."""
        ridge = math.sqrt(RIDGE * float(np.sum(self._r**2)) / len(self._r)) * np.eye(len(self._r))
        goal = np.concatenate([self._q.T @ self._weighted(change), np.zeros(len(self._r))])
        z = lsq_linear(np.vstack([self._r, ridge]), goal, (-TOLERANCE, TOLERANCE), method="bvls").x
        return np.asarray(change - np.tensordot(z, self._rows, 1))

    def part(self, name: str, place: str, rest: Array, mirror: float, unsure: float) -> Part:
        """The part of the gap that would come back without an effect (see `gap_share.parts_of_effects`).

        Args:
            name: of the hypothesis.
            place: of the chain.
            rest: of `rest_of`.
            mirror: 1, or -1 for the mirror image of the noise.
            unsure: relative standard deviation of the size.
        """
        x, e = rest[:, self.judged], self.noise[:, self.judged]
        square = x * x + 2.0 * mirror * x * e
        known = np.array([k[self.judged] for k in self._known.values()], float)
        amount = float(np.mean(square.sum(axis=1) / np.maximum(known.sum(axis=1), 1.0)))
        width = max(1, round(WINDOW / self.signals.period))
        edges = np.arange(0, max(square.shape[1] - width, 0) + 1, width)
        in_each = [(square[:, a:a + width].sum(axis=1), known[:, a:a + width].sum(axis=1)) for a in edges]
        windows = [float(np.mean(x / np.maximum(n, 1.0))) for x, n in in_each]
        return Part(name, place, amount, np.array(windows), unsure)
