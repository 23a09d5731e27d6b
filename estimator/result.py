"""What `step` returns: a pose never comes without what is known about it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np

from estimator.cdma.epoch import BlockFlag
from estimator.measurements import Job
from estimator.numerics.arrays import Array

SURPRISE: Final = 16.3
"""Squared Mahalanobis distance (3 degrees of freedom, 99.9 %) beyond which the pose and the lights' do not agree."""


VAGUE: Final = np.diag((4.0, 4.0, 33.0))
"""Information of a pose known to 0.5 m and 10 deg: what a match starts from when it is asked which axes it knows."""

KNOWN: Final = np.sqrt((0.01, 0.01, 0.0012))
"""Deviations (m, m, rad) below which an axis counts as known: 10 cm and 2 deg."""


class Reason(Enum):
    """Why a match is, or is not, a result."""

    CONVERGED = "converged"
    ITERATION_CAP = "iteration cap reached before convergence"
    OSCILLATING = "oscillates between two sets of pairs"
    TOO_FEW_POINTS = "too few valid beams"
    TOO_FEW_PAIRS = "too few beams found a partner in the map"
    NO_MAP = "nothing to match against yet"
    REJECTED = "residual or correction implausible"
    MALFORMED = "not a scan: lengths, bearings, times, mount or noise cannot be those of a sweep"
    LATE = "older than the scan before it, or than the way that is remembered"
    PASSED_OVER = "not matched: no time for it, or a person has said pause"


@dataclass(frozen=True, slots=True, eq=False)
class MatchResult:
    """Outcome of matching one scan against the local map.

    Attributes:
        T_odom_base: matched pose (the prediction where ``reason`` is not a result).
        information: 3x3 Fisher information of that pose, base-centred (x, y in m, yaw in rad).
        inliers, queries: pairs used and beams tried.
        iterations: used. residual_m: RMS of the inliers' point-to-line distance.
        known_axes: 3 booleans as floats (x, y, yaw) in the odom frame; 0 where this match says nothing.
        correction: (dx, dy, dyaw) by which the match moved the prediction.
    """

    T_odom_base: Array
    information: Array
    inliers: int
    queries: int
    iterations: int
    residual_m: float
    known_axes: Array
    correction: Array
    reason: Reason

    @property
    def ok(self) -> bool:
        """Whether the pose may be used."""
        return self.reason in (Reason.CONVERGED, Reason.ITERATION_CAP)

    def blind_directions(self) -> Array:
        """Directions (k, 3), k = 0 to 3, of which this match says nothing, whatever way the surroundings are turned.

        A row is a unit vector of (x, y, yaw) in the odom frame, with the three in units of 10 cm, 10 cm and 2 deg: a
        corridor at 45 deg gives (0.71, 0.71, 0), where ``known_axes`` can only say that neither x nor y is known; a
        round room gives the turn about its middle.
        """
        P = np.linalg.inv(self.information + VAGUE) / np.outer(KNOWN, KNOWN)
        value, vector = np.linalg.eigh(P)
        return np.asarray(vector[:, value > 1.0].T)


class LoopReason(Enum):
    """Which witnesses and conditions closed a loop. The order is published: further ones go to the end."""

    NEAR = "laser: the scan fits the map where it was expected"
    SEARCHED = "laser: the scan fits the map in one place of all that were possible"
    SUPPORTED = "laser, twice: two keyframes from different places agree on it"
    LIT = "light and laser: the same lamps are seen from the same place, and the scan fits the map there"
    PLACED = "found in the whole map: the one place that fits all that was seen since the place was lost"


@dataclass(frozen=True, slots=True)
class Loop:
    """An accepted loop closure between two keyframes.

    Attributes:
        counter: loops accepted so far. keyframe_new, keyframe_old: the latter begins the submap that was found.
        residual_m: root mean square distance of the beams that fit. reason: what closed it.
    """

    counter: int
    keyframe_new: int
    keyframe_old: int
    residual_m: float
    reason: LoopReason = LoopReason.NEAR


WEAK, STRONG = 3.0, 3.5
"""Deviations below and above which a lamp is too weak, or too strong, for the place."""
FITS = 2.0
"""Deviations within which one that is not used fits the place."""


class LinkState(Enum):
    """What one received lamp is used for, or why it is not."""

    ACCEPTED = "used"
    OCCLUDED = "weaker than it can be here: something stands in its way"
    REJECTED = "stronger than it can be here, or from the wrong place: moved, exchanged, or its code in use twice"
    RIM = "at the edge of the receiver's field of view"
    FAINT = "not above the noise"
    TWIN = "two lamps of this code are in view"
    UNSURVEYED = "no lamp of this code is known"
    PAUSED = "clear, but not among those that are used (Link_n)"
    MISSING = "should be received here and has not been for a while: dead, switched off, or covered for good"


@dataclass(frozen=True, slots=True)
class Link:
    """One lamp in view, or one that should be.

    Attributes:
        code: as received. lamp_id: which lamp of that code, None where that is not known.
        amplitude: of the modulated photocurrent, A. residual: ln(received / expected), None without an expectation.
        sigma: one sigma of that residual, of everything. gain, sigma_gain: ln of the lamp's power against the
            survey's, common part included, as estimated so far. contradicted: what the lamp says of itself differs
            from the survey (which wins).
    """

    code: int
    lamp_id: int | None
    state: LinkState
    amplitude: float
    residual: float | None = None
    sigma: float | None = None
    gain: float = 0.0
    sigma_gain: float = 0.0
    contradicted: bool = False

    @property
    def against(self) -> bool:
        """Whether it speaks against the place, see :func:`speaks_against`."""
        return speaks_against(self.state, self.residual, self.sigma)

    @property
    def waiting(self) -> bool:
        """Whether it fits the place and only waits to be used again, see :func:`waits`."""
        return waits(self.state, self.residual, self.sigma)


def speaks_against(state: LinkState, residual: float | None, sigma: float | None) -> bool:
    """Whether what is received of a lamp speaks against the place.

    One that only waits to be used again does not. One that is used may: a place that has become vague because nothing
    fitted it is no more likely than before.
    """
    if state not in (LinkState.ACCEPTED, LinkState.OCCLUDED) or residual is None or sigma is None:
        return state in (LinkState.OCCLUDED, LinkState.REJECTED)
    return residual < -WEAK * sigma or (state is LinkState.ACCEPTED and residual > STRONG * sigma)


def waits(state: LinkState, residual: float | None, sigma: float | None) -> bool:
    """Whether a lamp that is not used is received as it should be at the place, and so speaks for it.

    One that was hidden is used again only after a while and some way: if the robot stands, not before it drives on.
    """
    if state is not LinkState.OCCLUDED or residual is None or sigma is None:
        return False
    return abs(residual) <= FITS * sigma


class Fix(Enum):
    """How far the position from light has come."""

    NONE = "no lamps in view, or too few"
    STARTING = "position known, heading and gains still being found"
    GOOD = "position and heading known"
    HELD = "carried on by odometry alone, every link is paused"
    AMBIGUOUS = "several places fit"
    LOST = "what is received contradicts the position: starting anew"


@dataclass(frozen=True, slots=True, eq=False)
class LightsResult:
    """The `lights` filter (odometry and links, never laser) after a step: the independent witness and the paper's T_1.

    Attributes:
        t_mono: instant of the latest epoch taken in, `-inf` before the first.
        T_map_base, covariance: (x, y, yaw) and 3x3, meaningful unless fix is NONE or LOST; in AMBIGUOUS the likeliest.
            True for ``t_pose``, which is the instant of the newest record of any kind.
        links: strongest first. accepted: lamp IDs of the links used (the paper's S).
        gained: 3x3 information that this step's links added to the pose beyond the prediction, and ``gained_by``: the
            pose's correction they made; the pose takes exactly this, so that odometry is never counted twice.
        floor: the diffuse part as estimated. block: flags of the latest sample block. clock_ppm: of the sample clock.
        bent: how much farther than usual, and than they have long been, lamps are taken for others than was expected;
            deviations squared, of a lamp (`model_consistency.Bent`).
    """

    t_mono: float
    fix: Fix
    T_map_base: Array
    covariance: Array
    links: tuple[Link, ...]
    accepted: frozenset[int]
    gained: Array
    gained_by: Array
    floor: float = 0.0
    block: BlockFlag = BlockFlag.NONE
    clock_ppm: float | None = None
    t_pose: float = -math.inf
    bent: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Virtual:
    """The paper's virtual consistent state components: what light alone said of the place, free of laser and drift.

    Attributes:
        T_map_base, covariance: of the `lights` filter, for the keyframe's instant. accepted: IDs of the lamps used (S).
    """

    T_map_base: Array
    covariance: Array
    accepted: frozenset[int]


@dataclass(frozen=True, slots=True)
class Protection:
    """Bound on the error of T_map_base at the stated risk, if the place is not in doubt (`protection_level`).

    Attributes:
        horizontal_m, yaw_rad: the bounds. laser, light, wheels: what they rest on; the wheels are shared by both.
    """

    horizontal_m: float
    yaw_rad: float
    laser: bool
    light: bool
    wheels: bool


@dataclass(frozen=True, slots=True)
class Lag:
    """By how much scans are stamped later than the wheels' readings (`time_offset`); one sigma. Both in s.

    Negative: the wheels are late.
    """

    lag_s: float
    sigma_s: float


@dataclass(frozen=True, slots=True, eq=False)
class StepResult:
    """The estimate after one `step`.

    Attributes:
        t_mono: the instant the pose is true for (the scan's last beam, or the last record's end).
        T_odom_base: smooth pose, never jumps. T_map_odom: absolute correction, may jump.
        covariance: 3x3 of T_map_base (m, rad).
        velocity: (v_x, v_y, yaw rate) in the base frame.
        known_axes: (x, y, yaw) 1 known, 0 unknown, in the map frame.
        match: the scan match, None in a step without a scan.
        keyframe: ID of a keyframe laid in this step, or -1. loop: accepted in this step, or None.
        anchor, T_anchor_base: keyframe this pose hangs on and the pose relative to it (0 is the start), so that a
            trajectory kept as anchors follows every later correction of the map.
        jumps: how often T_map_odom moved by more than 5 cm or 1 deg at once, since the start.
        lights: of the `lights` filter, None where there is no photodiode. placed: light has told where the map lies;
            before that the map frame is the start pose's. gap: squared Mahalanobis distance (3 degrees of freedom)
            between T_map_base and the lights' own at the latest epoch, None where that cannot be said.
        apart: the two do not agree, or one of them is still on its way (`SurveyAlignment.apart`).
        misplaced: most of the lamps that are received cannot be received at T_map_base.
        anew: how often the local map has been begun anew because nothing fitted the old one: since then the place in
            the map is a guess.
        protection: bound on the error of T_map_base; None: none can be given.
        places: None where the place in the map is known; else how many places of it fit all that was seen: 0 none yet,
            1 one that is being confirmed.
        aside: a stored map is set aside: light tells the place, and in that map it is still looked for. let_go: how
            many stored maps were let go of since the start, because the robot is nowhere in them: the map is another.
        lag: between the stamps of scans and wheels, None where none is beyond doubt.
        jobs: work for the background worker; each answer comes back as a record of a later step.
    """

    t_mono: float
    T_odom_base: Array
    T_map_odom: Array
    covariance: Array
    velocity: Array
    known_axes: Array
    match: MatchResult | None
    keyframe: int
    loop: Loop | None
    anchor: int
    T_anchor_base: Array
    jumps: int
    lights: LightsResult | None = None
    placed: bool = False
    gap: float | None = None
    apart: bool = False
    misplaced: bool = False
    anew: int = 0
    protection: Protection | None = None
    places: int | None = None
    aside: bool = False
    let_go: int = 0
    lag: Lag | None = None
    jobs: tuple[Job, ...] = ()
