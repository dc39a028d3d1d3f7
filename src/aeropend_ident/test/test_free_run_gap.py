# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from aeropend_ident.diagnosis.chain.free_run import free_run
from aeropend_ident.diagnosis.free_run_gap import closure, floor, gap
from aeropend_ident.testing.rigs import BENCH, drawn_rig, recorded
from aeropend_sim.readings import MOST


def measured(model, seed=21, effects=None):
    signals = recorded(seed, effects, duration=25.0)
    start, stop = signals.train, len(signals)
    return gap(free_run(model, signals), signals, start, stop), floor(signals, start, stop)


@pytest.mark.promise("Verdict", "The floor is what a perfect model leaves")
def test_the_true_model_runs_down_to_the_floor():
    found, floors = measured(drawn_rig(21, {}))
    for channel in ("theta", "i_a", "v_a"):
        assert found.rms[channel] == pytest.approx(floors[channel], rel=0.1)
    assert found.rms["omega"] < 2.0 * floors["omega"]
    assert found.total == pytest.approx(
        np.sqrt(np.mean([(found.rms[c] / found.spread[c]) ** 2 for c in found.rms])))


@pytest.mark.promise("Verdict", "The share of the gap that is closed has an interval")
def test_share_of_what_can_close():
    effects = {"coulomb_friction": {}}
    before, floors = measured(BENCH, effects=effects)
    after, _ = measured(drawn_rig(21, effects), effects=effects)
    share, low, high = closure(before, after, floors)
    assert 0.97 < low <= share <= high <= 1.0
    assert closure(before, before, floors)[0] == pytest.approx(0.0)
    assert closure(after, after, floors) == (None, None, None)


@pytest.mark.filterwarnings("error")
def test_a_run_that_gives_no_number_diverges_without_warning():
    signals = recorded(21, duration=8.0)
    nothing = {c: np.full(len(signals), np.nan) for c in ("theta", "omega", "i_a", "v_a")}
    found = gap(nothing, signals, signals.train, len(signals))
    assert found.diverges
    assert found.rms == {c: pytest.approx(2.0 * MOST[c]) for c in found.rms}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("end", [np.nan, np.inf, 1e300])
def test_a_run_that_diverges_at_its_end_has_a_large_gap(end):
    signals = recorded(21, duration=8.0)
    run = {c: np.nan_to_num(signals.channel(c)) for c in ("theta", "omega", "i_a", "v_a")}
    run["theta"][-3:] = end
    found = gap(run, signals, signals.train, len(signals))
    assert found.diverges
    assert 2.0 * MOST["theta"] > found.rms["theta"] > 0.03 * MOST["theta"]
    assert found.rms["i_a"] < 1e-9
    assert np.isfinite(found.windows).all()
