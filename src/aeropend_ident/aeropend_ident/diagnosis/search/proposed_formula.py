# SPDX-License-Identifier: Apache-2.0
"""Formulas for a term that was learned as curves: short sums of `SHAPES`, whose text can stand in an effect file.

A dictionary holds each shape over each quantity with its constants on a grid. Two searches choose few of its columns:
our own over pairs and triples, and pysindy's optimisers over the columns that ours rates best. What they find is
refined by nonlinear least squares and ranked by one criterion.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from aeropend_ident.diagnosis.search.term_shapes import CONSTANTS, NUMPY, SHAPES, Array, Shape
from aeropend_sim.model.effects import EffectParameter
from aeropend_sim.model.formula import product

KNOTS = 12
"""Number of independent values of a curve whose knots are not given (choice: learned curves have 9 to 14)."""

MOST_TERMS = 3
"""Greatest number of shapes in a sum (choice: more than a reader can interpret)."""

POINTS = (120, 300)
"""Points of the data that are used, for one quantity and for several (choice: many times the number of knots)."""

LEAST_SD = 0.02
"""Least standard deviation of the target, relative to its RMS (choice: straight lines between knots differ so much)."""

PRICE = 1.0
"""Price of a constant, relative to that of the Bayesian information criterion.

Measured: of 200 drawn terms with known knots the first proposal was within 10 % in 77.5 %; with 0.7 in as many, with
0.5 in 75 %."""

REFINED = (16, 20, 12)
"""Greatest number of sums of one, two and three shapes that are refined (choice: well below 1 s)."""

BEAM = 4
"""Number of the best sums of two that get a third shape (choice)."""

PARALLEL = 0.999
"""Square of the correlation above which two columns of the dictionary are one (choice)."""

OUTSIDE = 1.5
"""Farthest point of a learned curve, over the greatest size of its quantity (choice: shapes that grow exponentially
have no number far outside)."""

ALIKE = 0.02
"""RMS difference of two proposals, relative to the target's RMS, below which the longer one is left out (choice)."""

NEAR = 6.0
"""Score above the best up to which a proposal with fewer constants is always shown (convention of the Bayesian
information criterion: strong evidence)."""

MOVE = 0.3
"""How far a place may move, relative to the range of its quantity (choice)."""

SIZE_RANGE = 4.0
"""Greatest size of a proposal, relative to its value (choice)."""


@dataclass(frozen=True)
class Proposal:
    """A formula for a learned term.

    Attributes:
        term: in the formula language.
        parameters: the size, at whose value 0 the term vanishes, then the other constants.
        score: n ln(1 + mean squared error over variance) + constants ln n, where n is the number of independent values
            of the learned curves; lower is better, and a difference of 6 is strong evidence.
        misfit: RMS difference from the target over all samples, relative to the target's RMS.
    """

    term: str
    parameters: dict[str, EffectParameter]
    score: float
    misfit: float

    def __call__(self, variables: Mapping[str, Array]) -> Array:
        """Values (N,) of the term with the parameters' defaults.

        Args:
            variables: quantity -> (N,) values.
        """
        names = dict(NUMPY) | dict(variables) | {name: p.default for name, p in self.parameters.items()}
        value = eval(self.term, {"__builtins__": {}}, names)  # noqa: S307 - a text that this module has written
        return np.asarray(value + np.zeros_like(next(iter(variables.values()))))


def propose(variables: Mapping[str, Array], units: Mapping[str, str], target: Array, sd: Array, unit: str,
            count: int = 5, knots: Mapping[str, Array] | None = None) -> list[Proposal]:
    """Propose formulas for a learned term, best first.

    Args:
        variables: quantity of the formula language -> (N,) values along the recording.
        units: of the quantities.
        target: (N,) the term.
        sd: (N,) standard deviation of the target; its errors may be correlated.
        unit: of the term.
        count: greatest number of proposals.
        knots: quantity -> points of its learned curve, where known: shapes are then compared as straight lines between
            these points, as the target was made.

    Returns:
        Proposals; none for a target that is zero.

    Raises:
        ValueError: no quantity, or arrays of different lengths.
    """
    if not variables or any(len(x) != len(target) for x in (*variables.values(), sd)):
        raise ValueError("the quantities, the target and its standard deviation need the same number of samples")
    level = float(np.sqrt(np.mean(target**2)))
    if not level > 0.0:
        return []
    data = _Data(variables, target, sd, level, knots or {})
    found = _Search(data).run()
    proposals = []
    for one in sorted(found, key=lambda s: s.score):
        made = _written(one, data, units, unit)
        values = made(variables)
        proposals.append((replace(made, misfit=float(np.sqrt(np.mean((values - target) ** 2))) / level), values))
    return _chosen(proposals, level, count)


def definition(proposal: Proposal, place: str, reading: str = "") -> dict[str, object]:
    """A proposal as `effect_file.define` takes it.

    Args:
        proposal: what to define.
        place: one of `effects.PLACES`.
        reading: that it is added to, at place sensing.
    """
    parameters = {name: {"unit": p.unit, "neutral": p.neutral, "default": p.default, "low": p.low, "high": p.high,
                         "description": p.description} for name, p in proposal.parameters.items()}
    return {"place": place, "physics": "a formula that was proposed for a learned term", "term": proposal.term,
            **({"reading": reading} if reading else {}), "parameters": parameters}


def _chosen(proposals: Sequence[tuple[Proposal, Array]], level: float, count: int) -> list[Proposal]:
    """The best that differ; the last place is kept for a shorter one if that is nearly as good."""
    kept: list[tuple[Proposal, Array]] = []
    for proposal, values in proposals:
        if all(float(np.sqrt(np.mean((values - other) ** 2))) > ALIKE * level or
               len(proposal.parameters) < len(earlier.parameters) for earlier, other in kept):
            kept.append((proposal, values))
    best = [proposal for proposal, _ in kept]
    top, later = best[:count], best[count:]
    shortest = min((len(p.parameters) for p in top), default=0)
    shorter = [p for p in later if len(p.parameters) < shortest and p.score < best[0].score + NEAR]
    return [*top[:-1], shorter[0]] if shorter and count > 1 else top


# --- the data


@dataclass(frozen=True)
class _Atom:
    """A shape over a quantity, perhaps times another quantity."""

    shape: Shape
    of: str
    times: str = ""


class _Data:
    """The points that are compared: quantities relative to their greatest size, target relative to its RMS.

    Attributes:
        span: greatest size of each quantity.
        x: (M,) values of each quantity.
        y: (M,) target over its standard deviation.
        weight: (M,) one over the standard deviation.
        independent: number of independent values in the target.
    """

    def __init__(self, variables: Mapping[str, Array], target: Array, sd: Array, level: float,
                 knots: Mapping[str, Array]) -> None:
        first = next(iter(variables.values()))
        wanted = min(len(target), POINTS[len(variables) > 1])
        chosen = ((np.arange(wanted) + 0.5) * len(target) / wanted).astype(int)
        if len(variables) == 1:
            chosen = np.argsort(first, kind="stable")[chosen]
        self.span = {name: float(np.max(np.abs(x))) or 1.0 for name, x in variables.items()}
        self.x = {name: np.asarray(x[chosen], dtype=float) / self.span[name] for name, x in variables.items()}
        self.weight = 1.0 / np.hypot(sd[chosen] / level, LEAST_SD)
        self.y = target[chosen] / level * self.weight
        self.level = level
        self._knots = {name: np.unique(np.clip(np.unique(at) / self.span[name], -OUTSIDE, OUTSIDE))
                       for name, at in knots.items() if name in variables}
        self._lines = {name: np.array([np.interp(self.x[name], at, row) for row in np.eye(len(at))]).T
                       for name, at in self._knots.items()}
        curves = len(variables) - ("thrust" in variables and len(variables) > 1)
        self.independent = float(sum(map(len, self._knots.values())) or KNOTS * curves)

    def column(self, atom: _Atom, constants: Array) -> Array:
        """(M,) an atom over the target's standard deviation."""
        if atom.of in self._lines:
            value = self._lines[atom.of] @ atom.shape(self._knots[atom.of], constants)
        else:
            value = atom.shape(self.x[atom.of], constants)
        return value * self.weight * (self.x[atom.times] if atom.times else 1.0)


# --- the search


@dataclass(frozen=True)
class _Sum:
    """A sum of atoms with its constants and coefficients."""

    atoms: tuple[_Atom, ...]
    constants: tuple[Array, ...]
    coefficients: Array
    error: float
    score: float


class _Search:
    """The dictionary, and sums of few of its columns."""

    def __init__(self, data: _Data) -> None:
        self.data = data
        self.atoms = _atoms(data.x)
        grids = [atom.shape.starts(data.x[atom.of]) for atom in self.atoms]
        self.group = np.repeat(np.arange(len(self.atoms)), [len(g) for g in grids])
        self.constants = [c for g in grids for c in g]
        columns = np.array([data.column(self.atoms[g], c) for g, c in zip(self.group, self.constants)]).T
        size = np.linalg.norm(columns, axis=0)
        usable = size > 1e-9 * np.max(size)
        self.group = self.group[usable]
        self.constants = [c for c, use in zip(self.constants, usable) if use]
        self.columns = columns[:, usable] / size[usable]
        self.first = np.flatnonzero(np.diff(self.group, prepend=-1))
        self.g = self.columns.T @ data.y
        self.H = self.columns.T @ self.columns
        self.y2 = float(data.y @ data.y)

    def run(self) -> list[_Sum]:
        """All sums that were refined."""
        supports = [*self._singles(), *self._pairs()]
        supports += [s for s in self._pysindy() if s not in supports]
        found = self._refined(supports)
        pairs = sorted((s for s in found if len(s.atoms) == MOST_TERMS - 1), key=lambda s: s.score)[:BEAM]
        starts = sorted((start for pair in pairs for start in self._third(pair)), key=lambda s: s[0])
        found += [self.refine(atoms, constants) for _, atoms, constants in starts[: REFINED[2]]]
        return found

    def _refined(self, supports: Iterable[tuple[int, ...]]) -> list[_Sum]:
        return [self.refine([self.atoms[self.group[j]] for j in s], [self.constants[j] for j in s]) for s in supports]

    def score(self, error: float, constants: int) -> float:
        """The criterion, from the sum of squares and the number of constants."""
        n = self.data.independent
        return n * math.log1p(error / len(self.data.y)) + PRICE * constants * math.log(n)

    def _price(self, groups: Array | Sequence[int]) -> int:
        return sum(_constants(self.atoms[int(k)]) for k in groups)

    def _singles(self) -> list[tuple[int, ...]]:
        """The best column of each atom, the best atoms first."""
        rated = []
        for first, end in itertools.pairwise([*self.first, len(self.group)]):
            j = first + int(np.argmax(self.g[first:end] ** 2))
            rated.append((self.score(self.y2 - self.g[j] ** 2, self._price([self.group[j]])), (j,)))
        return [support for _, support in sorted(rated)[: REFINED[0]]]

    def _pairs(self) -> list[tuple[int, ...]]:
        """The best columns of each pair of atoms, the best pairs first."""
        off = 1.0 - self.H**2
        gain = self.g[:, None] ** 2 + self.g**2 - 2.0 * self.H * np.outer(self.g, self.g)
        gain = np.where(off > 1.0 - PARALLEL, gain / np.maximum(off, 1.0 - PARALLEL), 0.0)
        best = np.maximum.reduceat(np.maximum.reduceat(gain, self.first, axis=0), self.first, axis=1)
        prices = np.array([_constants(self.atoms[self.group[f]]) for f in self.first])
        n = self.data.independent
        left = np.maximum(self.y2 - best, 0.0)
        rating = n * np.log1p(left / len(self.data.y)) + PRICE * math.log(n) * (prices[:, None] + prices)
        a, b = np.triu_indices(len(prices))
        ends = [*self.first[1:], len(self.group)]
        found: list[tuple[int, ...]] = []
        for k in np.argsort(rating[a, b])[: REFINED[1]]:
            rows, cols = slice(self.first[a[k]], ends[a[k]]), slice(self.first[b[k]], ends[b[k]])
            i, j = np.unravel_index(int(np.argmax(gain[rows, cols])), gain[rows, cols].shape)
            found.append((int(self.first[a[k]] + i), int(self.first[b[k]] + j)))
        return found

    def _third(self, pair: _Sum) -> list[tuple[float, list[_Atom], list[Array]]]:
        """A further column of each atom beside a sum, and the criterion with it."""
        basis = np.linalg.qr(np.column_stack([self.data.column(a, c) for a, c in zip(pair.atoms, pair.constants)]))[0]
        rest = self.data.y - basis @ (basis.T @ self.data.y)
        size = 1.0 - np.sum((basis.T @ self.columns) ** 2, axis=0)
        gain = np.where(size > 1.0 - PARALLEL, (self.columns.T @ rest) ** 2 / np.maximum(size, 1.0 - PARALLEL), 0.0)
        found = []
        for first, end in itertools.pairwise([*self.first, len(self.group)]):
            j = first + int(np.argmax(gain[first:end]))
            atoms = [*pair.atoms, self.atoms[self.group[j]]]
            rating = self.score(max(float(rest @ rest) - gain[j], 0.0), sum(map(_constants, atoms)))
            found.append((rating, atoms, [*pair.constants, self.constants[j]]))
        return found

    def _pysindy(self) -> list[tuple[int, ...]]:
        """Supports that pysindy's optimisers find among the columns of the best atoms and pairs."""
        import pysindy

        chosen = sorted({j for s in (*self._singles(), *self._pairs()) for j in s})
        part = self.columns[:, chosen]
        scale = float(np.sqrt(self.y2))
        optimisers = [pysindy.SSR(alpha=1e-3, max_iter=len(chosen)),
                      *(pysindy.STLSQ(threshold=t, alpha=1e-3) for t in (0.05, 0.1, 0.2, 0.4))]
        found: dict[tuple[int, ...], None] = {}
        for optimiser in optimisers:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                optimiser.fit(part, self.data.y[:, None] / scale)
            for coefficients in _history(optimiser):
                support = tuple(chosen[j] for j in np.flatnonzero(coefficients))
                if 1 <= len(support) <= MOST_TERMS:
                    found[support] = None
        return list(found)

    def refine(self, atoms: Sequence[_Atom], constants: Sequence[Array]) -> _Sum:
        """The sum with its constants fitted, beginning at some."""
        data = self.data
        letters = [k for a in atoms for k in a.shape.letters]
        cuts = np.cumsum([len(a.shape.letters) for a in atoms])[:-1]
        logarithmic = np.array([k in "swnrf" for k in letters], dtype=bool)
        low, high = (np.array([getattr(CONSTANTS[k], e) for k in letters], dtype=float) for e in ("low", "high"))
        free = low < high

        def columns(z: Array) -> Array:
            p = start.copy()
            p[free] = z
            p = np.where(logarithmic, np.exp(np.where(logarithmic, p, 0.0)), p)
            return np.column_stack([data.column(a, c) for a, c in zip(atoms, np.split(p, cuts))])

        def solved(z: Array) -> tuple[Array, Array]:
            A = columns(z)
            size = np.maximum(np.linalg.norm(A, axis=0), 1e-300)
            c = np.linalg.lstsq(A / size, data.y, rcond=1e-6)[0] / size
            return c, A @ c - data.y

        def internal(p: Array) -> Array:
            return np.where(logarithmic, np.log(np.where(logarithmic, p, 1.0)), p)

        start = internal(np.concatenate([np.asarray(c, dtype=float) for c in constants] or [np.zeros(0)]))
        bounds = internal(low)[free], internal(high)[free]
        z = np.clip(start[free], bounds[0] + 1e-6, bounds[1] - 1e-6)
        if len(z):
            z = least_squares(lambda z: solved(z)[1], z, bounds=bounds, max_nfev=10, xtol=1e-3, ftol=1e-3).x
        c, rest = solved(z)
        p = start.copy()
        p[free] = z
        p = np.where(logarithmic, np.exp(np.where(logarithmic, p, 0.0)), p)
        error = float(rest @ rest)
        return _Sum(tuple(atoms), tuple(np.split(p, cuts)), c, error, self.score(error, sum(map(_constants, atoms))))


def _history(optimiser: Any) -> list[Array]:
    """The coefficients (P,) of each step of an optimiser of pysindy."""
    return [np.asarray(step).reshape(-1) for step in [*optimiser.history_, optimiser.coef_]]


def _constants(atom: _Atom) -> int:
    """Number of free constants of an atom, its coefficient included."""
    return 1 + sum(CONSTANTS[k].low < CONSTANTS[k].high for k in atom.shape.letters)


def _atoms(x: Mapping[str, Array]) -> list[_Atom]:
    """All atoms over some quantities: each shape, alone and times the thrust, and products of two quantities.

    Without shapes that are another one where a quantity has one sign only.
    """
    found, names = [_Atom(SHAPES[0], next(iter(x)))], list(x)
    for k, name in enumerate(names):
        signed = bool(np.min(x[name]) < 0.0 < np.max(x[name]))
        shapes = [s for s in SHAPES[1:] if signed or not s.doubles]
        found += [_Atom(s, name) for s in shapes]
        if "thrust" in names and name != "thrust":
            found += [_Atom(s, name, "thrust") for s in shapes]
        found += [_Atom(s, name, other) for other in names[:k] for s in SHAPES if s.text == "{x}"
                  if "thrust" not in (name, other)]
    return found


# --- the text


def _written(found: _Sum, data: _Data, units: Mapping[str, str], unit: str) -> Proposal:
    """A sum as a formula in SI units; the term that contributes most has the size of all as its coefficient."""
    sizes = [abs(c) * float(np.linalg.norm(data.column(a, p)))
             for a, p, c in zip(found.atoms, found.constants, found.coefficients)]
    order = np.argsort(sizes)[::-1]
    parts, parameters = [], {}
    first = 1.0
    for number, k in enumerate(order, 1):
        atom, span = found.atoms[k], data.span
        suffix = "" if number == 1 else f"_{number}"
        names = {}
        per = [(units[atom.of], atom.shape.power)] + ([(units[atom.times], 1)] if atom.times else [])
        coefficient = float(found.coefficients[k]) * data.level / span[atom.of] ** atom.shape.power
        coefficient /= span[atom.times] if atom.times else 1.0
        own = product([(unit, 1), *((u, -p) for u, p in per)])
        if number == 1:
            first, first_unit = coefficient, own
            ratio = 1.0
            name = "size"
            parameters[name] = _size(coefficient, own)
        else:
            ratio = coefficient / first
            name = f"share{suffix}"
            ratio_unit = product([(own, 1), (first_unit, -1)])
            parameters[name] = _ranged(ratio, ratio_unit, 0.0, SIZE_RANGE * abs(ratio), "size relative to the first")
        for letter, value in zip(atom.shape.letters, found.constants[k]):
            constant = CONSTANTS[letter]
            names[letter] = constant.name + suffix
            real = float(value) * span[atom.of] ** constant.power
            parameters[names[letter]] = _ranged(
                real, product([(units[atom.of], constant.power)]) if constant.power else "-", constant.wide,
                MOVE * (span[atom.of] ** constant.power if letter != "p" else 2.0 * math.pi), constant.description)
        text = atom.shape.text.format(x=atom.of, **names)
        text = f"{atom.times} * {text}" if atom.times and text != "1" else (atom.times or text)
        parts.append(text if number == 1 else f"{name} * {text}" if text != "1" else name)
    total = f"({' + '.join(parts)})" if len(parts) > 1 else parts[0]
    term = "size" if total == "1" else f"size * {total}".replace("* 1 /", "/")
    return Proposal(term, parameters, found.score, 0.0)


def _size(value: float, unit: str) -> EffectParameter:
    default = _rounded(value) or 1e-12
    low, high = sorted((0.0, _rounded(SIZE_RANGE * default)))
    return EffectParameter(unit, 0.0, default, low, high, "size of the term")


def _ranged(value: float, unit: str, factor: float, move: float, description: str) -> EffectParameter:
    """A constant that may differ by a factor, or if that is 0 by a distance."""
    default = _rounded(value)
    if factor:
        low, high = sorted((_rounded(default / factor), _rounded(default * factor)))
    else:
        move = _rounded(move) or 1e-12
        low, high = default - move, default + move
    return EffectParameter(unit, default, default, low, high, description)


def _rounded(value: float) -> float:
    """To 5 significant digits."""
    return float(f"{value:.5g}")
