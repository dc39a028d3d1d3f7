# SPDX-License-Identifier: Apache-2.0
"""The parameters of the model: names, units, ranges, presets, and the ROS 2 parameter files that hold them."""

from __future__ import annotations

import difflib
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

import yaml

from aeropend_sim.errors import UserError
from aeropend_sim.model import effect_file
from aeropend_sim.model.effects import CATALOGUE, DEFINED, PARAMETER_MISMATCH
from aeropend_sim.untrusted import NumberLoader, load_yaml, printable

SAMPLE_PERIOD = 64 * 510 / 16e6
"""[s] Sample period: Timer1 of a 16 MHz ATmega2560, 8-bit phase-correct PWM, prescaler 64 (thesis 4.3.2)."""

LONGEST_STEP = 2.5e-3
"""[s] Longest step. Measured: over a longer one the error exceeds 2e-5 of the range of each state of `bench`."""

LARGEST_SEED = 2**31 - 1
"""Largest seed of what is drawn (choice: every integer type of files and messages holds it)."""

PRESETS = ("bench", "thesis")

SECTIONS = ("model", "sensing", "definitions", "effects")
"""The sections of a model file. The parameters of a node may stand beside them.

`definitions` has the effects that are given by a formula."""


class ModelError(UserError):
    """A model file, preset or value that cannot be used. The message is one line."""


@dataclass(frozen=True)
class Parameter:
    """A parameter of the model.

    Attributes:
        unit: its unit; "-" for none.
        low: smallest value.
        high: greatest value.
        description: its meaning.
    """

    unit: str
    low: float
    high: float
    description: str


_P = Parameter
PARAMETERS: dict[str, Parameter] = {
    "model.k0": _P("V", -10.0, 10.0, "duty map: v = max(0, k0 + k1 sqrt(k2 τ + k3)), thesis (4.3)"),
    "model.k1": _P("V", 0.0, 10.0, "duty map: factor of the root"),
    "model.k2": _P("-", 0.0, 1e12, "duty map: factor of the duty under the root"),
    "model.k3": _P("-", 0.0, 1e12, "duty map: constant under the root"),
    "model.R_a": _P("Ω", 1e-3, 1e3, "armature resistance"),
    "model.L_a": _P("H", 1e-7, 10.0, "armature inductance"),
    "model.K_e": _P("V·s/rad", 1e-6, 10.0, "back-EMF constant"),
    "model.K_t": _P("N·m/A", 1e-6, 10.0, "torque constant"),
    "model.J_m": _P("kg·m²", 1e-9, 1.0, "inertia of rotor, gear and propeller"),
    "model.B_m": _P("N·m·s/rad", 0.0, 10.0, "viscous friction of the rotor"),
    "model.k_load": _P("N·m·s²/rad²", 0.0, 1.0, "air torque of the propeller: k_load ω|ω|"),
    "model.k_thrust": _P("N·s²/rad²", 0.0, 10.0, "thrust: f = k_thrust ω|ω|"),
    "model.mgd_over_J": _P("1/s²", 0.0, 1e4, "gravity on the arm over its inertia"),
    "model.c_over_J": _P("1/s", 0.0, 1e3, "viscous friction of the pivot over the arm's inertia"),
    "model.L_over_J": _P("1/(kg·m)", 0.0, 1e5, "lever of the thrust over the arm's inertia"),
    "model.v_full": _P("V", 0.0, 1e3, "bridge without losses: v = v_full τ; 0 = the map of k0 to k3"),
    "model.reverse": _P("-", 0.0, 1.0, "share of the voltage that a duty below 0 gives in reverse; 0 = it brakes"),
    "sensing.angle_lsb": _P("rad", 0.0, 1.0, "resolution of the angle; 0 = continuous"),
    "sensing.angle_filter_tau": _P("s", 0.0, 1.0, "each of two equal first-order stages of the angle filter; 0 = none"),
    "sensing.angle_noise": _P("rad", 0.0, 1.0, "standard deviation before quantisation"),
    "sensing.current_lsb": _P("A", 0.0, 10.0, "resolution of the current; 0 = continuous"),
    "sensing.current_noise": _P("A", 0.0, 10.0, "standard deviation before quantisation"),
    "sensing.voltage_lsb": _P("V", 0.0, 10.0, "resolution of the voltage; 0 = continuous"),
    "sensing.voltage_noise": _P("V", 0.0, 10.0, "standard deviation before quantisation"),
    "sensing.speed_pulses_per_rev": _P("-", 0.0, 1e4, "pulses per revolution; 0 = the speed is sampled directly"),
    "sensing.speed_tick": _P("s", 0.0, 0.1, "resolution of the pulse times; 0 = continuous"),
    "sensing.speed_noise": _P("rad/s", 0.0, 1e3, "standard deviation of a speed reading"),
}
"""All parameters of a model file outside `effects`, as `section.name`."""


OPTIONAL = ("v_full", "reverse")
"""Parameters that a model file may leave out: they are 0 then."""

DUTY_MAP = ("k0", "k1", "k2", "k3")
"""Parameters that a model file with `v_full` may leave out: it has no use for them, and they are 0."""


def parameter(name: str) -> Parameter:
    """A parameter by its name in a diagnosis: `R_a`, or `sensing.angle_filter_tau`."""
    return PARAMETERS[name if "." in name else f"model.{name}"]

MODEL_NAMES = tuple(key[len("model."):] for key in PARAMETERS if key.startswith("model."))
SENSING_NAMES = tuple(key[len("sensing."):] for key in PARAMETERS if key.startswith("sensing."))


@dataclass(frozen=True)
class Model:
    """A complete model, in SI units.

    Attributes:
        name: preset or file that it comes from.
        model: parameters of the plant by name.
        sensing: parameters of the measurement chain by name.
        effects: active effects: id -> parameter name -> value, with all parameters of the effect.
    """

    name: str
    model: Mapping[str, float]
    sensing: Mapping[str, float]
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    def numbers(self) -> dict[str, float]:
        """The parameters of the plant, with `parameter_mismatch` applied."""
        return {**self.model, **self.effects.get(PARAMETER_MISMATCH, {})}

    def effect(self, id_: str, parameter: str) -> float:
        """A parameter of an effect; its neutral value if the model does not have the effect.

        Args:
            id_: the effect's id in the catalogue.
            parameter: name of its parameter.
        """
        return float(self.effects.get(id_, {}).get(parameter, DEFINED[id_].parameters[parameter].neutral))

    def in_any_form(self, id_: str, parameter: str) -> float:
        """A parameter of an effect, in whatever form the model has it; its neutral value if it has none.

        Args:
            id_: the effect's id in the catalogue.
            parameter: name of its parameter.
        """
        forms = (p[parameter] for form, p in self.effects.items()
                 if form in DEFINED and DEFINED[form].form_of == id_ and parameter in p)
        return next(map(float, forms), self.effect(id_, parameter))

    def with_effects(self, effects: Mapping[str, Mapping[str, float]]) -> Model:
        """The same model with other effects.

        Args:
            effects: id -> parameter name -> value, complete.
        """
        return Model(self.name, self.model, self.sensing, effects)


def _number(key: str, value: object, low: float, high: float, unit: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ModelError(f"{where}: {key} is {value!r}; give a number" + (f" in {unit}" if unit != "-" else ""))
    if not low <= value <= high:
        size = f"{value:g} {unit}" if unit != "-" else f"{value:g}"
        raise ModelError(f"{where}: {key} = {size} is out of range; give {low:g} to {high:g}")
    return float(value)


def _unknown(what: str, key: str, known: Mapping[str, object] | tuple[str, ...], where: str) -> ModelError:
    near = difflib.get_close_matches(key, list(known), n=1)
    hint = f"did you mean {near[0]}?" if near else "known: " + ", ".join(known)
    return ModelError(f"{where}: unknown {what} '{key}'; {hint}")


def from_flat(flat: Mapping[str, object], name: str = "model", base: Model | None = None) -> Model:
    """Build a model from dotted names, e.g. `model.R_a`, `effects.coulomb_friction.accel`.

    Args:
        flat: dotted name -> value. Missing parameters of an effect take its defaults.
        name: source of the values for error messages, usually the file.
        base: supplies the missing values. Without it all `model.*` and `sensing.*` names must be given.

    Raises:
        ModelError: unknown name, not a number, out of range, or missing.
    """
    numbers: dict[str, float] = {}
    effects: dict[str, dict[str, float]] = {}
    if base is not None:
        numbers = {f"{section}.{key}": value for section in ("model", "sensing")
                   for key, value in getattr(base, section).items()}
        effects = {id_: dict(parameters) for id_, parameters in base.effects.items()}
    for key, value in with_definitions(flat, name).items():
        section, _, rest = key.partition(".")
        if key in SECTIONS:
            raise ModelError(f"{name}: '{key}' is {value!r}; give its parameters by name, one per line")
        if section == "effects":
            _read_effect(effects, rest, value, name)
        elif key in PARAMETERS:
            p = PARAMETERS[key]
            numbers[key] = _number(key, value, p.low, p.high, p.unit, name)
        else:
            raise _unknown("parameter", key, tuple(PARAMETERS), name)
    numbers = {**{f"model.{key}": 0.0 for key in OPTIONAL}, **numbers}
    if numbers["model.v_full"] > 0.0:
        numbers |= {f"model.{key}": 0.0 for key in DUTY_MAP}
    missing = [key for key in PARAMETERS if key not in numbers]
    if missing:
        raise ModelError(f"{name}: {missing[0]} is missing ({len(missing)} in all); "
                         "a model file gives all parameters that the presets give")
    for id_, parameters in effects.items():
        if id_ != PARAMETER_MISMATCH:
            for key, q in DEFINED[id_].parameters.items():
                parameters.setdefault(key, q.default)
    return Model(name, {n: numbers[f"model.{n}"] for n in MODEL_NAMES},
                 {n: numbers[f"sensing.{n}"] for n in SENSING_NAMES}, effects)


def with_definitions(flat: Mapping[str, object], name: str) -> dict[str, object]:
    """Make the effects known that a model file defines.

    Args:
        flat: dotted name -> value.
        name: source of the values for error messages.

    Returns:
        The values without the definitions.

    Raises:
        EffectError: a definition cannot be used.
    """
    tree: dict[str, object] = {}
    for key, value in flat.items():
        if key.startswith("definitions."):
            _, *path, last = key.split(".")
            inner = tree
            for each in path:
                inner = inner.setdefault(each, {})  # type: ignore[assignment]
                if not isinstance(inner, dict):
                    raise ModelError(f"{name}: {key} cannot be read; a definition has the form of an effect file")
            inner[last] = value
    if tree:
        effect_file.define(tree, name)
    return {key: value for key, value in flat.items() if not key.startswith("definitions.")}


def _read_effect(effects: dict[str, dict[str, float]], rest: str, value: object, where: str) -> None:
    id_, _, parameter = rest.partition(".")
    if id_ not in DEFINED and id_ != PARAMETER_MISMATCH:
        near = difflib.get_close_matches(id_, DEFINED, n=1)
        raise _unknown("effect", id_, tuple(near) or (*CATALOGUE, PARAMETER_MISMATCH), where)
    if not parameter:
        example = "R_a: 1.2" if id_ == PARAMETER_MISMATCH else (
            f"{DEFINED[id_].size}: {DEFINED[id_].parameters[DEFINED[id_].size].default:g}")
        raise ModelError(f"{where}: effects.{id_} has no parameter; give at least one, as in {id_}: {{{example}}}")
    if id_ == PARAMETER_MISMATCH:
        key = f"model.{parameter}"
        if key not in PARAMETERS:
            raise _unknown("number in parameter_mismatch", parameter, MODEL_NAMES, where)
        p = PARAMETERS[key]
        effects.setdefault(id_, {})[parameter] = _number(f"effects.{rest}", value, p.low, p.high, p.unit, where)
        return
    if parameter not in DEFINED[id_].parameters:
        raise _unknown(f"parameter of {id_}", parameter, tuple(DEFINED[id_].parameters), where)
    q = DEFINED[id_].parameters[parameter]
    effects.setdefault(id_, {})[parameter] = _number(f"effects.{rest}", value, q.low, q.high, q.unit, where)


def to_flat(model: Model) -> dict[str, float]:
    """The values of a model: dotted name -> value; `from_flat` reads them where its effects are defined."""
    flat = {f"model.{key}": value for key, value in _given(model).items()}
    flat.update({f"sensing.{key}": value for key, value in model.sensing.items()})
    flat.update({f"effects.{id_}.{key}": value
                 for id_, parameters in model.effects.items() for key, value in parameters.items()})
    return flat


def _given(model: Model) -> dict[str, float]:
    """The parameters of the plant that a file must give, and the others where they are not 0."""
    left_out = {*OPTIONAL, *(DUTY_MAP if model.model.get("v_full", 0.0) > 0.0 else ())}
    return {key: value for key, value in model.model.items() if value != 0.0 or key not in left_out}


def flatten(tree: Mapping[str, object], prefix: str = "") -> dict[str, object]:
    """Turn nested mappings into dotted names; an empty section (as in `effects: {}`) adds nothing.

    Args:
        tree: nested mappings.
        prefix: put before each name.
    """
    flat: dict[str, object] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            flat.update(flatten(value, f"{prefix}{key}."))
        elif value or value == 0 or prefix or key not in SECTIONS:
            flat[f"{prefix}{key}"] = value
    return flat


def load(source: str | Path) -> Model:
    """Read a preset (`bench`, `thesis`) or a model file.

    Args:
        source: name of a preset, or path.

    Raises:
        ModelError: no such preset or file, not a ROS 2 parameter file, or a value in it cannot be used.
    """
    return from_flat(read_flat(source), str(source))


def read_flat(source: str | Path) -> dict[str, object]:
    """Read the values of a preset or a model file, unchecked, by their dotted names.

    Keys outside of the `SECTIONS` are parameters of a node and are left out.

    Args:
        source: name of a preset, or path.

    Raises:
        ModelError: no such preset or file, or not a ROS 2 parameter file.
    """
    name, text = str(source), _text(source)
    try:
        tree = load_yaml(text, NumberLoader)
    except yaml.MarkedYAMLError as error:
        line = f" at line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise ModelError(f"{name}: not valid YAML{line}: {error.problem}; see the presets for the form") from None
    except yaml.YAMLError:
        raise ModelError(f"{name}: not a model file; see the presets for the form") from None
    return _node_parameters(tree, name)


def _text(source: str | Path) -> str:
    """Text of a preset or a model file."""
    if str(source) in PRESETS:
        return (files("aeropend_sim") / "config" / f"{source}.yaml").read_text(encoding="utf-8")
    try:
        return Path(source).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ModelError(f"{source}: no such model file; give a file or a preset ({', '.join(PRESETS)})") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise ModelError(f"{source}: the model file cannot be read: {reason}") from None


def _node_parameters(tree: object, name: str) -> dict[str, object]:
    sections = tree.values() if isinstance(tree, Mapping) else ()
    found = [s["ros__parameters"] for s in sections if isinstance(s, Mapping) and "ros__parameters" in s]
    if len(found) != 1 or not isinstance(found[0], Mapping):
        raise ModelError(f"{name}: not a model file; it starts with '/**:' and 'ros__parameters:' (see the presets)")
    mine: dict[str, object] = {}
    for key, value in found[0].items():
        section, dot, _ = str(key).partition(".")
        if section in SECTIONS:
            mine[str(key)] = value
        elif (dot or isinstance(value, Mapping)) and difflib.get_close_matches(section, SECTIONS, cutoff=0.7):
            raise _unknown("section", section, SECTIONS, name)
    return flatten(mine)


def save(model: Model, path: str | Path, comment: str = "") -> None:
    """Write a model file for the plant node and `load`; `path` is replaced in one step.

    Args:
        model: the model; its `name` is not written.
        path: the file.
        comment: lines at the top of the file; each gets the prefix `# `.

    Raises:
        ModelError: the file cannot be written. An old file is then unchanged.
    """
    tree: dict[str, object] = {"model": _given(model), "sensing": dict(model.sensing)}
    if defined := effect_file.definitions(model.effects):
        tree["definitions"] = defined
    if model.effects:  # rcl's parser refuses an empty mapping
        tree["effects"] = {id_: dict(parameters) for id_, parameters in model.effects.items()}
    head = "".join(f"# {printable(line)}\n" for line in comment.splitlines())
    text = head + yaml.dump({"/**": {"ros__parameters": tree}}, Dumper=_Dumper, sort_keys=False, allow_unicode=True)
    path = Path(path)
    temporary = None
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=path.name)
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        Path(temporary).chmod(0o644)
        Path(temporary).replace(path)
    except BaseException as error:
        if temporary is not None:
            Path(temporary).unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise ModelError(f"{path}: the model file cannot be written: {error.strerror}") from None
        raise


class _Dumper(yaml.SafeDumper):
    """Writes floats so that YAML 1.1 and rcl read the same floats back."""


def _represent_float(dumper: yaml.SafeDumper, value: float) -> yaml.ScalarNode:
    text = repr(float(value))
    if "e" in text and "." not in text:
        text = text.replace("e", ".0e")
    return dumper.represent_scalar("tag:yaml.org,2002:float", text)


_Dumper.add_representer(float, _represent_float)
