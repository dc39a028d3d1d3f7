# SPDX-License-Identifier: Apache-2.0
"""Control allocation: from the thrust that a law demands to the duty, by the inverses of `aeropend_sim.model.actuator`.

It compensates the dead zone of the duty map and these effects, if the model has them: `thrust_lag`, `thrust_exponent`,
`rotor_friction`, `brush_drop`, `winding_heating`, `supply_sag`, `bridge_drop` and `supply_drift`. It assumes a fresh
supply and a cold winding at the last reset of the observer.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from aeropend_control.laws.observer import Observer
from aeropend_sim.model import actuator
from aeropend_sim.model.arm import static_thrust
from aeropend_sim.model.effects import THRUST_PIVOT_SPEED
from aeropend_sim.model.motor import brush_sign
from aeropend_sim.model.state import State

Array = NDArray[np.float64]


class Allocation:
    """Thrust -> speed -> voltage -> duty for the observer's model.

    Attributes:
        thrust_time: [s] time constant with which the thrust follows the demand; 0: the motor gets the voltage of the
            steady thrust, as in the thesis, and the thrust follows with the motor's own time constant.
    """

    def __init__(self, observer: Observer, thrust_time: float = 0.0) -> None:
        """Prepare the inverses for the observer's model.

        Args:
            observer: gives the model, the sample period and the time since the reset.
            thrust_time: [s] see the attribute.
        """
        model = observer.model
        self._observer, self._numbers = observer, model.numbers()
        self._duty_map = actuator.duty_map(self._numbers)
        self.thrust_time = thrust_time
        self._bridge_drop = model.in_any_form("bridge_drop", "v_drop")
        self._supply_drift = model.in_any_form("supply_drift", "rate")
        self._supply_resistance = model.in_any_form("supply_sag", "r_supply")
        self._heating = model.effect("winding_heating", "gain")
        self._brush_drop = model.in_any_form("brush_drop", "v_brush")
        self._rotor_friction = model.in_any_form("rotor_friction", "torque")
        self._thrust_lag = model.effect("thrust_lag", "tau")
        self._thrust_exponent = model.effect("thrust_exponent", "n")

    def duty(self, thrust: float, s: State) -> tuple[float, float]:
        """Duty for a demanded thrust.

        Args:
            thrust: [N] demand.
            s: state of the rig.

        Returns:
            The duty [0..1], and the thrust [N] that results within the limits of the duty.
        """
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
        """[s] The share of `thrust_time` [s] that is the air's; 0 if the model has no `thrust_lag`."""
        return min(self._thrust_lag, 0.5 * thrust_time)

    def static_thrust_for(self, thrust: float, s: State, air_time: float) -> float:
        """[N] Static thrust for which the lagging thrust follows a demand [N] with the time constant `air_time` [s]."""
        return s.thrust + self._thrust_lag / air_time * (thrust - s.thrust) if air_time else thrust

    def thrust_from(self, thrust: float, s: State, air_time: float) -> float:
        """[N] Thrust that a static thrust [N] amounts to: the inverse of `static_thrust_for`."""
        return s.thrust + air_time / self._thrust_lag * (thrust - s.thrust) if air_time else thrust

    def thrust(self, speed: float) -> float:
        """[N] Thrust at a steady speed [rad/s]."""
        c, e, *_ = self._observer.plant
        return float(static_thrust(speed, c, e))

    def speed(self, thrust: float) -> float:
        """[rad/s] Speed for a steady thrust [N]; 0 for a negative one, which the propeller cannot give."""
        pivot, exponent = THRUST_PIVOT_SPEED, self._thrust_exponent
        if thrust <= 0.0:
            return 0.0
        if exponent == 2.0:
            return actuator.speed(self._numbers, thrust)
        return pivot * (thrust / (self._numbers["k_thrust"] * pivot**2)) ** (1.0 / exponent)

    def resistance(self, s: State) -> float:
        """[Ω] Resistance of winding and supply."""
        return self._numbers["R_a"] * (1.0 + self._heating * s.heat) + self._supply_resistance

    def holding_current(self, speed: float, wanted: float) -> float:
        """[A] Steady current at a speed [rad/s], with dry friction if the demanded speed `wanted` [rad/s] is > 0."""
        friction = self._rotor_friction / self._numbers["K_t"] if wanted > 0.0 else 0.0
        return actuator.current_at(self._numbers, speed) + friction

    def drop(self, current: float, s: State) -> float:
        """[V] Voltage drop of a steady current [A] in winding, brushes and supply."""
        brushes = self._brush_drop * float(brush_sign(current)) if self._brush_drop else 0.0
        return self.resistance(s) * current + brushes

    def duty_of_voltage(self, wanted: float) -> tuple[float, float]:
        """Duty for a demanded voltage behind the bridge.

        Args:
            wanted: [V] demand.

        Returns:
            The duty [0..1], and the voltage [V] that results within the limits of the duty.
        """
        left = max(1e-3, 1.0 - self._supply_drift * self._observer.count * self._observer.period)
        duty = actuator.unmapped((wanted + self._bridge_drop) / left, self._duty_map) if wanted > 0.0 else 0.0
        return duty, max(0.0, actuator.mapped(duty, self._duty_map) * left - self._bridge_drop)
