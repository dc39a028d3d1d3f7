# SPDX-License-Identifier: Apache-2.0
"""Sparse identification: terms found, errors over the Cramér-Rao limit, and speed, beside pysindy and scipy."""

import math
import os
import subprocess
import sys
import warnings
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache
from itertools import repeat
from multiprocessing import get_context
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse import block_diag, csr_matrix, hstack

from aeropend_ident.bags.recording import RecordingError
from aeropend_ident.identification import dataset
from aeropend_ident.identification.dataset import STATES
from aeropend_ident.identification.discrepancy import in_library, nominal
from aeropend_ident.identification.free_run import RightHandSide, Wanted, sensitivities
from aeropend_ident.identification.identify import Identified, identify
from aeropend_ident.identification.output_error import Entries, Experiment, Fitter, Output
from aeropend_ident.identification.sindy import regress
from aeropend_ident.identification.weak import Weak
from aeropend_ident.signals.derivatives import tv_derivative
from aeropend_ident.studies import lorenz
from aeropend_ident.studies.thesis import LIBRARY, SECONDS, given, mismatched, missing, noisy, rates, states
from aeropend_sim.model import rig
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD, load
from evaluation.benchmarks import measure
from evaluation.benchmarks.measure import Figure, NotMeasuredError, Spread, Target, interleaved

Array = NDArray[np.float64]

SEEDS, QUICK = 20, 3


def limits(seed: int, sigma: Array) -> dict[tuple[str, str], float]:
    """Cramér-Rao standard deviation of each true coefficient, for all 70 s."""
    x, v = states(seed)
    true = in_library(load("thesis"))
    matrix = np.array([[true[s].get(t, 0.0) for t in LIBRARY.names] for s in STATES])
    outputs = tuple(Output(s, k, x[:, k], float(sigma[k])) for k, s in enumerate(STATES))
    fitter = Fitter(Experiment(LIBRARY, v[:, None].copy(), SAMPLE_PERIOD, x, outputs, free_states=4),
                    Entries.of(matrix))
    run = fitter.run(*fitter.point)
    assert run is not None
    normal, _ = fitter.normal_equations(run, fitter.model, fitter.residuals(run))
    sd = np.sqrt(np.diag(np.linalg.inv(normal.H)))
    return {(STATES[e], LIBRARY.names[t]): float(s)
            for e, t, s in zip(fitter.model.equation, fitter.model.term, sd)}


def errors(found: Identified, true: dict[str, dict[str, float]]) -> float:
    """Largest relative error of a coefficient; inf where terms are wrong."""
    if not lorenz.is_exact(found.equations, true):
        return math.inf
    return max((abs(found.equations[s][t] / c - 1.0) for s, e in true.items() for t, c in e.items()), default=0.0)


@cache
def _pool() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(mp_context=get_context("spawn"))  # a fork of numba's threads would hang


def of_each(quick: bool, function: Callable[..., Any], *same: Any, seeds: int = SEEDS) -> list[Any]:
    """Results of a function for each seed, in a process on each core: run times are not measured here."""
    return list(_pool().map(function, range(QUICK if quick else seeds), *map(repeat, same)))


def _exact(seed: int, method: str) -> float:
    thesis = load("thesis")
    true = missing() if method.startswith("discrepancy") else in_library(thesis)
    derivatives = rates(seed) if method.endswith("sindy") else None
    return errors(identify(given(*states(seed), derivatives), method, known=nominal(mismatched())), true)


def exact(quick: bool) -> list[Figure]:
    """Noise-free data of `thesis`: terms and coefficients by every method (thesis 5.2 and 5.4)."""
    about = measure.load()
    figures = []
    for method, target in (("sindy", 1e-8), ("weak", 1e-4), ("discrepancy-sindy", 1e-3), ("discrepancy-weak", 1e-3)):
        off = of_each(quick, _exact, method)
        figures.append(Figure(f"noise-free thesis, {method}: largest relative error (inf: wrong terms)", "-",
                              Spread.of(max(off)), Target(target), details={"each": off}, load=about))
    return figures


class Noisy(NamedTuple):
    """Result on noisy data: terms right, errors over their limits, error of K_q, wrong terms, [s] run time."""

    right: bool
    ratios: list[float]
    thrust: float
    wrong: list[str]
    seconds: float


def _noisy(seed: int, decibel: float) -> Noisy:
    true = in_library(load("thesis"))
    y, sigma = noisy(seed, decibel)
    found = identify(given(y, states(seed)[1]), "weak")
    ratios = [abs(found.equations[s][t] - true[s][t]) / sd for (s, t), sd in limits(seed, sigma).items()
              if t in found.equations[s]]
    got = found.equations["theta_dot"].get("omega*omega", math.inf)
    wrong = [f"{s}: {t}" for s in STATES for t in set(found.equations[s]) ^ set(true[s])]
    return Noisy(lorenz.is_exact(found.equations, true), ratios,
                 abs(got / true["theta_dot"]["omega*omega"] - 1.0), wrong, found.seconds)


def noise(quick: bool) -> list[Figure]:
    """The thesis' noisy setting: 70 s of `thesis`, 50 dB; then 40 and 30 dB."""
    figures = []
    for decibel in (50.0, 40.0, 30.0):
        about = measure.load()
        aim = decibel == 50.0
        each: list[Noisy] = of_each(quick, _noisy, decibel, seeds=SEEDS if aim else SEEDS // 4)
        lost = Counter(term for one in each for term in one.wrong)
        right, ratios = np.mean([x.right for x in each]), np.concatenate([x.ratios for x in each])
        name = f"{decibel:.0f} dB, weak"
        figures += [
            Figure(f"{name}: seeds with exactly the true terms", "-", Spread.of(float(right)),
                   Target(0.95, at_least=True) if aim else None,
                   details={"wrong": dict(lost), "seconds": [x.seconds for x in each]},
                   note="; ".join(f"{k} {n} times" for k, n in lost.items()), load=about, main=aim),
            Figure(f"{name}: error over the Cramér-Rao 1 sigma, 95 % quantile", "-",
                   Spread.of(float(np.quantile(ratios, 0.95))), Target(3.0) if aim else None, load=about, main=aim),
            Figure(f"{name}: K_q, largest relative error", "-", Spread.of(max(x.thrust for x in each)),
                   Target(0.01) if aim else None, load=about)]
    return figures


def _chain(seed: int) -> tuple[float, float, float, float]:
    model = load("bench")
    true = in_library(model)
    duty = Excitation(duration=SECONDS, seed=seed).series()
    read, _ = rig.record(model, duty, seed)
    try:
        found = identify(dataset.from_readings({**read, "duty": duty}, SAMPLE_PERIOD, model.sensing), "weak")
    except RecordingError:  # refused with a message
        return 0.0, 0.0, math.inf, math.nan
    return (float(set(found.equations["theta_dot"]) == set(true["theta_dot"])),
            float(lorenz.is_exact(found.equations, true)),
            max((r.gap / r.floor for r in found.free_run.values()), default=math.inf), found.seconds)


def chain(quick: bool) -> list[Figure]:
    """Recordings of `bench` through its measurement chain: terms of θ̈, and free runs on held-out data."""
    about = measure.load()
    arm, every, worst, seconds = (list(x) for x in zip(*of_each(quick, _chain), strict=True))
    return [Figure("bench recording, weak: seeds with exactly the terms of θ̈", "-", Spread.of(float(np.mean(arm))),
                   Target(0.95, at_least=True), details={"each": arm, "seconds": seconds}, load=about),
            Figure("bench recording, weak: seeds with exactly the terms of all", "-", Spread.of(float(np.mean(every))),
                   details={"each": every}, load=about),
            Figure("bench recording, weak: free run on held-out data over its floor, worst channel", "-",
                   Spread.of(worst), Target(2.0), details={"each": worst}, load=about)]


def _lorenz(seed: int) -> tuple[bool, bool]:
    true = lorenz.truth("weak")
    return (lorenz.is_exact(lorenz.study("weak", 0.05, seed).equations, true),
            lorenz.is_exact(_pysindy_lorenz(seed), true))


def study(quick: bool) -> list[Figure]:
    """The Lorenz system with 5 % noise, beside pysindy's weak form with a threshold chosen for the true answer."""
    about = measure.load()
    _pysindy()
    ours, peer = np.mean(of_each(quick, _lorenz), axis=0).tolist()
    return [Figure("Lorenz, 5 % noise: runs with exactly the true terms", "-", Spread.of(ours),
                   Target(0.9, at_least=True), "pysindy weak form, STLSQ 0.5", Spread.of(peer), load=about, main=True)]


def _pysindy() -> Any:
    try:
        import pysindy
    except ImportError:
        raise NotMeasuredError("pysindy is not installed: pip install -r requirements-dev.txt") from None
    return pysindy


def _pysindy_lorenz(seed: int) -> dict[str, dict[str, float]]:
    ps = _pysindy()
    x = lorenz.data(0.05, seed).values
    t = np.arange(len(x)) * lorenz.PERIOD
    np.random.seed(seed)  # noqa: NPY002 - pysindy draws its domains from there
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        weak = ps.WeakPDELibrary(ps.PolynomialLibrary(degree=lorenz.DEGREE), spatiotemporal_grid=t, K=200)
        model = ps.SINDy(feature_library=weak, optimizer=ps.STLSQ(threshold=0.5))
        model.fit(x, t=lorenz.PERIOD)
    # its polynomials come in the same order as ours: by degree, then by variable
    names = lorenz.polynomials(lorenz.STATES, lorenz.DEGREE)
    matrix = model.coefficients()
    if matrix.shape[1] != len(names):
        raise NotMeasuredError(f"pysindy's weak library has {matrix.shape[1]} terms, not {len(names)}")
    return {s: {names[j]: float(c) for j, c in enumerate(row) if c != 0.0} for s, row in zip(lorenz.STATES, matrix)}


def speed(quick: bool) -> list[Figure]:
    """Weak form with selection on 34,313 samples x 31 terms, beside pysindy; peak memory of `identify`."""
    about = measure.load()
    y, _ = noisy(0, 50.0)
    v = states(0)[1]
    held = v[:, None].copy()

    def ours() -> None:
        problem = Weak(LIBRARY, y, held, SAMPLE_PERIOD)
        for k in range(len(STATES)):
            regress(problem, k)

    ps = _pysindy()
    t = np.arange(len(y)) * SAMPLE_PERIOD
    inner = ps.ConcatLibrary([ps.PolynomialLibrary(degree=2), ps.FourierLibrary(n_frequencies=1)])

    def peer() -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            weak = ps.WeakPDELibrary(inner, spatiotemporal_grid=t, K=1000)
            ps.SINDy(feature_library=weak, optimizer=ps.STLSQ(threshold=0.9)).fit(y, u=v, t=SAMPLE_PERIOD)

    mine, theirs = interleaved(1 if quick else 5, ours, peer)
    tv, = interleaved(1 if quick else 5, lambda: tv_derivative(y[:, 0], SAMPLE_PERIOD))
    # VmHWM, in kB: ru_maxrss would start from this process's own
    code = ("from evaluation.benchmarks import identification as b; "
            "from aeropend_ident.identification.identify import identify; "
            "y, _ = b.noisy(0, 50.0); identify(b.given(y, b.states(0)[1]), 'weak'); "
            "print(next(int(x.split()[1]) / 1024 for x in open('/proc/self/status') if x.startswith('VmHWM')))")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False,
                          env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)})
    if done.returncode:
        raise NotMeasuredError(f"the memory of identify: {done.stderr.strip().splitlines()[-1]}")
    return [Figure("weak form with selection, 34,313 samples x 31 terms", "s CPU", Spread.of(mine), Target(2.0),
                   "pysindy weak form (K 1000), STLSQ", Spread.of(theirs), Spread.of(mine / theirs), load=about,
                   main=True),
            Figure("TVRegDiff, 34,313 samples, strength chosen", "s CPU", Spread.of(tv), Target(1.0), load=about),
            Figure("identify weak, 34,313 x 31, refinement included: peak memory", "MiB",
                   Spread.of(float(done.stdout)), Target(500.0), load=about)]


def fitting(quick: bool) -> list[Figure]:
    """The fit of the nine coefficients of `thesis` to 70 s at 50 dB, in one shot and in 34, from a start 2 % off."""
    about = measure.load()
    figures = []
    for length in (0, 1000):
        fitter = _two_percent_off(length)
        if not fitter.fit():
            raise NotMeasuredError("the model diverges")
        apart = float(np.max(np.abs(fitter.model.value - _scipy_fit(length)) / np.sqrt(np.diag(fitter.covariance()))))
        if apart > 0.05:
            raise NotMeasuredError(f"scipy stops {apart:.2g} standard deviations away")
        ours, peer = interleaved(1 if quick else 5, lambda n=length: _two_percent_off(n).fit(),
                                 lambda n=length: _scipy_fit(n))
        shots = len(fitter.shots)
        figures.append(Figure(f"fit of 9 coefficients to 34,313 samples of 4 states, shots: {shots}", "s CPU",
                              Spread.of(ours), None, f"scipy least_squares ({'lm' if shots == 1 else 'trf, sparse'})",
                              Spread.of(peer), Spread.of(ours / peer), load=about))
    return figures


def _two_percent_off(length: int) -> Fitter:
    y, sigma = noisy(0, 50.0)
    true = in_library(load("thesis"))
    matrix = 1.02 * np.array([[true[s].get(t, 0.0) for t in LIBRARY.names] for s in STATES])
    outputs = tuple(Output(s, k, y[:, k], float(sigma[k])) for k, s in enumerate(STATES))
    experiment = Experiment(LIBRARY, states(0)[1][:, None].copy(), SAMPLE_PERIOD, y, outputs, free_states=len(STATES))
    return Fitter(experiment, Entries.of(matrix), length, floor=1.0)


def _scipy_fit(length: int) -> Array:
    """The coefficients by scipy, with the same residuals and Jacobian, over coefficients and initial states."""
    f = _two_percent_off(length)
    n, free = len(f.model), len(STATES)
    sigma = np.array([o.sigma for o in f.experiment.outputs])

    def split(p: Array) -> tuple[Entries, Array]:
        return replace(f.model, value=p[:n]), p[n:].reshape(-1, free)

    last: dict[bytes, list[Array] | None] = {}

    def run_at(p: Array) -> list[Array] | None:
        if p.tobytes() not in last:  # the Jacobian is asked for where the residuals were
            last.clear()
            last[p.tobytes()] = f.run(*split(p))
        return last[p.tobytes()]

    def left(p: Array) -> Array:
        run = run_at(p)
        if run is None:
            return np.full(free * len(f.experiment), 1e3)
        residuals = f.residuals(run)
        return np.concatenate([np.column_stack([residuals[s][k] for s in STATES]).ravel() for k in range(len(run))])

    def jacobian(p: Array) -> Any:
        model = split(p)[0]
        used = np.unique(model.term)
        right = RightHandSide(used, LIBRARY.table, model.equation, model.term, model.value)
        wanted, parts = Wanted(used, model.equation, model.term, np.arange(free)), []
        for shot, x in zip(f.shots, run_at(p) or []):
            carry, out = np.zeros((free, n + free)), np.empty((len(shot), free, n + free))
            carry[:, n:] = np.eye(free)
            sensitivities(x, shot.inputs, shot.period, f.steps, right, wanted, carry, out)
            parts.append((-out / sigma[:, None]).reshape(-1, n + free))
        if len(parts) == 1:
            return parts[0]
        return hstack([csr_matrix(np.vstack([j[:, :n] for j in parts])), block_diag([j[:, n:] for j in parts])],
                      format="csr")

    start = np.concatenate([f.model.value, f.initial.ravel()])
    # lsmr's own tolerances stop up to half a standard deviation away from the minimum
    way = {"method": "lm"} if len(f.shots) == 1 else {"method": "trf", "tr_options": {"atol": 1e-13, "btol": 1e-13}}
    return np.asarray(least_squares(left, start, jacobian, x_scale="jac", **way).x[:n])
