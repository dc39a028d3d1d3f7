# SPDX-License-Identifier: Apache-2.0
"""A program that keeps the plant's pace and does nothing else: what it misses, the machine made it miss.

Prints how many ticks were late and how many lost when it is interrupted.
"""

import signal
import subprocess
import sys

from aeropend_sim.nodes.plant import BACKLOG, PERIOD_NS, Pace
from aeropend_sim.ros.realtime import prepare_thread, request_realtime_priority


class Sleeper:
    """Runs it."""

    def __enter__(self) -> "Sleeper":
        self._program = subprocess.Popen([sys.executable, __file__], stdout=subprocess.PIPE, text=True)
        return self

    def __exit__(self, *_: object) -> None:
        self._program.kill()
        self._program.wait()

    def ended(self) -> dict[str, int]:
        """End it; returns its late ticks and lost ticks."""
        self._program.send_signal(signal.SIGINT)
        said, _ = self._program.communicate()
        return dict(zip(("late ticks", "lost ticks"), map(int, said.split()), strict=True))


def main() -> int:
    """Sleep until SIGINT."""
    prepare_thread()
    request_realtime_priority()
    pace, lost = Pace(PERIOD_NS, BACKLOG), 0
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        while True:
            lost += pace.next()
    except KeyboardInterrupt:
        print(pace.late, lost)
    return 0


if __name__ == "__main__":
    sys.exit(main())
