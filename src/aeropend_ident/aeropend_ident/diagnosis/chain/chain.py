# SPDX-License-Identifier: Apache-2.0
"""The chain from duty to angle, cut into three stages: actuator, motor and arm.

Each stage is simulated alone. Its input is the signal measured before it, so that an error upstream does not show
downstream. The measured signal is replaced by a description of it: the output of the stage before, plus what that
output leaves, without the noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.known import Known
from aeropend_ident.diagnosis.chain.last_runs import LastRuns
from aeropend_ident.diagnosis.chain.values import (
    STAGES,
    Values,
    acts_on_arm,
    acts_on_motor,
    with_values,
    without_effects,
)
from aeropend_ident.diagnosis.policy import CALIBRATED, Policy, angle_only
from aeropend_ident.estimation.parameter import key
from aeropend_ident.estimation.residuals import finite
from aeropend_ident.interrupt import check
from aeropend_ident.signals.pulses import mean_speed
from aeropend_ident.signals.signals import Signals, split_apply
from aeropend_ident.signals.smoothing import slow_part
from aeropend_sim.model import actuator, dynamics, sensing
from aeropend_sim.model.coefficients import LONGEST_MOTOR_STEP, prepare_motor
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import LONGEST_STEP, Model
from aeropend_sim.model.state import State

Array = NDArray[np.float64]

DELAY = "command_delay.delay"
"""The one value of the actuator that acts between samples, where only the motor shows it."""

RAN_AWAY = 1e9
"""Residual, in the unit of the channel, of a simulation that is not finite (choice: larger than any reading)."""

SHORTEST_STEP = 5e-6
"""[s] Step of a simulation below which the motor is none (choice: a winding has a time constant of 50 µs or more)."""

VOLTAGE_SETTLES, SPEED_SETTLES = 0.05, 0.02
"""[s] Windows over which the rest of voltage and speed is averaged before it feeds the next stage.

Choice: longer than some samples, shorter than the time constants of rotor (voltage) and arm (speed)."""


@dataclass
class CutChain:
    """The cut chain of one recording under one model.

    Attributes:
        model: the nominal model.
        signals: the recording.
        voltage: [V] (N,) measured voltage without its noise; input of the motor.
        speed: [rad/s] (N,) measured speed between its pulses; input of the arm.
        current: [A] (N,) as measured; that of the nominal model where it is missing.
        actuator_values: values with which the actuator describes the voltage.
        unexplained_voltage: [V] (N,) what that description leaves, without the noise.
    """

    model: Model
    signals: Signals
    voltage: Array
    speed: Array
    current: Array
    actuator_values: dict[str, float] = field(default_factory=dict)
    unexplained_voltage: Array = field(default_factory=lambda: np.zeros(0))
    _last: tuple[Values, Model] | None = field(default=None, init=False, repr=False, compare=False)
    _motor_runs: LastRuns[tuple[Array, Array, Array]] = field(default_factory=lambda: LastRuns(acts_on_motor),
                                                              init=False, repr=False, compare=False)
    _motions: LastRuns[tuple[Array, Array]] = field(default_factory=lambda: LastRuns(acts_on_arm),
                                                    init=False, repr=False, compare=False)

    @classmethod
    def cut(cls, model: Model, signals: Signals) -> CutChain:
        """Cut the chain; the nominal model describes the inner signals until `set_*_input` replaces that."""
        none = np.zeros(len(signals))
        p = signals.pulses
        if p is not None and signals.has("v_a"):  # the timing of a slow pulse is more precise than the motor's voltage
            fitted = sum(model.model[name] != 0.0 for name in STAGES["actuator"])
            unsure = signals.sigma["v_a"] * math.sqrt(fitted / signals.train) / model.model["K_e"]
            signals = replace(signals, pulses=replace(p, sigma=np.hypot(p.sigma, unsure)))
        chain = cls(model, signals, none, none, none)
        chain.set_motor_input({})
        chain.current = np.where(np.isfinite(signals.i_a), signals.i_a, chain.motor({})[0])
        chain.set_motor_input({})  # again: the sag of the supply needs the current
        chain.set_arm_input({})
        return chain

    def head(self, n: int) -> CutChain:
        """The first n samples."""
        return replace(self, signals=self.signals.head(n), voltage=self.voltage[:n], speed=self.speed[:n],
                       current=self.current[:n], unexplained_voltage=self.unexplained_voltage[:n])

    def valued(self, values: Values) -> Model:
        """The model with these values; the last one is kept, as each stage asks for it several times."""
        if self._last is None or self._last[0] != values:
            self._last = (dict(values), with_values(self.model, values))
        return self._last[1]

    def pieces(self, values: Values, stop: int | None = None) -> list[tuple[slice, Model]]:
        """The pieces of the recording with the model that acts in each: effects may begin or end."""
        off = without_effects(values, self.model) if self.signals.window is not None else values
        return [(piece, self.valued(values if acts else off)) for piece, acts in self.signals.acting(stop)]

    # --- actuator: duty -> voltage

    def actuator(self, values: Values) -> Array:
        """[V] Voltage (N,) as it would be read."""
        return self._voltage(values, actuator.sampled_voltage)

    def _voltage(self, values: Values, of: Callable[..., Array]) -> Array:
        s = self.signals
        out = np.empty(len(s))
        for piece, m in self.pieces(values):
            n = m.numbers()
            # the duty before the recording is taken from the first voltage: with a delay it acts for a while
            first = s.v_a[0] if np.isfinite(s.v_a[0]) else actuator.voltage_at(n, values.get("initial.omega", 0.0))
            before = actuator.duty(n, first)
            v = of(n, s.duty, m.effects, s.period, start=-piece.start, before=before if math.isfinite(before) else 0.0)
            seen = actuator.terminal_voltage(m, v[piece], self.current[piece], s.period)
            out[piece] = sensing.read_voltage(m, seen, s.time[piece])
        return out

    def actuator_residuals(self, values: Values) -> dict[str, Array]:
        """Residual of the voltage over the training part, in units of its noise."""
        s = self.signals
        return {"v_a": self._train(s.v_a, self.actuator(values), s.after_unseen) / s.sigma["v_a"]}

    def likeliest_delay(self, values: Values) -> float:
        """[s] The command delay that fits the voltage best; the middle of its sample period, in which all fit alike."""
        high = CATALOGUE["command_delay"].parameters["delay"].high
        tried = (np.arange(max(math.floor(high / self.signals.period), 1)) + 0.5) * self.signals.period
        errors = [sum(float(r @ r) for r in self.actuator_residuals({**values, DELAY: d}).values()) for d in tried]
        return float(tried[int(np.argmin(errors))])

    def set_motor_input(self, values: Values) -> None:
        """Set the motor's input to the measured voltage, described by the actuator with these values."""
        self.actuator_values, self.unexplained_voltage = dict(values), self._unexplained_voltage(values)
        self.voltage = self._motor_input({})
        self._motor_runs.forget()
        self._motions.forget()

    def _unexplained_voltage(self, values: Values) -> Array:
        s = self.signals
        if not s.has("v_a"):
            return np.zeros(len(s))
        clean = partial(slow_part, width=round(VOLTAGE_SETTLES / s.period), sigma=s.sigma["v_a"])
        return split_apply(clean, s.v_a - self.actuator(values), s.train)

    def _motor_input(self, values: Values) -> Array:
        """[V] Motor input (N,). With a delay in `values` the voltage may change within a sample period."""
        s = self.signals
        late = {k: x for k, x in values.items() if k == DELAY}
        acting = {**self.actuator_values, **late}
        v = self._voltage(acting, actuator.acting_voltage)
        same = acting == self.actuator_values
        v = v + (self.unexplained_voltage if same else self._unexplained_voltage(acting))
        delay = self.valued(acting).effect("command_delay", "delay")
        early = np.arange(len(s)) < math.floor(delay / s.period + 1e-9)  # set by duties from before the recording
        return np.where(early & np.isfinite(s.v_a), s.v_a, v)

    # --- motor: voltage -> current, speed

    def motor(self, values: Values, stop: int | None = None) -> tuple[Array, Array, Array]:
        """Simulate the motor for the voltage measured, or for the duty if no voltage was measured.

        Args:
            values: parameters, effects and initial state.
            stop: sample to stop at; None: all.

        Returns:
            [A] current, [rad/s] speed and [rad] rotor angle, (N,) each; NaN of values with which no motor is so fast.
            They are kept, and must not be changed.
        """
        return self._motor_runs.of(values, lambda _: self._turn(values, stop), stop)  # the model of all is at hand

    def _turn(self, values: Values, stop: int | None) -> tuple[Array, Array, Array]:
        first = float(self.signals.i_a[0]) if np.isfinite(self.signals.i_a[0]) else 0.0
        state = State(i_a=first, omega=values.get("initial.omega", 0.0))
        if not self.signals.has("v_a"):
            voltage = self._voltage(values, actuator.acting_voltage)
        else:
            voltage = self._motor_input(values) if DELAY in values else self.voltage
        out = np.empty((3, len(voltage[:stop])))
        longest = LONGEST_MOTOR_STEP if angle_only([self.signals]) else LONGEST_STEP
        for piece, whole in self.pieces(values, stop):
            m = actuator.behind_terminals(whole)
            true = sensing.true_voltage(m, voltage[piece], self.signals.time[piece])
            part, prepared = np.full((3, len(true)), np.nan), prepare_motor(m, self.signals.period, longest)
            if prepared[0].h >= SHORTEST_STEP:
                state = dynamics.run_motor(true, state, *prepared, part)
            out[:, piece] = part
        return out[0], out[1], out[2]

    def motor_residuals(self, values: Values) -> dict[str, Array]:
        """Residuals of current and speed over the training part, in units of their noise."""
        s = self.signals
        i_a, omega, angle = self.motor(values, s.train)
        residuals = {}
        if s.has("i_a"):
            read = [sensing.read_current(m, i_a[piece], s.time[piece]) for piece, m in self.pieces(values, s.train)]
            residuals["i_a"] = self._train(s.i_a, np.concatenate(read)) / s.sigma["i_a"]
        if s.pulses is not None:
            p = s.pulses
            use = (p.index < s.train) & ~p.false
            residuals["omega"] = ((p.omega - mean_speed(angle, p.time, p.period, s.period)) / p.sigma)[use]
        elif s.has("omega"):
            residuals["omega"] = self._train(s.true_speed, omega) / s.sigma["omega"]
        return residuals

    def set_arm_input(self, values: Values) -> None:
        """Set the arm's input to the measured speed, described by the motor with these values."""
        s = self.signals
        _, omega, angle = self.motor(values)
        if s.pulses is not None and (~s.pulses.false).sum() > 2:
            omega = omega.copy()
            p = s.pulses.of(~s.pulses.false)
            error = p.omega - mean_speed(angle, p.time, p.period, s.period)
            t, middle = s.time, p.time - 0.5 * p.period
            omega[s.train:] += np.interp(t[s.train:], middle, error)
            if known := int(np.searchsorted(p.index, s.train)):
                omega[:s.train] += np.interp(t[:s.train], middle[:known], error[:known])
        elif s.has("omega"):
            clean = partial(slow_part, width=round(SPEED_SETTLES / s.period), sigma=s.sigma["omega"])
            omega = omega + split_apply(clean, s.true_speed - omega, s.train)
        self.speed = s.turning(omega)
        self._motions.forget()

    # --- arm: speed -> angle

    def arm(self, values: Values, stop: int | None = None) -> Array:
        """[rad] Angle (N,) as it would be read, before noise and quantisation; arguments as for `motor`."""
        theta, rate = self.arm_motion(values, stop)
        s, out = self.signals, np.empty(len(theta))
        for piece, m in self.pieces(values, stop):
            out[piece] = sensing.read_angle(m, theta, rate, s.period)[piece]
        return out

    def arm_motion(self, values: Values, stop: int | None = None) -> tuple[Array, Array]:
        """True angle [rad] and angular rate [rad/s], (N,) each; arguments, and what is kept, as for `motor`."""
        return self._motions.of(values, lambda _: self._swing(values, stop), stop)

    def _swing(self, values: Values, stop: int | None) -> tuple[Array, Array]:
        s, pieces = self.signals, self.pieces(values, stop)
        n = pieces[0][1].numbers()
        cut = s.has("omega") or s.has("i_a")
        if not cut and s.largest_duty == 0.0 and "initial.omega" not in values and actuator.voltage(n, 0.0) == 0.0:
            speed = np.zeros(len(s))[:stop]  # the rotor stands
        else:
            speed = self.speed[:stop] if cut else s.turning(self.motor(values, stop)[1])
        state = State(omega=float(speed[0]), theta=values.get("initial.theta", 0.0),
                      theta_dot=values.get("initial.theta_dot", 0.0),
                      thrust=float(actuator.thrust(n, speed[0])))
        theta, rate = np.empty(len(speed)), np.empty(len(speed))
        for piece, m in pieces:
            theta[piece], rate[piece], state = dynamics.swing(m, speed[piece], state, s.period)
        return theta, rate

    def arm_residuals(self, values: Values) -> dict[str, Array]:
        """Residual of the angle over the training part, in units of its noise."""
        s = self.signals
        return {"theta": self._train(s.theta, self.arm(values, s.train)) / s.sigma["theta"]}

    def residuals(self, stage: str) -> Callable[[Values], dict[str, Array]]:
        """The residual function of a stage by name; a channel without a reading has none."""
        of = {"actuator": self.actuator_residuals, "motor": self.motor_residuals, "arm": self.arm_residuals}[stage]
        return lambda values: {channel: r for channel, r in of(values).items() if len(r)}

    def _train(self, measured: Array, simulated: Array, start: int = 0) -> Array:
        part = slice(start, self.signals.train)
        return difference(measured[part], simulated[part])


class CutChains:
    """The cut chains of several recordings of one rig.

    Parameters and effects are shared; initial states, and what differs between recordings, are each recording's own.
    What is known to differ in a variant of the rig follows the shared value by its factor.
    Names of values and channels of recording k > 0 end in `@k`; see `estimation.parameter.Key`.

    Args:
        model: the nominal model.
        recordings: of one rig.
        policy: how the rig is diagnosed.
    """

    def __init__(self, model: Model, recordings: Sequence[Signals], policy: Policy = CALIBRATED) -> None:
        self.model, self.policy = model, policy
        self.likely: Mapping[str, float] = {}  # sizes of effects with which the parameters were identified
        self.with_likely: Model | None = None  # the nominal model that holds these effects
        self.state: Mapping[str, float] = {}  # initial states from which fits start
        self.plain: Model | None = None  # the best nominal model without further terms, of a driven rig
        self.known: Known | None = None  # what earlier verdicts know of the rig
        self.further: tuple[str, ...] = ()  # ids of effects of effect files that are tried too
        self.left_out: tuple[str, ...] = ()  # ids of effects that are not tried
        self.notes: tuple[str, ...] = ()  # what the recordings do not tell of the nominal model of a driven rig
        self.each = [self._cut(signals) for signals in recordings]

    def anew(self, recordings: Sequence[Signals], model: Model | None = None) -> CutChains:
        """The same chains cut from other recordings, with all that is known and tried.

        Args:
            recordings: of the same rig.
            model: the nominal model; None: the same.
        """
        out = type(self)(model or self.model, recordings, self.policy)
        for name in ("likely", "state", "plain", "known", "further", "left_out", "notes"):
            setattr(out, name, getattr(self, name))
        return out

    def _cut(self, signals: Signals) -> CutChain:
        return CutChain.cut(signals.variant.of(self.model), signals)

    def values_of(self, values: Values, k: int) -> dict[str, float]:
        """The values that act on recording k, under plain names; those of its variant."""
        return self._acting(values)[k]

    def estimates_of(self, values: Values, k: int) -> dict[str, float]:
        """The estimates that hold for recording k, under plain names; before the factors of its variant."""
        return self._estimates_of_each(values)[k]

    def _acting(self, values: Values) -> list[dict[str, float]]:
        return [chain.signals.variant.acting(own, self.model)
                for chain, own in zip(self.each, self._estimates_of_each(values), strict=True)]

    def _estimates_of_each(self, values: Values) -> list[dict[str, float]]:
        if len(self.each) == 1:
            return [{n: v for n, v in values.items() if not key(n).recording}]
        shared: dict[str, float] = {}
        own: list[dict[str, float]] = [{} for _ in self.each]
        for name, value in values.items():
            k = key(name)
            if k.recording and k.recording < len(own):
                own[k.recording][k.plain] = value
            elif not k.recording:
                (own[0] if k.is_initial else shared)[name] = value
        return [shared | mine for mine in own]

    def residuals(self, stage: str) -> Callable[[Values], dict[str, Array]]:
        """The residual function of a stage over all recordings."""
        return self.joined(lambda chain: chain.residuals(stage))

    def joined(self, of: Callable[[CutChain], Callable[[Values], dict[str, Array]]]
               ) -> Callable[[Values], dict[str, Array]]:
        """One residual function over all recordings, from one of each recording."""
        each = [of(chain) for chain in self.each]

        def function(values: Values) -> dict[str, Array]:
            check()
            return {key(channel).of(k): r
                    for k, (residuals, own) in enumerate(zip(each, self._acting(values), strict=True))
                    for channel, r in residuals(own).items()}

        return function

    def head(self, samples: int) -> CutChains:
        """The first recordings, up to so many samples of their training parts and nothing else."""
        out, left = copy(self), samples
        out.each = []
        for chain in self.each:
            if left > 0:
                out.each.append(chain.head(min(chain.signals.train, left)))
                left -= chain.signals.train
        return out

    def only(self, k: int) -> CutChains:
        """The chain of one recording alone."""
        out = copy(self)
        out.each = [self.each[k]]
        out.state = {key(n).of(0): v for n, v in self.state.items() if key(n).recording == k}
        return out

    def set_next_input(self, stage: str, values: Values) -> None:
        """Set the input of the stage after this one to what was measured, described with these values."""
        for k, chain in enumerate(self.each):
            if stage == "actuator":
                chain.set_motor_input(self.values_of(values, k))
            elif stage == "motor":
                chain.set_arm_input(self.values_of(values, k))

    @property
    def recordings(self) -> list[Signals]:
        """The recordings, in the order of `each`."""
        return [chain.signals for chain in self.each]

    @property
    def runs(self) -> int:
        """Simulations so far, if they are counted."""
        return 0


def difference(measured: Array, simulated: Array) -> Array:
    """Measured minus simulated where something was measured.

    Args:
        measured: (N,) NaN where missing.
        simulated: (N,) What is farther off than `RAN_AWAY`, or not finite, counts as `RAN_AWAY`.

    Returns:
        (M,) differences at the M <= N known samples.
    """
    off, known = measured - simulated, np.isfinite(measured)
    if not known.all():
        off = off[known]
    return finite(off, RAN_AWAY)
