# SPDX-License-Identifier: Apache-2.0
"""Many nominal models against one recording, on every core and side by side in the lanes of SIMD instructions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from aeropend_sim.compiled import equation, njit
from aeropend_sim.model.coefficients import Coefficients, prepare, steps_in
from aeropend_sim.model.dynamics import advance
from aeropend_sim.model.effects import PARAMETER_MISMATCH, is_active
from aeropend_sim.model.lag import Lag
from aeropend_sim.model.parameters import DUTY_MAP, SAMPLE_PERIOD, Model
from aeropend_sim.model.state import State
from aeropend_sim.model.terms import EMPTY

Array = NDArray[np.float64]

LANES = 16
"""Models that advance side by side. A choice."""


class _Rows(NamedTuple):
    """Rows of a block of models: of each quantity the only or the first one.

    `winding` and `rotor` have as many rows as `Lag` has fields, in their order, and `errors` has four: θ, ω, i_a, v_a.
    """

    h: int
    winding: int
    rotor: int
    per_L: int
    K_e: int
    torque: int
    load: int
    drag: int
    k_thrust: int
    gravity: int
    damping: int
    lever: int
    k0: int
    k1: int
    k2: int
    k3: int
    i_a: int
    omega: int
    theta: int
    theta_dot: int
    thrust: int
    errors: int
    voltage: int
    height: int


_HEIGHTS = {"winding": len(Lag._fields), "rotor": len(Lag._fields), "errors": 4}
ROW = _Rows(*(sum(_HEIGHTS.get(name, 1) for name in _Rows._fields[:at]) for at in range(len(_Rows._fields))))

_LAGS = ("winding", "rotor")
_SCALARS = ("h", "per_L", "K_e", "torque", "load", "drag", "k_thrust", "gravity", "damping", "lever")
_STATE = ("i_a", "omega", "theta", "theta_dot", "thrust")


@equation
def _lag(a: Array, row: int, j: int) -> Lag:
    n = LANES
    at = row * n + j
    return Lag(a[at], a[at + n], a[at + 2 * n], a[at + 3 * n], a[at + 4 * n], a[at + 5 * n], a[at + 6 * n],
               a[at + 7 * n])


@equation
def _coefficients(a: Array, j: int) -> Coefficients:
    n = LANES
    return Coefficients(
        1, a[ROW.h * n + j], _lag(a, ROW.winding, j), _lag(a, ROW.rotor, j), a[ROW.per_L * n + j], a[ROW.K_e * n + j],
        a[ROW.torque * n + j], a[ROW.load * n + j], a[ROW.drag * n + j], a[ROW.k_thrust * n + j],
        a[ROW.gravity * n + j], a[ROW.damping * n + j], a[ROW.lever * n + j])


@equation
def _state(a: Array, j: int) -> State:
    n = LANES
    return State(a[ROW.i_a * n + j], a[ROW.omega * n + j], 0.0, a[ROW.theta * n + j], a[ROW.theta_dot * n + j],
                 a[ROW.thrust * n + j], 0.0, 0.0, 0.0, 0.0, 0.0, EMPTY)


@equation
def _advance_lane(a: Array, j: int, state: State, v: float) -> None:
    n = LANES
    after = advance(state, v, _coefficients(a, j), None, None, None)
    a[ROW.i_a * n + j] = after.i_a
    a[ROW.omega * n + j] = after.omega
    a[ROW.theta * n + j] = after.theta
    a[ROW.theta_dot * n + j] = after.theta_dot
    a[ROW.thrust * n + j] = after.thrust


@njit(parallel=True)
def _squared_errors(duty: Array, measured: Array, steps: int, table: Array) -> None:
    """Advance the blocks of models and sum their errors.

    Args:
        duty: (N,) 0..1, held.
        measured: (4, N) θ, ω, i_a, v_a.
        steps: steps of each hold.
        table: (B, rows of a block x `LANES`) blocks. Row r of model j is at r LANES + j, so that the models of a block
            are the lanes of SIMD instructions. The rows `errors` are filled.
    """
    n = LANES
    for block in prange(table.shape[0]):
        a = table[block]
        for k in range(duty.shape[0]):
            if k == 0 or duty[k] != duty[k - 1]:
                for j in range(n):
                    root = math.sqrt(a[ROW.k2 * n + j] * duty[k] + a[ROW.k3 * n + j])
                    a[ROW.voltage * n + j] = max(0.0, a[ROW.k0 * n + j] + a[ROW.k1 * n + j] * root)
            theta, omega, i_a, v_a = measured[0, k], measured[1, k], measured[2, k], measured[3, k]
            for j in range(n):
                v = a[ROW.voltage * n + j]
                x = _state(a, j)
                a[ROW.errors * n + j] += (x.theta - theta) * (x.theta - theta)
                a[(ROW.errors + 1) * n + j] += (x.omega - omega) * (x.omega - omega)
                a[(ROW.errors + 2) * n + j] += (x.i_a - i_a) * (x.i_a - i_a)
                a[(ROW.errors + 3) * n + j] += (v - v_a) * (v - v_a)
                _advance_lane(a, j, x, v)
            for _ in range(steps - 1):
                for j in range(n):
                    _advance_lane(a, j, _state(a, j), a[ROW.voltage * n + j])


def squared_errors(models: Sequence[Model], duty: Array, measured: Array, period: float = SAMPLE_PERIOD,
                   states: Sequence[State] | None = None) -> Array:
    """Sums of squared errors of many nominal models against one recording, on every core.

    Args:
        models: M models; of their effects only `parameter_mismatch` is allowed, of their duty maps that of k0 to k3.
        duty: (N,) 0..1, held.
        measured: (4, N) θ, ω, i_a, v_a in SI units, without NaN.
        period: [s] time between samples.
        states: M states at the first sample; at rest by default.

    Returns:
        (M, 4) sums over the samples.

    Raises:
        ValueError: a model has effects.
    """
    if any(id_ != PARAMETER_MISMATCH and is_active(id_, p) for model in models for id_, p in model.effects.items()):
        raise ValueError("squared_errors simulates nominal models only; use simulate for effects")
    blocks = -(-len(models) // LANES)
    steps = max((steps_in(model, period) for model in models), default=1)
    rows = np.zeros((blocks * LANES, ROW.height))
    for j in range(len(rows)):
        m = min(j, len(models) - 1)  # the last block is filled up with the last model
        _fill(rows[j], models[m], prepare(models[m], period, steps)[0], states[m] if states is not None else State())
    table = np.ascontiguousarray(rows.reshape(blocks, LANES, ROW.height).transpose(0, 2, 1))
    _squared_errors(np.ascontiguousarray(duty, dtype=float), np.ascontiguousarray(measured, dtype=float), steps,
                    table.reshape(blocks, ROW.height * LANES))
    return table[:, ROW.errors:ROW.errors + 4].transpose(0, 2, 1).reshape(-1, 4)[:len(models)]


def _fill(rows: Array, model: Model, coefficients: Coefficients, state: State) -> None:
    """Write one model into its rows (R,)."""
    numbers = model.numbers()
    for name in _LAGS:
        at = getattr(ROW, name)
        rows[at:at + len(Lag._fields)] = getattr(coefficients, name)
    for names, source in ((_SCALARS, coefficients._asdict()), (DUTY_MAP, numbers), (_STATE, state._asdict())):
        for name in names:
            rows[getattr(ROW, name)] = source[name]
