# SPDX-License-Identifier: Apache-2.0
"""The file of an excitation signal: a ROS 2 parameter file, which `excite` plays."""

from __future__ import annotations

import sys
from dataclasses import asdict, fields
from pathlib import Path

import yaml

from aeropend_sim import yaml_file
from aeropend_sim.errors import UserError
from aeropend_sim.model.excitation import Excitation
from aeropend_sim.untrusted import printable


class _Dumper(yaml.SafeDumper):
    """Writes a list on one line."""


_Dumper.add_representer(list, lambda dumper, x: dumper.represent_sequence("tag:yaml.org,2002:seq", x, flow_style=True))


class ExcitationFileError(UserError):
    """A file of a signal that cannot be read or written. The message is one line."""


def save(x: Excitation, path: str | Path, comment: str = "") -> None:
    """Write a signal as a parameter file of `excite`; defaults are left out.

    Args:
        x: the signal.
        path: the file.
        comment: lines at its top.

    Raises:
        ExcitationFileError: it cannot be written.
    """
    default = asdict(Excitation())
    always = ("kind", "duration", *(("sequence", "holds") if x.kind == "holds" else ()))
    own = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(x).items() if k in always or v != default[k]}
    head = "".join(f"# {printable(line)}\n" for line in comment.splitlines())
    text = head + yaml.dump({"/**": {"ros__parameters": own}}, Dumper=_Dumper, sort_keys=False, width=110)
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        raise ExcitationFileError(f"{path}: the signal cannot be written: {error.strerror}") from None


def load(path: str | Path) -> Excitation:
    """Read a signal.

    Args:
        path: of a parameter file of `excite`.

    Raises:
        UserError: there is no such file, or it holds no signal.
    """
    tree = yaml_file.read(path, "a file of a signal", ExcitationFileError)
    own = tree
    for name in ("/**", "ros__parameters"):
        own = own.get(name) if isinstance(own, dict) else None
    if not isinstance(own, dict):
        raise ExcitationFileError(f"{path}: no signal: give a parameter file of excite, as `design` writes it")
    types = {f.name: f.type for f in fields(Excitation)}
    values: dict[str, object] = {}
    for name, value in own.items():
        if name not in types:
            raise ExcitationFileError(f"{path}: '{printable(str(name))}' is no parameter of a signal; give some of "
                                      f"{', '.join(types)}")
        values[str(name)] = _typed(value, getattr(Excitation(), str(name)), f"{path}: {name}")
    try:
        return Excitation(**values)  # type: ignore[arg-type]
    except UserError as error:
        raise ExcitationFileError(f"{path}: {error}") from None


def _typed(value: object, default: object, where: str) -> object:
    """A value with the type of its default."""
    if isinstance(default, str) and isinstance(value, str):
        return value
    several = isinstance(default, tuple)
    values = value if isinstance(value, list) else [value]
    numbers = [x for x in values
               if isinstance(x, (int, float)) and not isinstance(x, bool) and abs(x) <= sys.float_info.max]
    if isinstance(default, str) or several != isinstance(value, list) or len(numbers) < max(len(values), 1):
        kind = "a name" if isinstance(default, str) else "a list of numbers" if several else "a number"
        raise ExcitationFileError(f"{where}: give {kind}")
    if several:
        return tuple(map(float, numbers))
    if not isinstance(default, int):
        return float(numbers[0])
    if numbers[0] != int(numbers[0]):  # excite does not round either
        raise ExcitationFileError(f"{where}: give a whole number")
    return int(numbers[0])
