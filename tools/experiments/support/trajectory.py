"""Absolute trajectory error: how far an estimated way is from the true one, as it stands and after a best rigid fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Estimated poses of base_link (n, 3) at (n,) instants, and the true ones. Frames are the same, or meant to be."""

    t: Array
    pose: Array
    truth: Array

    def since(self, t: float) -> Track:
        """The part from an instant on."""
        some = self.t >= t
        return Track(self.t[some], self.pose[some], self.truth[some])


@dataclass(frozen=True, slots=True)
class Errors:
    """Of positions in m, of heading in degrees: root mean square, largest, at the end, and heading's mean square."""

    rmse: float
    largest: float
    end: float
    heading: float


def errors(track: Track) -> Errors:
    """The errors of a track as it stands."""
    way = np.hypot(*(track.pose[:, :2] - track.truth[:, :2]).T)
    turned = np.angle(np.exp(1j * (track.pose[:, 2] - track.truth[:, 2])))
    return Errors(
        float(np.sqrt(np.mean(way**2))),
        float(way.max()),
        float(way[-1]),
        float(np.degrees(np.sqrt(np.mean(turned**2)))),
    )


def started(track: Track) -> Track:
    """The same track put where the robot truly was at its first pose: what one knows who is told where it starts."""
    return Track(track.t, moved(track.pose, track.pose[0], track.truth[0]), track.truth)


def fitted(track: Track) -> Track:
    """The same track moved and turned as a whole so that its positions fit the truth best (least squares)."""
    a, b = track.pose[:, :2], track.truth[:, :2]
    at, to = a.mean(axis=0), b.mean(axis=0)
    p, q = a - at, b - to
    turn = np.arctan2(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]), np.sum(p * q))
    return Track(track.t, moved(track.pose, np.array((*at, 0.0)), np.array((*to, turn))), track.truth)


def moved(poses: Array, at: Array, to: Array) -> Array:
    """Poses (n, 3), moved and turned together so that one that is ``at`` comes to lie at ``to``."""
    turn = to[2] - at[2]
    c, s = np.cos(turn), np.sin(turn)
    dx, dy = poses[:, 0] - at[0], poses[:, 1] - at[1]
    return np.column_stack([to[0] + c * dx - s * dy, to[1] + s * dx + c * dy, poses[:, 2] + turn])
