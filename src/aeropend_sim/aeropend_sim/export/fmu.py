# SPDX-License-Identifier: Apache-2.0
"""A model as a Functional Mock-up Unit: FMI 3.0, co-simulation (https://fmi-standard.org/docs/3.0.2)."""

from __future__ import annotations

import hashlib
import platform
import shutil
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
import zipfile
from importlib.resources import files
from pathlib import Path

from aeropend_sim.errors import UserError
from aeropend_sim.export.targets import MEANINGS, MODULE, UNITS, c_files, described
from aeropend_sim.model.parameters import SAMPLE_PERIOD, Model

GLUE = "fmi3.c"
FIRST_OUTPUT = 10
"""Value reference of the first output. A choice."""

_OLDEST = (1980, 1, 1, 0, 0, 0)
"""Time of each file in the archive, so that one model makes one file."""

_BASE = {"rad": {"rad": 1}, "rad/s": {"rad": 1, "s": -1}, "A": {"A": 1}, "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
         "N": {"kg": 1, "m": 1, "s": -2}, "s": {"s": 1}}
"""Units of the variables in base units of FMI."""


def description(model: Model, period: float, token: str) -> str:
    """The file modelDescription.xml.

    Args:
        model: parameters and effects.
        period: [s] time between samples.
        token: that tells this FMU from others.
    """
    root = ET.Element("fmiModelDescription", fmiVersion="3.0", modelName="aeropendulum", instantiationToken=token,
                      description=" ".join(described(model)), generationTool="aeropend", license="Apache-2.0",
                      variableNamingConvention="flat")
    ET.SubElement(root, "CoSimulation", modelIdentifier=MODULE, canHandleVariableCommunicationStepSize="true",
                  fixedInternalStepSize=repr(period), canGetAndSetFMUState="true", canSerializeFMUState="true")
    units = ET.SubElement(root, "UnitDefinitions")
    for unit, base in _BASE.items():
        one = ET.SubElement(units, "Unit", name=unit)
        ET.SubElement(one, "BaseUnit", {name: str(power) for name, power in base.items()})
    log = ET.SubElement(root, "LogCategories")
    ET.SubElement(log, "Category", name="logStatusError")
    ET.SubElement(root, "DefaultExperiment", startTime="0.0", stopTime="10.0", stepSize=repr(period))
    variables = ET.SubElement(root, "ModelVariables")

    def variable(name: str, reference: int, causality: str, unit: str = "", text: str = "", **more: str) -> None:
        given = {"name": name, "valueReference": str(reference), "causality": causality, **more}
        if text:
            given["description"] = text
        if unit:
            given["unit"] = unit
        ET.SubElement(variables, "Float64", given)

    variable("time", 0, "independent", "s", "simulation time", variability="continuous")
    variable("duty", 1, "input", "", "duty of the motor, 0 to 1", variability="discrete", start="0.0")
    variable("noise", 2, "input", "", "a standard normal number for each sample, for the effect gust",
             variability="discrete", start="0.0")
    variable("theta_start", 3, "parameter", "rad", "angle of the arm at the start", variability="fixed", start="0.0")
    for k, name in enumerate(UNITS):
        variable(name, FIRST_OUTPUT + k, "output", UNITS[name], MEANINGS[name], variability="discrete")
    structure = ET.SubElement(root, "ModelStructure")
    for kind in ("Output", "InitialUnknown"):
        for k in range(len(UNITS)):
            ET.SubElement(structure, kind, valueReference=str(FIRST_OUTPUT + k))
    ET.indent(root)
    return _document(root)


def build_description(macros: dict[str, str]) -> str:
    """The file sources/buildDescription.xml: how another platform compiles the sources."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=MODULE)
    sources = ET.SubElement(configuration, "SourceFileSet", language="C99")
    for name in (f"{MODULE}.c", GLUE):
        ET.SubElement(sources, "SourceFile", name=name)
    for name, value in macros.items():
        ET.SubElement(sources, "PreprocessorDefinition", name=name, value=value)
    ET.indent(root)
    return _document(root)


def _document(root: ET.Element) -> str:
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def platform_name() -> str:
    """The platform as FMI names it, such as x86_64-linux."""
    machine = platform.machine().lower()
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(machine, machine)
    return f"{machine}-{ {'linux': 'linux', 'darwin': 'darwin', 'win32': 'windows'}.get(sys.platform, sys.platform) }"


def compiler() -> str | None:
    """The C compiler of this machine; None without any."""
    return next((found for name in ("cc", "gcc", "clang") if (found := shutil.which(name))), None)


def write(model: Model, path: Path, period: float = SAMPLE_PERIOD) -> bool:
    """Write an FMU.

    Args:
        model: parameters and effects.
        path: the file.
        period: [s] time between samples.

    Returns:
        Whether it holds a compiled library; without a C compiler it has the sources alone.

    Raises:
        UserError: the compiler fails.
    """
    sources = c_files(model, period)
    sources[GLUE] = (files("aeropend_sim") / "export" / GLUE).read_text(encoding="utf-8")
    token = "{" + hashlib.sha256("".join(sources.values()).encode()).hexdigest()[:32] + "}"
    parts: dict[str, bytes] = {"modelDescription.xml": description(model, period, token).encode()}
    parts |= {f"sources/{name}": text.encode() for name, text in sources.items()}
    parts["sources/buildDescription.xml"] = build_description(_macros(token)).encode()
    if (found := compiler()) is not None:
        ending = {"darwin": "dylib", "win32": "dll"}.get(sys.platform, "so")
        parts[f"binaries/{platform_name()}/{MODULE}.{ending}"] = _compiled(found, sources, token)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in parts.items():
            info = zipfile.ZipInfo(name, _OLDEST)
            info.compress_type, info.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(info, data)
    return found is not None


def _macros(token: str) -> dict[str, str]:
    """What fmi3.c takes from here."""
    return {"AEROPEND_TOKEN": f'"{token}"', "AEROPEND_FIRST_OUTPUT": str(FIRST_OUTPUT)}


def _compiled(compiler: str, sources: dict[str, str], token: str) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        for name, text in sources.items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        macros = [f"-D{name}={value}" for name, value in _macros(token).items()]
        command = [compiler, "-std=c99", "-O2", "-fPIC", "-shared", "-fvisibility=hidden", *macros, f"{MODULE}.c", GLUE,
                   "-o", "library", "-lm"]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        if done.returncode:
            raise UserError(f"{compiler} cannot compile the FMU: {' '.join(done.stderr.split())[:300]}")
        return (Path(folder) / "library").read_bytes()
