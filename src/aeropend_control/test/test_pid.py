# SPDX-License-Identifier: Apache-2.0
import math

import pytest

from aeropend_control.laws.pid import PID

T = 0.01


def test_each_term_is_what_the_formula_says():
    pid = PID(2.0, 3.0, 0.5, period=T, setpoint_weight=0.4)
    assert pid.step(1.0, 0.2, rate=0.7) == pytest.approx(2.0 * (0.4 - 0.2) - 0.5 * 0.7)
    assert pid.step(1.0, 0.2, rate=0.0) == pytest.approx(2.0 * 0.2 + 3.0 * T * 0.8)  # forward Euler: one sample later


def test_the_derivative_is_of_the_measurement_and_knows_no_step_of_the_reference():
    pid = PID(0.0, 0.0, 1.0, period=T)
    assert pid.step(0.0, 0.3) == 0.0  # the first sample has none before it
    assert pid.step(9.0, 0.3) == 0.0
    assert pid.step(9.0, 0.4) == pytest.approx(-0.1 / T)


def test_the_derivative_is_filtered():
    pid = PID(0.0, 0.0, 1.0, period=T, derivative_tau=10 * T)
    y, output = 0.0, 0.0
    for k in range(400):
        y += 2.0 * T
        output = pid.step(0.0, y)
        if k == 1:
            assert output == pytest.approx(-2.0 / 10.0)
    assert output == pytest.approx(-2.0)


def closed_loop(pid, duration=20.0, reference=1.0, load=0.0):
    """ẏ = u - load - y, exactly over each hold."""
    y, out = 0.0, []
    decay = math.exp(-T)
    for _ in range(round(duration / T)):
        u = pid.step(reference, y)
        y = decay * y + (1.0 - decay) * (u - load)
        out.append(y)
    return out


def test_the_integral_leaves_no_error():
    assert closed_loop(PID(2.0, 1.5, period=T), load=0.7)[-1] == pytest.approx(1.0, abs=1e-5)


def test_the_setpoint_weight_changes_the_reference_but_not_the_disturbance():
    overshoot, disturbed = [], []
    for weight in (1.0, 0.0):
        overshoot.append(max(closed_loop(PID(3.0, 12.0, period=T, setpoint_weight=weight))))
        disturbed.append(min(closed_loop(PID(3.0, 12.0, period=T, setpoint_weight=weight), reference=0.0, load=1.0)))
    assert overshoot[0] > overshoot[1] + 0.05
    assert disturbed[0] == pytest.approx(disturbed[1])


def test_a_limited_output_does_not_wind_up():
    free = PID(2.0, 4.0, period=T, high=1.05, tracking_time=1e6)
    led = PID(2.0, 4.0, period=T, high=1.05)
    assert max(closed_loop(free)) > 1.03
    assert max(closed_loop(led)) < 1.015
    assert closed_loop(led)[-1] == pytest.approx(1.0, abs=1e-3)


def test_a_limit_further_down_the_line_counts_the_same():
    own, other = PID(2.0, 4.0, period=T, high=1.1), PID(2.0, 4.0, period=T)
    for k in range(300):
        y = k / 400
        u = own.step(1.0, y)
        limited = min(other.step(1.0, y), 1.1)
        other.track(limited)
        assert limited == pytest.approx(u)
        assert other.integral == pytest.approx(own.integral)


def test_output_stays_within_its_limits_and_reset_forgets():
    pid = PID(5.0, 50.0, 1.0, period=T, low=-0.5, high=0.25)
    first = [pid.step(1.0, y / 50) for y in range(100)]
    assert min(first) == -0.5
    assert max(first) == 0.25
    pid.reset()
    assert [pid.step(1.0, y / 50) for y in range(100)] == first
    pid.reset(integral=0.1)
    assert pid.step(0.0, 0.0) == pytest.approx(0.1)


def test_other_gains_come_without_a_bump():
    pid = PID(2.0, 4.0, 0.3, period=T)
    for k in range(50):
        before = pid.step(1.0, 0.01 * k, rate=0.9)
    at_rest = PID(2.0, 4.0, 0.3, period=T)
    at_rest.integral = pid.integral
    expected = at_rest.step(1.0, 0.49, rate=0.9)  # what the old gains would give for the same sample
    pid.retune(7.0, 1.0, 0.1, setpoint_weight=0.2)
    assert pid.step(1.0, 0.49, rate=0.9) == pytest.approx(expected)
    assert expected == pytest.approx(before, abs=0.1)
    assert pid.step(1.0, 0.59, rate=0.9) == pytest.approx(expected - 0.1 * 7.0 + 1.0 * T * 0.51)


def test_refused_gains_change_nothing():
    pid = PID(2.0, 4.0, 0.3, period=T)
    with pytest.raises(ValueError, match="kd"):
        pid.retune(9.0, 9.0, math.nan)
    assert (pid.kp, pid.ki, pid.kd) == (2.0, 4.0, 0.3)


def test_it_goes_on_from_an_output():
    pid = PID(2.0, 4.0, 0.3, period=T)
    pid.align(0.7, 1.0, 0.2, rate=0.5)
    assert pid.step(1.0, 0.2, rate=0.5) == pytest.approx(0.7)


def test_the_exact_option_is_the_filter_of_held_inputs():
    """A ramp from rest: the difference is held over each sample, the filtered one is 1 - exp(-t/tau) of it."""
    tau = 2.5 * T
    exact, euler = (PID(0.0, 0.0, 1.0, period=T, derivative_tau=tau, exact=e) for e in (True, False))
    for k in range(1, 12):
        out = [pid.step(0.0, 3.0 * T * k) for pid in (exact, euler)]
        assert -out[0] == pytest.approx(-3.0 * math.expm1(-(k - 1) * T / tau), abs=1e-12)
        assert -out[1] == pytest.approx(3.0 * (1.0 - (1.0 - T / tau) ** (k - 1)), abs=1e-12)
    assert PID(0.0, 0.0, 1.0, period=T, derivative_tau=0.1 * T, exact=True).step(0.0, 1.0) == 0.0


@pytest.mark.parametrize(("wrong", "named"), [
    ({"kp": math.nan}, "kp"), ({"ki": math.inf}, "ki"), ({"period": 0.0}, "period"), ({"low": 1.0, "high": 1.0}, "low"),
    ({"derivative_tau": 0.5 * T}, "derivative_tau"), ({"tracking_time": -1.0}, "tracking_time")])
def test_nonsense_is_refused_by_name(wrong, named):
    with pytest.raises(ValueError, match=named) as error:
        PID(**{"kp": 1.0, "period": T, **wrong})
    assert len(str(error.value).splitlines()) == 1
