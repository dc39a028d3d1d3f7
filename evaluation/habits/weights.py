# SPDX-License-Identifier: Apache-2.0
"""The weights of `aeropend_ident.tables.guess`, measured on development seeds: `make habits ARGS=--weights`."""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from aeropend_ident.tables.guess import about_angle, about_chain, about_command, about_pair
from aeropend_ident.tables.traits import gain, origins, traits
from evaluation.habits import tables

SEED = 1
"""Of development."""


def measure(count: int) -> None:
    """Print how often each answer is given of the right column and of others.

    Args:
        count: number of tables.
    """
    right: dict[str, list[bool]] = defaultdict(list)
    for k in range(count):
        made = tables.draw(np.random.default_rng([SEED, k]))
        columns = [c for c in made.columns if c.digits is not None and np.ptp(c.values) > 0.0
                   and c.role not in ("t", "n", "temperature")]
        seen = {id(c): traits(c.values) for c in columns}
        y = next(c for c in columns if c.role == "y")
        follow = {id(columns[k]) for k in origins([seen[id(c)] for c in columns], list(range(len(columns))))}
        rest = [c for c in columns if id(c) not in follow and c.role != "e"]
        for c in rest:
            others = [(gain(seen[id(o)], seen[id(c)]), gain(seen[id(c)], seen[id(o)])) for o in rest if o is not c]
            elsewhere = max((gain(seen[id(x)], seen[id(z)]) for x in rest for z in rest
                             if x is not z and c is not x and c is not z), default=0.0)
            right[f"chain: {about_chain(others, elsewhere)}"].append(c.role == "y")
            if c.role != "y":
                but_angle = [(gain(seen[id(c)], seen[id(o)]), gain(seen[id(o)], seen[id(c)]))
                             for o in rest if o is not c and o.role != "y"]
                right[f"behind: {about_command(but_angle)}"].append(c.role == "u")
        for c in columns:
            right[f"angle: {about_angle(seen[id(c)])}"].append(c.role == "y")
            if c.role != "y":
                right[f"command: {about_angle(seen[id(c)])}"].append(c.role == "u")
                pair = about_pair(gain(seen[id(y)], seen[id(c)]), gain(seen[id(c)], seen[id(y)]))
                right[f"pair: {pair}"].append(c.role == "u")
    totals: dict[tuple[str, bool], int] = defaultdict(int)
    for answer, truth in right.items():
        for yes in truth:
            totals[answer.partition(":")[0], yes] += 1
    print(f"{'answer':<44} right  other  log odds")
    for answer, truth in sorted(right.items()):
        test = answer.partition(":")[0]
        share = [(truth.count(yes) + 1) / (totals[test, yes] + 2) for yes in (True, False)]
        print(f"{answer:<44}{share[0]:6.3f} {share[1]:6.3f} {np.log(share[0] / share[1]):9.1f}")
