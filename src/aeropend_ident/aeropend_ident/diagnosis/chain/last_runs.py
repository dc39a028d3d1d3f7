# SPDX-License-Identifier: Apache-2.0
"""The last runs of a part of the chain, so that it runs again only for values that act on it.

Most parameters of a search leave some part as it is: those of the arm leave the motor, those of a reading leave both.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from aeropend_ident.diagnosis.chain.values import Values

Run = TypeVar("Run")

KEPT = 4
"""Runs that are kept (choice: one at the point of a search, and one for each parameter of an effect, mostly three)."""


class LastRuns(Generic[Run]):
    """The last runs of a part of the chain, each with what acted on it.

    Args:
        acts: whether a value acts on this part, by its name.
    """

    def __init__(self, acts: Callable[[str], bool]) -> None:
        self._acts = acts
        self._kept: list[tuple[object, Run]] = []

    def of(self, values: Values, run: Callable[[Values], Run], stop: int | None = None) -> Run:
        """The run with some values, which is made if it is none of the last.

        Args:
            values: of all parts, by name.
            run: makes it from those that act. What it returns is kept, and must not be changed.
            stop: sample at which the run stops; None: the end.
        """
        own = {name: x for name, x in values.items() if self._acts(name)}
        acting = stop, own
        k = next((k for k, (other, _) in enumerate(self._kept) if other == acting), -1)
        found = self._kept.pop(k) if k >= 0 else (acting, run(own))
        self._kept.append(found)
        del self._kept[:-KEPT]
        return found[1]

    def forget(self) -> None:
        """Forget all runs: something else has changed on which they depend."""
        self._kept.clear()
