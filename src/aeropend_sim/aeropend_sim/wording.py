# SPDX-License-Identifier: Apache-2.0
"""Words for messages."""


def counted(number: int, noun: str, plural: str = "") -> str:
    """A number with its noun: '1 row', '3 rows'.

    Args:
        number: of things.
        noun: its singular.
        plural: its plural; "": the singular with an s.
    """
    return f"{number} {noun}" if number == 1 else f"{number} {plural or noun + 's'}"
