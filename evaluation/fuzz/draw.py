# SPDX-License-Identifier: Apache-2.0
"""Random choices, the same for the same seed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Draw:
    """Draws of one case.

    Args:
        seed: numbers that name the case.
    """

    def __init__(self, *seed: int) -> None:
        self.rng = np.random.default_rng(seed)

    def chance(self, probability: float) -> bool:
        """True with this probability."""
        return bool(self.rng.random() < probability)

    def pick(self, *choices: Any) -> Any:
        """One of these."""
        return choices[int(self.rng.integers(len(choices)))]

    def some(self, probability: float, *words: str) -> list[str]:
        """The words with this probability, else none."""
        return list(words) if self.chance(probability) else []

    def option(self, probability: float, name: str, values: Sequence[object]) -> list[str]:
        """An option of the command line with one of these values, with this probability."""
        return [name, str(self.pick(*values))] if self.chance(probability) else []

    def rows(self, n: int) -> NDArray[np.int64]:
        """Some of n rows: one, a few, a burst, a part, every k-th, all."""
        if n == 0:
            return np.zeros(0, dtype=np.int64)
        start = int(self.rng.integers(n))
        return np.asarray(self.pick(
            np.array([start]),
            np.unique(self.rng.integers(n, size=min(7, n))),
            np.arange(start, min(n, start + int(self.rng.integers(2, 400)))),
            np.arange(n // 2), np.arange(n), np.arange(start, n), np.array([0]), np.array([n - 1]),
            np.arange(0, n, int(self.rng.integers(2, 9))),
            np.flatnonzero(self.rng.random(n) < self.pick(0.01, 0.1, 0.3, 0.6))), dtype=np.int64)
