# SPDX-License-Identifier: Apache-2.0
"""Readings for bench tests: simulated recordings and tables."""

from types import SimpleNamespace

import numpy as np

from aeropend_ident.bench_tests.estimates import Rows
from aeropend_sim.model import rig
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model, load

BENCH = load("bench")


class Read(SimpleNamespace):
    """What the bench tests use of a recording."""

    def __len__(self):
        return len(self.t)


def recorded(model, duty, seed=0, **changed):
    """A recording of a simulated rig."""
    read, _ = rig.record(model, duty, seed)
    columns = {c: read[c] for c in ("theta", "omega", "i_a", "v_a")}
    return Read(path="bag", notes=(), t=np.arange(len(duty)) * SAMPLE_PERIOD, period=SAMPLE_PERIOD, duty=duty,
                **columns, gaps=np.zeros((0, 2), int), channels=("theta", "omega", "i_a", "v_a", "duty"), **changed)


def blocked(seed, effects=None, high=0.6):
    """A recording with a blocked rotor, of steps of the duty up to `high`."""
    model = Model("blocked", {**BENCH.model, "B_m": 10.0}, BENCH.sensing, effects or {})
    return recorded(model, Excitation("steps", duration=10.0, hold_max=1.0, sequence=(0.0, 0.5 * high, high)).series(),
                    seed)


def holds(estimate, true, times=4.0):
    """Whether the truth is within so many standard deviations, which are small."""
    assert 0.0 < estimate.sigma < 0.1 * abs(estimate.value)
    return abs(estimate.value - true) < times * estimate.sigma


def table(columns, name="table"):
    """Rows of a table, by column."""
    return Rows(name, {k: np.asarray(v, float) for k, v in columns.items()})
