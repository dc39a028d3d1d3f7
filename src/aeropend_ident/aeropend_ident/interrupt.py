# SPDX-License-Identifier: Apache-2.0
"""When Ctrl-C takes effect.

An exception at the end of compiled code would end the process. One between two files of a result would leave half of
it.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_came: list[bool] = []


@contextmanager
def on_interrupt(handler: Callable[[int, object], object] | signal.Handlers) -> Iterator[None]:
    """Handle Ctrl-C by this handler. Only the main thread is interrupted; in other threads nothing changes."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def interrupts_wait() -> Iterator[None]:
    """Ctrl-C in this block takes effect at the next `check`, or at its end. Where it is ignored, it stays ignored."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        yield
        return
    try:
        with on_interrupt(lambda *_: _came.append(True)):
            yield
        if _came:
            signal.raise_signal(signal.SIGINT)
    finally:
        _came.clear()


def check() -> None:
    """Raise KeyboardInterrupt if Ctrl-C waits."""
    if _came:
        raise KeyboardInterrupt
