# SPDX-License-Identifier: Apache-2.0
"""The folder with a command's results: there whole, or not at all."""

from __future__ import annotations

import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from aeropend_sim.errors import UserError
from aeropend_sim.model.parameters import ModelError


class OutputError(UserError):
    """The results cannot be written; the message is one line for a person."""


def check(out: Path, files: Sequence[str], *, overwrite: bool) -> None:
    """Make sure before the work that its results have a place.

    Raises:
        OutputError: `out` is no folder, or holds results already.
    """
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out}: is a file; --out takes a folder")
    taken = [name for name in files if (out / name).exists()]
    if taken and not overwrite:
        raise OutputError(f"{out}: holds {taken[0]} already; give another --out, or --overwrite to replace it")


@contextmanager
def whole(out: Path, files: Sequence[str]) -> Iterator[Path]:
    """A folder to write `files` to; they appear in `out` together, when the block ends without an exception.

    Raises:
        OutputError: the folder cannot be made or written.
    """
    made = not out.exists()
    with ExitStack() as afterwards:
        try:
            out.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=out, prefix=".writing_") as place:
                yield Path(place)
                afterwards.enter_context(_interrupts_wait())
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


@contextmanager
def on_interrupt(handler: Callable[[int, object], object] | signal.Handlers) -> Iterator[None]:
    """What Ctrl-C does in here; nothing changes in another thread than the main one, which alone is interrupted."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _interrupts_wait() -> Iterator[None]:
    """Ctrl-C in here takes effect when it ends: what is begun, and takes a moment, is done."""
    came = []
    with on_interrupt(lambda *_: came.append(True)):
        yield
    if came:
        signal.raise_signal(signal.SIGINT)
