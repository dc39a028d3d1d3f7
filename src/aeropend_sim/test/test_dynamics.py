# SPDX-License-Identifier: Apache-2.0
"""The compiled equations against scipy's integrators and a right-hand side written here from the table of effects."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from aeropend_sim.model import actuator, dynamics
from aeropend_sim.model.arm import linear_arm
from aeropend_sim.model.coefficients import MOST_STEPS, prepare, steps_in
from aeropend_sim.model.dynamics import simulate, steady
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model, load
from aeropend_sim.model.state import State

PERIODS = [5e-4, SAMPLE_PERIOD, 5e-3, 20e-3, 50e-3]
EQUATIONS = [id_ for id_, effect in CATALOGUE.items() if effect.place != "sensing"]

LARGE = {
    "bridge_drop": {"v_drop": 0.8}, "supply_sag": {"r_supply": 1.0}, "supply_drift": {"rate": 0.02},
    "command_delay": {"delay": 40 * SAMPLE_PERIOD}, "brush_drop": {"v_brush": 0.5},
    "winding_heating": {"gain": 0.2, "tau": 5.0}, "rotor_friction": {"torque": 3e-3}, "thrust_lag": {"tau": 0.4},
    "thrust_exponent": {"n": 1.2}, "axial_inflow": {"k": 1e-3}, "ground_effect": {"gain": 2.0, "width": 0.1},
    "coulomb_friction": {"accel": 8.0}, "quadratic_drag": {"k": 8.0}, "cable_torque": {"k": 30.0, "theta0": -0.3},
    "mast_flex": {"coupling": 0.6, "omega": 80.0, "zeta": 0.1}, "gust": {"sigma": 10.0, "tau": 0.05},
}


def defaults(*ids):
    return {id_: {name: p.default for name, p in CATALOGUE[id_].parameters.items()} for id_ in ids}


class Reference:
    """The plant by the equations of docs/effects.md, integrated between changes of the input or of dry friction."""

    def __init__(self, model: Model, method: str = "DOP853", rtol: float = 1e-10) -> None:
        self.n, self.e, self.method, self.rtol = model.numbers(), model.effects, method, rtol
        self.accel = self.get("coulomb_friction", "accel")
        self.torque = self.get("rotor_friction", "torque")
        self.lag = self.get("thrust_lag", "tau")
        self.coupling = self.get("mast_flex", "coupling")

    def get(self, id_, name, absent=0.0):
        return self.e.get(id_, {}).get(name, absent)

    def torques(self, t, y, duty, gust):
        """On the arm (over J), without friction; on the rotor, without friction; and the mast's restoring force."""
        theta, theta_dot, i, omega, f, _, q, q_dot = y
        n, get = self.n, self.get
        f = f if self.lag else self.static(omega)
        f *= 1.0 + get("ground_effect", "gain") * np.exp(-abs(theta) / get("ground_effect", "width", 1.0))
        f -= get("axial_inflow", "k") * omega * theta_dot
        arm = (-n["mgd_over_J"] * np.sin(theta) - n["c_over_J"] * theta_dot + n["L_over_J"] * f
               - get("quadratic_drag", "k") * theta_dot * abs(theta_dot)
               - get("cable_torque", "k") * (theta - get("cable_torque", "theta0")) + gust)
        rotor = n["K_t"] * i - n["B_m"] * omega - n["k_load"] * omega * abs(omega)
        omega_q = get("mast_flex", "omega")
        return arm, rotor, 2.0 * get("mast_flex", "zeta") * omega_q * q_dot + omega_q**2 * q

    def static(self, omega):
        power = self.get("thrust_exponent", "n", 2.0)
        return np.sign(omega) * self.n["k_thrust"] * 150.0**2 * (abs(omega) / 150.0)**power

    def derivative(self, t, y, duty, gust, arm_way, rotor_way):
        """Of θ, θ̇, i, ω, f, T, q, q̇; a way is the sign of motion, 0 where friction holds, None without friction."""
        n, get = self.n, self.get
        theta_dot, i, omega, f, heat, q_dot = y[1], y[2], y[3], y[4], y[5], y[7]
        arm, rotor, restoring = self.torques(t, y, duty, gust)
        v = max(0.0, n["k0"] + n["k1"] * np.sqrt(n["k2"] * duty + n["k3"]))
        v = max(0.0, v * (1.0 - get("supply_drift", "rate") * t) - get("bridge_drop", "v_drop"))
        v -= get("supply_sag", "r_supply") * i + get("brush_drop", "v_brush") * np.tanh(i / 0.02)
        resistance = n["R_a"] * (1.0 + get("winding_heating", "gain") * heat)
        acceleration = 0.0
        if arm_way != 0:  # θ̈ = arm - friction - q̈ and q̈ = -restoring - coupling θ̈
            acceleration = (arm - (arm_way or 0.0) * self.accel + restoring) / (1.0 - self.coupling)
        spin = 0.0 if rotor_way == 0 else (rotor - (rotor_way or 0.0) * self.torque) / n["J_m"]
        return [theta_dot, acceleration, (v - resistance * i - n["K_e"] * omega) / n["L_a"], spin,
                (self.static(omega) - f) / self.lag if self.lag else 0.0,
                i * i - heat / get("winding_heating", "tau", 1.0), q_dot,
                -restoring - self.coupling * acceleration if self.coupling else 0.0]

    def ways(self, t, y, duty, gust):
        arm, rotor, restoring = self.torques(t, y, duty, gust)

        def way(speed, drive, limit):
            if not limit:
                return None
            return np.sign(speed) if speed else float(np.sign(drive)) * (abs(drive) > limit)
        return way(y[1], arm + restoring, self.accel), way(y[3], rotor, self.torque)

    def run(self, duty, period, gust=None):
        """θ, θ̇, i, ω, f, T, q, q̇ at the N sample instants, (8, N)."""
        n, delay = len(duty), self.get("command_delay", "delay")
        late = round(delay / period)
        assert late * period == pytest.approx(delay, abs=1e-12)
        acting = np.concatenate([np.zeros(late), duty])[:n]
        gust = np.zeros(n) if gust is None else gust
        starts = [0, *(np.flatnonzero((np.diff(acting) != 0.0) | (np.diff(gust) != 0.0)) + 1), n]
        y, out = np.zeros(8), np.empty((8, n))
        for first, last in pairwise(starts):
            pieces = [np.empty((8, 0))]
            t, end = first * period, last * period
            samples = period * np.arange(first, last)
            while t < end:
                begin = t
                y, t, dense = self.piece(y, t, end, acting[first], gust[first])
                now = samples[(samples > begin - 1e-12) & (samples < t - 1e-12)]
                if now.size:
                    pieces.append(dense(now))
            out[:, first:last] = np.hstack(pieces)
        return out

    def piece(self, y, t, end, duty, gust):
        """Until `end` or until friction changes its mind: the state and time there, and what interpolates between."""
        arm_way, rotor_way = self.ways(t, y, duty, gust)
        extra = (duty, gust, arm_way, rotor_way)
        events, after = [], []

        def add(margin, index, moving):
            margin.terminal, margin.direction = True, -1.0
            events.append(margin)
            after.append((index, moving))

        def arm_margin(t, y, *_):
            arm, _, restoring = self.torques(t, y, duty, gust)
            return self.accel - abs(arm + restoring)

        if arm_way is not None:
            add((lambda t, y, *_: arm_way * y[1]) if arm_way else arm_margin, 1, bool(arm_way))
        if rotor_way is not None:
            add((lambda t, y, *_: rotor_way * y[3]) if rotor_way else
                (lambda t, y, *_: self.torque - abs(self.torques(t, y, duty, gust)[1])), 3, bool(rotor_way))
        found = solve_ivp(self.derivative, (t, end), y, self.method, rtol=self.rtol, atol=1e-12, dense_output=True,
                          events=events or None, args=extra)
        assert found.success
        y, t = found.y[:, -1].copy(), float(found.t[-1])
        if found.status == 1:
            for (index, moving), times in zip(after, found.t_events, strict=True):
                if times.size:
                    arm, rotor, restoring = self.torques(t, y, duty, gust)
                    drive = arm + restoring if index == 1 else rotor
                    y[index] = 0.0 if moving else 1e-12 * np.sign(drive)  # it stops, or it breaks away
        return y, t, found.sol


def steps_of(rng, n, length, low=0.0, high=1.0):
    return np.repeat(rng.uniform(low, high, n // length + 1), length)[:n]


def duty_for(period, duration=None):
    """Steps, a rest, steps again, and a new value each sample; (N,) of some seconds, fewer where samples are many."""
    duration = duration or min(4.0, 1.0 + 500.0 * period)
    rng, n = np.random.default_rng(5), round(duration / period)
    duty = steps_of(rng, n, max(1, round(0.08 * duration / period)))
    duty[n // 3:n // 2] = 0.0
    last = n // 8
    duty[n - last:] = rng.uniform(0.0, 1.0, last)
    return duty


def errors(model, duty, period, gust_noise=None, **options):
    """Largest difference to the reference in θ, θ̇, i, ω, over each one's range."""
    gust = None
    if "gust" in model.effects:
        sigma, tau = model.effects["gust"]["sigma"], model.effects["gust"]["tau"]
        keep, gust = np.exp(-period / tau), np.zeros(len(duty))
        for k in range(1, len(duty)):
            gust[k] = keep * gust[k - 1] + sigma * np.sqrt(1.0 - keep**2) * gust_noise[k - 1]
    expected = Reference(model, **options).run(duty, period, gust)[:4]
    found = np.array(simulate(model, duty, period, noise=gust_noise)[:4])
    return np.abs(found - expected).max(axis=1) / np.ptp(expected, axis=1)


@pytest.mark.parametrize("period", PERIODS)
@pytest.mark.parametrize("preset", ["bench", "thesis"])
def test_nominal_model_meets_scipy(preset, period):
    assert errors(load(preset), duty_for(period), period).max() < 2e-5


def test_nominal_model_meets_scipy_with_an_arm_that_turns_over():
    model, duty = load("bench"), np.ones(2000)
    assert simulate(model, duty).theta.max() > 10.0
    assert errors(model, duty, SAMPLE_PERIOD).max() < 2e-5


@pytest.mark.parametrize("size", ["default", "large"])
@pytest.mark.parametrize("id_", EQUATIONS)
def test_effect_meets_scipy(id_, size):
    effect = defaults(id_)[id_] if size == "default" else LARGE[id_]
    if id_ == "command_delay":
        effect = {"delay": SAMPLE_PERIOD * round(effect["delay"] / SAMPLE_PERIOD)}
    limit = {"rotor_friction": 5e-4, "brush_drop": 1e-2}.get(id_, 1e-4)
    options = {"method": "LSODA"} if id_ == "brush_drop" else {}
    duty = duty_for(SAMPLE_PERIOD)
    noise = np.random.default_rng(6).standard_normal(len(duty))
    found = errors(load("bench").with_effects({id_: effect}), duty, SAMPLE_PERIOD, noise, **options)
    assert found.max() < limit
    if id_ == "brush_drop":  # only the current, where it crosses the bend of the tanh, is that coarse
        assert found[[0, 1, 3]].max() < (2e-4 if size == "default" else 2e-3)


def test_voltage_is_that_at_the_terminals():
    sag = {"supply_sag": {"r_supply": 0.5}}
    duty = duty_for(SAMPLE_PERIOD)
    found = simulate(load("bench").with_effects(sag), duty)
    assert found.v_a == pytest.approx(actuator.voltage(load("bench").model, duty) - 0.5 * found.i_a, abs=1e-12)


@pytest.mark.parametrize("id_", ["thrust_lag", "thrust_exponent"])
def test_thrust_meets_scipy(id_):
    model, duty = load("bench").with_effects(defaults(id_)), duty_for(SAMPLE_PERIOD)
    reference = Reference(model)
    expected = reference.run(duty, SAMPLE_PERIOD)
    thrust = expected[4] if id_ == "thrust_lag" else [reference.static(omega) for omega in expected[3]]
    assert np.abs(simulate(model, duty).thrust - thrust).max() < 2e-5 * np.ptp(thrust)


@pytest.mark.parametrize("period", [SAMPLE_PERIOD, 20e-3])
def test_rotor_angle_is_the_integral_of_the_speed(period):
    duty, fine = duty_for(period), 32
    found = simulate(load("bench"), duty, period)
    omega = simulate(load("bench"), np.repeat(duty, fine), period / fine).omega
    turned = np.concatenate([[0.0], np.cumsum(0.5 * (omega[1:] + omega[:-1])) * period / fine])[::fine]
    assert found.rotor_angle == pytest.approx(turned, abs=2e-5 * turned[-1])


SMOOTH = [id_ for id_ in EQUATIONS
          if id_ not in ("command_delay", "brush_drop", "rotor_friction", "coulomb_friction", "gust")]


@pytest.mark.parametrize("period", PERIODS)
def test_smooth_effects_together_meet_scipy(period):
    model = load("bench").with_effects(defaults(*SMOOTH))
    assert errors(model, duty_for(period), period).max() < 2e-4


@pytest.mark.parametrize("period", PERIODS)
def test_all_effects_together_meet_scipy(period):
    model = load("bench").with_effects({**defaults(*EQUATIONS), "command_delay": {"delay": 3.0 * period}})
    duty = duty_for(period)
    noise = np.random.default_rng(7).standard_normal(len(duty))
    found = errors(model, duty, period, noise, method="LSODA", rtol=1e-9)
    assert found[[0, 1, 3]].max() < 5e-3
    assert found[2] < 1e-2


@pytest.mark.parametrize("mast", [{"coupling": 0.9, "omega": 300.0, "zeta": 1.0},
                                  {"coupling": 0.9, "omega": 300.0, "zeta": 0.001},
                                  {"coupling": 0.0005, "omega": 300.0, "zeta": 0.01}])
def test_stiff_mast_meets_scipy(mast):
    model = load("bench").with_effects({"mast_flex": mast})
    assert errors(model, duty_for(SAMPLE_PERIOD, 1.0), SAMPLE_PERIOD).max() < 2e-3


def test_mast_swings_on_while_the_arm_sticks():
    model = load("bench").with_effects({"coulomb_friction": {"accel": 12.0},
                                        "mast_flex": {"coupling": 0.3, "omega": 40.0, "zeta": 0.02}})
    duty = np.repeat([0.35, 0.0, 0.3, 0.32], 500)
    found = simulate(model, duty)
    assert (found.theta_dot == 0.0).mean() > 0.2
    found = errors(model, duty, SAMPLE_PERIOD)
    assert found[0] < 4e-4
    assert found[1] < 4e-3  # it breaks away up to a sample late, some dozen times


@pytest.mark.parametrize("part", [0.1, 0.5, 0.7])
def test_delay_by_a_part_of_a_period_meets_scipy(part):
    """Every current too, the first after the switch within a hold; and the voltage read is that before the switch."""
    fine, n = 10, 1200
    model = load("bench").with_effects({"command_delay": {"delay": (14.0 + part) * SAMPLE_PERIOD}})
    duty = steps_of(np.random.default_rng(8), n, 120)
    expected = Reference(model).run(np.repeat(duty, fine), SAMPLE_PERIOD / fine)[:4, ::fine]
    found = simulate(model, duty)
    assert (np.abs(np.array(found[:4]) - expected).max(axis=1) / np.ptp(expected, axis=1)).max() < 1e-3
    assert found.v_a[15:] == pytest.approx(actuator.voltage(model.numbers(), duty[:-15]), abs=1e-12)
    assert found.v_a[:15] == pytest.approx(np.full(15, float(actuator.voltage(model.numbers(), 0.0))), abs=1e-12)


def test_small_torque_never_moves_an_arm_that_sticks():
    duty = np.full(2000, 0.08)
    model = load("bench")
    torque = simulate(model, duty).theta.max()
    assert torque > 0.0
    held = simulate(model.with_effects({"coulomb_friction": {"accel": 3.0}}), duty)
    assert not held.theta.any()
    assert not held.theta_dot.any()


def test_free_swing_ends_stuck_within_the_band_of_friction():
    accel = 2.0
    model = load("bench").with_effects({"coulomb_friction": {"accel": accel}})
    found = simulate(model, np.zeros(5000), state=State(theta=1.0))
    end = found.theta[-1]
    assert 0.0 < abs(end) <= np.arcsin(accel / model.model["mgd_over_J"])
    still = found.theta == end
    assert still[-2500:].all()
    assert not found.theta_dot[-2500:].any()


def test_rotor_breaks_away_only_above_its_friction():
    numbers = load("bench").model
    model = load("bench").with_effects({"rotor_friction": {"torque": 4e-3}})
    holding = 4e-3 / numbers["K_t"] * numbers["R_a"]  # V
    below, above = (np.full(1500, float(actuator.duty(numbers, factor * holding))) for factor in (0.98, 1.02))
    assert not simulate(model, below).omega.any()
    assert simulate(model, above).omega[-1] > 1.0


def test_rotor_stops_and_stays():
    model = load("bench").with_effects({"rotor_friction": {"torque": 1e-3}})
    omega = simulate(model, np.concatenate([np.full(500, 0.5), np.zeros(2500)])).omega
    assert omega.min() == 0.0
    stop = int(np.flatnonzero(omega)[-1])
    assert 500 < stop < 2000


@pytest.mark.parametrize("preset", ["bench", "thesis"])
@pytest.mark.parametrize("duty", [0.0, 0.1, 0.4314])
def test_steady_state_stays(preset, duty):
    model = load(preset)
    state = steady(model, duty)
    found = simulate(model, np.full(2000, duty), state=state)
    for name in ("theta", "i_a", "omega", "thrust"):
        assert getattr(found, name) == pytest.approx(getattr(state, name), abs=1e-9)


def test_nominal_model_starts_at_rest_and_without_noise_stays_there():
    found = simulate(load("bench"), np.zeros(100))
    assert not np.array(found).any()


def test_gust_has_its_standard_deviation_and_correlation():
    """Seen through an arm that is nothing but inertia."""
    base = load("bench")
    free = Model("free", {**base.model, "mgd_over_J": 0.0, "c_over_J": 0.0, "L_over_J": 0.0}, base.sensing,
                 {"gust": {"sigma": 2.0, "tau": 0.1}})
    n = 400_000
    noise = np.random.default_rng(9).standard_normal(n)
    torque = np.diff(simulate(free, np.zeros(n), noise=noise).theta_dot) / SAMPLE_PERIOD
    assert torque.std() == pytest.approx(2.0, rel=0.03)
    late = round(0.1 / SAMPLE_PERIOD)
    assert np.mean(torque[late:] * torque[:-late]) / 4.0 == pytest.approx(np.exp(-late * SAMPLE_PERIOD / 0.1), abs=0.03)
    assert torque[0] == 0.0


def test_no_gust_without_noise():
    duty = duty_for(SAMPLE_PERIOD, 1.0)
    found = simulate(load("bench").with_effects(defaults("gust", "thrust_lag")), duty)
    alone = simulate(load("bench").with_effects(defaults("thrust_lag")), duty)
    assert np.array_equal(found, alone)


def test_one_step_a_sample_at_the_rigs_period():
    assert steps_in(load("bench"), SAMPLE_PERIOD) == 1
    assert steps_in(load("thesis"), SAMPLE_PERIOD) == 1
    assert steps_in(load("bench").with_effects(defaults(*CATALOGUE)), SAMPLE_PERIOD) == 1


def test_long_holds_and_fast_plants_are_cut():
    base = load("bench")
    assert steps_in(base, 2.5e-3) == 1
    assert steps_in(base, 20e-3) == 8
    fast = base.with_effects({"mast_flex": {"coupling": 0.9, "omega": 300.0, "zeta": 1.0}})
    assert steps_in(fast, SAMPLE_PERIOD) > 10
    absurd = Model("absurd", {**base.model, "J_m": 1e-9, "L_a": 1e-7, "K_t": 10.0, "K_e": 10.0}, base.sensing)
    assert steps_in(absurd, 1.0) == MOST_STEPS


@pytest.mark.parametrize("period", [SAMPLE_PERIOD, 20e-3])
def test_motor_alone_and_arm_alone_are_the_parts_of_the_whole(period):
    model, duty = load("bench").with_effects(defaults("brush_drop", "winding_heating", "thrust_lag")), duty_for(period)
    whole = simulate(model, duty, period)
    prepared = prepare(model, period)
    motor, arm = np.empty((3, len(duty))), np.empty((2, len(duty)))
    dynamics.run_motor(whole.v_a, State(), *prepared, motor)
    assert np.array_equal(motor, [whole.i_a, whole.omega, whole.rotor_angle])
    dynamics.run_arm(whole.omega, State(), 1, *prepared, (prepared[0], prepared[2]), arm)
    coarse = 30.0 * (period / 0.02)**2  # the speed is a straight line between samples
    assert np.abs(arm[0] - whole.theta).max() < 1e-3 * coarse * np.ptp(whole.theta)


@pytest.mark.parametrize("effects", [(), ("thrust_lag", "ground_effect", "cable_torque"), ("mast_flex", "axial_inflow"),
                                     ("coulomb_friction", "quadratic_drag")])
def test_an_arm_that_takes_longer_steps_swings_the_same(effects):
    model, duty = load("bench").with_effects(defaults(*effects)), duty_for(SAMPLE_PERIOD)
    speed, state = simulate(model, duty).omega, State(theta=0.2, theta_dot=-0.5)
    theta, rate, after = dynamics.swing(model, speed, state)
    each, prepared = np.empty((2, len(duty))), prepare(model)
    exact = dynamics.run_arm(speed, state, 1, *prepared, (prepared[0], prepared[2]), each)
    assert np.abs(theta - each[0]).max() < 1e-5 * np.ptp(theta)
    assert np.abs(rate - each[1]).max() < 1e-4 * np.ptp(rate)
    assert after.theta == pytest.approx(exact.theta, abs=1e-5)


@pytest.mark.parametrize("h", [2e-3, 1e-2])
def test_the_transition_of_the_linear_arm_is_exact_to_second_order(h):
    stiffness, damping = 40.0, 2.0
    rates = np.array([[0.0, 1.0, 0.0], [-stiffness, -damping, 1.0], [0.0, 0.0, 0.0]])
    exact = expm(rates * h)[:2]
    missing = (np.linalg.norm(rates, 2) * h)**3 / 6.0
    assert np.reshape(linear_arm(stiffness, damping, h), (2, 3)) == pytest.approx(exact, abs=missing)
