# SPDX-License-Identifier: Apache-2.0
"""The diagnosis document: what is written comes back to the byte, and what is no document is refused in one line."""

import copy
import json
import subprocess
import sys
from functools import cache

import numpy as np
import pytest

from aeropend_ident.bags.recording import Recording
from aeropend_ident.diagnosis import document
from aeropend_ident.diagnosis.diagnosis import diagnose
from aeropend_ident.diagnosis.document import Across, DocumentError, from_json, to_json
from aeropend_ident.diagnosis.results import document as document_of
from aeropend_ident.signals.from_bag import from_uncalibrated
from aeropend_ident.testing.rigs import BENCH, recorded
from aeropend_sim.model import dynamics
from aeropend_sim.model.parameters import Model
from aeropend_sim.model.state import State


def free_decay(first, rate=20.0, every=5):
    """Readings of the angle of an arm that is let go and left alone for 8 s."""
    model = Model("arm", {**BENCH.model, "mgd_over_J": 40.0, "c_over_J": 0.4}, BENCH.sensing, {})
    n = round(8.0 * rate) * every + 1
    swung = dynamics.swing(model, np.zeros(n), State(theta=first), 1.0 / rate / every)[0]
    theta = swung[::every] + 1e-3 * np.random.default_rng(1).standard_normal(n // every + 1)
    stamps = np.rint(np.arange(len(theta)) * 1e9 / rate).astype(np.int64)
    nothing, no_time = np.full(len(theta), np.nan), np.empty(0, np.int64)
    read = Recording(path="bag", namespace="/", stamp_ns=stamps, received_ns=stamps, t=stamps / 1e9, theta=theta,
                     omega=nothing, i_a=nothing, v_a=nothing, duty=nothing, channels=("theta",), period=1.0 / rate,
                     gaps=np.empty((0, 2), np.int64), duplicates=0, command_ns=no_time, command=np.empty(0),
                     reference_ns=no_time, reference=np.empty(0), truth=None, complete=True, notes=())
    return from_uncalibrated(read, BENCH.sensing)


@cache
def calibrated():
    found = diagnose(BENCH, [recorded(11, {"coulomb_friction": {}}, duration=16.0)])
    across = Across("tuesday", 0.5, 0.1, 0.01, None, None, None)
    return document_of(found, ["monday"], "bench", 1.234, [across])


def uncalibrated():
    found = diagnose(BENCH, [free_decay(1.0), free_decay(0.8)], fit_nominal=True)
    return document_of(found, ["one", "two"], "bench", 2.0)


def unusual():
    """Every optional key, and values that are seldom there."""
    made = to_json(calibrated())
    interval = {"value": 1.0, "low": -0.5, "high": 2}
    row = {"nominal": 1.0, **interval, "determined": True, "runs": [interval, interval], "run_to_run": 0.25}
    which = {**made["which"], "verdict": "unknown", "effects": [], "numbers": {"R_a": row}, "unexplained": ["why"],
             "unknown": {"place": "arm", "curves": [{"variable": "t", "unit": "V", "at": [0.0, 1], "value": [1, 2.5]}]},
             "not_separable": [["gust", "mast_flex"]],
             "next_experiment": {"why": "so", "excite": {"kind": "steps", "seed": 3, "on": True, "duration": 60.0,
                                                         "sequence": [0.0, 0.4, 1]}}}
    identified = {"from": "the angle and the command", "not_determined": ["R_a"],
                  "lift": {"duty": [0.0, 1.0], "rad_per_s2": [0.0, 9.5], "dead_zone": 0.1, "lag_s": 0.2},
                  "hangs_at": {**interval, "runs": [interval], "run_to_run": 0.0},
                  "own": {"command_delay.delay": interval}}
    order = list(made)
    order.insert(order.index("shrink") + 1, "identified")
    made |= {"which": which, "identified": identified}
    return from_json({key: made[key] for key in order})


@pytest.fixture(scope="module", params=[calibrated, uncalibrated, unusual])
def made(request):
    return request.param()


def test_a_document_comes_back_as_it_was(made):
    text = json.dumps(to_json(made), allow_nan=False)
    again = from_json(json.loads(text))
    assert again == made
    assert json.dumps(to_json(again)) == text


def test_optional_keys_are_there_only_where_they_have_a_value():
    body = to_json(calibrated())
    assert list(body) == ["format", "bags", "model", "duration_s", "samples", "train_s", "held_out_s", "channels",
                          "where", "which", "shrink", "estimates", "notes", "seconds"]
    assert list(body["shrink"])[-2:] == ["across", "budget"]
    assert next(iter(body["shrink"]["across"][0])) == "bag"
    assert all(list(row) == ["nominal", "value", "low", "high"] for row in body["which"]["numbers"].values())
    assert body["which"]["unknown"] is None


def test_keys_of_later_versions_are_ignored():
    body = to_json(calibrated())
    assert from_json({**body, "colour": "blue", "where": {**body["where"], "map": []}}) == from_json(body)


def fits(schema, data, definitions):
    """Whether data fits a schema, as far as the schema of a document goes."""
    if "$ref" in schema:
        return fits(definitions[schema["$ref"].removeprefix("#/$defs/")], data, definitions)
    if "anyOf" in schema:
        return any(fits(s, data, definitions) for s in schema["anyOf"])
    if schema["type"] == "array":
        return (isinstance(data, list) and schema.get("minItems", 0) <= len(data) <= schema.get("maxItems", len(data))
                and all(fits(schema["items"], x, definitions) for x in data))
    if schema["type"] == "object":
        known, others = schema.get("properties", {}), schema.get("additionalProperties")
        return (isinstance(data, dict) and set(schema.get("required", [])) <= set(data)
                and all(fits(known[k], x, definitions) for k, x in data.items() if k in known)
                and (others is None or all(fits(others, x, definitions) for x in data.values())))
    kinds = {"string": str, "integer": int, "number": (int, float), "boolean": bool, "null": type(None)}
    return isinstance(data, kinds[schema["type"]])


def test_the_schema_describes_the_document(made):
    schema = document.schema()
    body = to_json(made)
    assert fits(schema, body, schema["$defs"])
    assert set(body) <= set(schema["properties"])
    assert all(p.get("description") for d in (schema, *schema["$defs"].values()) for p in d["properties"].values())
    del body["where"]["regions"]
    assert not fits(schema, body, schema["$defs"])


def test_the_schema_is_printed():
    printed = subprocess.run([sys.executable, "-m", "aeropend_ident.diagnosis.document"], capture_output=True,
                             text=True, check=True)
    assert json.loads(printed.stdout) == document.schema()


def without(*path):
    def change(body):
        for key in path[:-1]:
            body = body[key]
        del body[path[-1]]
    return change


def put(value, *path):
    def change(body):
        for key in path[:-1]:
            body = body[key]
        body[path[-1]] = value
    return change


@pytest.mark.parametrize(("change", "message"), [
    (without("format"), "no diagnosis document: it has no format number"),
    (put("1", "format"), "no diagnosis document: it has no format number"),
    (put(2, "format"), "diagnosis document of format 2, this version reads format 1: update aeropend_ident"),
    (put(0, "format"), "format 0, this version reads format 1: diagnose the recording again"),
    (without("shrink", "gap_after"), "shrink.gap_after is missing"),
    (put("much", "shrink", "gap"), "shrink.gap must be a number, not 'much'"),
    (put(True, "samples"), "samples must be an integer, not True"),
    (put(7, "bags"), "bags must be a list, not 7"),
    (put([0.0], "train_s"), r"train_s must be a list of 2 values, not \[0.0\]"),
    (put([], "where"), r"where must be an object, not \[\]"),
    (put("likely", "which", "candidates", 0, "probability"),
     r"which.candidates\[0\].probability must be a number, not 'likely'"),
    (put({"place": 1, "curves": []}, "which", "unknown"), "which.unknown.place must be a string, not 1"),
    (put({"why": "", "excite": {"kind": None}}, "which", "next_experiment"), "excite.kind must be a list, not None"),
    (put("\x1b[31m\n" * 99, "seconds"), r"seconds must be a number, not '.x1b\[31m"),
])
def test_what_is_no_document_is_refused_in_one_line(change, message):
    body = copy.deepcopy(to_json(calibrated()))
    change(body)
    with pytest.raises(DocumentError, match=message) as raised:
        from_json(body)
    assert "\n" not in str(raised.value)
    assert len(str(raised.value)) < 200


@pytest.mark.parametrize("body", [None, [], "text", 1.0, {}])
def test_other_json_is_refused(body):
    with pytest.raises(DocumentError, match=r"^no diagnosis document: it has no format number"):
        from_json(body)


@pytest.mark.parametrize(("content", "message"), [
    (b"{", "is no JSON"), (b"\xff\xfe", "is no JSON"), (b"[" * 100_000, "is no JSON"), (b"{}", "no diagnosis document"),
    (None, "cannot be read: No such file"),
])
def test_a_file_that_is_no_document_is_named(tmp_path, content, message):
    path = tmp_path / "diagnosis.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DocumentError, match=message) as raised:
        document.read(path)
    assert str(raised.value).startswith(f"{path}: ")


def test_a_file_is_read(tmp_path, made):
    (tmp_path / "diagnosis.json").write_text(json.dumps(to_json(made)))
    assert document.read(tmp_path / "diagnosis.json") == made
