# SPDX-License-Identifier: Apache-2.0
"""Effects by formula: their definitions in an effect file or a model file, read, checked and written."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import yaml

from aeropend_sim import yaml_file
from aeropend_sim.errors import UserError
from aeropend_sim.model.effects import CATALOGUE, DEFINED, PARAMETER_MISMATCH, PLACES, Effect, EffectParameter
from aeropend_sim.model.forms import FORMS
from aeropend_sim.model.formula import CONSTANTS, FUNCTIONS, QUANTITIES, FormulaError, dimension, parse
from aeropend_sim.untrusted import one_line, printable

USES = {
    "actuator": ("v", "i_a", "t"), "electrical": ("i_a", "omega", "v", "t"), "rotor": ("omega", "i_a", "v", "t"),
    "thrust": ("omega", "thrust", "theta", "theta_dot", "t"), "arm": ("theta", "theta_dot", "omega", "thrust", "t"),
}
"""The quantities that a formula may use at each place but `sensing`."""

READINGS = {"theta": ("rad", ("theta", "theta_dot", "t")), "i_a": ("A", ("i_a", "t")), "v_a": ("V", ("v", "t"))}
"""The readings that a formula at place `sensing` may be added to: their unit, and the quantities that it may use."""

UNITS = {"actuator": "V", "electrical": "V", "rotor": "N·m", "thrust": "N", "arm": "rad/s²"}
"""The unit of a term at each place but `sensing`."""

MOST_EFFECTS = 50
"""Greatest number of effects in a file. A choice: each is a hypothesis of its own."""

MOST_PARAMETERS = 60
"""Greatest number of parameters of an effect. A choice: a learned term has up to 44."""

BUILT_IN = CATALOGUE.keys() | FORMS.keys()
"""Ids that no file may define."""

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,39}")
_KEYS = ("place", "physics", "form_of", "term", "sticks", "reading", "memory", "parameters")
_PARAMETER_KEYS = ("unit", "neutral", "default", "low", "high", "description", "refines")


class EffectError(UserError):
    """A definition of an effect that cannot be used. The message is one line."""


def load(path: str | Path) -> dict[str, Effect]:
    """Read an effect file, and make its effects known to models of this process.

    Args:
        path: YAML: id -> place, physics, term, parameters; see docs/guide/effects.md.

    Returns:
        The effects by id.

    Raises:
        EffectError: it cannot be read, or a definition cannot be used.
    """
    return define(yaml_file.read(path, "an effect file", EffectError), str(path))


def load_all(paths: Iterable[str | Path]) -> tuple[str, ...]:
    """Ids of the effects of effect files, which are then known to models of this process; errors as of `load`."""
    return tuple(id_ for path in paths for id_ in load(path))


def define(tree: object, where: str) -> dict[str, Effect]:
    """Check definitions, and make them known to models of this process.

    Args:
        tree: id -> definition.
        where: source of the definitions for error messages.

    Returns:
        The effects by id.

    Raises:
        EffectError: a definition cannot be used, or another one has the same id.
    """
    if not isinstance(tree, Mapping) or not tree:
        raise EffectError(f"{where}: no effect in it; give each as id: {{place, physics, term, parameters}}")
    if len(tree) > MOST_EFFECTS:
        raise EffectError(f"{where}: {len(tree)} effects; {MOST_EFFECTS} are allowed")
    found = {str(id_): _effect(str(id_), definition, where) for id_, definition in tree.items()}
    for id_, effect in found.items():
        if DEFINED.setdefault(id_, effect) != effect:
            raise EffectError(f"{where}: the effect {id_} is defined otherwise in another file: rename one of them")
    return found


def save(tree: Mapping[str, Mapping[str, object]], path: Path, comment: str = "") -> None:
    """Write an effect file.

    Args:
        tree: id -> definition.
        path: the file.
        comment: lines at its top.
    """
    head = "".join(f"# {printable(line)}\n" for line in comment.splitlines())
    text = yaml.safe_dump({id_: dict(one) for id_, one in tree.items()}, sort_keys=False, allow_unicode=True, width=120)
    path.write_text(head + text, encoding="utf-8")


def unit_of(place: str, reading: str = "") -> str:
    """The unit of a term.

    Args:
        place: of the chain.
        reading: that it is added to, at place `sensing`.
    """
    return READINGS[reading][0] if reading else UNITS[place]


def forget(id_: str) -> None:
    """Make an effect by formula unknown again, of which no model is left."""
    if id_ not in BUILT_IN:
        DEFINED.pop(id_, None)


def definitions(ids: object) -> dict[str, dict[str, object]]:
    """The definitions of those effects among some ids that are given by a formula; the inverse of `define`."""
    return {effect.id: _written(effect) for id_ in ids  # type: ignore[attr-defined]
            if id_ not in BUILT_IN and (effect := DEFINED.get(id_)) is not None and effect.term}


def _written(effect: Effect) -> dict[str, object]:
    tree: dict[str, object] = {"place": effect.place, "physics": effect.physics, "term": effect.term}
    if effect.form_of:
        tree["form_of"] = effect.form_of
    if effect.sticks:
        tree["sticks"] = True
    if effect.reading:
        tree["reading"] = effect.reading
    if effect.memory:
        tree["memory"] = {"name": effect.memory, "unit": effect.memory_unit, "rate": effect.rate}
    tree["parameters"] = {
        name: {"unit": p.unit, "neutral": p.neutral, "default": p.default, "low": p.low, "high": p.high,
               "description": p.description, **({"refines": True} if p.refines else {})}
        for name, p in effect.parameters.items()}
    return tree


def _effect(id_: str, tree: object, where: str) -> Effect:
    at = f"{where}: {one_line(id_)}"
    if not _NAME.fullmatch(id_) or id_ in ("initial", "sensing", "model"):
        raise EffectError(f"{at}: not an id; use letters, digits and _, a letter first")
    if id_ in BUILT_IN or id_ == PARAMETER_MISMATCH:
        raise EffectError(f"{at}: an effect of the catalogue has this id; choose another one")
    if not isinstance(tree, Mapping):
        raise EffectError(f"{at}: give place, physics, term and parameters")
    _check_keys(tree, _KEYS, at)
    place = tree.get("place")
    if place not in PLACES:
        raise EffectError(f"{at}: its place is {_shown(place)}; give one of {', '.join(PLACES)}")
    reading = tree.get("reading", "")
    if place == "sensing" and reading not in READINGS:
        raise EffectError(f"{at}: its reading is {_shown(reading)}; give one of {', '.join(READINGS)}")
    if place != "sensing" and reading:
        raise EffectError(f"{at}: only an effect at place sensing has a reading; leave it out")
    form_of, sticks = tree.get("form_of", ""), tree.get("sticks", False)
    if form_of and (form_of not in CATALOGUE or CATALOGUE[str(form_of)].place != place):
        raise EffectError(f"{at}: form_of is {_shown(form_of)}; give an effect of the catalogue at place {place}")
    if not isinstance(sticks, bool) or (sticks and place not in ("rotor", "arm")):
        raise EffectError(f"{at}: sticks is true or false, and true only for a friction of the rotor or the arm")
    memory, memory_unit, rate = _memory(tree.get("memory"), at)
    if memory and place == "sensing":
        raise EffectError(f"{at}: an effect at place sensing cannot have a memory yet")
    effect = Effect(id_, str(place), _text(tree.get("physics", ""), "physics", at), _parameters(tree, at, memory),
                    term=_text(tree.get("term"), "term", at), reading=str(reading), memory=memory,
                    memory_unit=memory_unit, rate=rate, sticks=sticks, form_of=str(form_of))
    try:
        return checked(effect)
    except FormulaError as error:
        raise EffectError(f"{at}: {error}") from None


def checked(effect: Effect) -> Effect:
    """The effect, its formulas parsed and their units checked.

    Raises:
        FormulaError: a formula cannot be used.
    """
    unit, uses = READINGS[effect.reading] if effect.reading else (UNITS[effect.place], USES[effect.place])
    units = {name: QUANTITIES[name] for name in uses} | {n: p.unit for n, p in effect.parameters.items()}
    if effect.memory:
        units[effect.memory] = effect.memory_unit
    for name in units:
        dimension(units[name], name)
    formulas = [(parse(effect.term, units), unit)]
    if effect.memory:
        formulas.append((parse(effect.rate, units), f"{effect.memory_unit}/s"))
        if effect.memory not in formulas[0][0].names:
            raise FormulaError(f"the term does not use the memory {effect.memory}: use it or leave it out")
    if unused := [name for name in effect.parameters if all(name not in f.names for f, _ in formulas)]:
        raise FormulaError(f"parameter {unused[0]} is in no formula: use it or leave it out")
    for formula, wanted in formulas:
        formula.check_units(wanted, units)
    return effect


def _memory(tree: object, at: str) -> tuple[str, str, str]:
    """Name, unit and derivative."""
    if tree is None:
        return "", "", ""
    if not isinstance(tree, Mapping) or set(tree) != {"name", "unit", "rate"}:
        raise EffectError(f"{at}: give its memory as memory: {{name: z, unit: rad, rate: (theta - z) / tau}}")
    name = str(tree["name"])
    _check_name(name, "memory", at)
    return name, _unit(tree["unit"], name, at), _text(tree["rate"], f"the rate of {name}", at)


def _parameters(tree: Mapping[str, object], at: str, memory: str) -> dict[str, EffectParameter]:
    given = tree.get("parameters")
    if not isinstance(given, Mapping) or not given:
        raise EffectError(f"{at}: it has no parameters; give its size first, as in "
                          "k: {unit: 1/s, default: 0.5, low: 0, high: 10}")
    if len(given) > MOST_PARAMETERS:
        raise EffectError(f"{at}: {len(given)} parameters; {MOST_PARAMETERS} are allowed")
    found = {}
    for k, (name, one) in enumerate(given.items()):
        _check_name(str(name), "parameter", at)
        if name == memory:
            raise EffectError(f"{at}: {name} is a parameter and its memory; rename one of them")
        found[str(name)] = _parameter(str(name), one, at, size=k == 0)
    return found


def _parameter(name: str, tree: object, at: str, *, size: bool) -> EffectParameter:
    if not isinstance(tree, Mapping):
        raise EffectError(f"{at}: parameter {name}: give unit, default, low and high")
    _check_keys(tree, _PARAMETER_KEYS, f"{at}: parameter {name}")
    numbers = {}
    for key in ("default", "low", "high"):
        numbers[key] = _number(tree.get(key), f"{at}: parameter {name}: {key}")
    if not numbers["low"] < numbers["high"]:
        raise EffectError(f"{at}: parameter {name}: low must be below high")
    numbers["neutral"] = _number(tree["neutral"], f"{at}: parameter {name}: neutral") if "neutral" in tree else (
        0.0 if size else numbers["default"])
    for key in ("default", "neutral"):
        if not numbers["low"] <= numbers[key] <= numbers["high"]:
            raise EffectError(f"{at}: parameter {name}: {key} {numbers[key]:g} is not between low and high")
    if size and numbers["neutral"] == numbers["default"]:
        raise EffectError(f"{at}: parameter {name} is the size: its default must differ from {numbers['neutral']:g}, "
                          "at which the effect is absent")
    refines = tree.get("refines", False)
    if not isinstance(refines, bool) or (size and refines):
        raise EffectError(f"{at}: parameter {name}: refines is true or false, and false for the size")
    return EffectParameter(_unit(tree.get("unit"), name, at), numbers["neutral"], numbers["default"],
                           numbers["low"], numbers["high"], _text(tree.get("description", ""), "description", at),
                           refines)


def _number(value: object, what: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= 1e15:
        raise EffectError(f"{what} is {_shown(value)}; give a number of at most 1e15")
    return float(value)


def _text(value: object, what: str, at: str) -> str:
    if isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value):
        return f"{value:g}"
    if not isinstance(value, str) or (value and not value.replace("\n", " ").isprintable()):
        raise EffectError(f"{at}: {what} is {_shown(value)}; give text")
    return " ".join(value.split())


def _unit(value: object, name: str, at: str) -> str:
    """A unit as the catalogue writes it: rad/s² for rad/s^2, N·m for N*m."""
    text = _text(value, f"the unit of {name}", at).replace("*", "·")
    return re.sub(r"\^(\d)", lambda found: "⁰¹²³⁴⁵⁶⁷⁸⁹"[int(found[1])], text)


def _check_name(name: str, what: str, at: str) -> None:
    if not _NAME.fullmatch(name):
        raise EffectError(f"{at}: {one_line(name)} is no name of a {what}; use letters, digits and _, a letter first")
    if name in QUANTITIES or name in FUNCTIONS or name in CONSTANTS:
        raise EffectError(f"{at}: {name} has a meaning of its own in formulas; rename the {what}")


def _check_keys(tree: Mapping[str, object], known: tuple[str, ...], at: str) -> None:
    for key in tree:
        if key not in known:
            raise EffectError(f"{at}: unknown key {_shown(key)}; known: {', '.join(known)}")


def _shown(value: object) -> str:
    return "missing" if value is None or value == "" else one_line(repr(value)[:80])
