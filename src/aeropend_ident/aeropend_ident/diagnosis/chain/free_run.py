# SPDX-License-Identifier: Apache-2.0
"""The free run: the whole chain, simulated from the duty alone and read as the rig would, without random effects."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.last_runs import LastRuns
from aeropend_ident.diagnosis.chain.values import acts_on_arm, acts_on_motor, with_values, without_effects
from aeropend_ident.interrupt import check
from aeropend_ident.signals.pulses import mean_speed
from aeropend_ident.signals.signals import Signals
from aeropend_sim.model import actuator, dynamics, sensing
from aeropend_sim.model.coefficients import prepare, prepare_motor
from aeropend_sim.model.parameters import LONGEST_STEP, Model
from aeropend_sim.model.state import State

Array = NDArray[np.float64]
Values = Mapping[str, float]
Pieces = Sequence[tuple[slice, Model]]

def free_run(model: Model, signals: Signals, values: Values | None = None) -> dict[str, Array]:
    """Simulate the rig from the duty alone and read it as the rig would, without random effects.

    Args:
        model: with its effects.
        signals: gives the duty and the instants of the pulses.
        values: further parameters, effects, and the initial state (`initial.theta`, ...).

    Returns:
        Channel -> (N,) readings before noise and quantisation.
    """
    pieces = _pieces(model, signals, values or {})
    run = _run(signals, pieces, values or {})
    held_speed = _held_speed(run.omega, run.rotor_angle, signals)
    return _read(run.theta, run.theta_dot, run.i_a, run.v_a, held_speed, signals, pieces)


def motion(model: Model, signals: Signals, values: Values) -> tuple[dynamics.Trajectory, Model]:
    """The states of a free run (see `free_run`), and the model with these values."""
    return _run(signals, _pieces(model, signals, values), values), with_values(model, values)


class StagedRun:
    """Free runs of one recording, first the motor, then the arm: nothing acts back from the arm on the motor.

    The motor runs again only when one of its values changes, so that the derivatives with respect to the parameters of
    the arm cost a run of the arm alone. The speed is a straight line over each step of the motor, and the arm takes
    longer steps; otherwise the readings are those of `free_run`.

    Args:
        model: with its effects.
        signals: gives the duty and the instants of the pulses.
    """

    def __init__(self, model: Model, signals: Signals) -> None:
        self.model, self.signals = model, signals
        self._motor_runs: LastRuns[_MotorRun] = LastRuns(acts_on_motor)
        self._motions: LastRuns[tuple[Array, Array]] = LastRuns(acts_on_arm)

    def readings(self, values: Values) -> dict[str, Array]:
        """As `free_run`, with these values."""
        check()
        s, pieces = self.signals, _pieces(self.model, self.signals, values)
        motor = self._motor_runs.of(values, self._turn)
        theta, theta_dot = self._motions.of(values, lambda own: self._swing(pieces, own, motor.speed))
        return _read(theta, theta_dot, motor.i_a, motor.v_a, motor.held_speed, s, pieces)

    def _swing(self, pieces: Pieces, values: Values, speeds: Sequence[Array]) -> tuple[Array, Array]:
        s = self.signals
        state = _begin(pieces, values)
        theta, theta_dot = np.empty(len(s)), np.empty(len(s))
        for speed, (piece, m) in zip(speeds, pieces, strict=True):
            parts = len(speed) // (piece.stop - piece.start)
            angle, rate, state = dynamics.swing(m, speed, state, s.period / parts)
            theta[piece], theta_dot[piece] = angle[::parts], rate[::parts]
        return theta, theta_dot

    def _turn(self, values: Values) -> _MotorRun:
        s, pieces = self.signals, _pieces(self.model, self.signals, values)
        state, speed = _begin(pieces, values), []
        i_a, v_a, omega, angle = np.empty((4, len(s)))
        for piece, m in pieces:
            v, sampled = _voltages(s, piece, m)
            parts = math.ceil(s.period / LONGEST_STEP - 1e-9)  # within which the speed is a straight line
            out = np.empty((3, parts * len(v)))
            state = dynamics.run_motor(np.repeat(v, parts), state, *prepare_motor(m, s.period / parts), out)
            i_a[piece], omega[piece], angle[piece] = out[:, ::parts]
            v_a[piece] = actuator.terminal_voltage(m, sampled, i_a[piece], s.period)
            speed.append(out[1])
        return _MotorRun(i_a, v_a, _held_speed(omega, angle, s), speed)


class _MotorRun(NamedTuple):
    """Current and voltage (N,), the speed (N,) as it is read, and that of each piece, at parts of a hold."""

    i_a: Array
    v_a: Array
    held_speed: Array
    speed: list[Array]


def _pieces(model: Model, signals: Signals, values: Values) -> Pieces:
    """The pieces of the recording with the model of each: effects may begin or end."""
    off = without_effects(values, model)
    return [(piece, with_values(model, values if acts else off)) for piece, acts in signals.acting()]


def _begin(pieces: Pieces, values: Values) -> State:
    """The state at the first sample."""
    n, omega = pieces[0][1].numbers(), values.get("initial.omega", 0.0)
    return State(i_a=float(actuator.current_at(n, omega)), omega=omega,
                 theta=values.get("initial.theta", 0.0), theta_dot=values.get("initial.theta_dot", 0.0),
                 thrust=float(actuator.thrust(n, omega)))


def _voltages(signals: Signals, piece: slice, m: Model) -> tuple[Array, Array]:
    """The voltages of `actuator.voltages` in a piece of a recording."""
    duty = np.ascontiguousarray(signals.duty, dtype=float)
    v, sampled = actuator.voltages(m.numbers(), duty, m.effects, signals.period, -piece.start)
    return v[piece], sampled[piece]


def _run(signals: Signals, pieces: Pieces, values: Values) -> dynamics.Trajectory:
    """The run of the whole chain, piece by piece; see `dynamics.simulate`."""
    check()
    out, state = np.empty((7, len(signals))), _begin(pieces, values)
    for piece, m in pieces:
        v, sampled = _voltages(signals, piece, m)
        part = np.empty((7, len(v)))
        state = dynamics.run(v, np.zeros(len(v)), state, *prepare(m, signals.period), part)
        if "command_delay" in m.effects:
            part[dynamics.ROW.v_a] += sampled - v
        out[:, piece] = part
    return dynamics.Trajectory(*out)


def _read(theta: Array, theta_dot: Array, i_a: Array, v_a: Array, held_speed: Array, signals: Signals, pieces: Pieces
          ) -> dict[str, Array]:
    """Channel -> reading, from the states (N,) and the speed (N,) as it is read."""
    out = {"theta": np.empty(len(theta)), "omega": held_speed, "i_a": np.empty(len(i_a)), "v_a": np.empty(len(v_a))}
    for piece, m in pieces:
        time = signals.time[piece]
        out["theta"][piece] = sensing.read_angle(m, theta, theta_dot, signals.period)[piece]
        out["i_a"][piece] = sensing.read_current(m, i_a[piece], time)
        out["v_a"][piece] = sensing.read_voltage(m, v_a[piece], time)
    return out


def _held_speed(omega: Array, rotor_angle: Array, signals: Signals) -> Array:
    """[rad/s] (N,) The speed as the pulses of the recording would have timed it, held between them."""
    p = signals.pulses
    if p is None or not len(p.index):
        return omega
    speed = mean_speed(rotor_angle, p.time, p.period, signals.period)
    last = np.searchsorted(p.index, np.arange(len(signals)), side="right") - 1
    held = np.where(last >= 0, speed[np.maximum(last, 0)], omega)  # until a first interval is timed
    # where the rig reads no speed, the model has stopped too if it would have shown one pulse at most; at first two,
    # as one begins the interval that is timed
    stopped = signals.omega == 0.0
    back = np.maximum(np.arange(len(signals)) - round(sensing.SPEED_TIMEOUT / signals.period), 0)
    turn = p.period[0] * abs(p.omega[0])
    slow = np.abs(rotor_angle - rotor_angle[back]) < np.where(last >= 0, turn, 2.0 * turn)
    return np.where(stopped, np.where(slow, 0.0, omega), held)
