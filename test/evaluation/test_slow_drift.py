# SPDX-License-Identifier: Apache-2.0
"""Free curves tell a reading that drifts slowly from a force that drifts slowly."""

import numpy as np
import pytest
from evaluation.blind import cases, changes, plant

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.priors import nominal_parameters
from aeropend_ident.diagnosis.search.free_curves import missing_terms
from aeropend_ident.diagnosis.search.search import unsearched
from aeropend_ident.signals.signals import from_arrays
from aeropend_sim.model.parameters import load

BENCH = load("bench")


@pytest.mark.promise("Verdict", "A reading that drifts slowly is told from a force that drifts slowly")
@pytest.mark.parametrize("place", changes.DRIFTING)
@pytest.mark.parametrize("seed", [1, 2])
def test_a_slow_drift_is_placed_where_it_is(place, seed):
    rng = np.random.default_rng(seed)
    duty = cases.duty_signal(rng, 40.0)
    _, columns = changes.drift(place, BENCH.model, BENCH.sensing, duty, rng)
    chains = CutChains(BENCH, [from_arrays({**columns, "duty": duty}, plant.PERIOD, BENCH.sensing)])
    base = unsearched(chains)["arm"].base
    best, other, *_ = missing_terms(chains, "arm", base, nominal_parameters(chains, "arm"))
    assert best.place == place
    assert best.left < 1.1 < base.mean_square
    assert best.left < other.left
