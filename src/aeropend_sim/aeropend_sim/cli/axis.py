# SPDX-License-Identifier: Apache-2.0
"""Round numbers along the axis of a drawing."""

from __future__ import annotations

import math


def tick_step(low: float, high: float, about: float, tolerance: float = 0.0) -> float:
    """Distance between the ticks of an axis: 1, 2 or 5 times a power of ten.

    Args:
        low: least value on the axis.
        high: greatest value on the axis; more than `low`.
        about: number of intervals that the axis has at most.
        tolerance: share by which a step may be too small for that number.

    Returns:
        The step, in the unit of the axis.
    """
    raw = (high - low) / about
    base = 10.0 ** math.floor(math.log10(raw))
    return next(m * base for m in (1.0, 2.0, 5.0, 10.0) if m * base >= raw * (1.0 - tolerance))


def multiples(low: float, high: float, step: float) -> range:
    """The whole numbers k for which `k * step` lies on the axis.

    Args:
        low: least value on the axis.
        high: greatest value on the axis.
        step: distance between two ticks, more than 0.
    """
    return range(math.ceil(low / step), math.floor(high / step) + 1)
