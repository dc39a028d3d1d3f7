# SPDX-License-Identifier: Apache-2.0
"""The chain cut in three: actuator, motor, arm, each simulated alone and fed with what was measured before it.

So an error upstream does not blame what is downstream. The inputs of a cut are the best description of the measured
signal that the part before it gives, corrected by what that description still leaves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.gap.signals import Signals
from aeropend_sim import actuator, dynamics, sensing
from aeropend_sim.parameters import Model

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


RAN_AWAY = 1e9
"""What the difference to a simulation that is not finite counts as."""


def with_values(model: Model, values: Values) -> Model:
    """The model with these values: `R_a` is a number, `coulomb_friction.accel` an effect's; `initial.*` is left out."""
    numbers = dict(model.model)
    effects = {k: dict(v) for k, v in model.effects.items()}
    for name, value in values.items():
        owner, _, parameter = name.partition(".")
        if not parameter:
            numbers[name] = value
        elif owner != "initial":
            effects.setdefault(owner, {})[parameter] = value
    return Model(model.name, numbers, model.sensing, effects)


@dataclass
class Chain:
    """The cut chain of one recording under one model.

    Attributes:
        model: the nominal model. signals: the recording.
        voltage: (N,) V, measured voltage without its noise; input of the motor.
        speed: (N,) rad/s, measured speed between its pulses; input of the arm.
    """

    model: Model
    signals: Signals
    voltage: Array
    speed: Array

    @classmethod
    def cut(cls, model: Model, signals: Signals) -> Chain:
        """The chain with the nominal model's description of its inner signals; `feed_*` replace them."""
        chain = cls(model, signals, np.zeros(len(signals)), np.zeros(len(signals)))
        chain.feed_motor({})
        chain.feed_arm({})
        return chain

    # --- actuator: duty -> voltage

    def actuator(self, values: Values) -> Array:
        """Voltage (N,) as it would be read."""
        s, m = self.signals, with_values(self.model, values)
        v = actuator.acting_voltage(m.numbers(), s.duty, m.effects, s.period, before=float(s.duty[0]))
        v = v - m.effects.get("supply_sag", {}).get("r_supply", 0.0) * np.nan_to_num(s.i_a)
        return v + m.effects.get("voltage_offset", {}).get("bias", 0.0)

    def actuator_residuals(self, values: Values) -> dict[str, Array]:
        """Residual of the voltage over the training part, in units of its noise."""
        s = self.signals
        return {"v_a": self._train(s.v_a, self.actuator(values), s.after_unseen) / s.sigma["v_a"]}

    def feed_motor(self, values: Values) -> None:
        """Take the voltage that feeds the motor from the measured one, described by the actuator with these values."""
        s = self.signals
        v = self.actuator(values)
        if s.has("v_a"):
            v = v + structure(s.v_a - v, round(0.05 / s.period), s.sigma["v_a"])
            early = np.arange(len(s)) < s.after_unseen
            v = np.where(early & np.isfinite(s.v_a), s.v_a, v)
        self.voltage = v

    # --- motor: voltage -> current, speed

    def motor(self, values: Values) -> tuple[Array, Array, Array]:
        """Current, speed and rotor angle (N,) for the voltage measured."""
        m = with_values(self.model, values)
        # what lies before the terminals is in the voltage already
        effects = {k: p for k, p in m.effects.items() if k != "supply_sag"}
        bias = m.effects.get("voltage_offset", {}).get("bias", 0.0)
        m = m.with_effects(effects)
        state = dynamics.State(i_a=values.get("initial.i_a", 0.0), omega=values.get("initial.omega", 0.0))
        out = np.empty((3, len(self.signals)))
        dynamics.run_motor(self.voltage - bias, state, *dynamics.prepare(m, self.signals.period), out)
        return out[0], out[1], out[2]

    def motor_residuals(self, values: Values) -> dict[str, Array]:
        """Residuals of current and speed over the training part, in units of their noise."""
        s = self.signals
        i_a, omega, angle = self.motor(values)
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
            p = s.pulses
            error = (p.omega - mean_speed(angle, p.time, p.period, s.period))[~p.false]
            middle = (p.time - 0.5 * p.period)[~p.false]
            omega = omega + np.interp(np.arange(len(s)) * s.period, middle, error)
        elif s.has("omega"):
            omega = omega + structure(s.true_speed - omega, round(0.02 / s.period), s.sigma["omega"])
        self.speed = np.maximum(omega, 0.0)

    # --- arm: speed -> angle

    def arm(self, values: Values) -> Array:
        """Angle (N,) as it would be read, before noise and quantisation, for the speed measured."""
        s, m = self.signals, with_values(self.model, values)
        n = m.numbers()
        state = dynamics.State(omega=float(self.speed[0]), theta=values.get("initial.theta", 0.0),
                               theta_dot=values.get("initial.theta_dot", 0.0),
                               thrust=float(actuator.thrust(n, self.speed[0])))
        out = np.empty((2, len(s)))
        dynamics.run_arm(self.speed, state, *dynamics.prepare(m, s.period), out)
        return sensing.angle_reading(out[0], out[1], sensing.prepare(m, s.period))

    def arm_residuals(self, values: Values) -> dict[str, Array]:
        """Residual of the angle over the training part, in units of its noise."""
        return {"theta": self._train(self.signals.theta, self.arm(values)) / self.signals.sigma["theta"]}

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
        plain = {n: v for n, v in values.items() if "@" not in n and (k == 0 or not n.startswith("initial."))}
        return plain | {n.partition("@")[0]: v for n, v in values.items() if n.endswith(f"@{k}")}

    def residuals(self, block: str) -> Callable[[Values], dict[str, Array]]:
        """The residual function of a block over all recordings."""
        def function(values: Values) -> dict[str, Array]:
            return {channel + _suffix(k): r for k, chain in enumerate(self.each)
                    for channel, r in chain.residuals(block)(self.own(values, k)).items()}

        return function

    def feed_next(self, block: str, values: Values) -> None:
        """Feed the part behind a block with what was measured, described by the block with these values."""
        for k, chain in enumerate(self.each):
            if block == "actuator":
                chain.feed_motor(self.own(values, k))
            elif block == "motor":
                chain.feed_arm(self.own(values, k))

    def named(self) -> Iterator[tuple[str, Signals]]:
        """For each recording the suffix of its names, and its signals."""
        for k, chain in enumerate(self.each):
            yield _suffix(k), chain.signals


def _suffix(k: int) -> str:
    return f"@{k}" if k else ""


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
    known = np.isfinite(measured)
    return np.nan_to_num(measured[known] - simulated[known], nan=RAN_AWAY, posinf=RAN_AWAY, neginf=-RAN_AWAY)


def mean_speed(angle: Array, time: Array, length: Array, period: float) -> Array:
    """Mean speed (M,) over intervals that end at `time` and last `length` (s), of a rotor angle (N,) sampled."""
    grid = np.arange(len(angle)) * period
    return (np.interp(time, grid, angle) - np.interp(time - length, grid, angle)) / length
