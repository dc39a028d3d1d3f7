# SPDX-License-Identifier: Apache-2.0
"""A PID controller for a fixed sample period."""

from __future__ import annotations

import math

from aeropend_sim.model.parameters import SAMPLE_PERIOD


class PID:
    """u = kp (b r - y) + ki ∫(r - y) dt - kd dy/dt, limited, by forward Euler as the thesis' library (6.4), or exact.

    Two degrees of freedom: the set-point weight b shapes the answer to a step of the reference and leaves the answer to
    a disturbance alone. While the output is limited, the integral is led back (back-calculation, Åström & Hägglund
    1995, 3.5).
    """

    def __init__(self, kp: float, ki: float = 0.0, kd: float = 0.0, *, period: float = SAMPLE_PERIOD,
                 setpoint_weight: float = 1.0, derivative_tau: float = 0.0, tracking_time: float = 0.0,
                 low: float = -math.inf, high: float = math.inf, exact: bool = False) -> None:
        """Gains in units of output per unit of input, per second, times second.

        Args:
            kp: proportional gain.
            ki: integral gain.
            kd: derivative gain.
            period: s between samples.
            setpoint_weight: b, 0..1.
            derivative_tau: s of the first-order filter of the derivative; 0: none, else at least one period.
            tracking_time: s in which the integral is led back; 0: half of sqrt(kd/ki), or kp/ki without a derivative.
            low: least output.
            high: greatest output.
            exact: sample the derivative's filter and the tracking exactly for inputs held over a period, instead of by
                forward Euler; the integral of a held error is the same by both. No time is too short for it.

        Raises:
            ValueError: one line that says which number cannot be used.
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
        """Change the gains; the integral takes over what that would change of the output.

        Raises:
            ValueError: one line that says which gain cannot be used; all are as they were.
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
        """Set the integral so that the output for these goes on from `output`."""
        self.integral = output - self._immediate(reference, measurement, rate)

    def reset(self, integral: float = 0.0) -> None:
        """Forget the past; `integral` is the integral's share of the output from here on."""
        self.integral = integral
        self._derivative = 0.0
        self._before = math.nan
        self._last = 0.0, 0.0, 0.0
        self._output = 0.0

    def step(self, reference: float, measurement: float, rate: float | None = None) -> float:
        """Take one sample.

        Args:
            reference: what the measurement is to become.
            measurement: this sample.
            rate: its derivative, if that is known better than by the difference of two samples; not filtered.

        Returns:
            The output, low..high.
        """
        error = reference - measurement
        self._last = reference, measurement, self._rate(measurement) if rate is None else rate
        wanted = self.integral + self._immediate(*self._last)
        self._output = min(max(wanted, self.low), self.high)
        self.integral += self.period * self.ki * error
        self._lead_back(self._output - wanted)
        return self._output

    def track(self, applied: float) -> None:
        """Tell what came of the last output further down the line, where that is limited too."""
        self._lead_back(applied - self._output)
        self._output = applied

    def _immediate(self, reference: float, measurement: float, rate: float) -> float:
        return self.kp * (self.setpoint_weight * reference - measurement) - self.kd * rate

    def _lead_back(self, excess: float) -> None:
        if self.ki != 0.0 and excess != 0.0:
            self.integral += self._share(self.tracking_time) * excess

    def _rate(self, measurement: float) -> float:
        difference = 0.0 if math.isnan(self._before) else (measurement - self._before) / self.period
        self._before = measurement
        self._derivative += self._share(self.derivative_tau) * (difference - self._derivative)
        return self._derivative

    def _share(self, tau: float) -> float:
        """Of what a first-order lag is away from its input, the share by which it closes in over a period."""
        if tau == 0.0:
            return 1.0
        return -math.expm1(-self.period / tau) if self.exact else self.period / tau

    def _check_time(self, name: str, tau: float) -> None:
        shortest = 0.0 if self.exact else self.period
        if tau != 0.0 and not shortest <= tau < math.inf:
            raise ValueError(f"{name} is {tau} s: give 0 or at least one period, {self.period:g} s")
