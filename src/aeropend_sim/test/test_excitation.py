# SPDX-License-Identifier: Apache-2.0
from itertools import pairwise

import numpy as np
import pytest

from aeropend_sim.model.dynamics import simulate
from aeropend_sim.model.excitation import KINDS, Excitation
from aeropend_sim.model.parameters import SAMPLE_PERIOD, load


def holds(series):
    """(duty, samples) of each stretch of equal duty."""
    starts = np.append(np.flatnonzero(np.diff(series, prepend=np.nan)), len(series))
    return [(series[start], end - start) for start, end in pairwise(starts)]


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_fills_the_duration_within_the_duty_range(kind):
    series = Excitation(kind=kind, duration=20.0).series()
    assert series.shape == (round(20.0 / SAMPLE_PERIOD),)
    assert series.min() >= 0.0
    assert series.max() <= 0.6


@pytest.mark.parametrize("kind", ["latin_hypercube", "multisine"])
def test_the_seed_decides(kind):
    one, same, other = (Excitation(kind=kind, duration=15.0, seed=seed).series() for seed in (1, 1, 2))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)


def test_latin_hypercube_uses_each_interval_of_duty_and_time_once():
    x = Excitation(duration=200.0, duty_min=0.1, duty_max=0.6, hold_min=0.5, hold_max=2.5, rest=4.0, seed=7)
    stretches = holds(x.series())
    rests = [at for at, (duty, _) in enumerate(stretches) if duty == 0.0]
    assert rests[:3] == [10, 21, 32]
    for first in (0, 11, 22):
        duties, samples = np.array(stretches[first : first + 10]).T
        assert sorted(np.floor((duties - 0.1) / 0.05).astype(int)) == list(range(10))
        seconds = samples * SAMPLE_PERIOD
        edge = SAMPLE_PERIOD / 0.2  # a hold is rounded to samples
        for k, share in enumerate(np.sort((seconds - 0.5) / 0.2)):
            assert k - edge <= share <= k + 1 + edge
    assert stretches[10][1] * SAMPLE_PERIOD == pytest.approx(4.0, abs=SAMPLE_PERIOD)
    assert stretches[0][0] != stretches[11][0]


def test_latin_hypercube_without_rest():
    assert len(holds(Excitation(duration=60.0, rest=0.0, duty_min=0.1).series())) > 50


def test_steps_repeat_the_sequence():
    series = Excitation(kind="steps", duration=10.0, hold_max=2.0, sequence=(0.1, 0.5, 0.3)).series()
    assert [duty for duty, _ in holds(series)] == [0.1, 0.5, 0.3, 0.1, 0.5]
    assert {samples for _, samples in holds(series)[:-1]} <= {980, 981}


def test_staircase_goes_up_and_down_in_equal_stairs():
    stairs = holds(Excitation(kind="staircase", duration=18.0, duty_min=0.2, duty_max=0.6, levels=5).series())
    assert [duty for duty, _ in stairs] == pytest.approx([0.2, 0.3, 0.4, 0.5, 0.6, 0.5, 0.4, 0.3, 0.2])
    assert max(samples for _, samples in stairs) - min(samples for _, samples in stairs) <= 1


def test_multisine_has_equal_lines_at_its_frequencies_and_nothing_else():
    duration = 2000 * SAMPLE_PERIOD
    frequencies = tuple(k / duration for k in (1, 3, 7, 20))
    series = Excitation(
        kind="multisine", duration=duration, duty_min=0.1, duty_max=0.5, frequencies=frequencies
    ).series()
    assert (series.min(), series.max()) == pytest.approx((0.1, 0.5))
    lines = np.abs(np.fft.rfft(series))[1:]
    strong = {1, 3, 7, 20}
    assert {int(k) + 1 for k in np.argsort(lines)[-4:]} == strong
    assert np.ptp(np.sort(lines)[-4:]) < 1e-9 * lines.max()
    assert np.sort(lines)[-5] < 1e-9 * lines.max()


def test_free_decay_lifts_and_lets_go():
    stretches = holds(Excitation(kind="free_decay", duration=25.0, duty=0.4, hold_max=2.0, rest=8.0).series())
    assert [duty for duty, _ in stretches] == [0.4, 0.0, 0.4, 0.0, 0.4, 0.0]
    assert stretches[1][1] * SAMPLE_PERIOD == pytest.approx(8.0, abs=SAMPLE_PERIOD)


def test_hold_holds():
    assert holds(Excitation(kind="hold", duty=0.33, duration=5.0).series()) == [(0.33, round(5.0 / SAMPLE_PERIOD))]


@pytest.mark.parametrize("seed", range(10))
def test_the_default_signal_moves_the_bench_rig_widely_and_safely(seed):
    state = simulate(load("bench"), Excitation(seed=seed).series())
    assert 0.6 < np.abs(state.theta).max() < 1.2
    assert state.theta.std() > 0.15
    assert state.omega.max() > 150.0
    assert state.omega.std() > 40.0


@pytest.mark.parametrize(
    ("fields", "names"),
    [
        ({"kind": "sweep"}, "latin_hypercube"),
        ({"duration": 0.0}, "duration"),
        ({"duration": 1e12}, "duration .* at most 3600"),
        ({"kind": "free_decay", "rest": float("inf")}, "rest is inf: give a number"),
        ({"hold_max": float("nan")}, "hold_max is nan: give a number"),
        ({"duty_min": 0.5, "duty_max": 0.4}, "duty_min"),
        ({"duty_max": 1.1}, "duty_max"),
        ({"hold_min": 3.0}, "hold_max"),
        ({"hold_min": 0.0}, "hold_min"),
        ({"levels": 1}, "levels is 1: give 2 to 1000"),
        ({"levels": 10**9}, "levels is 1000000000: give 2 to 1000"),
        ({"seed": -1}, "seed is -1: give 0 to 2147483647"),
        ({"rest": -1.0}, "rest"),
        ({"duty": 2.0}, "duty"),
        ({"sequence": ()}, "sequence"),
        ({"sequence": (0.1, 1.5)}, "sequence"),
        ({"frequencies": ()}, "frequencies"),
        ({"frequencies": (1.0, 300.0)}, "frequencies"),
    ],
)
def test_fields_that_make_no_sense_are_named(fields, names):
    with pytest.raises(ValueError, match=names) as error:
        Excitation(**fields)
    assert "\n" not in str(error.value)
