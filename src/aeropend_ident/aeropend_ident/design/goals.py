# SPDX-License-Identifier: Apache-2.0
"""What an experiment is designed for, as one number.

An effect is told from a rival by what the rival leaves of its change of the readings, after a fit of the rival, of the
numbers of the rig within their uncertainty, and of all other effects as small imperfections (T-optimality:
A. Atkinson, V. Fedorov: The design of experiments for discriminating between two rival models. Biometrika 62, 1975). To
first order this is the information on the effect that is left (Ds-optimality: A. Atkinson, A. Donev, R. Tobias: Optimum
experimental designs, with SAS. 2007, 10.3), so that nothing is fitted during the search.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.design.responses import Rows
from aeropend_ident.diagnosis.policy import CALIBRATED

Array = NDArray[np.float64]

NOTHING = "none"
"""The rival of an effect that should be seen at all."""

SURE = 1.645
"""Quantile of a standard normal variable at 95 % (derived)."""

APART = SURE + math.sqrt(SURE**2 + 2.0 * math.log(1.0 / CALIBRATED.undecided - 1.0))
"""Standard deviations by which an effect should differ from a rival: 4.6.

Derived: the log odds of two hypotheses that differ by d are normal with mean d²/2 and standard deviation d. With this d
a rival's probability is below that of a verdict that is undecided in 95 % of all recordings. `diagnose` asks for more
than evidence (docs/results/design.md)."""

SHARPER = 10.0
"""Factor by which a parameter should become better known (choice: then its prior hardly counts)."""


@dataclass(frozen=True)
class Answer:
    """What an experiment says of one thing that is asked.

    Attributes:
        of: the effect, or the number.
        rival: from which the effect differs least; "" for a number.
        value: standard deviations by which it differs, or factor by which the number becomes better known.
        wanted: value that is enough.
    """

    of: str
    rival: str
    value: float
    wanted: float

    @property
    def reached(self) -> float:
        """The value over that wanted."""
        return self.value / self.wanted


class Goal(Protocol):
    """What an experiment is for."""

    def answers(self, products: Array) -> tuple[Answer, ...]:
        """What is said of each thing that is asked.

        Args:
            products: (R, R) of the rows.
        """


def score(answers: Iterable[Answer]) -> float:
    """One number: what is nearly reached counts most, what cannot be reached and what is reached by far hardly."""
    return float(np.mean([math.log1p(a.reached) for a in answers]))


@dataclass(frozen=True)
class Separate:
    """Tell effects from rivals.

    Attributes:
        rows: of the rig.
        pairs: (effect, rival); `NOTHING` is the nominal model.
    """

    rows: Rows
    pairs: Sequence[tuple[str, str]]

    def distances(self, products: Array) -> dict[tuple[str, str], float]:
        """Pair -> standard deviations by which the effect differs from its rival.

        Args:
            products: (R, R) of the rows.
        """
        found = {}
        count = len(self.rows.background)
        for rival in dict.fromkeys(r for _, r in self.pairs):
            sd = self.rows.background.copy()
            used = list(range(count))
            if rival != NOTHING:
                sd[self.rows.index(rival)] = max(sd[self.rows.index(rival)], self.rows.wide(rival))
                own = self.rows.further.get(rival, ())
                used, sd = used + list(own), np.concatenate([sd, np.ones(len(own))])
            known = _known(products[np.ix_(used, used)], sd)
            for effect in (e for e, r in self.pairs if r == rival):
                k = self.rows.index(effect)
                left = (1.0 / known[k] - 1.0) / sd[k] ** 2
                unit = self.rows.wide(effect) if ":" in effect else 1.0
                found[effect, rival] = unit * math.sqrt(left)
        return found

    def answers(self, products: Array) -> tuple[Answer, ...]:
        """Each effect, with the rival from which it differs least."""
        closest: dict[str, tuple[str, float]] = {}
        for (effect, rival), d in self.distances(products).items():
            if effect not in closest or d < closest[effect][1]:
                closest[effect] = (rival, d)
        return tuple(Answer(e, rival, d, APART) for e, (rival, d) in closest.items())


@dataclass(frozen=True)
class Numbers:
    """Fix numbers of the model.

    Attributes:
        rows: of the rig.
        names: of the numbers.
    """

    rows: Rows
    names: Sequence[str]

    def answers(self, products: Array) -> tuple[Answer, ...]:
        """Each number, with the factor by which its standard deviation shrinks."""
        count = len(self.rows.background)
        known = _known(products[:count, :count], self.rows.background)
        return tuple(Answer(n, "", float(1.0 / math.sqrt(known[self.rows.index(n)])), SHARPER) for n in self.names)


def _known(products: Array, sd: Array) -> Array:
    """(K,) Variance of each value after the recording, over that before it.

    Args:
        products: (K, K) of the rows.
        sd: (K,) standard deviations before it.
    """
    information = np.eye(len(sd)) + products * sd[:, None] * sd[None, :]
    return np.clip(np.diag(np.linalg.inv(information)), np.finfo(float).tiny, 1.0)


def any_effect(rows: Rows, rivals: Sequence[str]) -> Separate:
    """See every effect, and tell it from every other.

    Args:
        rows: of the rig.
        rivals: names of effects and of mismatches.
    """
    return Separate(rows, [(e, r) for e in rows.effects for r in (NOTHING, *rivals) if r != e])


def between(rows: Rows, names: Sequence[str]) -> Separate:
    """Tell some effects from each other, and from nothing; each may be the truth.

    Args:
        rows: of the rig.
        names: at least one.
    """
    return Separate(rows, [(e, r) for e in names for r in (NOTHING, *names) if r != e])
