# SPDX-License-Identifier: Apache-2.0
"""The parameters of a node: description, check, declaration."""

import difflib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from aeropend_sim.cli.command import files
from aeropend_sim.errors import UserError


@dataclass(frozen=True)
class Setting:
    """A parameter of a node.

    Attributes:
        default: its value if the user gives none. Its type is the type of the parameter; a float also accepts a YAML
            integer; a list is a list of floats.
        description: its meaning, for `--help` and ROS tools.
        unit: its unit; "" for none.
        low: its smallest value.
        high: its greatest value.
        choices: its possible values; empty for any.
        live: whether it may be set while the node runs. The node then reacts to the change.
        path: whether its value may be the path of a file instead of one of the choices.
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
        """The values that a shell offers for completion."""
        if isinstance(self.default, bool):
            return ("true", "false")
        return (*self.choices, *files(prefix)) if self.path else self.choices

    def check(self, name: str, value: object) -> Any:
        """Return the value in the type of the parameter.

        Args:
            name: name of the parameter, for the error message.
            value: the value that was given.

        Raises:
            UserError: wrong type, out of range, or not one of the choices.
        """
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
            form = "d" if whole else "g"
            raise UserError(f"parameter {name} is {value:{form}}: give {self.low:.12g} to {self.high:.12g} {self.unit}"
                            .rstrip())
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
    """Return the values from the command line and parameter files, by full name, without the parameters of rclpy.

    Args:
        node: made with `automatically_declare_parameters_from_overrides=True`.
    """
    own = ("use_sim_time", "start_type_description_service")
    given = {name: parameter.value for name, parameter in node.get_parameters_by_prefix("").items()}
    return {name: value for name, value in given.items() if name not in own and not name.startswith("qos_overrides.")}


def declare(node: Node, name: str, value: object, descriptor: ParameterDescriptor) -> None:
    """Declare a parameter, in place of the one without a descriptor that rclpy declared for the override.

    Args:
        node: its node.
        name: its full name.
        value: its value.
        descriptor: its description.
    """
    if node.has_parameter(name):
        node.undeclare_parameter(name)
    node.declare_parameter(name, value, descriptor, ignore_override=True)


def read_settings(node: Node, table: Mapping[str, Setting], given: Mapping[str, object]) -> dict[str, Any]:
    """Check and declare the parameters of a node.

    Args:
        node: made with `automatically_declare_parameters_from_overrides=True`.
        table: every parameter by name.
        given: the values that were set; see `overrides`.

    Returns:
        The value of each parameter of the table.

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
