# SPDX-License-Identifier: Apache-2.0
"""The experiment advised for hypotheses that a recording does not tell apart."""

import numpy as np
import pytest

from aeropend_ident.diagnosis.chain.free_run import free_run
from aeropend_ident.diagnosis.experiment_design import LONGEST, SEPARATE, advise, distances, next_experiment
from aeropend_ident.signals.signals import Signals
from aeropend_ident.testing.rigs import BENCH, recorded
from aeropend_sim.model.excitation import Excitation


def hypothesis(**own: float) -> dict[str, float]:
    """`bench` with these values; `__` stands for the dot in a name."""
    return {**BENCH.model, **{name.replace("__", "."): value for name, value in own.items()}}


@pytest.fixture(scope="module")
def signals() -> Signals:
    return recorded(1, duration=10.0)


def test_the_advice_is_parameters_of_excite(signals):
    advice = next_experiment(BENCH, signals, hypothesis(coulomb_friction__accel=0.2),
                             hypothesis(quadratic_drag__k=0.3), ("coulomb_friction", "quadratic_drag"))
    planned = Excitation(**advice.excite)
    assert planned.duration <= LONGEST
    assert all(name in advice.why for name in ("coulomb_friction", "quadratic_drag", "theta"))


@pytest.mark.parametrize(("first", "second"), [
    (("bridge_drop", hypothesis(bridge_drop__v_drop=0.2)),
     ("parameter_mismatch:k0", hypothesis(k0=BENCH.model["k0"] - 0.2))),
    (("parameter_mismatch:k_thrust", hypothesis(k_thrust=1.3 * BENCH.model["k_thrust"])),
     ("parameter_mismatch:L_over_J", hypothesis(L_over_J=1.3 * BENCH.model["L_over_J"]))),
])
def test_what_is_the_same_in_every_equation_is_to_be_measured_directly(signals, first, second):
    advice = advise(BENCH, signals, first, [second])
    assert advice.excite == {}
    number = second[0].partition(":")[2]
    assert f"measure {number} (" in advice.why
    assert first[0] in advice.why


def test_what_numbers_within_their_uncertainty_can_take_over_is_no_difference(signals):
    """Readings that differ by parameters only: no signal separates the hypotheses."""
    friction = hypothesis(coulomb_friction__accel=0.4)
    shifted = {**friction, "k_thrust": 1.02 * friction["k_thrust"], "R_a": 0.98 * friction["R_a"]}
    a, b = (free_run(BENCH, signals, values)["theta"] for values in (friction, shifted))
    assert np.sqrt(np.mean((a - b) ** 2)) > 2.0 * signals.sigma["theta"]
    assert next_experiment(BENCH, signals, friction, shifted, ("coulomb_friction", "coulomb_friction")).excite == {}


def test_a_small_difference_takes_a_longer_experiment(signals):
    def duration(tau: float) -> float:
        advice = next_experiment(BENCH, signals, hypothesis(thrust_lag__tau=tau), hypothesis(encoder_lag__tau=tau / 2),
                                 ("thrust_lag", "encoder_lag"))
        return Excitation(**advice.excite).duration

    assert duration(0.06) == 60.0
    assert 60.0 < duration(0.02) <= LONGEST


def test_an_effect_at_its_neutral_size_is_no_part_of_a_hypothesis(signals):
    one, other = hypothesis(thrust_lag__tau=0.06), hypothesis(encoder_lag__tau=0.03)
    names = ("thrust_lag", "encoder_lag")
    plain = next_experiment(BENCH, signals, one, other, names)
    assert plain.excite
    assert next_experiment(BENCH, signals, {**one, "encoder_lag.tau": 0.0}, {**other, "thrust_lag.tau": 0.0},
                           names) == plain


def test_only_channels_that_were_recorded_count():
    """Two errors of the current's reading: nothing to tell apart where it is not read."""
    pair = hypothesis(current_gain__gain=0.1), hypothesis(current_offset__bias=0.05)
    names = ("current_gain", "current_offset")
    full, blind = recorded(2, duration=10.0), recorded(2, duration=10.0, without=("i_a",))
    assert next_experiment(BENCH, full, *pair, names).excite
    assert next_experiment(BENCH, blind, *pair, names).excite == {}


def test_one_experiment_for_several_rivals(signals):
    rivals = [("angle_offset", hypothesis(angle_offset__bias=0.02)),
              ("ground_effect", hypothesis(ground_effect__gain=0.2, ground_effect__width=0.3)),
              ("parameter_mismatch:k_thrust", hypothesis(k_thrust=1.2 * BENCH.model["k_thrust"]))]
    first = ("thrust_exponent", hypothesis(thrust_exponent__n=1.8))
    advice = advise(BENCH, signals, first, rivals)
    assert advice.excite
    distances = [float(text.split()[0]) for text in advice.why.split(" by ")[1:]]
    assert len(distances) == len(rivals)
    assert min(distances) > SEPARATE


def test_a_rival_that_no_signal_rules_out_is_said_beside_the_experiment_for_the_others(signals):
    first = ("bridge_drop", hypothesis(bridge_drop__v_drop=0.2))
    rivals = [("supply_sag", hypothesis(supply_sag__r_supply=0.4)),
              ("parameter_mismatch:k0", hypothesis(k0=BENCH.model["k0"] - 0.2))]
    advice = advise(BENCH, signals, first, rivals)
    assert advice.excite
    assert "from supply_sag by" in advice.why
    assert "measure k0 (" in advice.why


@pytest.mark.filterwarnings("error")
def test_a_hypothesis_under_which_the_rig_diverges_is_told_apart_and_no_error(signals):
    wild = ("diverges", hypothesis(c_over_J=-100.0))
    ((distance, _),) = distances(BENCH, signals, wild, [("bench", hypothesis())], Excitation(duration=10.0))
    assert np.isfinite(distance)
    assert distance > SEPARATE
