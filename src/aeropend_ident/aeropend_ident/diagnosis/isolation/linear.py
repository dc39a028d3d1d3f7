# SPDX-License-Identifier: Apache-2.0
"""The stages of a cut chain, linear in the parameters of the model and in the sizes of effects.

What a stage leaves of a planned recording is noise. An effect adds its signature: the change of the residual that the
effect makes at its size, by one simulation. A fit of parameters and effects is then linear algebra: the MAP fit of
`estimation.map_fit` (weights, priors, bounds, log evidence), without further simulations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.chain import CutChains
from aeropend_ident.diagnosis.chain.priors import nominal_parameters
from aeropend_ident.diagnosis.chain.values import STAGES
from aeropend_ident.estimation.bounded_fit import sensitivities
from aeropend_ident.estimation.map_fit import WEIGHT_CHANGE, Fit, covariance_of
from aeropend_ident.estimation.parameter import Parameter, key
from aeropend_ident.estimation.residuals import Residuals, weights

Array = NDArray[np.float64]

ROUNDS = 4
"""Rounds in which the weights of a linear fit are renewed at most (choice: they hardly change after the second)."""


@dataclass(frozen=True)
class Column:
    """One direction in which a hypothesis changes the residuals.

    Attributes:
        rows: channel -> (N,) change by one standard deviation of the prior, of channels that it changes.
        low: lower bound, in standard deviations.
        high: upper bound.
    """

    rows: Residuals
    low: float = -np.inf
    high: float = np.inf


class Products(NamedTuple):
    """The rows of one channel (N,).

    Attributes:
        by: (P,) indices of the columns that change it.
        rows: (P, N).
        products: (P, P) of the rows.
    """

    by: NDArray[np.intp]
    rows: Array
    products: Array


class LinearStages:
    """The stages of the cut chain of one planned recording, at the nominal values.

    Args:
        chains: cut, of a recording of a rig that is like the model.
        stages: that are looked at.
    """

    def __init__(self, chains: CutChains, stages: Sequence[str] = tuple(STAGES)) -> None:
        self.chains = chains
        self.parameters: list[Parameter] = []
        self.noise: dict[str, Array] = {}
        self.stage_of: dict[str, str] = {}
        self._columns: list[Column] = []
        for stage in stages:
            of, own = chains.residuals(stage), nominal_parameters(chains, stage)
            left = of({p.name: p.mean for p in own})
            if not left:
                continue
            slopes = sensitivities(of, own)
            self.noise |= left
            self.stage_of |= dict.fromkeys(left, stage)
            for j, p in enumerate(own):
                rows = {c: s.rows[list(s.by).index(j)] for c, s in slopes.items() if j in s.by}
                self.parameters.append(p)
                self._columns.append(Column({c: x for c, x in rows.items() if x.any()}, p.to_standard(p.low),
                                            p.to_standard(p.high)))

    @property
    def stages(self) -> list[str]:
        """The stages with a measured channel."""
        return list(dict.fromkeys(self.stage_of.values()))

    def change(self, values: Mapping[str, float], stages: Sequence[str]) -> Residuals:
        """Channel -> (N,) change of the residuals by some values, in some stages; unchanged channels are left out."""
        out: dict[str, Array] = {}
        for stage in stages:
            own = {p.name: p.mean for p in nominal_parameters(self.chains, stage)}
            before = {c: x for c, x in self.noise.items() if self.stage_of[c] == stage}
            if before:
                after = self.chains.residuals(stage)({**own, **values})
                out |= {c: after[c] - x for c, x in before.items() if not np.array_equal(after[c], x)}
        return out

    def of_rig(self, z: Array) -> Residuals:
        """Channel -> (N,) residuals of a rig whose numbers are off by z (P,), in standard deviations; with noise."""
        off = np.where([key(p.name).is_initial for p in self.parameters], 0.0, z)
        return {c: e - off[self.products[c].by] @ self.products[c].rows for c, e in self.noise.items()}

    def column_of(self, name: str) -> Column:
        """The column of a nominal parameter."""
        return self._columns[[p.name for p in self.parameters].index(name)]

    @cached_property
    def products(self) -> dict[str, Products]:
        """Channel -> the rows of the nominal parameters, and their products."""
        found = {}
        for c in self.noise:
            by = np.array([j for j, column in enumerate(self._columns) if c in column.rows], np.intp)
            rows = np.array([self._columns[j].rows[c] for j in by]).reshape(len(by), len(self.noise[c]))
            found[c] = Products(by, rows, rows @ rows.T)
        return found

    def fit(self, r: Mapping[str, Array], own: Sequence[Column] = (), *, instead: str = "") -> Fit:
        """The MAP fit of the nominal parameters, and of a hypothesis, to residuals (see `map_fit.fit`).

        Args:
            r: channel -> (N,) at the nominal values.
            own: columns of the hypothesis.
            instead: name of a nominal parameter that the hypothesis fits in its own way.
        """
        size, more = len(self._columns), len(own)
        low = np.array([c.low for c in (*self._columns, *own)])
        high = np.array([c.high for c in (*self._columns, *own)])
        if instead:
            k = [p.name for p in self.parameters].index(instead)
            low[k] = high[k] = 0.0
        slopes: dict[str, Products] = {}
        for c in r:
            by, rows, products = self.products[c]
            extra = [j for j, column in enumerate(own) if c in column.rows]
            if extra:
                new = np.array([own[j].rows[c] for j in extra])
                cross = rows @ new.T
                products = np.block([[products, cross], [cross.T, new @ new.T]])
                by, rows = np.concatenate([by, size + np.array(extra, np.intp)]), np.vstack([rows, new])
            slopes[c] = Products(by, rows, products)
        pulls = {c: rows @ r[c] for c, (_, rows, _) in slopes.items()}
        z, left = np.zeros(size + more), dict(r)
        weight, scale, ess = weights(left)
        information = np.eye(size + more)
        for _ in range(ROUNDS):
            information, gradient = np.eye(size + more), np.zeros(size + more)
            for c, (by, _, products) in slopes.items():
                information[np.ix_(by, by)] += weight[c] ** 2 * products
                gradient[by] += weight[c] ** 2 * pulls[c]
            z = bounded(information, -gradient, low, high)
            left = {c: r[c] + z[by] @ rows for c, (by, rows, _) in slopes.items()}
            before = weight
            weight, scale, ess = weights(left)
            if all(abs(weight[c] - before[c]) < WEIGHT_CHANGE * before[c] for c in weight):
                break
        names = [*(p.name for p in self.parameters), *(f"own{j}" for j in range(more))]
        sd = np.sqrt(np.diag(covariance_of(information)))
        return Fit(dict(zip(names, z.tolist(), strict=True)), dict(zip(names, sd.tolist(), strict=True)), left, scale,
                   ess, -0.5 * float(z @ z), {c: (by, products) for c, (by, _, products) in slopes.items()},
                   np.eye(size + more))


class Screening:
    """How much of residuals each of many alternatives would explain, from one linear solve (as `map_fit.screen`).

    Args:
        linear: the stages.
        alternatives: of one or two columns each.
    """

    def __init__(self, linear: LinearStages, alternatives: Sequence[Sequence[Column]]) -> None:
        self.linear = linear
        columns = list({id(c): c for own in alternatives for c in own}.values())
        place = {id(c): k for k, c in enumerate(columns)}
        self.first = np.array([place[id(own[0])] for own in alternatives], np.intp)
        self.last = np.array([place[id(own[-1])] for own in alternatives], np.intp)
        self.low, self.high = np.array([c.low for c in columns]), np.array([c.high for c in columns])
        self._of: dict[str, tuple[NDArray[np.intp], NDArray[np.float32], Array, Array, Array]] = {}
        for c in linear.noise:
            mine = np.array([k for k, column in enumerate(columns) if c in column.rows], np.intp)
            if len(mine):
                rows = np.array([columns[k].rows[c] for k in mine], np.float32)
                whole = np.full(len(columns), -1)
                whole[mine] = np.arange(len(mine))
                a, b = whole[self.first], whole[self.last]
                pairs = np.where((a >= 0) & (b >= 0), np.einsum("kn,kn->k", rows[a], rows[b]), 0.0)
                self._of[c] = (mine, rows, linear.products[c].rows @ rows.T, np.einsum("kn,kn->k", rows, rows), pairs)

    def explained(self, r: Mapping[str, Array], base: Fit) -> Array:
        """(A,) What each alternative takes off the weighted sum of squares.

        Args:
            r: channel -> (N,) at the nominal values.
            base: the fit without it, which gives the weights.
        """
        size, many = len(self.linear.parameters), len(self.low)
        information, gradient = np.eye(size), np.zeros(size)
        cross, pull, square, pairs = np.zeros((size, many)), np.zeros(many), np.ones(many), np.zeros(len(self.first))
        for c, x in r.items():
            w = min(base.ess[c] / len(x), 1.0) / base.scale[c] ** 2
            own = self.linear.products[c]
            information[np.ix_(own.by, own.by)] += w * own.products
            gradient[own.by] -= w * (own.rows @ x)
            if c in self._of:
                mine, rows, with_known, squares, products = self._of[c]
                cross[np.ix_(own.by, mine)] += w * with_known
                pull[mine] -= w * (rows @ x.astype(np.float32))
                square[mine] += w * squares
                pairs += w * products
        solved = np.linalg.solve(information, np.column_stack([cross, gradient]))
        pull = pull - cross.T @ solved[:, -1]
        square = square - np.sum(cross * solved[:, :-1], axis=0)
        z = np.clip(pull / square, self.low, self.high)
        alone = 2.0 * z * pull - z * z * square
        i, j = self.first, self.last
        best = np.maximum(alone[i], alone[j])
        off = pairs - np.sum(cross[:, i] * solved[:, j], axis=0)
        determinant = square[i] * square[j] - off * off
        with np.errstate(divide="ignore", invalid="ignore"):
            a = (square[j] * pull[i] - off * pull[j]) / determinant
            b = (square[i] * pull[j] - off * pull[i]) / determinant
            both = a * pull[i] + b * pull[j]
        inside = (i != j) & (determinant > 0.0) & (a >= self.low[i]) & (b >= self.low[j]) & (a <= self.high[i]) & (
            b <= self.high[j])
        return np.where(inside, np.maximum(both, best), best)


def bounded(information: Array, gradient: Array, low: Array, high: Array) -> Array:
    """The z (P,) that solves `information z = gradient`, with what would leave its bounds held at them (active set)."""
    held = low >= high
    z = np.where(held, low, 0.0)
    for _ in range(len(z)):
        free = ~held
        z[free] = np.linalg.solve(information[np.ix_(free, free)],
                                  gradient[free] - information[np.ix_(free, held)] @ z[held])
        out = free & ((z < low) | (z > high))
        if not out.any():
            break
        z = np.where(out, np.clip(z, low, high), z)
        held = held | out
    return z
