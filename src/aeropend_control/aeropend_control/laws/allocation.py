# SPDX-License-Identifier: Apache-2.0
"""Control allocation: from the thrust that a law wants to the duty, by the inverses of `aeropend_sim.model.actuator`.

The duty map's dead zone, and what the model names of `thrust_lag`, `thrust_exponent`, `rotor_friction`, `brush_drop`,
`winding_heating`, `supply_sag`, `bridge_drop` and `supply_drift`, are in it. The supply is taken to be fresh, and the
winding cold, when the observer was reset.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aeropend_control.laws.observer import Observer
from aeropend_sim.model import actuator, dynamics

Array = NDArray[np.float64]


class Allocation:
    """Thrust -> speed -> voltage -> duty for the observer's model.

    Attributes:
        thrust_time: s in which the thrust is made to follow what is wanted; 0: the motor is given the voltage that
            holds that thrust, as in the thesis, and takes its own time.
    """

    def __init__(self, observer: Observer, thrust_time: float = 0.0) -> None:
        model = observer.model
        self._observer, self._numbers = observer, model.numbers()
        self.thrust_time = thrust_time
        self._bridge_drop = model.effect("bridge_drop", "v_drop")
        self._supply_drift = model.effect("supply_drift", "rate")
        self._supply_resistance = model.effect("supply_sag", "r_supply")
        self._heating = model.effect("winding_heating", "gain")
        self._brush_drop = model.effect("brush_drop", "v_brush")
        self._rotor_friction = model.effect("rotor_friction", "torque")
        self._thrust_lag = model.effect("thrust_lag", "tau")
        self._thrust_exponent = model.effect("thrust_exponent", "n")

    def duty(self, thrust: float, s: dynamics.State) -> tuple[float, float]:
        """Duty for a thrust (N) in a state, and the thrust that comes of it within the limits of the duty."""
        air_time = self.air_time(self.thrust_time)
        speed = self.speed(self.static_thrust_for(thrust, s, air_time))
        rotor_time = self.thrust_time - air_time
        n, resistance = self._numbers, self.resistance(s)
        if rotor_time:
            now, per_speed = s.omega, n["J_m"] / (n["K_t"] * rotor_time)
            current, slope = per_speed * (speed - now), resistance * per_speed
        else:
            now, current = speed, 0.0
            slope = n["K_e"] + resistance * (n["B_m"] + 2.0 * n["k_load"] * speed) / n["K_t"]
        current += self.holding_current(now, speed)
        wanted = n["K_e"] * now + self.drop(current, s)
        duty, given = self.duty_of_voltage(wanted)
        return duty, self.thrust_from(self.thrust(speed + (given - wanted) / slope), s, air_time)

    def air_time(self, thrust_time: float) -> float:
        """In which part of the time for the thrust the air is made to follow; 0 where it does not lag."""
        return min(self._thrust_lag, 0.5 * thrust_time)

    def static_thrust_for(self, thrust: float, s: dynamics.State, air_time: float) -> float:
        """Static thrust that drives the air so that its thrust closes in on what is wanted in that time."""
        return s.thrust + self._thrust_lag / air_time * (thrust - s.thrust) if air_time else thrust

    def thrust_from(self, thrust: float, s: dynamics.State, air_time: float) -> float:
        """The inverse of `led`."""
        return s.thrust + air_time / self._thrust_lag * (thrust - s.thrust) if air_time else thrust

    def thrust(self, speed: float) -> float:
        """Thrust (N) of a steady speed (rad/s)."""
        c, e, _ = self._observer.plant
        return float(dynamics.static_thrust(speed, c, e))

    def speed(self, thrust: float) -> float:
        """Speed (rad/s) of a steady thrust (N); 0 where the propeller would have to push."""
        pivot, exponent = dynamics.THRUST_PIVOT_SPEED, self._thrust_exponent
        if thrust <= 0.0:
            return 0.0
        if exponent == 2.0:
            return float(actuator.speed(self._numbers, thrust))
        return pivot * (thrust / (self._numbers["k_thrust"] * pivot**2)) ** (1.0 / exponent)

    def resistance(self, s: dynamics.State) -> float:
        """Ω of winding and supply."""
        return self._numbers["R_a"] * (1.0 + self._heating * s.heat) + self._supply_resistance

    def holding_current(self, speed: float, wanted: float) -> float:
        """Current (A) that holds a speed (rad/s), when the rotor is to turn at `wanted`."""
        friction = self._rotor_friction / self._numbers["K_t"] if wanted > 0.0 else 0.0
        return float(actuator.current_at(self._numbers, speed)) + friction

    def drop(self, current: float, s: dynamics.State) -> float:
        """Voltage that a steady current takes in winding, brushes and supply."""
        brushes = self._brush_drop * float(dynamics.brush_sign(current)) if self._brush_drop else 0.0
        return self.resistance(s) * current + brushes

    def duty_of_voltage(self, wanted: float) -> tuple[float, float]:
        """Duty for a voltage at the bridge, and the voltage that the limits of the duty leave of it."""
        left = max(1e-3, 1.0 - self._supply_drift * self._observer.count * self._observer.period)
        duty = float(actuator.duty(self._numbers, (wanted + self._bridge_drop) / left)) if wanted > 0.0 else 0.0
        return duty, max(0.0, float(actuator.voltage(self._numbers, duty)) * left - self._bridge_drop)
