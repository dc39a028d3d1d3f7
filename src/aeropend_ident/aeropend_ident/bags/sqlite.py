# SPDX-License-Identifier: Apache-2.0
"""SQLite files of rosbag2: read by rosbags, and row by row where they are damaged."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any

from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition, MessageDefinitionFormat
from rosbags.rosbag2 import Reader

from aeropend_ident.bags.reading import (
    Budget,
    Chosen,
    Messages,
    RecordingError,
    ReportProblem,
    is_name,
    qos_profiles,
)
from aeropend_sim.untrusted import check_yaml

_BATCH = 256
"""Rows that are salvaged at once (choice)."""


def read_sqlite(file: Path, chosen: Chosen | None, report: ReportProblem, counts: Counter[tuple[str, str]]) -> Messages:
    """Read an SQLite bag file with rosbags. A copy of one that was broken off is repaired first, or read row by row.

    Args:
        file: to read.
        chosen: which messages are wanted; None: all.
        report: called with each problem.
        counts: gets the number of messages by topic and type, chosen or not.

    Raises:
        RecordingError: it is no SQLite file, or holds programs.
    """
    if file.stat().st_size == 0:
        report(f"{file.name} is empty: the recording was broken off before anything was written")
        return
    with file.open("rb") as stream:
        if stream.read(15) != b"SQLite format 3":
            raise RecordingError(f"{file}: not an SQLite file")
    last, opened, budget = -1, False, Budget(file)
    with ExitStack() as stack:
        beside = [Path(f"{file}{end}") for end in ("-wal", "-journal")]
        beside = [other for other in beside if other.is_file() and other.stat().st_size]
        if beside:
            # An unfinished transaction: SQLite completes or drops it on opening; in a copy, so that the original stays.
            report(f"{file.name} was not closed: the recording was broken off, its last moments are lost")
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="aeropend-")))
            for other in (file, *beside):
                with suppress(FileNotFoundError):  # a journal goes when its writer is still alive
                    shutil.copyfile(other, folder / other.name)
            file = folder / file.name
            _complete_transaction(file)
        try:
            _check_tables(file)
            reader = stack.enter_context(Reader(file))
            wanted = []
            for connection in reader.connections:
                if not is_name(connection.topic, connection.msgtype):
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
            report(f"{file.name} is damaged ({why}): what could be read was read")
            for connection, time, data in _salvage(file, chosen, Counter() if opened else counts, last):
                budget.take(len(data))
                yield connection, time, data


def _check_tables(file: Path) -> None:
    """Make sure that the file holds plain tables, and YAML that can be read without harm.

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
    queries = ("SELECT 1 FROM pragma_table_list WHERE type != 'table'",  # names stay in SQLite: they may be no text
               "SELECT 1 FROM pragma_table_list AS t JOIN pragma_table_xinfo(t.name) AS x WHERE x.hidden != 0")
    if any(database.execute(query).fetchone() for query in queries):
        raise RecordingError(f"{file}: holds views or columns that compute what they show: not a bag")


def _complete_transaction(file: Path) -> None:
    connection = sqlite3.connect(file)
    try:
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()
        connection.execute("PRAGMA journal_mode=DELETE").fetchall()
    except sqlite3.Error:
        pass  # reading reports the problem
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
        with suppress(sqlite3.Error):  # a view that cannot be read cannot run
            _refuse_programs(database, file)
        query = "SELECT id, name, type, * FROM topics"  # nothing where one of them is missing
        connections = {row["id"]: _connection(row) for row in _rows(database, query)
                       if is_name(row["name"], row["type"])}
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
    except (sqlite3.Error, UnicodeError):  # the latter for the name of a column
        return


def _is_message(time: object, data: object) -> bool:
    """Whether a row is a message: SQLite stores any type in any column."""
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
            qos_profiles(row["offered_qos_profiles"] if "offered_qos_profiles" in known else "")
        ),
        owner=None,
    )
