"""What one cycle knows, as the state machine takes it: already judged by the cycle, in numbers and yes or no."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from daemon.health.reasons import Reason

SILENT_PERIODS: Final = 3.0
"""Scan periods without a valid scan after which the lidar is said to be gone."""
VAGUE_M: Final = 0.15
VAGUE_RAD: Final = 0.05
"""One-sigma uncertainty beyond which TRACKING is not said. The heading's is 2.9 deg, of the 5 that TRACKING must not be
off by: of those that were less sure, some were (docs/integrity.md)."""


@dataclass(frozen=True, slots=True)
class Match:
    """What one scan's match says, already judged by the cycle.

    Attributes:
        good: it is a result and enough of the scan took part.
        known: (x, y, yaw) whether the match fixed the axis.
        off_m, off_rad: by how much it moved the pose from where it was taken to be.
    """

    good: bool
    known: tuple[bool, bool, bool]
    off_m: float = math.inf
    off_rad: float = math.inf


@dataclass(frozen=True, slots=True)
class Light:
    """What light says, already judged by the cycle.

    Attributes:
        alive: samples arrive. used: lamps are received and used, and the place and heading they tell are good.
        fits: enough lamps are received at a place like the pose's, though light, which has had to look for it anew,
            is not sure of it by itself yet.
        placed: it has been told by light where the map lies.
        lost: what is received contradicts the place that light itself had told.
        agrees: whether the light's place and the pose are the same within what both may be wrong; None: cannot be said.
        moved: in this cycle the pose was moved to where light says, after the two had contradicted each other.
        elsewhere: most of the lamps that are received cannot be received at the pose, in two epochs in a row.
        apart: they are not, or are and one of the two is still on its way.
        known: (x, y, yaw) whether the pose knows the axis, with or without a laser.
    """

    alive: bool
    used: bool = False
    fits: bool = False
    placed: bool = False
    lost: bool = False
    agrees: bool | None = None
    moved: bool = False
    elsewhere: bool = False
    apart: bool = False
    known: tuple[bool, bool, bool] = (False, False, False)


@dataclass(frozen=True, slots=True)
class Evidence:
    """What one cycle knows. Times in seconds of ``t_mono``.

    Attributes:
        t_mono: now.
        silence: scan periods since the last valid scan; None before the first.
        unreachable: the driver has backed off, and said why, since the last valid scan.
        match: of the scan of this cycle; None without a scan or before there is a map to match against.
        mapped: there is something to match against.
        sigma_m, sigma_rad: one-sigma uncertainty (larger axis; heading) gained by motion that nothing has witnessed.
        guessed: the map itself was laid upon a guess; the place in it stays one until something else tells it.
        odometry: whether it is arriving; None where none is configured.
        agree: whether wheels and laser told the same motion lately; None where that cannot be said.
        places: how many places fit while the place is looked for (0: none yet); None: not looking.
        ordered: a person has set the pose or reset the map in this cycle.
        lidar: there is one. light: None where no photodiode is configured.
        unused: why the laser is not used though it is there; None: it is.
        recalled: the robot has just been found in the whole map, and where the run before has left it.
    """

    t_mono: float
    silence: float | None = None
    unreachable: bool = False
    match: Match | None = None
    mapped: bool = False
    sigma_m: float = 0.0
    sigma_rad: float = 0.0
    guessed: bool = False
    odometry: bool | None = None
    agree: bool | None = None
    places: int | None = None
    ordered: bool = False
    lidar: bool = True
    light: Light | None = None
    unused: Reason | None = None
    recalled: bool = False
