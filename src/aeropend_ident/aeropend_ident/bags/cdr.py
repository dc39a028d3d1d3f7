# SPDX-License-Identifier: Apache-2.0
"""Many serialized messages of one type into arrays at once.

Messages a robot sends at a fixed rate nearly all have the same layout: the same joints, the same frame name, only the
numbers change. The layout is worked out once, on the first message, and the numbers of all messages that share it are
read in one step. Every byte that fixes the layout (encapsulation, counts, names) is compared first, so a message of
another layout starts a block of its own; what cannot be laid out is decoded one by one by rosbags.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

LONGEST = 1 << 16
"""Bytes of a message; a longer one is no sample of a rig and is not decoded."""
MAX_LAYOUTS = 32
"""A series with more layouts than this is not regular: the rest is decoded one by one."""

_NUMBERS = {
    "bool": "u1", "byte": "u1", "char": "u1", "octet": "u1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Block:
    """Messages of one layout.

    Attributes:
        rows: (n,) positions of these messages in the series they came from.
        numbers: field name with dots ("header.stamp.sec") -> (n,) array, or (n, k) for a sequence of k numbers.
        names: field name -> the strings of a string sequence, the same in all n messages.
    """

    rows: NDArray[np.int64]
    numbers: dict[str, NDArray[Any]]
    names: dict[str, tuple[str, ...]]


def decode(messages: Sequence[bytes], msgtype: str) -> tuple[list[Block], list[int]]:
    """Decode a series of CDR messages of one type.

    Args:
        messages: serialized messages, as recorded (encapsulation header first).
        msgtype: type name of all of them, "sensor_msgs/msg/JointState".

    Returns:
        Blocks of messages that share a layout, and the rows of messages that could not be decoded.
    """
    blocks: list[Block] = []
    single: list[int] = []
    lengths = np.fromiter(map(len, messages), dtype=np.int64, count=len(messages))
    layouts = 0
    failed = np.flatnonzero(lengths > LONGEST).tolist()
    for length in np.unique(lengths[lengths <= LONGEST]):
        rows = np.flatnonzero(lengths == length)
        picked = messages if len(rows) == len(messages) else [messages[row] for row in rows.tolist()]
        raw = np.frombuffer(b"".join(picked), dtype=np.uint8).reshape(len(rows), length)
        while len(rows):
            layouts += 1
            try:
                if layouts > MAX_LAYOUTS:
                    raise ValueError("too many layouts")
                layout = _Layout(raw[0].tobytes(), msgtype)
            except (ValueError, KeyError, struct.error):
                same = np.zeros(len(rows), dtype=bool)
                same[: None if layouts > MAX_LAYOUTS else 1] = True
                single.extend(rows[same].tolist())
            else:
                same = (raw[:, layout.fixed] == raw[0, layout.fixed]).all(axis=1)
                blocks.append(layout.read(rows[same], raw[same]))
            rows, raw = rows[~same], raw[~same]
    for row in sorted(single):
        block = _decode_one(row, messages[row], msgtype)
        if block is None:
            failed.append(row)
        else:
            blocks.append(block)
    return blocks, failed


def encode(template: bytes, msgtype: str, numbers: Mapping[str, NDArray[Any]]) -> list[bytes]:
    """Serialize a series of messages that differ in numbers only: the inverse of `decode`.

    Args:
        template: one of them, serialized.
        msgtype: its type.
        numbers: field name with dots -> (n,) array, or (n, k) for a sequence of k numbers; what is left out stays as
            in the template.

    Raises:
        ValueError, KeyError: the template has no such layout or field.
    """
    layout = _Layout(template, msgtype)
    count = len(next(iter(numbers.values())))
    raw = np.tile(np.frombuffer(template, dtype=np.uint8), (count, 1))
    table = raw.view(layout.dtype(len(template)))[:, 0]
    for name, values in numbers.items():
        table[name] = values
    whole, size = raw.tobytes(), len(template)
    return [whole[k * size : (k + 1) * size] for k in range(count)]


class _Layout:
    """Where the fields of one message are (CDR version 1, either byte order)."""

    def __init__(self, message: bytes, msgtype: str) -> None:
        """Lay out a message.

        Raises:
            ValueError: not a plain CDR message, or a field this class does not lay out.
            struct.error: the message ends early.
        """
        if message[:2] not in (b"\x00\x00", b"\x00\x01"):
            raise ValueError("not plain CDR")
        self.order = "<" if message[1] else ">"
        self.message = message
        self.position = 4
        self.fields: dict[str, tuple[str, int, int | None]] = {}  # name -> dtype, offset, count (None: a scalar)
        self.names: dict[str, tuple[str, ...]] = {}
        fixed: list[range] = [range(2)]
        self._walk(msgtype, "", fixed)
        if self.position > len(message):
            raise ValueError("message ends early")
        self.fixed = np.fromiter((byte for part in fixed for byte in part), dtype=np.int64)

    def read(self, rows: NDArray[np.int64], raw: NDArray[np.uint8]) -> Block:
        """Read the numbers of messages of this layout: raw is (n, length)."""
        table = np.ascontiguousarray(raw).view(self.dtype(raw.shape[1]))[:, 0]
        return Block(rows, {name: table[name] for name in self.fields}, self.names)

    def dtype(self, size: int) -> np.dtype[Any]:
        """The numbers of a message of `size` bytes as a structured type."""
        kinds = [(self.order + kind, () if count is None else (count,)) for kind, _, count in self.fields.values()]
        offsets = [offset for _, offset, _ in self.fields.values()]
        return np.dtype({"names": list(self.fields), "formats": kinds, "offsets": offsets, "itemsize": max(size, 1)})

    def _walk(self, msgtype: str, prefix: str, fixed: list[range]) -> None:
        for name, (node, detail) in _fields(msgtype):
            key = prefix + name
            if node == Nodetype.NAME:
                self._walk(detail, key + ".", fixed)
            elif node == Nodetype.BASE:
                if detail[0] == "string":
                    self._string(fixed, with_text=False)
                else:
                    self._numbers(key, detail[0], None)
            else:
                (inner, base), size = detail
                if inner != Nodetype.BASE:
                    raise ValueError("a sequence of messages")
                count = size if node == Nodetype.ARRAY else self._count(fixed)
                if base[0] == "string":
                    self.names[key] = tuple(self._string(fixed, with_text=True) for _ in range(count))
                else:
                    self._numbers(key, base[0], count)

    def _align(self, size: int) -> None:
        self.position += -(self.position - 4) % size  # the encapsulation header does not count

    def _count(self, fixed: list[range]) -> int:
        self._align(4)
        (count,) = struct.unpack_from(self.order + "I", self.message, self.position)
        fixed.append(range(self.position, self.position + 4))
        self.position += 4
        if count > len(self.message):  # every element takes a byte at least
            raise ValueError("count runs past the message")
        return int(count)

    def _string(self, fixed: list[range], *, with_text: bool) -> str:
        length = self._count(fixed)
        start, self.position = self.position, self.position + length
        if self.position > len(self.message):
            raise ValueError("string runs past the message")
        if not with_text:
            return ""
        fixed.append(range(start, self.position))
        return self.message[start : self.position].rstrip(b"\0").decode()

    def _numbers(self, key: str, base: str, count: int | None) -> None:
        kind = _NUMBERS[base]
        size = int(kind[1])
        if count != 0:
            self._align(size)
        self.fields[key] = (kind, self.position if count != 0 else 0, count)
        self.position += size * (1 if count is None else count)


def _decode_one(row: int, message: bytes, msgtype: str) -> Block | None:
    """Decode one message with rosbags; None when it cannot."""
    try:
        decoded = _typestore().deserialize_cdr(message, msgtype)
    except Exception:  # whatever is in the file, rosbags' decoder raises what its slices raise
        return None
    numbers: dict[str, NDArray[Any]] = {}
    names: dict[str, tuple[str, ...]] = {}
    for key, value in _flat(decoded, msgtype, ""):
        if isinstance(value, list):
            names[key] = tuple(value)
        elif not isinstance(value, str):
            numbers[key] = np.asarray(value)[np.newaxis]
    return Block(np.array([row], dtype=np.int64), numbers, names)


def _flat(message: Any, msgtype: str, prefix: str) -> Iterator[tuple[str, Any]]:
    for name, (node, detail) in _fields(msgtype):
        value = getattr(message, name)
        if node == Nodetype.NAME:
            yield from _flat(value, detail, prefix + name + ".")
        else:
            yield prefix + name, value


def _fields(msgtype: str) -> Iterable[tuple[str, tuple[Any, Any]]]:
    return _typestore().get_msgdef(msgtype).fields


@lru_cache(maxsize=1)
def _typestore() -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY)
