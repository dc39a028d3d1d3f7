# SPDX-License-Identifier: Apache-2.0
"""The simulated rig: the plant and its measurement chain, one sample or a whole series at a time."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aeropend_sim.model import actuator, dynamics, sensing
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model

Array = NDArray[np.float64]


class Sample(NamedTuple):
    """What the rig reports at an instant: rad, rad/s, A, V."""

    theta: float
    omega: float
    i_a: float
    v_a: float


class Truth(NamedTuple):
    """The state at that instant before the measurement chain: rad, rad/s, A, rad/s, V, rad."""

    theta: float
    theta_dot: float
    i_a: float
    omega: float
    v_a: float
    rotor_angle: float


class Rig:
    """A rig that starts at rest, hanging; the same model, seed and duties give the same samples to the last bit."""

    def __init__(self, model: Model, seed: int = 0, period: float = SAMPLE_PERIOD) -> None:
        self.model, self.seed, self.period = model, seed, period
        self._numbers = model.numbers()
        self._plant = dynamics.prepare(model, period)
        self._chain = sensing.prepare(model, period)
        delay = model.effect("command_delay", "delay")
        self._history = math.ceil(delay / period) + 1
        self.reset()

    def reset(self) -> None:
        """Back to rest, hanging, with a fresh supply, and to the start of the random numbers."""
        kicks, normal, uniform, turn = np.random.SeedSequence(self.seed).spawn(4)
        self._kicks, self._normal, self._uniform = (np.random.default_rng(s) for s in (kicks, normal, uniform))
        # where the propeller stands when it starts is chance; it decides when the first pulse comes
        angle = 2.0 * math.pi * float(np.random.default_rng(turn).random())
        self._state = dynamics.State(rotor_angle=angle)
        self._memory = sensing.NOTHING_READ
        self._past = np.zeros(self._history)
        self._count = 0

    def run(self, duty: Array) -> tuple[Array, Array]:
        """Read the rig and advance it over each duty in turn, held for one period.

        Args:
            duty: (N,) 0..1; sample k is read with duty[k] applied, which then acts until sample k + 1.

        Returns:
            Readings (4, N) in the order of `Sample`, and states (7, N) in the order of `dynamics.Trajectory`.
        """
        duty = np.ascontiguousarray(duty, dtype=float)
        n = len(duty)
        known = np.concatenate([self._past, duty])
        start = self._count - len(self._past)
        v, sampled = (x[len(self._past):] for x in actuator.voltages(
            self._numbers, known, self.model.effects, self.period, start))
        self._past = known[-self._history:]
        truth, read = np.empty((7, n)), np.empty((4, n))
        self._state = dynamics.run(v, self._kicks.standard_normal(n), self._state, *self._plant, truth)
        truth[dynamics.ROW.v_a] += sampled - v
        self._memory = sensing.read(read, truth, self._normal.standard_normal((n, 4)), self._uniform.random((n, 2)),
                                    self._memory, self._count == 0, self._chain)
        self._count += n
        return read, truth

    def sample(self, duty: float) -> tuple[Sample, Truth]:
        """Read the rig at this instant with a duty (0..1) applied, then advance it over one period."""
        read, truth = self.run(np.array([duty]))
        return Sample(*read[:, 0].tolist()), Truth(*truth[:len(Truth._fields), 0].tolist())


def record(model: Model, duty: Array, seed: int = 0, period: float = SAMPLE_PERIOD
           ) -> tuple[dict[str, Array], dict[str, Array]]:
    """A whole series at once: what a fresh rig reports, and its true states.

    Args:
        model: numbers and effects; duty: (N,) 0..1; seed: of all chance; period: s.

    Returns:
        Readings by the names of `Sample`, states by the names of `dynamics.Trajectory`; each (N,).
    """
    read, truth = Rig(model, seed, period).run(duty)
    return dict(zip(Sample._fields, read)), dict(zip(dynamics.Trajectory._fields, truth))
