"""Conversion between the estimator's map image and the arrays of a map file. Pure."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from daemon.maps.container import AnyArray, Content, nothing, pack
from daemon.maps.schema import Meta, Stored, Tables, lamp_tables, lamps_of
from estimator import Array, Constraints, Identity, Keyframe, MapImage, Piece, Settled, Submap, Virtual, finished, se2

SLICE: Final = 16
"""Number of keyframes or submaps between two pauses for other threads."""

Ranges = npt.NDArray[np.float32]


def packed(image: MapImage, meta: Meta, breathe: Callable[[], None] = nothing) -> bytes:
    """Encode a map file. ``breathe`` is called every fraction of a millisecond, so that other threads can run."""
    return pack(tables_of(finished(image), meta, breathe), breathe)


def meta_of(image: MapImage, saved: float, robot: str, software: str) -> Meta:
    """Metadata of a map image."""
    who = image.identity
    return Meta(who.map_id, who.name, who.surveyed, who.survey, who.session, saved, robot, software)


@dataclass(slots=True)
class _Scans:
    """Keyframes as table rows; a scan shared by a submap's reference scan and a keyframe is stored once."""

    rows: list[tuple[Keyframe, int, Array]] = field(default_factory=list)
    row_of: dict[int, int] = field(default_factory=dict)
    fans: list[Array] = field(default_factory=list)
    fan_of: dict[int, int] = field(default_factory=dict)

    def add(self, frame: Keyframe, submap: int, T: Array) -> None:
        self.row_of[frame.key] = len(self.rows)
        self.rows.append((frame, submap, T))

    def witness(self, frame: Keyframe) -> int:
        if frame.key not in self.row_of:
            self.add(frame, 0, np.zeros(3))
        return self.row_of[frame.key]

    def fan(self, bearing: Array) -> int:
        """Index of an array of bearings; a lidar has the same ones in every scan, so they are stored once."""
        if id(bearing) not in self.fan_of:
            same = (k for k, fan in enumerate(self.fans) if np.array_equal(fan, bearing))
            known = next(same, len(self.fans))
            if known == len(self.fans):
                self.fans.append(bearing)
            self.fan_of[id(bearing)] = known
        return self.fan_of[id(bearing)]


def tables_of(image: MapImage, meta: Meta, breathe: Callable[[], None] = nothing) -> dict[str, Content]:
    """Arrays of an image whose submaps are all finished."""
    scans = _Scans()
    for n, hung in enumerate(image.keyframes()):
        scans.add(*hung)
        if n % SLICE == 0:
            breathe()
    tables: dict[str, Content] = {"meta": meta.packed(), **_submaps(image, scans)}
    breathe()
    joined = image.constraints
    tables |= {
        "joined.keys": joined.between,
        "joined.T": joined.T,
        "joined.H": joined.information,
        "joined.loop": joined.loop.astype(np.uint8),
        **_frames(scans),
        **_ranges(scans, breathe),
        **lamp_tables(image.lamps),
        "gain.id": np.array(sorted(image.gains), "<i8"),
        "gain": _rows([np.concatenate(image.gains[k]) for k in sorted(image.gains)], 6),
        "sensor": _rows([] if image.sensors is None else list(image.sensors), 9),
        "pose": image.T_map_base.reshape(1, 3),
        "pose.P": image.P,
    }
    return tables


def _submaps(image: MapImage, scans: _Scans) -> dict[str, Content]:
    pieces = [(piece, piece.settled) for piece in image.submaps if piece.settled is not None]
    return {
        "submap.key": np.array([piece.key for piece, _ in pieces], "<i8"),
        "submap.first": np.array([piece.first for piece, _ in pieces], "<i8"),
        "submap.map": _rows([piece.T_map_submap for piece, _ in pieces], 3),
        "submap.odom": _rows([piece.T_odom_submap for piece, _ in pieces], 3),
        "submap.way": np.array([piece.way_m for piece, _ in pieces], "<f8"),
        "submap.sigma": np.array([settled.sigma for _, settled in pieces], "<f8"),
        "submap.elements": np.array([len(settled.elements) for _, settled in pieces], "<i8"),
        "submap.witness": np.array([scans.witness(settled.witness) for _, settled in pieces], "<i8"),
        "submap.seen": _rows([settled.witness.T_odom_keyframe for _, settled in pieces], 3),
        "submap.lit": np.array([piece.light is not None for piece, _ in pieces], "|u1"),
        "submap.light": _lights([piece.light for piece, _ in pieces]),
        "element": [np.empty((0, 8), "<f4"), *(settled.elements for _, settled in pieces)],
    }


def _frames(scans: _Scans) -> dict[str, Content]:
    frames = [frame for frame, _, _ in scans.rows]
    told = [frame.virtual for frame in frames]
    lamps = [sorted(virtual.accepted) for virtual in told if virtual is not None]
    fan = [scans.fan(frame.bearing_rad) for frame in frames]
    return {
        "frame.key": np.array([frame.key for frame in frames], "<i8"),
        "frame.submap": np.array([submap for _, submap, _ in scans.rows], "<i8"),
        "frame.T": _rows([T for _, _, T in scans.rows], 3),
        "frame.mount": _rows([frame.T_base_lidar for frame in frames], 3),
        "frame.turned": np.array([frame.turned_rad for frame in frames], "<f8"),
        "frame.fan": np.array(fan, "<i8"),
        "frame.lit": np.array([virtual is not None for virtual in told], "|u1"),
        "frame.light": _lights([None if one is None else (one.T_map_base, one.covariance) for one in told]),
        "frame.lamps": np.array([len(ids) for ids in lamps], "<i8"),
        "frame.lamp": np.array([lamp_id for ids in lamps for lamp_id in ids], "<i8"),
        "fan.beams": np.array([len(bearing) for bearing in scans.fans], "<i8"),
        "fan.bearing": np.concatenate([np.empty(0), *scans.fans]),
    }


def _ranges(scans: _Scans, breathe: Callable[[], None]) -> dict[str, Content]:
    """Ranges as integers in mm where these are exact, as lidars report them: that packs far smaller."""
    mm: list[AnyArray] = [np.empty(0, "<i4")]
    m: list[AnyArray] = [np.empty(0, "<f4")]
    exact = []
    for n, (frame, _, _) in enumerate(scans.rows):
        whole = in_mm(frame.range_m)
        exact.append(whole is not None)
        if whole is None:
            m.append(frame.range_m)
        else:
            mm.append(whole)
        if n % SLICE == 0:
            breathe()
    beams = [np.empty(0, "|u1"), *(frame.beam for frame, _, _ in scans.rows)]
    return {"frame.exact": np.array(exact, "|u1"), "range.mm": mm, "range.m": m, "beam": beams}


def in_mm(range_m: Ranges) -> npt.NDArray[np.int32] | None:
    """Ranges as integers in mm, None where one of them is not exactly such a value."""
    if not (np.abs(range_m) < 1e6).all():
        return None
    whole = np.rint(range_m.astype(np.float64) * 1e3).astype(np.int32)
    return whole if np.array_equal(in_m(whole).view(np.int32), range_m.view(np.int32)) else None


def in_m(whole: npt.NDArray[np.int32]) -> Ranges:
    """The inverse of :func:`in_mm`."""
    return (whole * 1e-3).astype(np.float32)


def _rows(rows: list[Array], columns: int) -> Array:
    return np.array(rows, np.float64).reshape(-1, columns)


def _lights(told: list[tuple[Array, Array] | None]) -> Array:
    """Pose and covariance of each light solution, only of those that exist."""
    return _rows([np.concatenate((T, P.reshape(-1))) for T, P in (one for one in told if one is not None)], 12)


def image_from(stored: Stored, without: frozenset[int] = frozenset()) -> MapImage:
    """Decode the map image of a stored map. ``without``: lamps whose stored gains are not valid any more."""
    meta, t = stored.meta, stored.tables
    frames = _kept_frames(t)
    pieces, stands = _kept_submaps(t, frames)
    hung = []
    for row, key in enumerate(t["frame.submap"].tolist()):
        if key:
            submap = stands[key]
            T_odom = se2.compose(submap.T_odom_submap, t["frame.T"][row])
            hung.append(replace(frames[row], submap=submap, T_odom_keyframe=T_odom))
    gains = {
        lamp_id: (row[:3].copy(), row[3:].copy())
        for lamp_id, row in zip(t["gain.id"].tolist(), t["gain"], strict=True)
        if lamp_id not in without
    }
    return MapImage(
        identity=Identity(meta.map_id, meta.name, meta.surveyed, meta.survey, meta.session),
        submaps=pieces,
        constraints=Constraints(t["joined.keys"], t["joined.T"], t["joined.H"], t["joined.loop"] != 0),
        frames=tuple(hung),
        gains=gains,
        sensors=(t["sensor"][0], t["sensor"][1]) if len(t["sensor"]) else None,
        lamps=tuple(lamp for lamp in lamps_of(t) if lamp.lamp_id not in without),
        T_map_base=t["pose"][0].copy(),
        P=t["pose.P"].copy(),
    )


def _kept_submaps(t: Tables, frames: list[Keyframe]) -> tuple[tuple[Piece, ...], dict[int, Submap]]:
    """Submaps as map image entries, and by key as nodes to which keyframes are attached."""
    ends = np.cumsum(t["submap.elements"])
    lights = _told(t["submap.lit"], t["submap.light"])
    pieces, stands = [], {}
    for row, key in enumerate(t["submap.key"].tolist()):
        elements = t["element"][ends[row] - t["submap.elements"][row] : ends[row]].copy()
        witness = replace(frames[t["submap.witness"][row]], T_odom_keyframe=t["submap.seen"][row].copy())
        settled = Settled(elements, witness, float(t["submap.sigma"][row]))
        T_map, T_odom = t["submap.map"][row].copy(), t["submap.odom"][row].copy()
        piece = Piece(
            key, int(t["submap.first"][row]), T_map, T_odom, float(t["submap.way"][row]), settled, lights[row]
        )
        pieces.append(piece)
        stands[key] = witness.submap = Submap(*piece)
    return tuple(pieces), stands


def _kept_frames(t: Tables) -> list[Keyframe]:
    """Keyframes that are not attached to a submap yet."""
    fans = np.split(t["fan.bearing"], np.cumsum(t["fan.beams"])[:-1]) if len(t["fan.beams"]) else []
    scans = _kept_scans(t)
    told = _told(t["frame.lit"], t["frame.light"])
    lamps = iter(np.split(t["frame.lamp"], np.cumsum(t["frame.lamps"])[:-1]) if len(t["frame.lamps"]) else [])
    nowhere, frames = Submap(0, 0, np.zeros(3), np.zeros(3)), []
    for row, (key, (range_m, beam)) in enumerate(zip(t["frame.key"].tolist(), scans, strict=True)):
        light = told[row]
        virtual = None if light is None else Virtual(*light, frozenset(next(lamps).tolist()))
        mount, turned = t["frame.mount"][row].copy(), float(t["frame.turned"][row])
        bearing = fans[t["frame.fan"][row]]
        frames.append(Keyframe(key, nowhere, np.zeros(3), mount, bearing, turned, range_m, beam, virtual))
    return frames


def _kept_scans(t: Tables) -> Iterator[tuple[Ranges, npt.NDArray[np.uint8]]]:
    """Ranges and beam kinds of each scan, in memory of its own, which is released with it."""
    at = at_mm = at_m = 0
    for fan, exact in zip(t["frame.fan"].tolist(), t["frame.exact"].tolist(), strict=True):
        n = int(t["fan.beams"][fan])
        if exact:
            ranges = in_m(t["range.mm"][at_mm : at_mm + n])
            at_mm += n
        else:
            ranges = t["range.m"][at_m : at_m + n].copy()
            at_m += n
        yield ranges, t["beam"][at : at + n].copy()
        at += n


def _told(lit: AnyArray, light: AnyArray) -> list[tuple[Array, Array] | None]:
    """Light solution of each row, None where there is none."""
    told: list[tuple[Array, Array] | None] = [None] * len(lit)
    for row, at in enumerate(np.flatnonzero(lit).tolist()):
        told[at] = light[row, :3].copy(), light[row, 3:].reshape(3, 3).copy()
    return told
