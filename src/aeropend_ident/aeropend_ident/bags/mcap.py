# SPDX-License-Identifier: Apache-2.0
"""MCAP files, read from front to back without their index.

One that was cut anywhere gives every whole message before the cut, by the same code that reads a whole file.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from pathlib import Path

from lz4.frame import LZ4FrameDecompressor
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat

from aeropend_ident.bags.reading import (
    LONGEST,
    Budget,
    Chosen,
    Messages,
    RecordingError,
    ReportProblem,
    ZstdDecompressor,
    is_name,
    qos_profiles,
    unpacked,
)

_MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0F
_LAST_OPCODE = 0x0F
_head = struct.Struct("<BQ")  # opcode, length of the record
_message_head = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
_LATEST = (1 << 63) - 1  # ns


def read_mcap(file: Path, chosen: Chosen | None, report: ReportProblem, counts: Counter[tuple[str, str]]) -> Messages:
    """Read the records of an MCAP file in turn, to its end or to where it breaks off.

    Args:
        file: to read.
        chosen: which messages are wanted; None: all.
        report: called with each problem.
        counts: gets the number of messages by topic and type, chosen or not.

    Raises:
        RecordingError: it is no MCAP file.
    """
    size = file.stat().st_size
    with file.open("rb") as stream:
        if size == 0:
            report(f"{file.name} is empty: the recording was broken off before anything was written")
            return
        if stream.read(8) != _MAGIC:
            raise RecordingError(f"{file}: not an MCAP file")
        records = _Records(chosen, counts)
        budget = Budget(file)
        closed = garbled = False
        while len(head := stream.read(_head.size)) == _head.size:
            opcode, length = _head.unpack(head)
            if not 0 < opcode <= _LAST_OPCODE and opcode < 0x80:  # from 0x80 on they are private: skipped
                garbled = True
                break
            if opcode == _DATA_END:
                closed = True
                break
            left = size - stream.tell()
            if left < length:  # it may be growing
                size = file.stat().st_size
                left = max(size - stream.tell(), 0)
            if length > LONGEST and opcode in (_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK):
                garbled = True
                break
            if opcode == _CHUNK:
                body = stream.read(min(length, left))
                chunk = _Chunk(body, whole=length <= left)
                if chunk.damage:
                    report(f"{file.name}: a chunk before byte {stream.tell()} is damaged: {chunk.damage}")
                budget.take(len(chunk.data))
                yield from records.read(chunk.data)
            elif length > left:
                garbled = length > LONGEST
                break
            elif opcode in (_SCHEMA, _CHANNEL, _MESSAGE):
                yield from records.read(head + stream.read(length))
            else:
                stream.seek(length, 1)
        if records.strays:
            report(f"{file.name}: {records.strays} messages belong to no known topic")
        if garbled:
            place = stream.tell() - _head.size
            report(f"{file.name} cannot be read past byte {place} of {size}: what comes after is lost")
            return
        stream.seek(-8, 2)
        if closed and stream.read(8) == _MAGIC:
            return
        if closed:
            report(f"{file.name} ends inside its index: the recording was broken off, no message is lost")
        else:
            report(f"{file.name} ends without its index: the recording was broken off, its last moments are lost")


class _Chunk:
    """The records inside an MCAP chunk, as far as they can be unpacked."""

    def __init__(self, body: bytes, *, whole: bool) -> None:
        self.data = b""
        self.damage = ""
        try:
            size, check, name_length = struct.unpack_from("<QII", body, 16)
            compression = body[32 : 32 + name_length].decode()
            start = 32 + name_length + 8
            (length,) = struct.unpack_from("<Q", body, start - 8)
        except (struct.error, UnicodeDecodeError):
            return  # cut inside its head, or zeros
        packed = body[start : start + length]
        try:
            if not compression:
                self.data = packed
            elif compression == "zstd":
                self.data = unpacked(ZstdDecompressor(), packed)
            elif compression == "lz4":
                self.data = unpacked(LZ4FrameDecompressor(), packed)
            else:
                self.damage = f"compression {compression!r} is not known"
        except Exception as error:  # the decompressors raise types of their own
            self.damage = str(error)
            return
        if whole and not self.damage and (len(self.data) != size or (check and zlib.crc32(self.data) != check)):
            self.damage, self.data = "its checksum or size is wrong", b""


class _Records:
    """Schemas, channels and messages, in the order of the file."""

    def __init__(self, chosen: Chosen | None, counts: Counter[tuple[str, str]]) -> None:
        self.chosen = chosen
        self.counts = counts
        self.strays = 0
        self.schemas: dict[int, tuple[str, str, str]] = {}  # name, encoding, text
        self.connections: dict[int, Connection] = {}
        self.wanted: dict[int, Connection] = {}

    def read(self, data: bytes) -> Messages:
        """Yield the chosen messages in a run of records; a message that is cut ends the run."""
        position, end = 0, len(data)
        seen: Counter[int] = Counter()
        wanted, unpack, count = self.wanted, _message_head.unpack_from, seen.update
        tally: list[int] = []
        try:
            while position + 9 <= end:
                opcode = data[position]
                if opcode == _MESSAGE:
                    if position + 31 > end:
                        break
                    _, length, channel, _, time, _ = unpack(data, position)
                    start, position = position + 31, position + 9 + length
                    if position > end or length < 22:
                        break
                    tally.append(channel)
                    connection = wanted.get(channel)
                    if connection is not None and time <= _LATEST:
                        yield connection, time, data[start:position]
                else:
                    _, length = _head.unpack_from(data, position)
                    start, position = position + 9, position + 9 + length
                    if position > end:
                        break
                    if opcode == _SCHEMA:
                        self._schema(data[start:position])
                    elif opcode == _CHANNEL:
                        self._channel(data[start:position])
        finally:
            count(tally)
            for channel, number in seen.items():
                known = self.connections.get(channel)
                if known is None:
                    self.strays += number
                else:
                    self.counts[known.topic, known.msgtype] += number

    def _schema(self, body: bytes) -> None:
        try:
            (key,) = struct.unpack_from("<H", body)
            name, place = _text(body, 2)
            encoding, place = _text(body, place)
            text, _ = _text(body, place)
        except (struct.error, UnicodeDecodeError):
            return
        self.schemas[key] = (name, encoding, text)

    def _channel(self, body: bytes) -> None:
        try:
            key, schema = struct.unpack_from("<HH", body)
            topic, place = _text(body, 4)
            encoding, place = _text(body, place)
            (length,) = struct.unpack_from("<I", body, place)
            end, place = place + 4 + length, place + 4
            extra = {}
            while place < end:
                name, place = _text(body, place)
                extra[name], place = _text(body, place)
        except (struct.error, UnicodeDecodeError):
            return
        msgtype, form, text = self.schemas.get(schema, ("", "", ""))
        if not is_name(topic, msgtype):
            return
        connection = Connection(
            id=key,
            topic=topic,
            msgtype=msgtype,
            msgdef=MessageDefinition(_FORMATS.get(form, MessageDefinitionFormat.NONE), text),
            digest=extra.get("topic_type_hash", ""),
            msgcount=0,
            ext=ConnectionExtRosbag2(encoding, qos_profiles(extra.get("offered_qos_profiles", ""))),
            owner=None,
        )
        if self.connections.get(key) == connection:
            return
        self.connections[key] = connection
        self.counts[topic, msgtype] += 0
        if self.chosen is None or self.chosen(topic, msgtype):
            self.wanted[key] = connection


def _text(body: bytes, place: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", body, place)
    end = place + 4 + length
    return body[place + 4 : end].decode(), end
