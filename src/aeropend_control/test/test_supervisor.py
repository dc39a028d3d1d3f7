# SPDX-License-Identifier: Apache-2.0
import math

import pytest

from aeropend_control.nodes.supervisor import Supervisor
from aeropend_sim.model.parameters import SAMPLE_PERIOD
from aeropend_sim.model.rig import Sample

PERIOD_NS = round(SAMPLE_PERIOD * 1e9)


class Counting:
    """Its duty is a hundredth of the samples since its start."""

    def __init__(self):
        self.resets = 0
        self.output = None
        self.reset()

    def reset(self, sample=None, duty=0.0):
        self.resets += 1
        self.since = duty
        self.samples = []

    def step(self, sample, reference):
        self.samples.append(sample)
        return len(self.samples) / 100 if self.output is None else self.output

    def retune(self, gains):
        pass


class Loop:
    """A supervisor with its law, and samples at the sample rate."""

    def __init__(self, **changes):
        self.law = Counting()
        limits = {"angle_limit": 1.0, "low": 0.0, "high": 0.8, **changes}
        self.supervisor = Supervisor(self.law, **limits)
        self.at = 0

    def sample(self, theta=0.1, omega=50.0, after=1):
        self.at += after
        return self.supervisor.step(10**18 + self.at * PERIOD_NS, Sample(theta, omega, 0.1, 0.5))

    def samples(self, count, **reading):
        return [self.sample(**reading) for _ in range(count)]


@pytest.fixture
def loop():
    loop = Loop()
    assert loop.supervisor.set_reference(0.4)
    return loop


def test_the_duty_is_0_until_there_is_a_reference():
    loop = Loop()
    assert loop.samples(5) == [0.0] * 5
    assert "no reference" in loop.supervisor.fault
    assert loop.law.samples == []
    loop.supervisor.set_reference(0.4)
    assert loop.samples(3) == [0.01, 0.02, 0.03]
    assert loop.supervisor.fault == ""


@pytest.mark.parametrize("reference", [math.nan, math.inf, -math.inf, -0.01, 0.81])
def test_a_reference_out_of_range_is_refused_and_the_one_before_stays(loop, reference):
    loop.sample()
    assert not loop.supervisor.set_reference(reference)
    assert loop.supervisor.reference == 0.4
    assert "give 0 to 0.8 rad" in loop.supervisor.refusal
    assert loop.supervisor.counts["refused"] == 1
    assert loop.sample() == 0.02
    assert loop.supervisor.set_reference(0.8)
    assert loop.supervisor.refusal == ""


@pytest.mark.parametrize("duty", [math.nan, math.inf])
def test_a_law_without_a_duty_gives_0_and_starts_anew(loop, duty):
    loop.samples(3)
    loop.law.output = duty
    assert loop.sample() == 0.0
    assert "the law" in loop.supervisor.fault
    loop.law.output = None
    assert loop.sample() == 0.01


@pytest.mark.parametrize("omega", [math.inf, -math.inf, 1e300, -1e7])
def test_a_reading_that_is_no_possible_number_is_a_missing_one_and_said(loop, omega):
    loop.sample()
    assert loop.sample(omega=omega) == 0.02
    assert math.isnan(loop.law.samples[-1].omega)
    assert loop.supervisor.doubt == "omega of a sample is no possible number: left out"
    assert loop.supervisor.counts["impossible"] == 1
    assert loop.sample() == 0.03
    assert loop.supervisor.doubt == ""
    assert loop.sample(theta=omega) == 0.0
    assert loop.sample() == 0.05  # it did not go beyond the angle limit: it was no angle


@pytest.mark.parametrize("duty", [math.inf, 55.0, math.nan])
def test_a_duty_that_is_no_share_was_not_applied(loop, duty):
    loop.supervisor.note_applied(duty)
    loop.sample()
    loop.sample(after=1000)  # a gap: the law starts anew from the duty that was applied
    assert loop.law.since == 0.0


def test_a_duty_is_a_share(loop):
    loop.law.output = 1.7
    assert loop.sample() == 1.0
    loop.law.output = -0.3
    assert loop.sample() == 0.0


def test_a_sample_that_was_there_before_is_left_out(loop):
    loop.samples(3)
    assert loop.sample(after=0) is None
    assert loop.sample(after=-1) is None
    assert loop.supervisor.counts["repeated"] == 2
    assert loop.sample(after=2) == 0.04  # the next one on the grid, nothing lost
    assert loop.supervisor.counts["lost"] == 0


def test_lost_samples_are_told_to_the_law(loop):
    loop.samples(2)
    assert loop.sample(after=4) == 0.06
    assert loop.supervisor.counts["lost"] == 3
    assert [math.isnan(s.theta) for s in loop.law.samples] == [False, False, True, True, True, False]


def test_after_a_long_gap_the_law_starts_anew(loop):
    loop.samples(5)
    assert loop.sample(after=30) == 0.01
    assert loop.supervisor.counts["lost"] == 29
    assert loop.sample(after=-10_000) == 0.01  # a plant that was started again
    assert loop.sample() == 0.02


def test_it_goes_on_from_the_duty_that_the_rig_held_meanwhile(loop):
    loop.samples(20)
    loop.supervisor.note_applied(0.2)
    loop.sample(after=100)
    assert loop.law.since == 0.2


@pytest.mark.promise("Control", "Without samples for 50 ms the duty is 0, and the law restarts with the next sample")
def test_silence_means_duty_0_and_a_new_start(loop):
    loop.samples(5)
    loop.supervisor.on_timeout()
    assert loop.supervisor.duty == 0.0
    assert "no sample for 0.05 s" in loop.supervisor.fault
    assert loop.sample(after=40) == 0.01
    assert loop.supervisor.fault == ""
    assert loop.supervisor.counts["silent"] == 1


def test_nan_means_duty_0_and_the_law_bridges_a_short_one(loop):
    loop.samples(3)
    assert loop.samples(2, theta=math.nan) == [0.0, 0.0]
    assert "theta of a sample is NaN" in loop.supervisor.fault
    assert loop.sample() == 0.06
    assert loop.samples(30, theta=math.nan) == [0.0] * 30
    assert loop.sample() == 0.01  # it restarted
    assert loop.supervisor.counts["unusable"] == 2


def test_only_what_the_law_measures_must_be_there(loop):
    assert loop.sample(omega=math.nan) == 0.01
    speed = Loop(measures=("omega",))
    speed.supervisor.set_reference(0.4)
    assert speed.sample(omega=math.nan) == 0.0
    assert "omega of a sample is NaN" in speed.supervisor.fault
    assert speed.sample(theta=math.nan) == 0.0


@pytest.mark.parametrize("theta", [1.01, -1.01])
def test_beyond_the_limit_the_duty_stays_0_until_the_next_reference(loop, theta):
    loop.samples(5)
    assert loop.sample(theta=theta) == 0.0
    assert "beyond the limit of 1 rad" in loop.supervisor.fault
    assert loop.samples(100) == [0.0] * 100
    assert not loop.supervisor.set_reference(math.nan)
    assert loop.sample() == 0.0
    assert loop.supervisor.set_reference(0.4)
    assert loop.sample() == 0.01
    assert loop.supervisor.counts["angle limit"] == 1


def test_while_the_rig_is_off_the_law_starts_anew_with_each_sample(loop):
    for _ in range(10):
        loop.supervisor.note_applied(loop.supervisor.duty)
        loop.sample()
    for _ in range(40):
        loop.supervisor.note_applied(0.0)
        duty = loop.sample()
        assert duty <= 0.36  # 0.5 in the end, if it wound up
    assert duty == 0.01
    assert "applies duty 0" in loop.supervisor.fault
    loop.law.output = 0.2
    loop.sample()
    loop.supervisor.note_applied(0.2)
    loop.law.output = None
    assert loop.samples(2) == [0.02, 0.03]
    assert loop.supervisor.fault == ""
    assert loop.supervisor.counts["off"] == 1
