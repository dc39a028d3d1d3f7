# SPDX-License-Identifier: Apache-2.0
"""Board time to host time, from the arrivals of the frames.

A frame arrives a fixed latency after its sample (conversions, transmission), plus a delay by USB, kernel and scheduler
that is never negative. So the line from board time to host time lies below all arrivals and as close to them as
possible. It is the edge of their lower convex hull over the mean board time (Moon, Skelly, Towsley, "Estimation and
removal of clock skew from network delay measurements", INFOCOM 1999). No threshold for outliers is needed: late
arrivals do not move the line.

The result does not jump when the line is fitted again. It approaches the new line within `SLEW_S`, at most `SLEW`
faster or slower than the board's clock, so it always increases. There is one exception: if the earliest arrivals of
half a second are all later than `STOOD_NS`, the board's clock has stood still (a host that stood still catches up at
once). Then the past is forgotten, and the result jumps ahead.
"""

from __future__ import annotations

from collections import deque
from itertools import pairwise

BUCKET_NS = 100_000_000
"""[ns] Board time of a bucket; only its earliest arrival is kept. A choice."""
BUCKETS = 300
"""Buckets that are fitted: 30 s. A choice."""
SETTLED = 3
"""Buckets from which on the line is used. A choice."""
MAX_DRIFT = 0.01
"""Greatest relative error of the board's clock. A choice: ceramic resonators are within 0.5 %."""
STOOD_NS = 10_000_000
"""[ns] Lateness of all arrivals of a bucket that shows that the board's clock stood still. A choice."""
STOOD = 5
"""Number of such buckets in a row that are required. A choice."""
SLEW_S = 0.5
"""[s] Time in which the result approaches a new line. A choice."""
SLEW = 0.02
"""Greatest relative difference between the rate of the result and that of the board's clock. A choice."""

Point = tuple[float, float]


class Ticks:
    """Extends a counter to one that does not wrap. Steps of more than half its range count as steps back.

    Args:
        bits: of the counter.
    """

    def __init__(self, bits: int = 32) -> None:
        self._range = 1 << bits
        self._last: int | None = None

    def extend(self, value: int) -> int:
        """Return the extended value. The first value stays unchanged."""
        if self._last is None:
            self._last = value
        else:
            step = (value - self._last) % self._range
            self._last += step - self._range if step > self._range // 2 else step
        return self._last


def line_below(points: list[Point]) -> tuple[float, float]:
    """Fit the line below all points that is closest to them in the mean.

    Args:
        points: (x, y) by increasing x, at least one. A point whose x does not increase is ignored.

    Returns:
        Slope, within ±MAX_DRIFT, and the value at x = 0.
    """
    hull: list[Point] = []
    for x, y in points:
        if hull and x <= hull[-1][0]:
            continue
        while len(hull) > 1 and (hull[-1][1] - hull[-2][1]) * (x - hull[-1][0]) >= (y - hull[-1][1]) * (
            hull[-1][0] - hull[-2][0]
        ):
            hull.pop()
        hull.append((x, y))
    mean = sum(x for x, _ in points) / len(points)
    slope = 0.0
    for (x0, y0), (x1, y1) in pairwise(hull):
        slope = (y1 - y0) / (x1 - x0)
        if x1 >= mean:
            break
    slope = min(max(slope, -MAX_DRIFT), MAX_DRIFT)
    return slope, min(y - slope * x for x, y in hull)


class BoardClock:
    """Turns board times into times of the host's monotonic clock.

    Args:
        tick_ns: [ns] unit of board times.
        latency_ns: [ns] time from the sampling instant to the arrival of its frame without further delay.
        bits: of the board's counter.

    Attributes:
        stops: number of times that the board's clock stood still.
    """

    def __init__(self, tick_ns: int, latency_ns: int = 0, bits: int = 32) -> None:
        self._tick = tick_ns
        self._latency = latency_ns
        self._bits = bits
        self._given = 0
        self.stops = 0
        self.restart()

    def restart(self) -> None:
        """Forget everything except the last result: the board was reset, or replaced."""
        self._ticks = Ticks(self._bits)
        self._origin: tuple[int, int] | None = None  # board and host time of the first arrival, ns
        self._buckets: deque[Point] = deque(maxlen=BUCKETS)
        self._bucket = 0
        self._earliest: Point | None = None
        self._line = (0.0, 0.0)
        self._slope = self._offset = 0.0  # of the result: host = board + offset + slope · board
        self._settled = False

    @property
    def settled(self) -> bool:
        """Whether there were enough arrivals for a fit."""
        return self._settled

    @property
    def drift(self) -> float:
        """Relative slowness of the board's clock against that of the host."""
        return self._line[0]

    def extend(self, ticks: int) -> int:
        """Return a board time without its wraps, ns.

        Args:
            ticks: as in the frames, in the order of arrival.
        """
        return self._ticks.extend(ticks) * self._tick

    def add(self, board_ns: int, arrival_ns: int) -> None:
        """Add the arrival of a frame.

        Args:
            board_ns: [ns] board time of its sample, from `extend`.
            arrival_ns: [ns] its arrival, host's monotonic clock.
        """
        if self._origin is None:
            self._origin = board_ns, arrival_ns
            self._bucket = board_ns // BUCKET_NS
        board = float(board_ns - self._origin[0])
        late = float(arrival_ns - self._origin[1]) - board
        if board_ns // BUCKET_NS != self._bucket:
            self._bucket = board_ns // BUCKET_NS
            if self._earliest is not None:
                self._buckets.append(self._earliest)
                self._earliest = None
                self._fit(board)
        if self._earliest is None or late < self._earliest[1]:
            self._earliest = board, late

    def _fit(self, now: float) -> None:
        if len(self._buckets) < SETTLED:
            return
        slope, offset = self._line
        latest = list(self._buckets)[-STOOD:]
        if self._settled and len(latest) == STOOD and all(y - offset - slope * x > STOOD_NS for x, y in latest):
            self._buckets.clear()
            self._buckets.extend(latest)
            self._settled = False
            self.stops += 1
        slope, offset = self._line = line_below(list(self._buckets))
        if not self._settled:
            self._settled = True
            self._slope, self._offset = slope, offset
            return
        end = now + SLEW_S * 1e9
        given = self._offset + self._slope * now
        wanted = (offset + slope * end - given) / (end - now)
        wanted = min(max(wanted, slope - SLEW), slope + SLEW)
        self._slope, self._offset = wanted, given - wanted * now

    def early_ns(self, board_ns: int, arrival_ns: int) -> float:
        """Return by how much an arrival is earlier than the fit allows, ns; negative for late arrivals.

        Args:
            board_ns: [ns] board time of the sample, from `extend`.
            arrival_ns: [ns] arrival of its frame, host's monotonic clock.
        """
        if self._origin is None:
            return 0.0
        board = board_ns - self._origin[0]
        return board + self._line[1] + self._line[0] * board - (arrival_ns - self._origin[1])

    def host_ns(self, board_ns: int) -> int:
        """Convert a board time to the host's monotonic clock, ns. The result is later than all results before.

        Args:
            board_ns: [ns] board time, from `extend`.

        Raises:
            RuntimeError: not settled yet.
        """
        if not self._settled or self._origin is None:
            raise RuntimeError("the clock is not settled yet")
        board = board_ns - self._origin[0]
        host = self._origin[1] + board + round(self._offset + self._slope * board) - self._latency
        self._given = max(host, self._given + 1)
        return self._given
