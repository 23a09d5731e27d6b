"""State and settings of the light filter; the equations are in state_vector.py and measurement_update.py."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol

import numpy as np

from estimator.light_filter.collinear_lamps import Under
from estimator.light_filter.lambertian import LAMP_COLUMNS
from estimator.light_filter.lamp_catalogue import Catalogue
from estimator.light_filter.model_consistency import Bent
from estimator.light_filter.state_vector import FIRST, OWN, SIZE, SLOTS
from estimator.light_filter.survey import Survey
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.pose_history import PoseHistory
from estimator.result import LightsResult

SILENT_S = 0.5
"""Time (s) without usable light after which light carries no information about the present pose. One epoch may be
lost.
"""

TRAIL_S = 1.0
"""Length of the history of dead-reckoned poses, s."""


class Pause(Enum):
    """When light is not used at all."""

    LINK = "each link for itself; as a whole only when none is left"
    PAPER = "as a whole as soon as fewer than Link_n links are clear, the Link_n strongest being used"


class Corrections(Protocol):
    """Residual map: error of the lamp model for a lamp at a position (walls, shape of the luminaire)."""

    def at(self, lamp_ids: Sequence[int], T_map_base: Array) -> Array:
        """Value to be added to ln of the expected RSS.

        Returns:
            One row per lamp: mean and sigma of ln RSS, gradient of the mean along x and y (1/m). Sigma is negative for
            a lamp that is not in the map.
        """


@dataclass(frozen=True, slots=True)
class MotionErrors:
    """One-sigma errors of odometry, gyro and constant velocity; random parts grow with the root of path, turn or time.

    Attributes:
        slip, side: m per root metre, along and across. turn: rad per root radian. wander: rad per root metre.
        skid: m per root radian turned: the centre of rotation is known to centimetres only.
        idle_m, idle_rad: per root second.
        scale, turn_scale: constant relative error of path length and turn by odometry. curve: rad per metre.
        gyro: rad per root second. gyro_bias: rad/s.
        acceleration, angular: m/s and rad/s per root second, without odometry. sideways: speed across, m/s.
        speed: sigma of the speed of a robot without odometry, m/s.
    """

    slip: float = 0.009
    side: float = 0.004
    turn: float = 0.02
    wander: float = 0.015
    skid: float = 0.02
    idle_m: float = 0.0005
    idle_rad: float = 0.0005
    scale: float = 0.04
    turn_scale: float = 0.03
    curve: float = 0.05
    gyro: float = 0.001
    gyro_bias: float = 0.02
    acceleration: float = 0.4
    angular: float = 0.3
    sideways: float = 0.03
    speed: float = 0.5


@dataclass(frozen=True, slots=True)
class ModelErrors:
    """One-sigma errors of the optical model.

    Attributes:
        ln: of any link (walls, shape of the luminaire). floor: share of the diffuse part that varies with position.
        lean: tilt of a lamp beyond the survey, m/m. white: ln, independent from epoch to epoch (stamps, decoder).
        edge: ln at the edge of the field of view, falling off inward with the fourth power.
        order: of the receiver's Lambert order.
        fade_m, fade_s: path length and time over which model errors decorrelate.
        common: ln gain common to all lamps, at the start. floor_ln: ln of the diffuse floor. tilt: receiver, m/m.
        gain_m, common_m, floor_m: random walk of the lamps' gains, the common gain and the diffuse floor, ln per root
            metre.
    """

    ln: float = 0.02
    floor: float = 0.5
    lean: float = 0.05
    white: float = 0.005
    edge: float = 0.06
    order: float = 0.1
    fade_m: float = 2.0
    fade_s: float = 600.0
    common: float = 0.25
    floor_ln: float = 0.5
    tilt: float = 0.005
    gain_m: float = 0.003
    common_m: float = 0.003
    floor_m: float = 0.02


@dataclass(frozen=True, slots=True)
class LightsSettings:
    """Settings of the light filter, the same for every building and robot; the survey holds what differs.

    Attributes:
        link_n: number of the strongest links that are used, 0 for all. pause: see :class:`Pause`.
        wait_s, wait_m: time and path length for which a link stays paused after it fits again.
        rim_rad: links closer to the edge of the field of view are not used. faint: minimum RSS in sigmas.
        headings: hypotheses per position at a start. decided: probability of one hypothesis that ends a start.
    """

    motion: MotionErrors = field(default_factory=MotionErrors)
    model: ModelErrors = field(default_factory=ModelErrors)
    link_n: int = 0
    pause: Pause = Pause.LINK
    wait_s: float = 0.5
    wait_m: float = 0.15
    rim_rad: float = 0.14
    faint: float = 5.0
    headings: int = 8
    decided: float = 0.99


@dataclass(slots=True)
class Watch:
    """Consistency record of one lamp's links.

    Attributes:
        t_bad, way_bad: time and path length of the last inconsistent link.
        t_run, way_run: start of this run of inconsistent links, inf if there is none.
        count, total, square: of the residuals in the run. strikes: number of times its gain was learned again.
        moved: it is not at its surveyed position, and is not used. paroles: number of times that was revoked.
        fitted: path length over which it fitted, m, as far as it still counts. way_seen: path length at the last
            comparison.
    """

    t_bad: float = -math.inf
    way_bad: float = -math.inf
    t_run: float = math.inf
    way_run: float = math.inf
    count: int = 0
    total: float = 0.0
    square: float = 0.0
    strikes: int = 0
    moved: bool = False
    paroles: int = 0
    fitted: float = 0.0
    way_seen: float = -math.inf


@dataclass(slots=True, eq=False)
class Track:
    """One light hypothesis: state with covariance, and the lamps in its slots.

    Attributes:
        x, P: (SIZE,) and (SIZE, SIZE). used: slots in use. lamps: (SLOTS, 7) for the kernels. slots: by lamp ID.
        seen: (SLOTS,) instant at which each was last received. weight: ln of its likelihood so far.
        watches: by lamp ID.
    """

    x: Array = field(default_factory=lambda: np.zeros(SIZE))
    P: Array = field(default_factory=lambda: np.zeros((SIZE, SIZE)))
    used: int = 0
    lamps: Array = field(default_factory=lambda: np.zeros((SLOTS, LAMP_COLUMNS)))
    slots: dict[int, int] = field(default_factory=dict)
    seen: Array = field(default_factory=lambda: np.full(SLOTS, -math.inf))
    weight: float = 0.0
    watches: dict[int, Watch] = field(default_factory=dict)

    @property
    def n(self) -> int:
        """Number of state elements in use."""
        return FIRST + OWN * self.used


@dataclass(slots=True, eq=False)
class Course:
    """Motion of the robot, common to all hypotheses.

    Attributes:
        t_mono: instant of the hypotheses' poses. t_odometry: end of the latest odometry. t_gyro: of the latest gyro.
        wheels: odometry is available. matched: its latest source was scan matches, not wheels.
        velocity: (v_x, v_y, yaw rate) by odometry and gyro. ahead: motion already applied beyond the last odometry.
        gyro_turned, gyro_span: gyro angle (rad) and time (s) summed since the last odometry.
        T, trail: dead-reckoned pose since the start, and its last second.
        way: path length, m.
    """

    t_mono: float = -math.inf
    t_odometry: float = -math.inf
    t_gyro: float = -math.inf
    wheels: bool = False
    matched: bool = False
    velocity: Array = field(default_factory=lambda: np.zeros(3))
    ahead: Array = field(default_factory=se2.identity)
    gyro_turned: float = 0.0
    gyro_span: float = 0.0
    T: Array = field(default_factory=se2.identity)
    trail: PoseHistory = field(default_factory=lambda: PoseHistory(TRAIL_S, first=True))
    way: float = 0.0


@dataclass(slots=True, eq=False)
class Lights:
    """State of the light filter; created by `light_filter.new_lights`, changed only by the functions of that module.

    Attributes:
        tracks: hypotheses, likeliest first; one when the pose is decided, none before a start.
        gains: by lamp ID, means and variances of (ln gain, tilt x, tilt y) of lamps that have left the slots.
        t_epoch, way_epoch: of the latest epoch. t_used: when a link was last used. way_start: path length at the start.
        t_lost: since when most links are inconsistent, inf if they are not.
        t_odd: since when several links are stronger than possible, which no obstacle explains. way_odd: path length
            then.
        under: collinearity of the lamps in use.
        absent: by lamp ID, (instant, path length) since which it should be received but is not.
        corrections: residual map, or None. lean: tilt of the ground under the robot, from an IMU.
        lost: inconsistent links caused the last start.
        before: sensor states of an earlier run, for the first hypothesis. recalled: its lamp gains, as ``gains``.
        bent: gain consistency (`gain_memory.bend`).
    """

    survey: Survey
    settings: LightsSettings
    catalogue: Catalogue
    course: Course = field(default_factory=Course)
    tracks: list[Track] = field(default_factory=list)
    gains: dict[int, tuple[Array, Array]] = field(default_factory=dict)
    t_epoch: float = -math.inf
    way_epoch: float = 0.0
    t_used: float = -math.inf
    way_start: float = 0.0
    t_lost: float = math.inf
    t_odd: float = math.inf
    way_odd: float = -math.inf
    under: Under = field(default_factory=Under)
    absent: dict[int, tuple[float, float]] = field(default_factory=dict)
    corrections: Corrections | None = None
    lean: tuple[float, float] = (0.0, 0.0)
    lost: bool = False
    before: Track | None = None
    recalled: dict[int, tuple[Array, Array]] = field(default_factory=dict)
    bent: Bent = field(default_factory=Bent)
    result: LightsResult | None = None
