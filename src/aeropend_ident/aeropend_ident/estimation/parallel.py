# SPDX-License-Identifier: Apache-2.0
"""Calls spread over processes that are copies of this one.

The fits of a search share one recording. Threads gain little: array operations pass the interpreter's lock around. A
copy of the process (fork) holds the recording and all that is known already; only results are sent.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context
from typing import Any, TypeVar

from aeropend_ident.interrupt import check
from aeropend_sim.errors import UserError

T = TypeVar("T")
R = TypeVar("R")

LOOK = 0.1
"""[s] Time after which it is looked whether Ctrl-C waits. Choice: nobody notices it."""

_work: list[tuple[Callable[[Any], Any], Sequence[Any]]] = []
"""The function and what it is called with, in a copy; empty in the process that is copied."""


def parallel(jobs: int, function: Callable[[T], R], items: Sequence[T]) -> list[R]:
    """The results of a function for each item, in their order.

    A function that changes anything changes it in a copy alone. A call from within a copy is not spread further.

    Args:
        jobs: processes at once; 1: this one.
        function: of an item.
        items: of any kind; only results are sent between processes.

    Raises:
        UserError: the system ended a process.
    """
    if min(jobs, len(items)) < 2 or _work:
        return [function(item) for item in items]
    others = {*active_children()}
    try:
        with ProcessPoolExecutor(min(jobs, len(items)), get_context("fork"), _begin, (function, items)) as pool:
            try:
                return _results([pool.submit(_result, k) for k in range(len(items))])
            except KeyboardInterrupt:
                for copy in {*active_children()} - others:
                    copy.kill()
                raise
            finally:
                pool.shutdown(cancel_futures=True)
    except BrokenProcessPool:
        check()  # Ctrl-C ends the copies too
        raise UserError("the system ended a process of the search, probably for want of memory: try --jobs 1") from None


def _results(waiting: list[Future[R]]) -> list[R]:
    """The results of calls that have begun, or the first error."""
    done, left = wait(waiting, 0.0)
    while left and not any(f.exception() for f in done):
        check()
        done, left = wait(waiting, LOOK, FIRST_EXCEPTION)
    return [f.result() for f in waiting]


def _begin(function: Callable[[Any], Any], items: Sequence[Any]) -> None:
    if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    _work.append((function, items))


def _result(k: int) -> Any:
    (function, items), = _work
    return function(items[k])
