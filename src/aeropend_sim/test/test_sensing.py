# SPDX-License-Identifier: Apache-2.0
"""The measurement chain against closed forms, scipy and brute force."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import brentq

from aeropend_sim.model import dynamics, sensing
from aeropend_sim.model.dynamics import simulate
from aeropend_sim.model.effects import SPIKE_FACTOR
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model, load
from aeropend_sim.model.rig import Sample, record

H = SAMPLE_PERIOD
STEP = 2.0 * math.pi
THETA, OMEGA, I_A, V_A = range(4)


def chain(effects=None, period=H, **sensing_numbers):
    """A chain that measures perfectly but for what is named."""
    base = load("thesis")
    return sensing.prepare(Model("chain", base.model, {**base.sensing, **sensing_numbers}, effects or {}), period)


def read(states, c, seed=0):
    """Readings (4, N) of (7, N) states, by fresh random numbers."""
    rng = np.random.default_rng(seed)
    n = states.shape[1]
    out = np.empty((4, n))
    sensing.read(out, states, rng.standard_normal((n, 4)), rng.random((n, 2)), sensing.NOTHING_READ, True, c)
    return out


def states(n, **channels):
    """(7, N) states in the order of a trajectory, 0 where not named."""
    order = ("theta", "theta_dot", "i_a", "omega", "v_a", "rotor_angle", "thrust")
    return np.array([np.broadcast_to(channels.get(name, 0.0), n) for name in order], dtype=float)


def turning(omega, n, period=H, begin=0.0):
    """A rotor at a constant speed."""
    return states(n, omega=omega, rotor_angle=begin + omega * period * np.arange(n))


def varied():
    rng = np.random.default_rng(2)
    return states(500, **{name: rng.uniform(-1.0, 1.0, 500) for name in ("theta", "i_a", "omega", "v_a")})


def test_perfect_chain_reads_the_state():
    s = varied()
    assert np.array_equal(read(s, chain()), s[[0, 3, 2, 4]])


# --- quantisation and noise

@pytest.mark.parametrize(("name", "row"), [("angle_lsb", THETA), ("current_lsb", I_A), ("voltage_lsb", V_A)])
def test_quantisation_rounds_to_the_nearest_multiple(name, row):
    s, lsb = varied(), 0.0123
    perfect, found = read(s, chain()), read(s, chain(**{name: lsb}))
    multiples = found[row] / lsb
    assert np.abs(multiples - np.round(multiples)).max() < 1e-12
    assert np.abs(found[row] - perfect[row]).max() <= 0.5 * lsb * (1.0 + 1e-12)
    assert np.abs(found[row] - perfect[row]).max() > 0.45 * lsb
    assert abs(np.mean(found[row] - perfect[row])) < 0.1 * lsb
    others = [k for k in range(4) if k != row]
    assert np.array_equal(found[others], perfect[others])


@pytest.mark.parametrize(("name", "row"), [("angle_noise", THETA), ("current_noise", I_A), ("voltage_noise", V_A),
                                           ("speed_noise", OMEGA)])
def test_noise_is_white_and_normal(name, row):
    n, sigma = 100_000, 0.02
    found = read(states(n), chain(**{name: sigma}))
    noise = found[row]
    assert noise.std() == pytest.approx(sigma, rel=0.01)
    assert abs(noise.mean()) < 4.0 * sigma / math.sqrt(n)
    assert abs(np.mean(noise[1:] * noise[:-1])) < 4.0 * sigma**2 / math.sqrt(n)
    assert np.mean(np.abs(noise) < sigma) == pytest.approx(0.6827, abs=0.006)
    assert not found[[k for k in range(4) if k != row]].any()


def test_noise_of_the_channels_is_independent():
    names = ("angle_noise", "speed_noise", "current_noise", "voltage_noise")
    found = read(states(100_000), chain(**dict.fromkeys(names, 1.0)))
    assert np.abs(np.corrcoef(found) - np.eye(4)).max() < 0.015


def test_noise_comes_before_quantisation():
    found = read(states(1000), chain(angle_noise=0.02, angle_lsb=0.01))
    multiples = found[THETA] / 0.01
    assert np.abs(multiples - np.round(multiples)).max() < 1e-12
    assert len(np.unique(found[THETA])) > 5


# --- angle filter

def filtered(theta, time, first, second):
    """Two first-order stages, settled at the first angle, by scipy."""
    def stages(t, x):
        return [(theta(t) - x[0]) / first, (x[0] - x[1]) / second]
    return solve_ivp(stages, (0.0, time[-1]), [theta(0.0)] * 2, "DOP853", time, rtol=1e-11, atol=1e-13).y[1]


@pytest.mark.parametrize("more", [0.0, 0.04])
@pytest.mark.parametrize(("period", "tau", "limit"), [
    (H, 4.7e-3, 2e-5), (H, 0.03, 1e-6), (H, 1e-3, 2e-4), (20e-3, 0.1, 2e-3), (50e-3, 0.5, 2e-3), (50e-3, 4.7e-3, 0.02)])
def test_filter_meets_scipy(period, tau, limit, more):
    def theta(t):
        return 0.4 + 0.3 * np.sin(12.0 * t) + 0.2 * np.cos(5.0 * t + 1.0)

    def theta_dot(t):
        return 3.6 * np.cos(12.0 * t) - 1.0 * np.sin(5.0 * t + 1.0)

    time = np.arange(round(3.0 / period)) * period
    c = chain({"encoder_lag_single": {"lag": more}}, angle_filter_tau=tau, period=period)
    found = read(states(len(time), theta=theta(time), theta_dot=theta_dot(time)), c)
    expected = filtered(theta, time, tau, tau + more)
    assert np.abs(found[THETA] - expected).max() < limit * np.ptp(expected)
    again = sensing.angle_reading(theta(time), theta_dot(time), c)
    assert np.array_equal(again, found[THETA])


@pytest.mark.parametrize("period", [H, 20e-3, 50e-3])
def test_filter_lags_a_ramp_by_twice_its_time_constant(period):
    time = np.arange(round(2.0 / period)) * period
    found = read(states(len(time), theta=0.7 * time, theta_dot=0.7), chain(angle_filter_tau=0.03, period=period))
    late = time > 1.5
    assert found[THETA][late] == pytest.approx(0.7 * (time[late] - 0.06), abs=1e-12)


def test_filter_starts_settled():
    found = read(states(50, theta=0.37), chain(angle_filter_tau=0.1))
    assert found[THETA] == pytest.approx(np.full(50, 0.37), abs=1e-14)


def test_encoder_lag_is_a_slower_filter():
    rng = np.random.default_rng(3)
    s = states(300, theta=np.cumsum(rng.standard_normal(300)))
    slower = read(s, chain({"encoder_lag": {"tau": 0.03}}, angle_filter_tau=4.7e-3))
    assert np.array_equal(slower, read(s, chain(angle_filter_tau=4.7e-3 + 0.03)))
    assert np.array_equal(read(s, chain({"encoder_lag": {"tau": 0.03}})), read(s, chain(angle_filter_tau=0.03)))


def test_a_single_slow_stage_needs_no_other():
    time = np.arange(1000) * H
    found = read(states(1000, theta=0.7 * time, theta_dot=0.7), chain({"encoder_lag_single": {"lag": 0.06}}))
    assert found[THETA][-1] == pytest.approx(0.7 * (time[-1] - 0.06), abs=1e-9)


# --- effects of sensing

def test_offsets_and_gain_and_their_order():
    s = varied()
    found = read(s, chain({"angle_offset": {"bias": 0.06}, "encoder_eccentricity": {"amplitude": 0.05, "phase": 0.5},
                           "current_gain": {"gain": 0.15}, "current_offset": {"bias": 0.06},
                           "voltage_offset": {"bias": 0.1}}))
    assert found[THETA] == pytest.approx(s[0] + 0.06 + 0.05 * np.sin(s[0] + 0.5), abs=1e-15)
    assert found[I_A] == pytest.approx(1.15 * s[2] + 0.06, abs=1e-15)
    assert found[V_A] == pytest.approx(s[4] + 0.1, abs=1e-15)
    assert np.array_equal(found[OMEGA], s[3])


def test_encoders_error_is_before_the_filter():
    s = states(2, theta=np.array([0.0, 1.0]))
    error = {"encoder_eccentricity": {"amplitude": 0.05, "phase": 0.5}, "angle_offset": {"bias": 0.1}}
    start = 0.05 * math.sin(0.5) + 0.1
    assert read(s, chain(error, angle_filter_tau=10.0 * H))[THETA, 0] == pytest.approx(start, abs=1e-15)
    assert abs(read(s, chain(error, angle_filter_tau=1.0))[THETA, 1] - start) < 1e-3


# --- speed from pulses

def measured_speed(angle_at, n, period, pulses, tick):
    """Contract section 3 by brute force: find each pulse, time it, hold what the last two give; (N,) rad/s."""
    step, end = STEP / pulses, (n - 1) * period
    first = math.floor(angle_at(0.0) / step) + 1
    last = math.floor(angle_at(end) / step)
    times = [brentq(lambda t, k=k: angle_at(t) - k * step, 0.0, end, xtol=1e-14) for k in range(first, last + 1)]
    counted = [tick * math.floor(t / tick) if tick else t for t in times]
    out = np.zeros(n)
    for k in range(n):
        known = [c for t, c in zip(times, counted, strict=True) if t <= k * period]
        if len(known) >= 2 and k * period - known[-1] <= 0.5:
            out[k] = step / (known[-1] - known[-2])
    return out


@pytest.mark.parametrize("period", [H, 20e-3])
@pytest.mark.parametrize("pulses", [1, 2, 7])
@pytest.mark.parametrize("tick", [0.0, 4e-6, 1e-4])
@pytest.mark.parametrize("omega", [8.1, 33.0, 171.0])
def test_constant_speed_is_that_of_the_pulses(period, pulses, tick, omega):
    n = round(2.0 / period)
    found = read(turning(omega, n, period, 1.234), chain(period=period, speed_pulses_per_rev=pulses, speed_tick=tick))
    expected = measured_speed(lambda t: 1.234 + omega * t, n, period, pulses, tick)
    assert found[OMEGA] == pytest.approx(expected, rel=1e-6)
    assert np.count_nonzero(expected) > 0.2 * n


def test_changing_speed_is_that_of_the_pulses():
    n = 2500
    duty = np.repeat([0.3, 0.05, 0.9, 0.0, 0.5], n // 5)
    found = simulate(load("bench"), duty)
    s = np.array(found)
    angle_at = CubicHermiteSpline(np.arange(n) * H, found.rotor_angle, found.omega)
    expected = measured_speed(angle_at, n, H, 1, 0.0)
    reading = read(s, chain(speed_pulses_per_rev=1.0))[OMEGA]
    differs = np.abs(reading - expected) > 1e-4 * np.abs(expected) + 1e-9
    assert differs.sum() <= 2  # a pulse at the very instant of a sample may fall to either side
    assert np.count_nonzero(expected) > 0.8 * n
    assert reading[-1] == pytest.approx(found.omega[-1], rel=0.01)


def test_pulse_times_are_in_whole_ticks():
    tick = 4e-6
    reading = read(turning(171.0, 3000), chain(speed_pulses_per_rev=1.0, speed_tick=tick))[OMEGA]
    periods = STEP / reading[reading > 0.0]
    ticks = periods / tick
    assert np.abs(ticks - np.round(ticks)).max() < 1e-6
    assert set(np.round(ticks)) == {math.floor(STEP / 171.0 / tick), math.ceil(STEP / 171.0 / tick)}


def test_speed_is_0_before_two_pulses_and_held_between():
    period_of_turn = 0.1
    reading = read(turning(STEP / period_of_turn, 400, begin=STEP * 0.5), chain(speed_pulses_per_rev=1.0))[OMEGA]
    time = np.arange(400) * H
    second_pulse = 1.5 * period_of_turn
    assert not reading[time < second_pulse].any()
    assert reading[time >= second_pulse] == pytest.approx(np.full((time >= second_pulse).sum(), STEP / period_of_turn))


def test_speed_is_0_after_half_a_second_without_a_pulse():
    turn = 0.6
    n = 1500
    reading = read(turning(STEP / turn, n, begin=0.5 * STEP), chain(speed_pulses_per_rev=1.0))[OMEGA]
    time = np.arange(n) * H
    since = (time - 0.5 * turn) % turn
    held = (time >= 1.5 * turn) & (since <= 0.5)
    assert reading[held] == pytest.approx(np.full(held.sum(), STEP / turn))
    assert not reading[~held].any()
    assert (~held[time > 1.5 * turn]).any()


def test_speed_of_a_rotor_that_stands_is_0():
    assert not read(states(1000, rotor_angle=3.0), chain(speed_pulses_per_rev=1.0))[OMEGA].any()


def test_speed_noise_is_one_number_a_pulse():
    reading = read(turning(100.0, 20_000), chain(speed_pulses_per_rev=1.0, speed_noise=2.0))[OMEGA]
    held = reading[reading > 0.0]
    changes = np.flatnonzero(np.diff(held))
    assert len(changes) == pytest.approx(20_000 * H * 100.0 / STEP, rel=0.01)
    each = held[changes]
    assert each.std() == pytest.approx(2.0, rel=0.1)
    assert each.mean() == pytest.approx(100.0, abs=0.3)


@pytest.mark.parametrize("pulses", [0.0, 1.0])
def test_spikes_are_outliers_and_nothing_else(pulses):
    n, rate = 100_000, 3.0
    s = turning(150.0, n)
    clean = read(s, chain(speed_pulses_per_rev=pulses))
    spiky = read(s, chain({"speed_spikes": {"rate": rate}}, speed_pulses_per_rev=pulses))
    assert np.array_equal(spiky[[THETA, I_A, V_A]], clean[[THETA, I_A, V_A]])
    hit = spiky[OMEGA] != clean[OMEGA]
    factor = spiky[OMEGA][hit] / clean[OMEGA][hit]
    assert factor.min() >= SPIKE_FACTOR[0] - 1e-9
    assert factor.max() <= SPIKE_FACTOR[1] + 1e-9
    assert factor.mean() == pytest.approx(0.5 * sum(SPIKE_FACTOR), rel=0.05)
    spikes = len(np.unique(factor))
    assert spikes == pytest.approx(rate * n * H, rel=0.12)
    if pulses:  # held until the next pulse
        assert hit.sum() == pytest.approx(spikes * STEP / 150.0 / H, rel=0.03)


def test_bench_chain_as_stated():
    """The noise-free chain of the preset: resolution, filter and ticks alone."""
    base = load("bench")
    quiet = Model("quiet", base.model, {**base.sensing, "angle_noise": 0.0, "current_noise": 0.0, "voltage_noise": 0.0})
    found, truth = record(quiet, np.repeat([0.2, 0.4], 1500))
    assert np.abs(found["i_a"] - truth["i_a"]).max() <= 0.5 * base.sensing["current_lsb"] + 1e-12
    assert np.abs(found["v_a"] - truth["v_a"]).max() <= 0.5 * base.sensing["voltage_lsb"] + 1e-12
    lag = truth["theta"] - 2.0 * base.sensing["angle_filter_tau"] * truth["theta_dot"]
    assert np.abs(found["theta"] - lag).max() <= 0.5 * base.sensing["angle_lsb"] + 1e-3


def test_the_reading_of_a_current_and_a_voltage_is_that_of_the_whole_chain():
    effects = {"current_gain": {"gain": 0.3}, "current_offset": {"bias": 0.06}, "voltage_offset": {"bias": -0.1}}
    base = load("thesis")
    model = Model("read", base.model, dict.fromkeys(base.sensing, 0.0), effects)
    i_a, v_a = np.linspace(-1.0, 2.0, 7), np.linspace(0.0, 9.0, 7)
    out = read(states(7, i_a=i_a, v_a=v_a), sensing.prepare(model))
    assert np.array_equal(sensing.read_current(model, i_a), out[I_A])
    assert np.array_equal(sensing.read_voltage(model, v_a), out[V_A])
    assert sensing.true_voltage(model, sensing.read_voltage(model, v_a)) == pytest.approx(v_a)
    assert sensing.read_current(base, 1.5) == 1.5


def test_rows_of_readings_and_states_are_named_in_the_order_of_their_tuples():
    assert sensing.READING._fields == Sample._fields
    assert dynamics.ROW._fields == dynamics.Trajectory._fields
    assert [*sensing.READING] == [*range(4)]
    assert [*dynamics.ROW] == [*range(7)]


def test_pulses_do_not_tell_the_direction():
    n = 400
    angle = np.cumsum(np.full(n, 100.0 * H))
    forward = read(states(n, omega=np.full(n, 100.0), rotor_angle=angle), chain(speed_pulses_per_rev=1.0))
    backward = read(states(n, omega=np.full(n, -100.0), rotor_angle=-angle), chain(speed_pulses_per_rev=1.0))
    assert backward[OMEGA, -1] == pytest.approx(100.0, rel=1e-3)
    assert np.array_equal(forward, backward)
