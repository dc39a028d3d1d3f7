# SPDX-License-Identifier: Apache-2.0
import csv
import io
import math
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from rich.console import Console

from aeropend_control.analysis import step_report
from aeropend_control.analysis.step_response import StepError, StepResponse
from aeropend_control.laws.registry import LAWS

GOOD = StepResponse(0.0, 0.4, 0.0, 0.4, 0.3, 0.7, 1.1, 0.04, 0.001)


def test_missing_samples_and_readings_are_filled_by_straight_lines():
    t = np.array([0.0, 1.0, 2.0, 5.0])
    grid, columns, lost = step_report.on_grid(t, {"a": [0.0, 10.0, np.nan, 50.0], "b": [np.nan] * 4}, 1.0)
    assert grid.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert columns["a"].tolist() == [0.0, 10.0, 20.0, 30.0, 40.0, 50.0]
    assert np.isnan(columns["b"]).all()
    assert lost == 2


def test_a_stamp_that_is_far_off_is_refused_and_not_filled_up():
    with pytest.raises(StepError, match="999999999990 samples are missing beside 10: a stamp must be wrong"):
        step_report.on_grid([*range(9), 1e12 - 1], {"a": np.zeros(10)}, 1.0)


@pytest.mark.parametrize("law", LAWS)
def test_a_good_step_keeps_every_limit(law):
    fast = GOOD._replace(rise_time=0.1, settling_time=0.5)
    assert step_report.missed(fast, step_report.limits(law)) == []


@pytest.mark.promise("Control", "The requirements of Table 6.1 are met on `bench`, and what is missed is named")
@pytest.mark.parametrize(("name", "value"), [
    ("rise_time", 0.51), ("rise_time", math.nan), ("peak_time", 0.91), ("settling_time", 3.7),
    ("settling_time", math.nan), ("overshoot", 0.21), ("steady_state_error", 0.0088), ("steady_state_error", -0.0088),
])
def test_what_is_missed_is_named(name, value):
    assert step_report.missed(GOOD._replace(**{name: value}), step_report.ANGLE) == [name]


def test_without_a_peak_none_is_late():
    assert step_report.missed(GOOD._replace(peak_time=math.nan, overshoot=0.0), step_report.ANGLE) == []


def test_the_cascade_behind_feedback_linearization_must_do_better():
    late = GOOD._replace(settling_time=1.3, overshoot=0.06)
    assert step_report.missed(late, step_report.limits("feedback_linearization")) == []
    cascade = step_report.limits("feedback_linearization_cascade")
    assert step_report.missed(late, cascade) == ["settling_time", "overshoot"]


def test_the_table_marks_what_is_missed():
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(step_report.table({"small_signal": [GOOD, GOOD._replace(overshoot=0.25)]}))
    lines = [line for line in console.export_text().splitlines() if "0.4 rad" in line]
    assert "4.0" in lines[0]
    assert lines[0].rstrip().endswith("✓")
    assert "25.0 ✗" in lines[1]
    assert lines[1].rstrip().endswith("✗")


def test_the_csv_reads_back(tmp_path):
    path = tmp_path / "steps.csv"
    columns = {"time": np.array([0.0, 0.00204]), "theta": np.array([0.1, np.nan])}
    step_report.write_csv(path, columns)
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0] == ["time (s)", "theta (rad)"]
    assert np.array(rows[1:], dtype=float) == pytest.approx(np.array([[0.0, 0.1], [0.00204, np.nan]]), nan_ok=True)


def test_the_drawing_holds_response_reference_and_duty():
    t = 0.01 * np.arange(500)
    y = 0.4 * (1.0 - np.exp(-t))
    y[100] = np.nan
    root = ET.fromstring(step_report.draw(t, np.full(500, 0.4), y, np.full(500, 0.3), "a < b", "rad"))
    lines = root.findall("{http://www.w3.org/2000/svg}polyline")
    assert len(lines) == 3
    points = [np.array([pair.split(",") for pair in line.attrib["points"].split()], dtype=float) for line in lines]
    assert [len(one) for one in points] == [500, 499, 500]
    assert np.ptp(points[0][:, 1]) == 0.0
    assert (np.diff(points[1][:, 1]) <= 0.0).all()  # upwards on the page
    assert all(one[:, 0].min() >= 70.0 and one[:, 0].max() <= 870.0 for one in points)
    assert "a < b" in "".join(root.itertext())


def test_a_single_sample_is_no_step_response():
    with pytest.raises(StepError, match="a single sample shows no step response"):
        step_report.on_grid([1.0], {"theta": [0.2]}, float("nan"))
