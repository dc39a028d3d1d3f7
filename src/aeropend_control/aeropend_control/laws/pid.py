# SPDX-License-Identifier: Apache-2.0
"""A PID controller for a fixed sample period."""

from __future__ import annotations

import math

from aeropend_sim.model.parameters import SAMPLE_PERIOD


class PID:
    """u = kp (b r - y) + ki ∫(r - y) dt - kd dy/dt, limited; forward Euler as in the thesis' library (6.4), or exact.

    Two degrees of freedom: the set-point weight b changes the response to the reference and not the response to a
    disturbance. Anti-windup by back-calculation (Åström & Hägglund 1995, 3.5).
    """

    def __init__(self, kp: float, ki: float = 0.0, kd: float = 0.0, *, period: float = SAMPLE_PERIOD,
                 setpoint_weight: float = 1.0, derivative_tau: float = 0.0, tracking_time: float = 0.0,
                 low: float = -math.inf, high: float = math.inf, exact: bool = False) -> None:
        """Prepare the controller. Below, out and in are the units of output and measurement.

        Args:
            kp: [out/in] proportional gain.
            ki: [out/in/s] integral gain.
            kd: [out·s/in] derivative gain.
            period: [s] between samples.
            setpoint_weight: b, 0..1.
            derivative_tau: [s] time constant of the derivative's filter; 0: no filter, else at least one period.
            tracking_time: [s] time constant of the back-calculation; 0: sqrt(kd/ki)/2, or kp/ki if kd is 0.
            low: [out] least output.
            high: [out] greatest output.
            exact: discretise the derivative's filter and the back-calculation exactly for inputs held over a period,
                instead of by forward Euler. The integral of a held error is the same in both cases. Then time constants
                may be shorter than a period.

        Raises:
            ValueError: an argument cannot be used; one line that names it.
        """
        if not 0.0 < period < math.inf:
            raise ValueError(f"period is {period} s: give more than 0")
        self.exact, self.period = exact, period
        self._check_time("derivative_tau", derivative_tau)
        if not low < high:
            raise ValueError(f"the output is limited to {low}..{high}: give low < high")
        self.derivative_tau, self.low, self.high = derivative_tau, low, high
        self.kp = self.ki = self.kd = self.setpoint_weight = 0.0
        self.reset()
        self.retune(kp, ki, kd, setpoint_weight=setpoint_weight, tracking_time=tracking_time)

    def retune(self, kp: float, ki: float = 0.0, kd: float = 0.0, *, setpoint_weight: float = 1.0,
               tracking_time: float = 0.0) -> None:
        """Change the gains without a bump: the integral compensates the change of the output.

        Args:
            kp: [out/in] proportional gain.
            ki: [out/in/s] integral gain.
            kd: [out·s/in] derivative gain.
            setpoint_weight: b, 0..1.
            tracking_time: [s] as for the constructor.

        Raises:
            ValueError: a gain cannot be used; one line that names it. All gains keep their values.
        """
        for name, value in (("kp", kp), ("ki", ki), ("kd", kd), ("setpoint_weight", setpoint_weight)):
            if not math.isfinite(value):
                raise ValueError(f"{name} is {value}: give a finite number")
        self._check_time("tracking_time", tracking_time)
        before = self._immediate(*self._last)
        self.kp, self.ki, self.kd, self.setpoint_weight = kp, ki, kd, setpoint_weight
        self.tracking_time = tracking_time
        if ki != 0.0 and self.tracking_time == 0.0:
            ratio = 0.5 * math.sqrt(abs(kd / ki)) if kd != 0.0 else abs(kp / ki)
            self.tracking_time = max(ratio, self.period)
        self.integral += before - self._immediate(*self._last)

    def align(self, output: float, reference: float, measurement: float, rate: float = 0.0) -> None:
        """Set the integral so that the output for these inputs is `output`.

        Args:
            output: [out] the output to continue from.
            reference: [in] reference.
            measurement: [in] measurement.
            rate: [in/s] derivative of the measurement.
        """
        self.integral = output - self._immediate(reference, measurement, rate)

    def reset(self, integral: float = 0.0) -> None:
        """Restart with a value of the integral part [out]."""
        self.integral = integral
        self._derivative = 0.0
        self._before = math.nan
        self._last = 0.0, 0.0, 0.0
        self._output = 0.0

    def step(self, reference: float, measurement: float, rate: float | None = None) -> float:
        """Process a sample.

        Args:
            reference: [in] reference.
            measurement: [in] measurement.
            rate: [in/s] its derivative, which is not filtered; None: the filtered difference of two samples.

        Returns:
            [out] The output, low..high.
        """
        error = reference - measurement
        self._last = reference, measurement, self._rate(measurement) if rate is None else rate
        wanted = self.integral + self._immediate(*self._last)
        self._output = min(max(wanted, self.low), self.high)
        self.integral += self.period * self.ki * error
        self._back_calculate(self._output - wanted)
        return self._output

    def track(self, applied: float) -> None:
        """Back-calculate from the output [out] that was applied, if it was limited further downstream."""
        self._back_calculate(applied - self._output)
        self._output = applied

    def _immediate(self, reference: float, measurement: float, rate: float) -> float:
        return self.kp * (self.setpoint_weight * reference - measurement) - self.kd * rate

    def _back_calculate(self, excess: float) -> None:
        if self.ki != 0.0 and excess != 0.0:
            self.integral += self._share(self.tracking_time) * excess

    def _rate(self, measurement: float) -> float:
        difference = 0.0 if math.isnan(self._before) else (measurement - self._before) / self.period
        self._before = measurement
        self._derivative += self._share(self.derivative_tau) * (difference - self._derivative)
        return self._derivative

    def _share(self, tau: float) -> float:
        """Share of its distance to a held input that a first-order lag covers in a period."""
        if tau == 0.0:
            return 1.0
        return -math.expm1(-self.period / tau) if self.exact else self.period / tau

    def _check_time(self, name: str, tau: float) -> None:
        shortest = 0.0 if self.exact else self.period
        if tau != 0.0 and not shortest <= tau < math.inf:
            raise ValueError(f"{name} is {tau} s: give 0 or at least one period, {self.period:g} s")
