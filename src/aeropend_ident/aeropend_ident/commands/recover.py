# SPDX-License-Identifier: Apache-2.0
"""The command that makes a proper bag of one that was broken off; the broken one stays as it is."""

from __future__ import annotations

import argparse
import re
import shutil
import sqlite3
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinitionFormat
from rosbags.rosbag2.errors import WriterError
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from aeropend_ident.bags.container import STORAGES, Bag
from aeropend_ident.bags.msgtypes import learn
from aeropend_ident.bags.reading import RecordingError
from aeropend_ident.bags.writer import BagWriter
from aeropend_sim.cli.command import EXIT_CODES, Parser, entry_point
from aeropend_sim.cli.progress import Show, nothing, progress

CHECKPOINT_MESSAGES = 20_000
"""Messages after which the new bag is made whole on disk and progress is shown (choice: 20 s of a rig's samples)."""

LONGEST_IDL = 100_000
"""Characters of an IDL definition that is read (choice; it bounds the time of rosbags' parser)."""
_IDL_TEXT = re.compile(r'"(?:\\.|[^"\\])*"|//[^\n]*|/\*.*?\*/', re.DOTALL)
_IDL_ANNOTATION = re.compile(r"@\w+\s*\([^()]*\)")

EXAMPLES = f"""examples:
  recover my_bag
  recover my_bag --out saved
  recover my_bag/my_bag.mcap

{EXIT_CODES}"""


@dataclass(frozen=True)
class Recovered:
    """What was recovered.

    Attributes:
        out: the new bag; None when the old one needs nothing.
        counts: messages by topic.
        seconds: from the first message to the last.
        problems: what was wrong with the old bag.
        left_out: topics whose type is known neither to the bag nor here.
    """

    out: Path | None
    counts: dict[str, int]
    seconds: float
    problems: tuple[str, ...]
    left_out: tuple[str, ...]


def recover(path: Path | str, out: Path | str | None = None, show: Show = nothing) -> Recovered:
    """Write what can be read of a bag into a new one, of the same storage.

    Args:
        path: the broken bag; it is not changed.
        out: folder to make; PATH_recovered when left out.
        show: called with the share of the messages that is written.

    Raises:
        RecordingError: nothing can be recovered, `out` exists, or it cannot be written; nothing is left behind.
    """
    path = Path(path)
    bag = Bag(path)
    target = Path(out) if out is not None else _beside(path)
    times: list[int] = []
    counts: Counter[str] = Counter()
    for connection, received, _ in bag.messages():
        counts[connection.topic] += 1
        times = [min(times[0], received), max(times[1], received)] if times else [received, received]
    seconds = (times[1] - times[0]) / 1e9 if times else 0.0
    if not bag.problems:
        return Recovered(None, dict(counts), seconds, (), ())
    if not times:
        raise RecordingError(f"{path}: nothing to recover: {bag.problems[0]}")
    try:
        writer = BagWriter(target, bag.storage)
    except WriterError as error:
        raise RecordingError(f"{target} exists: name another folder with --out") from error
    try:
        writer.open()
        left_out = _copy(bag, writer, sum(counts.values()), show)
        writer.close()
    except (OSError, sqlite3.Error) as error:
        _discard(writer)
        raise RecordingError(f"{target}: cannot be written: {getattr(error, 'strerror', None) or error}") from error
    except BaseException:
        _discard(writer)
        raise
    kept = {topic: count for topic, count in counts.items() if topic not in left_out}
    return Recovered(target, kept, seconds, tuple(bag.problems), left_out)


def _beside(path: Path) -> Path:
    """PATH_recovered, without the suffix of a bare file."""
    named = path if path.name not in {"", ".."} else path.resolve()  # as in `recover .`
    name = named.name
    for suffix in (".zstd", *STORAGES):
        name = name.removesuffix(suffix)
    return named.parent / f"{name}_recovered"


def _copy(bag: Bag, writer: BagWriter, total: int, show: Show) -> tuple[str, ...]:
    """Write every message whose type can be had. Returns the topics left out."""
    typestore = get_typestore(Stores.ROS2_JAZZY)
    entered: dict[tuple[str, str], Connection | None] = {}
    for number, (connection, received, message) in enumerate(bag.messages(), 1):
        key = (connection.topic, connection.msgtype)
        if key not in entered:
            entered[key] = _enter(connection, writer, typestore)
        target = entered[key]
        if target is not None:
            writer.write(target, received, message)
        if number % CHECKPOINT_MESSAGES == 0:
            writer.checkpoint()
            show(number / total)
    return tuple(topic for (topic, _), target in entered.items() if target is None)


def _enter(connection: Connection, writer: BagWriter, typestore: Typestore) -> Connection | None:
    """Enter a topic in the new bag; None when its type is not known."""
    assert isinstance(connection.ext, ConnectionExtRosbag2)
    if connection.msgtype not in typestore.types:
        try:
            if connection.msgdef.format == MessageDefinitionFormat.MSG:
                typestore.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
            elif connection.msgdef.format == MessageDefinitionFormat.IDL:
                _check_idl(connection.msgdef.data)
                typestore.register(get_types_from_idl(connection.msgdef.data))
            else:
                learn(typestore, connection.msgtype)
        except Exception:  # whatever the definition says, rosbags' parsers raise what their code raises
            return None
    try:
        return writer.add_connection(
            connection.topic,
            connection.msgtype,
            typestore=typestore,
            serialization_format=connection.ext.serialization_format,
            offered_qos_profiles=connection.ext.offered_qos_profiles,
        )
    except (OSError, sqlite3.Error):
        raise
    except Exception:  # a type that holds itself, for example
        return None


def _check_idl(text: str) -> None:
    """Make sure that rosbags' parser comes to an end: each parenthesis in a constant takes it 30 times longer.

    Raises:
        ValueError: it would not.
    """
    bare = _IDL_ANNOTATION.sub("", _IDL_TEXT.sub("", text))
    if len(text) > LONGEST_IDL or "(" in bare:
        raise ValueError("an IDL definition that is long, or computes")


def _discard(writer: BagWriter) -> None:
    """Remove a new bag that was not finished."""
    if writer.storage is not None:
        writer.abort()
        shutil.rmtree(writer.path, ignore_errors=True)


@entry_point("recover", "interrupted, nothing was written")
def main(args: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = Parser(
        prog="recover",
        description="Makes a proper bag of a recording that was broken off. The broken one stays as it is.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("bag", metavar="BAG", help="rosbag2 folder, or a bare .mcap or .db3 file")
    parser.add_argument("--out", metavar="DIR", help="folder to make (default: BAG_recovered)")
    options = parser.parse_args(args)
    with progress("recovering") as show:
        done = recover(options.bag, options.out, show)
    total = sum(done.counts.values())
    if done.out is None:
        print(f"{options.bag} is whole: {total} messages over {done.seconds:.3f} s, nothing to recover")
        return 0
    print(f"{done.out}: {total} messages over {done.seconds:.3f} s recovered")
    for topic, count in sorted(done.counts.items()):
        print(f"  {topic}: {count}")
    for problem in done.problems:
        print(f"  lost: {problem}")
    for topic in done.left_out:
        print(f"  left out: {topic}: its message type is known neither to the bag nor here")
    return 0


if __name__ == "__main__":
    sys.exit(main())
