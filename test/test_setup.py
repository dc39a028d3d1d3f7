# SPDX-License-Identifier: Apache-2.0
"""A clone sets itself up: what is missing is installed, and said; a ROS 2 install is not asked for."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
APT = '#!/bin/sh\necho "$@" >> "$(dirname "$0")/asked"\n'
SUDO = '#!/bin/sh\nexec "$@"\n'


@pytest.fixture
def setup(tmp_path):
    """tools/setup on a machine that has little: what it printed, its exit code, and what apt-get was asked for."""
    def run(what: str, *programs: str, **environment: str) -> tuple[str, int, str]:
        for name in ("bash", "dirname", "env", "uname", "sh"):
            (tmp_path / name).symlink_to(shutil.which(name))
        for name, text in (("id", "#!/bin/sh\necho 1000\n"), ("sudo", SUDO), ("apt-get", APT)):
            if name in ("id", *programs):
                (tmp_path / name).write_text(text)
                (tmp_path / name).chmod(0o755)
        done = subprocess.run([ROOT / "tools" / "setup", what], env={"PATH": str(tmp_path), **environment},
                              capture_output=True, text=True, check=False)
        asked = tmp_path / "asked"
        return done.stdout + done.stderr, done.returncode, asked.read_text() if asked.exists() else ""
    return run


@pytest.mark.promise("Start", "`make demo` sets itself up in a clone, and says what it installs and why")
@pytest.mark.parametrize(("what", "why", "package"), [
    ("compiler", "there is no working C compiler", "gcc"),
    ("firmware", "the board's program and its emulator are built from source", "gcc-avr"),
    ("test", "flash the board's program", "avrdude"),
    ("test", "press TAB in zsh", "zsh")])
def test_what_is_missing_is_installed_and_said(setup, what, why, package):
    said, code, asked = setup(what, "sudo", "apt-get")
    assert code == 0, said
    assert re.search(rf"^setup: .*{why}.*: installing .* {package}\b.* with sudo apt-get$", said, re.MULTILINE)
    assert re.search(rf"^-qq install -y .* {package}\b", asked, re.MULTILINE)


@pytest.mark.promise("Start", "`make demo` sets itself up in a clone, and says what it installs and why")
@pytest.mark.parametrize(("program", "message"), [
    ("sudo", "there is no apt-get here to install gcc libc6-dev: install it and run this again"),
    ("apt-get", "there is no sudo here: run 'apt-get install gcc libc6-dev' as root, then this again")])
def test_where_nothing_can_be_installed_one_line_says_what_to_do(setup, program, message):
    said, code, asked = setup("compiler", program)
    assert (code, asked) == (2, "")
    assert said.endswith(f"{message}\n")
    assert said.count("\n") == 1


def test_a_python_that_is_not_there_is_named(setup):
    said, code, _ = setup("runtime", PYTHON="python9")
    assert (code, said.count("\n")) == (2, 1)
    assert "there is no 'python9' here: install Python 3.10 or newer" in said


@pytest.mark.promise("Start", "No ROS 2 installation is needed")
def test_rclpy_is_that_of_the_environment_and_needs_no_ros_install():
    code = "import rclpy; rclpy.init(); print(open('/proc/self/maps').read())"
    clean = {name: os.environ[name] for name in ("PATH", "HOME")}
    done = subprocess.run([sys.executable, "-c", code], env=clean, capture_output=True, text=True, check=True)
    ours = set(re.findall(r"\S*/lib(?:rcl|rmw_fastrtps|fastrtps|fastdds)\S*\.so\S*", done.stdout))
    assert ours
    assert [path for path in ours if not Path(path).is_relative_to(sys.prefix)] == []
