# SPDX-License-Identifier: Apache-2.0
"""The study case of the thesis (3.3): the Lorenz system, identified by each method.

Run it with `python -m aeropend_ident.studies.lorenz [--noise 0.05]`.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping, Sequence

import numpy as np

from aeropend_ident.identification.dataset import Dataset, from_arrays
from aeropend_ident.identification.identify import METHODS, Identified, identify
from aeropend_ident.identification.output_error import Entries, Experiment, Fitter
from aeropend_ident.identification.terms import Array, Library, polynomials
from aeropend_sim.cli.command import EXIT_CODES, Parser, as_seed, entry_point
from aeropend_sim.cli.progress import progress

STATES = ("x", "y", "z")
EQUATIONS: dict[str, dict[str, float]] = {"x": {"x": -10.0, "y": 10.0}, "y": {"x": 28.0, "y": -1.0, "x*z": -1.0},
                                          "z": {"z": -8.0 / 3.0, "x*y": 1.0}}
MISMATCH: dict[str, dict[str, float]] = {"x": {"x": -9.5, "y": 9.5}, "y": {"x": 27.0, "y": -1.0, "x*z": -1.0},
                                         "z": {"z": -8.0 / 3.0, "x*y": 1.0}}
"""A model that is wrong in ẋ and ẏ, as in Fig 3.5 of the thesis, which prints no coefficients."""

PERIOD = 0.002
"""[s] Sample period."""

DURATION = 10.0
"""[s] Length of a run."""

DEGREE = 3
"""Degree of the polynomials among which terms are chosen."""


def simulate(duration: float = DURATION, period: float = PERIOD, seed: int = 0) -> Array:
    """States (N, 3) of a run that starts near (-8, 8, 27).

    Args:
        duration: [s] length.
        period: [s] sample period.
        seed: of the start.
    """
    n, start = round(duration / period), np.array([-8.0, 8.0, 27.0]) + np.random.default_rng(seed).normal(size=3)
    library = Library.of(STATES, sorted({t for e in EQUATIONS.values() for t in e}))
    matrix = np.array([[EQUATIONS[s].get(t, 0.0) for t in library.names] for s in STATES])
    guess = start + np.linspace(-50.0, 50.0, n)[:, None]
    fitter = Fitter(Experiment(library, np.zeros((n, 0)), period, guess, (), free_states=3), Entries.of(matrix))
    fitter.steps = 16
    states = fitter.run(fitter.model, start[None])
    assert states is not None
    return states[0]


def rates(states: Array) -> dict[str, Array]:
    """The exact derivatives, by state."""
    library = Library.of(STATES, sorted({t for e in EQUATIONS.values() for t in e}))
    terms = library(states)
    return {s: terms @ np.array([EQUATIONS[s].get(t, 0.0) for t in library.names]) for s in STATES}


def data(noise: float = 0.05, seed: int = 0, *, exact: bool = False) -> Dataset:
    """A run with noise.

    Args:
        noise: standard deviation of the noise over that of each state.
        seed: of the start and the noise.
        exact: give the exact derivatives as well.
    """
    x = simulate(seed=seed)
    y = x + noise * x.std(axis=0) * np.random.default_rng(seed + 1000).standard_normal(x.shape)
    columns = dict(zip(STATES, y.T))
    return from_arrays(columns, {}, PERIOD, name="lorenz", derivatives=rates(x) if exact else None)


def study(method: str, noise: float = 0.05, seed: int = 0) -> Identified:
    """Identify the equations of a run.

    Args:
        method: one of `METHODS`.
        noise: standard deviation of the noise over that of each state.
        seed: of the start and the noise.
    """
    return identify(data(noise, seed, exact=noise == 0.0 and method.endswith("sindy")), method,
                    polynomials(STATES, DEGREE), MISMATCH)


def truth(method: str) -> dict[str, dict[str, float]]:
    """The equations that a method should find."""
    known: Mapping[str, Mapping[str, float]] = MISMATCH if method.startswith("discrepancy") else {}
    found = {s: {t: c - known.get(s, {}).get(t, 0.0) for t, c in e.items()} for s, e in EQUATIONS.items()}
    return {s: {t: c for t, c in e.items() if c != 0.0} for s, e in found.items()}


def is_exact(found: Mapping[str, Mapping[str, float]], true: Mapping[str, Mapping[str, float]]) -> bool:
    """Whether all equations have exactly the true terms."""
    return all(set(found[s]) == set(true[s]) for s in true)


@entry_point("lorenz")
def main(arguments: Sequence[str] | None = None) -> int:
    """Print the equations found by each method; returns the exit code."""
    parser = Parser(prog="lorenz", description="Identify the Lorenz system by each method.",
                    epilog=f"examples:\n  python -m aeropend_ident.studies.lorenz --noise 0.1 --seed 3\n\n{EXIT_CODES}",
                    formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--noise", type=float, default=0.05,
                        help="noise over the standard deviation of each state (default: 0.05)")
    parser.add_argument("--seed", type=as_seed, default=0, help="seed of the noise and of the start (default: 0)")
    options = parser.parse_args(arguments)
    if not (math.isfinite(options.noise) and 0.0 <= options.noise < 1.0):
        parser.error(f"--noise is {options.noise:g}: give a share from 0 to below 1")
    found_by = {}
    with progress("", len(METHODS)) as show:
        for number, method in enumerate(METHODS):
            show(number, method)
            found_by[method] = study(method, options.noise, options.seed)
    for method, found in found_by.items():
        result = "the true terms" if is_exact(found.equations, truth(method)) else "not the true terms"
        print(f"{method}: {result}, {found.seconds:.1f} s")
        for s, equation in found.equations.items():
            shown = "  ".join(f"{t} {c:.6g} ± {found.sigma[s][t]:.1g}" for t, c in equation.items())
            print(f"  {s}: {shown or 'nothing'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
