# SPDX-License-Identifier: Apache-2.0
"""A parameter to be estimated with its prior, and the names of values."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LARGEST_POWER = 709.0
"""Power of e below which it is a number (derived: e^709.8 is the largest one)."""

ROUNDING = 1e-9
"""Distance from a bound, in units of the prior, that is rounding (derived: far above that of a double, far below any
change that counts)."""


class Key(NamedTuple):
    """The name of a value or of a channel, in its parts.

    `R_a` is a parameter of the model, `coulomb_friction.accel` one of an effect, `sensing.angle_filter_tau` one of the
    measurement chain, `initial.theta@1` the initial angle of recording 1. Recording 0 has no suffix.

    Attributes:
        owner: the part before the dot; "" for a parameter of the model, or a channel.
        name: the part after it.
        recording: number of the recording.
    """

    owner: str
    name: str
    recording: int

    @property
    def is_initial(self) -> bool:
        """Whether this is a part of an initial state."""
        return self.owner == "initial"

    @property
    def plain(self) -> str:
        """The name without the recording."""
        return f"{self.owner}.{self.name}" if self.owner else self.name

    def of(self, recording: int) -> str:
        """The name of the same value of another recording."""
        return f"{self.plain}@{recording}" if recording else self.plain


@cache
def key(name: str) -> Key:
    """Split a name; the only place that knows its form."""
    plain, _, recording = name.partition("@")
    owner, dot, parameter = plain.partition(".")
    return Key(owner, parameter, int(recording or 0)) if dot else Key("", plain, int(recording or 0))


@dataclass(frozen=True)
class Parameter:
    """A parameter to be estimated, with a normal or log-normal prior.

    Attributes:
        name: see `Key`. `x@k` acts on the channels of recording k.
        mean: of the prior; its median if `log`.
        sd: standard deviation of the prior; that of the logarithm if `log`.
        low: lower bound; positive if `log`.
        high: upper bound.
        start: where a search starts; None: at the mean.
        log: whether the prior is log-normal.
        correlation: (name, correlation) of other parameters with which the prior is correlated, in standard units.
    """

    name: str
    mean: float
    sd: float
    low: float = -np.inf
    high: float = np.inf
    start: float | None = None
    log: bool = False
    correlation: tuple[tuple[str, float], ...] = ()

    @property
    def begin(self) -> float:
        """Where a search starts."""
        return self.mean if self.start is None else self.start

    def to_standard(self, value: float) -> float:
        """A value as a standard normal variable z."""
        if self.log:
            return (np.log(value) - np.log(self.mean)) / self.sd if value > 0.0 else -np.inf
        return (value - self.mean) / self.sd

    def value(self, z: float) -> float:
        """The inverse of `to_standard`; at a bound, rounding does not leave the range."""
        power = self.sd * z
        if not self.log:
            x, unit = float(self.mean + power), self.sd
        else:  # an extrapolation may go anywhere before its bounds hold it
            x = unit = float(self.mean * math.exp(power)) if power < LARGEST_POWER else math.inf
        held = min(max(x, self.low), self.high)
        return held if abs(x - held) < ROUNDING * unit else x

    def slope(self, z: float) -> float:
        """Derivative of the value with respect to z."""
        return self.value(z) * self.sd if self.log else self.sd


def started(parameters: Iterable[Parameter], values: Mapping[str, float]) -> list[Parameter]:
    """The parameters with these values as starts; others keep their start."""
    return [replace(p, start=values.get(p.name, p.start)) for p in parameters]


def prior_information(parameters: Sequence[Parameter]) -> Array:
    """Information matrix (P, P) of the prior in standard units: the inverse of the correlations.

    Two parameters are correlated if both state it: one that replaces another is not.
    """
    at = {p.name: j for j, p in enumerate(parameters)}
    stated = {(at[p.name], at[other]): value for p in parameters for other, value in p.correlation if other in at}
    correlations = np.eye(len(parameters))
    for (j, k), value in stated.items():
        if k < j and (k, j) in stated:
            correlations[j, k] = correlations[k, j] = value
    return np.asarray(np.linalg.inv(correlations))
