# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the tests that start real processes."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent / "support"))

from evaluation.support.graph import Graph, Process, isolate

isolate()


@pytest.fixture(scope="session")
def graph() -> Iterator[Graph]:
    """The tests' own node."""
    graph = Graph()
    yield graph
    graph.close()


@pytest.fixture
def start() -> Iterator[Callable[..., Process]]:
    """Start a node's process; it is stopped when the test ends, whatever happens."""
    processes: list[Process] = []

    def start(name: str, *args: str) -> Process:
        processes.append(Process(name, *args))
        return processes[-1]

    yield start
    for process in reversed(processes):
        process.stop()
