# SPDX-License-Identifier: Apache-2.0
"""How messages travel: by UDP, on one machine too; how many may wait; and how soon who starts is found.

Fast DDS has shared memory as well. There, whoever starts can stop all that others publish for 333 ms, which costs the
plant 114 samples (https://github.com/eProsima/Fast-DDS/issues/6535), and whoever is killed can leave a lock on which
the next to start waits for ever (https://github.com/eProsima/Fast-DDS/issues/1144).

What comes while a process stands still waits in its sockets. The usual 208 KiB are full after some 0.2 s at the sample
rate, a publisher keeps 100 messages to send again, and the rest is lost. So our sockets ask for 4 MiB.

Who starts announces itself before it listens. Who is there answers at once, and once only: the answer of a fast one is
missed, and both then wait for its next regular announcement. So these come every second, not every three.
"""

import os
from collections.abc import MutableMapping
from pathlib import Path

from rclpy.utilities import get_rmw_implementation_identifier

CONFIG = Path(__file__).parents[1] / "config"
LOCALHOST = CONFIG / "localhost.xml"
"""Profile of Fast DDS for this machine only: rmw_fastrtps has no LOCALHOST without shared memory."""
SUBNET = CONFIG / "subnet.xml"
"""Profile of Fast DDS for any other range."""
RANGE, PROFILES, TRANSPORTS = (
    "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS"
)  # fmt: skip
UDP = "UDPv4"
OTHERS = ("FASTDDS_DEFAULT_PROFILES_FILE", "ROS_LOCALHOST_ONLY")
FOUND_BY_NAME = ("DEFAULT_FASTRTPS_PROFILES.xml", "DEFAULT_FASTDDS_PROFILES.xml")
"""Profiles that Fast DDS takes from the folder in which a process starts."""


def without_shared_memory(environment: MutableMapping[str, str] = os.environ) -> None:
    """Let this process, and those it starts, talk by UDP alone; to be called before `rclpy.init`.

    Who is found stays as it was (`ROS_AUTOMATIC_DISCOVERY_RANGE`, `ROS_STATIC_PEERS`), and who has shared memory is
    talked to by UDP. Nothing is changed for somebody who chose a profile or transports, or another middleware.

    Args:
        environment: is changed.
    """
    profile = LOCALHOST if environment.get(RANGE) == "LOCALHOST" else SUBNET
    if (
        get_rmw_implementation_identifier() != "rmw_fastrtps_cpp"
        or PROFILES in environment
        or environment.get(TRANSPORTS, UDP) != UDP
        or any(environment.get(name) for name in OTHERS)
        or any(Path(name).is_file() for name in FOUND_BY_NAME)
        or not profile.is_file()  # without it, SUBNET would be what it says
    ):
        return
    environment[PROFILES] = str(profile)
    environment.pop(TRANSPORTS, None)
    if profile is LOCALHOST:
        environment[RANGE] = "SUBNET"
