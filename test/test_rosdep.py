# SPDX-License-Identifier: Apache-2.0
"""On a ROS 2 install rosdep brings what the packages import: asked of the real rosdep, with the entries it reads."""

import ast
import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

ROOT = Path(__file__).parents[1]
ENTRIES = Path(__file__).parent / "rosdep"
PACKAGES = sorted(path.parent for path in ROOT.glob("src/*/package.xml"))
OTHERWISE = {"compression": "comes with Python 3.14", "lz4": "rosbags brings it", "backports": "rosbags brings it",
             "llvmlite": "numba brings it", "threadpoolctl": "the README asks for it",
             "pysindy": "the README asks for it"}
WITHOUT = {"matplotlib", "distributed", "h5py", "mujoco"}
"""Used where they are installed; what needs them says so where they are not."""
MODULES = {"jinja2": "python3-jinja2", "serial": "python3-serial", "cobs": "python-cobs-pip",
           "rosbags": "python3-rosbags-pip"}


def rosdep(home: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run rosdep with no entries but ours."""
    sources = home / "sources"
    sources.mkdir(exist_ok=True)
    (sources / "20-default.list").write_text(f"yaml {(ENTRIES / 'keys.yaml').as_uri()}\n")
    environment = os.environ | {"ROS_HOME": str(home), "ROSDEP_SOURCE_PATH": str(sources),
                                "ROSDISTRO_INDEX_URL": (ENTRIES / "index.yaml").as_uri()}
    return subprocess.run([Path(sys.executable).parent / "rosdep", *arguments], env=environment, capture_output=True,
                          text=True, check=False)


def dependencies(package: Path) -> set[str]:
    """Names that its package.xml says it runs with."""
    return {str(entry.text) for entry in ElementTree.parse(package / "package.xml").getroot().findall("exec_depend")}


def imports(package: Path) -> set[str]:
    """Top-level modules that its code imports, Python's own left out."""
    found = set()
    for file in (package / package.name).rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                found |= {name.name.split(".")[0] for name in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                found.add(node.module.split(".")[0])
    return found - sys.stdlib_module_names - {package.name}


@pytest.mark.promise("Packages", "`rosdep` installs what the packages need on ROS 2 Jazzy")
def test_rosdep_knows_all_that_the_packages_need(tmp_path):
    update = rosdep(tmp_path, "update", "--rosdistro", "jazzy")
    assert update.returncode == 0, update.stderr
    done = rosdep(tmp_path, "install", "--from-paths", str(ROOT / "src"), "--ignore-src", "--simulate", "--reinstall",
                  "--rosdistro", "jazzy", "--os", "ubuntu:noble")
    assert done.returncode == 0, done.stdout + done.stderr
    installed = {line.split()[-1] for line in done.stdout.splitlines() if " install " in line}
    assert {"ros-jazzy-rclpy", "ros-jazzy-sensor-msgs", "python3-scipy", "rosbags", "cobs"} <= installed


def test_it_would_tell_of_a_key_that_it_does_not_know(tmp_path):
    (tmp_path / "src").mkdir()
    text = (ROOT / "src/aeropend_bridge/package.xml").read_text()
    (tmp_path / "src/package.xml").write_text(text.replace("python3-serial", "python3-cereal"))
    rosdep(tmp_path, "update", "--rosdistro", "jazzy")
    done = rosdep(tmp_path, "install", "--from-paths", str(tmp_path / "src"), "--simulate", "--rosdistro", "jazzy",
                  "--os", "ubuntu:noble")
    assert done.returncode != 0
    assert "python3-cereal" in done.stdout + done.stderr


@pytest.mark.promise("Packages", "`rosdep` installs what the packages need on ROS 2 Jazzy")
@pytest.mark.parametrize("package", PACKAGES, ids=lambda path: path.name)
def test_what_a_package_imports_is_in_its_package_xml(package):
    named = dependencies(package)
    for module in imports(package) - OTHERWISE.keys() - WITHOUT:
        assert named & {module, MODULES.get(module, f"python3-{module}")}, f"{package.name} imports {module}"


def test_each_entry_is_needed():
    asked = {str(entry.text) for package in PACKAGES for entry in ElementTree.parse(package / "package.xml").iter()
             if entry.tag.endswith("depend")}
    assert set(yaml.safe_load((ENTRIES / "keys.yaml").read_text())) <= asked
