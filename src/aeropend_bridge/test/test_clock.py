# SPDX-License-Identifier: Apache-2.0
"""Board time to host time, on simulated clocks with known truth."""

import numpy as np
import pytest

from aeropend_bridge.clock import MAX_DRIFT, SLEW, BoardClock, Ticks, line_below

TICK = 500
STEP = 4080
PERIOD_NS = STEP * TICK
LATENCY_NS = 900_000


class Rig:
    """A board's clock against the host's, and frames that arrive late by chance.

    `drift` is how much slower the board runs; may change by `aging` per second.
    """

    def __init__(self, rng, drift=0.0, ticks=1000, aging=0.0, late=None):
        self.rng, self.drift, self.aging = rng, drift, aging
        self.ticks, self.host = ticks, 5_000_000_000_000.0
        self.late = late or (lambda rng: rng.exponential(200e3) + (rng.random() < 0.02) * rng.exponential(20e6))

    def frames(self, n):
        """Board time on the wire, true sampling instant, arrival, for n samples."""
        last = 0.0
        for _ in range(n):
            self.ticks = (self.ticks + STEP) % 2**32
            self.host += PERIOD_NS * (1.0 + self.drift)
            self.drift += self.aging * PERIOD_NS * 1e-9
            last = max(last, self.host + LATENCY_NS + self.late(self.rng))  # bytes keep their order
            yield self.ticks, self.host, round(last)


def errors(clock, frames):
    """Stamps minus true instants, ns, of the samples that get stamps; and the stamps."""
    out, stamps = [], []
    for ticks, true, arrival in frames:
        board = clock.extend(ticks)
        clock.add(board, arrival)
        if clock.settled:
            stamps.append(clock.host_ns(board))
            out.append(stamps[-1] - true)
    return np.array(out), np.array(stamps)


@pytest.mark.promise("Hardware", "Stamps are the sampling instants, whatever delays a frame")
@pytest.mark.parametrize("drift", [0.0, 3e-3, -5e-3])
@pytest.mark.parametrize("ticks", [0, 2**32 - 10_000_000])
def test_stamps_are_the_sampling_instants(drift, ticks):
    clock = BoardClock(TICK, LATENCY_NS)
    error, stamps = errors(clock, Rig(np.random.default_rng(1), drift, ticks).frames(490 * 60))
    assert len(error) > 490 * 60 - 250
    assert np.sqrt(np.mean(error**2)) < 100e3
    assert np.sqrt(np.mean(error[490 * 5 :] ** 2)) < 20e3
    assert clock.drift == pytest.approx(drift, abs=5e-6)
    steps = np.diff(stamps)
    assert np.all(np.abs(steps / (PERIOD_NS * (1.0 + drift)) - 1.0) < 1.5 * SLEW)


def test_a_clock_that_warms_up_is_followed():
    clock = BoardClock(TICK, LATENCY_NS)
    error, _ = errors(clock, Rig(np.random.default_rng(2), 1e-3, aging=0.5e-6).frames(490 * 60))
    assert np.sqrt(np.mean(error[490 * 5 :] ** 2)) < 100e3


@pytest.mark.promise("Hardware", "Stamps are the sampling instants, whatever delays a frame")
def test_no_number_of_late_frames_moves_it():
    def late(rng):
        return 0.0 if rng.random() < 0.4 else rng.uniform(0.5e6, 3e6)

    clock = BoardClock(TICK, LATENCY_NS)
    error, _ = errors(clock, Rig(np.random.default_rng(3), 1e-4, late=late).frames(490 * 40))
    assert np.abs(error[490 * 5 :]).max() < 20e3


@pytest.mark.promise("Hardware", "Stamps are the sampling instants, whatever delays a frame")
def test_stalls_of_the_host_do_not_move_it():
    rig = Rig(np.random.default_rng(4), 2e-4)
    frames = list(rig.frames(490 * 30))
    free = 0
    held = []
    for k, (ticks, true, arrival) in enumerate(frames):  # each 5 s the host reads nothing for 300 ms
        if k % 2450 == 2449:
            free = arrival + 300_000_000
        held.append((ticks, true, max(arrival, free)))
    clock = BoardClock(TICK, LATENCY_NS)
    error, _ = errors(clock, held)
    assert np.sqrt(np.mean(error[490:] ** 2)) < 100e3


def test_a_board_whose_clock_stood_still_is_found_again():
    rig = Rig(np.random.default_rng(10), 2e-4)
    clock = BoardClock(TICK, LATENCY_NS)
    errors(clock, rig.frames(3000))
    rig.host += 150e6
    error, stamps = errors(clock, rig.frames(3000))
    assert clock.stops == 1
    assert np.all(np.diff(stamps) > 0)
    assert np.sqrt(np.mean(error[400:] ** 2)) < 100e3


def test_stamps_grow_whatever_arrives():
    rng = np.random.default_rng(5)
    clock = BoardClock(TICK)
    _, stamps = errors(clock, Rig(rng, late=lambda rng: rng.choice([0.0, 80e6, 400e6])).frames(2000))
    clock.restart()
    _, again = errors(clock, Rig(rng).frames(2000))  # a board that was reset, its first frames earlier than it could
    assert np.all(np.diff(np.concatenate([stamps, again])) > 0)


def test_after_a_restart_the_past_is_forgotten():
    clock = BoardClock(TICK, LATENCY_NS)
    rig = Rig(np.random.default_rng(6), 1e-3)
    errors(clock, rig.frames(2000))
    rig.ticks, rig.drift, rig.host = 77, -1e-3, rig.host + 3e9
    clock.restart()
    assert not clock.settled
    error, _ = errors(clock, rig.frames(5000))
    assert np.sqrt(np.mean(error**2)) < 100e3


def test_it_settles_within_half_a_second():
    clock = BoardClock(TICK, LATENCY_NS)
    error, _ = errors(clock, Rig(np.random.default_rng(7), 2e-3).frames(245))
    assert len(error) > 20
    assert np.sqrt(np.mean(error**2)) < 300e3


def test_a_frame_from_the_future_is_told():
    clock = BoardClock(TICK, LATENCY_NS)
    for ticks, _, arrival in Rig(np.random.default_rng(8)).frames(1000):
        board = clock.extend(ticks)
        assert not clock.settled or clock.early_ns(board, arrival) < 1e6
        clock.add(board, arrival)
    assert clock.early_ns(board + 10_000_000_000, arrival) > 9e9


def test_ticks_extend_over_wraps_and_steps_back():
    ticks = Ticks(8)
    assert [ticks.extend(value) for value in (200, 250, 4, 100, 200, 40, 30)] == [200, 250, 260, 356, 456, 552, 542]


def test_line_below():
    assert line_below([(5.0, 3.0)]) == (0.0, 3.0)
    rng = np.random.default_rng(9)
    x = np.sort(rng.uniform(0.0, 100.0, 200))
    y = 0.005 * x - 2.0 + np.where(rng.random(200) < 0.1, 0.0, rng.exponential(5.0, 200))
    slope, offset = line_below(list(zip(x.tolist(), y.tolist())))
    assert slope == pytest.approx(0.005, abs=1e-9)
    assert offset == pytest.approx(-2.0, abs=1e-6)
    assert np.all(y - slope * x - offset > -1e-9)
    steep = line_below([(0.0, 0.0), (1.0, 5.0), (2.0, 10.0)])
    assert steep == (MAX_DRIFT, 0.0)


def test_no_time_before_it_settled():
    with pytest.raises(RuntimeError):
        BoardClock(TICK).host_ns(0)
