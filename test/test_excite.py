# SPDX-License-Identifier: Apache-2.0
"""The node `excite`: what it sends, when, and how it ends."""

import signal
import time

import numpy as np
import pytest
from evaluation.support.graph import parameters, stamps
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import BatteryState
from std_msgs.msg import Float64

from aeropend_control.nodes.excite import REPEAT, changes
from aeropend_sim.model.excitation import KINDS, Excitation
from aeropend_sim.ros.interface import ARMATURE, DUTY_COMMAND, stamp

PERIOD_NS = 2_040_000


def test_changes_are_sent_at_once_and_the_rest_is_repeated():
    series = np.array([0.1] * 20 + [0.2] * 3 + [0.1] * 10)
    assert changes(series, 9).tolist() == [0, 9, 18, 20, 23, 32]
    assert changes(np.zeros(1), 9).tolist() == [0]
    assert REPEAT * PERIOD_NS < 20e6


def test_it_waits_for_a_listener_and_says_so(start):
    excite = start("excite").wait_for("no subscriber to /duty_command")
    assert excite.stop() == 0


@pytest.mark.parametrize("kind", KINDS)
def test_it_sends_the_signal_then_0_and_ends(graph, start, kind):
    excite = start("excite", *parameters(kind=kind, duration=2.0, seed=4))
    with graph.listening(Float64, DUTY_COMMAND) as sent:
        graph.until(lambda: excite.popen.poll() is not None, "its end")
        graph.until(lambda: sent and sent[-1].data == 0.0, "duty 0")
    assert excite.wait() == 0
    series = Excitation(kind=kind, duration=2.0, seed=4).series()
    due = series[changes(series)]
    received = [message.data for message in sent]
    assert received[-1] == 0.0
    assert set(received) <= {0.0, *series}
    # a machine under load may leave out what is overdue, not what is news for long
    assert len(due) + 10 >= len(received) > 0.7 * len(due)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_with_duty_0(graph, start, number):
    excite = start("excite", *parameters(kind="hold", duty=0.5, duration=600.0))
    with graph.listening(Float64, DUTY_COMMAND) as sent:
        graph.until(lambda: len(sent) > 20, "its duty")
        assert sent[-1].data == 0.5
        excite.send(number).send(number)
        graph.until(lambda: sent[-1].data == 0.0, "duty 0")
    assert excite.wait() == 0


class SteppedClock:
    """The tests' own /clock, which nodes hear by best effort."""

    def __init__(self, graph, publish):
        self.ns = 0
        self._graph = graph
        self._publish = publish

    def step(self, periods, condition, what):
        """Move on, and wait for what the new time brings."""
        self.ns += periods * PERIOD_NS

        def heard():
            self._publish(Clock(clock=stamp(self.ns)))
            return condition()

        self._graph.until(heard, what)


def test_it_follows_the_clock_to_the_sample(graph, start):
    excite = start("excite", *parameters(duration=1.0, seed=2, use_sim_time=True))
    series = Excitation(duration=1.0, seed=2).series()
    due = changes(series)
    with graph.listening(Float64, DUTY_COMMAND) as sent, graph.talking(Clock, "/clock") as publish:
        clock = SteppedClock(graph, publish)
        clock.step(1000, lambda: len(sent) == 1, "the first duty")
        for number, periods in enumerate(np.diff(due), start=2):
            clock.step(int(periods), lambda number=number: len(sent) == number, f"duty {number}")
        clock.step(len(series), lambda: excite.popen.poll() is not None, "its end")
        graph.until(lambda: len(sent) > len(due), "duty 0")
    received = [message.data for message in sent]
    assert received[: len(due)] == series[due].tolist()
    assert set(received[len(due) :]) == {0.0}
    assert excite.wait() == 0


def test_a_clock_that_goes_back_ends_it(graph, start):
    excite = start("excite", *parameters(use_sim_time=True))
    with graph.listening(Float64, DUTY_COMMAND) as sent, graph.talking(Clock, "/clock") as publish:
        clock = SteppedClock(graph, publish)
        clock.step(1000, lambda: len(sent) == 1, "the first duty")
        clock.step(-500, lambda: excite.popen.poll() is not None, "its end")
        graph.until(lambda: sent[-1].data == 0.0, "duty 0")
    assert excite.wait() == 2
    assert "/clock went back" in excite.output.splitlines()[-1]


def test_the_plant_applies_it_in_fast_simulated_time(graph, start):
    start("plant", *parameters(speed=2.0))
    with graph.listening(BatteryState, ARMATURE) as armature:
        excite = start(
            "excite", *parameters(kind="steps", sequence="[0.2, 0.5]", hold_max=2.0, duration=8.0, use_sim_time=True)
        )
        graph.until(lambda: excite.popen.poll() is not None, "its end")
        graph.until(lambda: armature[-1].percentage == 0.0, "duty 0")
    assert excite.wait() == 0
    duty = np.array([message.percentage for message in armature])
    at = np.flatnonzero(np.diff(duty))
    assert duty[at + 1].tolist() == np.float32([0.2, 0.5, 0.2, 0.5, 0.0]).tolist()
    lengths = np.diff(np.array(stamps(armature))[at]) * 1e-9
    assert lengths == pytest.approx([2.0] * 4, abs=0.5)


def test_it_drives_the_plant_and_leaves_it_off(graph, start):
    start("plant")
    with graph.listening(BatteryState, ARMATURE) as armature:
        excite = start("excite", *parameters(kind="hold", duty=0.3, duration=1.5))
        graph.until(lambda: any(message.percentage == np.float32(0.3) for message in armature), "the duty")
        graph.until(lambda: excite.popen.poll() is not None, "its end")
        graph.until(lambda: armature[-1].percentage == 0.0, "duty 0")
        counters = graph.diagnostics("plant", lambda values: values["refused commands"] == "0")
    assert counters
    assert excite.wait() == 0


def test_an_overdue_duty_is_left_out_not_sent_late(graph, start):
    excite = start("excite", *parameters(kind="staircase", levels=100, duration=4.0, duty_max=0.99))
    with graph.listening(Float64, DUTY_COMMAND) as sent:
        graph.until(lambda: len(sent) > 20, "its duty")
        excite.send(signal.SIGSTOP)
        time.sleep(1.0)
        excite.send(signal.SIGCONT)
        seen = len(sent)
        graph.until(lambda: len(sent) > seen + 2, "more")
        jump = np.abs(np.diff([message.data for message in sent])).max()
        graph.until(lambda: excite.popen.poll() is not None, "its end")
    assert jump > 0.2
    assert excite.wait() == 0


BAD = {
    "kind": ("sweep", "one of latin_hypercube"),
    "duration": (-1.0, "give 0.01 to 3600 s"),
    "duty_max": (1.5, "give -1 to 1"),
    "duty_min": (0.9, "duty_min < duty_max"),
    "hold_min": (5.0, "hold_min <= hold_max"),
    "levels": (2.5, "whole number"),
    "sequence": ("[0.1, 2.0]", "sequence"),
    "frequencies": ("[300.0]", "Hz"),
    "durration": (3.0, "did you mean duration?"),
}


@pytest.mark.promise("Commands", "An input that cannot be used ends a command with one line and exit code 2")
def test_bad_parameters_end_in_one_line_and_exit_code_2(start):
    cases = list(BAD.items())
    for at in range(0, len(cases), 3):
        batch = [(start("excite", *parameters(**{name: value})), text) for name, (value, text) in cases[at : at + 3]]
        for process, text in batch:
            assert process.wait() == 2
            (line,) = process.output.splitlines()
            assert line.startswith("excite: ")
            assert text in line


def test_help_names_parameters_and_examples(start):
    excite = start("excite", "--help")
    assert excite.wait() == 0
    for text in ("usage: excite", "duration", "frequencies", *KINDS):
        assert text in excite.output
