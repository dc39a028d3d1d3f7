# SPDX-License-Identifier: Apache-2.0
"""Score verdicts against labels.

A hypothesis goes by a key: the effect's id, and for a mismatch `parameter_mismatch:NUMBER`. Naming another number is
wrong. A recording without a verdict counts as answered wrongly, never as left out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import stats

from aeropend_ident.diagnosis.document import from_json
from aeropend_sim.model.effects import CATALOGUE, PARAMETER_MISMATCH
from evaluation.blind.plant import HELD

KINDS = ("single", "none", "two", "outside")
FAILED = "failed"
"""What a recording without a verdict was taken for."""

OTHER_NUMBER = "mismatch, other number"
CONFUSABLE = (*CATALOGUE, PARAMETER_MISMATCH, "none")
SIZES = (1.5, 2.0, 3.0, 4.0, 6.0, 10.0)
"""Edges of the classes of size, in floors."""

PROBABILITIES = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0)
"""Edges of the classes of stated probability."""


MATERIAL = 0.03
"""True share of the squared gap from which an effect should be claimed; one that is claimed below it is not there."""


@dataclass(frozen=True)
class TrueEffect:
    """An effect that a recording holds: its key, its place, and its true parameters where the form has them."""

    key: str
    place: str
    parameters: Mapping[str, float]


@dataclass(frozen=True)
class Label:
    """The truth about a recording: `kind` of `KINDS`, `form` "table" or "other", `size` in floors, 0 if it has none.

    `shares` has the share of the squared gap that a rig without an effect would not have, by id, where it is known.
    """

    name: str
    kind: str
    form: str
    effects: tuple[TrueEffect, ...]
    size: float
    shares: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def read(cls, label: Mapping[str, Any]) -> Label:
        """From the sealed file.

        Raises:
            ValueError: an unknown kind or form, or a number of effects that does not fit the kind.
        """
        effects = tuple(TrueEffect(key_of(e["effect"], e["parameters"]), e["place"], e["parameters"])
                        for e in label["effects"])
        wanted = {"single": 1, "none": 0, "two": 2, "outside": len(effects) or 1}
        kind, form = label["kind"], label["form"]
        if kind not in wanted or form not in {"table", "other"} or len(effects) != wanted[kind]:
            raise ValueError(f"label of {label['name']}: {len(effects)} effects of kind {kind!r}, form {form!r}")
        return cls(label["name"], kind, form, effects, float(label["size"]), label.get("shares", {}))

    @property
    def keys(self) -> set[str]:
        """The keys of all effects in it."""
        return {e.key for e in self.effects}


@dataclass(frozen=True)
class Candidate:
    """A hypothesis weighed by the diagnosis, with its intervals (low, high) by parameter."""

    key: str
    probability: float
    intervals: Mapping[str, tuple[float, float]]


@dataclass(frozen=True)
class Answer:
    """What was said about a recording, by the diagnosis or by a peer.

    Attributes:
        first: key of the first effect, "none", "unknown" or `FAILED`.
        found: keys of all effects claimed.
        named: `first` and what it was said not to be separable from.
        place: of the chain, or "".
        candidates: of the diagnosis. closed: share of the gap. seconds: time taken.
        small: ids of effects listed as found, with less than a material share of the gap.
    """

    first: str
    found: tuple[str, ...] = ()
    named: tuple[str, ...] = ()
    place: str = ""
    candidates: tuple[Candidate, ...] = ()
    closed: float | None = None
    seconds: float | None = None
    small: tuple[str, ...] = ()

    @property
    def claims(self) -> bool:
        """Whether it claims an effect."""
        return bool(self.found) or self.first not in {"none", "unknown", FAILED}

    def candidate(self, key: str) -> Candidate | None:
        """The candidate of that key, or None."""
        return next((c for c in self.candidates if c.key == key), None)


def key_of(effect: str, parameters: Mapping[str, object]) -> str:
    """The key of an effect with these parameters."""
    return f"{effect}:{next(iter(parameters))}" if effect == PARAMETER_MISMATCH and parameters else effect


def id_of(key: str) -> str:
    """The effect's id in a key."""
    return key.partition(":")[0]


def answer_of_diagnosis(body: Mapping[str, Any] | None) -> Answer:
    """The answer in a diagnosis document; None, or an object that holds an `error`, has failed."""
    if body is None or "error" in body:
        return Answer(FAILED, seconds=body["seconds"] if body else None)
    document = from_json(body)
    which = document.which
    rows = sorted(which.candidates, key=lambda c: not c.found)  # those found first, in the order given
    candidates = tuple(Candidate(key_of(c.effect, c.parameters), float(c.probability),
                                 {k: (p.low, p.high) for k, p in c.parameters.items()}) for c in rows)
    mismatches = [key_of(c.effect, c.parameters) for c in rows if c.found and c.effect == PARAMETER_MISMATCH]
    found: list[str] = []
    for effect in which.effects:
        found += (mismatches or [PARAMETER_MISMATCH]) if effect == PARAMETER_MISMATCH else [effect]
    first = which.verdict
    if first == PARAMETER_MISMATCH:
        first = mismatches[0] if mismatches else first
    return Answer(first, tuple(dict.fromkeys(found)), _named(first, which.not_separable, candidates),
                  document.where.place, candidates, document.closure.closed, document.seconds, which.small)


def answer_of_peer(said: Mapping[str, Any] | None) -> Answer:
    """Read what a peer gave: {"effects": [keys, strongest first], "place": .., "seconds": ..}."""
    if said is None:
        return Answer(FAILED)
    first = said["effects"][0] if said["effects"] else "none"
    return Answer(first, tuple(said["effects"]), (first,), said["place"], seconds=said.get("seconds"))


def _named(first: str, groups: Iterable[Sequence[str]], candidates: Sequence[Candidate]) -> tuple[str, ...]:
    named = [first]
    for group in groups:
        if first not in group and id_of(first) not in group:
            continue
        for entry in group:
            if entry == PARAMETER_MISMATCH and not (first.startswith(entry) and group.count(entry) == 1):
                # the id alone stands for the number that is the most probable besides the first
                others = [c for c in candidates if id_of(c.key) == entry and c.key not in named]
                named += [max(others, key=lambda c: c.probability).key] if others else []
            elif entry != id_of(first):
                named.append(entry)
    return tuple(dict.fromkeys(named))


# --- figures


@dataclass(frozen=True)
class Figure:
    """One figure with its 95 % interval and its target.

    Attributes:
        value, low, high: None where there was nothing to measure.
        count: number of recordings (or intervals) behind it.
        at_least, at_most: the target; without them the figure is reported only.
    """

    name: str
    value: float | None
    low: float | None = None
    high: float | None = None
    count: int = 0
    at_least: float | None = None
    at_most: float | None = None
    share: bool = True

    @property
    def judged(self) -> bool:
        """Whether it has a target."""
        return self.at_least is not None or self.at_most is not None

    @property
    def met(self) -> bool:
        """Whether the value meets the target; nothing measured does not."""
        return (self.value is not None and (self.at_least is None or self.value >= self.at_least)
                and (self.at_most is None or self.value <= self.at_most))

    def document(self) -> dict[str, Any]:
        """The figure as JSON; "met" is null without a target."""
        return asdict(self) | {"met": self.met if self.judged else None}


def wilson(hits: int, total: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    interval = stats.binomtest(hits, total).proportion_ci(0.95, method="wilson")
    return float(interval.low), float(interval.high)


def share(name: str, hits: Iterable[bool], *, at_least: float | None = None, at_most: float | None = None) -> Figure:
    """The share of hits, with Wilson's interval."""
    all_ = [bool(h) for h in hits]
    if not all_:
        return Figure(name, None, at_least=at_least, at_most=at_most)
    return Figure(name, sum(all_) / len(all_), *wilson(sum(all_), len(all_)), len(all_), at_least, at_most)


def median(name: str, numbers: Iterable[float], *, at_least: float | None = None, at_most: float | None = None,
           is_share: bool = False) -> Figure:
    """The median, with the 95 % interval that order statistics give."""
    x = np.sort([float(v) for v in numbers])
    if not len(x):
        return Figure(name, None, at_least=at_least, at_most=at_most, share=is_share)
    rank = max(int(stats.binom.ppf(0.025, len(x), 0.5)) - 1, 0)
    return Figure(name, float(np.median(x)), float(x[rank]), float(x[-1 - rank]), len(x), at_least, at_most, is_share)


Pairs = Sequence[tuple[Label, Answer]]


def pair(labels: Sequence[Mapping[str, Any]], said: Mapping[str, Any], read: Callable[[Any], Answer]) -> Pairs:
    """Each label with its answer; a recording without one has failed.

    Raises:
        ValueError: an answer to no label, or two labels of one name.
    """
    truth = [Label.read(label) for label in labels]
    names = [t.name for t in truth]
    if len(set(names)) != len(names):
        raise ValueError("two labels have one name")
    if strange := set(said) - set(names):
        raise ValueError(f"answers to recordings that have no label: {sorted(strange)[:3]}")
    return [(t, read(said.get(t.name))) for t in truth]


def of_kind(pairs: Pairs, *kinds: str) -> Pairs:
    """Those recordings of these kinds."""
    return [(t, a) for t, a in pairs if t.kind in kinds]


def right_first(t: Label, a: Answer) -> bool:
    """The first effect named is in the recording."""
    return a.first in t.keys


def right_named(t: Label, a: Answer) -> bool:
    """The first effect is right, or is said not to be separable from one that is."""
    return bool(t.keys & {a.first, *a.named})


def right_place(t: Label, a: Answer) -> bool:
    """The place is that of an effect in the recording."""
    return a.place in {e.place for e in t.effects}


def both(t: Label, a: Answer) -> bool:
    """Both effects are found, and one of them is the verdict."""
    return right_first(t, a) and t.keys <= set(a.found)


def listed(keys: Iterable[str], a: Answer) -> bool:
    """Whether each effect is claimed, or listed as small."""
    return all(key in a.found or id_of(key) in a.small for key in keys)


def by_effect(pairs: Pairs) -> dict[str, list[tuple[Label, Answer]]]:
    """Recordings of a single effect by its id."""
    groups: dict[str, list[tuple[Label, Answer]]] = {}
    for t, a in of_kind(pairs, "single"):
        groups.setdefault(id_of(t.effects[0].key), []).append((t, a))
    return {k: groups[k] for k in sorted(groups, key=_order)}


def _order(effect: str) -> tuple[int, str]:
    return (CONFUSABLE.index(effect) if effect in CONFUSABLE else len(CONFUSABLE), effect)


def intervals_held(pairs: Pairs, *forms: str) -> list[bool]:
    """For each true parameter of each effect that was found: whether its 95 % interval holds it."""
    held = []
    for t, a in of_kind(pairs, "single", "two"):
        for effect in t.effects:
            candidate = a.candidate(effect.key)
            if t.form not in forms or effect.key not in a.found or candidate is None:
                continue
            for name, value in effect.parameters.items():
                if value is not None:
                    low, high = candidate.intervals.get(name, (math.nan, math.nan))
                    held.append(any(low <= value + turn <= high for turn in _turns(effect.key, name)))
    return held


def _turns(key: str, parameter: str) -> tuple[float, ...]:
    """What may be added to a parameter without changing anything: whole turns of an angle."""
    p = CATALOGUE[key].parameters.get(parameter) if key in CATALOGUE else None
    circular = p is not None and p.low == -math.pi and p.high == math.pi
    return (-2.0 * math.pi, 0.0, 2.0 * math.pi) if circular else (0.0,)


def worst_effect(pairs: Pairs) -> Figure:
    """The effect that is named first least often when it is alone."""
    each = [share(f"right effect first, worst effect: {effect}", [right_first(t, a) for t, a in group], at_least=0.75)
            for effect, group in by_effect(pairs).items()]
    nothing = Figure("right effect first, worst effect", None, at_least=0.75)
    return min(each, key=lambda f: f.value if f.value is not None else 2.0, default=nothing)


def scored(pairs: Pairs) -> list[Figure]:
    """The figures that peers can be scored by as well."""
    single, none, two, out = (of_kind(pairs, kind) for kind in KINDS)
    out = [(t, a) for t, a in out if t.effects[0].key not in HELD]
    return [
        share("right effect first", [right_first(t, a) for t, a in single], at_least=0.90),
        worst_effect(pairs),
        share("right effect first or named with the first", [right_named(t, a) for t, a in single], at_least=0.97),
        median("names given, median", [len(a.named) for _, a in single], at_most=2.0),
        share("right place", [right_place(t, a) for t, a in single], at_least=0.95),
        share("none: an effect claimed", [a.claims for _, a in none], at_most=0.03),
        share("both of two", [both(t, a) for t, a in two], at_least=0.80),
        share("outside: unknown", [a.first == "unknown" for _, a in out], at_least=0.80),
        share("outside: right place", [right_place(t, a) for t, a in out], at_least=0.90),
    ]


def besides(pairs: Pairs) -> list[Figure]:
    """Effects claimed besides the true ones, or listed as small; reported without a target."""
    single, two = of_kind(pairs, "single"), of_kind(pairs, "two")
    return [share("single: something claimed besides", [bool(set(a.found) - t.keys) for t, a in single]),
            share("both of two, where each makes 3 % of the squared gap or more",
                  [both(t, a) for t, a in two if min(t.shares.values(), default=0.0) >= MATERIAL]),
            share("both of two, or one of them listed as small", [listed(t.keys, a) for t, a in two]),
            share("both of two and nothing besides", [both(t, a) and set(a.found) == t.keys for t, a in two])]


def figures(pairs: Pairs) -> list[Figure]:
    """Every figure of the diagnosis, those with targets first, then the figures that are reported only."""
    single, none, two, out = (of_kind(pairs, kind) for kind in KINDS)
    table, other = ([(t, a) for t, a in single if t.form == form] for form in ("table", "other"))
    closed = [(a.closed if a.first != FAILED else 0.0) for _, a in of_kind(pairs, "single", "two")]
    seconds = [a.seconds for _, a in pairs if a.seconds is not None]
    return [
        *scored(pairs),
        share("95 % intervals that hold the truth", intervals_held(pairs, "table"), at_least=0.90, at_most=0.98),
        median("share of the closable gap closed, median", [c for c in closed if c is not None], at_least=0.90,
               is_share=True),
        median("seconds, median", seconds, at_most=10.0),
        Figure("seconds, longest", max(seconds, default=None), count=len(seconds), share=False),
        share("no verdict at all", [a.first == FAILED for _, a in pairs]),
        share("right effect first, form of the table", [right_first(t, a) for t, a in table]),
        share("right effect first, another form", [right_first(t, a) for t, a in other]),
        share("95 % intervals that hold the truth, another form", intervals_held(pairs, "other")),
        *besides(pairs),
        share("none: `unknown`", [a.first == "unknown" for _, a in none]),
        share("outside, but held by another form of an effect: that effect first",
              [a.first == HELD[t.effects[0].key] for t, a in out if t.effects[0].key in HELD]),
        share("first of two right", [right_first(t, a) for t, a in two]),
        share("outside: right place where `unknown`", [right_place(t, a) for t, a in out if a.first == "unknown"]),
    ]


def against_limit(pairs: Pairs, limits: Mapping[str, Mapping[str, Any]]) -> list[Figure]:
    """How far below the accuracy of a test that knows both hypotheses exactly, on the recordings it was found for."""
    mine = [(t, a) for t, a in pairs if t.name in limits]
    hits = share("right effect first, where the limit is known", [right_first(t, a) for t, a in mine])
    best = float(np.mean([limits[t.name]["accuracy"] for t, _ in mine])) if mine else None
    below = best - hits.value if best is not None and hits.value is not None else None
    return [hits, Figure("the limit", best, count=len(mine)),
            Figure("below the limit", below, count=len(mine), at_most=0.03)]


def by_size(pairs: Pairs, hit: Callable[[Label, Answer], bool] = right_first) -> list[Figure]:
    """The share of hits in each class of size, single effects; those that have no size (0) are left out."""
    single = [(t, a) for t, a in of_kind(pairs, "single") if t.size > 0.0]
    classes = np.clip(np.searchsorted(SIZES, [t.size for t, _ in single], side="right") - 1, 0, len(SIZES) - 2)
    return [share(f"{low:g} to {high:g}", [hit(t, a) for (t, a), k in zip(single, classes) if k == j])
            for j, (low, high) in enumerate(pairwise(SIZES))]


@dataclass(frozen=True)
class Calibration:
    """Stated probability of the first candidate against how often it was right.

    Attributes:
        classes: one figure a class of `PROBABILITIES`: share of hits. stated: mean probability in each, or None.
        brier: mean squared difference of probability and hit; 0 is perfect.
        brier_of_base_rate: of stating the overall share of hits every time.
    """

    classes: list[Figure]
    stated: list[float | None]
    brier: float | None = None
    brier_of_base_rate: float | None = None


def calibration(pairs: Pairs) -> Calibration:
    """Over every recording in which an effect is the verdict, whatever is in it."""
    said = [(candidate.probability, right_first(t, a)) for t, a in pairs
            if (candidate := a.candidate(a.first)) is not None]
    p, hit = np.array([s[0] for s in said]), np.array([s[1] for s in said], dtype=float)
    k = np.clip(np.searchsorted(PROBABILITIES, p, side="right") - 1, 0, len(PROBABILITIES) - 2)
    classes = [share(f"{low:g} to {high:g}", (hit[k == j] > 0.0).tolist())
               for j, (low, high) in enumerate(pairwise(PROBABILITIES))]
    stated = [float(p[k == j].mean()) if (k == j).any() else None for j in range(len(PROBABILITIES) - 1)]
    if not said:
        return Calibration(classes, stated)
    return Calibration(classes, stated, float(np.mean((p - hit) ** 2)), float(np.var(hit)))


@dataclass(frozen=True)
class Confusion:
    """How often each truth (row) was taken for each verdict (column)."""

    rows: list[str] = field(default_factory=list)
    columns: list[str] = field(default_factory=list)
    counts: list[list[int]] = field(default_factory=list)


def confusion(pairs: Pairs) -> Confusion:
    """Single effects, none, and what is outside the catalogue, against the verdict's first effect."""
    columns = [*CATALOGUE, PARAMETER_MISMATCH, OTHER_NUMBER, "none", "unknown", FAILED]
    cells: dict[str, list[int]] = {}
    for t, a in of_kind(pairs, "single", "none", "outside"):
        key = t.effects[0].key if t.effects else "none"
        row = f"outside: {key}" if t.kind == "outside" else id_of(key)
        column = id_of(a.first)
        if column == row == PARAMETER_MISMATCH and a.first != key:
            column = OTHER_NUMBER
        cells.setdefault(row, [0] * len(columns))[columns.index(column)] += 1
    rows = sorted(cells, key=_order)
    return Confusion(rows, columns, [cells[r] for r in rows])
