# SPDX-License-Identifier: Apache-2.0
"""Progress of a command, and the time that is left."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.text import Text

SILENT_S = 2.0
"""[s] Time before a progress bar is shown. A choice: shorter work needs no bar."""


class Show(Protocol):
    """Shows the progress."""

    def __call__(self, done: float, what: str = "") -> None:
        """Show the progress.

        Args:
            done: finished part of the total.
            what: new description of the work; "" if it is the same.
        """


class TimeLeft(ProgressColumn):
    """The time left, from the mean speed so far. It is shown after the first step; that of rich needs more steps."""

    def render(self, task: Task) -> Text:
        """Text of the column."""
        if not task.completed or task.total is None or task.elapsed is None:
            return Text("")
        at: float = task.fields["at"]  # time of the last step
        left = at * (task.total - task.completed) / task.completed - (task.elapsed - at)
        minutes, seconds = divmod(max(0, round(left)), 60)
        return Text(f"{minutes} min {seconds:02} s left" if minutes else f"{seconds} s left")


def nothing(done: float, what: str = "") -> None:
    """Show nothing."""


@contextmanager
def progress(what: str, total: float = 1.0, console: Console | None = None, silent_s: float = SILENT_S
             ) -> Iterator[Show]:
    """Show a bar with the time left on standard error, if that is a terminal and the work takes long.

    Args:
        what: description of the work.
        total: value of `done` at the end.
        console: other place for the bar.
        silent_s: [s] time before the bar is shown.
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
