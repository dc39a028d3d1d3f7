# SPDX-License-Identifier: Apache-2.0
"""What earlier verdicts know of a rig: estimates of parameters and effects, with their covariance."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.values import FILTER, PLACE_OF_PARAMETER, limits, stage_at
from aeropend_ident.estimation.parameter import Parameter, key
from aeropend_sim.model.effects import DEFINED, RANDOM

Array = NDArray[np.float64]

LEAST_SD = 1e-6
"""Least standard deviation over the value (choice: below any that matters; it keeps standard units finite)."""


@dataclass(frozen=True)
class Known:
    """Estimates of a rig.

    Attributes:
        names: (P,) parameters of the model, `sensing.angle_filter_tau`, and parameters of effects.
        values: (P,) estimates.
        covariance: (P, P) of the estimates, the scatter between recordings included.
        verdicts: that the estimates are from.
    """

    names: tuple[str, ...]
    values: Array
    covariance: Array
    verdicts: tuple[str, ...]

    def sd(self, name: str) -> float:
        """Standard deviation of an estimate; 0 if it is not known."""
        j = self.names.index(name) if name in self.names else None
        return 0.0 if j is None else float(np.sqrt(self.covariance[j, j]))

    def parameters(self, stages: Collection[str], reach: float) -> list[Parameter]:
        """The estimates that act first in one of some stages, as parameters with correlated priors.

        Args:
            stages: of the cut chain.
            reach: standard deviations up to which an estimate may move.
        """
        deviation = np.sqrt(np.diag(self.covariance))
        least = LEAST_SD * np.abs(self.values)
        mine = [j for j, n in enumerate(self.names)
                if stage_of(n) in stages and key(n).owner not in RANDOM and max(deviation[j], least[j]) > 0.0]
        out = []
        for j in mine:
            name, value, sd = self.names[j], float(self.values[j]), max(float(deviation[j]), float(least[j]))
            low, high = limits(name).low, limits(name).high
            log = key(name).owner == "" and value > 0.0
            spread = sd / value if log else sd
            ends = (value * np.exp(-reach * spread), value * np.exp(reach * spread)) if log else (
                value - reach * sd, value + reach * sd)
            correlation = tuple((self.names[k], float(self.covariance[j, k] / (deviation[j] * deviation[k])))
                                for k in range(len(self.names)) if k != j and deviation[j] * deviation[k] > 0.0)
            out.append(Parameter(name, value, spread, max(low, float(ends[0])), min(high, float(ends[1])), log=log,
                                 correlation=correlation))
        return out


def is_parameter(name: str) -> bool:
    """Whether it names a parameter of the model, the filter of the measurement chain, or a parameter of an effect."""
    k = key(name)
    if k.owner in DEFINED:
        return k.name in DEFINED[k.owner].parameters and k.plain == name
    return name in PLACE_OF_PARAMETER


def stage_of(name: str) -> str:
    """The first stage in which a parameter of the model or of an effect acts."""
    owner = key(name).owner
    if name == FILTER:
        return "arm"
    if owner in DEFINED:
        return stage_at(DEFINED[owner].place, DEFINED[owner].reading)
    return stage_at(PLACE_OF_PARAMETER[name])


def pooled(verdicts: Sequence[Known]) -> Known:
    """The estimates of several verdicts of one rig: their mean, with the scatter between them.

    An estimate that not all have counts where it is there.

    Args:
        verdicts: at least one.
    """
    names = tuple(dict.fromkeys(n for v in verdicts for n in v.names))
    values, covariance = np.zeros(len(names)), np.zeros((len(names), len(names)))
    for j, name in enumerate(names):
        own = [float(v.values[v.names.index(name)]) for v in verdicts if name in v.names]
        values[j] = np.mean(own)
        if len(own) > 1:
            covariance[j, j] = np.var(own, ddof=1)  # of one more recording, not of the mean
    for v in verdicts:
        at = [names.index(n) for n in v.names]
        covariance[np.ix_(at, at)] += v.covariance / len(verdicts)
    return Known(names, values, covariance, tuple(name for v in verdicts for name in v.verdicts))
