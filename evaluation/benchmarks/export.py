# SPDX-License-Identifier: Apache-2.0
"""Speed of exported models beside our own simulation."""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from shutil import which

import numpy as np
from numpy.typing import NDArray

from aeropend_sim.export import fmu, targets
from aeropend_sim.export.plant_step import Outputs
from aeropend_sim.model import dynamics, sensing
from aeropend_sim.model.parameters import Model, load
from evaluation.benchmarks import measure
from evaluation.benchmarks.measure import Figure, NotMeasuredError, Spread, Target, interleaved
from evaluation.benchmarks.simulation import PEERS, duty, pointer

Array = NDArray[np.float64]


def speed(quick: bool) -> list[Figure]:
    """70 s of an exported model, C and FMU, beside our simulation of plant and angle."""
    effects = {"quadratic_drag": {"k": 0.6}, "ground_effect": {"gain": 0.25, "width": 0.3}}
    model, about = load("bench").with_effects(effects), measure.load()
    series = duty()

    def ours() -> Array:
        true = dynamics.simulate(model, series)
        return sensing.read_angle(model, true.theta, true.theta_dot)

    with tempfile.TemporaryDirectory() as folder:
        by_c, by_fmu = _exported(model, Path(folder), series)
        if not (np.allclose(by_c()[:, 6], ours(), atol=1e-9) and np.allclose(by_fmu()[:, 6], ours(), atol=1e-9)):
            raise AssertionError("the exported model and ours disagree")
        c_s, fmu_s, ours_s = interleaved(20 if quick else 150, by_c, by_fmu, ours)
    return [Figure(f"exported model, {name}, 70 s", "ms CPU", Spread.of(1e3 * seconds), Target(2.0, "ratio"),
                   "our simulation", Spread.of(1e3 * ours_s), Spread.of(seconds / ours_s),
                   {"samples": len(series), "effects": list(effects)}, load=about, main=True)
            for name, seconds in (("C", c_s), ("FMU", fmu_s))]


def _exported(model: Model, folder: Path, series: Array) -> tuple[Callable[[], Array], Callable[[], Array]]:
    """The runs by C and by FMU.

    Raises:
        NotMeasuredError: there is no compiler.
    """
    if which("gcc") is None:
        raise NotMeasuredError("there is no gcc, which compiles exported C: install gcc (make bench does)")
    for name, text in targets.c_files(model).items():
        (folder / name).write_text(text)
    subprocess.run(["gcc", "-O2", "-shared", "-fPIC", "-I", str(folder), str(PEERS / "exported.c"),
                    f"{targets.MODULE}.c", "-o", "run.so", "-lm"], cwd=folder, check=True)
    fmu.write(model, folder / "model.fmu")
    with zipfile.ZipFile(folder / "model.fmu") as archive:
        archive.extractall(folder)
        token = archive.read("modelDescription.xml").split(b'instantiationToken="')[1].split(b'"')[0]
    run = ctypes.CDLL(str(folder / "run.so"))
    unit = ctypes.CDLL(str(next((folder / "binaries").glob("*/*"))))
    unit.fmi3InstantiateCoSimulation.restype = ctypes.c_void_p
    functions = [ctypes.cast(getattr(unit, f"fmi3{name}"), ctypes.c_void_p)
                 for name in ("SetFloat64", "GetFloat64", "DoStep")]
    out = np.empty((len(series), len(Outputs._fields)))
    n = ctypes.c_long(len(series))

    def by_c() -> Array:
        run.by_c(n, pointer(series), pointer(out))
        return out

    def by_fmu() -> Array:
        instance = ctypes.c_void_p(unit.fmi3InstantiateCoSimulation(
            b"one", token, None, False, False, False, False, None, ctypes.c_size_t(0), None, None, None))
        run.by_fmu(n, pointer(series), pointer(out), instance, *functions, ctypes.c_uint32(fmu.FIRST_OUTPUT))
        unit.fmi3FreeInstance(instance)
        return out

    return by_c, by_fmu
