# SPDX-License-Identifier: Apache-2.0
"""A YAML file that a person wrote, read, or refused in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from aeropend_sim.errors import UserError
from aeropend_sim.untrusted import NumberLoader, load_yaml, one_line


def read(path: str | Path, kind: str, refused: type[UserError]) -> Any:
    """Read a YAML file of numbers and names.

    Args:
        path: of the file.
        kind: what it is, for error messages: "an effect file".
        refused: the error that is raised.

    Raises:
        UserError: as `refused`: the file cannot be read, or is no YAML.
    """
    try:
        return load_yaml(Path(path).read_text(encoding="utf-8"), NumberLoader)
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not a text file"
        raise refused(f"{path}: the {kind.split(' ', 1)[1]} cannot be read: {reason}") from None
    except yaml.MarkedYAMLError as error:
        line = f" at line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise refused(f"{path}: not valid YAML{line}: {one_line(str(error.problem))}") from None
    except yaml.YAMLError as error:
        raise refused(f"{path}: not {kind}: {one_line(str(error))}") from None
