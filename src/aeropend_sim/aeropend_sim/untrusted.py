# SPDX-License-Identifier: Apache-2.0
"""Input from files of unknown origin: text made printable, and YAML read without harm.

The safe loaders of PyYAML run no code. But deep nesting overflows the C stack, merged aliases grow without limit, the
conversion of a long number takes hours, and a tag that does not fit its value raises an exception of any type.
"""

from __future__ import annotations

import re
from collections.abc import Hashable
from typing import Any

import yaml

DEEPEST = 50
"""Greatest depth of mappings and lists. A choice: parameter files and metadata of bags have fewer than 10."""
LONGEST_MESSAGE = 2000
"""Greatest number of characters of a message. A choice."""
LONGEST_WORD = 1000
"""Greatest number of characters of an unquoted word, which may be a number. A choice."""

_FASTEST: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def printable(text: str) -> str:
    r"""The text with control characters, line breaks and lone surrogates written as \x1b, \n, \udcff."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def one_line(text: str) -> str:
    """The text as one printable line of limited length."""
    return printable(text if len(text) <= LONGEST_MESSAGE else f"{text[:LONGEST_MESSAGE]} …")


def check_yaml(text: str | bytes) -> None:
    """Check that YAML can be read in a time and memory proportional to its length.

    Args:
        text: one document.

    Raises:
        yaml.YAMLError: it is no YAML, has an alias, is nested deeper than `DEEPEST`, or has a word that is too long.
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
        loader: a safe loader of PyYAML.

    Raises:
        yaml.YAMLError: it cannot be read.
    """
    check_yaml(text)
    try:
        return yaml.load(text, loader)
    except yaml.YAMLError:
        raise
    except Exception as error:  # from int(), float() and datetime()
        raise yaml.YAMLError(f"a value does not fit its tag or type: {error}") from error


class NumberLoader(yaml.SafeLoader):
    """Reads numbers and truth values as rcl does (1e-5 is a number, in YAML 1.1 text), and refuses repeated keys."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012 - PyYAML's own

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, object]:
        """A mapping, without repeated keys."""
        seen: set[str] = set()
        for key, _ in node.value:
            name = str(key.value)
            if name in seen:
                raise yaml.constructor.ConstructorError(None, None, f"{name} is given twice", key.start_mark)
            seen.add(name)
        return super().construct_mapping(node, deep)


NumberLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?$|[-+]?\.(inf|Inf|INF)$|\.(nan|NaN|NAN)$"),
    list("-+.0123456789"))
NumberLoader.add_implicit_resolver("tag:yaml.org,2002:bool", re.compile(r"(true|True|TRUE|false|False|FALSE)$"),
                                   list("tTfF"))
NumberLoader.add_implicit_resolver("tag:yaml.org,2002:null", re.compile(r"~$|null$|Null$|NULL$|$"), ["~", "n", "N", ""])
