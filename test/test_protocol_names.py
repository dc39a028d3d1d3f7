# SPDX-License-Identifier: Apache-2.0
"""Firmware and host call the same things by the same names, with the same values."""

import re
from pathlib import Path

import pytest

from aeropend_bridge import protocol

HEADER = (Path(__file__).parents[1] / "firmware" / "protocol.h").read_text()


def enumerators(name, prefix=""):
    """The constants of an enum of the header, without their prefix."""
    body = re.search(rf"enum {name} \{{(.*?)\}}", HEADER, re.DOTALL)[1]
    return {key.removeprefix(prefix): eval(value) for key, value in re.findall(r"(\w+) = ([^,\n}]+)", body)}


@pytest.mark.parametrize(("name", "prefix", "host"), [
    ("message", "", protocol.Type), ("status", "", protocol.Status), ("scheme", "SCHEME_", protocol.Scheme),
    ("mode", "MODE_", protocol.Mode), ("flag", "FLAG_", protocol.Flag)])
def test_each_name_and_value_of_the_firmware_is_that_of_the_host(name, prefix, host):
    assert enumerators(name, prefix) == {member.name: member.value for member in host}


@pytest.mark.parametrize(("name", "value"), [
    ("BAUD", protocol.BAUD), ("PROTOCOL_VERSION", protocol.VERSION), ("CALIBRATION_SIZE", protocol.CALIBRATION_SIZE)])
def test_each_constant_of_the_firmware_is_that_of_the_host(name, value):
    assert int(re.search(rf"#define {name} (\d+)", HEADER)[1]) == value
