# SPDX-License-Identifier: Apache-2.0
"""The tables of chapters 4 and 5 of the thesis, as printed and recomputed: `python -m aeropend_ident.studies.thesis`.

"Feedback control of an aeropendulum based on a data-driven dynamic model", UFCG. Chapter 4 is recomputed from its
printed tables by the bench tests of this package. Chapter 5 is recomputed on its simulation model, the preset `thesis`,
in two ways: as in the thesis (its library, derivatives, weights and threshold, with the optimiser of pysindy), and by
`identify`.
"""

from __future__ import annotations

import argparse
import math
import sys
import warnings
from collections.abc import Iterator, Sequence
from functools import cache
from types import ModuleType

import numpy as np

from aeropend_ident.bench_tests import estimates
from aeropend_ident.bench_tests.estimates import GEAR, Estimate, Rows
from aeropend_ident.identification import dataset
from aeropend_ident.identification.dataset import STATES, Dataset, from_arrays
from aeropend_ident.identification.discrepancy import Equations, in_library, nominal
from aeropend_ident.identification.identify import Identified, identify
from aeropend_ident.identification.terms import Array, Library, thesis_terms
from aeropend_ident.signals.derivatives import tv_derivative
from aeropend_ident.tables.units import RPM
from aeropend_sim.cli.command import Parser, as_seed, entry_point
from aeropend_sim.model import actuator, dynamics, rig
from aeropend_sim.model.coefficients import prepare
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model, load
from aeropend_sim.model.state import State

SECONDS = 70.0
"""[s] Length of the recordings of chapter 5."""

LIBRARY = Library.of((*STATES, "v_a"), thesis_terms((*STATES, "v_a")))


def _rows(name: str, names: Sequence[str], text: str) -> Rows:
    return Rows(name, dict(zip(names, np.array([[float(x) for x in row.split("/")] for row in text.split()]).T)))


TABLE_4_1 = _rows("Table 4.1", ("v_a", "i_a"), """0.48/0.44 0.60/0.55 0.29/0.25 1.42/1.30 1.47/1.33 0.35/0.30 0.89/0.85
    0.74/0.69 1.31/1.17 1.54/1.40 0.78/0.74 1.58/1.57 0.79/0.73 0.99/0.96 1.76/1.67 0.57/0.52 0.37/0.35 1.93/1.89
    1.37/1.32 2.44/2.28 1.09/0.99""")
"""[V, A] Blocked rotor."""

_SPEEDS = _rows("Table 4.2", ("v_a", "i_a", "omega"), """1.08/0.29/1158 1.182/0.33/1235 1.272/0.35/1306 1.377/0.40/1402
    1.483/0.45/1485 1.561/0.50/1561 1.666/0.55/1638 1.781/0.61/1734 1.864/0.65/1805 1.974/0.70/1885""")
TABLE_4_2 = Rows(_SPEEDS.name, {**_SPEEDS.columns, "omega": RPM * _SPEEDS.columns["omega"]})
"""[V, A, rad/s] Steady states; the speed is printed in RPM."""

CURVE_4_4 = (0.054, 0.0435, 0.0029)
"""[N/V², N/V, N] Thrust over the voltage, a v² + b v + c. The points are not printed."""

WRONG = {"mgd_over_J": 131.5, "lift": 1.65}
"""The mismatched model of section 5.4: θ̈ = -131.5 sin θ - 13.82 θ̇ + 1.65 ω²."""

THRESHOLD, WINDOW, WEAK = 0.9, 40, (120, 2, 30, 1e-6, 1.4e-3)
"""Section 5.2 and 5.3: λ; samples of the moving average; K, p, half-width, and γ without and with noise."""

PRINTED_MSE = {"5.3": "1e-24", "5.4": "6e-10", "5.7": "3.7", "5.9": "0.18", "5.13": "2.55e-29", "5.14": "1.7e-12"}
"""Figure -> printed mean squared error of the arm's acceleration on the test set."""

FIGURES: dict[str, tuple[str, dict[str, dict[str, float]], int]] = {
    "5.3": ("noise-free, derivatives given: SINDy", {
        "theta": {"theta_dot": 1.0}, "theta_dot": {"theta_dot": -13.82, "omega*omega": 1.7285, "sin(theta)": -131.75},
        "i_a": {"i_a": -8.6957, "omega": -1.0217, "v_a": 4.3478}, "omega": {"i_a": 4519.2, "omega": -192.31}}, 0),
    "5.4": ("noise-free: Weak SINDy", {
        "theta": {"theta_dot": 1.0}, "theta_dot": {"theta_dot": -13.82, "omega*omega": 1.7285, "sin(theta)": -131.75},
        "i_a": {"i_a": -8.754, "omega": -1.0196, "v_a": 4.349}, "omega": {"i_a": 4519.2, "omega": -192.31}}, 0),
    "5.7": ("50 dB: SINDy", {
        "theta": {"theta_dot": 1.0},
        "theta_dot": {"theta_dot": -15.922, "omega*omega": -12.861, "sin(theta)": -21686.0},
        "i_a": {"i_a": 1524.7, "omega": 0.17495, "v_a": -12.596}, "omega": {"i_a": 8607.1, "omega": 42.773}}, 85),
    "5.9": ("50 dB: Weak SINDy", {
        "theta": {"theta_dot": 1.0016},
        "theta_dot": {"theta_dot": -13.651, "omega*omega": 2.8046, "sin(theta)": -110.59},
        "i_a": {"i_a": 5.063, "omega": -1.6485, "v_a": 3.8343}, "omega": {"i_a": 133.78, "omega": -37.418}}, 34),
    "5.13": ("mismatched model, derivatives given: discrepancy SINDy", {
        "theta": {}, "theta_dot": {"omega*omega": -0.07847, "sin(theta)": 0.25}, "i_a": {}, "omega": {}}, 0),
    "5.14": ("mismatched model: discrepancy Weak SINDy", {
        "theta": {}, "theta_dot": {"omega*omega": -0.07847, "sin(theta)": 0.25003}, "i_a": {}, "omega": {}}, 3),
    "5.17": ("the rig: Weak SINDy", {
        "theta": {"theta_dot": 1.002}, "theta_dot": {"theta_dot": -29.632, "omega*omega": 0.0, "sin(theta)": -117.36},
        "i_a": {"i_a": -8.8027, "omega": 0.0, "v_a": 0.0}, "omega": {"i_a": 18367.0, "omega": 41.114}}, 65),
}
"""Figure -> its subject, the printed coefficients of the true terms, and the number of other terms that it prints."""

DISCREPANCY = ("5.13", "5.14")
"""Figures of section 5.4. They print the model minus the truth; the terms to be added are the negative of that."""


@cache
def states(seed: int) -> tuple[Array, Array]:
    """States (N, 4) of `thesis` over 70 s, integrated in 32 steps per sample, and the voltage (N,)."""
    model = load("thesis")
    v = actuator.voltage(model.numbers(), Excitation(duration=SECONDS, seed=seed).series())
    out = np.empty((7, len(v)))
    dynamics.run(v, np.zeros(len(v)), State(), *prepare(model, SAMPLE_PERIOD, 32), out)
    return np.ascontiguousarray(out[:4].T), v


def rates(seed: int) -> Array:
    """The exact derivatives (N, 4) of `states`."""
    x, v = states(seed)
    return LIBRARY(np.column_stack([x, v])) @ matrix_of(in_library(load("thesis"))).T


def noisy(seed: int, decibel: float) -> tuple[Array, Array]:
    """States (N, 4) with white noise, and its standard deviations (4,).

    Args:
        seed: of the excitation and the noise.
        decibel: [dB] signal-to-noise ratio.
    """
    x, _ = states(seed)
    sigma = np.sqrt(np.mean(x**2, axis=0)) * 10.0 ** (-decibel / 20.0)
    return x + sigma * np.random.default_rng(1000 + seed).standard_normal(x.shape), sigma


def given(x: Array, v: Array, derivatives: Array | None = None) -> Dataset:
    """A dataset of states (N, 4) and voltage (N,)."""
    return from_arrays(dict(zip(STATES, x.T)), {"v_a": v}, SAMPLE_PERIOD,
                       derivatives=None if derivatives is None else dict(zip(STATES, derivatives.T)))


def matrix_of(equations: Equations) -> Array:
    """Coefficients (4, 31)."""
    return np.array([[equations[s].get(t, 0.0) for t in LIBRARY.names] for s in STATES])


def mismatched() -> Model:
    """The model of section 5.4."""
    model = load("thesis")
    return Model("wrong", {**model.model, "mgd_over_J": WRONG["mgd_over_J"],
                           "k_thrust": WRONG["lift"] / model.model["L_over_J"]}, model.sensing)


def missing() -> dict[str, dict[str, float]]:
    """The terms that the mismatched model lacks."""
    wrong = in_library(mismatched())
    found = {s: {t: c - wrong[s].get(t, 0.0) for t, c in e.items()} for s, e in in_library(load("thesis")).items()}
    return {s: {t: c for t, c in e.items() if abs(c) > 1e-9} for s, e in found.items()}


def chapter_4() -> Iterator[tuple[str, str, str, str]]:
    """Rows of text: the quantity, the printed value, the recomputed value, and a remark."""
    resistance = estimates.blocked_rotor(TABLE_4_1).numbers["R_a"]
    yield "R_a, Table 4.1", "1.08 Ω, sd 0.04", _one(resistance), ""
    found = estimates.steady(TABLE_4_2, Estimate(1.08, resistance.sigma, "Ω", "Table 4.1"))
    printed, constant = found.others["K_e in V/RPM"], found.numbers["K_e"]
    yield "K_ω, Table 4.2", "6.606e-4, sd 1.377e-5", _one(printed), ""
    yield ("K_ω, Table 4.3", "6.6e-4 Vs/rad", _one(constant),
           f"wrong unit: Table 4.2's speeds are RPM, so 6.6e-4 is V/RPM; in SI it is {1.0 / RPM:.4g} times that")
    yield ("K_t, Table 4.3", "0.235 Nm/A", _one(found.numbers["K_t"]),
           "of the simulation model, not of this motor: in SI K_t is K_ω")
    yield ("B_m, Table 4.3", "0.01 Ns/m²", _one(found.numbers["B_m"]),
           f"wrong unit, and of the simulation model; beside it k_load = {_one(found.numbers['k_load'])}")
    yield ("L_a, 4.4.2", "2.2 mH", f"{1e3 * 0.002 * resistance.value:.3g} mH",
           "τ_e = 2 ms times R_a; τ_e itself is printed to one digit")
    numbers = load("bench").model
    top = float(actuator.voltage(numbers, 1.0))
    dead = float(((0.0 - numbers["k0"]) / numbers["k1"]) ** 2 - numbers["k3"]) / numbers["k2"]
    yield ("v_a(τ), (4.3)", "MSE 2.6e-5 V²", f"{top:.4g} V at τ = 1",
           f"its points are not printed; no voltage up to τ = {dead:.2g}")
    a, b, c = CURVE_4_4
    p, q, r, s = estimates.thrust_to_voltage(a, b, c)
    yield ("v_a(f), (4.5)", "0.4028 + 9.2593 √0.0013 + 0.2160 f", f"{p:.4f} + {q:.4f} √({r:.4f} + {s:.4f} f)",
           "the inverse of (4.4): wrong sign, and the root is too short")
    v, w = TABLE_4_2.columns["v_a"], TABLE_4_2.columns["omega"]
    thrust = estimates.thrust_curve(Rows("(4.4) over Table 4.2", {"omega": w, "thrust": a * v * v + b * v + c}),
                                      numbers)
    k = thrust.numbers["k_thrust"]
    within = float(np.ptp(thrust.panels[0].y / w**2)) / 2.0 / k.value
    remark = f"of the simulation model; (4.4) over Table 4.2's speeds is f = {k.value:.4g} ω², {100.0 * within:.2g} %"
    yield "K_q, Table 4.3", "1e-4", f"{k.value / GEAR**2:.4g} N s²", remark


def _one(e: Estimate) -> str:
    scatter = "" if math.isnan(e.scatter) else f", sd {e.scatter:.4g}"
    return f"{e.value:.4g} ± {e.sigma:.1g} {e.unit}{scatter}" if e.sigma > 0.0 else f"{e.value:.4g} {e.unit}"


def as_printed(figure: str, optimiser: ModuleType, seed: int = 0) -> Array:
    """Coefficients (4, 31) by the method of the thesis: sequentially thresholded least squares of pysindy.

    The windows follow the description in the thesis. It does not print the threshold of the discrepancy methods.

    Args:
        figure: of `FIGURES`.
        optimiser: the module pysindy.
        seed: of the excitation and the noise.
    """
    x, v = states(seed)
    exact = in_library(load("thesis"))
    known = matrix_of(in_library(mismatched())) if figure in DISCREPANCY else np.zeros((len(STATES), len(LIBRARY)))
    weak = figure in ("5.4", "5.9", "5.14")
    if figure in ("5.7", "5.9"):
        y, _ = noisy(seed, 50.0)
        mean = np.column_stack([np.convolve(column, np.ones(WINDOW) / WINDOW, "valid") for column in y.T])
        x, v = mean, np.convolve(v, np.ones(WINDOW) / WINDOW, "valid")
        smooth = [tv_derivative(column, SAMPLE_PERIOD) for column in x.T]
        derivatives = np.column_stack([d for _, d in smooth])
    else:
        derivatives = LIBRARY(np.column_stack([x, v])) @ matrix_of(exact).T
    terms = LIBRARY(np.column_stack([x, v]))
    part = slice(0, round(0.75 * len(x)))
    rows, left = terms[part], derivatives[part] - terms[part] @ known.T
    penalty = 0.0
    if weak:
        count, power, half, clean, dirty = WEAK
        penalty = dirty if figure == "5.9" else clean
        rows, left = _weak_rows(terms[part], x[part], terms[part] @ known.T, count, power, half)
    stlsq = optimiser.STLSQ(threshold=1e-2 if figure in DISCREPANCY else THRESHOLD, alpha=penalty)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # an equation has no terms, which is right here
        stlsq.fit(rows, left)
    return np.asarray(stlsq.coef_, dtype=float)


def _weak_rows(terms: Array, x: Array, known: Array, count: int, power: int, half: int) -> tuple[Array, Array]:
    """The weak form with evenly spread windows (1 - s²)^power, by the trapezoidal rule.

    Args:
        terms: (N, P) the terms.
        x: (N, S) the states.
        known: (N, S) the known part of the derivatives.
        count: number of windows.
        power: of the windows.
        half: half-width in samples.
    """
    s = np.arange(-half, half + 1) / half
    phi, slope = (1.0 - s * s) ** power, -2.0 * power * s * (1.0 - s * s) ** (power - 1) / (half * SAMPLE_PERIOD)
    first = np.linspace(0, len(x) - len(s), count).astype(int)
    cut = first[:, None] + np.arange(len(s))
    rows = np.einsum("kwp,w->kp", terms[cut], phi)
    left = -np.einsum("kws,w->ks", x[cut], slope) - np.einsum("kws,w->ks", known[cut], phi)
    return rows, left


def here(figure: str, seed: int = 0) -> Identified:
    """The figure's equations by `identify`; Fig 5.17 is of the simulated rig `bench`, not of the rig of the thesis.

    Args:
        figure: of `FIGURES`.
        seed: of the excitation and the noise.
    """
    x, v = states(seed)
    if figure == "5.17":
        model = load("bench")
        duty = Excitation(duration=SECONDS, seed=seed).series()
        read, _ = rig.record(model, duty, seed)
        return identify(dataset.from_readings({**read, "duty": duty}, SAMPLE_PERIOD, model.sensing), "weak")
    if figure in ("5.7", "5.9"):
        return identify(given(noisy(seed, 50.0)[0], v), "sindy" if figure == "5.7" else "weak")
    data = given(x, v, rates(seed)) if figure in ("5.3", "5.13") else given(x, v)
    method = {"5.3": "sindy", "5.4": "weak", "5.13": "discrepancy-sindy", "5.14": "discrepancy-weak"}[figure]
    return identify(data, method, known=nominal(mismatched()) if figure in DISCREPANCY else None)


def chapter_5(figure: str, seed: int = 0) -> Iterator[str]:
    """A figure's matrix as text: the coefficients of the true terms, and the number of others.

    There is a column for the printed values, one for the method of the thesis, and one for `identify`.

    Args:
        figure: of `FIGURES`.
        seed: of the excitation and the noise.
    """
    what, printed, others = FIGURES[figure]
    if figure in DISCREPANCY:
        printed = {s: {t: -c for t, c in e.items()} for s, e in printed.items()}
        what += "; printed as the model minus the truth, here with the opposite sign"
    peer: Array | None = None
    if figure != "5.17":
        try:
            import pysindy
        except ImportError:
            pysindy = None
        peer = None if pysindy is None else as_printed(figure, pysindy, seed)
    found = here(figure, seed)
    true = missing() if figure in DISCREPANCY else in_library(load("bench" if figure == "5.17" else "thesis"))
    yield f"Fig {figure}, {what}"
    yield f"  {'':24}{'true':>14}{'printed':>14}{'re-run':>14}{'identify':>14}{'1 sigma':>10}"
    for s in STATES:
        for term in dict.fromkeys([*true[s], *printed[s]]):
            value = "" if term not in printed[s] else f"{printed[s][term]:.6g}"
            own = "" if peer is None else f"{peer[STATES.index(s), LIBRARY.names.index(term)]:.6g}"
            got, sd = found.equations[s].get(term, 0.0), found.sigma[s].get(term, 0.0)
            yield (f"  d({s})/dt: {term:{22 - len(s) - 6}}{true[s].get(term, 0.0):14.6g}{value:>14}{own:>14}{got:14.6g}"
                   f"{sd:10.2g}")
    spurious = sum(t not in true[s] for s in STATES for t in found.equations[s])
    theirs = "" if peer is None else str(int(sum(peer[k, j] != 0.0 for k, s in enumerate(STATES) for j, t in
                                                 enumerate(LIBRARY.names) if t not in true[s])))
    yield f"  {'terms that are not true':24}{0:14}{others:14}{theirs:>14}{spurious:14}"
    if figure in PRINTED_MSE:
        own = "" if peer is None else f"{_mse(peer, figure, seed):.2g}"
        yield (f"  {'MSE of θ̈, held out':25}{'':14}{PRINTED_MSE[figure]:>14}{own:>14}"
               f"{_mse(matrix_of(found.equations), figure, seed):14.2g}")
    yield ""


def _mse(matrix: Array, figure: str, seed: int) -> float:
    """Mean squared error of the arm's acceleration in the last quarter of the noise-free states."""
    x, v = states(seed)
    whole = matrix + (matrix_of(in_library(mismatched())) if figure in DISCREPANCY else 0.0)
    late = slice(round(0.75 * len(x)), None)
    rate = LIBRARY(np.column_stack([x, v])[late]) @ whole[1]
    return float(np.mean((rate - rates(seed)[late, 1]) ** 2))


@entry_point("thesis")
def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; returns the exit code."""
    parser = Parser(prog="thesis", formatter_class=argparse.RawDescriptionHelpFormatter, epilog="""examples:
  python -m aeropend_ident.studies.thesis                 all tables, a few minutes
  python -m aeropend_ident.studies.thesis 4               chapter 4 only
  python -m aeropend_ident.studies.thesis 5.9 5.14        two figures of chapter 5

exit codes: 0, 2 no such table, 130 interrupted""",
                    description="The tables of chapters 4 and 5 of the thesis, as printed and recomputed.")
    parser.add_argument("which", nargs="*", metavar="TABLE",
                        help=f"4, or a figure: {', '.join(FIGURES)} (default: all)")
    parser.add_argument("--seed", type=as_seed, default=0, help="seed of the excitation and of the noise (default: 0)")
    options = parser.parse_args(arguments)
    wanted = options.which or ["4", *FIGURES]
    unknown = [name for name in wanted if name != "4" and name not in FIGURES]
    if unknown:
        parser.error(f"no table '{unknown[0]}': give 4 or a figure of {', '.join(FIGURES)}")
    for name in wanted:
        for line in _chapter_4() if name == "4" else chapter_5(name, options.seed):
            print(line, flush=True)
    return 0


def _chapter_4() -> Iterator[str]:
    yield f"  {'Chapter 4':18}{'printed':38}{'here'}"
    for name, printed, found, remark in chapter_4():
        yield f"  {name:18}{printed:38}{found}"
        if remark:
            yield f"  {'':18}{'':38}{remark}"
    yield ""


if __name__ == "__main__":
    sys.exit(main())
