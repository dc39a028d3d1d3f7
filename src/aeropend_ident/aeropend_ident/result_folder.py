# SPDX-License-Identifier: Apache-2.0
"""The results of a command: a folder that is written completely or not at all, its name, and single files."""

from __future__ import annotations

import shutil
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from aeropend_ident.interrupt import interrupts_wait
from aeropend_sim.errors import UserError
from aeropend_sim.model.parameters import ModelError


class OutputError(UserError):
    """The results cannot be written; the message is one line for the user."""


def ensure_free(out: Path, files: Sequence[str], *, overwrite: bool) -> None:
    """Make sure before the work that its results can be written.

    Args:
        out: the folder.
        files: names of the results.
        overwrite: whether results in it may be replaced.

    Raises:
        OutputError: `out` is no folder, or holds results already.
    """
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: is a file; --out takes a folder")
    taken = [name for name in files if (out / name).exists()]
    if taken and not overwrite:
        raise OutputError(f"{out}: holds {taken[0]} already; give another --out, or --overwrite to replace it")


def ensure_new(file: Path, option: str, *, overwrite: bool) -> None:
    """Make sure before the work that a file can be written.

    Args:
        file: the file.
        option: that names it.
        overwrite: whether it may be replaced.

    Raises:
        OutputError: it is there already.
    """
    if file.exists() and not overwrite:
        raise OutputError(f"{file}: is there already; give another {option}, or --overwrite to replace it")


def write_page(file: Path, text: str) -> None:
    """Write the page of `--html`.

    Args:
        file: the page.
        text: its content.

    Raises:
        OutputError: it cannot be written.
    """
    try:
        file.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{file}: cannot be written: {error.strerror}; give another --html") from None


def folder_names(bags: Sequence[str], taken: Iterable[str] = ()) -> list[str]:
    """A unique folder name for each recording: its own name, with those of the folders above it where names are equal.

    Args:
        bags: the recordings. One that is given twice gets a number.
        taken: names that are not to be used.
    """
    paths = [p.absolute() if p.name not in {"", ".."} else p.resolve() for p in map(Path, bags)]
    parts = [(*p.parts[1:-1], p.stem if p.suffix in {".mcap", ".db3"} else p.name) for p in paths]
    depth = dict.fromkeys(parts, 1)
    while True:
        count = Counter("_".join(p[-d:]) for p, d in depth.items())
        longer = [p for p, d in depth.items() if count["_".join(p[-d:])] > 1 and d < len(p)]
        if not longer:
            break
        for p in longer:
            depth[p] += 1
    found = ["_".join(p[-depth[p]:]) for p in parts]
    used = set(taken)
    for j, name in enumerate(found):
        k = 1
        while found[j] in used:
            k += 1
            found[j] = f"{name}_{k}"
        used.add(found[j])
    return found


@contextmanager
def atomic_folder(out: Path, files: Sequence[str]) -> Iterator[Path]:
    """A temporary folder for results, which appear in `out` together when the block ends without an exception.

    Args:
        out: the folder of the results.
        files: their names.

    Raises:
        OutputError: the folder cannot be made or written.
    """
    made = not out.exists()
    with ExitStack() as afterwards:
        try:
            out.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=out, prefix=".writing_") as place:
                yield Path(place)
                afterwards.enter_context(interrupts_wait())
                for name in files:
                    (Path(place) / name).replace(out / name)
        except BaseException as error:  # Ctrl-C too
            if made:
                shutil.rmtree(out, ignore_errors=True)
            if not isinstance(error, (OSError, ModelError)):
                raise
            why = error.strerror if isinstance(error, OSError) else error
            raise OutputError(f"{out}: the results cannot be written: {why}; give another folder with --out or make "
                              "room") from None
