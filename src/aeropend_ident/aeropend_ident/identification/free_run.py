# SPDX-License-Identifier: Apache-2.0
"""Free runs of a sparse model and their sensitivities, compiled.

A model is dx/dt = Σ c f(x, u) over entries (equation, term, coefficient). The inputs u are held from sample to sample.
Runge-Kutta steps of fourth order integrate the states and, for sensitivities, their transition matrix.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from aeropend_ident.identification.terms import Array, Indices, Table, terms_at
from aeropend_sim.compiled import njit


class RightHandSide(NamedTuple):
    """The right-hand side of a model, for compiled code.

    Attributes:
        used: the terms of its entries, each once.
        table: the terms of the library.
        equation: (E,) the equation of each entry.
        term: (E,) the term of each entry.
        coefficient: (E,) the coefficient of each entry.
    """

    used: Indices
    table: Table
    equation: Indices
    term: Indices
    coefficient: Array


class Wanted(NamedTuple):
    """Coefficients with respect to which a run is differentiated, and the states whose derivatives are kept.

    Attributes:
        terms: the terms of the coefficients, each once.
        equation: (P,) the equation of each coefficient.
        term: (P,) the term of each coefficient.
        states: (O,) indices of the states.
    """

    terms: Indices
    equation: Indices
    term: Indices
    states: Indices


class _Workspace(NamedTuple):
    """Arrays that `_advance` works in; for a run without sensitivities all but x, value, rate and total have no rows.

    Attributes:
        x: (variables,) the states, then the inputs; the caller fills the inputs in.
        value: (terms,) the terms at x.
        slope: (terms, variables) their derivatives.
        rate: (n,) the right-hand side.
        total: (n,) change of the state over a step.
        jacobian: (n, n) derivative of the right-hand side by the states.
        turn, now, moved: (n, n) as total, x and rate, for the transition matrix.
    """

    x: Array
    value: Array
    slope: Array
    rate: Array
    total: Array
    jacobian: Array
    turn: Array
    now: Array
    moved: Array


@njit(cached=False, inline="always", error_model="numpy")  # inlined for the same reason as the terms
def _rates(model: RightHandSide, n: int, w: _Workspace) -> None:
    """Compute the right-hand side and, where slope has rows, its Jacobian at the variables x."""
    terms_at(w.x, model.used, model.table, w.value, w.slope)
    with_slope = w.slope.shape[0] > 0
    for i in range(n):
        w.rate[i] = 0.0
        if with_slope:
            for k in range(n):
                w.jacobian[i, k] = 0.0
    for k in range(len(model.coefficient)):
        w.rate[model.equation[k]] += model.coefficient[k] * w.value[model.term[k]]
        if with_slope:
            for i in range(n):
                w.jacobian[model.equation[k], i] += model.coefficient[k] * w.slope[model.term[k], i]


@njit(error_model="numpy", nogil=True)
def _advance(y: Array, phi: Array, s: float, steps: int, model: RightHandSide, w: _Workspace) -> None:
    """Advance a state by Runge-Kutta steps of fourth order.

    Args:
        y: (n,) the state; it is replaced.
        phi: (n, n) its derivatives, replaced as well; without rows, they are left out.
        s: [s] length of a step.
        steps: number of steps.
        model: the right-hand side.
        w: room to work in, with the inputs in x.
    """
    n, m = len(y), phi.shape[0]
    for _ in range(steps):
        for i in range(n):
            w.x[i] = y[i]
            w.total[i] = 0.0
        for i in range(m):
            for k in range(m):
                w.now[i, k] = phi[i, k]
                w.turn[i, k] = 0.0
        for stage in range(4):
            _rates(model, n, w)
            weight = s / 3.0 if stage in (1, 2) else s / 6.0
            ahead = s if stage == 2 else 0.5 * s
            for i in range(n):
                w.total[i] += weight * w.rate[i]
                w.x[i] = y[i] + ahead * w.rate[i]
            for i in range(m):
                for k in range(m):
                    w.moved[i, k] = 0.0
                for q in range(m):
                    a = w.jacobian[i, q]
                    if a != 0.0:  # few states act on a state
                        for k in range(m):
                            w.moved[i, k] += a * w.now[q, k]
            for i in range(m):
                for k in range(m):
                    w.turn[i, k] += weight * w.moved[i, k]
                    w.now[i, k] = phi[i, k] + ahead * w.moved[i, k]
        for i in range(n):
            y[i] += w.total[i]
        for i in range(m):
            for k in range(m):
                phi[i, k] += w.turn[i, k]


@njit(error_model="numpy", nogil=True)
def run(x0: Array, u: Array, h: float, steps: int, model: RightHandSide, low: Array, high: Array, out: Array) -> bool:
    """Run a model over the samples of its inputs.

    Args:
        x0: (n,) initial state.
        u: (N, inputs) inputs, held from sample to sample.
        h: [s] sample period.
        steps: integration steps per sample.
        model: the right-hand side.
        low: (n,) lower limit of the states.
        high: (n,) upper limit of the states.
        out: (N, n) receives the states.

    Returns:
        False when a state leaves its limits; the run ends there.
    """
    n = len(x0)
    none = np.empty((0, 0))
    w = _Workspace(np.empty(n + u.shape[1]), np.empty(len(model.table.first) - 1), none, np.empty(n), np.empty(n), none,
                   none, none, none)
    y = x0.copy()
    for k in range(len(u)):
        for i in range(n):
            out[k, i] = y[i]
        for i in range(u.shape[1]):
            w.x[n + i] = u[k, i]
        _advance(y, none, h / steps, steps, model, w)
        for i in range(n):
            if not low[i] < y[i] < high[i]:
                return False
    return True


@njit(error_model="numpy", nogil=True)
def sensitivities(states: Array, u: Array, h: float, steps: int, model: RightHandSide, wanted: Wanted, carry: Array,
                  out: Array) -> None:
    """Differentiate the states of a run with respect to coefficients and initial states.

    Simpson's rule integrates the effect of each coefficient over a sample.

    Args:
        states: (N, n) the run.
        u: (N, inputs) its inputs.
        h: [s] sample period.
        steps: integration steps per sample; even.
        model: the right-hand side.
        wanted: the P coefficients, and the O states whose derivatives are kept.
        carry: (n, P + I) derivatives at the first sample, for I initial states; replaced by those after the last one.
        out: (N, O, P + I) receives the derivatives.
    """
    n, columns, params = states.shape[1], carry.shape[1], len(wanted.term)
    terms, variables = len(model.table.first) - 1, states.shape[1] + u.shape[1]
    w = _Workspace(np.empty(variables), np.empty(terms), np.empty((terms, variables)), np.empty(n), np.empty(n),
                   np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty((n, n)))
    none = np.empty((0, 0))
    f0, fm, f1 = np.zeros(terms), np.zeros(terms), np.zeros(terms)
    first, second, whole, y = np.empty((n, n)), np.empty((n, n)), np.empty((n, n)), np.empty(n)
    new = np.empty_like(carry)
    half = steps // 2
    for k in range(len(u)):
        for o in range(len(wanted.states)):
            for p in range(columns):
                out[k, o, p] = carry[wanted.states[o], p]
        for i in range(n):
            y[i] = w.x[i] = states[k, i]
            for q in range(n):
                first[i, q] = second[i, q] = 1.0 if i == q else 0.0
        for i in range(u.shape[1]):
            w.x[n + i] = u[k, i]
        terms_at(w.x, wanted.terms, model.table, f0, none)
        _advance(y, first, h / steps, half, model, w)
        for i in range(n):
            w.x[i] = y[i]
        terms_at(w.x, wanted.terms, model.table, fm, none)
        _advance(y, second, h / steps, half, model, w)
        for i in range(n):
            w.x[i] = y[i]
        terms_at(w.x, wanted.terms, model.table, f1, none)
        for i in range(n):
            for q in range(n):
                whole[i, q] = 0.0
                for r in range(n):
                    whole[i, q] += second[i, r] * first[r, q]
        for i in range(n):
            for p in range(params):
                e, t = wanted.equation[p], wanted.term[p]
                push = whole[i, e] * f0[t] + 4.0 * second[i, e] * fm[t]
                if i == e:
                    push += f1[t]
                new[i, p] = h / 6.0 * push
            for p in range(params, columns):
                new[i, p] = 0.0
            for q in range(n):
                a = whole[i, q]
                if a != 0.0:
                    for p in range(columns):
                        new[i, p] += a * carry[q, p]
        carry[:, :] = new
