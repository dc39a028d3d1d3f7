# SPDX-License-Identifier: Apache-2.0
"""Recordings of simulated rigs for the tests: numbers a little off, effects as asked, duty in random steps."""

from __future__ import annotations

import math

import numpy as np

from aeropend_ident.signals.signals import Signals, from_arrays
from aeropend_sim.model import rig
from aeropend_sim.model.effects import DEFINED
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model, load
from aeropend_sim.model.rig import Rig, Sample

BENCH = load("bench")


def steps(duration: float, seed: int, high: float = 0.55) -> np.ndarray:
    """Duty (N,) held for 0.5 to 3 s each, one in six at 0, 0 at the end."""
    rng = np.random.default_rng(seed)
    n = round(duration / SAMPLE_PERIOD)
    duty, k = np.zeros(n), 0
    while k < n:
        hold = round(rng.uniform(0.5, 3.0) / SAMPLE_PERIOD)
        duty[k:k + hold] = 0.0 if rng.random() < 1 / 6 else rng.uniform(0.0, high)
        k += hold
    duty[-250:] = 0.0
    return duty


def drawn_rig(seed: int, effects: dict[str, dict[str, float]], off: float = 0.02) -> Model:
    """`bench` with numbers off by a standard deviation of `off`, and effects; missing parameters at their defaults."""
    rng = np.random.default_rng(10_000 + seed)
    numbers = {k: v * (1.0 + off * rng.standard_normal()) for k, v in BENCH.model.items()}
    full = {id_: {k: p.default for k, p in DEFINED[id_].parameters.items()} | given for id_, given in effects.items()}
    return Model("rig", numbers, BENCH.sensing, full)


class ChangingRig(Rig):
    """A rig whose model changes while it runs; the state goes on."""

    def change(self, model: Model) -> None:
        """Go on with another model, without a command delay."""
        other = Rig(model, self.seed, self.period)
        self.model, self._numbers, self._plant, self._chain = model, other._numbers, other._plant, other._chain


def changing(seed: int, effects: dict[str, dict[str, float]], since: float = 0.0, until: float = math.inf,
             duration: float = 40.0) -> Signals:
    """A recording of a rig whose effects act from an instant on [s], until another [s]."""
    duty = steps(duration, seed)
    with_, without = drawn_rig(seed, effects), drawn_rig(seed, {})
    edges = [round(min(t, duration) / SAMPLE_PERIOD) for t in (0.0, since, until, duration)]
    rig_, parts = ChangingRig(without, seed), []
    for start, stop, model in zip(edges, edges[1:], (without, with_, without)):
        rig_.change(model)
        if stop > start:
            parts.append(rig_.run(duty[start:stop])[0])
    columns = dict(zip(Sample._fields, np.concatenate(parts, axis=1)), duty=duty)
    return from_arrays(columns, SAMPLE_PERIOD, BENCH.sensing)


def recorded(seed: int, effects: dict[str, dict[str, float]] | None = None, duration: float = 20.0,
             off: float = 0.02, without: tuple[str, ...] = ()) -> Signals:
    """A recording of such a rig; channels in `without` are missing."""
    duty = steps(duration, seed)
    columns, _ = rig.record(drawn_rig(seed, effects or {}, off), duty, seed)
    columns["duty"] = duty
    for channel in without:
        columns[channel] = np.full(len(duty), np.nan)
    return from_arrays(columns, SAMPLE_PERIOD, BENCH.sensing)
