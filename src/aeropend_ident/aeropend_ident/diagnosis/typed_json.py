# SPDX-License-Identifier: Apache-2.0
"""JSON from frozen dataclasses and back, and the schema of that JSON.

A field becomes a key of the same name, or of the name in its metadata: `field(metadata={"key": NAME})`. A field with a
default is an optional key, left out where the field has its default. Other keys are always there, `null` for None.

Types of fields: `bool`, `int`, `float`, `str`, dataclasses, unions, `Mapping[str, T]`, `tuple[T, ...]` and
`tuple[T, T]` of these. An integer is a valid `float` and stays an integer. Keys that have no field are ignored.
"""

from __future__ import annotations

import types
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")

SCALARS: dict[Any, tuple[tuple[type, ...], str]] = {
    bool: ((bool,), "boolean"), int: ((int,), "integer"), float: ((int, float), "number"), str: ((str,), "string"),
    types.NoneType: ((types.NoneType,), "null"),
}
"""Type of a field -> types of its values in Python, name in a JSON schema."""


class JsonError(ValueError):
    """A value has the wrong type or is missing; the message begins with the path of the value."""


def to_json(value: object) -> Any:
    """The value as dicts, lists and scalars."""
    if is_dataclass(value):
        pairs = [(f, getattr(value, f.name)) for f in fields(value)]
        return {_key(f): to_json(x) for f, x in pairs if _required(f) or x != _default(f)}
    if isinstance(value, Mapping):
        return {key: to_json(x) for key, x in value.items()}
    return [to_json(x) for x in value] if isinstance(value, (list, tuple)) else value


def from_json(kind: type[T], data: object) -> T:
    """Read a dataclass.

    Args:
        kind: the dataclass.
        data: what `json.loads` returns.

    Raises:
        JsonError: a value is missing or has the wrong type.
    """
    value: T = _read(kind, data, "")
    return value


def schema(kind: type) -> dict[str, object]:
    """The JSON schema (draft 2020-12) of a dataclass; the descriptions come from the docstrings."""
    definitions: dict[str, object] = {}
    _schema(kind, definitions)
    top = definitions.pop(kind.__name__)
    assert isinstance(top, dict)
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": kind.__name__, **top,
            "$defs": definitions}


def _key(f: Field[Any]) -> str:
    return str(f.metadata.get("key", f.name))


def _read(hint: Any, data: object, path: str) -> Any:
    arguments = get_args(hint)
    if hint in SCALARS:
        accepted, name = SCALARS[hint]
        if not isinstance(data, accepted) or (isinstance(data, bool) and hint is not bool):
            raise _wrong(path, f"a {name}" if name != "integer" else "an integer", data)
        return data
    if is_dataclass(hint):
        return _read_object(hint, data, path)
    if get_origin(hint) in (Union, types.UnionType):
        return _read_union(arguments, data, path)
    if get_origin(hint) is tuple:
        if not isinstance(data, list):
            raise _wrong(path, "a list", data)
        if arguments[1] is not Ellipsis and len(data) != len(arguments):
            raise _wrong(path, f"a list of {len(arguments)} values", data)
        return tuple(_read(arguments[0], x, f"{path}[{k}]") for k, x in enumerate(data))
    return {key: _read(arguments[1], x, _below(path, key)) for key, x in _object(data, path).items()}


def _read_object(kind: Any, data: object, path: str) -> Any:
    found, hints = _object(data, path), get_type_hints(kind)
    values = {}
    for f in fields(kind):
        if _key(f) in found:
            values[f.name] = _read(hints[f.name], found[_key(f)], _below(path, _key(f)))
        elif _required(f):
            raise JsonError(f"{_below(path, _key(f))} is missing")
    return kind(**values)


def _required(f: Field[Any]) -> bool:
    return f.default is MISSING and f.default_factory is MISSING


def _default(f: Field[Any]) -> object:
    return f.default if f.default_factory is MISSING else f.default_factory()


def _read_union(members: tuple[Any, ...], data: object, path: str) -> Any:
    if data is None and types.NoneType in members:
        return None
    others = [m for m in members if m is not types.NoneType]
    for member in others[:-1]:
        with suppress(JsonError):
            return _read(member, data, path)
    return _read(others[-1], data, path)


def _object(data: object, path: str) -> Mapping[str, object]:
    if not isinstance(data, Mapping):
        raise _wrong(path, "an object", data)
    return data


def _below(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key


def _wrong(path: str, expected: str, data: object) -> JsonError:
    text = repr(data)
    text = text if len(text) <= 40 else f"{text[:40]}..."
    return JsonError(f"{path or 'the document'} must be {expected}, not {text}")


def _schema(hint: Any, definitions: dict[str, object]) -> dict[str, object]:
    """The schema of a type; those of dataclasses go to `definitions`."""
    arguments = get_args(hint)
    if hint in SCALARS:
        return {"type": SCALARS[hint][1]}
    if is_dataclass(hint):
        name = getattr(hint, "__name__", "")
        if name not in definitions:
            definitions[name] = {}  # holds the place in the order
            definitions[name] = _schema_of_object(hint, definitions)
        return {"$ref": f"#/$defs/{name}"}
    if get_origin(hint) in (Union, types.UnionType):
        return _any_of(arguments, definitions)
    if get_origin(hint) is tuple:
        length = {} if arguments[1] is Ellipsis else {"minItems": len(arguments), "maxItems": len(arguments)}
        return {"type": "array", "items": _schema(arguments[0], definitions), **length}
    return {"type": "object", "additionalProperties": _schema(arguments[1], definitions)}


def _any_of(members: Sequence[Any], definitions: dict[str, object]) -> dict[str, object]:
    each = [_schema(member, definitions) for member in members]
    return each[0] if len(each) == 1 else {"anyOf": each}


def _schema_of_object(kind: Any, definitions: dict[str, object]) -> dict[str, object]:
    said, hints = _descriptions(kind), get_type_hints(kind)
    properties = {}
    for f in fields(kind):
        described = {"description": said[f.name]} if f.name in said else {}
        members = [hints[f.name]]
        if f.default is None:  # left out instead of null
            members = [m for m in get_args(hints[f.name]) if m is not types.NoneType]
        properties[_key(f)] = {**described, **_any_of(members, definitions)}
    return {"description": (kind.__doc__ or "").partition("\n")[0], "type": "object", "properties": properties,
            "required": [_key(f) for f in fields(kind) if _required(f)]}


def _descriptions(kind: Any) -> dict[str, str]:
    """Field -> its text in the `Attributes:` of the docstring."""
    texts: dict[str, str] = {}
    name = ""
    for line in (kind.__doc__ or "").partition("Attributes:")[2].splitlines():
        first, colon, text = line.strip().partition(":")
        if colon and len(line) - len(line.lstrip()) == 8:
            name, texts[first] = first, text.strip()
        elif line.strip() and name:
            texts[name] += f" {line.strip()}"
    return texts
