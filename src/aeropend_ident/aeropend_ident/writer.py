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
from pathlib import Path
from typing import Any, cast

from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer

from aeropend_ident.bag import UNFINISHED

PLUGINS = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}


class BagWriter(Writer):
    """A version 9 rosbag2 writer with checkpoints; use it in one thread.

    Until it is closed, the bag's metadata holds the custom datum "unfinished".
    """

    def __init__(self, path: Path | str, storage: str = "mcap") -> None:
        """Prepare to write.

        Args:
            path: folder to make.
            storage: "mcap" or "sqlite3".

        Raises:
            WriterError: the path exists.
        """
        super().__init__(path, version=9, storage_plugin=PLUGINS[storage])
        self._ending: _Ending | None = None

    def open(self) -> None:
        """Make the folder with an empty bag in it.

        Raises:
            WriterError: the folder exists by now.
            OSError: it cannot be made or written; nothing is left behind.
            sqlite3.Error: as OSError.
        """
        try:
            super().open()
            if isinstance(self.storage, McapWriter):
                self._ending = _Ending(self.storage.bio)
                self.storage.bio = cast("io.BufferedWriter[Any]", self._ending)
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
        if isinstance(self.storage, Sqlite3Writer):
            self.storage.conn.commit()
            whole.storage = cast("Any", _MetadataOnly(self.storage.path))
        elif isinstance(self.storage, McapWriter):
            if self.storage.chunk.msgs:
                self.storage.close_chunk()
            cast("_Ending", self._ending).begin()
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
        if self._ending is None:
            super().close()
            return
        self.checkpoint()
        self.abort()

    def abort(self) -> None:
        """Let go of the bag as it was at the last checkpoint."""
        if self._ending is not None:
            self._ending.release()
        super().abort()


class _MetadataOnly:
    """A storage that has nothing to write, so that only metadata.yaml is."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def close(self, version: int, metadata: str) -> None:
        """Write nothing."""


class _Ending(io.RawIOBase):
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

    def write(self, data: bytes) -> int:  # type: ignore[override]
        self._buffer += data
        return len(data)

    def tell(self) -> int:
        return self._start + len(self._buffer)

    def begin(self) -> None:
        """Say that the ending begins here."""
        self._kept = len(self._buffer)

    def close(self) -> None:
        """Put everything on disk; go back to before the ending."""
        if self._file.closed:
            return
        try:
            self._put(self._buffer)
        except OSError:
            self._put(self._last)  # over space that it had before, so this needs none
            os.ftruncate(self._disk, self._start + len(self._last))
            del self._buffer[self._kept :]
            raise
        self._last = bytes(self._buffer[self._kept :])
        self._start += self._kept
        self._buffer.clear()
        self._kept = 0

    def release(self) -> None:
        """Close the file as it is."""
        self._buffer.clear()
        self._file.close()

    def _put(self, data: bytes | bytearray) -> None:
        view, place = memoryview(data), self._start
        while view:
            done = os.pwrite(self._disk, view, place)
            view, place = view[done:], place + done
