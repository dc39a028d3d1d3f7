# SPDX-License-Identifier: Apache-2.0
"""Recordings of simulated rigs for the tests: numbers a little off, effects as asked, duty in random steps."""

from __future__ import annotations

import numpy as np

from aeropend_ident.signals.signals import Signals, from_arrays
from aeropend_sim.model import rig
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model, load

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
    full = {id_: {k: p.default for k, p in CATALOGUE[id_].parameters.items()} | given for id_, given in effects.items()}
    return Model("rig", numbers, BENCH.sensing, full)


def recorded(seed: int, effects: dict[str, dict[str, float]] | None = None, duration: float = 40.0,
             off: float = 0.02, without: tuple[str, ...] = ()) -> Signals:
    """A recording of such a rig; channels in `without` are missing."""
    duty = steps(duration, seed)
    columns, _ = rig.record(drawn_rig(seed, effects or {}, off), duty, seed)
    columns["duty"] = duty
    for channel in without:
        columns[channel] = np.full(len(duty), np.nan)
    return from_arrays(columns, SAMPLE_PERIOD, BENCH.sensing)
