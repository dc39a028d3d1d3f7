# SPDX-License-Identifier: Apache-2.0
"""What the readers of both storages share: their types, and limits for files of unknown origin."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2.metadata import parse_qos

from aeropend_sim.errors import UserError
from aeropend_sim.untrusted import check_yaml

if sys.version_info >= (3, 14):
    from compression.zstd import ZstdDecompressor
else:
    from backports.zstd import ZstdDecompressor

__all__ = ["Budget", "Chosen", "Messages", "RecordingError", "ReportProblem", "ZstdDecompressor", "is_name", "pieces",
           "qos_profiles", "unpacked"]

Messages = Iterator[tuple[Connection, int, bytes]]
"""Connection, receive time in ns, serialized message."""

Chosen = Callable[[str, str], bool]
"""Whether the messages of a topic and type are wanted."""

ReportProblem = Callable[[str], None]
"""Called with a line for each problem of a bag."""

LONGEST = 1 << 28
"""[bytes] Longest message or chunk, unpacked. A choice: a longer one is a damaged length."""

MOST_UNPACKED, MOST_RATIO = 1 << 30, 100
"""[bytes], [-] What may be unpacked from a file: so many bytes, or so many times its size if that is more. Choices."""

PIECE = 1 << 24
"""[bytes] Size of the pieces in which a file is unpacked (choice)."""

LONGEST_NAME = 255
"""Characters of the longest name of a topic: the limit of DDS."""


class RecordingError(UserError):
    """A recording cannot be used; the message is one line for the user."""


class Budget:
    """The bytes that a file may still unpack to: a small file that unpacks to very much is not a recording."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._left = max(MOST_UNPACKED, MOST_RATIO * file.stat().st_size)

    def take(self, size: int) -> int:
        """Count bytes, and return their number.

        Raises:
            RecordingError: the file unpacks to too much.
        """
        self._left -= size
        if self._left < 0:
            raise RecordingError(f"{self._file}: unpacks to more than {MOST_RATIO} times its size: not a recording")
        return size


def pieces(decompressor: Any, packed: bytes) -> Iterator[bytes]:
    """Unpack a part of a stream, a piece at a time."""
    yield decompressor.decompress(packed, PIECE)
    while not (decompressor.eof or decompressor.needs_input):
        yield decompressor.decompress(b"", PIECE)


def unpacked(decompressor: Any, packed: bytes) -> bytes:
    """Unpack a chunk or a message, up to where it ends or breaks off.

    Raises:
        ValueError: it is too long. Others: those of the decompressor.
    """
    data = bytes(decompressor.decompress(packed, LONGEST))
    if not (decompressor.eof or decompressor.needs_input):
        raise ValueError(f"it unpacks to more than {LONGEST} bytes")
    return data


def is_name(topic: object, msgtype: object) -> bool:
    """Whether these can be names of a topic and its type; other texts are never printed."""
    return all(isinstance(name, str) and name.isprintable() and len(name) <= LONGEST_NAME for name in (topic, msgtype))


def qos_profiles(text: str) -> list[Qos]:
    """The QoS profiles in a metadata field; none if they cannot be read: a recording is worth more than its QoS."""
    try:
        check_yaml(text)
        return parse_qos(text)
    except Exception:  # PyYAML and rosbags raise many types
        return []
