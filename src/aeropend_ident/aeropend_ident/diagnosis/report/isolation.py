# SPDX-License-Identifier: Apache-2.0
"""What a planned recording would show, as one self-contained HTML page with the matrix of pairs."""

from __future__ import annotations

from dataclasses import dataclass

from aeropend_ident.diagnosis.isolation.isolate import Isolation
from aeropend_ident.diagnosis.report.environment import environment


@dataclass(frozen=True)
class Cell:
    """One pair.

    Attributes:
        kind: `self`, `unseen`, `open` (not told apart), `form` (told apart only by the form of the effects: they are in
            one equation) or `apart`.
        text: what a pointer shows.
        share: probability of the rival, 0 to 1.
    """

    kind: str
    text: str
    share: float = 0.0


def matrix(found: Isolation) -> list[tuple[str, list[Cell]]]:
    """The rows of the matrix: an effect that the rig has, and a cell for each effect that might be named.

    Args:
        found: what a planned recording would show.
    """
    rows = []
    for a in found.at_size:
        cells = []
        for rival in _named(found):
            p = a.rivals.get(rival, 0.0)
            if rival == a.effect:
                cells.append(Cell("self", f"{a.effect} itself"))
            elif not a.seen:
                cells.append(Cell("unseen", f"{a.effect} is not seen at this size"))
            elif p > 0.0:
                cells.append(Cell("open", f"{a.effect} is not told from {rival}: it would have {100.0 * p:.0f} %", p))
            elif rival in found.structural and rival not in found.structural[a.effect].isolable_from:
                cells.append(Cell("form", f"{a.effect} is told from {rival} by its form: both act in equations that "
                                          "structure alone does not separate"))
            else:
                cells.append(Cell("apart", f"{a.effect} is told from {rival}"))
        rows.append((a.effect, cells))
    return rows


def render(found: Isolation, command: str) -> str:
    """Write the page.

    Args:
        found: what a planned recording would show.
        command: the command line that led here.

    Returns:
        One HTML file that needs nothing else.
    """
    return environment().get_template("isolation.html.j2").render(found=found, rows=matrix(found), names=_named(found),
                                                                  command=command)


def _named(found: Isolation) -> list[str]:
    """The effects that might be named: the columns of the matrix."""
    effects = [a.effect for a in found.at_size]
    return effects + sorted({r for a in found.at_size for r in a.rivals} - set(effects))
