"""Keyframes (kept scans with their pose) and submaps (path segments that the pose graph moves as rigid bodies)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from weakref import WeakSet

import numpy as np
import numpy.typing as npt

from estimator.job_queue import job_function
from estimator.measurements import Beam, Beams, Scan
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.result import Virtual
from estimator.scan_matching import local_map
from estimator.scan_matching.deskew import ScanPoints, unturned
from estimator.scan_matching.line_features import lines_of
from estimator.scan_matching.local_map import LocalMap, MapSettings

Square = tuple[int, int, int]
Elements = npt.NDArray[np.float32]
"""Line elements (n, local_map.WIDTH) in the submap's frame; float32 resolves a micrometre over 10 m."""

ANYWHERE = np.diag((1e3, 1e3, 10.0))
"""Covariance (m, m, rad) of a pose without an odometry edge to the others."""

NEAR_M, NEAR_RAD = 0.4, 0.25 * math.pi
"""Distance (m, rad) within which keyframes show the same (see `estimator.mapping.keyframe_selection.retire`)."""

LONGEST_M = 1e6
"""Largest stored range, m; longer ones mean the same and would exceed single precision."""


@dataclass(slots=True, eq=False, weakref_slot=True)
class Submap:
    """A segment of the path that corrections of the map move as one rigid body.

    Attributes:
        key: number, counted from 1.
        first: ID of its first keyframe, whose pose is its own.
        T_map_submap: pose in the map; follows every correction.
        T_odom_submap: pose when it was created, constant.
        way_m: path length until there.
        settled: its content, once it is finished.
        light: its pose by the light solution at its most certain keyframe, with the covariance; None without.
        lamps: IDs of the lamps used at any of its keyframes (the paper's S_M, of this segment).
        into: submap that has replaced it in the graph, and its pose in that one; None while it stands alone.
        hung: submaps that this one has replaced and that keyframes still refer to.
        strayed: accumulated covariance of the path until there, see `SubmapGraph.strayed_since`; by default no path is
            known.
    """

    key: int
    first: int
    T_map_submap: Array
    T_odom_submap: Array
    way_m: float = 0.0
    settled: Settled | None = None
    light: tuple[Array, Array] | None = None
    lamps: frozenset[int] = frozenset()
    into: tuple[Submap, Array] | None = None
    hung: WeakSet[Submap] = field(default_factory=WeakSet)
    strayed: Array = field(default_factory=lambda: -ANYWHERE)

    def hang_on(self, hub: Submap, T_hub_submap: Array) -> None:
        """Replace this submap by ``hub`` in the graph, together with all submaps that it has replaced.

        Over years of laps each submap replaces an earlier one. Every reference points to ``hub`` directly, so no chain
        grows.
        """
        for other in (self, *self.hung):
            T = T_hub_submap if other.into is None else se2.compose(T_hub_submap, other.into[1])
            other.into = hub, T
            hub.hung.add(other)
        self.hung.clear()

    def place(self) -> Array:
        """``T_map_submap`` with all corrections so far."""
        if self.into is None:
            return self.T_map_submap
        other, T_other_submap = self.into
        return se2.compose(other.place(), T_other_submap)


@dataclass(slots=True, eq=False)
class Keyframe:
    """A kept scan.

    Attributes:
        key: ID of the keyframe.
        submap: its submap.
        T_odom_keyframe: pose when it was created, constant.
        T_base_lidar: mount.
        bearing_rad: shared with the other keyframes of the same lidar.
        turned_rad: yaw turned from the first to the last beam.
        range_m: float32.
        beam: uint8 of `Beam`.
        virtual: the light solution, None where it is not valid.
    """

    key: int
    submap: Submap
    T_odom_keyframe: Array
    T_base_lidar: Array
    bearing_rad: Array
    turned_rad: float
    range_m: npt.NDArray[np.float32]
    beam: npt.NDArray[np.uint8]
    virtual: Virtual | None = None

    @property
    def T_map_keyframe(self) -> Array:
        """Its pose in the map with all corrections so far."""
        return se2.compose(self.submap.place(), se2.between(self.submap.T_odom_submap, self.T_odom_keyframe))

    @property
    def T_odom_lidar(self) -> Array:
        """Pose of the lidar when the keyframe was created."""
        return se2.compose(self.T_odom_keyframe, self.T_base_lidar)

    def beams(self) -> Beams:
        """Beams in the lidar's frame at the scan's end."""
        return unturned(self.bearing_rad, self.turned_rad), self.range_m.astype(np.float64), self.beam


SIZE = 12
"""Keyframes in a submap: some three metres of path."""


@dataclass(frozen=True, slots=True, eq=False)
class Settled:
    """Content of a finished submap.

    Attributes:
        elements: of all its keyframes, merged.
        witness: reference scan: its middle keyframe, in the submap's frame, for the free-space test.
        sigma: range noise assumed for them.
    """

    elements: Elements
    witness: Keyframe
    sigma: float

    def local(self) -> LocalMap:
        """The submap as a local map, in its own frame."""
        return local_map.index(self.elements.astype(np.float64), np.zeros(2), 1, self.witness)


def near(one: Array, other: Array) -> bool:
    """Whether two keyframes show the same from the same position; motion along an axis stays within an eighth turn."""
    x, y, yaw = (one - other).tolist()
    return math.hypot(x, y) < NEAR_M and abs(se2.wrap(yaw)) < NEAR_RAD


def square_of(T_map_keyframe: Array) -> Square:
    """Half metre square and eighth of a turn, by which keyframes are listed."""
    x, y, yaw = T_map_keyframe.tolist()
    return math.floor(2.0 * x), math.floor(2.0 * y), math.floor(yaw * 4.0 / math.pi + 0.5) % 8


def squares_about(T_map_keyframe: Array) -> list[Square]:
    """The squares whose lists contain every keyframe that is `near`."""
    i, j, k = square_of(T_map_keyframe)
    return [(i + a, j + b, (k + c) % 8) for a in (0, -1, 1) for b in (0, -1, 1) for c in (0, -1, 1)]


def hanging(frames: Iterable[Keyframe]) -> list[tuple[Submap, list[Keyframe]]]:
    """Keyframes by submap, in the order of the submaps' creation."""
    groups: dict[int, tuple[Submap, list[Keyframe]]] = {}
    for frame in frames:
        groups.setdefault(frame.submap.first, (frame.submap, []))[1].append(frame)
    return [groups[first] for first in sorted(groups)]


def keep(key: int, T_map: Array, T_odom: Array, scan: Scan, turned_rad: float) -> Keyframe:
    """Create a keyframe of a scan matched at ``T_odom``, with a submap of its own."""
    return Keyframe(
        key=key,
        submap=Submap(0, key, T_map, T_odom),
        T_odom_keyframe=T_odom,
        T_base_lidar=scan.T_base_lidar,
        bearing_rad=scan.bearing_rad,
        turned_rad=turned_rad,
        range_m=np.clip(scan.range_m, -LONGEST_M, LONGEST_M).astype(np.float32),
        beam=scan.beam,
    )


@job_function
def settle(frames: Sequence[Keyframe], T_odom_submap: Array, sigma: float) -> Settled:
    """Merge the lines of keyframes (at least one) into the content of a submap created at ``T_odom_submap``."""
    local = local_map.empty(np.zeros(2))
    placed = [replace(frame, T_odom_keyframe=se2.between(T_odom_submap, frame.T_odom_keyframe)) for frame in frames]
    for frame in placed:
        lines = lines_of(points_of_frame(frame, sigma))
        local = local_map.update(local, frame, lines, MapSettings(age=len(placed) + 1), sigma)
    return Settled(local.elements.astype(np.float32), placed[len(placed) // 2], sigma)


def points_of_frame(frame: Keyframe, sigma: float) -> ScanPoints:
    """Surface points of a keyframe in its base frame."""
    bearing, distance, kind = frame.beams()
    hit = (kind == Beam.HIT) & np.isfinite(distance) & (distance > 0.0)
    angle, reach = bearing[hit] + frame.T_base_lidar[2], distance[hit]
    xy = np.column_stack((reach * np.cos(angle), reach * np.sin(angle))) + frame.T_base_lidar[:2]
    return ScanPoints(np.ascontiguousarray(xy), np.ascontiguousarray(frame.T_base_lidar[:2]), 0.0, sigma)
