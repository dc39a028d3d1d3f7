# SPDX-License-Identifier: Apache-2.0
"""What comes from strangers: text that is shown to a person, and YAML without what can hurt.

A file may be anybody's. PyYAML's safe loaders run no code, but nesting overflows the C stack, merged aliases multiply,
long numbers take hours, and a tag that does not fit its value raises whatever the value's type raises.
"""

from __future__ import annotations

from typing import Any

import yaml

DEEPEST = 50
"""Mappings and lists inside each other; parameter files and bags' metadata have fewer than 10."""
LONGEST_MESSAGE = 2000
"""Characters of what is said in one line."""
LONGEST_WORD = 1000
"""Characters of an unquoted word, which may be a number."""

_FASTEST: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def printable(text: str) -> str:
    r"""The same text with what steers a terminal, breaks a line or cannot be encoded as \x1b, \n, \udcff."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def one_line(text: str) -> str:
    """The same text as one line for a person: printable and not endless."""
    return printable(text if len(text) <= LONGEST_MESSAGE else f"{text[:LONGEST_MESSAGE]} …")


def check_yaml(text: str | bytes) -> None:
    """Make sure that YAML can be read without harm, in a time and memory in proportion to its length.

    Raises:
        yaml.YAMLError: it is none, holds an alias, is nested deeper than `DEEPEST`, or holds an endless word.
    """
    depth = 0
    event: Any
    for event in yaml.parse(text, _FASTEST):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        problem = ""
        if isinstance(event, yaml.AliasEvent):
            problem = "an alias (*name) is not read here: write its value out"
        elif depth > DEEPEST:
            problem = f"nested deeper than {DEEPEST}"
        elif isinstance(event, yaml.ScalarEvent) and len(event.value) > LONGEST_WORD and " " not in event.value and (
                event.implicit[0] or event.tag is not None):
            problem = f"an unquoted word of more than {LONGEST_WORD} characters"
        if problem:
            raise yaml.composer.ComposerError(None, None, problem, event.start_mark)


def load_yaml(text: str | bytes, loader: Any = _FASTEST) -> Any:
    """Read YAML as `yaml.load` does, after `check_yaml`.

    Args:
        text: one document.
        loader: a safe one.

    Raises:
        yaml.YAMLError: it cannot be read.
    """
    check_yaml(text)
    try:
        return yaml.load(text, loader)
    except yaml.YAMLError:
        raise
    except Exception as error:  # what int(), float() and datetime() raise
        raise yaml.YAMLError(f"a value does not fit its tag or type: {error}") from error
