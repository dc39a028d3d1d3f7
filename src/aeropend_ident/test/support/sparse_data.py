# SPDX-License-Identifier: Apache-2.0
"""Data with known equations: the rig of the thesis, and small systems that are pushed."""

import numpy as np
from scipy.signal import lfilter

from aeropend_ident.identification.dataset import from_arrays
from aeropend_ident.identification.discrepancy import in_library
from aeropend_sim.model import actuator, dynamics
from aeropend_sim.model.coefficients import prepare
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD, load
from aeropend_sim.model.state import State

STATES = ("theta", "theta_dot", "i_a", "omega")
THESIS = load("thesis")
TRUE = in_library(THESIS)
TERMS = ["x", "u", "w", "x*u", "x*x"]
"""Candidate terms for `pushed_once`."""


def simulated(seconds, seed=0):
    """States by name, each (N,), and the voltage (N,) of the rig of the thesis."""
    v = actuator.voltage(THESIS.numbers(), Excitation(duration=seconds, seed=seed).series())
    out = np.empty((7, len(v)))
    dynamics.run(v, np.zeros(len(v)), State(), *prepare(THESIS, SAMPLE_PERIOD, 32), out)
    return dict(zip(STATES, out[:4])), v


def noisy(x, decibel, seed):
    """States with white noise of so many dB below them."""
    rng = np.random.default_rng(seed)
    return {s: a + np.sqrt(np.mean(a**2)) * 10.0 ** (-decibel / 20.0) * rng.standard_normal(len(a))
            for s, a in x.items()}


def rates(x, v):
    """The exact derivatives of the states."""
    values = {"theta_dot": x["theta_dot"], "sin(theta)": np.sin(x["theta"]), "omega*omega": x["omega"] ** 2,
              "i_a": x["i_a"], "omega": x["omega"], "v_a": v}
    return {s: sum(c * values[t] for t, c in e.items()) for s, e in TRUE.items()}


def pushed_once(push, n=6000, seed=5):
    """x' = -20 x + u + w (N,), where w pushes in one short stretch only; noisy readings, and both inputs."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, n // 100), 100)
    w = np.where(abs(np.arange(n) - 2330) < 70, push, 0.0)
    x = lfilter([0.0, (1.0 - np.exp(-0.1)) / 20.0], [1.0, -np.exp(-0.1)], u + w)
    return from_arrays({"x": x + 1e-3 * rng.standard_normal(n)}, {"u": u, "w": w}, 0.005)


def pushed(slope, n=3000, period=0.005, seed=7):
    """x (N,) of x' = slope(x) + u from rest, with noise, and u (N,), held for half a second each."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-1.0, 1.0, n // 100), 100)
    x = np.zeros(n)
    for k in range(n - 1):
        x[k + 1] = x[k]
        for _ in range(10):
            x[k + 1] += 0.1 * period * (slope(x[k + 1]) + u[k])
    return x + 1e-3 * rng.standard_normal(n), u
