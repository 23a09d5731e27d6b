"""Record of one match for the match journal: the matcher's input and result, with the light solution beside them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator.fusion.light_witness import virtual
from estimator.measurements import Scan
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.result import Fix, MatchResult
from estimator.scan_matching.deskew import ScanPoints
from estimator.scan_matching.scan_matcher import Asked
from estimator.state import State


@dataclass(frozen=True, slots=True, eq=False)
class LightPoint:
    """One lamp as a point of the paper's Eq. 13: its position in body frames by light alone.

    Attributes:
        lamp_id, code: number of the lamp, and its code.
        reference: in the frame of the newest keyframe, ``X_ref^-1 L``; None without a valid light solution there.
        present: in the present body frame, ``X_new^-1 L``.
        residual: ``present``, transformed by the matched motion since the keyframe, minus ``reference`` (x, y in m,
            frame of the keyframe); None without a reference or a match.
        logarithm: ln of received over expected RSS in the latest epoch, None if it was not received.
    """

    lamp_id: int
    code: int
    reference: Array | None
    present: Array
    residual: Array | None
    logarithm: float | None


@dataclass(frozen=True, slots=True, eq=False)
class LightSaid:
    """Light solution at a scan: state of the fix, the pose T_map_base if it is valid, and the lamps in use.

    ``keyframe`` is the ID of the newest one, created at ``T_odom_keyframe``.
    """

    fix: Fix
    T_map_base: Array | None
    keyframe: int
    T_odom_keyframe: Array
    lamps: tuple[LightPoint, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """Input and result of one match, and the light solution; a few references, nothing computed yet."""

    scan: Scan
    points: ScanPoints
    asked: Asked | None
    result: MatchResult
    light: LightSaid | None


def entry_of(state: State, scan: Scan, points: ScanPoints, asked: Asked | None, result: MatchResult) -> Entry:
    """Record of a match, called by `State.journal`: after the match and before it is fused."""
    return Entry(scan, points, asked, result, light_said(state, result))


def light_said(state: State, match: MatchResult) -> LightSaid | None:
    """Light solution at this scan; None without a photodiode."""
    if state.light is None:
        return None
    light = state.light
    now = virtual(state.pose, state.motion, light)
    if now is None:
        return LightSaid(light.result.fix, None, state.pose.anchor, state.pose.T_odom_anchor, ())
    newest = state.map.keyframes.get(state.pose.anchor)
    before = None if newest is None else newest.virtual
    moved = se2.between(state.pose.T_odom_anchor, match.T_odom_base) if match.ok else None
    strength = {link.lamp_id: link.residual for link in light.result.links}
    lamps = []
    for lamp_id in sorted(now.accepted | (frozenset() if before is None else before.accepted)):
        lamp = light.filter.catalogue.by_id.get(lamp_id)
        if lamp is None:
            continue
        at = np.array(((lamp.x, lamp.y),))
        present = se2.apply(se2.inverse(now.T_map_base), at)[0]
        reference = None if before is None else se2.apply(se2.inverse(before.T_map_base), at)[0]
        residual = None
        if reference is not None and moved is not None:
            residual = se2.apply(moved, present[None])[0] - reference
        lamps.append(LightPoint(lamp_id, lamp.code, reference, present, residual, strength.get(lamp_id)))
    return LightSaid(light.result.fix, now.T_map_base, state.pose.anchor, state.pose.T_odom_anchor, tuple(lamps))
