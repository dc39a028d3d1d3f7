# SPDX-License-Identifier: Apache-2.0
"""Message types by name: their class, and their definition for a bag."""

from __future__ import annotations

import importlib
import os
import re
import sys
from pathlib import Path
from typing import Any

from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore

_NAME = re.compile(r"[a-z][a-z0-9_]*/msg/[A-Z][A-Za-z0-9]*")


def message_class(msgtype: str) -> Any:
    """Return the class of "sensor_msgs/msg/JointState".

    Raises:
        LookupError: there is no such type installed.
    """
    definition(msgtype)
    package, _, name = msgtype.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise LookupError(f"message type {msgtype} is not installed") from error


def definition(msgtype: str) -> Path:
    """The .msg file of a type that a ROS package provides: to import anything else would run anybody's code.

    Raises:
        LookupError: there is none.
    """
    package, _, name = msgtype.partition("/msg/")
    prefixes = [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]  # an environment is one, too
    for prefix in filter(None, prefixes) if _NAME.fullmatch(msgtype) else ():
        share = Path(prefix) / "share"
        if (share / "ament_index" / "resource_index" / "rosidl_interfaces" / package).is_file():
            return share / package / "msg" / f"{name}.msg"
    raise LookupError(f"message type {msgtype} is not installed")


def learn(typestore: Typestore, msgtype: str) -> None:
    """Enter a type that rosbags does not know, and those it is made of, from its installed .msg file.

    Raises:
        LookupError: there is no such file, or it cannot be understood.
    """
    if msgtype in typestore.types:
        return
    try:
        types = get_types_from_msg(definition(msgtype).read_text(encoding="utf-8"), msgtype)
    except Exception as error:  # there may be no such type; the file system's and the parser's own
        raise LookupError(f"the definition of message type {msgtype} cannot be had: {error}") from error
    for _, fields in types.values():
        for _, field in fields:
            for part in _types_in(field):
                learn(typestore, part)
    typestore.register(types)


def _types_in(field: Any) -> list[str]:
    if isinstance(field, tuple):
        return [name for part in field for name in _types_in(part)]
    return [field] if isinstance(field, str) and field.count("/") == 2 else []
