# SPDX-License-Identifier: Apache-2.0
"""The raw messages of a rosbag2 bag, whole or broken off.

rosbags reads whole bags; it refuses a recording whose process was killed. Here an MCAP file is read from front to back
without its index, so one that was cut anywhere gives every whole message before the cut, by the same code that reads a
whole one. SQLite files are read by rosbags, and row by row where they are damaged. What was wrong is said in
`Bag.problems`. Nothing is ever written to a bag here.
"""

from __future__ import annotations

import shutil
import sqlite3
import struct
import sys
import tempfile
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path, PurePosixPath
from typing import Any

import yaml
from lz4.frame import LZ4FrameDecompressor
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat, Qos
from rosbags.rosbag2 import Reader
from rosbags.rosbag2.metadata import parse_qos

from aeropend_sim.errors import UserError
from aeropend_sim.untrusted import check_yaml, load_yaml, one_line

if sys.version_info >= (3, 14):
    from compression.zstd import ZstdDecompressor
else:
    from backports.zstd import ZstdDecompressor

Messages = Iterator[tuple[Connection, int, bytes]]
"""Connection, receive time in ns, serialized message."""

Chosen = Callable[[str, str], bool]
Say = Callable[[str], None]

NEWEST_VERSION = 9
UNFINISHED = "unfinished"
"""Key in a bag's custom data while `record` runs: a bag that still has it was not closed."""
STORAGES = {".mcap": "mcap", ".db3": "sqlite3"}

_MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0F
_LAST_OPCODE = 0x0F
_LONGEST = 1 << 28  # bytes of a message or a chunk, unpacked; one that says it is longer says nonsense
_MOST, _RATIO = 1 << 30, 100  # bytes that may be unpacked from a file; or so many times its size, whichever is more
_PIECE = 1 << 24  # bytes unpacked at once
_head = struct.Struct("<BQ")  # opcode, length of what follows
_message_head = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
_BATCH = 256  # rows salvaged at once
_LATEST = (1 << 63) - 1  # ns
_LONGEST_NAME = 255  # characters of a topic's name, as DDS has it


class RecordingError(UserError):
    """A recording cannot be used; the message is one line for the user."""


class Bag:
    """One bag: a rosbag2 folder, or a bare .mcap or .db3 file (also with .zstd behind it).

    Attributes:
        path: as given.
        storage: "mcap" or "sqlite3".
        problems: what is wrong with the bag, one line each; complete after all messages were read.
        counts: messages met so far by (topic, type), chosen or not; complete after all messages were read.
    """

    def __init__(self, path: Path | str) -> None:
        """Find the files of a bag.

        Raises:
            RecordingError: there is no bag at `path`.
        """
        self.path = Path(path)
        self.problems: list[str] = []
        self.counts: Counter[tuple[str, str]] = Counter()
        self._per_message_zstd = False
        try:
            if not self.path.exists():
                raise RecordingError(f"{path}: no such file or folder")
            self._files = self._files_of_folder() if self.path.is_dir() else [self.path]
        except OSError as error:
            raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
        kinds = {_storage_suffix(file) for file in self._files}
        if len(kinds) != 1 or None in kinds:
            names = ", ".join(file.name for file in self._files)
            raise RecordingError(f"{path}: not a bag: {names} (expected .mcap or .db3 files)")
        self.storage = STORAGES[kinds.pop() or ""]

    def messages(self, chosen: Chosen | None = None) -> Messages:
        """Read the bag from front to back, in the order of its files.

        Args:
            chosen: tells by topic and type whether its messages are wanted; all when left out.

        Yields:
            Connection, receive time (ns) and serialized message. Connections of one topic in several files differ.

        Raises:
            RecordingError: a file cannot be opened.
        """
        self.counts.clear()
        for file in self._files:
            with ExitStack() as stack:
                reader = _read_mcap if self.storage == "mcap" else _read_sqlite
                try:
                    plain = self._unzipped(file, stack) if file.suffix == ".zstd" else file
                    budget = _Budget(file)
                    for connection, time, data in reader(plain, chosen, self._say, self.counts):
                        if self._per_message_zstd:
                            data = self._unzip(data)
                            budget.take(len(data))
                        yield connection, time, data
                except OSError as error:
                    raise RecordingError(f"{file}: cannot be read: {error.strerror}") from error

    def _say(self, problem: str) -> None:
        problem = one_line(problem)
        if problem not in self.problems:  # a bag may be read twice
            self.problems.append(problem)

    def _files_of_folder(self) -> list[Path]:
        folder = self.path
        found = sorted(file for file in folder.iterdir() if file.is_file() and _storage_suffix(file))
        metadata = folder / "metadata.yaml"
        if not metadata.is_file():
            if not found:
                raise RecordingError(f"{folder}: not a bag: no metadata.yaml and no .mcap or .db3 file in it")
            self._say("metadata.yaml is missing: the recording was broken off")
            return found
        try:
            information = load_yaml(metadata.read_bytes())
            information = information["rosbag2_bagfile_information"]
            named = [folder / PurePosixPath(name).name for name in information["relative_file_paths"]]
            version = int(information["version"])
            mode = str(information.get("compression_mode") or "").lower()
            form = str(information.get("compression_format") or "")
            custom = dict(information.get("custom_data") or {})
        except (yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            if not found:
                raise RecordingError(f"{folder}: not a bag: metadata.yaml is damaged and alone") from error
            self._say("metadata.yaml is damaged")
            return found
        if version > NEWEST_VERSION:
            self._say(f"bag version {version} is newer than version {NEWEST_VERSION}, which is known here")
        if UNFINISHED in custom:
            self._say("the recording was not closed (killed, or still running): it may end up to a second early")
        self._per_message_zstd = mode == "message"
        if mode not in ("", "none") and form != "zstd":
            raise RecordingError(f"{folder}: compressed with {form!r}, only zstd can be read")
        files = [file for file in named if file.is_file()]
        if missing := [file.name for file in named if not file.is_file()]:
            self._say(f"missing though metadata.yaml names it: {', '.join(missing)}")
        if not files and not found:
            raise RecordingError(f"{folder}: holds none of the files its metadata.yaml names: {', '.join(missing)}")
        return files or found

    def _unzipped(self, file: Path, stack: ExitStack) -> Path:
        """Unpack a file compressed as a whole, as far as it goes."""
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="aeropend-"))
        plain = Path(folder) / file.stem
        decompressor = ZstdDecompressor()
        with file.open("rb") as packed, plain.open("wb") as out:
            try:
                budget = _Budget(file)
                while not decompressor.eof and (part := packed.read(1 << 20)):
                    for piece in _pieces(decompressor, part):
                        budget.take(out.write(piece))
            except RecordingError:
                raise
            except Exception as error:  # the type differs between Python's own module and its backport
                self._say(f"{file.name}: damaged: {error}")
        if not decompressor.eof:
            self._say(f"{file.name}: compressed data ends early")
        return plain

    def _unzip(self, data: bytes) -> bytes:
        try:
            return _unpacked(ZstdDecompressor(), data)
        except Exception:  # as above; what is left empty is not understood further on
            return b""


class _Budget:
    """How much a file may unpack to: what comes out of a small file in vast amounts is no recording."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._left = max(_MOST, _RATIO * file.stat().st_size)

    def take(self, size: int) -> int:
        """Count bytes, and return how many they were.

        Raises:
            RecordingError: it is too much.
        """
        self._left -= size
        if self._left < 0:
            raise RecordingError(f"{self._file}: unpacks to more than {_RATIO} times its size: not a recording")
        return size


def _pieces(decompressor: Any, packed: bytes) -> Iterator[bytes]:
    """Unpack a part of a stream, a piece at a time."""
    yield decompressor.decompress(packed, _PIECE)
    while not (decompressor.eof or decompressor.needs_input):
        yield decompressor.decompress(b"", _PIECE)


def _unpacked(decompressor: Any, packed: bytes) -> bytes:
    """Unpack a chunk or a message, as far as it is there.

    Raises:
        ValueError: it is too long. Others: the decompressor's own.
    """
    data = bytes(decompressor.decompress(packed, _LONGEST))
    if not (decompressor.eof or decompressor.needs_input):
        raise ValueError(f"it unpacks to more than {_LONGEST} bytes")
    return data


def _storage_suffix(file: Path) -> str | None:
    suffix = Path(file.stem).suffix if file.suffix == ".zstd" else file.suffix
    return suffix if suffix in STORAGES else None


# ---- MCAP ------------------------------------------------------------------------------------------------------------


def _read_mcap(
    file: Path, chosen: Chosen | None, say: Say, counts: Counter[tuple[str, str]]
) -> Messages:
    """Read the records of an MCAP file in turn, to its end or to where it breaks off."""
    size = file.stat().st_size
    with file.open("rb") as stream:
        if size == 0:
            say(f"{file.name} is empty: the recording was broken off before anything was written")
            return
        if stream.read(8) != _MAGIC:
            raise RecordingError(f"{file}: not an MCAP file")
        records = _Records(chosen, counts)
        budget = _Budget(file)
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
            if length > _LONGEST and opcode in (_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK):
                garbled = True
                break
            if opcode == _CHUNK:
                body = stream.read(min(length, left))
                chunk = _Chunk(body, whole=length <= left)
                if chunk.damage:
                    say(f"{file.name}: a chunk before byte {stream.tell()} is damaged: {chunk.damage}")
                budget.take(len(chunk.data))
                yield from records.read(chunk.data)
            elif length > left:
                garbled = length > _LONGEST
                break
            elif opcode in (_SCHEMA, _CHANNEL, _MESSAGE):
                yield from records.read(head + stream.read(length))
            else:
                stream.seek(length, 1)
        if records.strays:
            say(f"{file.name}: {records.strays} messages belong to no known topic")
        if garbled:
            place = stream.tell() - _head.size
            say(f"{file.name} cannot be read past byte {place} of {size}: what comes after is lost")
            return
        stream.seek(-8, 2)
        if closed and stream.read(8) == _MAGIC:
            return
        if closed:
            say(f"{file.name} ends inside its index: the recording was broken off, no message is lost")
        else:
            say(f"{file.name} ends without its index: the recording was broken off, its last moments are lost")


class _Chunk:
    """The records inside an MCAP chunk, as far as they can be had."""

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
                self.data = _unpacked(ZstdDecompressor(), packed)
            elif compression == "lz4":
                self.data = _unpacked(LZ4FrameDecompressor(), packed)
            else:
                self.damage = f"compression {compression!r} is not known"
        except Exception as error:  # the decompressors raise types of their own
            self.damage = str(error)
            return
        if whole and not self.damage and (len(self.data) != size or (check and zlib.crc32(self.data) != check)):
            self.damage, self.data = "its checksum or size is wrong", b""


class _Records:
    """Schemas, channels and messages as they come."""

    def __init__(self, chosen: Chosen | None, counts: Counter[tuple[str, str]]) -> None:
        self.chosen = chosen
        self.counts = counts
        self.strays = 0
        self.schemas: dict[int, tuple[str, str, str]] = {}  # name, encoding, text
        self.connections: dict[int, Connection] = {}
        self.wanted: dict[int, Connection] = {}

    def read(self, data: bytes) -> Messages:
        """Yield the chosen ones of the whole messages in a run of records."""
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
        if not _is_name(topic, msgtype):
            return
        connection = Connection(
            id=key,
            topic=topic,
            msgtype=msgtype,
            msgdef=MessageDefinition(_FORMATS.get(form, MessageDefinitionFormat.NONE), text),
            digest=extra.get("topic_type_hash", ""),
            msgcount=0,
            ext=ConnectionExtRosbag2(encoding, _qos(extra.get("offered_qos_profiles", ""))),
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


def _is_name(topic: object, msgtype: object) -> bool:
    """Whether these can be names of a topic and its type: nothing else is shown to anybody."""
    return all(isinstance(name, str) and name.isprintable() and len(name) <= _LONGEST_NAME for name in (topic, msgtype))


def _qos(text: str) -> list[Qos]:
    try:
        check_yaml(text)
        return parse_qos(text)
    except Exception:  # a profile that cannot be read is not worth a recording
        return []


# ---- SQLite ----------------------------------------------------------------------------------------------------------


def _read_sqlite(
    file: Path, chosen: Chosen | None, say: Say, counts: Counter[tuple[str, str]]
) -> Messages:
    """Read an SQLite bag file with rosbags; heal or salvage a copy of it where it was broken off."""
    if file.stat().st_size == 0:
        say(f"{file.name} is empty: the recording was broken off before anything was written")
        return
    with file.open("rb") as stream:
        if stream.read(15) != b"SQLite format 3":
            raise RecordingError(f"{file}: not an SQLite file")
    last, opened, budget = -1, False, _Budget(file)
    with ExitStack() as stack:
        beside = [Path(f"{file}{end}") for end in ("-wal", "-journal")]
        beside = [other for other in beside if other.is_file() and other.stat().st_size]
        if beside:
            # An unfinished transaction: SQLite settles it on opening, in a copy so that the original stays as it is.
            say(f"{file.name} was not closed: the recording was broken off, its last moments are lost")
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="aeropend-")))
            for other in (file, *beside):
                with suppress(FileNotFoundError):  # a journal goes when its writer is still alive
                    shutil.copyfile(other, folder / other.name)
            file = folder / file.name
            _settle(file)
        try:
            _check_tables(file)
            reader = stack.enter_context(Reader(file))
            wanted = []
            for connection in reader.connections:
                if not _is_name(connection.topic, connection.msgtype):
                    continue
                counts[connection.topic, connection.msgtype] += connection.msgcount
                if chosen is None or chosen(connection.topic, connection.msgtype):
                    wanted.append(connection)
            opened = True
            for connection, time, data in reader.messages(wanted) if wanted else ():
                if _is_message(time, data):
                    budget.take(len(data))
                    yield connection, time, data
                    last = time
        except RecordingError:
            raise
        except Exception as error:  # rosbags and SQLite raise many types on a damaged file
            why = (str(error).splitlines() or [type(error).__name__])[0]
            say(f"{file.name} is damaged ({why}): what could be read was read")
            for connection, time, data in _salvage(file, chosen, Counter() if opened else counts, last):
                budget.take(len(data))
                yield connection, time, data


def _check_tables(file: Path) -> None:
    """Make sure that rosbags reads data, which ends, and YAML that does no harm.

    Raises:
        RecordingError: views or virtual tables, which are programs.
        sqlite3.Error, yaml.YAMLError: the file is damaged.
    """
    with closing(sqlite3.connect(f"{file.absolute().as_uri()}?immutable=1", uri=True)) as database:
        _refuse_programs(database, file)
        for table, column in (("topics", "offered_qos_profiles"), ("metadata", "metadata")):
            if column in [row[1] for row in database.execute(f"PRAGMA table_info({table})")]:
                for (text,) in database.execute(f"SELECT {column} FROM {table}"):  # noqa: S608 - names of ours
                    check_yaml(str(text))


def _refuse_programs(database: sqlite3.Connection, file: Path) -> None:
    tables = database.execute("PRAGMA table_list").fetchall()
    computed = [row for table in tables for row in database.execute("SELECT hidden FROM pragma_table_xinfo(?)",
                                                                    (table[1],)) if row[0]]
    if computed or any(table[2] != "table" for table in tables):
        raise RecordingError(f"{file}: holds views or columns that compute what they show: not a bag")


def _settle(file: Path) -> None:
    connection = sqlite3.connect(file)
    try:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        connection.execute("PRAGMA journal_mode=DELETE").fetchall()
    except sqlite3.Error:
        pass  # reading says what is wrong
    finally:
        connection.close()


def _salvage(file: Path, chosen: Chosen | None, counts: Counter[tuple[str, str]], last: int) -> Messages:
    """Yield the rows of a damaged SQLite bag file that can still be read, of those received after `last` (ns)."""
    folder = Path(tempfile.mkdtemp(prefix="aeropend-"))
    copy = folder / file.name
    shutil.copyfile(file, copy)
    with copy.open("r+b") as stream:  # a page that is there in part would be read as if the rest of it were zeros
        size = int.from_bytes(stream.read(18)[16:], "big")
        page = {0: 1, 1: 65536}.get(size, size)
        stream.truncate(copy.stat().st_size // page * page)
    database = sqlite3.connect(copy)
    database.row_factory = sqlite3.Row
    try:
        # without this, SQLite refuses a file that is shorter than its header says
        database.execute("PRAGMA writable_schema=ON")
        with suppress(sqlite3.Error):  # what cannot be read cannot run
            _refuse_programs(database, file)
        query = "SELECT id, name, type, * FROM topics"  # nothing where one of them is missing
        connections = {row["id"]: _connection(row) for row in _rows(database, query)
                       if _is_name(row["name"], row["type"])}
        start, misses = 1, 0
        while misses < 64:
            query = "SELECT topic_id, timestamp, data FROM messages WHERE id BETWEEN ? AND ?"
            rows = list(_rows(database, query, start, start + _BATCH - 1))
            start, misses = start + _BATCH, 0 if rows else misses + 1
            for row in rows:
                connection = connections.get(row["topic_id"])
                if connection is None or not _is_message(row["timestamp"], row["data"]) or row["timestamp"] <= last:
                    continue
                counts[connection.topic, connection.msgtype] += 1
                if chosen is None or chosen(connection.topic, connection.msgtype):
                    yield connection, row["timestamp"], row["data"]
    finally:
        database.close()
        shutil.rmtree(folder, ignore_errors=True)


def _rows(database: sqlite3.Connection, query: str, *arguments: Any) -> Iterator[sqlite3.Row]:
    """Yield rows up to the first that cannot be read."""
    try:
        yield from database.execute(query, arguments)
    except sqlite3.Error:
        return


def _is_message(time: object, data: object) -> bool:
    """SQLite puts anything into any column."""
    return isinstance(time, int) and isinstance(data, bytes)


def _connection(row: sqlite3.Row) -> Connection:
    known = set(row.keys())
    return Connection(
        id=row["id"],
        topic=row["name"],
        msgtype=row["type"],
        msgdef=MessageDefinition(MessageDefinitionFormat.NONE, ""),
        digest=row["type_description_hash"] if "type_description_hash" in known else "",
        msgcount=0,
        ext=ConnectionExtRosbag2(
            str(row["serialization_format"]) if "serialization_format" in known else "cdr",
            _qos(row["offered_qos_profiles"] if "offered_qos_profiles" in known else "")
        ),
        owner=None,
    )
