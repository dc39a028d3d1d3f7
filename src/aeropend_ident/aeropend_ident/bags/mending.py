# SPDX-License-Identifier: Apache-2.0
"""The command that mends a recording, as messages name it: `import BAG NEW ...`, with the names of the real ones."""

from __future__ import annotations

import shlex
from itertools import count
from pathlib import Path

from aeropend_sim.untrusted import printable

COMMAND = "import BAG NEW "


def mend(*options: str) -> str:
    """The command with these options of `import`; the recording has no name yet."""
    return f"`{COMMAND}{' '.join(options)}`"


def named(text: str, bag: str | Path) -> str:
    """A message whose commands name the recording, and a new one beside it that is not there yet.

    Args:
        text: with commands of `mend`, or without.
        bag: the recording.
    """
    if COMMAND not in text:
        return text
    path = Path(bag)
    name = path.name if path.is_dir() else path.stem
    new = next(place for number in count(1)
               if not (place := path.with_name(f"{name}_mended{number if number > 1 else ''}")).exists())
    return text.replace(COMMAND, printable(f"import {shlex.join([str(path), str(new)])} "))
