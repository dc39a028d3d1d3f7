# SPDX-License-Identifier: Apache-2.0
"""Forms: effects of the catalogue that follow another law than it has. Are they named, do the intervals hold?

A third of the rigs have the form of docs/effects.md, a third one that another form of the catalogue resembles, a third
one that no form of the catalogue has.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.signals.signals import from_arrays
from aeropend_sim.model.parameters import load
from evaluation.blind import cases, folder, page, plant, score

Array = NDArray[np.float64]

CHANCE = ("gust", "speed_spikes", "command_delay")
"""Effects that have no other form in the generator, or of which only statistics show."""


@dataclass(frozen=True)
class Answer:
    """What was said of one rig.

    Attributes:
        effect: that the rig has.
        form: of it.
        place: where it acts.
        verdict: given.
        beside: the effects that the verdict cannot separate from it.
        said: place that was said.
        likeliest: the likeliest form, and its probability.
        closed: share of the closable gap that closes.
        strength: true strength, and the interval that was given; None if it was not found, or has none.
        parameters: whether the interval of each true parameter holds it.
        seconds: taken.
    """

    effect: str
    form: str
    place: str
    verdict: str
    beside: tuple[str, ...]
    said: str
    likeliest: tuple[str, float]
    closed: float | None
    strength: tuple[float, float, float, float] | None
    parameters: tuple[bool, ...]
    seconds: float

    @property
    def held(self) -> bool:
        """Whether the interval of the strength holds the true one."""
        return self.strength is not None and self.strength[2] <= self.strength[0] <= self.strength[3]


def true_strength(case: cases.Case, sensing: Mapping[str, float], duty: Array) -> float:
    """RMS of the term of the one effect of a rig over what is fitted, of a dry friction where it moves."""
    (effect,) = case.effects
    id_, own = str(effect["effect"]), dict(effect["parameters"])  # type: ignore[call-overload]
    form = cases.FORMS.index(case.form)
    head, _, neutral = cases.scale(id_)
    with_, without = (plant.packed(case.numbers, sensing["angle_filter_tau"], {id_: {**own, **off}}, {}, form)
                      for off in ({}, {head: neutral}))
    y, v, _ = plant.states(with_, duty, np.zeros(0))
    end, d = round(0.7 * len(duty)), np.zeros(y.shape[1])

    def of(p: Array) -> Array:
        if id_ in ("current_gain", "current_offset", "voltage_offset"):
            return plant.shown(p, y, v)["v_a" if id_ == "voltage_offset" else "i_a"][:end]
        if case.effects[0]["place"] == "actuator":
            return np.array([plant.terminal_voltage(duty[k], k * plant.PERIOD, y[k], p) for k in range(end)])
        state, unit = {"electrical": (plant.S.i, case.numbers["L_a"]), "rotor": (plant.S.omega, case.numbers["J_m"]),
                       "thrust": (plant.S.rate, 1.0 / case.numbers["L_over_J"]), "arm": (plant.S.rate, 1.0),
                       "sensing": (plant.S.stage1, sensing["angle_filter_tau"])}[str(effect["place"])]
        return np.array([unit * plant.derivative(y[k], k * plant.PERIOD, duty[k], p, np.zeros(0), d)[state]
                         for k in range(end)])

    term = of(with_)
    y = y.copy()
    y[:, plant.S.sag] = 0.0  # what the supply has stored is of the effect
    term = term - of(without)
    if id_ in ("coulomb_friction", "rotor_friction"):
        speed = np.abs(y[:end, plant.S.rate if id_ == "coulomb_friction" else plant.S.omega])
        term = term[speed > 0.02 * speed.max()]
    return float(np.sqrt(np.mean(term**2)))


def plan(count: int, seed: int) -> list[tuple[str, str]]:
    """Effect and form of each rig: every pair as often as any other."""
    rng = np.random.default_rng([seed, 33])
    pairs = [(e, form) for e in plant.EFFECTS if e not in CHANCE for form in cases.FORMS]
    order = [pairs[k] for _ in range(count // len(pairs) + 1) for k in rng.permutation(len(pairs))]
    return order[:count]


def answer(k: int, effect: str, form: str, seed: int, duration: float) -> Answer:
    """Draw a rig, record it, and diagnose it."""
    nominal = load(folder.MODEL)
    case, columns = cases.draw(f"r{k:03d}", "single", [effect], form, nominal.model, nominal.sensing,
                               seed * 100_003 + k, duration)
    started = time.perf_counter()
    found = diagnose(nominal, [from_arrays(columns, plant.PERIOD, nominal.sensing)], 1)
    seconds = time.perf_counter() - started
    which = found.conclusions.which
    pairs = [{score.id_of(name) for name in pair} for pair in which.not_separable]
    named = {which.verdict}.union(*(pair for pair in pairs if which.verdict in pair))
    mine = next((c for c in which.candidates if c.effect == effect), None)
    forms = (mine.forms if mine else None) or {"": 0.0}
    likeliest = max(forms.items(), key=lambda item: item[1])
    strength, held = None, []
    if mine is not None and mine.found:
        if mine.strength is not None:
            strength = (true_strength(case, nominal.sensing, columns["duty"]), mine.strength.value, mine.strength.low,
                        mine.strength.high)
        own: dict[str, float] = case.effects[0]["parameters"]  # type: ignore[assignment]
        held = [mine.parameters[n].low <= x <= mine.parameters[n].high for n, x in own.items()
                if n in mine.parameters and n != "phase"]
    return Answer(effect, form, str(case.effects[0]["place"]), which.verdict, tuple(sorted(named - {which.verdict})),
                  found.conclusions.where.place, likeliest, found.conclusions.closure.closed, strength, tuple(held),
                  seconds)


def figures(found: list[Answer]) -> list[score.Figure]:
    """The figures of forms."""
    made = []
    for form, what in zip(cases.FORMS, ("form of the table", "form like another of the catalogue",
                                        "form that is in no catalogue"), strict=True):
        own = [a for a in found if a.form == form]
        made += [
            score.share(f"{what}: right effect first", [a.verdict == a.effect for a in own], at_least=0.92),
            score.share(f"{what}: first, or said to be not separable",
                        [a.effect in (a.verdict, *a.beside) for a in own]),
            score.share(f"{what}: right place", [a.said == a.place for a in own]),
            score.share(f"{what}: `unknown`", [a.verdict == "unknown" for a in own]),
            score.share(f"{what}: 95 % interval of the strength holds", [a.held for a in own if a.strength],
                        at_least=0.93 if form == "table" else 0.9),
            score.median(f"{what}: width of that interval over the strength, median",
                         [(a.strength[3] - a.strength[2]) / a.strength[1] for a in own if a.strength]),
            score.share(f"{what}: 95 % intervals of the parameters hold", [h for a in own for h in a.parameters]),
            score.median(f"{what}: gap closed, median", [a.closed for a in own if a.closed is not None]),
        ]
    return [*made, score.median("seconds, median", [a.seconds for a in found], at_most=6.0)]


def report(count: int, seed: int, duration: float, jobs: int) -> list[score.Figure]:
    """Draw, diagnose and score; prints a line a rig, and the figures."""
    found: list[Answer] = folder.each("diagnosing", plan(count, seed),
                                      lambda k, row: answer(k, *row, seed, duration), jobs)
    for a in found:
        closed = page.closed(a.closed)
        form = f"; form {a.likeliest[0]} {100.0 * a.likeliest[1]:.0f} %" if a.likeliest[0] else ""
        if a.strength is not None:
            closed += f", strength {a.strength[0]:.3g} in {a.strength[2]:.3g} to {a.strength[3]:.3g}" + " MISSED" * (
                not a.held)
        print(f"{'+' if a.verdict == a.effect else '-'} {a.form:6} {a.effect:21} {a.place:10} -> {a.verdict:20} "
              f"({a.said}) {', '.join(a.beside)}{form}; {closed}; {a.seconds:.1f} s")
    return page.printed(figures(found))
