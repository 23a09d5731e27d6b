"""Evidence of one cycle: the input of the state machine, as numbers and flags that the cycle has derived."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from daemon.health.reasons import Reason

SILENT_PERIODS: Final = 3.0
"""Scan periods without a valid scan after which the lidar has timed out."""
VAGUE_M: Final = 0.15
VAGUE_RAD: Final = 0.05
"""One-sigma limit above which the state is not TRACKING. For the heading it is 2.9 deg, while TRACKING permits an error
of 5 deg: above the limit, some headings exceeded that (docs/integrity.md)."""


@dataclass(frozen=True, slots=True)
class Match:
    """Result of one scan match.

    Attributes:
        good: the match is valid and enough of the scan took part.
        known: (x, y, yaw) whether the match determines the axis.
        off_m, off_rad: correction of the predicted pose by the match.
    """

    good: bool
    known: tuple[bool, bool, bool]
    off_m: float = math.inf
    off_rad: float = math.inf


@dataclass(frozen=True, slots=True)
class Light:
    """Result of the light filter in one cycle.

    Attributes:
        alive: samples arrive. used: lamps are received and in use, and position and heading of the light solution are
            good.
        fits: enough lamps are received at a position close to the pose's, although the restarted light filter has not
            converged yet.
        placed: light has aligned the map to the survey.
        lost: the received lamps contradict the position of the light solution itself.
        agrees: whether the light solution and the pose agree within their covariances; None: not available.
        moved: in this cycle the pose moved to the light solution, after the two had disagreed.
        elsewhere: most of the received lamps cannot be received at the pose, in two epochs in a row.
        apart: the two solutions disagree, or one of them is still moving to the other.
        known: (x, y, yaw) whether the pose determines the axis, with or without a lidar.
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
    """Evidence of one cycle. Times in seconds of ``t_mono``.

    Attributes:
        t_mono: now.
        silence: scan periods since the last valid scan; None before the first.
        unreachable: the driver has backed off with an error since the last valid scan.
        match: of the scan of this cycle; None without a scan or before there is a map to match against.
        mapped: there is a map to match against.
        sigma_m, sigma_rad: one-sigma uncertainty (larger axis; heading) gained by motion that no measurement confirmed.
        guessed: the map itself was extended at an unconfirmed pose; the pose stays unconfirmed until other evidence.
        odometry: whether it is arriving; None where none is configured.
        agree: whether odometry and lidar measured the same motion recently; None where not available.
        places: number of hypotheses during relocalisation (0: none yet); None: no relocalisation.
        ordered: an operator has set the pose or reset the map in this cycle.
        lidar: a lidar is configured. light: None where no photodiode is configured.
        unused: reason why an available lidar is not used; None: it is used.
        recalled: relocalisation in the whole map has just found the pose at the stored pose of the previous run.
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
