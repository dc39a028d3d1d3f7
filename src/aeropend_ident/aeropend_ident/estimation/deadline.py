# SPDX-License-Identifier: Apache-2.0
"""The end of the time that a search may take."""

from __future__ import annotations

import time


def passed(deadline: float | None) -> bool:
    """Whether it is later than an instant [s] of `time.monotonic`; never if there is none."""
    return deadline is not None and time.monotonic() > deadline
