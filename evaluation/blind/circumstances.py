# SPDX-License-Identifier: Apache-2.0
"""The blind check of rigs as they are: many small imperfections, feedback, wrong noise, lost samples, change in time.

Each circumstance is a row of its own. The rigs are those of `plant`; what a recording holds is drawn here. The share of
an effect in the gap is that of the mean square which no refit of the numbers absorbs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.testing import bags
from aeropend_sim.model.parameters import Model, load
from evaluation.blind import cases, changes, controllers, folder, other_rigs, page, plant, score
from evaluation.blind.plant import EFFECTS, OUTSIDE, PERIOD

Array = NDArray[np.float64]

ROWS = {"messy": 0.28, "closed loop": 0.14, "nothing missing": 0.18, "three effects": 0.1, "onset": 0.17,
        "slow drift": 0.05, "other rigs": 0.08}
"""Circumstance -> share of the recordings."""

BACKGROUND = (10, 12)
"""Imperfections of a messy rig, at least and at most."""

SMALL = (0.2, 1.2)
"""Floors, in its worst channel, of one imperfection of a messy rig."""

MAIN_SHARE = (0.2, 0.95)
"""Share of the gap that the main effect of a messy rig makes."""

PART_OF_THREE = (0.03, 0.1)
"""Gap, in spreads of the channels, that each of three effects makes."""

LARGEST, LARGEST_SMALL = 1.5, 0.4
"""Largest size of a main effect and of an imperfection, in sizes that `cases` starts from."""

RESOLUTION, JITTER = (0.7, 1.3), 0.1
"""Resolutions and tick over those of the model file, and sample instants off by up to so many periods, if nothing is
missing."""

RANDOM_OR_STEPPED = ("command_delay", "speed_spikes", "current_clip", "slew_limit", "brown_outs")
"""Effects whose gap does not grow in proportion to their size: they are no imperfections of a messy rig."""


@dataclass(frozen=True)
class Drawn:
    """An effect of a recording.

    Attributes:
        effect: its id.
        place: of the chain.
        parameters: by name; of an effect outside of the catalogue its size.
        gusts: (N + 2,) random torque, or (0,).
        moved: (4 N,) what it alone changes of the readings, in floors.
    """

    effect: str
    place: str
    parameters: dict[str, float]
    gusts: Array
    moved: Array

    def scaled(self, rig: cases.Weighed, factor: float, most: float = LARGEST) -> Drawn:
        """The effect at another size, at most one that a rig might have."""
        own = dict(self.parameters)
        head, start, neutral = cases.scale(self.effect)
        factor = min(factor, most * abs(start) / max(abs(own[head] - neutral), 1e-12))
        own[head] = neutral + factor * (own[head] - neutral)
        gusts = factor * self.gusts
        return Drawn(self.effect, self.place, own, gusts, rig.moved(_packed(rig, [(self.effect, own)]), gusts))


def _packed(rig: cases.Weighed, effects: Sequence[tuple[str, Mapping[str, float]]]) -> Array:
    inside = {e: own for e, own in effects if e in EFFECTS}
    outside = {e: own["size"] for e, own in effects if e in OUTSIDE}
    return rig.packed(inside, outside, other=True)


def small(effect: str, rig: cases.Weighed, rng: np.random.Generator) -> Drawn:
    """An imperfection of a messy rig: an effect in another form than the catalogue's, at a size of about a floor."""
    own = cases.parameters_of(effect, rng)(0.1 * cases.scale(effect)[1])
    gusts = np.zeros(0)
    if effect == "gust":
        gusts = plant.turbulence(own["sigma"], own["tau"], len(rig.duty), True, rng)
    place = OUTSIDE[effect][0] if effect in OUTSIDE else cases.PLACES[effect]
    drawn = Drawn(effect, place, own, gusts, rig.moved(_packed(rig, [(effect, own)]), gusts))
    goal = math.exp(rng.uniform(*np.log(SMALL)))
    return drawn.scaled(rig, goal / max(rig.left(drawn.moved), 1e-3), LARGEST_SMALL)


def messy(rng: np.random.Generator, rig: cases.Weighed) -> tuple[list[Drawn], dict[str, float]]:
    """A rig with many small imperfections and one main effect; and the share of each in the gap."""
    kinds = [e for e in (*EFFECTS, *OUTSIDE) if e not in RANDOM_OR_STEPPED]
    mains = [e for e in EFFECTS if e not in RANDOM_OR_STEPPED]
    while True:
        main = str(rng.choice(mains))
        others = [str(e) for e in rng.permutation([e for e in kinds if e != main])]
        background = [small(e, rig, rng) for e in others[:rng.integers(BACKGROUND[0], BACKGROUND[1] + 1)]]
        behind = rig.gap(np.sum([d.moved for d in background], axis=0))
        goal = rng.uniform(*MAIN_SHARE)
        one = small(main, rig, rng)
        for _ in range(4):  # the gap of an effect grows about with its size
            one = one.scaled(rig, math.sqrt(goal / (1.0 - goal) / max(rig.gap(one.moved) / behind, 1e-6)))
        all_ = [one, *background]
        shares = rig.shares({d.effect: d.moved for d in all_})
        if shares[main] > MAIN_SHARE[0] and all(shares[main] > shares[d.effect] for d in background):
            return all_, shares


def three(effects: Sequence[str], rng: np.random.Generator, rig: cases.Weighed) -> tuple[list[Drawn], dict[str, float]]:
    """A rig with effects that make comparable parts of the gap; and the share of each."""
    drawn = [small(e, rig, rng) for e in effects]
    for k, d in enumerate(drawn):
        goal = rng.uniform(*PART_OF_THREE)
        for _ in range(4):
            d = d.scaled(rig, goal / max(math.sqrt(rig.gap(d.moved)), 1e-6))
        drawn[k] = d
    return drawn, rig.shares({d.effect: d.moved for d in drawn})


def make(row: str, effects: Sequence[str], nominal: Mapping[str, float], sensing: Mapping[str, float], seed: int,
         duration: float) -> tuple[dict[str, Any], dict[str, Array], NDArray[np.bool_]]:
    """A recording of a circumstance.

    Args:
        row: the circumstance.
        effects: of the recording; drawn here for "messy".
        nominal: numbers of the model file.
        sensing: of the model file.
        seed: of all that is drawn.
        duration: [s] of the recording.

    Returns:
        Its label, its channels (N,), and which samples were lost (N,).
    """
    rng, chain = np.random.default_rng([seed, 19]), np.random.default_rng([seed, 29])
    numbers = {k: v * (1.0 + rng.uniform(-cases.OFF, cases.OFF)) for k, v in nominal.items()}
    duty = cases.duty_signal(rng, duration)
    label: dict[str, Any] = {"row": row, "shares": {}, "effects": [], "seed": seed}
    own = dict(sensing)
    lost = np.zeros(len(duty), dtype=bool)
    if row in changes.ROWS:
        entry, columns = changes.make(effects[0], numbers, nominal, sensing, duty, rng)
        return {**label, "effects": [entry]}, {**columns, "duty": duty}, lost
    controller, gusts, other = None, np.zeros(0), True
    if row in {"messy", "three effects"}:
        weighed = cases.Weighed(numbers, nominal, sensing, duty)
        drawn, label["shares"] = messy(rng, weighed) if row == "messy" else three(effects, rng, weighed)
        p = _packed(weighed, [(d.effect, d.parameters) for d in drawn])
        gusts = next((d.gusts for d in drawn if len(d.gusts)), gusts)
        label["effects"] = [{"effect": d.effect, "place": d.place, "parameters": d.parameters} for d in drawn]
    else:
        if row == "nothing missing":
            for name in ("angle_noise", "current_noise", "voltage_noise"):
                own[name] *= 3.0 ** rng.uniform(-1.0, 1.0)
            own["angle_filter_tau"] *= rng.uniform(0.9, 1.1)
            for name in ("angle_lsb", "current_lsb", "voltage_lsb", "speed_tick"):
                own[name] *= chain.uniform(*RESOLUTION)
            lost[1:-1] = rng.random(len(lost) - 2) < rng.choice([0.0, 0.01, 0.05, 0.2])
            label["sensing"], label["lost"] = own, float(lost.mean())
        if row == "closed loop" or (row == "nothing missing" and rng.random() < 0.3):
            controller = controllers.ALL[rng.integers(len(controllers.ALL))](rng)
        other = bool(rng.random() < 0.5)
        rig = cases.Sizer(numbers, own, duty) if effects else None
        inside: dict[str, dict[str, float]] = {}
        for effect in effects:
            assert rig is not None
            goal = math.exp(rng.uniform(*np.log(cases.FLOORS)))
            entry, _ = cases.sized(effect, rig, goal, "other" if other else "table", nominal, rng)
            label["effects"].append(entry)
            parameters: dict[str, float] = entry["parameters"]  # type: ignore[assignment]
            if effect == "parameter_mismatch":
                numbers |= parameters
            else:
                inside[effect] = parameters
            if effect == "gust":
                gusts = cases.gusts_of(entry, len(duty), other=other)
            entry.pop("draw", None)
        p = plant.packed(numbers, own["angle_filter_tau"], inside, {}, other)
    y, v, applied = plant.states(p, duty, gusts, controller)
    if row == "nothing missing":
        y = plant.at_other_instants(y, JITTER, chain)
    return label, {**plant.measured(p, y, v, own, rng), "duty": applied}, lost


def plan(count: int, seed: int, only: str = "") -> list[tuple[str, list[str]]]:
    """Circumstance and effects of each recording; of one circumstance alone if `only` names it."""
    rng = np.random.default_rng([seed, 23])
    in_turn = {"closed loop": [*EFFECTS, "parameter_mismatch"], "other rigs": other_rigs.EFFECTS, **changes.ROWS}
    rows: list[tuple[str, list[str]]] = []
    for row, part in ({only: 1.0} if only else ROWS).items():
        for k in range(round(part * count)):
            effects: list[str] = []
            scalable = [e for e in EFFECTS if e not in RANDOM_OR_STEPPED]
            if row in in_turn:
                if k % len(in_turn[row]) == 0:
                    order = rng.permutation(in_turn[row])
                effects = [str(order[k % len(in_turn[row])])]
            elif row == "three effects":
                while len({cases.PLACES[e] for e in effects}) < 3:
                    effects = [str(e) for e in rng.choice(scalable, 3, replace=False)]
            rows.append((row, effects))
    return rows


def make_all(out: Path, count: int, seed: int, duration: float, jobs: int, only: str = "") -> None:
    """Make the recordings, and seal their labels."""
    nominal = load(folder.MODEL)

    def one(k: int, row: tuple[str, list[str]]) -> dict[str, Any]:
        if row[0] == "other rigs":
            rng = np.random.default_rng([seed * 100_019 + k, 19])
            made = other_rigs.make(row[1][0], nominal.model, nominal.sensing, duration, rng)
            bags.write(out / "recordings" / f"c{k:03d}", made.columns, round(made.period * 1e9))
            folder.write_model(out, f"c{k:03d}", Model("rig", made.model, made.sensing))
            return {"name": f"c{k:03d}", "row": row[0], "shares": {}, **made.label}
        label, columns, lost = make(*row, nominal.model, nominal.sensing, seed * 100_019 + k, duration)
        bags.write(out / "recordings" / f"c{k:03d}", columns, round(PERIOD * 1e9), lost)
        return {"name": f"c{k:03d}", **label}

    folder.make_all(out, plan(count, seed, only), one, jobs)


@dataclass(frozen=True)
class Judged:
    """A recording with its label and its verdict.

    Attributes:
        label: as sealed.
        answer: of the diagnosis.
        shares: effect -> share of the gap as stated, and its 95 % interval, where there is one.
        instants: "since" and "until" of the effects found, [s].
    """

    label: Mapping[str, Any]
    answer: score.Answer
    shares: Mapping[str, tuple[float, float, float]]
    instants: Sequence[tuple[str, float]] = ()

    @property
    def main(self) -> Mapping[str, Any] | None:
        """The main effect of the recording, if it holds one."""
        return next(iter(self.label["effects"]), None)

    @property
    def keys(self) -> set[str]:
        """The keys of all effects in it."""
        return {score.key_of(e["effect"], e["parameters"]) for e in self.label["effects"]}

    @property
    def listed(self) -> bool:
        """Whether each effect in it is claimed, or listed as small."""
        return score.listed(self.keys, self.answer)

    @property
    def material(self) -> set[str]:
        """The keys of the effects in it that make `score.MATERIAL` of the gap or more."""
        return {score.key_of(e["effect"], e["parameters"]) for e in self.label["effects"]
                if self.label["shares"].get(e["effect"], 0.0) >= score.MATERIAL}

    @property
    def first(self) -> bool:
        """Whether the verdict is the main effect, or none where there is none."""
        return self.answer.first == ("none" if self.main is None else
                                     score.key_of(self.main["effect"], self.main["parameters"]))

    @property
    def first_or_not_separable(self) -> bool:
        """Whether the main effect comes first, or is said to be not separable from the first."""
        return self.first or (self.main is not None and score.key_of(self.main["effect"], self.main["parameters"])
                              in self.answer.named)

    @property
    def placed(self) -> bool:
        """Whether the place is that of the main effect."""
        return self.main is not None and self.answer.place == self.main["place"]

    @property
    def timed(self) -> bool:
        """Whether an effect was found that begins, or ends, when the main effect does."""
        return self.main is not None and any(changes.in_time(self.main, *one) for one in self.instants)

    @property
    def main_share(self) -> float:
        """Share of the main effect in the gap, where shares are known."""
        return float(self.label["shares"].get(self.main["effect"], 0.0)) if self.main else 0.0

    @property
    def ghosts(self) -> int:
        """Number of effects claimed that make less than `score.MATERIAL` of the gap, or none of it."""
        return sum(self.label["shares"].get(score.id_of(key), 0.0) < score.MATERIAL for key in self.answer.found)

    @property
    def shares_held(self) -> list[bool]:
        """For each effect claimed that is there: whether the interval of its share holds the true one."""
        true = self.label["shares"]
        return [low <= true[e] <= high for e, (_, low, high) in self.shares.items()
                if e in true and e in self.answer.found]


def judged(out: Path) -> list[Judged]:
    """The recordings with labels and verdicts.

    Raises:
        SystemExit: a verdict is missing; the labels stay sealed until all are written.
    """
    labels, verdicts = folder.opened(out)
    found = []
    for label in labels:
        body = verdicts[label["name"]]
        shares = {c["effect"]: (c["share"]["value"], c["share"]["low"], c["share"]["high"])
                  for c in body.get("which", {}).get("candidates", ()) if c.get("share")}
        instants = [(which, c[which]["value"]) for c in body.get("which", {}).get("candidates", ()) if c["found"]
                    for which in ("since", "until") if c.get(which)]
        found.append(Judged(label, score.answer_of_diagnosis(body), shares, instants))
    return found


def figures(found: Sequence[Judged]) -> list[score.Figure]:
    """The figures of all circumstances."""
    rows = {row: [j for j in found if j.label["row"] == row] for row in ROWS}
    half = [j for j in rows["messy"] if j.main_share >= 0.5]
    seconds = [j.answer.seconds for j in found if j.answer.seconds is not None]
    ghosts = [j.ghosts for j in rows["messy"]]
    right, share = (lambda js: [j.first for j in js]), score.share
    return [
        share("messy, half of the gap or more: main effect first", right(half), at_least=0.92),
        share("messy, half of the gap or more: first, or said to be not separable from the first",
              [j.first_or_not_separable for j in half]),
        share("messy, half of the gap or more: place", [j.placed for j in half], at_least=0.96),
        share("messy, less than half of the gap: main effect first",
              right([j for j in rows["messy"] if j not in half])),
        score.Figure("messy: ghosts a recording", float(np.mean(ghosts)) if ghosts else None, count=len(ghosts),
                     at_most=0.15, share=False),
        share("messy: 95 % interval of the share holds the true share",
              [held for j in rows["messy"] for held in j.shares_held], at_least=0.90),
        share("closed loop: right effect first", right(rows["closed loop"]), at_least=0.93),
        share("nothing missing: an effect or `unknown` claimed",
              [j.answer.first != "none" for j in rows["nothing missing"]], at_most=0.03),
        share("three effects: all named", [j.keys <= set(j.answer.found) for j in rows["three effects"]],
              at_least=0.85),
        share("three effects: all named, or listed as small", [j.listed for j in rows["three effects"]]),
        share("three effects: all named that make 3 % of the gap or more",
              [j.material <= set(j.answer.found) for j in rows["three effects"]]),
        share("onset: right effect first", right(rows["onset"]), at_least=0.90),
        share("onset: begins or ends within 0.5 s", [j.timed for j in rows["onset"]], at_least=0.95),
        share("slow drift of a reading or a force: right place", [j.placed for j in rows["slow drift"]],
              at_least=0.90),
        share("other rigs: right effect, or none, first", right(rows["other rigs"]), at_least=0.90),
        score.median("seconds, median", seconds, at_most=5.0),
        score.Figure("seconds, longest", max(seconds, default=None), count=len(seconds), at_most=20.0, share=False),
    ]


def report(out: Path) -> list[score.Figure]:
    """Print what was said of each recording, and the figures."""
    found = judged(out)
    for j in found:
        true = [f"{e['effect']} {100 * j.label['shares'][e['effect']]:.0f} %" if j.label["shares"] else e["effect"]
                for e in j.label["effects"]]
        said = [f"{e} {100 * j.shares[score.id_of(e)][0]:.0f} %" if score.id_of(e) in j.shares else e
                for e in j.answer.found]
        print(f"{j.label['name']} {'+' if j.first else '-'} "
              f"{j.label['row']:16} {', '.join(true[:3]) or 'nothing'} -> {j.answer.first} ({j.answer.place}): "
              f"{', '.join(said)}; {j.answer.seconds:.1f} s")
    return page.printed(figures(found))
