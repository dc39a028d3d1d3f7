# SPDX-License-Identifier: Apache-2.0
"""Tells the tests that run nodes from those that only compute: the latter may share the machine (`make test`)."""

import pytest

RUN_NODES = {"graph", "processes", "start"}
"""The fixtures of tests whose nodes need the machine to themselves."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark those that start nodes."""
    for item in items:
        if RUN_NODES & set(getattr(item, "fixturenames", ())) or item.get_closest_marker("alone"):
            item.add_marker("live")
