# SPDX-License-Identifier: Apache-2.0
"""The structural analysis of `isolate` beside that of faultdiagnosistoolbox (E. Frisk, M. Krysander).

`pip install faultdiagnosistoolbox`, then `python -m evaluation.isolate.peer`.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from aeropend_ident.diagnosis.isolation import structure
from aeropend_ident.signals.signals import CHANNELS
from aeropend_sim.model.effects import CATALOGUE


def disagreements(channels: tuple[str, ...]) -> tuple[int, int]:
    """Entries of the matrix of isolability in which the two differ, and all entries."""
    from faultdiagnosistoolbox import DiagnosisModel  # type: ignore[import-not-found]

    of = structure.equations(channels)
    wrong = {e: structure.equation_of(e) for e in CATALOGUE if structure.equation_of(e) in of}
    mine = structure.isolable(of, wrong)
    faults = list(wrong)
    relations = [[v.replace(" ", "_") for v in sorted(variables)] + [f for f in faults if wrong[f] == equation]
                 for equation, variables in of.items()]
    peer = DiagnosisModel({"type": "VarStruc", "x": sorted(set().union(*of.values())), "f": faults, "z": [],
                           "rels": relations}, name="aeropendulum")
    detectable = set(peer.DetectabilityAnalysis()[0])
    theirs = np.asarray(peer.IsolabilityAnalysis(), dtype=bool)  # row fault is not isolable from column fault
    wanted = np.array([["" in mine[f] and g not in mine[f] for g in faults] for f in faults])
    shown = [k for k, f in enumerate(faults) if f in detectable]
    differ = int((theirs[np.ix_(shown, shown)] != wanted[np.ix_(shown, shown)]).sum())
    return differ + len(detectable ^ {f for f in faults if "" in mine[f]}), len(shown) ** 2 + len(faults)


def main() -> None:
    """Compare all sets of channels that hold the angle."""
    others = [c for c in CHANNELS if c != "theta"]
    for n in range(len(others) + 1):
        for more in combinations(others, n):
            differ, entries = disagreements(("theta", *more))
            print(f"{', '.join(('theta', *more))}: {differ} of {entries} entries differ")


if __name__ == "__main__":
    main()
