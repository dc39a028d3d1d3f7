# SPDX-License-Identifier: Apache-2.0
"""How far a command is, and how long it will still take."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

SILENT_S = 2.0
"""Work before a bar is shown, s: what takes less needs none."""


class Show(Protocol):
    """Shows how much is done."""

    def __call__(self, done: float, what: str = "") -> None:
        """Show that this much of the total is done; `what` is done now, if that has changed."""


class TimeLeft(ProgressColumn):
    """The time left when it goes on as it did, from the first step on: rich's own column waits for more of them."""

    def render(self, task: Task) -> Text:
        """Its text."""
        if not task.completed or task.total is None or task.elapsed is None:
            return Text("")
        at: float = task.fields["at"]  # when the last step was done
        left = at * (task.total - task.completed) / task.completed - (task.elapsed - at)
        minutes, seconds = divmod(max(0, round(left)), 60)
        return Text(f"{minutes} min {seconds:02} s left" if minutes else f"{seconds} s left")


def nothing(done: float, what: str = "") -> None:
    """Show nothing."""


@contextmanager
def progress(what: str, total: float = 1.0, console: Console | None = None, silent_s: float = SILENT_S
             ) -> Iterator[Show]:
    """A bar with the time left on standard error, where that is a terminal and the work has taken a while.

    Args:
        what: is done.
        total: what `done` counts up to.
        console: another place for it.
        silent_s: work before it is shown, s.
    """
    console = console or Console(stderr=True)
    bar = Progress(TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:3.0f} %"),
                   TimeLeft(), console=console, transient=True, disable=not console.is_terminal)
    task = bar.add_task(what, total=total, at=0.0)

    def show(done: float, what: str = "") -> None:
        bar.update(task, completed=done, description=what or None, at=bar.tasks[0].elapsed)

    timer = threading.Timer(silent_s, bar.start)
    timer.daemon = True
    timer.start()
    try:
        yield show
    finally:
        timer.cancel()
        timer.join()
        if bar.live.is_started:
            bar.stop()
