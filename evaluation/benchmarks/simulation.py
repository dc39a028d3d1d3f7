# SPDX-License-Identifier: Apache-2.0
"""Speed and accuracy of the simulation, beside C and scipy."""

import ctypes
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from pathlib import Path
from shutil import which

import numpy as np
from numba import config, set_num_threads
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

from aeropend_sim.model import actuator, dynamics, ensemble
from aeropend_sim.model.effects import CATALOGUE
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model, load
from evaluation.benchmarks import measure
from evaluation.benchmarks.measure import Figure, NotMeasuredError, Spread, Target, interleaved

Array = NDArray[np.float64]

SECONDS = 70.0
MODELS = 256
THREADS = 2
NAMES = ("k0", "k1", "k2", "k3", "R_a", "L_a", "K_e", "K_t", "J_m", "B_m", "k_load", "k_thrust", "mgd_over_J",
         "c_over_J", "L_over_J")
"""Order of `struct plant` in peers/plant.h."""
STATES = ("theta", "theta_dot", "i_a", "omega")
PEERS = Path(__file__).parent / "peers"


@cache
def duty() -> Array:
    """The excitation of a recording, (N,)."""
    return Excitation(duration=SECONDS).series()


@cache
def library(source: str, *flags: str) -> ctypes.CDLL:
    """Compile a C peer with the system's gcc.

    Raises:
        NotMeasuredError: there is no gcc, or it fails.
    """
    if which("gcc") is None:
        raise NotMeasuredError("there is no gcc, so there is no C to compare with: install gcc (make bench does)")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "peer.so"
        command = ["gcc", "-O3", *flags, "-shared", "-fPIC", str(PEERS / source), "-o", str(out), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise NotMeasuredError(f"gcc cannot compile {source}: {' '.join(done.stderr.split())[:200]}")
        return ctypes.CDLL(str(out))


def pointer(array: Array) -> ctypes.c_void_p:
    """An array as C sees it."""
    return ctypes.c_void_p(array.ctypes.data)


def numbers(models: list[Model]) -> Array:
    """Models as an array of `struct plant`."""
    return np.array([[model.numbers()[name] for name in NAMES] for model in models])


def c_series(model: Model, *flags: str, inner: int = 1) -> Callable[[], Array]:
    """`dynamics.simulate` by C: Runge-Kutta of fourth order, `inner` steps a sample."""
    function = library("series.c", *flags).series
    plant, series = numbers([model]), duty()

    def run() -> Array:
        out = np.empty((7, len(series)))
        function(pointer(plant), pointer(series), ctypes.c_long(len(series)), ctypes.c_double(SAMPLE_PERIOD),
                 ctypes.c_long(inner), pointer(out))
        return out

    return run


def reference(model: Model) -> dict[str, Array]:
    """The states at the samples by scipy's DOP853 at 1e-10, restarted wherever the duty changes."""
    n, series = model.numbers(), duty()
    v = actuator.voltage(n, series)
    edges = [0, *np.flatnonzero(np.diff(series)) + 1, len(series)]
    out = np.empty((4, len(series)))
    x = np.zeros(4)
    sine = np.sin

    def rates(_: float, x: Array, v: float) -> list[float]:
        theta, theta_dot, i_a, omega = x
        f = n["k_thrust"] * omega * abs(omega)
        return [theta_dot,
                n["L_over_J"] * f - n["c_over_J"] * theta_dot - n["mgd_over_J"] * sine(theta),
                (v - n["R_a"] * i_a - n["K_e"] * omega) / n["L_a"],
                (n["K_t"] * i_a - n["B_m"] * omega - n["k_load"] * omega * abs(omega)) / n["J_m"]]

    for first, last in pairwise(edges):
        t = np.arange(last - first + 1) * SAMPLE_PERIOD
        solved = solve_ivp(rates, (0.0, t[-1]), x, "DOP853", t, args=(v[first],), rtol=1e-10, atol=1e-12,
                           max_step=SAMPLE_PERIOD)  # longer steps would be read off its interpolant, to 6e-6 only
        out[:, first:last] = solved.y[:, :-1]
        x = solved.y[:, -1]
    return dict(zip(STATES, out, strict=True))


def worst(found: dict[str, Array], true: dict[str, Array]) -> dict[str, float]:
    """The largest error of each state over its range."""
    return {name: float(np.abs(found[name] - x).max() / np.ptp(x)) for name, x in true.items()}


def nominal(quick: bool) -> list[Figure]:
    """70 s of the nominal model: time beside C, and error against scipy."""
    model, series = load("bench"), duty()
    about = measure.load()
    c = c_series(model, "-march=native")
    plain = c_series(model)
    ours_s, c_s, plain_s = interleaved(40 if quick else 300, lambda: dynamics.simulate(model, series), c, plain)

    true = reference(model)
    ours_error = worst(dynamics.simulate(model, series)._asdict(), true)

    def c_error(inner: int) -> dict[str, float]:
        out = c_series(model, "-march=native", inner=inner)()
        return worst(dict(zip(STATES, out, strict=False)), true)

    errors = {inner: max(c_error(inner).values()) for inner in (1, 2, 3, 4, 6, 8, 12, 16)}
    if not errors[16] < 1e-6:
        raise AssertionError(f"C and scipy disagree by {errors[16]:.1e}: one of the peers is wrong")
    inner = next(inner for inner, error in errors.items() if error <= max(*ours_error.values(), errors[16]))
    (as_good_s,) = interleaved(10 if quick else 50, c_series(model, "-march=native", inner=inner))
    as_good_ms = 1e3 * Spread.of(as_good_s).median
    return [
        Figure("nominal model, 70 s", "ms CPU", Spread.of(1e3 * ours_s), Target(1.3, "ratio"), "C RK4, 1 step a sample",
               Spread.of(1e3 * c_s), Spread.of(ours_s / c_s),
               {"samples": len(series), "c_o3_without_native_ms": 1e3 * Spread.of(plain_s).median,
                "c_as_accurate": {"steps_a_sample": inner, "ms": as_good_ms}},
               f"C needs {inner} steps a sample and {as_good_ms:.2f} ms to be as accurate", about, main=True),
        Figure("nominal model, worst error of any state over its range", "-", Spread.of(max(ours_error.values())),
               Target(2e-5), "C RK4, 1 step a sample", Spread.of(errors[1]),
               Spread.of(max(ours_error.values()) / errors[1]),
               {"against": "scipy DOP853 at 1e-10", "ours": ours_error, "c": c_error(1), "c_by_steps": errors},
               load=about),
    ]


def all_effects(quick: bool) -> list[Figure]:
    """70 s with every effect of the catalogue at its default size, beside C without any."""
    model, series = load("bench"), duty()
    about = measure.load()
    full = model.with_effects({id_: {name: p.default for name, p in effect.parameters.items()}
                               for id_, effect in CATALOGUE.items()})
    noise = np.random.default_rng(0).standard_normal(len(series))
    c = c_series(model, "-march=native")
    ours_s, c_s = interleaved(20 if quick else 150, lambda: dynamics.simulate(full, series, noise=noise), c)
    return [Figure(f"all {len(CATALOGUE)} effects on, 70 s", "ms CPU", Spread.of(1e3 * ours_s), Target(3.9, "ratio"),
                   "C RK4 without effects", Spread.of(1e3 * c_s), Spread.of(ours_s / c_s), load=about, main=True)]


def batch(quick: bool) -> list[Figure]:
    """256 parameter sets against one recording, error sums only, beside C with 16 SIMD lanes."""
    base, series = load("bench"), duty()
    about = measure.load()
    rng = np.random.default_rng(0)
    models = [Model(base.name, {name: value * (1.0 + 0.02 * rng.standard_normal())
                                for name, value in base.model.items()}, base.sensing) for _ in range(MODELS)]
    x = dynamics.simulate(base, series)
    measured = np.array([x.theta, x.omega, x.i_a, x.v_a])
    flags = ("-march=native", "-ffast-math", "-fopenmp")
    function, plants, errors = library("batch.c", *flags).batch, numbers(models), np.empty((MODELS, 4))

    def c() -> Array:
        function(pointer(plants), ctypes.c_long(MODELS), pointer(series), pointer(measured), ctypes.c_long(len(series)),
                 ctypes.c_double(SAMPLE_PERIOD), pointer(errors))
        return errors

    def ours() -> Array:
        return ensemble.squared_errors(models, series, measured)

    set_num_threads(min(THREADS, config.NUMBA_NUM_THREADS))
    if not np.allclose(ours()[:, (0, 1, 3)], c()[:, (0, 1, 3)], rtol=1e-2):
        raise AssertionError("C and aeropend_sim disagree: one of them is wrong")
    ours_s, c_s = interleaved(5 if quick else 25, ours, c, clock=time.perf_counter)
    return [Figure(f"{MODELS} parameter sets, error sums, {THREADS} threads", "runs/s", Spread.of(MODELS / ours_s),
                   Target(4000.0, at_least=True), "C RK4, 16 SIMD lanes, OpenMP", Spread.of(MODELS / c_s),
                   Spread.of(c_s / ours_s), {"gcc_flags": ["-O3", *flags]}, load=about, main=True)]


def compiling(quick: bool) -> list[Figure]:
    """CPU time that numba takes to compile every kernel of the simulation, once, and to load them later."""
    about = measure.load()
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}

        def seconds() -> float:
            program = [sys.executable, "-m", "evaluation.benchmarks.first_use"]
            return float(subprocess.run(program, env=environment, capture_output=True, text=True, check=True).stdout)

        first, again = seconds(), seconds()
    del quick
    return [Figure("first use: import and compile every kernel", "s CPU", Spread.of(first), Target(30.0),
                   "from numba's cache, every later use", Spread.of(again), Spread.of(first / again), load=about)]
