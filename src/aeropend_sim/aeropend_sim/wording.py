# SPDX-License-Identifier: Apache-2.0
"""Words for messages."""

from collections.abc import Sequence


def counted(number: int, noun: str, plural: str = "") -> str:
    """A number with its noun: '1 row', '3 rows'.

    Args:
        number: of things.
        noun: its singular.
        plural: its plural; "": the singular with an s.
    """
    return f"{number} {noun}" if number == 1 else f"{number} {plural or noun + 's'}"


MANY = 1e4
"""Ratio from which a text gives only a bound (choice: what is that far off needs no digits)."""


def times(ratio: float) -> str:
    """A ratio in words: `times(9.13)` is "9.1 times", `times(2e7)` is "more than 10000 times".

    Args:
        ratio: the number, 0 or more.
    """
    return f"{float(f'{ratio:.3g}'):g} times" if ratio < MANY else f"more than {MANY:g} times"


def enumerated(words: Sequence[str]) -> str:
    """Words as a list in a sentence: "a", "a and b", "a, b and c".

    Args:
        words: one or more.
    """
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
