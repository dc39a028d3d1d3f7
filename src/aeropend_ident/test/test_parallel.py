# SPDX-License-Identifier: Apache-2.0
"""Calls in copies of a process: the results of one process, its errors, a line if a copy is ended, and Ctrl-C."""

import os
import signal
import time
from multiprocessing import active_children

import pytest

from aeropend_ident.estimation.parallel import parallel
from aeropend_ident.interrupt import check, interrupts_wait, on_interrupt
from aeropend_sim.errors import UserError


@pytest.mark.parametrize("jobs", [1, 2, 5])
def test_results_come_in_order_and_functions_need_not_be_sent(jobs):
    factor = [10]
    assert parallel(jobs, lambda x: factor[0] * x, range(7)) == [0, 10, 20, 30, 40, 50, 60]


def test_several_processes_work_and_a_copy_makes_no_further_ones():
    def of_process(_):
        return os.getpid(), parallel(4, lambda _: os.getpid(), range(4))

    found = parallel(2, of_process, range(6))
    assert os.getpid() not in {mine for mine, _ in found}
    assert all(set(inner) == {mine} for mine, inner in found)
    assert parallel(1, lambda _: os.getpid(), range(3)) == [os.getpid()] * 3


def test_what_a_function_changes_stays_in_its_copy():
    seen = []
    parallel(2, seen.append, range(4))
    assert seen == []


def test_an_error_is_the_callers():
    def fails(x):
        raise ValueError(f"item {x}")

    with pytest.raises(ValueError, match="item 0"):
        parallel(2, fails, range(3))


def test_a_copy_that_the_system_ends_is_said_in_one_line():
    with pytest.raises(UserError, match="want of memory: try --jobs 1"):
        parallel(2, lambda _: os.kill(os.getpid(), signal.SIGKILL), range(2))


def interrupted(after=lambda: None):
    with interrupts_wait():
        signal.raise_signal(signal.SIGINT)
        after()


def test_ctrl_c_takes_effect_at_the_next_check_or_at_the_end():
    done = []
    with pytest.raises(KeyboardInterrupt):
        interrupted(lambda: [done.append("what had begun"), check(), done.append("more")])
    assert done == ["what had begun"]
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    check()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_where_ctrl_c_is_ignored_it_stays_so():
    with on_interrupt(signal.SIG_IGN):
        interrupted(check)
        assert parallel(2, lambda _: os.kill(os.getpid(), signal.SIGINT), range(2)) == [None, None]


def test_ctrl_c_ends_the_copies_too():
    with pytest.raises(KeyboardInterrupt):
        interrupted(lambda: parallel(2, lambda _: os.kill(os.getpid(), signal.SIGINT), range(2)))


def test_ctrl_c_for_this_process_alone_ends_the_copies_in_their_work(tmp_path):
    def work(k):
        time.sleep(20.0)
        (tmp_path / str(k)).touch()

    with pytest.raises(KeyboardInterrupt):
        interrupted(lambda: parallel(2, work, range(2)))
    assert active_children() == []
    assert not [*tmp_path.iterdir()]
