# SPDX-License-Identifier: Apache-2.0
"""Running a node as a program: arguments, signals, an orderly end.

A node is any `rclpy.node.Node`. The program uses three attributes of the node, if they exist:

- `done` (bool): if true, the program ends with exit code 0;
- `error` (Exception): if set, the program ends; a `UserError` is printed as one line and gives exit code 2;
- `close()`: called once at the end, before the node is destroyed. Signals do not interrupt it. It stops threads, sends
  the last message and closes files.

Subscription callbacks take only the message: the EventsExecutor of this rclpy fails on callbacks that also take the
message info.
"""

import gc
import os
import signal
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import rclpy
import rclpy.logging
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from aeropend_sim.cli.command import asked_to_complete
from aeropend_sim.errors import UserError
from aeropend_sim.ros.parameter_files import readable_parameter_files
from aeropend_sim.ros.transport import without_shared_memory
from aeropend_sim.ros.usage import Usage, no_words

RCLError = rclpy_implementation.RCLError

try:
    from rclpy.experimental import EventsExecutor
except ImportError:  # an older rclpy
    EventsExecutor = SingleThreadedExecutor

SPIN_S = 0.1
"""[s] Greatest delay until the program notices a signal. A choice."""

LEAVE_S = 5.0
"""[s] Time for the middleware to shut down after the node has ended; then the process exits. A choice."""


class Stop:
    """After `install`, SIGINT and SIGTERM set the flag `requested`."""

    def __init__(self) -> None:
        self.requested = False

    def install(self) -> None:
        """Handle both signals. Call it in the main thread."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._request)

    def _request(self, _number: int, _frame: FrameType | None) -> None:
        self.requested = True

    @staticmethod
    def ignore() -> None:
        """Ignore both signals, so that they do not interrupt the end of the program. Call it in the main thread."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)


def run(
    make_node: Callable[..., Node],
    args: Sequence[str] | None = None,
    usage: Usage | None = None,
    read: Callable[[list[str]], Any] = no_words,
) -> int:
    """Run one node until it is done or a signal arrives.

    From here on, SIGINT and SIGTERM end the program with exit code 0, at any moment and also if repeated. The handlers
    of rclpy are not used, because they destroy the context while the executor spins.

    Args:
        make_node: makes the node, after `rclpy.init`. Its argument is the result of `read`; it has no argument if that
            is None. May raise UserError.
        args: command line without the name of the program; None for `sys.argv`.
        usage: the help and the completions. If None, `read` gives both.
        read: reads the arguments before `--ros-args`. May raise UserError.

    Returns:
        The exit code: 0, or 2 after a UserError, which is printed on standard error as one line.
    """
    argv = list(sys.argv[1:] if args is None else args)
    if asked_to_complete() or {"-h", "--help"} & set(argv):
        if usage is None:
            read(["--help"])
        else:
            usage.show()
        return 0
    program = Path(sys.argv[0]).stem or "aeropend"
    stop = Stop()
    stop.install()
    code = 2
    try:
        with tempfile.TemporaryDirectory(prefix="aeropend_") as folder:
            readable = readable_parameter_files(argv, folder)
            try:
                words = read(_words(readable))
                _init(readable)
            except UserError as error:  # name the user's file, not the rewritten copy
                names = {copy: file for copy, file in zip(readable, argv, strict=True) if copy != file}
                raise UserError(" ".join(names.get(word.strip("'."), word) for word in str(error).split())) from error
        code = _spin(make_node if words is None else partial(make_node, words), stop)
    except UserError as error:
        print(f"{program}: {error}", file=sys.stderr)
    finally:
        stop.ignore()
        with _leaving(code):
            gc.collect()  # remains of a node whose constructor failed
            rclpy.try_shutdown()
    return code


def _words(argv: list[str]) -> list[str]:
    """The arguments before `--ros-args`."""
    try:
        return list(remove_ros_args(["node", *argv])[1:])
    except Exception as error:  # rclpy has several unrelated classes for this
        raise UserError(_short(error)) from error


def _init(argv: list[str]) -> None:
    """Start rclpy; its errors about the command line become one UserError."""
    rclpy.logging.set_logger_level("rcl", rclpy.logging.LoggingSeverity.FATAL)  # the UserError has the same text
    without_shared_memory()
    try:
        rclpy.init(args=["node", *argv], signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:
        raise UserError(_short(error)) from error
    finally:
        rclpy.logging.set_logger_level("rcl", rclpy.logging.LoggingSeverity.UNSET)


def _short(error: Exception) -> str:
    """The message of rcl without C source lines and parser internals."""
    text = " ".join(str(error).split()).split(", at /")[0].split(". Error: Expected lexeme")[0]
    for prefix in ("failed to initialize rcl: ", "Failed to parse ROS arguments: "):
        text = text.removeprefix(prefix)
    return f"unknown ROS argument {text}" if type(error).__name__ == "UnknownROSArgsError" else text


@contextmanager
def _leaving(code: int) -> Iterator[None]:
    """End the process after `LEAVE_S` if the middleware does not shut down: in rare cases it hangs."""

    def leave() -> None:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)

    watchdog = threading.Timer(LEAVE_S, leave)
    watchdog.daemon = True
    watchdog.start()
    try:
        yield
    finally:
        watchdog.cancel()


def _spin(make_node: Callable[[], Node], stop: Stop) -> int:
    """Make the node, spin it until it ends, destroy it. Returns 0 or raises the node's error."""
    node: Node | None = None
    executor: Executor | None = None
    try:
        if stop.requested:
            return 0
        warnings.filterwarnings("ignore", "Failed to fini rosout", RuntimeWarning)  # follows from the error below
        try:
            node = make_node()
        except RCLError as why:
            raise UserError(f"the node cannot be started: {_short(why)}") from why
        executor = EventsExecutor()
        executor.add_node(node)
        # spin() of the EventsExecutor can hang at the end; short calls do not, and they let the flag be checked
        while not (stop.requested or getattr(node, "done", False) or getattr(node, "error", None)):
            executor.spin_once(timeout_sec=SPIN_S)
    finally:
        stop.ignore()
        if node is not None and hasattr(node, "close"):
            node.close()
        with _leaving(2 if getattr(node, "error", None) else 0):
            if executor is not None:
                executor.shutdown()
            if node is not None:
                with suppress(Exception):  # the process ends anyway
                    node.destroy_node()
    if error := getattr(node, "error", None):
        raise error
    return 0
