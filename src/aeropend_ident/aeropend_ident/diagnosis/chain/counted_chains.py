# SPDX-License-Identifier: Apache-2.0
"""Cut chains of an uncalibrated rig, which count their simulations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from multiprocessing import Value

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.values import Values
from aeropend_ident.diagnosis.policy import UNCALIBRATED, Policy
from aeropend_ident.signals.signals import Signals
from aeropend_sim.model.parameters import Model

Array = NDArray[np.float64]


class CountedChains(CutChains):
    """Cut chains of an uncalibrated rig, which count how often residuals are computed; see `CutChains`."""

    def __init__(self, model: Model, recordings: Sequence[Signals], policy: Policy = UNCALIBRATED) -> None:
        super().__init__(model, recordings, policy)
        self._counted = Value("q", 0)  # shared: fits run in copies of this process

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
