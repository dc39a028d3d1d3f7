# SPDX-License-Identifier: Apache-2.0
"""Counts to SI, calibration files, and what is measured at rest."""

import math
import random
from dataclasses import replace
from itertools import pairwise

import pytest
import yaml

from aeropend_bridge import calibration
from aeropend_bridge.calibrate import CalibrationError, mean_on_circle, middle, zeros
from aeropend_bridge.calibration import default, load, save
from aeropend_bridge.protocol import Flag, Sample
from aeropend_sim.model.parameters import load as load_model

REST = Sample(0, 0, 0, 0, 0, 0, 0, 0)


def test_the_default_has_the_resolution_that_the_bench_model_says():
    sensing = load_model("bench").sensing
    for flags, scale in ((Flag.SSI, 1.0), (0, 1025 / 1024)):  # at position p the encoder's output is high for p + 1 µs
        rest = default().measured(REST._replace(flags=flags))
        step = default().measured(REST._replace(current=1, voltage=1, angle=1, flags=flags))
        assert step.i_a - rest.i_a == pytest.approx(sensing["current_lsb"])
        assert step.v_a - rest.v_a == pytest.approx(sensing["voltage_lsb"])
        assert step.theta - rest.theta == pytest.approx(sensing["angle_lsb"] * scale)


def test_counts_become_si():
    c = replace(default(), current_zero=2.0, voltage_zero=-3.0, pwm_zero=9.0, ssi_zero=1000.0, pulses_per_rev=2.0)
    m = c.measured(Sample(0, 0, 51, 662, 1004, 397, 40_000, Flag.SSI))
    assert m.i_a == pytest.approx(660 * 2.56 / 1024 / 1.65)
    assert m.v_a == pytest.approx(400 * 2.56 / 512)
    assert m.theta == pytest.approx(4 * 2 * math.pi / 1024)
    assert m.omega == pytest.approx(2 * math.pi / (2 * 0.02))
    assert m.duty == pytest.approx(0.2)
    assert c.measured(REST._replace(period=0)).omega == 0.0


def test_the_angle_goes_on_over_the_wrap_of_the_encoder():
    c = replace(default(), ssi_zero=1020.0)
    theta = [c.measured(REST._replace(angle=angle % 1024, flags=Flag.SSI)).theta for angle in range(1000, 1100)]
    assert [after - before for before, after in pairwise(theta)] == pytest.approx([2 * math.pi / 1024] * 99)
    assert theta[20] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.promise("Hardware", "An angle with an error is not measured")
def test_an_angle_that_came_with_an_error_is_not_measured():
    c = default()
    assert math.isnan(c.measured(REST._replace(flags=Flag.SSI | Flag.SSI_PARITY)).theta)
    assert math.isnan(c.measured(REST._replace(flags=Flag.SSI | Flag.SSI_STATUS)).theta)
    assert not math.isnan(c.measured(REST._replace(flags=Flag.SSI)).theta)


def test_a_saved_file_is_read_back_and_rcl_reads_it_as_floats(tmp_path):
    path = tmp_path / "rig.yaml"
    ours = replace(default(), current_zero=1e-7, voltage_zero=-1.5, latency=1e-5, pulses_per_rev=2.0)
    save(ours, path, "first\nsecond")
    assert load(path) == ours
    assert path.read_text().startswith("# first\n# second\n/**:\n")
    section = yaml.safe_load(path.read_text())["/**"]["ros__parameters"]["calibration"]
    assert all(type(value) is float for value in section.values())


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a: [", "not a parameter file"),
        ("model: 1", "not a calibration"),
        ("/**: {ros__parameters: {model: {R_a: 1.0}}}", "not a calibration"),
        ("/**: {ros__parameters: {calibration: {curent_zero: 1.0}}}", "curent_zero"),
        ("/**: {ros__parameters: {calibration: {current_zero: much}}}", "give a number"),
        ("/**: {ros__parameters: {calibration: {current_zero: 5e3}}}", "out of range"),
    ],
)
def test_bad_files_are_refused_by_name(tmp_path, text, expected):
    path = tmp_path / "rig.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=expected) as error:
        load(path)
    assert "rig.yaml" in str(error.value)
    with pytest.raises(ValueError, match="No such file"):
        load(tmp_path / "missing.yaml")
    with pytest.raises(ValueError, match="cannot be written"):
        save(default(), tmp_path / "missing" / "rig.yaml")


def test_a_file_that_says_little_takes_the_rest_from_the_default(tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text("/**: {ros__parameters: {calibration: {pwm_zero: 511.5}}}")
    assert load(path) == replace(default(), pwm_zero=511.5)


def test_middle_is_not_moved_by_a_converter_that_ends_at_zero():
    rng = random.Random(1)
    for offset in (-2.0, 0.0, 0.7, 5.25, 400.0):
        counts = [max(0, round(rng.gauss(offset, 3.3))) for _ in range(5000)]
        assert middle(counts) == pytest.approx(max(offset, 0.0), abs=0.2)
    assert middle([7] * 10) == 7.0


def test_mean_on_circle():
    assert mean_on_circle([1022, 1023, 0, 1, 2]) == (pytest.approx(0.0), pytest.approx(math.sqrt(2.0)))
    mean, spread = mean_on_circle([1023, 0])
    assert (mean, spread) == (1023.5, 0.5)


def resting(**fields):
    rng = random.Random(2)
    return [
        REST._replace(
            current=max(0, round(rng.gauss(6.0, 3.0))), voltage=round(rng.gauss(-2.0, 1.0)), angle=500 + k % 2
        )._replace(**fields)
        for k in range(500)
    ]


def test_zeros_of_a_rig_at_rest():
    base = replace(default(), current_per_count=0.002)
    found, notes = zeros(base, resting(), resting(angle=1023, flags=Flag.SSI))
    assert notes == []
    assert found.current_zero == pytest.approx(6.0, abs=0.3)
    assert found.voltage_zero == pytest.approx(-2.0, abs=0.2)
    assert (found.pwm_zero, found.ssi_zero) == (500.5, 1023.0)
    assert found.current_per_count == 0.002


@pytest.mark.parametrize(("bad", "why"), [(500, "500 of 500 angles came with errors"),
                                          (0, "scheme ssi gave no sample")])
def test_an_encoder_that_is_not_wired_both_ways_keeps_that_zero_and_says_so(bad, why):
    base = replace(default(), ssi_zero=77.0)
    found, (note,) = zeros(base, resting(), resting(flags=Flag.SSI | Flag.SSI_PARITY)[:bad])
    assert note == f"ssi_zero is not measured: {why}"
    assert found.ssi_zero == 77.0


@pytest.mark.promise("Hardware", "`calibrate` measures the zeros of a rig at rest, and refuses others")
@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        ([], "no samples"),
        (resting(duty=1), "driven"),
        (resting(period=50_000), "turns"),
        ([s._replace(angle=500 + k % 40) for k, s in enumerate(resting())], "moves"),
        ([s._replace(current=k % 200) for k, s in enumerate(resting())], "current reads"),
        ([s._replace(voltage=k % 200) for k, s in enumerate(resting())], "voltage reads"),
        (resting(flags=Flag.SSI | Flag.SSI_STATUS), "magnet"),
    ],
)
def test_a_rig_that_is_not_at_rest_is_refused(wrong, expected):
    with pytest.raises(CalibrationError, match=expected):
        zeros(calibration.default(), wrong, wrong)
