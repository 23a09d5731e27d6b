"""Maps sensor time to host time by the lower envelope of the delays: data arrive late, never early.

The closest line below all points is an edge of their convex hull (Moon, Skelly, Towsley: "Estimation and removal of
clock skew from network delay measurements", INFOCOM 1999).
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from typing import Final

SLOPE_LIMIT: Final = 1.5e-3  # of sensor clock against host clock; a quartz has 50e-6, much worse is accepted
LAG_S: Final = 0.020
_LAG_LASTS_S: Final = 3.0  # a slowly grown lag that lasts this long: the sensor's clock has moved
_QUEUE_LASTS_S: Final = 600.0  # a sudden lag: by then the rate's error (3e-5) has added up to LAG_S
_AT_ONCE_S: Final = 1.0  # from a quarter of LAG_S to all of it: ten times faster than a clock may be off (SLOPE_LIMIT)
_BRIDGED: Final = 1e-4  # of the time without an edge: error of the extrapolated slope
_RATE_HALF_S: Final = 10.0  # edges over this span weigh half in the rate: delays differ by 4 ms, sensor rates by 4e-4
_NEAR_S: Final = 1.0  # up to here after the last edge the line keeps the slope of the edges
_BIN_S: Final = 0.25
_WINDOW_S: Final = 30.0
_LOOK_BACK_S: Final = 2.0
_KEEP_BINS: Final = 8


class Envelope:
    """Lower edge of the delay (arrival - stamp, s) over a sliding window, as a line in sensor time.

    Args:
        period_s: interval of the points, s; a slow stream needs a longer window.
    """

    def __init__(self, period_s: float) -> None:
        self._window_s = max(_WINDOW_S, 100.0 * period_s)
        self._look_back_s = max(_LOOK_BACK_S, 20.0 * period_s)
        self.restart()

    def restart(self) -> None:
        """Forget all points."""
        self._bins: deque[tuple[float, float]] = deque()  # lowest point of each quarter second: (x, delay)
        self._bin_end = -math.inf
        self._slope = self._rate = 0.0
        self._base = 0.0
        self._x0 = 0.0
        self._lagging_since = math.inf
        self._queued = False
        self._t_prompt = -math.inf
        self._t_last = -math.inf

    @property
    def slope(self) -> float:
        """Host seconds per sensor second, less one."""
        return self._slope

    @property
    def lag_lasts(self) -> bool:
        """True when all points have lagged for so long that the cause is the sensor's clock, not the transport.

        A clock drifts by its rate, or it is set; a set clock breaks the rhythm of the stamps and is detected there. It
        cannot lose 0.1 s between two scans while the motor turns evenly. A sudden lag is therefore the line or the
        computer, which may hold up data for much longer than a clock takes to drift.
        """
        return self._t_last - self._lagging_since > (_QUEUE_LASTS_S if self._queued else _LAG_LASTS_S)

    def age(self, x: float) -> float:
        """Sensor seconds since the last point that constrained the edge."""
        return x - self._bins[-1][0] if self._bins else 0.0

    def delay(self, x: float) -> float:
        """Arrival less stamp of an undelayed scan, at sensor time ``x``; seconds.

        Beyond the last edge the line continues with the long-term clock rate: the slope of a few seconds contains the
        transport's own changes and would drift by a millisecond per second.
        """
        ahead = x - self._x0
        near = min(ahead, _NEAR_S)
        return self._base + self._slope * near + self._rate * (ahead - near)

    def feed(self, x: float, delay: float) -> float:
        """Add a point; returns its excess over the updated edge, >= 0, s."""
        if not self._bins:
            self._x0, self._base = x, delay
        excess = delay - self.delay(x)
        self._t_last = x + delay
        if excess > self._lag(x):  # does not constrain the edge
            if math.isinf(self._lagging_since):
                self._lagging_since = self._t_last
                self._queued = self._t_last - excess - self._t_prompt < _AT_ONCE_S
            return excess
        self._lagging_since = math.inf
        if excess < 0.25 * LAG_S:
            self._t_prompt = self._t_last - excess
        if x >= self._bin_end:
            self._open_bin(x, delay)
        elif excess < self._bins[-1][1] - self.delay(self._bins[-1][0]):
            self._bins[-1] = (x, delay)
        if excess < 0:
            self._base += excess
            self._fit()
        return max(0.0, delay - self.delay(x))

    def _lag(self, x: float) -> float:
        """Excess from which a point counts as late; the last points of an emptying queue are no edge either."""
        over = LAG_S if math.isinf(self._lagging_since) else 0.25 * LAG_S + _BRIDGED * self.age(x)
        return min(over, LAG_S)

    def shift(self, seconds: float) -> None:
        """Correct past sensor times that were too late by ``seconds``: their delays were too short."""
        self._bins = deque((x, delay + seconds) for x, delay in self._bins)
        self._base += seconds

    def _open_bin(self, x: float, delay: float) -> None:
        self._bins.append((x, delay))
        while len(self._bins) > _KEEP_BINS and self._bins[0][0] < x - self._window_s:
            self._bins.popleft()
        self._bin_end = x + _BIN_S
        self._fit()

    def _fit(self) -> None:
        """Tangent of the lower hull a little before the end of the window, its slope limited.

        A tangent below the middle would be closest to all points. But periods close to a whole number of milliseconds
        bend the edge, and the estimate is needed at the end of the window.
        """
        hull: list[tuple[float, float]] = []
        for point in self._bins:
            while len(hull) > 1 and _turns_right(hull[-2], hull[-1], point):
                hull.pop()
            hull.append(point)
        first, last = self._bins[0][0], self._bins[-1][0]
        under = max(last - self._look_back_s, 0.5 * (first + last))
        slope = 0.0
        for (x0, y0), (x1, y1) in itertools.pairwise(hull):
            slope = (y1 - y0) / (x1 - x0)
            if x1 >= under:
                break
        self._slope = min(max(slope, -SLOPE_LIMIT), SLOPE_LIMIT)
        self._rate = self._slope / (1.0 + (_RATE_HALF_S / max(last - first, _BIN_S)) ** 2)
        self._x0 = self._bins[-1][0]
        self._base = min(y + self._slope * (self._x0 - x) for x, y in hull)


def _turns_right(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) <= (b[1] - a[1]) * (c[0] - a[0])
