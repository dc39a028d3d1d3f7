# SPDX-License-Identifier: Apache-2.0
"""What `precompile` compiles is what a diagnosis runs."""

import pytest

from aeropend_ident.commands import precompile
from aeropend_ident.diagnosis.chain import weak_start
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.testing.rigs import BENCH, recorded
from aeropend_sim.model import dynamics, sensing


def misses():
    return sum(sum(f.stats.cache_misses.values()) for f in (dynamics.run, dynamics.run_arm, dynamics.run_motor,
                                                            sensing.angle_reading, weak_start._turned))


@pytest.mark.promise("Commands", "After `precompile` a first diagnosis compiles nothing")
def test_after_it_a_diagnosis_compiles_nothing():
    assert precompile.main([]) == 0
    before = misses()
    diagnose(BENCH, [recorded(5, {"supply_sag": {}, "thrust_exponent": {}}, 20.0)])
    weak_start.rotor_speed(BENCH, recorded(5, {}, 6.0))
    assert misses() == before
