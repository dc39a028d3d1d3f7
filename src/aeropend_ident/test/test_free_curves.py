# SPDX-License-Identifier: Apache-2.0
"""A term that the model lacks is found at the place where it acts, and drawn as what it is."""

from dataclasses import replace

import numpy as np
import pytest

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.priors import nominal_parameters
from aeropend_ident.diagnosis.chain.values import STAGES
from aeropend_ident.diagnosis.search.free_curves import (
    KNOTS,
    arm_response,
    hats,
    knots_of,
    missing_terms,
    motor_response,
)
from aeropend_ident.estimation.map_fit import fit
from aeropend_ident.signals.signals import from_arrays
from aeropend_ident.testing.rigs import BENCH, drawn_rig, steps
from aeropend_sim.model import rig
from aeropend_sim.model.coefficients import prepare
from aeropend_sim.model.dynamics import run_motor, swing
from aeropend_sim.model.parameters import SAMPLE_PERIOD
from aeropend_sim.model.state import State


def bent_current(columns, truth):
    columns["i_a"] = columns["i_a"] + 0.02 * np.sin(6.0 * truth["i_a"])


def recording(effects, read=lambda *_: None, seed=5, duration=20.0):
    """Signals of a rig with effects, its readings changed by `read`."""
    duty = steps(duration, seed)
    columns, truth = rig.record(drawn_rig(seed, effects), duty, seed)
    read(columns, truth)
    return from_arrays({**columns, "duty": duty}, SAMPLE_PERIOD, BENCH.sensing)


def found(stage, *recordings):
    """The missing terms at the places of a stage after the nominal structure was fitted to it and to those before."""
    chains = CutChains(BENCH, recordings)
    for name in STAGES:
        known = nominal_parameters(chains, name)
        base = fit(chains.residuals(name), known)
        if name == stage:
            break
        chains.set_next_input(name, base.values)
    return missing_terms(chains, stage, base, known)


@pytest.mark.parametrize(("place", "stage", "effects", "read"), [
    ("actuator", "actuator", {"bridge_drop": {}}, None),
    ("electrical", "motor", {"brush_drop": {"v_brush": 0.03}}, None),
    ("electrical", "motor", {"winding_heating": {}}, None),
    ("rotor", "motor", {"rotor_friction": {}}, None),
    ("sensing", "motor", {}, bent_current),
    ("thrust", "arm", {"ground_effect": {}}, None),
    ("thrust", "arm", {"thrust_exponent": {}}, None),
    ("thrust", "arm", {"thrust_lag": {}}, None),
    ("arm", "arm", {"quadratic_drag": {}}, None)])
def test_a_term_is_found_where_it_acts(place, stage, effects, read):
    best, *others = found(stage, recording(effects, read or (lambda *_: None)))
    assert best.place == place
    assert best.before > 2.0
    assert best.left < 0.35 * best.before
    assert all(best.left < other.left for other in others)


def test_two_recordings_of_one_rig_agree_on_the_place():
    best = found("motor", recording({}, bent_current), recording({}, bent_current, duration=12.0))[0]
    assert best.place == "sensing"
    assert best.left < 0.4 * best.before


def test_a_recording_in_which_a_channel_hardly_varies_still_counts():
    """Its current takes too few levels for knots of its own."""
    whole = recording({}, bent_current)
    n = len(whole)
    coarse = replace(whole, i_a=np.where(np.arange(n) < n // 2, 0.0, 0.2))
    chains = CutChains(BENCH, [whole, coarse])
    base = fit(chains.residuals("motor"), nominal_parameters(chains, "motor"))
    both = missing_terms(chains, "motor", base, nominal_parameters(chains, "motor"))
    swapped = CutChains(BENCH, [coarse, whole])
    base = fit(swapped.residuals("motor"), nominal_parameters(swapped, "motor"))
    other = missing_terms(swapped, "motor", base, nominal_parameters(swapped, "motor"))
    assert [t.place for t in both] == [t.place for t in other]
    for a, b in zip(both, other, strict=True):
        assert a.left == pytest.approx(b.left, rel=1e-3)


def test_nothing_missing_leaves_nothing_to_explain():
    for stage in STAGES:
        for term in found(stage, recording({})):
            assert 0.9 < term.left <= term.before < 1.5


def along(curve, x):
    """A curve over x, without its mean and slope, which the model's numbers and other curves take."""
    y = np.interp(x, curve.knot, curve.value)
    return y - np.polyval(np.polyfit(x, y, 1), x)


@pytest.mark.parametrize(("stage", "effects", "variable", "range_", "truth"), [
    ("actuator", {"supply_sag": {}}, "i_a", (-0.5, 0.9), None),
    ("arm", {"ground_effect": {}}, "theta (share of the thrust)", (0.03, 0.7), lambda x: 0.25 * np.exp(-x / 0.3)),
    ("motor", {}, "i_a", (-0.4, 0.8), lambda x: 0.02 * np.sin(6.0 * x))])
def test_the_curve_is_the_terms_own(stage, effects, variable, range_, truth):
    best = found(stage, recording(effects, bent_current if stage == "motor" else lambda *_: None))[0]
    curve = next(c for c in best.curves if c.variable == variable)
    x = np.linspace(*range_, 200)
    if truth is None:  # linear: its slope counts
        slope = np.polyfit(x, np.interp(x, curve.knot, curve.value), 1)[0]
        assert slope == pytest.approx(-0.15, rel=0.15)
    else:
        true = truth(x) - np.polyval(np.polyfit(x, truth(x), 1), x)
        assert np.abs(along(curve, x) - true).max() < 0.4 * np.ptp(true)
        assert np.corrcoef(along(curve, x), true)[0, 1] > 0.9


def test_hats_draw_any_line_between_their_knots():
    x = np.random.default_rng(0).standard_normal(2000)
    x[::50] = np.nan
    knots = knots_of(x)
    basis = hats(x, knots)
    assert basis.shape == (KNOTS, 2000)
    np.testing.assert_allclose(basis.sum(axis=0), 1.0)
    inside = (x > knots[0]) & (x < knots[-1])
    assert inside.mean() > 0.9
    np.testing.assert_allclose(((2.0 * knots + 1.0) @ basis)[inside], 2.0 * x[inside] + 1.0)


@pytest.mark.parametrize("x", [np.zeros(50), np.full(50, np.nan)])
def test_what_does_not_vary_carries_no_curve(x):
    knots = knots_of(x)
    basis = hats(x, knots)
    assert basis.shape == (0, 50)
    assert len(knots) == 0


def test_arm_answers_a_small_torque_as_the_simulation_does():
    """The torque is a small change of the gravity term, around a motion of the arm."""
    speed = 150.0 + 30.0 * np.sin(np.arange(2000) * 0.01)
    small = 1e-4
    model = drawn_rig(1, {}, 0.0)
    heavier = model.with_effects({"cable_torque": {"k": small, "theta0": 0.0}})
    begin = State(omega=150.0, thrust=BENCH.model["k_thrust"] * 150.0**2)
    theta, there = (swing(m, speed, begin)[0] for m in (model, heavier))
    n = model.numbers()
    answer = arm_response(-small * theta[None, :], n["mgd_over_J"] * np.cos(theta), n["c_over_J"], 0.0, SAMPLE_PERIOD)
    moved = there - theta
    assert np.abs(answer[0] - moved).max() < 0.006 * np.abs(moved).max()


def test_motor_answers_a_small_voltage_as_the_simulation_does():
    rng = np.random.default_rng(2)
    voltage = np.repeat(rng.uniform(0.5, 2.5, 10), 200)
    more = np.repeat(rng.uniform(-1e-3, 1e-3, 20), 100)
    out = np.empty((2, 3, 2000))
    for k, v in enumerate((voltage, voltage + more)):
        run_motor(v, State(), *prepare(BENCH), out[k])
    n = BENCH.numbers()
    answer = motor_response(more[None, :], np.zeros((1, 2000)), out[0, 1], n["R_a"], n["L_a"], n["K_e"], n["K_t"],
                            n["J_m"], n["B_m"], n["k_load"], SAMPLE_PERIOD)
    for a, moved, limit in zip(answer, out[1] - out[0], (5e-3, 1.5e-3, 1.5e-3), strict=True):
        assert np.abs(a[0] - moved).max() < limit * np.abs(moved).max()


@pytest.mark.filterwarnings("error")
def test_a_response_that_diverges_has_numbers_all_the_same():
    s = replace(recording({}, duration=6.0), period=2.0, pulses=None)
    assert all(np.isfinite(term.left) for term in found("motor", s))
