# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from aeropend_ident.signals.derivatives import differences, noise_of, smoothed, tv_derivative

PERIOD = 0.002


def signal(n=8000):
    t = np.arange(n) * PERIOD
    return np.sin(2.0 * t) + 0.3 * np.cos(5.0 * t), 2.0 * np.cos(2.0 * t) - 1.5 * np.sin(5.0 * t)


def test_noise_is_told_from_signal():
    x, _ = signal()
    assert noise_of(x + 0.01 * np.random.default_rng(0).standard_normal(len(x))) == pytest.approx(0.01, rel=0.05)


def test_differences_are_of_fourth_order():
    x, rate = signal()
    assert np.abs(differences(x, PERIOD) - rate)[2:-2].max() < 1e-8


@pytest.mark.parametrize(("way", "off"), [(smoothed, 0.04), (tv_derivative, 0.06)])
def test_the_derivative_of_a_noisy_signal(way, off):
    x, rate = signal()
    noisy = x + 0.005 * np.random.default_rng(1).standard_normal(len(x))
    smooth, found = way(noisy, PERIOD)
    assert np.sqrt(np.mean((found - rate) ** 2)) < off * rate.std()
    assert np.sqrt(np.mean((smooth - x) ** 2)) < 0.002
    assert np.sqrt(np.mean((differences(noisy, PERIOD) - rate) ** 2)) > rate.std()


def test_a_corner_stays_sharp_under_total_variation():
    t = np.arange(4000) * PERIOD
    x, rate = np.abs(t - 4.0), np.sign(t - 4.0)
    _, found = tv_derivative(x + 0.01 * np.random.default_rng(2).standard_normal(len(t)), PERIOD)
    off = np.abs(t - 4.0) > 0.1
    assert np.abs(found - rate)[off][50:-50].mean() < 0.03


def test_34000_samples_need_no_dense_matrix():
    x, rate = signal(34_000)
    _, found = tv_derivative(x + 0.005 * np.random.default_rng(3).standard_normal(len(x)), PERIOD)
    assert np.sqrt(np.mean((found - rate) ** 2)) < 0.06 * rate.std()
