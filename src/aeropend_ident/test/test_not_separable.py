# SPDX-License-Identifier: Apache-2.0
"""Which pairs of effects the verdict calls not separable."""

import numpy as np

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.conclude import not_separable, stand_ins
from aeropend_ident.diagnosis.gap_share import Part
from aeropend_ident.diagnosis.search.findings import Findings, RankedHypothesis
from aeropend_ident.diagnosis.search.hypotheses import hypotheses
from aeropend_ident.diagnosis.search.search import refit, unsearched
from aeropend_ident.estimation.map_fit import estimate
from aeropend_ident.testing.rigs import BENCH, recorded


def test_a_rival_is_compared_beside_the_other_effects_of_its_stage():
    """A cable stays unexplained: what the lags differ by is less than what it leaves."""
    made = recorded(3, {"thrust_lag": {"tau": 0.05}, "coulomb_friction": {"accel": 0.15},
                        "cable_torque": {"k": 0.3, "theta0": 0.3}}, 20.0)
    chains = CutChains(BENCH, [made])
    base = unsearched(chains)["arm"].base
    of = {h.effect: h for h in hypotheses(BENCH)}
    lag, late, friction, flex = (of[e] for e in ("thrust_lag", "encoder_lag", "coulomb_friction", "mast_flex"))
    final = refit(chains, "arm", [lag, friction], base.values)

    def ranked(h, fit, gain, probability):
        return RankedHypothesis(h, fit, gain, probability)

    alone = [ranked(h, refit(chains, "arm", [h], base.values), gain, 0.0) for h, gain in ((late, 480.0), (flex, 60.0))]
    found = ((ranked(lag, final, 500.0, 1.0), *alone), (ranked(friction, final, 50.0, 1.0),))
    pairs = not_separable(chains, {"arm": Findings("arm", base, final, found)})
    assert [(first.hypothesis.effect, rival.hypothesis.effect) for first, rival in pairs] == [
        ("thrust_lag", "encoder_lag")]


def test_an_effect_found_that_stands_in_for_another_is_not_separable_from_it():
    of = {h.effect: h for h in hypotheses(BENCH) if not h.parameter}
    fit = estimate({}, {})
    drop, sag = (RankedHypothesis(of[e], fit, 100.0, 1.0) for e in ("bridge_drop", "supply_sag"))
    parts = [Part("bridge_drop", "actuator", 1.0, np.ones(3)),
             Part("supply_sag", "actuator", 0.5, np.ones(3), instead_of="bridge_drop")]
    assert stand_ins(parts, {"actuator": Findings("actuator", fit, fit, ((drop,), (sag,)))}) == [(drop, sag)]


def test_an_effect_that_was_taken_out_counts_as_tried():
    flex = next(h for h in hypotheses(BENCH) if h.effect == "mast_flex")
    one, other = ((RankedHypothesis(flex, estimate({"x": 1.0, "y": 2.0}, {}), 9.0, 0.9),) for _ in range(2))
    f = Findings("arm", one[0].fit, one[0].fit, (one,), cut_short=True).without(one)
    assert [(r.hypothesis, r.probability) for r in f.rivals] == [(flex, 0.0)]
    assert other not in (one,)  # two selections of one effect are told apart
