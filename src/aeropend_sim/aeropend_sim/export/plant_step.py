# SPDX-License-Identifier: Apache-2.0
"""The simulated rig, one sample at a time, composed of the model's functions for translation.

It is `model.rig.Rig` without chance: readings have no noise, no steps of resolution and no pulses, and the gust takes
its random number from outside.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from aeropend_sim.model import actuator, dynamics, sensing
from aeropend_sim.model.arm import advance_arm, arm_drive, arm_terms, near_ground
from aeropend_sim.model.coefficients import Coefficients, Extra, prepare
from aeropend_sim.model.effects import NO_EFFECT, Values, values
from aeropend_sim.model.motor import advance_motor, at_terminals
from aeropend_sim.model.parameters import Model
from aeropend_sim.model.sensing import MeasurementChain
from aeropend_sim.model.state import Motion, State, quantities, since
from aeropend_sim.model.terms import EMPTY, Terms, term_sum, terms


class Rig(NamedTuple):
    """State of the rig: of the plant, of the angle's filter, and number of samples since the start."""

    plant: State
    filter1: float
    filter2: float
    seen: float
    seen_dot: float
    samples: float


class Outputs(NamedTuple):
    """True quantities, then what the sensors read of angle, current and voltage: rad, rad/s, A, V, N."""

    theta: float
    theta_dot: float
    omega: float
    i_a: float
    v_a: float
    thrust: float
    theta_read: float
    i_a_read: float
    v_a_read: float


class Known(NamedTuple):
    """What a model fixes, for the functions below."""

    duty_map: actuator.DutyMap
    effects: Mapping[str, Mapping[str, float]]
    period: float
    share: float
    c: Coefficients
    e: Values | None
    x: Extra | None
    added: Terms | None
    chain: MeasurementChain
    wrong_angle: Terms | None
    wrong_current: Terms | None
    wrong_voltage: Terms | None
    held: Coefficients
    """Those of an arm without gravity and damping: another simulator has them itself."""
    rest: Values | None
    """The effects but those of `NATIVE`."""


NATIVE = ("coulomb_friction", "cable_torque", "mast_flex")
"""Effects that simulators of rigid bodies have themselves."""


def known(model: Model, period: float) -> Known:
    """What a model fixes.

    Args:
        model: parameters and effects.
        period: [s] time between samples.
    """
    c, e, x, added = prepare(model, period)
    rest = None if e is None else values({id_: p for id_, p in model.effects.items() if id_ not in NATIVE}) or NO_EFFECT
    _, part = actuator.delay(model.effects, period)
    numbers = model.numbers()
    share = actuator.share_of_first(numbers, part, period) if part > 0.0 else 0.0
    angle, current, voltage = (terms(model.effects, (reading,)) for reading in ("theta", "i_a", "v_a"))
    return Known(actuator.duty_map(numbers), model.effects, period, share, c, e, x, added,
                 sensing.prepare(model, period), angle, current, voltage, c._replace(gravity=0.0, damping=0.0), rest)


def begin(theta: float, k: Known) -> Rig:
    """The rig at rest at an angle (rad), with the motor off; the angle's filter has settled."""
    plant = State(0.0, 0.0, 0.0, theta)
    seen, seen_dot = see(plant, 0.0, k)
    angle = sensing.encoder_angle(seen, k.chain)
    return Rig(plant, angle, angle, seen, seen_dot, 0.0)


def see(plant: State, t: float, k: Known) -> tuple[float, float]:
    """Angle and rate that the encoder sees after a time (s)."""
    return sensing.seen_with_errors(plant.theta, plant.theta_dot, t, k.wrong_angle)


def voltage_at(duty: float, rig: Rig, k: Known) -> float:
    """[V] Voltage at the bridge that a duty gives now."""
    return actuator.at_bridge(actuator.mapped(duty, k.duty_map), rig.samples * k.period, k.effects)  # type: ignore[return-value]


def held_voltage(rig: Rig, duty: float, before: float, k: Known) -> float:
    """[V] Voltage at the bridge over one period.

    Args:
        rig: at its start.
        duty: that acts, 0 to 1.
        before: duty that acts until a delayed change within the period; else without effect.
        k: the model.
    """
    return actuator.held_voltage(k.duty_map, duty, before, k.share, rig.samples * k.period, k.effects)


def next_sample(rig: Rig, duty: float, before: float, noise: float, k: Known) -> Rig:
    """The rig after one period.

    Args:
        rig: at its start.
        duty: that acts, 0 to 1.
        before: duty that acts until a delayed change within the period; else without effect.
        noise: a standard normal number, for `gust`; else without effect.
        k: the model.
    """
    v = held_voltage(rig, duty, before, k)
    plant = rig.plant
    for _ in range(k.c.steps):
        plant = dynamics.advance(plant, v, k.c, k.e, k.x, k.added)
    return after(rig, plant, noise, k)


def after(rig: Rig, plant: State, noise: float, k: Known) -> Rig:
    """The rig after one period, from its plant then.

    Args:
        rig: at the start of the period.
        plant: at its end.
        noise: a standard normal number, for `gust`; else without effect.
        k: the model.
    """
    if k.e is not None:
        plant = dynamics.next_gust(plant, noise, k.x)
    samples = rig.samples + 1.0
    seen, seen_dot = see(plant, samples * k.period, k)
    past = sensing.Memory(rig.filter1, rig.filter2, rig.seen, rig.seen_dot, 0.0, 0.0, 0.0, 0.0, 0.0)
    filter1, filter2 = sensing.filter_angle(past, seen, seen_dot, k.chain)
    return Rig(plant, filter1, filter2, seen, seen_dot, samples)


class Drive(NamedTuple):
    """What an arm in another simulator needs over one step.

    Attributes:
        plant: at the end of the step, the arm as it was at its start.
        torque: [rad/s²] torque on the arm over its inertia that the other simulator does not have itself.
        friction: [rad/s²] dry friction over the inertia.
    """

    plant: State
    torque: float
    friction: float


def drive(plant: State, v: float, k: Known) -> Drive:
    """Winding, rotor and air over one step, for an arm that another simulator moves.

    Args:
        plant: at its start, with angle and rate of that arm.
        v: [V] voltage at the bridge, held.
        k: the model. `k.held` and `k.rest` say what the other simulator does not have itself.
    """
    c, e, x, added = k.c, k.e, k.x, k.added
    past = None if added is None else dynamics.pasts(plant, v, c, added)
    i1, wm, w1, angle, heat = advance_motor(plant, v, past, c, e, x, added)
    _, f1 = advance_arm(plant, wm, w1, past, c, e, x, added)
    middle = Motion(plant.theta + 0.5 * c.h * plant.theta_dot, plant.theta_dot, 0.0, 0.0)
    f = 0.5 * (plant.thrust + f1)
    f += f * near_ground(middle.theta, e)
    torque = arm_drive(0.0, middle, f, wm, plant.gust, k.held, k.rest)
    friction = 0.0
    if e is not None:
        friction = e.coulomb_friction_accel  # type: ignore[attr-defined]
    end = State(i1, w1, angle, plant.theta, plant.theta_dot, f1, heat, 0.0, 0.0, plant.gust, plant.time, plant.memory)
    if added is not None and past is not None:
        free = arm_terms(middle, f, wm, 0.0, past.middle, c, added)
        friction += free - arm_terms(middle, f, wm, 1.0, past.middle, c, added)
        torque += free
        end = since(end, dynamics.past_after(plant, end, v, past, c, added))
    return Drive(end, torque, friction)


def outputs(rig: Rig, duty: float, k: Known) -> Outputs:
    """What the rig shows.

    Args:
        rig: its state.
        duty: that acts from now on, 0 to 1; the voltage follows it at once.
        k: the model.
    """
    plant = rig.plant
    v = at_terminals(voltage_at(duty, rig, k), plant, k.e, k.added)
    i_read, v_read = plant.i_a, v
    if k.wrong_current is not None:
        i_read = plant.i_a + term_sum(0, k.wrong_current.arm_friction, quantities(plant, v), EMPTY, k.wrong_current)
    if k.wrong_voltage is not None:
        v_read = v + term_sum(0, k.wrong_voltage.arm_friction, quantities(plant, v), EMPTY, k.wrong_voltage)
    return Outputs(plant.theta, plant.theta_dot, plant.omega, plant.i_a, v, plant.thrust, rig.filter2,
                   sensing.current_reading(i_read, k.chain), sensing.voltage_reading(v_read, k.chain))


FUNCTIONS: tuple[Any, ...] = (begin, next_sample, outputs)
"""What a program offers."""

DRIVING: tuple[Any, ...] = (held_voltage, drive, after)
"""What a program offers besides if another simulator moves the arm."""
