"""Where the odom frame lies in the survey: light corrects T_map_odom, and T_odom_base never hears of it.

What is estimated is the error of ``T_map_base`` with its covariance ``P`` and with its covariance ``X`` with the error
of ``T_odom_base`` against the local map (whose own covariance is ``fused.P``). Both errors grow by the same motion, so
a scan that mends the one mends the other as far as ``X`` says; what light has mended already is not mended twice. A
gain of zero for ``T_odom_base`` keeps it smooth and free of light (a Schmidt-Kalman filter). In a corridor the long
axis so comes from light, in a room the laser holds the pose and light finds where the map lies.

The `lights` filter uses the same odometry. Therefore only what its links have *added* is taken (`LightsResult.gained`,
a channel filter), and no more than one filter's worth for each stretch or time over which the error of its own model
stays the same: without that, a robot at rest would average the same wall reflection until it believed it.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from estimator.fusion.heading_stability import Swing
from estimator.fusion.light_inflation import (
    BESIDE_M,
    TRUST,
    across_the_row,
    doubted,
    doubted_covariance,
    without_heading,
)
from estimator.fusion.motion_history import KEPT_S
from estimator.light_filter.collinear_lamps import Lately, doubt, straighten, sure_part
from estimator.light_filter.light_channel import SILENT_S, too_strong_at
from estimator.mapping.map_frame import move_map, rehang, shift_map
from estimator.measurements import Command, Order
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.covariance3 import grow_tie, hang, mend_tie
from estimator.numerics.symmetric3 import det3, invert3, largest_of, positive_part, symmetric
from estimator.result import SURPRISE, Fix, LightsResult, Virtual
from estimator.state import State

FRESH_M, FRESH_S = 0.7, 60.0
"""Way and time after which the error of the light model (walls, floor, lamps) is another one."""

DRIFT = (5e-5, 5e-5, 2e-6)
"""Variance per metre (m^2, m^2, rad^2) by which a map laid by matching bends beyond what the matches know of: some
7 mm and 0.08 deg by the root of the way."""

ASTRAY_RAD = 0.35
"""A heading from light that is off by so much, without wheels, has led its position astray too."""
SURPRISE_S = 1.0
"""Light that is sure and disagrees for longer is believed: nothing else knows where in the building the robot is."""
TOLERANCE = np.diag((0.02**2, 0.02**2, 0.005**2))
"""What stamps and lever arms make of a moving robot."""

APART = 1.5
"""Squared Mahalanobis distance above which a pose is still on its way to where light is, or light to it. The errors of
a pose that comes from light are mostly light's own: at 150 starts it was 0.1 (median), at one of fifty above 0.8, and
not 3 as between two that know nothing of one another; of the four above 1.5 three were wrong."""
FAR_M, FAR_RAD, CHECKED = 1.5, 0.5, 3
"""While the laser has held the pose without a break, light that is off by less is told, not followed: the laser does
not lose so little, and light that reflects in an unusual place is off by as much; nor, where the pose is known, is
light of fewer lamps: one of two that hangs elsewhere takes the place along."""
SAID = np.diag((0.3**2, 0.3**2, 0.15**2))
"""Covariance of a pose that a person gives."""
SURER = 0.25
"""Share of the pose's generalised variance below which the lights' is taken as it is."""
BLIND_S, BLIND_PERIODS, SLOWEST_S = 0.5, 1.5, 3.0
"""Without a match for so long, or so many scan periods (of a slow laser), light and odometry are all there is."""
KNOWN = np.array((0.15**2, 0.15**2, 0.1**2))
"""Variances (m^2, m^2, rad^2) below which an axis of the pose in the survey's frame counts as known."""
MEMORY_S = 1.0
"""How late a light epoch may come."""
SILENT_PERIODS = 2.5
"""Nor does light that has been silent for so many epochs, where these come slowly; see `SILENT_S`."""


@dataclass(slots=True, eq=False)
class Absolute:
    """The tie of the odom frame to the survey's frame.

    Attributes:
        placed: light has told where the map lies. proved: it was sure of that, or a person said so. broken: the laser
            has let go of the pose since, or begun its map anew.
        P, X: see above, both 3x3, odom-aligned axes. kept: T_map_base, and P in map axes, at the latest match, or
            when light or a person said where the map lies; what P has grown by since is of the way, not of the map.
        gap: squared Mahalanobis distance between the pose and the lights' at the latest epoch, None: either is unknown.
        apart: at the latest epoch that told the place they did not agree, or one was on its way to the other.
        by_map: the pose comes from the map that the robot was found in, not from light.
        odd_since: since when they disagree. doubted_at: when that was last no reason to follow light. unheard: the
            laser has found the place while the `lights` filter held another one, and they have not agreed since.
        elsewhere_since: since when what is received does not fit the place. aside_since: nor each epoch alone.
        way, way_young: driven so far, and when light last began to find the place. way_start: of the `lights` filter,
            the start that has led to the place on which the two last agreed.
        fresh: how much of the lights' information may be taken, 0 to 1; grows with way and time.
        since: ID of the first keyframe laid after the pose was known for the last time.
        t_match: instant of the latest match; scan_s: what had passed since the scan before it.
        t_light: instant of the latest epoch, whatever was in it; light_s: what had passed since the one before it.
        poses: T_odom_base of the last second, each with its instant.
        swing: the heading of the odom frame by light over the last stretch of way. row: what a row of lamps leaves.
        mended: when light has mended the pose in the last seconds, and what part (3x3, odom axes) of its error is left.
    """

    placed: bool = False
    proved: bool = False
    broken: bool = False
    P: Array = field(default_factory=lambda: np.zeros((3, 3)))
    X: Array = field(default_factory=lambda: np.zeros((3, 3)))
    kept: tuple[Array, Array] = field(default_factory=lambda: (se2.identity(), np.zeros((3, 3))))
    gap: float | None = None
    apart: bool = False
    by_map: bool = False
    odd_since: float | None = None
    doubted_at: float = -math.inf
    elsewhere_since: float | None = None
    aside_since: float | None = None
    unheard: bool = False
    way: float = 0.0
    way_young: float = 0.0
    way_start: float = -math.inf
    fresh: float = 0.0
    since: int = 0
    t_match: float = -math.inf
    scan_s: float = 0.0
    t_light: float = -math.inf
    light_s: float = 0.0
    poses: deque[tuple[float, Array]] = field(default_factory=deque)
    swing: Swing = field(default_factory=Swing)
    row: Lately = field(default_factory=Lately)
    mended: deque[tuple[float, Array]] = field(default_factory=deque)


def on_motion(state: State, T_before: Array, P_before: Array, t_before: float) -> None:
    """Let the tie's uncertainty grow by the motion that has just been predicted."""
    tie, moving = state.absolute, state.fused
    if tie is None:
        return
    x, y, _ = (moving.T_odom_base - T_before).tolist()
    way, dt = math.hypot(x, y), moving.t_mono - t_before
    both = np.empty((2, 3, 3))
    grow_tie(tie.P, tie.X, P_before, moving.P, np.array((x, y, DRIFT[0] * way, DRIFT[1] * way, DRIFT[2] * way)), both)
    tie.P, tie.X = both[0], both[1]
    tie.way += way
    tie.fresh = min(1.0, tie.fresh + way / FRESH_M + (dt / FRESH_S if math.isfinite(dt) else 0.0))
    tie.poses.append((moving.t_mono, moving.T_odom_base))
    while moving.t_mono - tie.poses[0][0] > MEMORY_S:
        tie.poses.popleft()


def on_match(state: State, T_before: Array, P_before: Array, lacked: Array) -> None:
    """Mend T_map_base by as much of the match's correction of T_odom_base as was its own error too."""
    tie, moving = state.absolute, state.fused
    if tie is None:
        return
    tie.broken |= blind(state)
    tie.t_match = moving.t_mono
    tie.scan_s = min(moving.t_mono - state.t_scan, SLOWEST_S)
    if not tie.placed:
        return
    mended = np.empty((3, 3, 3))
    mend_tie(tie.P, tie.X, lacked, P_before, moving.P, mended)
    tie.P, tie.X, share = mended[0], mended[1], mended[2]
    made = moving.T_odom_base - T_before
    made[2] = se2.wrap(made[2])
    T_map_base = se2.compose(state.T_map_odom, T_before) + se2.rotation(state.T_map_odom[2]) @ (share @ made)
    move_map(state, se2.compose(T_map_base, se2.inverse(moving.T_odom_base)))
    keep_tie(state)


def keep_tie(state: State) -> None:
    """Remember how surely the map lies in the survey: see `Absolute.kept`."""
    tie, R = state.absolute, se2.rotation(state.T_map_odom[2])
    assert tie is not None
    tie.kept = se2.compose(state.T_map_odom, state.fused.T_odom_base), R @ tie.P @ R.T


def on_lights(state: State, lights: LightsResult) -> None:
    """Take an epoch of the `lights` filter."""
    tie = state.absolute
    assert tie is not None
    assert state.light is not None
    tie.gap = None
    tie.light_s, tie.t_light = min(lights.t_mono - tie.t_light, SLOWEST_S), lights.t_mono
    if begun_anew(state, lights):
        tie.way_young = tie.way
    if lights.fix not in (Fix.GOOD, Fix.STARTING):
        return
    tie.row.take(doubt(state.light.filter.catalogue, lights.accepted), tie.way)
    in_row = tie.row.narrow(BESIDE_M)
    lights = across_the_row(tie.row.left, doubted(lights, tie.way - tie.way_young, state.light.told, in_row))
    held = holds_heading(state)
    if held:
        lights = without_heading(lights)
    T_odom_base = pose_at(state, max(lights.t_mono, lights.t_pose))
    R = se2.rotation(state.T_map_odom[2])
    P = R @ tie.P @ R.T
    off = lights.T_map_base - se2.compose(state.T_map_odom, T_odom_base)
    off[2] = se2.wrap(off[2])
    tie.gap = float(off @ invert3(P + lights.covariance + TOLERANCE) @ off) if tie.placed else None
    if not tie.placed or tie.odd_since is not None or held:  # held: what light says of the heading is not used
        tie.swing.forget()
    elif lights.fix is Fix.GOOD:
        tie.swing.take(tie.way, float(lights.T_map_base[2] - T_odom_base[2]))
    tie.apart = False
    if not tie.placed:
        follow(state, lights, T_odom_base)
        tie.gap = 0.0
    elif _contradicted(state, lights, off) or _surer(tie, lights):
        follow(state, lights, T_odom_base)
    else:
        tie.apart = _apart(tie)
        if lights.fix is Fix.GOOD and tie.odd_since is None and not (held and abs(off[2]) > ASTRAY_RAD):
            gain(state, lights, T_odom_base, off)
    if lights.fix is Fix.GOOD and tie.odd_since is None:
        tie.proved, tie.broken = True, False
        tie.way_start = state.light.filter.way_start


def on_order(state: State, command: Command) -> None:
    """What a person orders holds for light too: it looks about the given pose, or begins anew."""
    tie, T_map_base = state.absolute, command.T_map_base
    if tie is None or state.light is None or command.order is Order.REMEMBERED:
        return
    if command.order is Order.RESET:
        state.light.reset()
        tie.placed, tie.proved, tie.gap, tie.odd_since, tie.since = False, False, None, None, 0
        told_anew(tie, False)
    if T_map_base is not None and np.isfinite(T_map_base).all():
        state.light.place(T_map_base, SAID)
        state.frozen.forget()
        R = se2.rotation(state.T_map_odom[2])
        tie.P = R.T @ SAID @ R
        leave(state, np.zeros((3, 3)))
        tie.placed, tie.proved, tie.gap, tie.odd_since, tie.fresh = True, True, None, None, 0.0
        tie.broken, tie.way_start = False, state.light.filter.way_start
        told_anew(tie, False)
        keep_tie(state)


def told_anew(tie: Absolute, by_map: bool) -> None:
    """A person, or the map, has told the place: what light and pose were to each other before is no matter."""
    tie.apart, tie.by_map = False, by_map
    tie.swing.forget()


def gain(state: State, lights: LightsResult, T_odom_base: Array, off: Array) -> None:
    """Add the information that the epoch's links have added to the `lights` filter, as far as it is news.

    The links' own measurement, stripped of what the `lights` filter knew before, is ``L+ x+ - L- x-``; about the pose
    here that is ``G (x- - x) + L+ dx`` with ``G = L+ - L-`` and the correction ``dx`` that they made.
    """
    tie = state.absolute
    assert tie is not None
    R = se2.rotation(state.T_map_odom[2])
    L_lights = invert3(lights.covariance)
    most = largest_of(lights.gained, lights.covariance)
    part = min(1.0, tie.fresh / most) if most > 0.0 and not blind(state) else 1.0
    tie.fresh = max(0.0, tie.fresh - part * max(most, 0.0))  # blind, more is taken than has come fresh
    G = part * lights.gained
    told = G @ (off - lights.gained_by) + part * (L_lights @ lights.gained_by)
    if state.light is not None and not state.light.on_wheels:
        tie.P, tie.X = straighten(tie.P, tie.X)
    before = R @ tie.P @ R.T
    L_before = invert3(before)
    after = symmetric(invert3(L_before + positive_part(G)))
    keep = R.T @ after @ L_before @ R
    tie.P = R.T @ after @ R
    leave(state, keep)
    correct(state, se2.compose(state.T_map_odom, T_odom_base) + after @ told, T_odom_base)
    if np.all(np.diag(after) < KNOWN):
        if tie.since == 0 and state.atlas.kept:  # a stored map has come along for the last time
            rehang(state, 0)
        tie.since = state.next_key


def follow(state: State, lights: LightsResult, T_odom_base: Array) -> None:
    """Take the lights' pose as it is."""
    tie = state.absolute
    assert tie is not None
    state.frozen.forget()
    correct(state, lights.T_map_base, T_odom_base)
    R = se2.rotation(state.T_map_odom[2])
    tie.P = R.T @ lights.covariance @ R
    leave(state, np.zeros((3, 3)))
    tie.placed, tie.odd_since, tie.fresh, tie.by_map = True, None, 0.0, False
    keep_tie(state)


def hang_on_anchor(state: State) -> None:
    """The pose is as sure as its anchor, swung out to here, and the way since: the map has told it, not light."""
    tie, moving, P = state.absolute, state.fused, np.empty((3, 3))
    assert tie is not None
    hang(state.T_odom_anchor, moving.T_odom_base, state.P_anchor, moving.P, 0.0, P)
    tie.P, tie.X = P, moving.P.copy()
    tie.mended.clear()


def leave(state: State, keep: Array) -> None:
    """Of the tie's error, and so of what it shares with the pose's, ``keep`` (3x3, odom-aligned axes) is left."""
    tie, now = state.absolute, state.fused.t_mono
    assert tie is not None
    tie.X = keep @ tie.X
    tie.mended.append((now, keep))
    while now - tie.mended[0][0] > KEPT_S:
        tie.mended.popleft()


def correct(state: State, T_map_base: Array, T_odom_base: Array) -> None:
    """Move the map; what was laid since the pose was last known comes along, what is older stays where it is."""
    assert state.absolute is not None
    T_map_odom = se2.compose(T_map_base, se2.inverse(T_odom_base))
    shift_map(
        state, se2.compose(T_map_odom, se2.inverse(state.T_map_odom)), max(state.absolute.since, state.atlas.since)
    )
    move_map(state, T_map_odom)


def virtual(state: State) -> Virtual | None:
    """What light alone says of the place just now, as far as the map may rely on it; None where it says nothing good.

    What it does not know it must not say: a row of lamps would turn the map to and fro, so that its far end moved by
    metres between two laps; and without wheels the heading may have settled the wrong way round.
    """
    tie = state.absolute
    if tie is None or state.light is None or state.light.result.fix is not Fix.GOOD:
        return None
    wheels = state.light.told
    lights = across_the_row(tie.row.left, state.light.result)
    _, factor = doubted_covariance(lights, tie.way - tie.way_young, wheels, tie.row.narrow(BESIDE_M))
    T_odom_base = pose_at(state, max(lights.t_mono, lights.t_pose))
    T_map_base = lights.T_map_base.copy()
    if not wheels:  # the pose's heading is the better guess, by which the submap's origin is found from here
        lights = without_heading(lights)
        T_map_base[2] = se2.compose(state.T_map_odom, T_odom_base)[2]
    T_map_base = se2.compose(T_map_base, se2.between(T_odom_base, state.fused.T_odom_base))
    return Virtual(T_map_base, factor / TRUST * lights.covariance, lights.accepted)


def begun_anew(state: State, lights: LightsResult) -> bool:
    """Whether light is only just finding its place, so that gains are not known yet.

    A heading that has become vague since, as that of a robot that stands where no wheels say so, and a stretch between
    two lamps leave the gains known.
    """
    assert state.light is not None
    if lights.fix in (Fix.GOOD, Fix.HELD):
        return False
    known = lights.fix is Fix.STARTING and len(state.light.filter.tracks) == 1 and not state.light.filter.lost
    return not (known and lights.covariance[0, 0] + lights.covariance[1, 1] < KNOWN[0] + KNOWN[1])


def holds_heading(state: State) -> bool:
    """Whether the laser holds a heading that light has proved, and light has nothing as good.

    Without wheels the `lights` filter takes a robot to drive the way it faces, and its heading may settle the wrong way
    round whenever the robot is slow; the laser does not turn round.
    """
    tie = state.absolute
    assert tie is not None
    return tie.proved and not tie.broken and not blind(state) and not (state.light is not None and state.light.told)


def blind(state: State) -> bool:
    """Whether the laser has not told anything lately, though a scan was due."""
    tie = state.absolute
    assert tie is not None
    return state.fused.t_mono - tie.t_match > max(BLIND_S, BLIND_PERIODS * tie.scan_s)


def tells(state: State) -> bool:
    """Whether light has told the place and goes on telling; lamps that went out hold nobody where they once did."""
    tie, light = state.absolute, state.light
    if tie is None or light is None or not tie.placed:
        return False
    return state.fused.t_mono - light.filter.t_used <= max(SILENT_S, SILENT_PERIODS * tie.light_s)


def told_last(state: State) -> float:
    """When a link was used for the last time; -inf without a photodiode."""
    return -math.inf if state.light is None else state.light.filter.t_used


def pose_at(state: State, t_mono: float) -> Array:
    """T_odom_base at an instant of the last second, at constant twist between two predictions; the ends are held."""
    assert state.absolute is not None
    after = state.fused.t_mono, state.fused.T_odom_base
    if state.absolute.poses and state.absolute.poses[-1][0] > after[0]:  # at a late scan, the pose is taken back
        after = state.absolute.poses[-1]
        if t_mono >= after[0]:
            return after[1]
    for t, T in reversed(state.absolute.poses):
        if t <= t_mono < after[0]:
            twist = se2.log(se2.between(T, after[1]))
            return se2.compose(T, se2.exp(twist * ((t_mono - t) / (after[0] - t))))
        if t < after[0]:
            after = t, T
    return after[1] if t_mono < after[0] else state.fused.T_odom_base


def _contradicted(state: State, lights: LightsResult, off: Array) -> bool:
    """Whether light has disagreed with the pose for long enough, and by enough, to be believed.

    Light that looks, or is off by less than the laser could have lost, says nothing against a proved pose held since;
    nor does one lamp beside a row of others, seen for a moment: what the row has led astray it does not put right.
    """
    tie = state.absolute
    assert tie is not None
    if tie.gap is None or tie.gap <= SURPRISE:
        tie.odd_since = None
        return False
    tie.odd_since = lights.t_mono if tie.odd_since is None else tie.odd_since
    held = tie.proved and not tie.broken and not blind(state)
    away, turn = sure_part(off, lights.covariance)
    far = away > FAR_M or (turn > FAR_RAD and not holds_heading(state) and _elsewhere(state))
    checked = len(lights.accepted) >= CHECKED or bool(np.any(np.diag(tie.P) >= KNOWN))
    if held and not (far and lights.fix is Fix.GOOD and checked):
        tie.doubted_at = lights.t_mono
    return lights.t_mono - max(tie.odd_since, tie.doubted_at) >= SURPRISE_S


def _apart(tie: Absolute) -> bool:
    """Whether pose and light do not agree, or do and one of them is still on its way to the other.

    A pose that the map has told shares nothing with light, and they are as far apart as chance will have it.
    """
    assert tie.gap is not None
    if tie.odd_since is not None or tie.by_map:
        return tie.odd_since is not None
    return tie.gap > APART or not tie.swing.rests


def _elsewhere(state: State) -> bool:
    """Whether light has had to look for its place anew since it last agreed, or a lamp cannot be received here.

    Else it is its heading that wheels have led away, or that a row of lamps has left open: the laser holds its own, and
    nothing that is received speaks against the place.
    """
    assert state.absolute is not None
    assert state.light is not None
    if state.light.filter.way_start > state.absolute.way_start:
        return True
    return any(too_strong_at(state.light, se2.compose(state.T_map_odom, state.fused.T_odom_base)))


def _surer(tie: Absolute, lights: LightsResult) -> bool:
    """Whether the lights' pose is so much better known that nothing is lost by taking it as it is."""
    return tie.odd_since is None and det3(lights.covariance) < SURER * det3(tie.P)
