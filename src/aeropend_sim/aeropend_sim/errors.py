# SPDX-License-Identifier: Apache-2.0
"""The error that a user can correct."""

from aeropend_sim.untrusted import one_line


class UserError(ValueError):
    """An input that cannot be used, or an output that cannot be made.

    Its text is one line: the problem, its place, and how to correct it. Commands and nodes print it and end with exit
    code 2. All errors that a user can cause derive from it.
    """

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))
