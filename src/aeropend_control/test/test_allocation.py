# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from aeropend_control.laws.allocation import Allocation
from aeropend_control.laws.observer import Observer
from aeropend_sim.model import actuator, dynamics
from aeropend_sim.model.coefficients import prepare
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import Model, load
from aeropend_sim.model.rig import Rig
from aeropend_sim.model.state import State

BENCH = load("bench")
MOTOR = ["bridge_drop", "supply_sag", "brush_drop", "rotor_friction", "thrust_exponent"]


def with_effect(effect):
    return BENCH.with_effects({} if effect == "none" else {
        effect: {name: p.default for name, p in CATALOGUE[effect].parameters.items()}})


@pytest.mark.parametrize("effect", ["none", *MOTOR, "thrust_lag"])
@pytest.mark.parametrize("thrust", [0.05, 0.2])
def test_the_rig_gives_the_thrust_that_is_asked_for(effect, thrust):
    model = with_effect(effect)
    duty, given = Allocation(Observer(model)).duty(thrust, State(omega=100.0, thrust=thrust))
    truth = Rig(Model("held", BENCH.model, BENCH.sensing, model.effects)).run(np.full(6000, duty))[1]
    assert given == pytest.approx(thrust)
    assert truth[6, -1] == pytest.approx(thrust, rel=0.01)


@pytest.mark.parametrize("thrust_time", [0.0, 0.05])
def test_what_the_limits_leave_is_told(thrust_time):
    allocation = Allocation(Observer(BENCH), thrust_time)
    at_rest = State()
    duty, given = allocation.duty(2.0, at_rest)
    assert duty == 1.0
    assert 0.0 < given < 1.0
    assert allocation.duty(-1.0, at_rest) == (0.0, 0.0)


def test_a_thrust_time_is_the_time_in_which_the_thrust_follows():
    observer = Observer(BENCH)
    allocation, model = Allocation(observer, 0.08), BENCH
    prepared = prepare(model)
    state = dynamics.steady(model, 0.4)
    start, out, thrust = state.thrust, np.empty((7, 1)), []
    for _ in range(300):
        duty, _ = allocation.duty(1.1 * start, state)
        thrust.append(state.thrust)
        v = float(actuator.voltage(model.numbers(), duty))
        state = dynamics.run(np.array([v]), np.zeros(1), state, *prepared, out)
    way = (np.array(thrust) - start) / (0.1 * start)
    assert np.argmax(way > 0.632) * observer.period == pytest.approx(0.08, rel=0.1)
    assert way[-1] == pytest.approx(1.0, abs=0.02)


def test_the_dead_zone_of_the_duty_map_is_jumped():
    """Below some duty the bridge gives nothing; the least thrust asks for more than that."""
    allocation = Allocation(Observer(BENCH))
    assert allocation.duty_of_voltage(0.0) == (0.0, 0.0)
    duty, given = allocation.duty_of_voltage(0.01)
    assert duty > 0.005
    assert given == pytest.approx(0.01)
