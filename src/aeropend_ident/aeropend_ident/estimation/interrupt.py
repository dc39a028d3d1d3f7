# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C takes effect between simulations: an exception at the end of compiled code would end the process."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_came: list[bool] = []


@contextmanager
def between_simulations() -> Iterator[None]:
    """Let Ctrl-C take effect at the next `check` in this block, or at its end; in the main thread alone."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, lambda *_: _came.append(True))
    try:
        yield
        check()
    finally:
        signal.signal(signal.SIGINT, before)
        _came.clear()


def check() -> None:
    """Raise KeyboardInterrupt if Ctrl-C came."""
    if _came:
        raise KeyboardInterrupt
