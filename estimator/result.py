"""Result types of an estimator step: pose with covariance, match, loop, links, light result, protection level."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Final

import numpy as np

from estimator.cdma.epoch import BlockFlag, PwmLight
from estimator.measurements import Job
from estimator.numerics.arrays import Array

SURPRISE: Final = 16.3
"""Squared Mahalanobis distance (99.9 % of chi-square, 3 degrees of freedom) above which two poses disagree."""


VAGUE: Final = np.diag((4.0, 4.0, 33.0))
"""Information of a pose known to 0.5 m and 10 deg: the prior in the test of a match's known axes."""

KNOWN: Final = np.sqrt((0.01, 0.01, 0.0012))
"""Sigma (m, m, rad) below which an axis counts as known: 10 cm and 2 deg."""


class Reason(Enum):
    """Reason why a match is valid or not."""

    CONVERGED = "converged"
    ITERATION_CAP = "iteration cap reached before convergence"
    OSCILLATING = "oscillates between two sets of pairs"
    TOO_FEW_POINTS = "too few valid beams"
    TOO_FEW_PAIRS = "too few beams have a correspondence in the map"
    NO_MAP = "the local map is still empty"
    REJECTED = "residual or correction implausible"
    REPEATED = "the same scan again although the robot has moved"
    MALFORMED = "not a valid scan: lengths, bearings, times, mount or noise are impossible"
    LATE = "older than the previous scan, or than the motion history"
    PASSED_OVER = "not matched: no computing time left, or paused"


@dataclass(frozen=True, slots=True, eq=False)
class MatchResult:
    """Result of matching one scan against the local map.

    Attributes:
        T_odom_base: matched pose (the prediction where ``reason`` is not a result).
        information: 3x3 Fisher information of that pose, base-centred (x, y in m, yaw in rad).
        inliers, queries: pairs used and beams tried.
        iterations: number used.
        residual_m: RMS of the inliers' point-to-line distance.
        known_axes: 3 booleans as floats (x, y, yaw) in the odom frame; 0 where this match has no information.
        correction: (dx, dy, dyaw) of the match to the prediction.
        reason: see `Reason`.
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
        """Degenerate directions (k, 3), k = 0 to 3, of this match, for any orientation of the surroundings.

        A row is a unit vector of (x, y, yaw) in the odom frame. Its units are 10 cm, 10 cm and 2 deg. A corridor at 45
        deg gives (0.71, 0.71, 0), where ``known_axes`` only shows that neither x nor y is known. A round room gives the
        rotation about its centre.
        """
        P = np.linalg.inv(self.information + VAGUE) / np.outer(KNOWN, KNOWN)
        value, vector = np.linalg.eigh(P)
        return np.asarray(vector[:, value > 1.0].T)


class LoopReason(Enum):
    """Conditions that closed a loop. The order is published: further ones go to the end."""

    NEAR = "laser: the scan fits the map where it was expected"
    SEARCHED = "laser: the scan fits the map in one place of all that were possible"
    SUPPORTED = "laser, twice: two keyframes from different places agree on it"
    LIT = "light and laser: the same lamps are seen from the same place, and the scan fits the map there"
    PLACED = "found in the whole map: the one place that fits all that was seen since the place was lost"


@dataclass(frozen=True, slots=True)
class Loop:
    """An accepted loop closure between two keyframes.

    Attributes:
        counter: loops accepted so far.
        keyframe_new: ID of the new keyframe.
        keyframe_old: ID of the first keyframe of the matched submap.
        residual_m: root mean square distance of the beams that fit.
        reason: conditions that it passed.
    """

    counter: int
    keyframe_new: int
    keyframe_old: int
    residual_m: float
    reason: LoopReason = LoopReason.NEAR


WEAK, STRONG = 3.0, 3.5
"""Sigmas below and above the expected RSS beyond which a lamp is inconsistent with the pose."""
FITS = 2.0
"""Sigmas within which an unused lamp is consistent with the pose."""


class LinkState(Enum):
    """Use of a received lamp, or the reason why it is not used."""

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
        code: as received.
        lamp_id: lamp with that code, None where that is not known.
        state: its use.
        amplitude: of the modulated photocurrent, A.
        residual: ln(received / expected), None without an expectation.
        sigma: one sigma of that residual, from all sources.
        gain, sigma_gain: ln of the lamp's power over the survey's, common part included, as estimated so far.
        contradicted: whether the lamp's own data differs from the survey (which takes precedence).
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
        """Whether it is inconsistent with the pose, see :func:`speaks_against`."""
        return speaks_against(self.state, self.residual, self.sigma)

    @property
    def waiting(self) -> bool:
        """Whether it is consistent with the pose and only waits for use, see :func:`waits`."""
        return waits(self.state, self.residual, self.sigma)


def speaks_against(state: LinkState, residual: float | None, sigma: float | None) -> bool:
    """Whether the RSS of a lamp is inconsistent with the pose.

    A lamp that only waits for use is consistent. A lamp in use may be inconsistent: a large covariance after many
    inconsistent links makes the pose no more likely.
    """
    if state not in (LinkState.ACCEPTED, LinkState.OCCLUDED) or residual is None or sigma is None:
        return state in (LinkState.OCCLUDED, LinkState.REJECTED)
    return residual < -WEAK * sigma or (state is LinkState.ACCEPTED and residual > STRONG * sigma)


def waits(state: LinkState, residual: float | None, sigma: float | None) -> bool:
    """Whether an unused lamp has the expected RSS at the pose, and so supports it.

    A lamp that was hidden is used again only after some time and path: for a robot at rest, not before it drives on.
    """
    if state is not LinkState.OCCLUDED or residual is None or sigma is None:
        return False
    return abs(residual) <= FITS * sigma


class Fix(Enum):
    """State of the position by light."""

    NONE = "no lamps in view, or too few"
    STARTING = "position known, heading and gains still being found"
    GOOD = "position and heading known"
    HELD = "carried on by odometry alone, every link is paused"
    AMBIGUOUS = "several places fit"
    LOST = "what is received contradicts the position: starting anew"


@dataclass(frozen=True, slots=True, eq=False)
class LightsResult:
    """Result of the light filter (odometry and links, never lidar) after a step: the light solution, the paper's T_1.

    Attributes:
        t_mono: instant of the latest epoch in use, `-inf` before the first.
        fix: state of the position.
        T_map_base, covariance: (x, y, yaw) and 3x3, valid unless fix is NONE or LOST; in AMBIGUOUS the most probable.
            They refer to ``t_pose``.
        links: strongest first.
        accepted: lamp IDs of the links used (the paper's S).
        gained: 3x3 information that this step's links added to the pose beyond the prediction.
        gained_by: the correction of the pose by them. The pose uses exactly these two, so that odometry never counts
            twice.
        floor: the diffuse floor as estimated.
        block: flags of the latest sample block.
        clock_ppm: of the sample clock.
        t_pose: instant of the newest record of any kind.
        bent: gain consistency: excess of the normalised squared deviation of gains and tilts, per lamp, over its usual
            and its long-term value (`model_consistency.Bent`).
        pwm: PWM-dimmed lamps in view. slow: codes of lamps that rise too slowly.
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
    pwm: tuple[PwmLight, ...] = ()
    slow: frozenset[int] = frozenset()


@dataclass(frozen=True, slots=True, eq=False)
class Virtual:
    """The paper's virtual consistent state components: the pose by light and odometry alone, without lidar or drift.

    Attributes:
        T_map_base, covariance: of the light filter, for the keyframe's instant.
        accepted: IDs of the lamps used (S).
    """

    T_map_base: Array
    covariance: Array
    accepted: frozenset[int]


@dataclass(frozen=True, slots=True)
class Protection:
    """Protection level of T_map_base at the stated risk, if the pose is the right hypothesis (`protection_level`).

    Attributes:
        horizontal_m, yaw_rad: the level.
        laser, light, wheels: solutions behind it; both of the former use odometry.
    """

    horizontal_m: float
    yaw_rad: float
    laser: bool
    light: bool
    wheels: bool


@dataclass(frozen=True, slots=True)
class Lag:
    """Time offset of scan stamps behind odometry stamps (`time_offset`), and its sigma, both in s.

    Negative: odometry is late.
    """

    lag_s: float
    sigma_s: float


class SlowError(IntEnum):
    """Lasting errors of odometry and lidar mount."""

    DISTANCE = 0  # true distance over that of odometry, less 1
    TURN = 1  # true turn over that of odometry, less 1
    DRIFT = 2  # turn per metre that odometry misses, rad/m
    MOUNT_YAW = 3  # yaw of the lidar mount less the configured one, rad
    MOUNT_Y = 4  # its y less the configured one, m


@dataclass(frozen=True, slots=True)
class SlowErrors:
    """Estimated :class:`SlowError` (`wheel_calibration`), of which one at least is beyond a sound robot's.

    Attributes:
        value, sigma: of each error, in its unit.
        large: whether it is beyond a sound robot's.
    """

    value: tuple[float, ...]
    sigma: tuple[float, ...]
    large: tuple[bool, ...]

    @property
    def wheels(self) -> bool:
        """Whether an error of odometry is large."""
        return any(self.large[: SlowError.MOUNT_YAW])

    @property
    def mount(self) -> bool:
        """Whether an error of the lidar mount is large."""
        return any(self.large[SlowError.MOUNT_YAW :])


@dataclass(frozen=True, slots=True, eq=False)
class StepResult:
    """The estimate after one `step`.

    Attributes:
        t_mono: instant of the pose (the scan's last beam, or the last record's end).
        T_odom_base: smooth pose, never jumps.
        T_map_odom: absolute correction, may jump.
        covariance: 3x3 of T_map_base (m, rad).
        velocity: (v_x, v_y, yaw rate) in the base frame.
        known_axes: (x, y, yaw) 1 known, 0 unknown, in the map frame.
        match: the scan match, None in a step without a scan.
        keyframe: ID of a keyframe created in this step, or -1.
        loop: accepted in this step, or None.
        anchor, T_anchor_base: anchor keyframe (0 is the start) and the pose relative to it. A trajectory stored as
            anchors follows every later correction of the map.
        jumps: number of changes of T_map_odom by more than 5 cm or 1 deg at once, since the start.
        lights: result of the light filter, None without a photodiode.
        placed: whether the map is aligned to the survey; before that the map frame is the start pose's.
        gap: squared Mahalanobis distance (3 degrees of freedom) of T_map_base and the light solution at the latest
            epoch. None where one is not available.
        apart: whether the two disagree, or one of them still converges (`SurveyAlignment.apart`).
        misplaced: whether most of the received lamps are impossible at T_map_base.
        anew: number of local map restarts because nothing fitted the old one: since then the pose in the map is
            unconfirmed.
        protection: protection level of T_map_base; None: unavailable.
        places: None where the pose in the map is known; else the number of hypotheses: 0 none yet, 1 one under
            confirmation.
        dead_reckoned: whether odometry alone carries the pose in the map, after a gap in which the robot may have been
            kidnapped; a search of the map has to confirm it.
        aside: whether there is an unaligned map: light gives the pose, and the search in that map continues.
        let_go: number of stored maps dropped since the start, because the robot is nowhere in them.
        lag: time offset between the stamps of scans and odometry, None while it is not certain.
        slow: lasting errors of wheels and lidar mount, None while none is large.
        jumped: sigma (rad) of the heading after a jump that wheels do not explain; ``covariance`` includes it.
        gyro: factor of the gyro's readings over the true turn, None while it is about 1.
        jobs: work for the background worker; each result returns as a record of a later step.
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
    dead_reckoned: bool = False
    aside: bool = False
    let_go: int = 0
    lag: Lag | None = None
    slow: SlowErrors | None = None
    jumped: float = 0.0
    gyro: float | None = None
    jobs: tuple[Job, ...] = ()
