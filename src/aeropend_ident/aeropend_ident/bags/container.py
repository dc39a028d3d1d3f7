# SPDX-License-Identifier: Apache-2.0
"""The raw messages of a rosbag2 bag, whole or broken off.

rosbags reads whole bags; it refuses a recording whose process was killed. A `Bag` gives what can be read of any, and
lists what is wrong with it in `problems`. It never writes to a bag.
"""

from __future__ import annotations

import shlex
import tempfile
from collections import Counter
from contextlib import ExitStack
from pathlib import Path, PurePosixPath

import yaml

from aeropend_ident.bags.mcap import read_mcap
from aeropend_ident.bags.reading import (
    Budget,
    Chosen,
    Messages,
    RecordingError,
    ZstdDecompressor,
    pieces,
    unpacked,
)
from aeropend_ident.bags.sqlite import read_sqlite
from aeropend_sim.cli.command import called
from aeropend_sim.untrusted import load_yaml, one_line, printable

NEWEST_VERSION = 9
"""Newest version of the metadata of rosbag2 that is known here."""

UNFINISHED = "unfinished"
"""Key in a bag's custom data while `record` runs: a bag that still has it was not closed."""

STORAGES = {".mcap": "mcap", ".db3": "sqlite3"}
"""Suffix of a file -> identifier of its storage in rosbag2."""


class Bag:
    """One bag: a rosbag2 folder, or a bare .mcap or .db3 file (also with .zstd behind it).

    Attributes:
        path: as given.
        storage: "mcap" or "sqlite3".
        problems: of the bag, one line each; complete after all messages were read.
        counts: number of messages by (topic, type), chosen or not; complete after all messages were read.
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
            table = printable(f"{called('import', 'aeropend_ident')} {shlex.quote(str(path))}")
            raise RecordingError(f"{path}: not a bag: {names} (expected .mcap or .db3 files); if it is a table, "
                                 f"`{table}` shows how to make a recording of it")
        self.storage = STORAGES[kinds.pop() or ""]

    def messages(self, chosen: Chosen | None = None) -> Messages:
        """Read the bag from front to back, in the order of its files.

        Args:
            chosen: which messages are wanted, by topic and type; None: all.

        Yields:
            Connection, receive time (ns) and serialized message. Connections of one topic in several files differ.

        Raises:
            RecordingError: a file cannot be opened.
        """
        self.counts.clear()
        for file in self._files:
            with ExitStack() as stack:
                reader = read_mcap if self.storage == "mcap" else read_sqlite
                try:
                    plain = self._unzipped(file, stack) if file.suffix == ".zstd" else file
                    budget = Budget(file)
                    for connection, time, data in reader(plain, chosen, self._report, self.counts):
                        if self._per_message_zstd:
                            data = self._unzip(data)
                            budget.take(len(data))
                        yield connection, time, data
                except OSError as error:
                    raise RecordingError(f"{file}: cannot be read: {error.strerror}") from error

    def _report(self, problem: str) -> None:
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
            self._report("metadata.yaml is missing: the recording was broken off")
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
            self._report("metadata.yaml is damaged")
            return found
        if version > NEWEST_VERSION:
            self._report(f"bag version {version} is newer than version {NEWEST_VERSION}, which is known here")
        if UNFINISHED in custom:
            self._report("the recording was not closed (killed, or still running): it may end up to a second early")
        self._per_message_zstd = mode == "message"
        if mode not in ("", "none") and form != "zstd":
            raise RecordingError(f"{folder}: compressed with {form!r}, only zstd can be read")
        files = [file for file in named if file.is_file()]
        if missing := [file.name for file in named if not file.is_file()]:
            self._report(f"missing though metadata.yaml names it: {', '.join(missing)}")
        if not files and not found:
            raise RecordingError(f"{folder}: holds none of the files its metadata.yaml names: {', '.join(missing)}")
        return files or found

    def _unzipped(self, file: Path, stack: ExitStack) -> Path:
        """Unpack a file that is compressed as a whole, up to where it ends or breaks off."""
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="aeropend-"))
        plain = Path(folder) / file.stem
        decompressor = ZstdDecompressor()
        with file.open("rb") as packed, plain.open("wb") as out:
            try:
                budget = Budget(file)
                while not decompressor.eof and (part := packed.read(1 << 20)):
                    for piece in pieces(decompressor, part):
                        budget.take(out.write(piece))
            except RecordingError:
                raise
            except Exception as error:  # the type differs between Python's own module and its backport
                self._report(f"{file.name}: damaged: {error}")
        if not decompressor.eof:
            self._report(f"{file.name}: compressed data ends early")
        return plain

    def _unzip(self, data: bytes) -> bytes:
        try:
            return unpacked(ZstdDecompressor(), data)
        except Exception:  # as above; an empty message is left out when it is decoded
            return b""


def _storage_suffix(file: Path) -> str | None:
    suffix = Path(file.stem).suffix if file.suffix == ".zstd" else file.suffix
    return suffix if suffix in STORAGES else None
