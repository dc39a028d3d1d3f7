# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest
from readings import recording
from sparse_data import simulated

from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.identification.dataset import from_arrays, from_bag, from_readings
from aeropend_ident.testing.rigs import BENCH, steps
from aeropend_sim.model import rig
from aeropend_sim.model.parameters import SAMPLE_PERIOD


@pytest.mark.parametrize(("change", "words"), [
    ({"omega": np.nan}, "omega is not a number"),
    ({"i_a": 0.5}, "i_a is 0.5 all the time"),
])
def test_bad_arrays_are_refused_in_one_line(change, words):
    x, v = simulated(6.0)
    for name, value in change.items():
        x[name] = np.full(len(v), value)
    with pytest.raises(RecordingError, match=words) as error:
        from_arrays(x, {"v_a": v}, SAMPLE_PERIOD)
    assert "\n" not in str(error.value)


@pytest.mark.filterwarnings("error")
def test_a_channel_that_is_not_used_may_be_missing():
    duty = steps(8.0, 3)
    columns = {**rig.record(BENCH, duty, 3)[0], "duty": duty}
    columns["i_a"] = np.full(len(duty), np.nan)
    data = from_readings(columns, SAMPLE_PERIOD, BENCH.sensing, ("theta", "theta_dot"), ("omega",))
    assert data.states == ("theta", "theta_dot")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("states", "inputs"), [
    (("i_a",), ("v_a",)), (("omega", "i_a"), ("duty",)), (("theta", "theta_dot"), ("omega",))])
def test_channels_that_are_not_used_may_have_holes(states, inputs):
    duty = steps(8.0, 3)
    columns = {**rig.record(BENCH, duty, 3)[0], "duty": duty}
    for name in {"theta", "omega", "i_a", "v_a"} - {*states, *inputs}:
        columns[name][100:400] = np.nan
    data = from_readings(columns, SAMPLE_PERIOD, BENCH.sensing, states, inputs)
    assert np.isfinite(data.values).all()
    assert np.isfinite(data.held).all()


def test_stamps_that_keep_no_sample_period_are_refused_in_one_line():
    duty = steps(12.0, 3)
    columns = {**rig.record(BENCH, duty, 3)[0], "duty": duty}
    t = np.cumsum(np.where(np.arange(len(duty)) % 4 == 3, 0.4e-3, SAMPLE_PERIOD))
    with pytest.raises(RecordingError, match="its stamps keep no sample period"):
        from_bag(recording(t, **columns), BENCH.sensing)
