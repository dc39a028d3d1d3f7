# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from aeropend_ident.estimation.map_fit import covariance_of, fit
from aeropend_ident.estimation.parameter import Parameter
from aeropend_ident.estimation.screening import screen
from aeropend_ident.signals.statistics import effective_sample_size

RNG = np.random.default_rng(7)
T = np.linspace(0.0, 10.0, 2000)


def line(noise, slope=2.0, offset=0.5, bend=0.0):
    y = offset + slope * T + bend * T**2 + noise

    def residuals(values):
        return {"y": y - values["offset"] - values["slope"] * T - values.get("bend", 0.0) * T**2}

    return residuals


SLOPE = Parameter("slope", 2.1, 1.0)
OFFSET = Parameter("offset", 0.0, 1.0)
BEND = Parameter("bend", 0.0, 1.0)


def test_white_noise_counts_in_full_and_coloured_noise_by_its_correlation_time():
    white = RNG.standard_normal(20_000)
    assert effective_sample_size(white) == pytest.approx(20_000, rel=0.1)
    coloured = np.zeros(200_000)
    for k in range(1, len(coloured)):
        coloured[k] = 0.95 * coloured[k - 1] + RNG.standard_normal()
    assert effective_sample_size(coloured) == pytest.approx(200_000 * 0.05 / 1.95, rel=0.2)


@pytest.mark.promise("Verdict", "Estimates lie within their 95 % intervals")
def test_estimates_lie_within_their_intervals():
    inside = 0
    for seed in range(200):
        noise = np.random.default_rng(seed).standard_normal(len(T))
        found = fit(line(noise), [SLOPE, OFFSET])
        inside += abs(found.values["slope"] - 2.0) < 1.96 * found.sd["slope"]
    assert 180 <= inside <= 199  # 95 %, binomial


def test_the_right_structure_has_the_higher_evidence_and_the_wrong_one_does_not_run_to_absurd_numbers():
    noise = RNG.standard_normal(len(T))
    data = line(noise, bend=0.3)
    known = Parameter("slope", 2.0, 0.1)
    without, with_ = fit(data, [known, OFFSET]), fit(data, [known, OFFSET, BEND])
    ess = with_.ess
    assert with_.log_evidence(ess) - without.log_evidence(ess) > 40.0
    assert with_.values["bend"] == pytest.approx(0.3, abs=3 * with_.sd["bend"])
    assert abs(without.values["slope"] - 2.0) < 0.3  # three prior standard deviations; the data alone would say 5


def test_an_addition_that_explains_nothing_lowers_the_evidence():
    data = line(RNG.standard_normal(len(T)))
    without, with_ = fit(data, [SLOPE, OFFSET]), fit(data, [SLOPE, OFFSET, BEND])
    assert with_.log_evidence(with_.ess) < without.log_evidence(with_.ess)


def test_two_hypotheses_that_fit_alike_have_the_same_evidence_wherever_their_searches_began():
    wave = np.sin(3.0 * T)
    y = 40.0 * wave + RNG.standard_normal(len(T))
    fits = [fit(lambda values: {"y": y - values["size"] * wave}, [Parameter("size", 0.0, 1e4, start=start)], rounds=1)
            for start in (39.9, -300.0)]
    assert fits[1].ess["y"] == pytest.approx(fits[0].ess["y"], rel=0.05)
    found = [f.log_evidence(fits[0].ess) for f in fits]  # far away the residual was coloured, and counted for less
    assert found[1] == pytest.approx(found[0], abs=0.01)
    assert fits[0].log_occam({"y": 2000.0}) == pytest.approx(
        -0.5 * (40.0 / 1e4) ** 2 - 0.5 * np.log(1.0 + 1e8 * np.sum(wave**2) / fits[0].scale["y"] ** 2), abs=0.05)


def test_bounds_hold_and_logarithms_stay_positive():
    data = line(RNG.standard_normal(len(T)), slope=2.0)
    found = fit(data, [Parameter("slope", 1.0, 0.5, 0.1, 1.5), OFFSET])
    assert found.values["slope"] == pytest.approx(1.5)
    found = fit(data, [Parameter("slope", 0.5, 1.0, 1e-3, 100.0, log=True), OFFSET])
    assert abs(found.values["slope"] - 2.0) < 3.0 * found.sd["slope"] < 0.1


def test_screening_ranks_by_what_would_be_left():
    data = line(0.1 * RNG.standard_normal(len(T)), bend=0.3)
    known = [Parameter("slope", 2.0, 0.1), OFFSET]
    base = fit(data, known)
    useless = Parameter("nothing", 0.0, 1.0, start=1.0)
    left = screen(data, base, known, [(Parameter("bend", 0.0, 1.0, start=0.1),), (useless,)])
    assert left[0].left < 0.2
    assert left[1].left == 1.0
    assert left[0].values["bend"] == pytest.approx(0.3, abs=0.01)
    assert left[0].values["slope"] == pytest.approx(2.0, abs=0.1)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("beyond", [1e300, np.inf, np.nan])
def test_a_simulation_that_diverges_is_a_bad_fit_and_no_error(beyond):
    plain = line(RNG.standard_normal(len(T)))

    def residuals(values):
        y = plain(values)["y"]
        return {"y": np.where(T > 9.0, beyond, y) if values["slope"] > 2.5 or values["bend"] > 0.1 else y}

    found = fit(residuals, [Parameter("slope", 2.4, 1.0), OFFSET, BEND])
    assert found.values["slope"] == pytest.approx(2.0, abs=5.0 * found.sd["slope"])
    far = Parameter("bend", 1.0, 1.0)
    assert screen(residuals, fit(residuals, [SLOPE, OFFSET, BEND]), [SLOPE, OFFSET, BEND], [[far]])


@pytest.mark.filterwarnings("error")
def test_a_parameter_that_is_extrapolated_far_is_beyond_its_bounds():
    assert Parameter("delay", 1.0, 1.0, 0.1, 10.0, log=True).value(1e4) == np.inf


def test_a_covariance_has_variances_above_0_however_near_to_singular_its_information_is():
    good = np.array([[4.0, 1.0], [1.0, 1e12]])
    assert covariance_of(good) == pytest.approx(np.linalg.inv(good))
    near = np.outer(x := np.array([1.0, 1e7, 3e-4]), x) + np.eye(3) * 1e-9
    near[0, 1] = near[1, 0] = near[0, 1] * (1.0 + 1e-9)
    assert (np.diag(np.linalg.inv(near)) < 0.0).any()
    assert (np.diag(covariance_of(near)) > 0.0).all()


def test_a_size_is_surer_while_the_phase_with_which_it_trades_is_held():
    """Over a small angle a sine is nearly a straight line: amplitude and phase make the same slope together."""
    x, noise = np.linspace(-0.2, 0.2, len(T)), 0.003 * np.random.default_rng(5).standard_normal(len(T))
    y = 0.05 * np.sin(x + 0.8) + noise
    amplitude, offset = Parameter("amplitude", 0.04, 0.1, low=0.0), Parameter("offset", 0.0, 0.05)
    phase = Parameter("phase", 0.5, 1.0)

    def residuals(values):
        return {"y": (y - values["offset"] - values["amplitude"] * np.sin(x + values.get("phase", 0.8))) / 0.003}

    both = fit(residuals, [amplitude, phase, offset])
    held = fit(lambda values: residuals({**values, "phase": both.values["phase"]}), [amplitude, offset])
    assert both.sd_given("amplitude", ["phase"]) == pytest.approx(held.sd["amplitude"], rel=0.02)
    assert both.sd["amplitude"] > 3.0 * held.sd["amplitude"]
    assert both.sd_given("amplitude", []) == pytest.approx(both.sd["amplitude"])
