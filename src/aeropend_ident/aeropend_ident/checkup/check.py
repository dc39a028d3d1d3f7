# SPDX-License-Identifier: Apache-2.0
"""One finding of a check-up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Level = Literal["ok", "warning", "error"]
"""Whether all is well, something may be wrong, or something does not work."""


@dataclass(frozen=True)
class Check:
    """A finding.

    Attributes:
        level: how bad it is.
        what: what was looked at.
        text: what was seen and, if it is not ok, what to do.
    """

    level: Level
    what: str
    text: str

    def __str__(self) -> str:
        return f"{self.level:<8} {self.what}: {self.text}"


def ok(what: str, text: str) -> Check:
    """All is well."""
    return Check("ok", what, text)


def warning(what: str, text: str) -> Check:
    """Something may be wrong."""
    return Check("warning", what, text)


def error(what: str, text: str) -> Check:
    """Something does not work."""
    return Check("error", what, text)
