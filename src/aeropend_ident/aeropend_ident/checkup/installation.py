# SPDX-License-Identifier: Apache-2.0
"""The check-up of the installation: packages, ROS, serial ports, the cache of compiled code, the disk."""

from __future__ import annotations

import os
import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import metadata, util
from pathlib import Path

from aeropend_ident.checkup.check import Check, error, ok, warning
from aeropend_sim.wording import counted

PACKAGES = ("aeropend_sim", "aeropend_ident", "aeropend_control", "aeropend_bridge")
"""Our packages."""

PINNED = re.compile(r"([\w.-]+)(?:\[[^]]*\])?==([^\s;#]+)(?:; python_version (<|>=) \"3\.(\d+)\")?")
"""A line of requirements.txt: package, version, and the Python versions that it is for."""

RANGES = ("LOCALHOST", "SUBNET", "OFF", "SYSTEM_DEFAULT")
"""Values of ROS_AUTOMATIC_DISCOVERY_RANGE (interface of ROS 2)."""

MOST_DOMAIN, USUAL_DOMAIN = 232, 101
"""Largest ROS_DOMAIN_ID, and the largest whose ports Linux gives to no other program (interface of ROS 2)."""

FULL, LOW = 100e6, 2e9
"""[bytes] Free disk below which nothing can be recorded, and below which a long recording may not fit.

Choice: a rig fills about 0.5 GB in an hour."""


def checks(folder: Path, environment: Mapping[str, str] = os.environ) -> Iterator[Check]:
    """All findings.

    Args:
        folder: in which results would be written.
        environment: of the process.
    """
    yield from packages(requirements())
    yield from ros(environment)
    yield from serial_ports(sorted([*Path("/dev").glob("ttyACM*"), *Path("/dev").glob("ttyUSB*")]))
    yield compiler_cache(_cache_folder)
    yield disk(folder, shutil.disk_usage(folder).free)


def requirements() -> str:
    """The text of requirements.txt of the source tree that is installed; "" if there is none."""
    found = util.find_spec("aeropend_ident")
    origin = Path(found.origin).resolve() if found and found.origin else Path()
    path = origin.parents[3] / "requirements.txt" if len(origin.parents) > 3 else Path()
    return path.read_text(encoding="utf-8") if path.is_file() else ""


def packages(pinned: str) -> Iterator[Check]:
    """Python, our packages, and what they need.

    Args:
        pinned: text of a requirements.txt.
    """
    ours = [name for name in PACKAGES if util.find_spec(name) is None]
    if ours:
        yield error("packages", f"{', '.join(ours)} cannot be found: install all four packages under src/")
    wrong, missing, right = [], [], 0
    for name, version, sign, minor in PINNED.findall(pinned):
        if minor and (sys.version_info[1] < int(minor)) != (sign == "<"):
            continue
        try:
            there = metadata.version(name)
        except metadata.PackageNotFoundError:
            missing.append(name)
            continue
        right += there == version
        if there != version:
            wrong.append(f"{name} is {there}, tested with {version}")
    if missing:
        yield error("packages", f"{', '.join(missing)} cannot be found: pip install -r requirements.txt")
    if wrong:
        yield warning("packages", f"{'; '.join(wrong)}: pip install -r requirements.txt")
    if not (ours or missing or wrong):
        tested = f", {counted(right, 'package')} of the tested versions" if right else ""
        yield ok("packages", f"Python {platform.python_version()}{tested}")


def ros(environment: Mapping[str, str]) -> Iterator[Check]:
    """ROS 2: the client library, the domain, and how far messages reach.

    Args:
        environment: of the process.
    """
    found = util.find_spec("rclpy")
    if found is None:
        yield warning("ROS 2", "rclpy cannot be found: no node can run (plant, record, bridge); pip install -r "
                      "requirements.txt, or source a ROS 2 Jazzy; import and diagnose need none")
        return
    sourced = environment.get("AMENT_PREFIX_PATH", "")
    if sourced and not any(str(found.origin).startswith(place) for place in sourced.split(":")):
        yield warning("ROS 2", f"a shell has sourced {sourced.split(':')[0]}, but rclpy is that of "
                      f"{Path(str(found.origin)).parents[1]}: use a shell that has sourced nothing")
    distribution = environment.get("ROS_DISTRO", "jazzy")
    if distribution != "jazzy":
        yield warning("ROS 2", f"ROS_DISTRO is {distribution}, tested with jazzy: messages may differ")
    domain = environment.get("ROS_DOMAIN_ID", "0") or "0"
    if not domain.isdigit() or int(domain) > MOST_DOMAIN:
        yield error("ROS domain", f"ROS_DOMAIN_ID is {domain!r}: give a number from 0 to {USUAL_DOMAIN}")
    elif int(domain) > USUAL_DOMAIN:
        yield warning("ROS domain", f"ROS_DOMAIN_ID is {domain}: another program may have its ports; give 0 to "
                      f"{USUAL_DOMAIN}")
    reach = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or "SUBNET"
    if reach not in RANGES:
        yield error("ROS discovery", f"ROS_AUTOMATIC_DISCOVERY_RANGE is {reach!r}: give {' or '.join(RANGES)}")
    elif reach in ("SUBNET", "SYSTEM_DEFAULT"):
        yield warning("ROS discovery", "every machine of this network can command the rig: export "
                      "ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST if that is not wanted")
    else:
        yield ok("ROS discovery", f"domain {domain}, range {reach}")


def serial_ports(ports: Sequence[Path]) -> Iterator[Check]:
    """Whether boards can be reached.

    Args:
        ports: the serial ports of this machine.
    """
    if not ports:
        yield ok("serial port", "no board is connected")
    for port in ports:
        if os.access(port, os.R_OK | os.W_OK):
            yield ok("serial port", f"{port} can be opened")
        else:
            yield error("serial port", f"{port} may not be opened: sudo usermod -aG dialout $USER, then log in "
                        "again")


def compiler_cache(folder: Callable[[], str]) -> Check:
    """Whether compiled functions are kept for the next start.

    Args:
        folder: gives the folder of the cache; a RuntimeError if there is none.
    """
    try:
        place = folder()
        Path(place).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=place):
            return ok("compiler cache", place)
    except (OSError, RuntimeError):
        return warning("compiler cache", "it cannot be written, so every start compiles for a minute: export "
                       "NUMBA_CACHE_DIR=a folder that can be written")


def _cache_folder() -> str:
    """The folder in which numba keeps the compiled dynamics."""
    from aeropend_sim.model import dynamics

    folder: str = vars(dynamics.run)["_cache"].cache_path
    return folder


def disk(folder: Path, free: float) -> Check:
    """Whether there is room for recordings.

    Args:
        folder: in which they would be written.
        free: [bytes] there.
    """
    room = f"{free / 1e9:.1f} GB free in {folder.resolve()}"
    if free < FULL:
        return error("disk", f"{room}: make room before you record")
    return warning("disk", f"{room}: an hour of a rig needs 0.5 GB") if free < LOW else ok("disk", room)
