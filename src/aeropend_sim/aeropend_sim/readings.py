# SPDX-License-Identifier: Apache-2.0
"""Which numbers can be a reading of a rig, and which stamps a time: recordings and nodes leave out all others."""

MOST = {"theta": 1e4, "omega": 1e6, "i_a": 1e6, "v_a": 1e6, "duty": 1.0, "reference": 1e6}
"""Channel -> greatest amount of a reading.

Choice: no small rig reaches it, even where somebody sends degrees, rpm, mA or mV, which are recognised later. A duty is
a fraction (docs/interfaces.md). A reference is an angle or a speed."""

ROUNDING = 1e-3
"""Amount by which a duty may be beyond 1, and counts as 1 (choice: that of a duty in per mille, rounded)."""


def is_possible(channel: str, value: float) -> bool:
    """Whether a number can be a reading of a channel (a key of `MOST`); NaN and infinity cannot."""
    return abs(value) <= MOST[channel]


def is_time(seconds: int, nanoseconds: int) -> bool:
    """Whether a stamp is a time: not before 1970, and with less than a second of nanoseconds."""
    return seconds >= 0 and 0 <= nanoseconds < 1_000_000_000
