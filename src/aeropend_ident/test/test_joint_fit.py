# SPDX-License-Identifier: Apache-2.0
"""The fits without an effect, with which its share of the gap is measured."""

import numpy as np
import pytest

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.free_run_gap import HeldOut
from aeropend_ident.diagnosis.joint_fit import fit_jointly
from aeropend_ident.diagnosis.search.search import search
from aeropend_ident.signals.signals import from_arrays
from aeropend_ident.testing.rigs import BENCH, drawn_rig, steps
from aeropend_sim.model import rig
from aeropend_sim.model.parameters import SAMPLE_PERIOD


@pytest.mark.parametrize("seed", [2, 3])
def test_a_fit_without_an_effect_leaves_a_smaller_gap_than_the_values_beside_the_effect(seed):
    """A current that is read too large: R_a, L_a and K_t can take over a part of it."""
    duty = steps(25.0, seed)
    columns, _ = rig.record(drawn_rig(seed, {"current_gain": {"gain": -0.1}}), duty, seed)
    chains = CutChains(BENCH, [from_arrays({**columns, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)])
    findings = search(chains, 2)
    effects = [h for f in findings.values() for h in f.effects if h.name == "current_gain"]
    joint = fit_jointly(chains, findings, gust=False)
    held_out = HeldOut(chains, BENCH, chains.recordings, spikes=False)
    fitted = joint.without(effects)
    assert all(h.own[0].name not in fitted for h in effects)
    beside = {n: v for n, v in joint.values.items() if n in fitted}
    again, same, after = (held_out.gap_of(v) for v in (fitted, beside, joint.values))
    assert again.total < 0.8 * same.total
    assert again.total > after.total
    nominal = BENCH.model
    assert all(abs(fitted[n] / nominal[n] - 1.0) < 0.0901 for n in ("R_a", "L_a", "K_t", "J_m"))
    assert np.isfinite(list(fitted.values())).all()
