# SPDX-License-Identifier: Apache-2.0
"""The chain cut in three: actuator, motor, arm, each simulated alone and fed with what was measured before it.

So an error upstream does not blame what is downstream. The inputs of a cut are the best description of the measured
signal that the part before it gives, corrected by what that description still leaves.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.signals.signals import Signals, apart
from aeropend_sim.model import actuator, dynamics, sensing
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import Model

Array = NDArray[np.float64]
Values = Mapping[str, float]

BLOCKS: dict[str, tuple[str, ...]] = {
    "actuator": ("k0", "k1", "k2", "k3"),
    "motor": ("R_a", "L_a", "K_e", "K_t", "J_m", "B_m", "k_load"),
    "arm": ("k_thrust", "mgd_over_J", "c_over_J", "L_over_J"),
}
"""The parts of the cut chain and the model's numbers in each."""

PLACE_OF_NUMBER = {
    **dict.fromkeys(BLOCKS["actuator"], "actuator"), **dict.fromkeys(("R_a", "L_a", "K_e"), "electrical"),
    **dict.fromkeys(("K_t", "J_m", "B_m", "k_load"), "rotor"), "k_thrust": "thrust", "L_over_J": "thrust",
    "mgd_over_J": "arm", "c_over_J": "arm",
}
"""Where in the chain a number of the model lives."""


DELAY = "command_delay.delay"
"""The one value of the actuator that acts between samples, where only the motor shows it."""

RAN_AWAY = 1e9
"""What the difference to a simulation that is not finite counts as."""


def with_values(model: Model, values: Values) -> Model:
    """The model with these values.

    `R_a` is a number, `coulomb_friction.accel` an effect's, `sensing.angle_filter_tau` the measurement chain's;
    `initial.*` is left out.
    """
    numbers, measuring = dict(model.model), dict(model.sensing)
    effects = {k: dict(v) for k, v in model.effects.items()}
    for name, value in values.items():
        owner, _, parameter = name.partition(".")
        if not parameter:
            numbers[name] = value
        elif owner == "sensing":
            measuring[parameter] = value
        elif owner != "initial":
            effects.setdefault(owner, {})[parameter] = value
    return Model(model.name, numbers, measuring, effects)


@dataclass
class Chain:
    """The cut chain of one recording under one model.

    Attributes:
        model: the nominal model. signals: the recording.
        voltage: (N,) V, measured voltage without its noise; input of the motor.
        speed: (N,) rad/s, measured speed between its pulses; input of the arm.
        current: (N,) A, as measured, the nominal model's where it is missing.
        described, beyond: the values that describe the voltage, and what (N,) they leave of it.
    """

    model: Model
    signals: Signals
    voltage: Array
    speed: Array
    current: Array
    described: dict[str, float] = field(default_factory=dict)
    beyond: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def cut(cls, model: Model, signals: Signals) -> Chain:
        """The chain with the nominal model's description of its inner signals; `feed_*` replace them."""
        none = np.zeros(len(signals))
        p = signals.pulses
        if p is not None and signals.has("v_a"):  # the timing of a slow pulse is surer than the voltage that drives it
            unsure = signals.sigma["v_a"] * math.sqrt(len(BLOCKS["actuator"]) / signals.train) / model.model["K_e"]
            signals = replace(signals, pulses=replace(p, sigma=np.hypot(p.sigma, unsure)))
        chain = cls(model, signals, none, none, none)
        chain.feed_motor({})
        chain.current = np.where(np.isfinite(signals.i_a), signals.i_a, chain.motor({})[0])
        chain.feed_motor({})
        chain.feed_arm({})
        return chain

    def head(self, n: int) -> Chain:
        """The first n samples."""
        return replace(self, signals=self.signals.head(n), voltage=self.voltage[:n], speed=self.speed[:n],
                       current=self.current[:n], beyond=self.beyond[:n])

    # --- actuator: duty -> voltage

    def actuator(self, values: Values) -> Array:
        """Voltage (N,) as it would be read."""
        return self._voltage(values, actuator.sampled_voltage)

    def _voltage(self, values: Values, of: Callable[..., Array]) -> Array:
        s, m = self.signals, with_values(self.model, values)
        n = m.numbers()
        # what acted before the recording, and with a delay acts on, is what the rotor begins with
        first = s.v_a[0] if np.isfinite(s.v_a[0]) else actuator.voltage_at(n, values.get("initial.omega", 0.0))
        v = of(n, s.duty, m.effects, s.period, before=float(actuator.duty(n, first)))
        v = v - m.effects.get("supply_sag", {}).get("r_supply", 0.0) * self.current
        return v + m.effects.get("voltage_offset", {}).get("bias", 0.0)

    def actuator_residuals(self, values: Values) -> dict[str, Array]:
        """Residual of the voltage over the training part, in units of its noise."""
        s = self.signals
        return {"v_a": self._train(s.v_a, self.actuator(values), s.after_unseen) / s.sigma["v_a"]}

    def likeliest_delay(self, values: Values) -> float:
        """The `command_delay` (s) that fits the voltage best, in the middle of the period in which all look alike."""
        high = CATALOGUE["command_delay"].parameters["delay"].high
        tried = (np.arange(math.floor(high / self.signals.period)) + 0.5) * self.signals.period
        errors = [sum(float(np.mean(r * r)) for r in
                      self.actuator_residuals({**values, DELAY: d}).values()) for d in tried]
        return float(tried[int(np.argmin(errors))])

    def feed_motor(self, values: Values) -> None:
        """Take the voltage that feeds the motor from the measured one, described by the actuator with these values."""
        self.described, self.beyond = dict(values), self._beyond(values)
        self.voltage = self._voltage_fed({})

    def _beyond(self, values: Values) -> Array:
        """What of the measured voltage (N,) the actuator with these values does not describe, without the noise."""
        s = self.signals
        if not s.has("v_a"):
            return np.zeros(len(s))
        clean = partial(structure, width=round(0.05 / s.period), sigma=s.sigma["v_a"])
        return apart(clean, s.v_a - self.actuator(values), s.train)

    def _voltage_fed(self, values: Values) -> Array:
        """What feeds the motor; a delay in `values` says when in its hold a voltage changed."""
        s = self.signals
        late = {k: x for k, x in values.items() if k == DELAY}
        acting = {**self.described, **late}
        v = self._voltage(acting, actuator.acting_voltage)
        v = v + (self.beyond if acting == self.described else self._beyond(acting))
        delay = self.valued(acting).effects.get("command_delay", {}).get("delay", 0.0)
        early = np.arange(len(s)) < math.floor(delay / s.period + 1e-9)  # set by duties from before the recording
        return np.where(early & np.isfinite(s.v_a), s.v_a, v)

    # --- motor: voltage -> current, speed

    def motor(self, values: Values, stop: int | None = None) -> tuple[Array, Array, Array]:
        """Current, speed and rotor angle for the voltage measured, (N,) or up to sample `stop`."""
        m = with_values(self.model, values)
        # what lies before the terminals is in the voltage already
        effects = {k: p for k, p in m.effects.items() if k != "supply_sag"}
        bias = m.effects.get("voltage_offset", {}).get("bias", 0.0)
        m = m.with_effects(effects)
        first = float(self.signals.i_a[0]) if np.isfinite(self.signals.i_a[0]) else 0.0
        state = dynamics.State(i_a=first, omega=values.get("initial.omega", 0.0))
        if not self.signals.has("v_a"):  # nothing to cut at: from the duty
            voltage = self._voltage(values, actuator.acting_voltage)
        else:
            voltage = self._voltage_fed(values) if DELAY in values else self.voltage
        voltage = voltage[:stop] - bias
        out = np.empty((3, len(voltage)))
        dynamics.run_motor(voltage, state, *dynamics.prepare(m, self.signals.period), out)
        return out[0], out[1], out[2]

    def motor_residuals(self, values: Values) -> dict[str, Array]:
        """Residuals of current and speed over the training part, in units of their noise."""
        s = self.signals
        i_a, omega, angle = self.motor(values, s.train)
        residuals = {}
        if s.has("i_a"):
            m = with_values(self.model, values).effects
            gain = 1.0 + m.get("current_gain", {}).get("gain", 0.0)
            offset = m.get("current_offset", {}).get("bias", 0.0)
            residuals["i_a"] = self._train(s.i_a, gain * i_a + offset) / s.sigma["i_a"]
        if s.pulses is not None:
            p = s.pulses
            use = (p.index < s.train) & ~p.false
            residuals["omega"] = ((p.omega - mean_speed(angle, p.time, p.period, s.period)) / p.sigma)[use]
        elif s.has("omega"):
            residuals["omega"] = self._train(s.true_speed, omega) / s.sigma["omega"]
        return residuals

    def feed_arm(self, values: Values) -> None:
        """Take the speed that feeds the arm from the measured one, described by the motor with these values."""
        s = self.signals
        _, omega, angle = self.motor(values)
        if s.pulses is not None and (~s.pulses.false).sum() > 2:
            p = s.pulses.of(~s.pulses.false)
            error = p.omega - mean_speed(angle, p.time, p.period, s.period)
            t, middle = np.arange(len(s)) * s.period, p.time - 0.5 * p.period
            omega[s.train:] += np.interp(t[s.train:], middle, error)
            if known := int(np.searchsorted(p.index, s.train)):
                omega[:s.train] += np.interp(t[:s.train], middle[:known], error[:known])
        elif s.has("omega"):
            omega = omega + apart(partial(structure, width=round(0.02 / s.period), sigma=s.sigma["omega"]),
                                  s.true_speed - omega, s.train)
        self.speed = np.maximum(omega, 0.0)

    # --- arm: speed -> angle

    def valued(self, values: Values) -> Model:
        """The model with these values."""
        return with_values(self.model, values)

    def arm(self, values: Values, stop: int | None = None) -> Array:
        """Angle as it would be read, before noise and quantisation, for the speed measured; (N,) or up to `stop`."""
        theta, rate = self.arm_motion(values, stop)
        return sensing.angle_reading(theta, rate, sensing.prepare(self.valued(values), self.signals.period))

    def arm_motion(self, values: Values, stop: int | None = None) -> tuple[Array, Array]:
        """True angle and angular rate for the speed measured, (N,) or up to sample `stop`."""
        s, m = self.signals, self.valued(values)
        n = m.numbers()
        cut = s.has("omega") or s.has("i_a")
        if not cut and not s.duty.any() and "initial.omega" not in values and actuator.voltage(n, 0.0) == 0.0:
            speed = np.zeros(len(s))[:stop]  # a rotor that stands
        else:
            speed = self.speed[:stop] if cut else np.maximum(self.motor(values, stop)[1], 0.0)
        state = dynamics.State(omega=float(speed[0]), theta=values.get("initial.theta", 0.0),
                               theta_dot=values.get("initial.theta_dot", 0.0),
                               thrust=float(actuator.thrust(n, speed[0])))
        out = np.empty((2, len(speed)))
        dynamics.run_arm(speed, state, *dynamics.prepare(m, s.period), out)
        return out[0], out[1]

    def arm_residuals(self, values: Values) -> dict[str, Array]:
        """Residual of the angle over the training part, in units of its noise."""
        s = self.signals
        return {"theta": self._train(s.theta, self.arm(values, s.train)) / s.sigma["theta"]}

    def residuals(self, block: str) -> Callable[[Values], dict[str, Array]]:
        """The residual function of a block by name."""
        return {"actuator": self.actuator_residuals, "motor": self.motor_residuals, "arm": self.arm_residuals}[block]

    def _train(self, measured: Array, simulated: Array, start: int = 0) -> Array:
        part = slice(start, self.signals.train)
        return difference(measured[part], simulated[part])


class Chains:
    """The cut chains of several recordings of one rig: numbers and effects are shared, initial states are each one's.

    Names of values and channels of recording k > 0 end in `@k`.
    """

    def __init__(self, model: Model, recordings: Sequence[Signals], *, fit_nominal: bool = False) -> None:
        self.model, self.fit_nominal = model, fit_nominal
        self.each = [Chain.cut(model, signals) for signals in recordings]

    def own(self, values: Values, k: int) -> dict[str, float]:
        """What of the values concerns recording k, under plain names."""
        return self._owns(values)[k]

    def _owns(self, values: Values) -> list[dict[str, float]]:
        shared: dict[str, float] = {}
        own: list[dict[str, float]] = [{} for _ in self.each]
        for name, value in values.items():
            plain, _, k = name.partition("@")
            if k and int(k) < len(own):
                own[int(k)][plain] = value
            elif not k:
                (own[0] if name.startswith("initial.") else shared)[name] = value
        return [shared | mine for mine in own]

    def residuals(self, block: str) -> Callable[[Values], dict[str, Array]]:
        """The residual function of a block over all recordings."""
        return self.joined(lambda chain, values: chain.residuals(block)(values))

    def joined(self, of: Callable[[Chain, Values], dict[str, Array]]) -> Callable[[Values], dict[str, Array]]:
        """One residual function over all recordings, of one over each."""
        def function(values: Values) -> dict[str, Array]:
            return {channel + _suffix(k): r for k, (chain, own) in enumerate(zip(self.each, self._owns(values)))
                    for channel, r in of(chain, own).items()}

        return function

    def head(self, samples: int) -> Chains:
        """The first recordings, up to so many samples of their training parts and nothing else."""
        out, left = copy(self), samples
        out.each = []
        for chain in self.each:
            if left > 0:
                out.each.append(chain.head(min(chain.signals.train, left)))
                left -= chain.signals.train
        return out

    def feed_next(self, block: str, values: Values) -> None:
        """Feed the part behind a block with what was measured, described by the block with these values."""
        for k, chain in enumerate(self.each):
            if block == "actuator":
                chain.feed_motor(self.own(values, k))
            elif block == "motor":
                chain.feed_arm(self.own(values, k))

    @property
    def recordings(self) -> list[Signals]:
        """What was recorded, in the order of `each`."""
        return [chain.signals for chain in self.each]

    def named(self) -> Iterator[tuple[str, Signals]]:
        """For each recording the suffix of its names, and its signals."""
        for k, chain in enumerate(self.each):
            yield _suffix(k), chain.signals


def _suffix(k: int) -> str:
    return f"@{k}" if k else ""


def of_recording(name: str) -> tuple[str, int]:
    """A name without the suffix of its recording, and which recording that is."""
    plain, _, k = name.partition("@")
    return plain, int(k or 0)


def smooth(x: Array, width: int) -> Array:
    """Centred moving mean (N,) over `width` samples, missing ones left out; 0 where there is nothing."""
    known = np.isfinite(x)
    kernel = np.ones(max(1, width | 1))
    total = np.convolve(np.where(known, x, 0.0), kernel, mode="same")
    count = np.convolve(known.astype(float), kernel, mode="same")
    return np.where(count > 0.0, total / np.maximum(count, 1.0), 0.0)


def structure(residual: Array, width: int, sigma: float) -> Array:
    """The slow part (N,) of a residual, shrunk by the share of it that white noise of `sigma` alone would show."""
    slow = smooth(residual, width)
    power = float(np.mean(slow * slow))
    return slow * max(0.0, 1.0 - sigma * sigma / (width | 1) / power) if power > 0.0 else slow


def difference(measured: Array, simulated: Array) -> Array:
    """Measured minus simulated where something was measured; a simulation that ran away counts as far off."""
    off = (measured - simulated)[np.isfinite(measured)]
    if np.isfinite(off).all():
        return off
    return np.nan_to_num(off, nan=RAN_AWAY, posinf=RAN_AWAY, neginf=-RAN_AWAY)


def mean_speed(angle: Array, time: Array, length: Array, period: float) -> Array:
    """Mean speed (M,) over intervals that end at `time` and last `length` (s), of a rotor angle (N,) sampled."""
    grid = np.arange(len(angle)) * period
    return (np.interp(time, grid, angle) - np.interp(time - length, grid, angle)) / length
