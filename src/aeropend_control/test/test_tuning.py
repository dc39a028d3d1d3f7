# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from aeropend_control.laws.tuning import (
    TABLE_6_1,
    Requirements,
    TuningError,
    pair,
    place,
    settling_time,
    thrust_lag,
)
from aeropend_sim.model import actuator
from aeropend_sim.model.parameters import load
from aeropend_sim.model.rig import Rig

BENCH, THESIS = load("bench"), load("thesis")


def test_the_pair_has_the_overshoot_and_stays_within_two_percent():
    decay, omega_2 = pair(1.5, 0.1)
    damped = math.sqrt(omega_2 - decay**2)
    assert math.exp(-decay * math.pi / damped) == pytest.approx(0.1)
    assert math.exp(-decay * 1.5) * math.sqrt(omega_2) / damped == pytest.approx(0.02)


@pytest.mark.parametrize(("model", "other"), [(BENCH, 3.0), (BENCH, 2.0), (THESIS, 3.0)])
def test_the_poles_are_where_they_were_placed(model, other):
    n, at = model.numbers(), 0.4
    kp, ki, kd, weight, thrust_time = place(model, 1.2, 0.1, at, other)
    lag, c = thrust_time or thrust_lag(model, at), n["c_over_J"]
    gravity = n["mgd_over_J"] * math.cos(at)
    poles = np.roots([lag, 1.0 + c * lag, c + gravity * lag + kd, kp, ki])
    decay, omega_2 = pair(1.2, 0.1)
    (complex_,) = poles[poles.imag > 1e-6]
    assert (-complex_.real, abs(complex_) ** 2) == (pytest.approx(decay), pytest.approx(omega_2))
    others = -np.sort(poles.real[np.abs(poles.imag) < 1e-6])
    assert others == pytest.approx(others[0], rel=1e-3)  # two equal ones
    assert ki / (kp * weight) == pytest.approx(others[0], rel=1e-3)  # one is cancelled
    if model is BENCH:
        assert others[0] == pytest.approx(other * decay, rel=1e-3)


@pytest.mark.parametrize("limit", [{"t_r": 0.3}, {"t_p": 0.5}, {"t_s": 0.8}])
def test_each_requirement_can_be_the_one_that_binds(limit):
    wide = Requirements(10.0, 10.0, 10.0, 0.2)._replace(**limit)
    loose = Requirements(10.0, 10.0, 10.0, 0.2)
    assert settling_time(wide, 0.1) < 0.5 * settling_time(loose, 0.1)


@pytest.mark.parametrize(("requirements", "M_p", "said"), [
    (TABLE_6_1._replace(t_r=0.0), 0.1, "t_r"), (TABLE_6_1._replace(t_s=math.nan), 0.1, "t_s"),
    (TABLE_6_1, 1.0, "overshoot"), (TABLE_6_1._replace(t_p=-1.0), 0.1, "t_p")])
def test_requirements_that_make_no_sense_are_refused_by_name(requirements, M_p, said):
    with pytest.raises(TuningError, match=said) as error:
        settling_time(requirements, M_p)
    assert len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize("model", [BENCH, THESIS])
def test_the_lag_is_that_of_the_thrust(model):
    """A small step of the voltage around an angle: after one lag the thrust has made 63 % of its way."""
    n, at = model.numbers(), 0.4
    speed = float(actuator.speed(n, n["mgd_over_J"] / n["L_over_J"] * math.sin(at)))
    duty = float(actuator.duty(n, actuator.voltage_at(n, speed)))
    rig = Rig(model)
    rig.run(np.full(3000, duty))
    thrust = rig.run(np.full(1500, 1.01 * duty))[1][6]
    way = (thrust - thrust[0]) / (thrust[-1] - thrust[0])
    assert np.argmax(way > 1.0 - math.exp(-1.0)) * rig.period == pytest.approx(thrust_lag(model, at), rel=0.12)
