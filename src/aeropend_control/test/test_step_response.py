# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest
from scipy.optimize import brentq

from aeropend_control.analysis.step_response import StepError, step_responses
from aeropend_sim.model.parameters import SAMPLE_PERIOD

TIME = SAMPLE_PERIOD * np.arange(4000)
LSB = 2.0 * math.pi / 1024


def second_order(time, zeta, omega):
    """The step response of omega²/(s² + 2 zeta omega s + omega²), 0 before time 0."""
    wd = omega * math.sqrt(1.0 - zeta**2)
    t = np.maximum(time, 0.0)
    return 1.0 - np.exp(-zeta * omega * t) * (np.cos(wd * t) + zeta * omega / wd * np.sin(wd * t))


def rise(zeta, omega):
    """Its t_r, by the exact response."""
    peak = math.pi / (omega * math.sqrt(1.0 - zeta**2))
    crossing = [brentq(lambda t, level=level: float(second_order(t, zeta, omega)) - level, 0.0, peak)
                for level in (0.1, 0.9)]
    return crossing[1] - crossing[0]


def settling(zeta, omega):
    """Its t_s, by the exact response on a fine grid."""
    t = np.linspace(0.0, 8.0, 400_000)
    return t[np.flatnonzero(np.abs(second_order(t, zeta, omega) - 1.0) > 0.02)[-1]]


@pytest.mark.parametrize(("zeta", "omega"), [(0.3, 6.0), (0.456, 6.0), (0.6, 4.0), (0.7, 9.0)])
@pytest.mark.parametrize("smoothing", [0.0, 0.06])
def test_second_order_answers(zeta, omega, smoothing):
    start = TIME[500]
    reference = np.where(start <= TIME, 0.4, 0.0)
    (step,) = step_responses(TIME, 0.4 * second_order(TIME - start, zeta, omega), reference, smoothing)
    assert step.start == start
    assert (step.reference, step.initial) == (0.4, pytest.approx(0.0, abs=1e-4))
    assert step.rise_time == pytest.approx(rise(zeta, omega), rel=0.005)
    assert step.peak_time == pytest.approx(math.pi / (omega * math.sqrt(1.0 - zeta**2)), rel=0.005)
    assert step.settling_time == pytest.approx(settling(zeta, omega), rel=0.01)
    assert step.overshoot == pytest.approx(math.exp(-math.pi * zeta / math.sqrt(1.0 - zeta**2)), abs=0.003)
    assert step.steady_state_error == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize("size", [0.2, 0.4, -0.5])
@pytest.mark.parametrize("seed", range(5))
def test_noise_and_quantisation_change_little(size, seed):
    start = TIME[500]
    y = 0.6 + size * second_order(TIME - start, 0.5, 6.0)
    read = LSB * np.round((y + 2e-3 * np.random.default_rng(seed).standard_normal(len(y))) / LSB)
    reference = np.where(start <= TIME, 0.6 + size, 0.6)
    (exact,), (seen,) = step_responses(TIME, y, reference), step_responses(TIME, read, reference)
    assert seen.rise_time == pytest.approx(exact.rise_time, rel=0.06)
    assert seen.peak_time == pytest.approx(exact.peak_time, rel=0.15)
    assert seen.settling_time == pytest.approx(exact.settling_time, rel=0.15)
    assert seen.overshoot == pytest.approx(exact.overshoot, abs=0.02)
    assert seen.steady_state_error == pytest.approx(0.0, abs=1e-3)


def test_a_response_without_overshoot_has_no_peak():
    noise = 2e-3 * np.random.default_rng(0).standard_normal(len(TIME))
    (step,) = step_responses(TIME, 0.4 * -np.expm1(-TIME / 0.4) + noise, np.full(len(TIME), 0.4))
    assert step.overshoot == 0.0
    assert math.isnan(step.peak_time)
    assert step.rise_time == pytest.approx(0.4 * math.log(9.0), rel=0.05)
    assert step.settling_time == pytest.approx(0.4 * math.log(50.0), rel=0.1)


def test_every_step_of_a_sequence_and_its_steady_state_error():
    levels = (0.2, 0.5, 0.5, 0.3)
    reference = np.repeat(levels, 2000)
    time = SAMPLE_PERIOD * np.arange(len(reference))
    y = np.zeros(len(time))
    for before, level, k in ((0.0, 0.2, 0), (0.2, 0.5, 2000), (0.5, 0.3, 6000)):
        y[k:] = before + 0.01 * (k == 0) + (level - before) * second_order(time[k:] - time[k], 0.6, 6.0)
    found = step_responses(time, y, reference)
    assert [s.reference for s in found] == [0.2, 0.5, 0.3]
    assert [s.start for s in found] == [time[0], time[2000], time[6000]]
    assert [s.initial for s in found[1:]] == [pytest.approx(0.21, abs=2e-3), pytest.approx(0.5, abs=2e-3)]
    assert [s.steady_state_error for s in found] == [pytest.approx(e, abs=1e-3) for e in (-0.01, 0.0, 0.0)]
    assert found[2].overshoot == pytest.approx(math.exp(-math.pi * 0.6 / 0.8), abs=0.005)


def test_what_is_not_reached_is_nan():
    y = 0.4 * second_order(TIME, 0.02, 6.0)  # swings on and on
    (step,) = step_responses(TIME, y, np.full(len(TIME), 0.4))
    assert math.isnan(step.settling_time)
    assert step.overshoot > 0.7


NOISE = 2e-3 * np.random.default_rng(3).standard_normal(len(TIME))


@pytest.mark.parametrize(("y", "reference", "said"), [
    (NOISE, np.zeros(len(TIME)), "no step"),
    (np.full(len(TIME), 0.3), np.full(len(TIME), 0.3), "no step"),
    (NOISE, np.where(TIME > 2.0, 0.4, 0.0), "does not move"),
    (np.zeros(len(TIME)), np.where(TIME > 2.0, 0.4, 0.0), "does not move"),
    (np.where(TIME > 2.0, np.nan, 0.0), np.where(TIME > 2.0, 0.4, 0.0), "NaN"),
    (np.zeros(7), np.where(TIME > 2.0, 0.4, 0.0), "lengths"),
])
def test_no_step_is_said_in_one_line(y, reference, said):
    with pytest.raises(StepError, match=said) as error:
        step_responses(TIME, y, reference)
    assert len(str(error.value).splitlines()) == 1


def test_time_must_rise():
    with pytest.raises(StepError, match="rise"):
        step_responses(TIME[::-1], TIME, TIME > 2.0)
