# SPDX-License-Identifier: Apache-2.0
"""Cut chains of an uncalibrated rig: they count their simulations, and do not repeat a motor's.

Most parameters of such a rig (of the arm, its initial state, its effects) leave the speed as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from multiprocessing import Value

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import CutChain, CutChains
from aeropend_ident.diagnosis.chain.values import Values, acts_on_motor
from aeropend_ident.diagnosis.policy import UNCALIBRATED, Policy, angle_only
from aeropend_ident.signals.signals import Signals
from aeropend_sim.model.parameters import Model

Array = NDArray[np.float64]

KEPT = 2
"""Runs of the motor that are kept (derived: one at the point of a search, one at its last trial)."""


class CachedChain(CutChain):
    """A chain that keeps its last runs of the motor."""

    def motor(self, values: Values, stop: int | None = None) -> tuple[Array, Array, Array]:
        """As `CutChain.motor`."""
        if not angle_only([self.signals]):  # the motor's input changes while the search goes on
            return super().motor(values, stop)
        runs: list[tuple[object, tuple[Array, Array, Array]]] = vars(self).setdefault("kept", [])
        wanted = (stop, tuple(sorted((n, v) for n, v in values.items() if acts_on_motor(n))))
        k = next((k for k, (other, _) in enumerate(runs) if other == wanted), -1)
        run = runs.pop(k) if k >= 0 else (wanted, super().motor(values, stop))
        runs.append(run)
        del runs[:-KEPT]
        return run[1]


class CachedChains(CutChains):
    """Cut chains of an uncalibrated rig, which count how often residuals are computed; see `CutChains`."""

    def __init__(self, model: Model, recordings: Sequence[Signals], policy: Policy = UNCALIBRATED) -> None:
        super().__init__(model, recordings, policy)
        self._counted = Value("q", 0)  # shared: fits run in copies of this process

    def _cut(self, signals: Signals) -> CutChain:
        return CachedChain.cut(self.model, signals)

    @property
    def runs(self) -> int:
        """Number of times that residuals were computed."""
        return self._counted.value

    def residuals(self, stage: str) -> Callable[[Values], dict[str, Array]]:
        """As `CutChains.residuals`, counted."""
        function = super().residuals(stage)

        def counted(values: Values) -> dict[str, Array]:
            with self._counted:
                self._counted.value += 1
            return function(values)

        return counted
