# SPDX-License-Identifier: Apache-2.0

import numpy as np
import pytest
from sparse_data import STATES, TRUE, simulated

from aeropend_ident.identification.dataset import from_arrays, from_readings
from aeropend_ident.identification.output_error import Entries, Fitter
from aeropend_ident.identification.output_error_selection import tracks
from aeropend_ident.identification.problem import Problem
from aeropend_ident.identification.terms import TermError, thesis_terms
from aeropend_ident.testing.rigs import BENCH
from aeropend_sim.model import rig
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD


@pytest.fixture(scope="module")
def measured():
    """10 s of the rig, through its measurement chain."""
    duty = Excitation(duration=10.0).series()
    read, _ = rig.record(BENCH, duty, 0)
    return Problem(from_readings({**read, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing), thesis_terms((*STATES, "v_a")))


def test_a_state_and_its_derivative_are_run_together(measured):
    assert measured.groups == [["theta", "theta_dot"], ["i_a"], ["omega"]]
    assert measured.exact == {0: {"theta_dot": 1.0}}


def test_the_measurement_chain_has_rows_that_are_not_fitted(measured):
    rows = measured.rows(["theta_stage1", "theta_stage2", "rotor_angle"])
    assert rows == [4, 5, 6]
    assert not measured.candidates[rows].any()
    narrow = np.arange(4.0 * 31).reshape(4, 31)
    assert (measured.narrowed(measured.widened(narrow)) == narrow).all()
    assert not measured.widened(narrow)[rows].any()


def test_a_group_runs_with_the_sensor_states_that_show_it(measured):
    alone = measured.experiment(1000, ["omega"])
    assert alone.library.variables[: alone.n] == ("omega", "rotor_angle")
    assert [m.name for m in alone.means] == ["omega"]
    assert measured.experiment(1000).n == 7


def test_methods_give_the_same_result_in_any_order():
    x, v = simulated(6.0)
    data = from_arrays(x, {"v_a": v}, SAMPLE_PERIOD)
    names = sorted({t for equation in TRUE.values() for t in equation})
    first, second = Problem(data, names), Problem(data, names)
    matrix = first.regress(first.regression())
    held_out = second.held_out_run(None)
    assert (held_out.channels, held_out.states, held_out.notes) == ({}, None, ())
    assert (second.regress(second.regression()) == matrix).all()


def test_an_unknown_variable_is_named_with_those_of_the_user(measured):
    with pytest.raises(TermError, match="known: theta, theta_dot, i_a, omega, v_a"):
        Problem(measured.data, ["phi"])


def test_a_term_that_is_too_large_to_compute_with_is_refused(measured):
    with pytest.raises(TermError, match=r"'omega\^300' is too large"):
        Problem(measured.data, ["omega", "omega^300"])


@pytest.mark.filterwarnings("error")
def test_a_part_without_a_pulse_of_the_speed_has_no_spread_of_it(measured):
    part = measured.experiment(20)
    assert [len(mean.value) for mean in part.means] == [0]
    fitter = Fitter(part, Entries.of(np.zeros(measured.candidates.shape)), 0, floor=1.0)
    fitter.fit(rounds=1)
    assert not tracks(fitter)  # a model without terms
