# SPDX-License-Identifier: Apache-2.0
"""Known variants of a rig, as with a payload or another propeller: which numbers of its model differ in a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from aeropend_ident.bags.recording import RecordingError
from aeropend_sim import yaml_file
from aeropend_sim.model.parameters import MODEL_NAMES, PARAMETERS, Model, load

KEYS = ("recordings", "numbers", "unknown", "model")
"""What a variant may state."""

EXAMPLE = "payload: {recordings: [my_bag], numbers: {mgd_over_J: 41.0}}"


class VariantError(RecordingError):
    """A file of variants that cannot be used. The message is one line."""


@dataclass(frozen=True)
class Variant:
    """A variant of a rig.

    A number that is known differs from that of the model by an exact factor, so that one estimate holds for all
    variants. A number that is unknown is estimated for each recording.

    Attributes:
        name: of the variant.
        factor: number of the model -> its value in the variant over that in the model.
        unknown: numbers of the model that differ by an unknown amount.
    """

    name: str
    factor: Mapping[str, float] = field(default_factory=dict)
    unknown: tuple[str, ...] = ()

    def of(self, model: Model) -> Model:
        """The model of the variant, with the unknown numbers as they are."""
        if not self.factor:
            return model
        return replace(model, model={n: x * self.factor.get(n, 1.0) for n, x in model.model.items()})

    def acting(self, values: Mapping[str, float], model: Model) -> dict[str, float]:
        """The values that act on a recording of the variant.

        Args:
            values: of the rig, by plain names.
            model: of the rig.
        """
        if not self.factor:
            return dict(values)
        return {**values, **{n: factor * values.get(n, model.model[n]) for n, factor in self.factor.items()}}


SAME = Variant("")
"""The rig as the model states it."""


def read(path: str | Path, bags: Sequence[str], model: Model) -> dict[str, Variant]:
    """Read a file of variants.

    Args:
        path: YAML: name -> `recordings`, and `numbers` (name -> value), `unknown` (names) or `model` (a model file).
        bags: the recordings, as they were given.
        model: of the rig without any variant.

    Returns:
        Recording -> its variant, of those that are of one.

    Raises:
        VariantError: the file cannot be read, or names a recording or a number that is not there.
        ModelError: a model file in it cannot be used.
    """
    tree = _tree(Path(path))
    found: dict[str, Variant] = {}
    for name, entry in tree.items():
        where = f"{path}: {name}"
        if not isinstance(entry, Mapping) or not entry.get("recordings"):
            raise VariantError(f"{where} has no recordings; give them as in {EXAMPLE}")
        if wrong := [key for key in entry if key not in KEYS]:
            raise VariantError(f"{where} has the unknown key '{wrong[0]}'; known: {', '.join(KEYS)}")
        variant = _variant(str(name), entry, model, Path(path).parent, where)
        for bag in _list(entry["recordings"], f"{where}: recordings"):
            mine = [given for given in bags if _same(bag, given, Path(path).parent)]
            if not mine:
                raise VariantError(f"{where} names the recording {bag}, which is not given; leave it out, or give it")
            for given in mine:
                if found.setdefault(given, variant) is not variant:
                    raise VariantError(f"{path}: {bag} is of the variants {found[given].name} and {name}; it can be of "
                                       "one")
    return found


def _tree(path: Path) -> Mapping[object, object]:
    tree = yaml_file.read(path, "a file of variants", VariantError)
    if not isinstance(tree, Mapping) or not tree:
        raise VariantError(f"{path}: no variant in it; give each as in {EXAMPLE}")
    return tree


def _variant(name: str, entry: Mapping[object, object], model: Model, folder: Path, where: str) -> Variant:
    numbers: dict[str, float] = {}
    if "model" in entry:
        other = load(folder / str(entry["model"])).model
        numbers = {n: x for n, x in other.items() if x != model.model[n]}
    given = entry.get("numbers") or {}
    if not isinstance(given, Mapping):
        raise VariantError(f"{where}: numbers is {given!r}; give numbers of the model with their values")
    numbers |= {_number(n, where): _value(x, str(n), where) for n, x in given.items()}
    unknown = tuple(_number(n, where) for n in _list(entry.get("unknown") or [], f"{where}: unknown"))
    if not numbers and not unknown:
        raise VariantError(f"{where} says of no number that it differs; give numbers, unknown or model")
    if both := sorted(set(numbers) & set(unknown)):
        raise VariantError(f"{where}: {both[0]} is known and unknown; give it once")
    if none := sorted(n for n in (*numbers, *unknown) if model.model[n] == 0.0):
        raise VariantError(f"{where}: {none[0]} is 0 in the model: no variant can differ in it; give the model another")
    return Variant(name, {n: x / model.model[n] for n, x in numbers.items()}, unknown)


def _number(name: object, where: str) -> str:
    if name not in MODEL_NAMES:
        raise VariantError(f"{where}: unknown number '{name}'; known: {', '.join(MODEL_NAMES)}")
    return str(name)


def _value(x: object, name: str, where: str) -> float:
    p = PARAMETERS[f"model.{name}"]
    if isinstance(x, bool) or not isinstance(x, (int, float)) or not p.low <= x <= p.high or x == 0.0:
        raise VariantError(f"{where}: {name} is {x!r}; give a number from {p.low:g} to {p.high:g}, not 0")
    return float(x)


def _list(x: object, where: str) -> list[str]:
    if isinstance(x, str) or not isinstance(x, Sequence):
        raise VariantError(f"{where} is {x!r}; give a list, as in [one, another]")
    return [str(one) for one in x]


def _same(name: str, bag: str, folder: Path) -> bool:
    """Whether a name in the file means a recording: as it was given, as its last part, or as a path from the file."""
    return name in (bag, Path(bag).name) or (folder / name).resolve() == Path(bag).resolve()
