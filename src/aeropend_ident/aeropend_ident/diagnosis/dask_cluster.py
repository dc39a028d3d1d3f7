# SPDX-License-Identifier: Apache-2.0
"""Work on a Dask cluster; nothing here knows the work."""

from __future__ import annotations

import asyncio
import logging
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from aeropend_sim.errors import UserError

ANSWER_WITHIN = 5.0
"""[s] Time within which a Dask scheduler and a first worker must answer (choice)."""

KILLED = "its process was killed, most likely because memory ran out"

Task = TypeVar("Task")


class ClusterError(UserError):
    """The Dask cluster cannot be used; the message is one line for the user."""


def results(client: Any, function: Callable[[Task], object], tasks: Iterable[Task]) -> Iterator[tuple[Task, object]]:
    """Let the workers of a cluster apply a function to tasks.

    joblib's Dask backend is not used: it waits for ever for a worker that was killed.

    Args:
        client: see `cluster`.
        function: that a worker can import.
        tasks: each is made shortly before a worker takes it.

    Yields:
        Each task with its result, in their order; with a line of text where the worker failed.
    """
    waiting: deque[tuple[Task, Any]] = deque()

    def first() -> tuple[Task, object]:
        task, future = waiting.popleft()
        try:
            return task, future.result()
        except Exception as error:
            return task, KILLED if type(error).__name__ == "KilledWorker" else " ".join(str(error).split())

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sending large graph")  # a recording is large
        for task in tasks:
            waiting.append((task, client.submit(function, task, pure=False)))
            if len(waiting) > 2 * sum(client.ncores().values()):
                yield first()
        while waiting:
            yield first()


@contextmanager
def cluster(address: str | None) -> Iterator[Any]:
    """Connect to a Dask cluster whose workers have this package.

    Args:
        address: of its scheduler, as "tcp://host:8786"; None: no cluster.

    Yields:
        A `distributed.Client`, or None.

    Raises:
        ClusterError: Dask is not installed, no scheduler answers, or a worker lacks this package.
    """
    if address is None:
        yield None
        return
    try:
        import distributed
    except ImportError:
        raise ClusterError("--dask needs Dask, which is not installed: pip install 'aeropend_ident[dask]'") from None
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # every failure comes back as an exception
    untyped: Any = distributed

    async def knock() -> None:
        security = untyped.Security().get_connection_args("client")
        comm = await untyped.comm.connect(address, timeout=ANSWER_WITHIN, **security)
        await comm.close()

    try:
        asyncio.run(knock())  # a client that cannot connect leaves tracebacks behind
        client = untyped.Client(address, timeout=ANSWER_WITHIN, set_as_default=False)
    except Exception as error:
        silent = isinstance(error, (OSError, distributed.TimeoutError))
        why = "nothing answers there" if silent else " ".join(str(error).split())
        raise ClusterError(f"--dask {address}: {why}; give the address that the scheduler prints when it starts, "
                           "such as tcp://host:8786") from None
    with client:
        try:
            client.wait_for_workers(1, timeout=ANSWER_WITHIN)
        except distributed.TimeoutError:
            raise ClusterError(f"--dask {address}: the cluster has no worker; start some with: dask worker {address}"
                               ) from None
        package = __name__.partition(".")[0]

        def has() -> bool:  # a function of this module could not be sent to a worker that lacks it
            import importlib.util
            return importlib.util.find_spec(package) is not None

        there = {"the scheduler": client.run_on_scheduler(has), **client.run(has)}
        if lacking := [where for where in there if not there[where]]:
            raise ClusterError(f"--dask {address}: {package} is not installed for {' and '.join(lacking[:3])}; "
                               "the scheduler and every worker need it")
        yield client
