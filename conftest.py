# SPDX-License-Identifier: Apache-2.0
"""Marks the tests that run nodes: those that only compute may share the machine (`make test`)."""

import signal

import pytest

RUN_NODES = {"graph", "processes", "start"}
"""The fixtures of tests whose nodes need the machine to themselves."""


def pytest_configure() -> None:
    """Let Ctrl-C interrupt tests that were started in the background, where a shell ignores it."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark those that start nodes."""
    for item in items:
        if RUN_NODES & set(getattr(item, "fixturenames", ())) or item.get_closest_marker("alone"):
            item.add_marker("live")
