# SPDX-License-Identifier: Apache-2.0
"""Exported models step as ours, whatever effects they hold."""

import ctypes
import hashlib
import re
import subprocess
import sys
import types
import xml.etree.ElementTree as ET
import zipfile

import numpy as np
import pytest

from aeropend_sim.export import command, fmu, plant_step, rigid_body, targets
from aeropend_sim.export.specialise import fields
from aeropend_sim.model import dynamics, effect_file
from aeropend_sim.model.effects import CATALOGUE, DEFINED
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model, load, save
from aeropend_sim.model.rig import Rig
from aeropend_sim.model.state import State

STEPS_AS_OURS = pytest.mark.promise(
    "Other simulators",
    "An exported Python module, C file or FMU steps as our simulation, to 1e-9, with every effect, form and formula")
BENCH = load("bench")
DUTY = np.repeat(np.random.default_rng(4).uniform(0.0, 0.8, 12), 60)
DUTY[:40] = 0.0
OWN = effect_file.define({
    "learned": {"place": "arm", "term": "-table(theta, a, ya, b, yb, c, yc)", "parameters": {
        name: {"unit": "rad" if len(name) == 1 else "rad/s^2", "default": x, "low": -9, "high": 9, "neutral": 0}
        for name, x in {"ya": 0.1, "a": -0.2, "b": 0.3, "yb": 0.7, "c": 0.9, "yc": -0.4}.items()}},
    "bent_reading": {"place": "sensing", "reading": "theta",
                     "term": "k * theta_dot * clip(theta / w, -1, step(t - s))",
                     "parameters": {"k": {"unit": "s", "default": 0.01, "low": 0, "high": 1},
                                    "w": {"unit": "rad", "default": 0.5, "low": 0.1, "high": 1},
                                    "s": {"unit": "s", "default": 0.2, "low": 0, "high": 1}}},
    "bent_voltage": {"place": "sensing", "reading": "v_a", "term": "k * max(v, w) * sign(v - w)", "parameters": {
        "k": {"unit": "-", "default": 0.02, "low": 0, "high": 1},
        "w": {"unit": "V", "default": 0.5, "low": 0, "high": 9}}},
}, "test")


def with_effects(*ids: str, model: Model = BENCH, **more: dict[str, float]) -> Model:
    """A model with effects of default size; `more` gives parameters."""
    effects = {id_: {name: p.default for name, p in DEFINED[id_].parameters.items()} | more.get(id_, {})
               for id_ in (*ids, *more)}
    return model.with_effects(effects)


FAST = Model("fast", {**BENCH.model, "J_m": 2e-6, "mgd_over_J": 400.0}, BENCH.sensing)
MODELS = {
    "nominal": BENCH,
    "several steps a sample, v_full, reverse": Model("full", FAST.model | {"v_full": 9, "reverse": 0.5}, FAST.sensing),
    "every effect of the catalogue": with_effects(*CATALOGUE),
    "a duty late by part of a sample": with_effects(command_delay={"delay": 2.4 * SAMPLE_PERIOD}),
    "other forms, memories": with_effects(
        "bridge_drop_resistive", "supply_sag_capacitor", "brush_drop_algebraic", "rotor_friction_stribeck",
        "thrust_lag_speed", "ground_effect_cheeseman", "coulomb_friction_uneven", "coulomb_friction_dahl",
        "current_gain_bent", "brush_drop"),
    "effects by formula": with_effects("learned", "bent_reading", "bent_voltage", "gust"),
}


class Ours:
    """Our own simulation without chance in its readings; the kicks of the gust are kept."""

    def __init__(self, model: Model, duty: np.ndarray) -> None:
        smooth = dict.fromkeys(model.sensing, 0.0) | {"angle_filter_tau": model.sensing["angle_filter_tau"]}
        rig = Rig(Model(model.name, model.model, smooth, model.effects))
        rig._state = State()
        self.noise = np.random.default_rng(1).standard_normal(len(duty))
        rig._kicks = types.SimpleNamespace(standard_normal=lambda _: self.noise)
        read, truth = rig.run(duty)
        row = dynamics.ROW
        self.rows = np.array([truth[row.theta], truth[row.theta_dot], truth[row.omega], truth[row.i_a], truth[row.v_a],
                              truth[row.thrust], read[0], read[2], read[3]])

    def misfit(self, other: np.ndarray) -> float:
        """The largest difference of any output over its largest value."""
        assert other.shape == self.rows.shape
        assert np.isfinite(other).all()
        return float((np.abs(other - self.rows).max(axis=1) / np.abs(self.rows).max(axis=1)).max())


@pytest.fixture(scope="module", params=list(MODELS))
def case(request):
    model = MODELS[request.param]
    return model, Ours(model, DUTY)


def module(text: str) -> types.ModuleType:
    found = types.ModuleType("exported_" + hashlib.sha256(text.encode()).hexdigest()[:8])
    sys.modules[found.__name__] = found
    exec(compile(text, "exported.py", "exec"), vars(found))
    return found


@STEPS_AS_OURS
def test_the_python_module_steps_as_ours(case):
    model, ours = case
    rig = module(targets.python_module(model)).Model()
    out = np.array([rig.step(float(duty), kick) for duty, kick in zip(DUTY, ours.noise, strict=True)]).T
    assert ours.misfit(out) < 1e-9


RUN = """#include "aeropend_model.h"
void run(long n, const double *duty, const double *noise, Outputs *out)
{
    aeropend model;
    aeropend_begin(&model, 0.0);
    for (long k = 0; k < n; k++) {
        out[k] = aeropend_read(&model, duty[k]);
        aeropend_advance(&model, duty[k], noise[k]);
    }
}
"""


@STEPS_AS_OURS
def test_the_c_file_steps_as_ours_and_compiles_without_a_warning(case, tmp_path):
    model, ours = case
    for name, text in {**targets.c_files(model), "run.c": RUN}.items():
        (tmp_path / name).write_text(text)
    command = ["gcc", "-std=c99", "-pedantic", "-Wall", "-O1", "-shared", "-fPIC", "aeropend_model.c", "run.c",
               "-o", "run.so", "-lm"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    out = np.empty((len(DUTY), len(ours.rows)))
    pointers = [ctypes.c_void_p(a.ctypes.data) for a in (DUTY, ours.noise, out)]
    ctypes.CDLL(str(tmp_path / "run.so")).run(ctypes.c_long(len(DUTY)), *pointers)
    assert ours.misfit(out.T) < 1e-9


@STEPS_AS_OURS
def test_the_fmu_is_valid_and_steps_as_ours(tmp_path):
    from fmpy import read_model_description, simulate_fmu
    from fmpy.validation import validate_fmu

    model = MODELS["every effect of the catalogue"]
    ours, path = Ours(model, DUTY), tmp_path / "model.fmu"
    assert fmu.write(model, path)
    assert validate_fmu(str(path)) == []
    names = [v.name for v in read_model_description(str(path)).modelVariables if v.causality == "output"]
    t = SAMPLE_PERIOD * np.arange(len(DUTY))
    signals = np.array(list(zip(t, DUTY, ours.noise)), [("time", float), ("duty", float), ("noise", float)])
    found = simulate_fmu(str(path), stop_time=t[-1], step_size=SAMPLE_PERIOD, output_interval=SAMPLE_PERIOD,
                         input=signals, output=names)
    assert names == list(fields(plant_step.Outputs))
    assert ours.misfit(np.array([found[name] for name in names])) < 1e-9


def test_the_fmu_keeps_states_and_refuses_what_it_has_not(tmp_path):
    from fmpy import extract, read_model_description
    from fmpy.fmi1 import FMICallException
    from fmpy.fmi3 import FMU3Slave

    path = tmp_path / "model.fmu"
    fmu.write(BENCH, path)
    description = read_model_description(str(path))
    slave = FMU3Slave(guid=description.instantiationToken, unzipDirectory=extract(str(path), str(tmp_path / "out")),
                      modelIdentifier=targets.MODULE, instanceName="one")
    slave.instantiate()
    slave.setFloat64([3], [0.4])
    slave.enterInitializationMode(startTime=1.0)
    slave.exitInitializationMode()
    assert slave.getFloat64([10]) == [0.4]
    slave.setFloat64([1], [0.3])
    slave.doStep(1.0, 0.5)  # many samples at once
    kept = slave.getFMUState()
    slave.doStep(1.5, 0.3)
    once = slave.getFloat64([10, 12])
    assert once != [0.4, 0.0]
    slave.setFMUState(kept)
    slave.doStep(1.5, 0.3)
    assert slave.getFloat64([10, 12]) == once
    slave.freeFMUState(kept)
    with pytest.raises(FMICallException):
        slave.getFloat64([99])
    slave.freeInstance()


def test_a_start_angle_is_that_of_a_rig_let_go():
    rig = module(targets.python_module(BENCH)).Model(theta=0.5)
    out = np.array([rig.step(0.0) for _ in range(200)])
    free = dynamics.simulate(BENCH, np.zeros(200), state=State(theta=0.5))
    assert np.allclose(out[:, 0], free.theta, atol=1e-12)
    assert out[0, 6] == 0.5


@pytest.mark.promise("Other simulators", "No text of a model file becomes code of an exported file")
def test_no_text_of_a_model_file_becomes_code(tmp_path):
    bad = '"""\\n*/ int y; /* -->'
    definition = {"place": "arm", "physics": bad, "term": "-k * pow", "parameters": {
        "k": {"unit": "1/s^2", "default": 2, "low": 0, "high": 9}},
        "memory": {"name": "pow", "unit": "rad", "rate": "(theta - pow) / (1e-2 * sqrt(s * s))"}}
    definition["parameters"]["s"] = {"unit": "s", "default": 5, "low": 1, "high": 9}
    effect_file.define({"evil": definition}, "test")
    try:
        model = with_effects("evil")
        model = Model(bad, model.model, model.sensing, model.effects)
        ours = Ours(model, DUTY)
        rig = module(targets.python_module(model)).Model()
        assert ours.misfit(np.array([rig.step(float(duty)) for duty in DUTY]).T) < 1e-9
        for name, text in targets.c_files(model).items():
            (tmp_path / name).write_text(text)
        line = ["gcc", "-std=c99", "-Wall", "-Werror", "-fsyntax-only", "aeropend_model.c"]
        assert subprocess.run(line, cwd=tmp_path, check=False).returncode == 0
        assert "int y" not in re.sub(r"/\*.*?\*/", "", (tmp_path / "aeropend_model.c").read_text(), flags=re.DOTALL)
        for text in (rigid_body.mjcf(model), rigid_body.urdf(model), rigid_body.sdf(model)):
            ET.fromstring(text)
    finally:
        effect_file.forget("evil")


def test_what_a_target_cannot_hold_is_said_in_its_files_and_on_the_screen(tmp_path, capsys):
    model = with_effects("speed_spikes", "quadratic_drag", "cable_torque", command_delay={"delay": -1e-3})
    save(model, tmp_path / "rig.yaml")
    for target, names in {"c": ("sensor noise", "speed_spikes", "command_delay"),
                          "urdf": ("motor", "quadratic_drag", "cable_torque", "gravity"),
                          "sdf": ("motor", "quadratic_drag"), "mjcf": ("quadratic_drag", "speed_spikes")}.items():
        assert command.main([str(tmp_path / "rig.yaml"), "--to", target, "--out", str(tmp_path / target)]) == 0
        told = [line for line in capsys.readouterr().out.splitlines() if line.startswith("not in it: ")]
        written = " ".join(path.read_text() for path in (tmp_path / target).iterdir())
        for name in names:
            assert any(name in line for line in told), (target, name)
            assert name in written
    assert "cable_torque" not in "".join(map(str, rigid_body.missing(model, "sdf")))


def test_files_are_not_overwritten_unasked(tmp_path, capsys):
    line = ["bench", "--to", "urdf", "--out", str(tmp_path)]
    assert [command.main([*line, *more]) for more in ([], [], ["--overwrite"])] == [0, 2, 0]
    assert capsys.readouterr().err == (f"export: {tmp_path / 'aeropendulum.urdf'} exists: name another folder with "
                                       "--out, or give --overwrite\n")


def test_without_a_compiler_the_fmu_has_its_sources(tmp_path, monkeypatch):
    monkeypatch.setattr(fmu, "compiler", lambda: None)
    paths, missing = command.write(BENCH, "fmu", tmp_path)
    assert any("no C compiler" in line for line in missing)
    with zipfile.ZipFile(paths[0]) as archive:
        names = archive.namelist()
    assert "sources/buildDescription.xml" in names
    assert not [name for name in names if name.startswith("binaries/")]


def test_one_model_makes_one_fmu(tmp_path):
    for name in ("a", "b"):
        fmu.write(BENCH, tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
