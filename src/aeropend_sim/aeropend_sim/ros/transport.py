# SPDX-License-Identifier: Apache-2.0
"""Transport of the messages: UDP, also on one machine; size of the socket buffers; period of the announcements.

Fast DDS also has shared memory. There, a process that starts can block the publishers of all others for 333 ms, which
costs the plant 114 samples (https://github.com/eProsima/Fast-DDS/issues/6535). A process that is killed can leave a
lock on which the next process waits for ever (https://github.com/eProsima/Fast-DDS/issues/1144).

While a process stands still, messages wait in its sockets. The usual buffer of 208 KiB is full after about 0.2 s at the
sample rate, a publisher keeps 100 messages for repetition, and the others are lost. So the sockets ask for 4 MiB.

A process that starts announces itself before it listens. The others answer at once and only once. A fast answer is
lost, and both sides then wait for the next regular announcement. So the period of announcements is 1 s, not 3 s.
"""

import os
from collections.abc import MutableMapping
from pathlib import Path

from rclpy.utilities import get_rmw_implementation_identifier

CONFIG = Path(__file__).parents[1] / "config"
LOCALHOST = CONFIG / "localhost.xml"
"""Profile of Fast DDS for this machine only. In rmw_fastrtps itself, LOCALHOST means shared memory."""
SUBNET = CONFIG / "subnet.xml"
"""Profile of Fast DDS for all other ranges."""
RANGE, PROFILES, TRANSPORTS = (
    "ROS_AUTOMATIC_DISCOVERY_RANGE", "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS"
)  # fmt: skip
UDP = "UDPv4"
OTHERS = ("FASTDDS_DEFAULT_PROFILES_FILE", "ROS_LOCALHOST_ONLY")
FOUND_BY_NAME = ("DEFAULT_FASTRTPS_PROFILES.xml", "DEFAULT_FASTDDS_PROFILES.xml")
"""Names of profiles that Fast DDS reads from the working directory of a process."""


def without_shared_memory(environment: MutableMapping[str, str] = os.environ) -> None:
    """Use only UDP in this process and in those that it starts. Call it before `rclpy.init`.

    The range of discovery stays (`ROS_AUTOMATIC_DISCOVERY_RANGE`, `ROS_STATIC_PEERS`). Processes with shared memory are
    reached by UDP. Nothing changes if the user has chosen a profile, transports, or another middleware.

    Args:
        environment: the environment to change.
    """
    profile = LOCALHOST if environment.get(RANGE) == "LOCALHOST" else SUBNET
    if (
        get_rmw_implementation_identifier() != "rmw_fastrtps_cpp"
        or PROFILES in environment
        or environment.get(TRANSPORTS, UDP) != UDP
        or any(environment.get(name) for name in OTHERS)
        or any(Path(name).is_file() for name in FOUND_BY_NAME)
        or not profile.is_file()  # without the file, the range would silently become SUBNET
    ):
        return
    environment[PROFILES] = str(profile)
    environment.pop(TRANSPORTS, None)
    if profile is LOCALHOST:
        environment[RANGE] = "SUBNET"
