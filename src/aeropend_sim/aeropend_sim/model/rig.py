# SPDX-License-Identifier: Apache-2.0
"""The simulated rig: the plant and its measurement chain, one sample or a whole series at a time."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aeropend_sim.model import actuator, dynamics, sensing
from aeropend_sim.model.coefficients import prepare
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model
from aeropend_sim.model.state import State

Array = NDArray[np.float64]


class Sample(NamedTuple):
    """Readings of one sample: rad, rad/s, A, V."""

    theta: float
    omega: float
    i_a: float
    v_a: float


class Truth(NamedTuple):
    """True state of one sample, before the measurement chain: rad, rad/s, A, rad/s, V, rad."""

    theta: float
    theta_dot: float
    i_a: float
    omega: float
    v_a: float
    rotor_angle: float


class Rig:
    """A simulated rig that starts at rest, hanging. The same model, seed and duties give the same samples to the bit.

    Args:
        model: parameters and effects.
        seed: seed of all random numbers.
        period: [s] time between samples.
    """

    def __init__(self, model: Model, seed: int = 0, period: float = SAMPLE_PERIOD) -> None:
        self.model, self.seed, self.period = model, seed, period
        self._numbers = model.numbers()
        self._plant = prepare(model, period)
        self._chain = sensing.prepare(model, period)
        self._errors = sensing.readings_with_errors(model)
        delay = model.effect("command_delay", "delay")
        self._history = math.ceil(delay / period) + 1 if delay else 0
        self.reset()

    def reset(self) -> None:
        """Return to the start: at rest, hanging, with a full battery and the first random numbers."""
        kicks, normal, uniform, turn = np.random.SeedSequence(self.seed).spawn(4)
        self._kicks, self._normal, self._uniform = (np.random.default_rng(s) for s in (kicks, normal, uniform))
        # the first angle of the propeller is random; it decides the time of the first pulse
        angle = 2.0 * math.pi * float(np.random.default_rng(turn).random())
        self._state = State(rotor_angle=angle)
        self._memory = sensing.NOTHING_READ
        self._past = np.zeros(self._history)
        self._count = 0

    def run(self, duty: Array) -> tuple[Array, Array]:
        """Read the rig and advance it over each duty in turn, held for one period.

        Args:
            duty: (N,) 0..1; duty[k] acts from sample k, at which it is already applied, to sample k + 1.

        Returns:
            Readings (4, N) in the order of `Sample`, and states (7, N) in the order of `dynamics.Trajectory`.
        """
        duty = np.ascontiguousarray(duty, dtype=float)
        n, before = len(duty), len(self._past)
        known = np.concatenate([self._past, duty]) if before else duty
        v, sampled = actuator.voltages(self._numbers, known, self.model.effects, self.period, self._count - before)
        if before:
            v, sampled, self._past = v[before:], sampled[before:], known[-before:]
        truth, read = np.empty((7, n)), np.empty((4, n))
        self._state = dynamics.run(v, self._kicks.standard_normal(n), self._state, *self._plant, truth)
        if sampled is not v:
            truth[dynamics.ROW.v_a] += sampled - v
        seen = _with_errors(self.model, truth, self._count, self.period) if self._errors else truth
        self._memory = sensing.read(read, seen, self._normal.standard_normal((n, 4)), self._uniform.random((n, 2)),
                                    self._memory, self._count == 0, self._chain)
        self._count += n
        return read, truth

    def sample(self, duty: float) -> tuple[Sample, Truth]:
        """Read the rig, then advance it over one period.

        Args:
            duty: 0..1; it is applied when the rig is read.
        """
        read, truth = self.run(np.array([duty]))
        return Sample(*read[:, 0].tolist()), Truth(*truth[:len(Truth._fields), 0].tolist())


def _with_errors(model: Model, truth: Array, start: int, period: float) -> Array:
    """The states (7, N) as the sensors see them: with the errors of readings that are given by formulas."""
    seen, row = truth.copy(), dynamics.ROW
    time = period * np.arange(start, start + truth.shape[1])
    seen[row.theta], seen[row.theta_dot] = sensing.seen_angle(model, truth[row.theta], truth[row.theta_dot], period,
                                                              start * period)
    alone = model.with_effects({id_: p for id_, p in model.effects.items() if id_ not in CATALOGUE})
    seen[row.i_a] = sensing.read_current(alone, truth[row.i_a], time)
    seen[row.v_a] = sensing.read_voltage(alone, truth[row.v_a], time)
    return seen


def record(model: Model, duty: Array, seed: int = 0, period: float = SAMPLE_PERIOD
           ) -> tuple[dict[str, Array], dict[str, Array]]:
    """Simulate a new rig over a series of duties.

    Args:
        model: parameters and effects.
        duty: (N,) 0..1.
        seed: seed of all random numbers.
        period: [s] time between samples.

    Returns:
        Readings by the names of `Sample`, states by the names of `dynamics.Trajectory`; each (N,).
    """
    read, truth = Rig(model, seed, period).run(duty)
    return dict(zip(Sample._fields, read)), dict(zip(dynamics.Trajectory._fields, truth))
