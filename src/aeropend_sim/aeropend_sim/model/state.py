# SPDX-License-Identifier: Apache-2.0
"""State of the plant, and its quantities over one step."""

from __future__ import annotations

from typing import NamedTuple

from aeropend_sim.compiled import equation
from aeropend_sim.model.terms import EMPTY, Memory, Quantities


class State(NamedTuple):
    """State of the plant at an instant, SI units. The last six belong to effects and are 0 without them."""

    i_a: float = 0.0
    omega: float = 0.0
    rotor_angle: float = 0.0
    theta: float = 0.0
    theta_dot: float = 0.0
    thrust: float = 0.0
    heat: float = 0.0
    flex: float = 0.0
    flex_dot: float = 0.0
    gust: float = 0.0
    time: float = 0.0
    memory: Memory = EMPTY


class Over(NamedTuple):
    """A quantity over one step."""

    start: float
    middle: float
    end: float


class Past(NamedTuple):
    """Time (s), and the states of effects by formula, at an instant."""

    time: float
    memory: Memory


class Pasts(NamedTuple):
    """`Past` over one step."""

    start: Past
    middle: Past
    end: Past


class Motion(NamedTuple):
    """The motion of the arm, and of the mode of the mast."""

    theta: float
    theta_dot: float
    flex: float
    flex_dot: float


@equation
def quantities(state: State, v: float) -> Quantities:
    """What formulas take, from the state of the plant and the voltage."""
    return Quantities(state.theta, state.theta_dot, state.omega, state.thrust, state.i_a, v, state.time)


@equation
def since(state: State, past: Past) -> State:
    """The state with this time and these memories."""
    s = state
    return State(s.i_a, s.omega, s.rotor_angle, s.theta, s.theta_dot, s.thrust, s.heat, s.flex, s.flex_dot, s.gust,
                 past.time, past.memory)
