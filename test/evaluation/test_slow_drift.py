# SPDX-License-Identifier: Apache-2.0
"""Free curves tell a reading that drifts slowly from a force that drifts slowly."""

import numpy as np
import pytest
from evaluation.blind import cases, plant

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.priors import nominal_parameters
from aeropend_ident.diagnosis.search.free_curves import missing_terms
from aeropend_ident.diagnosis.search.search import unsearched
from aeropend_ident.signals.signals import from_arrays
from aeropend_sim.model.parameters import load

BENCH = load("bench")


def drifting(place, amount, seed, duration=40.0):
    """A recording whose angle reading drifts by `amount` rad, or whose arm is driven by a torque that turns it so far."""
    rng = np.random.default_rng(seed)
    duty = cases.duty_signal(rng, duration)
    p = plant.packed(BENCH.model, BENCH.sensing["angle_filter_tau"], {}, {}, other=False)
    drift = amount * np.arange(len(duty) + 2) / len(duty)
    y, v, _ = plant.states(p, duty, BENCH.model["mgd_over_J"] * drift if place == "arm" else np.zeros(0))
    if place == "sensing":
        y[:, plant.S.stage2] += drift[:len(duty)]
    return from_arrays({**plant.measured(p, y, v, BENCH.sensing, rng), "duty": duty}, plant.PERIOD, BENCH.sensing)


@pytest.mark.promise("Verdict", "A reading that drifts slowly is told from a force that drifts slowly")
@pytest.mark.parametrize("place", ["sensing", "arm"])
@pytest.mark.parametrize(("amount", "seed"), [(0.06, 1), (-0.03, 2)])
def test_a_slow_drift_is_placed_where_it_is(place, amount, seed):
    chains = CutChains(BENCH, [drifting(place, amount, seed)])
    base = unsearched(chains)["arm"].base
    best, other, *_ = missing_terms(chains, "arm", base, nominal_parameters(chains, "arm"))
    assert best.place == place
    assert best.left < 1.1 < base.mean_square
    assert best.left < other.left
