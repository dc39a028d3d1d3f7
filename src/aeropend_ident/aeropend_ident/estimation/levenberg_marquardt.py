# SPDX-License-Identifier: Apache-2.0
"""A Levenberg-Marquardt search for the MAP estimate; `map_fit` has the cost.

Steps end at the bounds, follow curved valleys, and correct the derivatives while the model is nearly linear.
`scipy.optimize.least_squares` with the same residuals, Jacobian and weights ends at the same cost and takes 2.5 to 3
times the CPU time (`make bench ARGS="--only optimiser"`): it restarts whenever the weights are renewed, and solves for
the bounds more exactly than is needed here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.estimation.deadline import passed
from aeropend_ident.estimation.parameter import Parameter, key, prior_information
from aeropend_ident.estimation.residuals import Residuals, Sensitivities, finite, weights

Array = NDArray[np.float64]

Products = dict[str, tuple[NDArray[np.intp], Array]]
"""Channel -> indices (P,) of the parameters that change it, and the products (P, P) of their sensitivities."""

STEP = 1e-4
"""Step of the finite differences, in standard deviations of the prior.

Choice: well above rounding, well below curvature."""

DAMPING, DAMPING_DOWN, DAMPING_UP, MOST_DAMPING = 1e-3, 0.2, 8.0, 1e6
"""Levenberg-Marquardt damping: first value, factors after a step that succeeds and one that fails, and where it ends.

Choice; any factors from 0.1 and 10 on lead to the same minimum."""

GOOD_STEP = 0.75
"""Share of the expected decrease below which the derivatives are computed anew, rather than corrected (choice)."""

STEADY = 0.1
"""Relative change of a derivative over a step, once it is corrected, up to which it is not computed anew.

Choice: a fit ends only with all derivatives computed anew. Measured: a fit with 46 parameters, most of them points of a
curve, ends at the same cost in half the time; with 0.03 and 0.3 it takes longer."""

ALONG = 0.2
"""Share of a step over which the second derivative along it is taken (choice: its source takes 0.1 to each side)."""

ENOUGH, ENOUGH_OF_EXCESS = 1e-2, 1e-4
"""Decrease of the cost below which the search stops: absolute, and relative to the cost above that of noise.

Choice: the cost is twice a log density, and a difference of 1 hardly decides between two hypotheses."""

FEWEST_STEADY = 16
"""Number of derivatives that must stay, so that the others alone are computed anew.

Choice: the points of a learned curve. It saves so many runs each time, and costs as many as there are parameters at the
end of a fit."""

NONE: Mapping[str, Sensitivities] = {}
"""No derivatives."""

TINY = 1e-300
"""Least size that is divided by (derived: above 0, below any derivative)."""


class _Trial(NamedTuple):
    """A point (P,) in standard units with its residuals and its cost."""

    z: Array
    residuals: dict[str, Array]
    cost: float


class Search:
    """A point in the space of the parameters, in standard units, with its residuals and their weights.

    Args:
        residuals: values by name -> residuals in units of a reading's noise.
        parameters: to be fitted.
        least_ess: effective sample size that a channel counts for at least.
    """

    def __init__(self, residuals: Callable[[dict[str, float]], Residuals], parameters: Sequence[Parameter],
                 least_ess: float = 0.0) -> None:
        self.residuals, self.parameters, self.least_ess = residuals, tuple(parameters), least_ess
        self.low = np.array([p.to_standard(p.low) for p in parameters])
        self.high = np.array([p.to_standard(p.high) for p in parameters])
        self.z = np.array([p.to_standard(p.begin) for p in parameters])
        self.z = np.clip(self.z, self.low, self.high)
        self.prior = prior_information(parameters)
        self.current = self.at(self.z)
        self.slopes: dict[str, Sensitivities] = {}
        self.steady = np.zeros(len(self.z), bool)
        self.due = True  # whether derivatives are computed before the next step
        self.fresh = self.whole = False  # whether derivatives were computed at this point; all of them
        self.ended = False
        self.renew_weights()

    def at(self, z: Array) -> dict[str, Array]:
        """Residuals at a point z (P,) in standard units."""
        values = {p.name: p.value(x) for p, x in zip(self.parameters, z.tolist(), strict=True)}
        return {k: finite(np.asarray(r)) for k, r in self.residuals(values).items() if len(r)}

    def renew_weights(self) -> None:
        """Set noise inflation and effective sample size to those of the residuals at this point."""
        self.weight, self.scale, self.ess = weights(self.current, self.least_ess)

    def stack(self, residuals: Residuals) -> Array:
        """Weighted residuals of all channels as one vector."""
        return np.concatenate([self.weight[k] * residuals[k] for k in self.weight] or [np.zeros(0)])

    def renew_slopes(self) -> None:
        """Compute derivatives anew at this point; those that are steady stay as they were corrected.

        A derivative is steady if computing it anew the last time changed it by less than `STEADY`.
        """
        before, self.fresh, self.whole = self.slopes, True, not self.steady.any()
        self.slopes = self.differences(kept=before)
        if before:
            changed = np.zeros(len(self.z))
            for k, s in self.slopes.items():
                off = np.linalg.norm(s.rows - before[k].rows, axis=1) / np.maximum(np.linalg.norm(s.rows, axis=1), TINY)
                changed[s.by] = np.maximum(changed[s.by], off)
            stay = changed < STEADY
            self.steady = stay & (stay.sum() >= FEWEST_STEADY)

    def jacobian(self) -> dict[str, Sensitivities]:
        """Derivatives of the weighted residuals, by finite differences."""
        return self.weighted(self.differences())

    def weighted(self, slopes: Mapping[str, Sensitivities]) -> dict[str, Sensitivities]:
        """Derivatives of the weighted residuals from those of the residuals."""
        return {k: Sensitivities(s.by, self.weight[k] * s.rows) for k, s in slopes.items()}

    def differences(self, kept: Mapping[str, Sensitivities] = NONE) -> dict[str, Sensitivities]:
        """Derivatives of the residuals, by finite differences towards the inside of the bounds.

        Args:
            kept: derivatives of which those that are steady are taken as they are.
        """
        moves = np.where(self.z + STEP > self.high, -STEP, STEP)
        return self._differences(self.z + moves, None, moves, kept)

    def slopes_over(self, sd: Array) -> dict[str, Sensitivities]:
        """Slopes of the residuals from one standard deviation below to one above, for each parameter.

        Args:
            sd: (P,) standard deviations in standard units.
        """
        after, before = np.minimum(self.z + sd, self.high), np.maximum(self.z - sd, self.low)
        return self._differences(after, before, after - before)

    def _differences(self, after: Array, before: Array | None, moves: Array,
                     kept: Mapping[str, Sensitivities] = NONE) -> dict[str, Sensitivities]:
        """Differences of the residuals over those of each parameter, which is moved alone.

        A parameter that each recording has a value of its own for is moved in all recordings at once.

        Args:
            after: (P,) value of each parameter where it is moved.
            before: (P,) the same, of the residuals that are subtracted; None: those at this point.
            moves: (P,) what each parameter is moved by.
            kept: see `differences`.
        """
        groups: dict[str, dict[int, int]] = {}
        for j, p in enumerate(self.parameters):
            name = key(p.name)
            groups.setdefault(name.plain, {})[name.recording] = j
        by = {k: [g.get(key(k).recording, g.get(0, -1)) for g in groups.values()] for k in self.weight}
        slopes = {}
        for k, each in by.items():
            own = np.array([j for j in each if j >= 0], int)
            slopes[k] = Sensitivities(own, np.empty((len(own), len(self.current[k]))))
        left = {k: len(s.by) for k, s in slopes.items()}
        # the last ones first: those of a reading come last, and need no run but that at this point, which is known
        for at, group in reversed(list(enumerate(groups.values()))):
            keep = bool(kept) and self.steady[list(group.values())].all()
            if not keep:
                moved = self._with(group, after)
                still = self.current if before is None else self._with(group, before)
            for k, s in slopes.items():
                if (j := by[k][at]) >= 0:
                    left[k] -= 1
                    s.rows[left[k]] = kept[k].rows[left[k]] if keep else (moved[k] - still[k]) / moves[j]
        return slopes

    def _with(self, group: Mapping[int, int], values: Array) -> dict[str, Array]:
        """Residuals with some parameters at other values."""
        z, own = self.z.copy(), list(group.values())
        z[own] = values[own]
        return self.at(z)

    def stacked(self, slopes: Mapping[str, Sensitivities]) -> Array:
        """The derivatives of all channels as one matrix, one row a parameter."""
        out, at = np.zeros((len(self.z), sum(s.rows.shape[1] for s in slopes.values()))), 0
        for s in slopes.values():
            out[s.by, at:at + s.rows.shape[1]] = s.rows
            at += s.rows.shape[1]
        return out

    def normal_equations(self, slopes: Mapping[str, Sensitivities]) -> tuple[Array, Array, Products]:
        """Information matrix (P, P) and gradient (P,) of half the cost, prior included; and what `Fit` keeps."""
        information, gradient = self.prior.copy(), self.prior @ self.z
        products: dict[str, tuple[NDArray[np.intp], Array]] = {}
        for k, s in slopes.items():
            of_all = s.rows @ s.rows.T
            information[np.ix_(s.by, s.by)] += of_all
            gradient[s.by] += s.rows @ (self.weight[k] * self.current[k])
            products[k] = (s.by, of_all / self.weight[k] ** 2)
        return information, gradient, products

    def step(self, damped: Array, gradient: Array) -> Array:
        """The step (P,) to the minimum of a damped quadratic model within the bounds.

        A parameter that is pushed against its bound stays, one that would cross it ends there. The step of the others
        is the best one with that: a step that is computed without bounds and then clipped is wrong for all others.

        Args:
            damped: information matrix (P, P) with damping.
            gradient: (P,) of half the cost.
        """
        free = ~((self.z <= self.low) & (gradient > 0.0) | (self.z >= self.high) & (gradient < 0.0))
        step = np.zeros(len(self.z))
        while free.any():
            held = ~free
            step[free] = np.linalg.solve(damped[np.ix_(free, free)],
                                         -gradient[free] - damped[np.ix_(free, held)] @ step[held])
            inside = np.clip(self.z + step, self.low, self.high) - self.z
            crossed = free & (inside != step)
            if not crossed.any():
                break
            step[crossed] = inside[crossed]
            free &= ~crossed
        return step

    def bent(self, step: Array, damped: Array) -> Array:
        """A step with geodesic acceleration, which follows a curved valley.

        The second derivative of the residuals along the step adds half of what it changes (M. Transtrum and J. Sethna,
        Improvements to the Levenberg-Marquardt algorithm, arXiv:1201.5885, 2012).

        Args:
            step: (P,) the straight one.
            damped: information matrix (P, P) with damping.
        """
        near, far = self.at(self.z + 0.5 * ALONG * step), self.at(self.z + ALONG * step)
        bend = np.zeros(len(step))
        for k, s in self.slopes.items():
            second = (self.current[k] - 2.0 * near[k] + far[k]) / (0.5 * ALONG)**2
            bend[s.by] += self.weight[k]**2 * s.rows @ second
        moved = step != 0.0
        out = step.copy()
        out[moved] -= 0.5 * np.linalg.solve(damped[np.ix_(moved, moved)], bend[moved])
        return out

    def _tried(self, step: Array) -> _Trial:
        """The point after a step, its residuals and its cost."""
        z = np.clip(self.z + step, self.low, self.high)
        residuals = self.at(z)
        r = self.stack(residuals)
        return _Trial(z, residuals, float(r @ r + z @ self.prior @ z))

    def improve(self, steps: int, deadline: float | None = None, *, first_look: bool = False) -> Products:
        """Take Levenberg-Marquardt steps with the weights as they are.

        Args:
            steps: at most.
            deadline: after it, only one; see `passed`.
            first_look: see `fit`.

        Returns:
            Products of the last `normal_equations`.
        """
        damping, products = DAMPING, Products()
        for done in range(steps):
            if done and passed(deadline):
                break
            if self.due:
                self.renew_slopes()
                self.due = False
            r = self.stack(self.current)
            information, gradient, products = self.normal_equations(self.weighted(self.slopes))
            cost = float(r @ r + self.z @ self.prior @ self.z)
            enough = ENOUGH + ENOUGH_OF_EXCESS * max(cost - sum(self.ess.values()), 0.0)
            gained, straight, bent = 0.0, True, False
            while damping < MOST_DAMPING:
                damped = information + damping * np.diag(np.diag(information))
                step = self.step(damped, gradient)
                trial = self._tried(step)
                expected = -float(step @ (2.0 * gradient + information @ step))
                straight = cost - trial.cost >= GOOD_STEP * expected
                bent = self.fresh and not straight and expected > enough
                if bent:
                    trial = min(trial, self._tried(self.bent(step, damped)), key=lambda one: one.cost)
                if trial.cost < cost:
                    gained, moved = cost - trial.cost, trial.z - self.z
                    self.slopes = {k: s.corrected(moved, trial.residuals[k] - self.current[k])
                                   for k, s in self.slopes.items()}
                    self.z, self.current = trial.z, trial.residuals
                    damping *= DAMPING_DOWN
                    break
                if not self.fresh:
                    break
                damping *= DAMPING_UP
            ended = gained < enough
            self.ended = ended and (self.whole or first_look) and not bent
            if self.ended:
                break
            self.due = ended or not straight
            if ended and self.fresh:  # all derivatives confirm the end
                self.steady[:] = False
            self.fresh = self.whole = False
        return products
