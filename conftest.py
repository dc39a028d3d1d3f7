# SPDX-License-Identifier: Apache-2.0
"""Tells the tests that run nodes from those that only compute: the latter may share the machine (`make test`)."""

import pytest

RUN_NODES = {"graph", "processes", "start"}
"""The fixtures of tests whose nodes need the machine to themselves."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark those that start nodes, those of the packages apart from those of `test`."""
    for item in items:
        if RUN_NODES & set(getattr(item, "fixturenames", ())) or item.get_closest_marker("alone"):
            item.add_marker("live")
        if item.get_closest_marker("live"):
            item.add_marker(pytest.mark.xdist_group(item.path.relative_to(item.config.rootpath).parts[0]))
