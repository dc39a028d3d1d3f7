# SPDX-License-Identifier: Apache-2.0
"""A rosbag2 writer whose bag is whole after every checkpoint.

rosbags writes the index of a bag when it is closed, so a bag whose writer is killed opens nowhere. This one writes
index and metadata at every checkpoint as if the bag ended there, and takes the place of that ending with what comes
next. Whatever happens in between, every rosbag2 tool opens the bag as it was at the last checkpoint.
"""

from __future__ import annotations

import copy
import io
import os
import shutil
import sqlite3
import zlib
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, cast

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionMode
from rosbags.rosbag2.storage_mcap import McapWriter, PendingChunk
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer

from aeropend_ident.bags.container import UNFINISHED

PLUGINS = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}

_CRC_OFFSET = 33  # of the checksum in a chunk record


class _Ending:
    """What McapWriter writes to: held in memory, and put on disk in one go when the writer closes it.

    What was written from `begin` to `close` is the ending; what is written after that takes its place.
    """

    def __init__(self, file: io.BufferedWriter[Any]) -> None:
        file.flush()
        self._file = file
        self._disk = file.fileno()
        self._start = file.tell()  # where on disk the buffer belongs
        self._buffer = bytearray()
        self._kept = 0  # bytes of the buffer that come before the ending
        self._last = b""  # the ending that is on disk, at _start

    def write(self, data: bytes) -> int:
        """Append."""
        self._buffer += data
        return len(data)

    def tell(self) -> int:
        """Return where the next byte will be in the file."""
        return self._start + len(self._buffer)

    def patch(self, place: int, data: bytes) -> None:
        """Change bytes that are not on disk yet."""
        at = place - self._start
        self._buffer[at : at + len(data)] = data

    def begin(self) -> None:
        """Say that the ending begins here."""
        self._kept = len(self._buffer)

    def close(self) -> None:
        """Put everything on disk; go back to before the ending."""
        common = len(self._last)
        try:
            # The new part first, then what takes the place of the old ending: killed in between, the file has the
            # length it says, and the chunk that was being written is found out by its checksum.
            self._put(self._buffer[common:], self._start + common)
            self._put(self._buffer[:common], self._start)
            if len(self._buffer) < common:
                os.ftruncate(self._disk, self.tell())
        except OSError:
            self._put(self._last, self._start)  # over space that it had before, so this needs none
            os.ftruncate(self._disk, self._start + common)
            del self._buffer[self._kept :]
            raise
        self._last = bytes(self._buffer[self._kept :])
        self._start += self._kept
        self._buffer.clear()
        self._kept = 0

    def release(self) -> None:
        """Close the file as it is."""
        self._file.close()

    def _put(self, data: bytes | bytearray, place: int) -> None:
        view = memoryview(data)
        while view:
            done = os.pwrite(self._disk, view, place)
            view, place = view[done:], place + done


class _Mcap(McapWriter):
    """rosbags' MCAP storage, which can be closed again and again."""

    def __init__(self, path: Path, compression: CompressionMode) -> None:
        super().__init__(path, compression)
        file = self.bio
        try:
            self._ending = _Ending(file)
        except OSError:
            file.raw.close()  # what is in its buffer cannot be written
            raise
        self.bio = cast("io.BufferedWriter[Any]", self._ending)

    def close_chunk(self) -> None:
        """Close the chunk, with a checksum."""
        place = self.bio.tell()
        check = zlib.crc32(self.chunk.bio.getbuffer())
        super().close_chunk()
        self._ending.patch(place + _CRC_OFFSET, check.to_bytes(4, "little"))

    def close(self, version: int, metadata: str) -> None:
        """Write the ending; what is written from now on takes its place."""
        if self.chunk.msgs:
            self.close_chunk()
        waiting = self.chunk  # topics without a message yet: they go with the next one
        self.chunk = PendingChunk(2**63 - 1, 0, io.BytesIO(), defaultdict(list))
        self._ending.begin()
        try:
            super().close(version, metadata)
        finally:
            self.chunk = waiting

    def abort(self) -> None:
        """Close the file as it was at the last checkpoint."""
        self._ending.release()


class _Sqlite(Sqlite3Writer):
    """rosbags' SQLite storage, which can be closed again and again."""

    def close(self, version: int, metadata: str) -> None:
        """Commit, with the metadata."""
        self.cursor.execute("DELETE FROM metadata")
        self.cursor.execute("INSERT INTO metadata(metadata_version, metadata) VALUES(?, ?)", (version, metadata))
        self.conn.commit()


class BagWriter(Writer):
    """A version 9 rosbag2 writer with checkpoints; use it in one thread.

    Until it is closed, the bag's metadata holds the custom datum "unfinished".
    """

    STORAGE_PLUGINS: ClassVar[Mapping[StoragePlugin, Any]] = {  # type: ignore[misc]
        StoragePlugin.MCAP: _Mcap,
        StoragePlugin.SQLITE3: _Sqlite,
    }

    def __init__(self, path: Path | str, storage: str = "mcap") -> None:
        """Prepare to write.

        Args:
            path: folder to make.
            storage: "mcap" or "sqlite3".

        Raises:
            WriterError: the path exists.
        """
        super().__init__(path, version=9, storage_plugin=PLUGINS[storage])

    def open(self) -> None:
        """Make the folder with an empty bag in it.

        Raises:
            WriterError: the folder exists by now.
            OSError: it cannot be made or written; nothing is left behind.
            sqlite3.Error: as OSError.
        """
        try:
            super().open()
            self.set_custom_data(UNFINISHED, "true")
            self.checkpoint()
        except (OSError, sqlite3.Error):
            self.abort()
            shutil.rmtree(self.path, ignore_errors=True)
            raise

    def checkpoint(self) -> None:
        """Make the bag on disk whole, with everything written so far.

        Raises:
            OSError: the disk is full or failed; the bag stays whole as of the last checkpoint.
            sqlite3.Error: as OSError.
        """
        whole = copy.copy(self)  # closing the copy writes index and metadata; the original stays open
        try:
            Writer.close(whole)
        except OSError:
            self.metapath.with_suffix(".yaml.tmp").unlink(missing_ok=True)
            raise

    def close(self) -> None:
        """Close the bag for good.

        Raises:
            OSError: as for `checkpoint`.
            sqlite3.Error: as for `checkpoint`.
        """
        self.custom_data.pop(UNFINISHED, None)
        self.checkpoint()
        self.abort()
