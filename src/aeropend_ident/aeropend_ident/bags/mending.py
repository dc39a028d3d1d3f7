# SPDX-License-Identifier: Apache-2.0
"""The command that mends a recording, as messages say it: `import BAG NEW ...`, with the names of the real ones."""

from __future__ import annotations

import shlex
from itertools import count
from pathlib import Path

from aeropend_sim.cli.command import called
from aeropend_sim.untrusted import printable

COMMAND = "import BAG NEW "
COPY = "writes a mended copy to NEW"


def mend(*options: str) -> str:
    """The command with these options of `import`, and what it does; the recordings have no names yet."""
    return f"`{COMMAND}{' '.join(options)}` {COPY}"


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
    command = f"{called('import', 'aeropend_ident')} {shlex.join([str(path), str(new)])} "
    return text.replace(COMMAND, printable(command)).replace(COPY, printable(COPY.replace("NEW", str(new))))
