# SPDX-License-Identifier: Apache-2.0
"""Pairs of recordings of one rig between which something was changed, or nothing: does `diagnose --since` say what?

The rigs are those of `plant`. The rig has an effect of its own in half of the pairs. What changes is what a person does
at a bench: a mass on the arm, a screw of the pivot, another propeller, a weaker supply, a cable, a magnet that slipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.chain.known import Known
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.document import Since
from aeropend_ident.signals.signals import Signals, from_arrays
from aeropend_sim.model.parameters import load
from evaluation.blind import cases, folder, page, plant, score
from evaluation.blind.plant import PERIOD

Array = NDArray[np.float64]

UNCHANGED = 0.3
"""Share of the pairs between which nothing changes."""

STEP = (0.05, 0.3)
"""Relative change of a parameter (choice: what a person notices, to what nobody overlooks)."""

OWN = ("coulomb_friction", "thrust_lag", "supply_sag", "quadratic_drag", "angle_offset", "brush_drop")
"""Effects that a rig may have from the beginning."""

ALIKE = {"k_thrust": "L_over_J", "K_t": "J_m"}
"""Parameters of which only the product or ratio with another acts: either may be named."""

Numbers = dict[str, float]
Effects = dict[str, Numbers]


@dataclass
class Rig:
    """Numbers and effects of a rig at one time."""

    numbers: Numbers
    effects: Effects = field(default_factory=dict)


@dataclass(frozen=True)
class Pair:
    """A pair of recordings, and what was changed.

    Attributes:
        kind: of the change, or "nothing".
        changed: name -> (value before, value after).
        before: first recording.
        after: second recording.
    """

    kind: str
    changed: Mapping[str, tuple[float, float]]
    before: Signals
    after: Signals


def _log(rng: np.random.Generator, ends: tuple[float, float]) -> float:
    return math.exp(rng.uniform(*np.log(ends)))


def mass(rig: Rig, rng: np.random.Generator) -> None:
    """A mass on the arm, or taken off: inertia and weight change, each by its own share."""
    inertia = 1.0 + rng.choice([-0.7, 1.0]) * _log(rng, STEP)
    weight = 1.0 + (inertia - 1.0) * rng.uniform(0.5, 2.0)
    rig.numbers["mgd_over_J"] *= weight / inertia
    for name in ("c_over_J", "L_over_J"):
        rig.numbers[name] /= inertia


def screw(rig: Rig, rng: np.random.Generator) -> None:
    """A screw of the pivot that is tightened or loosened: dry friction."""
    now = rig.effects.get("coulomb_friction", {}).get("accel", 0.0)
    factor = _log(rng, (1.3, 3.0)) ** rng.choice([-1.0, 1.0])
    rig.effects["coulomb_friction"] = {"accel": now * factor if now else _log(rng, (0.2, 1.5))}


def propeller(rig: Rig, rng: np.random.Generator) -> None:
    """Another propeller: load and thrust change together, each by its own share."""
    size = rng.choice([-0.7, 1.0]) * _log(rng, STEP)
    rig.numbers["k_load"] *= 1.0 + size
    rig.numbers["k_thrust"] *= 1.0 + size * rng.uniform(0.6, 1.4)
    rig.numbers["J_m"] *= 1.0 + 0.2 * size


def supply(rig: Rig, rng: np.random.Generator) -> None:
    """A weaker supply: more resistance."""
    now = rig.effects.get("supply_sag", {}).get("r_supply", 0.0)
    rig.effects["supply_sag"] = {"r_supply": now + _log(rng, (0.05, 0.4))}


def cable(rig: Rig, rng: np.random.Generator) -> None:
    """A cable that pulls."""
    rig.effects["cable_torque"] = {"k": _log(rng, (1.0, 6.0)), "theta0": rng.uniform(-0.3, 0.6)}


def magnet(rig: Rig, rng: np.random.Generator) -> None:
    """A magnet that slipped: the zero of the angle."""
    now = rig.effects.get("angle_offset", {}).get("bias", 0.0)
    rig.effects["angle_offset"] = {"bias": now + rng.choice([-1.0, 1.0]) * _log(rng, (0.02, 0.15))}


def nothing(rig: Rig, rng: np.random.Generator) -> None:
    """Nothing is done."""


CHANGES: tuple[Callable[[Rig, np.random.Generator], None], ...] = (mass, screw, propeller, supply, cable, magnet)


def draw(rng: np.random.Generator, duration: float, change: Callable[[Rig, np.random.Generator], None]) -> Pair:
    """A pair of recordings.

    Args:
        rng: of all that is drawn.
        duration: [s] of each recording.
        change: what happens between them.
    """
    nominal = load(folder.MODEL)
    rig = Rig({k: nominal.model[k] * (1.0 + rng.uniform(-cases.OFF, cases.OFF)) for k in plant.NUMBERS})
    if rng.random() < 0.5:
        own = str(rng.choice(OWN))
        head, start, neutral = cases.scale(own)
        rig.effects[own] = {head: neutral + start * rng.uniform(0.3, 1.0)}
    was = Rig(dict(rig.numbers), {e: dict(p) for e, p in rig.effects.items()})
    before = _recorded(rig, nominal.sensing, duration, rng)
    change(rig, rng)
    after = _recorded(rig, nominal.sensing, duration, rng)
    changed = {n: (was.numbers[n], v) for n, v in rig.numbers.items() if v != was.numbers[n]}
    changed |= {f"{e}.{n}": (was.effects.get(e, {}).get(n, 0.0), v) for e, p in rig.effects.items()
                for n, v in p.items() if was.effects.get(e, {}).get(n) != v}
    return Pair(change.__name__, changed, before, after)


def _recorded(rig: Rig, sensing: Mapping[str, float], duration: float, rng: np.random.Generator) -> Signals:
    duty = cases.duty_signal(rng, duration)
    p = plant.packed(rig.numbers, sensing["angle_filter_tau"], rig.effects, {}, other=False)
    y, v, applied = plant.states(p, duty, np.zeros(0))
    return from_arrays({**plant.measured(p, y, v, sensing, rng), "duty": applied}, PERIOD, sensing)


@dataclass(frozen=True)
class Judged:
    """What was said of a pair.

    Attributes:
        kind: of the change.
        named: whether a changed parameter comes first among those that are claimed.
        direction: of each claimed change that was made: whether its sign is right.
        held: of each: whether its interval holds the true change.
        ghosts: parameters claimed that were not changed.
        said: the claims.
    """

    kind: str
    named: bool
    direction: tuple[bool, ...]
    held: tuple[bool, ...]
    ghosts: tuple[str, ...]
    said: tuple[str, ...]


def judge(pair: Pair, jobs: int = 1) -> Judged:
    """Diagnose the first recording, then the second since the first."""
    monday = diagnose(load(folder.MODEL), [pair.before], jobs)
    e = monday.conclusions.estimates
    assert e is not None
    known = Known(e.names, np.array(e.values), np.array(e.covariance), ("before",))
    found = diagnose(monday.augmented, [pair.after], jobs, known=known).conclusions.since
    assert found is not None
    return _judged(pair, found)


def _judged(pair: Pair, since: Since) -> Judged:
    true = {**pair.changed}
    for name, other in ALIKE.items():
        for one, two in ((name, other), (other, name)):
            if one in pair.changed and two not in pair.changed:
                true[two] = pair.changed[one]
    claimed = [c for c in since.changes if c.claimed]
    direction, held = [], []
    for c in claimed:
        if c.name not in true or c.name.endswith(("theta0", "phase")):
            continue
        a, b = true[c.name]
        scale = c.before.value / a if c.before is not None and a else 1.0  # products are known, not their factors
        direction.append((b - a) * c.change.value > 0.0)
        held.append(c.change.low <= scale * (b - a) <= c.change.high)
    effects = {n.partition(".")[0] for n in true}
    ghosts = tuple(c.name for c in claimed if c.name not in true and c.name.partition(".")[0] not in effects)
    first = claimed[0].name if claimed else ""
    return Judged(pair.kind, first in true or first.partition(".")[0] in effects, tuple(direction), tuple(held), ghosts,
                  tuple(f"{c.name} {c.change.value:+.3g}" for c in claimed))


def report(count: int, seed: int, duration: float, jobs: int) -> list[score.Figure]:
    """Draw pairs, judge and print them; returns the figures."""
    def one(k: int, change: Callable[[Rig, np.random.Generator], None]) -> tuple[Judged, dict[str, Any]]:
        pair = draw(np.random.default_rng([seed, k, 31]), duration, change)
        return judge(pair), dict(pair.changed)

    same = round(UNCHANGED * count)
    plan = [nothing] * same + [CHANGES[k % len(CHANGES)] for k in range(count - same)]
    judged: list[Judged] = []
    for j, changed in folder.each("pairs", plan, one, jobs):
        judged.append(j)
        if not j.named or j.ghosts or not all(j.held):
            true = ", ".join(f"{n} {a:.3g} -> {b:.3g}" for n, (a, b) in changed.items())
            print(f"  {j.kind}: {true or 'nothing'}; said: {', '.join(j.said) or 'nothing'}")
    return page.printed(figures(judged))


def figures(judged: Sequence[Judged]) -> list[score.Figure]:
    """The figures of judged pairs."""
    real = [j for j in judged if j.kind != "nothing"]
    share = score.share
    return [share("changed pairs: what was changed comes first", [j.named for j in real], at_least=0.90),
            share("changes named: right direction", [d for j in real for d in j.direction], at_least=0.97),
            share("changes named: 95 % interval holds the change", [h for j in real for h in j.held], at_least=0.90),
            share("changed pairs: something claimed that did not change", [bool(j.ghosts) for j in real]),
            share("unchanged pairs: a change is claimed", [bool(j.said) for j in judged if j.kind == "nothing"],
                  at_most=0.03)]
