# SPDX-License-Identifier: Apache-2.0
"""Message types by name: their class, and their definition for a bag."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from rosbags.typesys import get_types_from_msg
from rosbags.typesys.store import Typestore


def message_class(msgtype: str) -> Any:
    """Return the class of "sensor_msgs/msg/JointState".

    Raises:
        LookupError: there is no such type installed.
    """
    package, _, name = msgtype.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise LookupError(f"message type {msgtype} is not installed") from error


def learn(typestore: Typestore, msgtype: str) -> None:
    """Enter a type that rosbags does not know, and those it is made of, from its installed .msg file.

    Raises:
        LookupError: there is no such file, or it cannot be understood.
    """
    if msgtype in typestore.types:
        return
    package, _, name = msgtype.partition("/msg/")
    try:
        from ament_index_python.packages import get_package_share_directory

        file = Path(get_package_share_directory(package)) / "msg" / f"{name}.msg"
        types = get_types_from_msg(file.read_text(encoding="utf-8"), msgtype)
    except Exception as error:  # there may be no ROS; ament's, the file system's and the parser's own
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
