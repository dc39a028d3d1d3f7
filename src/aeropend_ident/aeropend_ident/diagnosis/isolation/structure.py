# SPDX-License-Identifier: Apache-2.0
"""Which effects the equations alone let be seen and told apart: structural analysis.

Only which variable is in which equation counts, no number. An effect makes one equation wrong. It is detectable if that
equation is in the overdetermined part of the equations, where a variable can be computed in two ways (analytical
redundancy). It is isolable from another if it is so without the other's equation.

Sources: A. Dulmage, N. Mendelsohn: Coverings of bipartite graphs. Canadian Journal of Mathematics 10, 1958.
M. Krysander, E. Frisk: Sensor placement for fault diagnosis. IEEE Transactions on Systems, Man, and Cybernetics A 38,
2008.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from types import MappingProxyType

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import maximum_bipartite_matching

from aeropend_sim.model.effects import DEFINED

Equations = Mapping[str, frozenset[str]]
"""Equation -> its unknown variables; what is known (the duty, the readings) is left out."""

MODEL: Equations = MappingProxyType({
    "actuator": frozenset({"voltage", "current"}),
    "electrical": frozenset({"d_current", "current", "voltage", "speed"}),
    "rotor": frozenset({"d_speed", "speed", "current"}),
    "thrust": frozenset({"thrust", "speed", "angle", "rate"}),
    "arm": frozenset({"d_rate", "rate", "angle", "thrust"}),
    "d current/dt": frozenset({"d_current", "current"}),
    "d speed/dt": frozenset({"d_speed", "speed"}),
    "d angle/dt": frozenset({"rate", "angle"}),
    "d rate/dt": frozenset({"d_rate", "rate"}),
})
"""The equations of the chain (in `model`), one a place, and the derivatives; current loads the supply."""

READS = {"theta": "angle", "omega": "speed", "i_a": "current", "v_a": "voltage"}
"""The variable that each channel reads."""


def equations(channels: Collection[str]) -> dict[str, frozenset[str]]:
    """The equations of a rig with some channels measured.

    Args:
        channels: that are measured.
    """
    return {**MODEL, **{f"read {c}": frozenset({READS[c]}) for c in channels}}


def equation_of(effect: str) -> str:
    """The equation that an effect makes wrong.

    Args:
        effect: its id.
    """
    e = DEFINED[effect]
    return f"read {e.reading}" if e.place == "sensing" else e.place


def overdetermined(of: Equations) -> frozenset[str]:
    """The overdetermined part of some equations (Dulmage and Mendelsohn).

    It is what alternating paths reach from the equations that a maximum matching leaves over.

    Args:
        of: the equations.
    """
    names, unknowns = list(of), sorted(set().union(*of.values()))
    table = np.array([[u in of[e] for u in unknowns] for e in names], dtype=int)
    matched = maximum_bipartite_matching(csr_matrix(table), perm_type="row")  # equation of each variable, or -1
    reached = set(range(len(names))) - set(matched.tolist())
    new = list(reached)
    while new:
        for variable in np.flatnonzero(table[new.pop()]):
            if (equation := int(matched[variable])) not in reached:  # of a variable in this part all are matched
                reached.add(equation)
                new.append(equation)
    return frozenset(names[k] for k in reached)


def isolable(of: Equations, wrong: Mapping[str, str]) -> dict[str, frozenset[str]]:
    """Effect -> the effects from which it is isolable; the key "" in a set says that it is detectable.

    Args:
        of: the equations.
        wrong: effect -> the equation that it makes wrong; one that is not there (its channel is not read) is none.
    """
    whole = overdetermined(of)
    without = {e: overdetermined({k: v for k, v in of.items() if k != e}) for e in set(wrong.values()) if e in of}
    return {f: frozenset([""] * (e in whole) + [g for g, other in wrong.items()
                                               if e in without.get(other, whole) and e != other])
            for f, e in wrong.items()}
