# SPDX-License-Identifier: Apache-2.0
import io
import time

from rich.console import Console
from rich.progress import Progress

from aeropend_sim.cli.progress import TimeLeft, progress


def shown(silent_s, *, terminal):
    """What a bar shows of work that is over when the bar has come, or could have."""
    text = io.StringIO()
    with progress("fitting", 4.0, Console(file=text, force_terminal=terminal), silent_s) as show:
        show(1.0, "reading")
        show(2.0)
        end = time.monotonic() + 60.0
        while terminal and silent_s < 1.0 and "reading" not in text.getvalue():
            assert time.monotonic() < end
            time.sleep(0.01)
    return text.getvalue()


def test_a_bar_says_what_is_done_and_how_much():
    text = shown(0.0, terminal=True)
    assert "reading" in text
    assert "50 %" in text
    assert "s left" in text


def test_short_work_shows_no_bar():
    assert shown(60.0, terminal=True) == ""


def test_a_file_gets_no_bar():
    assert shown(0.0, terminal=False) == ""


def test_the_time_left_is_that_of_what_is_done_and_runs_down_between_steps():
    clock = [0.0]
    bar = Progress(get_time=lambda: clock[0], disable=True)
    task = bar.add_task("fitting", total=4.0, at=0.0)

    def left():
        return TimeLeft().render(bar.tasks[0]).plain

    assert left() == ""
    clock[0] = 30.0
    bar.update(task, completed=1.0, at=30.0)
    assert left() == "1 min 30 s left"
    clock[0] = 70.0
    assert left() == "50 s left"
    clock[0] = 300.0
    assert left() == "0 s left"
