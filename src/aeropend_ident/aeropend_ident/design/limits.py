# SPDX-License-Identifier: Apache-2.0
"""What an experiment must not exceed, for every rig within the uncertainty of its model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.free_run import free_run
from aeropend_ident.diagnosis.chain.priors import NOMINAL_SD, TOLERANCE
from aeropend_ident.signals.signals import Signals
from aeropend_sim.errors import UserError
from aeropend_sim.model.parameters import MODEL_NAMES, Model

Array = NDArray[np.float64]
Ranges = dict[str, tuple[float, float]]
"""Channel -> least and greatest value, in SI units."""


class LimitError(UserError):
    """Limits that contradict each other, or that no signal keeps. The message is one line."""


@dataclass(frozen=True)
class Limits:
    """What an experiment must not exceed.

    Attributes:
        theta: [rad] least and greatest angle of the arm.
        omega: [rad/s] greatest speed of the rotor.
        i_a: [A] greatest current, in either direction.
        duty: [-1..1] least and greatest duty.
        duty_rate: [1/s] greatest rate of the duty; 0: it may jump.

    Raises:
        LimitError: an empty range, or one without the rest (angle 0, duty 0).
    """

    theta: tuple[float, float] = (-0.5 * math.pi, 0.5 * math.pi)
    omega: float = math.inf
    i_a: float = math.inf
    duty: tuple[float, float] = (0.0, 0.6)
    duty_rate: float = 0.0

    def __post_init__(self) -> None:
        for name, (low, high), unit in (("angle", self.theta, " rad"), ("duty", self.duty, "")):
            if not low <= 0.0 < high:
                raise LimitError(f"{name} {low:g} to {high:g}{unit}: give a range that holds 0, where the rig rests")
        for name, most in (("speed", self.omega), ("current", self.i_a)):
            if not most > 0.0:
                raise LimitError(f"{name} {most:g}: give a limit above 0")
        if not (self.duty[0] >= -1.0 and self.duty[1] <= 1.0):
            raise LimitError(f"duty {self.duty[0]:g} to {self.duty[1]:g}: give a range within -1 to 1")
        if not (math.isfinite(self.duty_rate) and self.duty_rate >= 0.0):
            raise LimitError(f"duty rate {self.duty_rate:g} 1/s: give 0 (it may jump) or more")

    @property
    def ranges(self) -> Ranges:
        """The ranges of the channels."""
        return {"theta": self.theta, "omega": (-self.omega, self.omega), "i_a": (-self.i_a, self.i_a)}

    def excess(self, reach: Ranges) -> float:
        """By what share of its limit the worst channel is beyond it; negative: the share that is left.

        Args:
            reach: what the channels reach.
        """
        worst = -math.inf
        for channel, (low, high) in self.ranges.items():
            least, greatest = reach[channel]
            if math.isfinite(high):
                worst = max(worst, greatest / high - 1.0)
            if math.isfinite(low) and low < 0.0:
                worst = max(worst, least / low - 1.0)
            elif low == 0.0 and least < 0.0:
                worst = max(worst, -least / high)
        return worst

    def crossed(self, reach: Ranges) -> bool:
        """Whether a channel is beyond its limit."""
        return any(not low <= least <= greatest <= high for (low, high), (least, greatest) in
                   ((limit, reach[c]) for c, limit in self.ranges.items()))


def reach_of(readings: Mapping[str, Array]) -> Ranges:
    """What the channels reach; infinite for a run that diverges."""
    return {c: (float(x.min()), float(x.max())) if np.isfinite(x := readings[c]).all() else (-math.inf, math.inf)
            for c in ("theta", "omega", "i_a")}


def drawn(model: Model, effects: Sequence[Mapping[str, float]], rng: np.random.Generator) -> dict[str, float]:
    """The values of a rig within the uncertainty: numbers in their tolerance, and one of some effects, or none.

    Args:
        model: the nominal model.
        effects: values of each effect at its greatest size.
        rng: draws.
    """
    reach = TOLERANCE * NOMINAL_SD
    values = {n: x * (1.0 + reach * rng.uniform(-1.0, 1.0)) for n, x in model.model.items() if n in MODEL_NAMES}
    k = int(rng.integers(len(effects) + 1))
    return values if k == len(effects) else {**values, **effects[k]}


def crossings(model: Model, signals: Signals, limits: Limits, effects: Sequence[Mapping[str, float]], draws: int,
              seed: int) -> int:
    """The number of drawn rigs that cross a limit.

    Args:
        model: the nominal model.
        signals: the experiment, with the time after its end in which the arm comes to rest.
        limits: that must hold.
        effects: values of each effect that a rig may have.
        draws: rigs.
        seed: of the draws.
    """
    rng = np.random.default_rng(seed)
    rigs = [drawn(model, effects, rng) for _ in range(draws)]
    return sum(limits.crossed(reach_of(free_run(model, signals, rig))) for rig in rigs)
