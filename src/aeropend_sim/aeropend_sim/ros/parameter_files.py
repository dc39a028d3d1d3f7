# SPDX-License-Identifier: Apache-2.0
"""ROS parameter files from the command line: checked, and rewritten where rcl's reader would misread them."""

from pathlib import Path

import yaml

from aeropend_sim.errors import UserError
from aeropend_sim.untrusted import check_yaml


def readable_parameter_files(argv: list[str], folder: str) -> list[str]:
    """Check each file of `--params-file`, and rewrite those that rcl would misread.

    After an empty mapping, rcl's YAML reader puts the next values under wrong names or loses them. It refuses a key
    without a value. Here both become an empty string, so that the node receives them.

    Args:
        argv: the command line.
        folder: takes the rewritten files.

    Returns:
        The command line, with the paths of the rewritten files.

    Raises:
        UserError: a file cannot be read, or is no parameter file.
    """
    argv = list(argv)
    for at, argument in enumerate(argv[:-1]):
        if argument != "--params-file":
            continue
        root = _read(argv[at + 1])
        if root is None:
            continue
        _check_sections(argv[at + 1], root)
        if _fill_empty(root):
            copy = Path(folder) / f"{at}.yaml"
            argv[at + 1] = str(copy)
            with copy.open("w", encoding="utf-8") as file:
                yaml.serialize(root, file, Dumper=yaml.SafeDumper)
    return argv


def _read(path: str) -> yaml.Node | None:
    """The root of a YAML file; None for an empty one."""
    try:
        text = Path(path).read_text(encoding="utf-8")
        check_yaml(text)
        root: yaml.Node | None = yaml.compose(text, Loader=yaml.SafeLoader)
    except OSError as error:
        raise UserError(f"cannot read parameter file '{path}': {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"cannot read parameter file '{path}': not a text file") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" line {mark.line + 1}" if mark else ""
        raise UserError(f"parameter file '{path}'{where}: {getattr(error, 'problem', error)}") from error
    return root


def _check_sections(path: str, root: yaml.Node) -> None:
    """Refuse a file without `NODE: ros__parameters: ...`; the message of rcl would be less clear."""

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
    """Replace each empty mapping and null below `ros__parameters` by an empty string; return whether there was one."""
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
