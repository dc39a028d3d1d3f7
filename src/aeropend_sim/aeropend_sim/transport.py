# SPDX-License-Identifier: Apache-2.0
"""How messages travel: by UDP, on one machine too.

Fast DDS has shared memory as well. There, whoever starts can stop all that others publish for 333 ms, which costs the
plant 114 samples (https://github.com/eProsima/Fast-DDS/issues/6535), and whoever is killed can leave a lock on which
the next to start waits for ever (https://github.com/eProsima/Fast-DDS/issues/1144).
"""

import os
from collections.abc import MutableMapping
from pathlib import Path

from rclpy.utilities import get_rmw_implementation_identifier

LOCALHOST = Path(__file__).parent / "config" / "localhost.xml"
"""Profile of Fast DDS for this machine only: rmw_fastrtps has no LOCALHOST without shared memory."""
RANGE, PROFILES, TRANSPORTS = (
    "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS"
)  # fmt: skip
UDP = "UDPv4"
OTHERS = ("FASTDDS_DEFAULT_PROFILES_FILE", "ROS_LOCALHOST_ONLY")


def without_shared_memory(environment: MutableMapping[str, str] = os.environ) -> None:
    """Let this process, and those it starts, talk by UDP alone; to be called before `rclpy.init`.

    Who is found stays as it was (`ROS_AUTOMATIC_DISCOVERY_RANGE`, `ROS_STATIC_PEERS`), and who has shared memory is
    talked to by UDP. Nothing is changed for somebody who chose a profile or transports, or another middleware.

    Args:
        environment: is changed.
    """
    ours = str(LOCALHOST)
    if (
        get_rmw_implementation_identifier() != "rmw_fastrtps_cpp"
        or environment.get(PROFILES, ours) != ours
        or environment.get(TRANSPORTS, UDP) != UDP
        or any(environment.get(name) for name in OTHERS)
    ):
        return
    if environment.get(RANGE) != "LOCALHOST":
        if PROFILES not in environment:
            environment[TRANSPORTS] = UDP
    elif LOCALHOST.is_file():  # without it, SUBNET would be what it says
        environment[PROFILES], environment[RANGE] = ours, "SUBNET"
        environment.pop(TRANSPORTS, None)
