# SPDX-License-Identifier: Apache-2.0
"""What every node's program needs around its node: arguments, parameters, signals, a clean end, diagnostics.

A node is any `rclpy.node.Node`. Three attributes are looked at when it has them:

- `done` (bool): set it to end the program with exit code 0;
- `error` (Exception): set it to end the program; a `UserError` becomes one line and exit code 2;
- `close()`: called once at the end, before the node is destroyed, when signals no longer interrupt: stop threads,
  send the last message, close files.

Subscription callbacks take the message alone: the EventsExecutor of this rclpy fails on callbacks that also want the
message info, raw or not.
"""

import difflib
import gc
import math
import os
import signal
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import rclpy
import rclpy.logging
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from aeropend_sim.cli.command import Parser, asked_to_complete, files
from aeropend_sim.ros import interface
from aeropend_sim.ros.transport import without_shared_memory
from aeropend_sim.untrusted import check_yaml, one_line

RCLError = rclpy_implementation.RCLError

try:
    from rclpy.experimental import EventsExecutor
except ImportError:  # an older rclpy
    EventsExecutor = SingleThreadedExecutor

EXIT_CODES = "exit codes: 0 ended, by Ctrl-C too; 2 the command line or a parameter cannot be used (one line says why)"

SPIN_S = 0.1
"""The longest the program takes to notice a signal, s."""

LEAVE_S = 5.0
"""s that the middleware is given to end, once the node has done its own part."""


class UserError(Exception):
    """What the user can put right: one line that says what, where, and what to do."""


class Stop:
    """Turns SIGINT and SIGTERM into a flag, from `install` on."""

    def __init__(self) -> None:
        self.requested = False

    def install(self) -> None:
        """Take over both signals. Only in the main thread."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._request)

    def _request(self, _number: int, _frame: FrameType | None) -> None:
        self.requested = True

    @staticmethod
    def ignore() -> None:
        """Let no signal interrupt the end of the program. Only in the main thread."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)


class Worker(threading.Thread):
    """A node's own thread. What goes wrong in it ends the program like an error anywhere else.

    Args:
        node: gets `error` when the target raises, and `done` when it returns.
        target: called with an event that says it is time to stop.
        name: of the thread, as system tools show it.
    """

    def __init__(self, node: Node, target: Callable[[threading.Event], None], name: str) -> None:
        super().__init__(name=name, daemon=True)
        self._node = node
        self._body = target
        self._end = threading.Event()

    def run(self) -> None:
        """Thread body."""
        try:
            self._body(self._end)
            self._node.done = True
        except Exception as error:  # the main thread raises it
            self._node.error = error

    def stop(self) -> None:
        """Ask the target to return and wait until it has."""
        self._end.set()
        if self.is_alive():
            self.join()


class Diagnostics:
    """Publishes a node's counters on `/diagnostics` once a second of wall time.

    Args:
        node: whose counters.
        report: returns what is wrong now ("" for nothing) and the counters.
        hardware_id: what the node stands for.
    """

    def __init__(
        self, node: Node, report: Callable[[], tuple[str, Mapping[str, object]]], hardware_id: str = ""
    ) -> None:
        self._node = node
        self._report = report
        self._hardware_id = hardware_id
        self._publisher = node.create_publisher(DiagnosticArray, interface.DIAGNOSTICS, interface.QOS)
        # wall time: a node whose /clock has stopped must still be heard
        self._timer = node.create_timer(1.0, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def publish(self) -> None:
        """Publish the counters now."""
        warning, values = self._report()
        status = DiagnosticStatus(
            level=DiagnosticStatus.WARN if warning else DiagnosticStatus.OK,
            name=self._node.get_fully_qualified_name().lstrip("/"),
            message=warning or "ok",
            hardware_id=self._hardware_id,
            values=[KeyValue(key=key, value=_text(value)) for key, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)


def _text(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class Setting:
    """A parameter of a node: what the user may give, and what is taken otherwise.

    The default's type is the parameter's type; a float also takes a YAML integer. Lists are lists of floats. What is
    `live` may be set while the node runs, which then must listen to it. A `path` may name a file besides its choices.
    """

    default: bool | int | float | str | list[float]
    description: str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()
    live: bool = False
    path: bool = False

    def values(self, prefix: str) -> Iterable[str]:
        """What a shell may offer as its value."""
        if isinstance(self.default, bool):
            return ("true", "false")
        return (*self.choices, *files(prefix)) if self.path else self.choices

    def check(self, name: str, value: object) -> Any:
        """Return the value in the setting's own type, or raise UserError."""
        kind = type(self.default)
        if kind is list and not isinstance(value, (str, bytes, bool)) and hasattr(value, "__iter__"):
            return [self._number(name, item, float) for item in value]
        if kind in (int, float):
            return self._number(name, value, kind)
        if type(value) is not kind:
            wanted = {bool: "true or false", str: "text", list: "a list of numbers"}[kind]
            raise UserError(f"parameter {name} is {value!r}: give {wanted}")
        if self.choices and value not in self.choices and not self.path:
            raise UserError(f"parameter {name} is '{value}': give one of {', '.join(self.choices)}")
        return value

    def _number(self, name: str, value: object, kind: type) -> float | int:
        whole = kind is int
        if isinstance(value, bool) or not isinstance(value, int if whole else (int, float)):
            raise UserError(f"parameter {name} is {value!r}: give a {'whole ' if whole else ''}number")
        if not self.low <= value <= self.high or not math.isfinite(value):
            raise UserError(f"parameter {name} is {value:g}: give {self.low:g} to {self.high:g} {self.unit}".rstrip())
        return kind(value)

    def descriptor(self) -> ParameterDescriptor:
        """Describe the parameter to ROS tools: unit and meaning, range, and whether it is fixed while the node runs."""
        text = f"[{self.unit}] {self.description}" if self.unit else self.description
        descriptor = ParameterDescriptor(description=text, read_only=not self.live)
        if self.choices:
            descriptor.additional_constraints = f"one of {', '.join(self.choices)}{', or a file' if self.path else ''}"
        if math.isfinite(self.low) and math.isfinite(self.high):
            if isinstance(self.default, float):
                descriptor.floating_point_range = [FloatingPointRange(from_value=self.low, to_value=self.high)]
            elif type(self.default) is int:
                descriptor.integer_range = [IntegerRange(from_value=int(self.low), to_value=int(self.high), step=1)]
        return descriptor


def overrides(node: Node) -> dict[str, Any]:
    """Return what the command line and parameter files set, by full name, without rclpy's own parameters.

    The node must have been made with `automatically_declare_parameters_from_overrides=True`.
    """
    own = ("use_sim_time", "start_type_description_service")
    given = {name: parameter.value for name, parameter in node.get_parameters_by_prefix("").items()}
    return {name: value for name, value in given.items() if name not in own and not name.startswith("qos_overrides.")}


def declare(node: Node, name: str, value: object, descriptor: ParameterDescriptor) -> None:
    """Declare a parameter with this value, in place of the bare one that the override made."""
    if node.has_parameter(name):
        node.undeclare_parameter(name)
    node.declare_parameter(name, value, descriptor, ignore_override=True)


def read_settings(node: Node, table: Mapping[str, Setting], given: Mapping[str, object]) -> dict[str, Any]:
    """Check and declare a node's parameters.

    Args:
        node: made with `automatically_declare_parameters_from_overrides=True`.
        table: every parameter by name.
        given: what was set; see `overrides`.

    Returns:
        Every parameter of the table.

    Raises:
        UserError: unknown name, wrong type, or out of range.
    """
    for name in given:
        if name not in table:
            near = difflib.get_close_matches(name, table, n=1)
            raise UserError(f"unknown parameter {name}: " + (f"did you mean {near[0]}?" if near else "see --help"))
    values = {name: setting.check(name, given.get(name, setting.default)) for name, setting in table.items()}
    for name, value in values.items():
        declare(node, name, value, table[name].descriptor())
    return values


@dataclass(frozen=True)
class Usage:
    """What `--help` of a node's program says, and what a shell completes.

    Attributes:
        text: of `--help`.
        settings: the parameters, by full name.
        word: what stands for the argument that is given without `--ros-args`; "" when there is none.
    """

    text: str
    settings: Mapping[str, Setting]
    word: str = ""

    def show(self) -> None:
        """Print the help; or tell the shell what may come next, and end."""
        if asked_to_complete():
            self._complete()
        print(self.text)

    def _complete(self) -> None:
        parser = Parser()
        if self.word:
            parser.add_argument("word", nargs="?", metavar=self.word)
        parser.add_argument("--ros-args", action="store_true", help="what follows is for ROS")
        parser.add_argument("--params-file", action="append", metavar="FILE", help="file of parameters")
        for option, meaning, completer in (
            ("-p", "parameter", self._parameters),
            ("-r", "other name", lambda **_: ("__ns:=/", "__node:=")),
        ):
            action = parser.add_argument(option, action="append", help=meaning)
            action.completer = completer  # type: ignore[attr-defined]
        parser.complete()

    def _parameters(self, prefix: str, **_: Any) -> Mapping[str, str]:
        """What may come next, and what it means."""
        name, given, value = prefix.partition(":=")
        if not given:
            return {f"{name}:=": setting.description for name, setting in self.settings.items()}
        setting = self.settings.get(name)
        return {f"{name}:={one}": "" for one in setting.values(value)} if setting else {}


def usage(
    summary: str,
    table: Mapping[str, Setting],
    examples: Sequence[str],
    more: str = "",
    word: str = "",
    further: Mapping[str, Setting] | None = None,
) -> Usage:
    """Describe a node's program.

    Args:
        summary: what it does.
        table: its parameters.
        examples: of command lines.
        more: text below the parameters.
        word: what stands for the argument that is given without `--ros-args`.
        further: parameters that are told of in `more`.
    """
    lines = [summary, "", "usage: " + examples[0]]
    lines += ["       " + example for example in examples[1:]]
    lines += ["", "parameters (-p name:=value, or a ROS parameter file):"] if table else []
    for name, setting in table.items():
        limits = ", ".join((*setting.choices, *["FILE"] * setting.path))
        if math.isfinite(setting.low) and math.isfinite(setting.high):
            limits = f"{setting.low:.12g}..{setting.high:.12g}"
        unit = f" {setting.unit}" if setting.unit else ""
        default = str(setting.default).lower() if isinstance(setting.default, bool) else setting.default
        limits = f"{limits}{unit}; " if limits else ""
        lines.append(f"  {name:<18} {setting.description}; {limits}default {default}")
    lines += ["", more] if more else []
    return Usage("\n".join([*lines, "", EXIT_CODES]), {**table, **(further or {})}, word)


def no_options(words: Sequence[str]) -> None:
    """Refuse options among the arguments that are not ROS's."""
    no_words([word for word in words if word.startswith("-")])


def no_words(words: Sequence[str]) -> None:
    """Refuse every argument that is not ROS's."""
    if words:
        raise UserError(f"unknown argument '{words[0]}': set parameters with --ros-args -p name:=value, see --help")


def run(
    make_node: Callable[..., Node],
    args: Sequence[str] | None = None,
    usage: Usage | None = None,
    read: Callable[[list[str]], Any] = no_words,
) -> int:
    """Run one node until it is done or a signal comes, and end cleanly.

    SIGINT and SIGTERM, once or many times, at any moment from here on, end the program with exit code 0: rclpy's own
    handlers are not used because they tear the context down under a spinning executor.

    Args:
        make_node: builds the node, after `rclpy.init`, of what `read` returned unless that is None. May raise
            UserError.
        args: command line without the program's name; None takes `sys.argv`.
        usage: what `--help` prints and a shell completes. When None, `read` does both.
        read: takes the arguments outside `--ros-args`. May raise UserError.

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
            readable = _readable_parameter_files(argv, folder)
            try:
                words = read(_words(readable))
                _init(readable)
            except UserError as error:  # say the user's file, not our copy of it
                names = {copy: file for copy, file in zip(readable, argv, strict=True) if copy != file}
                raise UserError(" ".join(names.get(word.strip("'."), word) for word in str(error).split())) from error
        code = _spin(make_node if words is None else partial(make_node, words), stop)
    except UserError as error:
        print(one_line(f"{program}: {' '.join(str(error).split())}"), file=sys.stderr)
    finally:
        stop.ignore()
        with _leaving(code):
            gc.collect()  # what a node left behind that could not be made whole
            rclpy.try_shutdown()
    return code


def _words(argv: list[str]) -> list[str]:
    """The arguments that are not ROS's."""
    try:
        return list(remove_ros_args(["node", *argv])[1:])
    except Exception as error:  # rclpy has several unrelated classes for this
        raise UserError(_short(error)) from error


def _init(argv: list[str]) -> None:
    """Start rclpy, with its complaints about the command line as one UserError."""
    rclpy.logging.set_logger_level("rcl", rclpy.logging.LoggingSeverity.FATAL)  # the UserError says it already
    without_shared_memory()
    try:
        rclpy.init(args=["node", *argv], signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:
        raise UserError(_short(error)) from error
    finally:
        rclpy.logging.set_logger_level("rcl", rclpy.logging.LoggingSeverity.UNSET)


def _short(error: Exception) -> str:
    """Strip C source lines and parser internals from rcl's message."""
    text = str(error).split(", at /")[0].split(". Error: Expected lexeme")[0]
    for prefix in ("failed to initialize rcl: ", "Failed to parse ROS arguments: "):
        text = text.removeprefix(prefix)
    return f"unknown ROS argument {text}" if type(error).__name__ == "UnknownROSArgsError" else text


def _readable_parameter_files(argv: list[str], folder: str) -> list[str]:
    """Check every `--params-file` and rewrite those that rcl would misread, into `folder`.

    rcl's YAML reader loses its place after an empty mapping (what follows lands under the wrong name, or is lost) and
    refuses a key without value. Both become an empty string here, so that the node sees them.
    """
    argv = list(argv)
    for at, argument in enumerate(argv[:-1]):
        if argument != "--params-file":
            continue
        path = argv[at + 1]
        try:
            text = Path(path).read_text(encoding="utf-8")
            check_yaml(text)
            root = yaml.compose(text, Loader=yaml.SafeLoader)
        except OSError as error:
            raise UserError(f"cannot read parameter file '{path}': {error.strerror}") from error
        except UnicodeDecodeError as error:
            raise UserError(f"cannot read parameter file '{path}': not a text file") from error
        except yaml.YAMLError as error:
            mark = getattr(error, "problem_mark", None)
            where = f" line {mark.line + 1}" if mark else ""
            raise UserError(f"parameter file '{path}'{where}: {getattr(error, 'problem', error)}") from error
        if root is None:
            continue
        _check_sections(path, root)
        if _fill_empty(root):
            copy = Path(folder) / f"{at}.yaml"
            argv[at + 1] = str(copy)
            with copy.open("w", encoding="utf-8") as file:
                yaml.serialize(root, file, Dumper=yaml.SafeDumper)
    return argv


def _check_sections(path: str, root: yaml.Node) -> None:
    """Refuse a file that is not NODE: ros__parameters: ..., which rcl would say less clearly."""

    def refuse(node: yaml.Node, why: str) -> None:
        raise UserError(
            f"parameter file '{path}' line {node.start_mark.line + 1}: {why}; it must read '/**: ros__parameters: ...'"
        )

    def section(node: yaml.Node) -> None:
        if not isinstance(node, yaml.MappingNode):
            refuse(node, "no parameters")
        for key, value in node.value:
            if not isinstance(value, yaml.MappingNode):
                refuse(key, f"'{key.value}' holds no parameters")
            if key.value != "ros__parameters":
                section(value)

    section(root)


def _fill_empty(node: yaml.Node) -> bool:
    """Put an empty string in place of each empty mapping and null below ros__parameters. True when there was one."""
    changed = False
    if isinstance(node, yaml.MappingNode):
        for at, (key, value) in enumerate(node.value):
            empty_map = isinstance(value, yaml.MappingNode) and not value.value and key.value != "ros__parameters"
            null = isinstance(value, yaml.ScalarNode) and value.tag == "tag:yaml.org,2002:null"
            if empty_map or null:
                node.value[at] = (key, yaml.ScalarNode("tag:yaml.org,2002:str", "", style='"'))
                changed = True
            else:
                changed |= _fill_empty(value)
    return changed


@contextmanager
def _leaving(code: int) -> Iterator[None]:
    """End the program after `LEAVE_S` if the middleware does not let go: it was seen to hang, if hardly ever."""

    def leave() -> None:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)

    patience = threading.Timer(LEAVE_S, leave)
    patience.daemon = True
    patience.start()
    try:
        yield
    finally:
        patience.cancel()


def _spin(make_node: Callable[[], Node], stop: Stop) -> int:
    """Make the node, spin it to its end, take it down. Returns 0 or raises."""
    node: Node | None = None
    executor: Executor | None = None
    try:
        if stop.requested:
            return 0
        warnings.filterwarnings("ignore", "Failed to fini rosout", RuntimeWarning)  # after what is said below
        try:
            node = make_node()
        except RCLError as why:
            raise UserError(f"the node cannot be started: {_short(why)}") from why
        executor = EventsExecutor()
        executor.add_node(node)
        # spin() of the EventsExecutor can hang at the end; in slices it does not, and the flag is seen
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
                with suppress(Exception):  # the node is going anyway
                    node.destroy_node()
    if error := getattr(node, "error", None):
        raise error
    return 0


def wait_until(condition: Callable[[], bool], stop: threading.Event, poll_s: float = 0.05) -> bool:
    """Poll a condition until it holds (True) or `stop` is set (False)."""
    while not condition():
        if stop.wait(poll_s):
            return False
    return True
