# SPDX-License-Identifier: Apache-2.0
"""Cut chains of a rig with angle and command alone, which count their runs and do not repeat a motor's.

Most unknowns of such a rig (the arm's numbers, where it begins, its effects) leave the speed as it is.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import Chain, Chains, Values
from aeropend_ident.signals.signals import Signals
from aeropend_sim.model import dynamics
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import Model

Array = NDArray[np.float64]

BEHIND = ("mgd_over_J", "c_over_J", "L_over_J", "initial.theta", "initial.theta_dot")
"""Values that act behind the motor."""

RUNS = 2
"""Runs of the motor that are kept: where a search stands, and the last one that it tried."""


class ThriftyChain(Chain):
    """A chain that keeps its last runs of the motor, each thread its own."""

    def motor(self, values: Values, stop: int | None = None) -> tuple[Array, Array, Array]:
        """As `Chain.motor`."""
        s = self.signals
        if s.has("v_a") or s.has("i_a") or s.has("omega"):  # what feeds the motor changes while the search goes on
            return super().motor(values, stop)
        if not hasattr(self, "kept"):
            self.kept = threading.local()
        runs: list[tuple[object, tuple[Array, Array, Array]]] = self.kept.__dict__.setdefault("runs", [])
        steps = dynamics.steps_in(self.valued(values), s.period)
        key = (stop, steps, tuple(sorted((n, v) for n, v in values.items() if _at_motor(n))))
        k = next((k for k, (other, _) in enumerate(runs) if other == key), -1)
        run = runs.pop(k) if k >= 0 else (key, super().motor(values, stop))
        runs.append(run)
        del runs[:-RUNS]
        return run[1]


def _at_motor(name: str) -> bool:
    owner, _, parameter = name.partition(".")
    return name not in BEHIND and owner != "sensing" and not (parameter and owner in CATALOGUE
                                                              and CATALOGUE[owner].place == "arm")


class ThriftyChains(Chains):
    """Chains of an unknown rig; `runs` counts how often their residuals were taken."""

    def __init__(self, model: Model, recordings: Sequence[Signals]) -> None:
        super().__init__(model, recordings, fit_nominal=True)
        self.each = [ThriftyChain.cut(model, signals) for signals in recordings]
        self.runs = 0

    def residuals(self, block: str) -> Callable[[Values], dict[str, Array]]:
        """As `Chains.residuals`, counted."""
        function = super().residuals(block)

        def counted(values: Values) -> dict[str, Array]:
            self.runs += 1
            return function(values)

        return counted
