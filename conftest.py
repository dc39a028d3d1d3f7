# SPDX-License-Identifier: Apache-2.0
"""Marks the tests that run nodes: those that only compute may share the machine (`make test`)."""

import re
import signal
from pathlib import Path

import pytest

RUN_NODES = {"graph", "processes", "start"}
"""The fixtures of tests whose nodes need the machine to themselves."""

SAID = {"live and not alone": re.compile(rf"[(,] ?({'|'.join(sorted(RUN_NODES))})[,)]|mark\.live"),
        "alone": re.compile(r"mark\.alone")}
"""What stands in each file that has tests for an option -m of tools/test."""


def pytest_configure() -> None:
    """Let Ctrl-C interrupt tests that were started in the background, where a shell ignores it."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave files unread that have no test for the option -m: each process needs 10 s for all of them."""
    said = SAID.get(config.option.markexpr)
    if said and collection_path.match("test_*.py") and not said.search(collection_path.read_text()):
        return True
    return None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark those that start nodes, see that tools/test runs each of them, and begin with what takes longest."""
    items.sort(key=lambda item: mark.args[0] if (mark := item.get_closest_marker("timeout")) else 0.0, reverse=True)
    for item in items:
        alone = item.get_closest_marker("alone")
        if alone or RUN_NODES & set(getattr(item, "fixturenames", ())):
            item.add_marker("live")
        if item.get_closest_marker("live"):
            said = SAID["alone" if alone else "live and not alone"]
            if not said.search(item.path.read_text()):
                raise pytest.UsageError(f"{item.nodeid} starts nodes, but its file does not match {said.pattern!r}: "
                                        "tools/test would not run it")
