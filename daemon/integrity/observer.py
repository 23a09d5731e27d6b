"""Evidence observer: derives the state machine's evidence from step result, device status and odometry of a cycle."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from daemon.health.reasons import Reason as Cause
from daemon.integrity.arrival_monitor import ODOMETRY_SILENT_S
from daemon.integrity.evidence import SILENT_PERIODS, VAGUE_M, VAGUE_RAD, Evidence, Light, Match
from daemon.integrity.motion_consistency import MotionConsistency
from estimator import (
    SURPRISE,
    Array,
    Command,
    Fix,
    LightEpoch,
    LightsResult,
    LoopReason,
    MatchResult,
    Odometry,
    Order,
    Reason,
    Record,
    SampleBlock,
    StepResult,
    se2,
)
from hal.lidar import LidarStatus, Link

ENOUGH_INLIERS: Final = 0.4
"""Smallest share of inlier beams of a good match."""
OPENING_S: Final = 10.0
"""Time in s after the start without a scan from which the lidar is unreachable, whatever its driver's status."""
LIGHT_SILENT_S: Final = 1.0
"""Time in s without samples after which they have timed out; blocks arrive twenty times a second."""
GUESS_S: Final = 0.5
"""Time in s for which the velocity predicts an axis that no measurement determines; after that it is unconfirmed."""
TELLING: Final = (LoopReason.PLACED, LoopReason.LIT)
"""Reasons of loops that determine the pose of a robot that may have been kidnapped."""
SEVERAL: Final = 3
"""Smallest number of lamps from which light can find a pose again."""
EARLY: Final = 0.01
"""Share of a scan period by which a timer may be early and still stand for the whole period."""


class Observer:
    """Derives evidence from consecutive cycles; it stores times of arrivals and when each axis was last confirmed.

    Attributes:
        unused: reason why an available lidar is skipped, set by the cycle; None: it is used.
    """

    def __init__(self, t_mono: float, odometry: bool, lidar: bool = True, lights: bool = False) -> None:
        """Start at ``t_mono``; ``odometry``, ``lidar``, ``lights``: which inputs are configured."""
        self.motion_consistency = MotionConsistency()
        self.unused: Cause | None = None
        self._lidar, self._lights = lidar, lights
        self._t_samples = t_mono
        self._jumps = 0
        self._odd = self._placed = False
        self._t_misplaced: float | None = None
        self._known = (False, False, False)
        self._t_start = t_mono
        self._odometry = odometry
        self._t_scan: float | None = None
        self._t_odometry = t_mono
        self._P_complete: Array | None = None
        self._mapped = False
        self._unreachable = False
        self._t_shown = [t_mono] * 3
        self._guessed = [False] * 3
        self._anew = 0
        self._begun = False
        self._remembered: Array | None = None

    def odometry_ok(self, t_mono: float, latest: float | None = None) -> bool | None:
        """Whether odometry is arriving; None where none is configured.

        ``latest``: arrival of the latest reading, which may still wait for a cycle.
        """
        latest = self._t_odometry if latest is None else max(self._t_odometry, latest)
        return t_mono - latest <= ODOMETRY_SILENT_S if self._odometry else None

    def silence(self, t_mono: float, period: float) -> float | None:
        """Scan periods since the last received scan; None before the first."""
        return None if self._t_scan is None else (t_mono - self._t_scan) / period

    def on_scan(self, t_rx: float) -> None:
        """Register a valid scan."""
        self._t_scan = t_rx
        self._unreachable = False

    def on_odometry(self, t_rx: float) -> None:
        """Register a valid odometry reading."""
        self._odometry = True
        self._t_odometry = t_rx

    def evidence(
        self, t_mono: float, period: float, status: LidarStatus, records: tuple[Record, ...], result: StepResult | None
    ) -> Evidence:
        """Evidence of one cycle; call it once per cycle with everything the cycle consumed."""
        for record in records:
            if isinstance(record, Odometry):
                self.motion_consistency.on_odometry(record)
            elif isinstance(record, SampleBlock | LightEpoch):
                self._t_samples = t_mono
        ordered = self._take_orders(records)
        match = self._match(result)
        if match is not None and result is not None:
            match = self._without_guesses(match, result, t_mono, ordered)
        if result is not None and result.placed:
            sigma_m, sigma_rad = _growth(result.covariance, np.zeros((3, 3)))
        else:
            sigma_m, sigma_rad = self._sigma(match, result, ordered, self.odometry_ok(t_mono))
        silence = self.silence(t_mono, period)
        late = self._t_scan is None and t_mono - self._t_start > OPENING_S
        self._unreachable |= (
            status.link is Link.WAITING or late
        )  # set until a scan arrives: one more attempt of the driver changes nothing
        return Evidence(
            t_mono=t_mono,
            silence=None if silence is None else silence + EARLY * SILENT_PERIODS,
            unreachable=self._unreachable,
            match=match,
            mapped=self._mapped,
            sigma_m=sigma_m,
            sigma_rad=sigma_rad,
            odometry=self.odometry_ok(t_mono),
            agree=self.motion_consistency.agree(),
            guessed=any(self._guessed),
            places=_places(result),
            ordered=ordered,
            lidar=self._lidar,
            light=self._light(t_mono, result) if self._lights else None,
            unused=self.unused,
            recalled=self._recalled(result),
        )

    def _take_orders(self, records: tuple[Record, ...]) -> bool:
        """Whether an operator command came; the previous run's stored pose is kept until relocalisation uses it."""
        commands = [record for record in records if isinstance(record, Command)]
        for command in commands:
            self._remembered = command.T_map_base if command.order is Order.REMEMBERED else None
        return any(command.order is not Order.REMEMBERED for command in commands)

    def _recalled(self, result: StepResult | None) -> bool:
        """Whether relocalisation has just found the pose, and it equals the stored pose of the previous run."""
        remembered = self._remembered
        if result is None or result.loop is None or result.loop.reason is not LoopReason.PLACED or remembered is None:
            return False
        from estimator import near  # the warm-up has loaded the estimator

        self._remembered = None
        T_map_base = se2.compose(result.T_map_odom, result.T_odom_base)
        return near(remembered, T_map_base)

    def _light(self, t_mono: float, result: StepResult | None) -> Light:
        """Evidence from light; in a cycle without a step it contains only the timeout and the last known axes."""
        alive = t_mono - self._t_samples <= LIGHT_SILENT_S
        if result is None or result.lights is None:
            return Light(alive, placed=self._placed, known=self._known)
        lights, gap = result.lights, result.gap
        against = result.misplaced or (_contradicts(lights) and lights.fix is not Fix.NONE)
        self._placed, self._known = result.placed, _axes(result.known_axes)
        moved = result.jumps > self._jumps and self._odd
        self._jumps = result.jumps
        self._odd = against or (gap is not None and gap > SURPRISE)
        return Light(
            alive=alive,
            used=alive and lights.fix is Fix.GOOD and bool(lights.accepted),
            fits=alive and not self._odd and gap is not None and _nearly(lights),
            placed=result.placed,
            lost=lights.fix is Fix.LOST,
            agrees=None if not alive or (gap is None and not against) else not self._odd,
            moved=moved,
            elsewhere=alive and self._elsewhere(result.misplaced, lights.t_mono),
            apart=alive and result.apart,
            known=self._known,
        )

    def _elsewhere(self, misplaced: bool, t_epoch: float) -> bool:
        """Whether two consecutive epochs have links impossible at the pose; a passing person adds no light."""
        if not misplaced:
            self._t_misplaced = None
        elif self._t_misplaced is None:
            self._t_misplaced = t_epoch
        return self._t_misplaced is not None and t_epoch > self._t_misplaced

    def _match(self, result: StepResult | None) -> Match | None:
        if result is None or result.match is None:
            return None
        found = result.match
        if found.reason is Reason.PASSED_OVER:
            return None
        self._mapped = found.reason is not Reason.NO_MAP
        if not self._mapped:
            return None
        off_m, off_rad = math.hypot(*found.correction[:2].tolist()), abs(float(found.correction[2]))
        match = Match(good(found), _axes(result.known_axes), off_m, off_rad)
        laser = (
            found.known_axes if result.placed else result.known_axes
        )  # axes that light determines are independent of the lidar
        self.motion_consistency.on_match(result.t_mono, result.T_odom_base, match.good and all(_axes(laser)))
        return match

    def _without_guesses(self, match: Match, result: StepResult, t_mono: float, ordered: bool) -> Match:
        """The match without the axes along which the map itself was extended at an unconfirmed pose.

        Without odometry, the velocity alone predicts the pose along an axis that no match determines. A keyframe
        created then stays displaced, and every later scan fits it perfectly. Such a match shows the position in the
        surroundings, not in the map. A loop closure, an operator command or light that agrees ends this condition.
        The same applies to every axis of a map that was restarted because no scan fitted the old one, unless odometry
        has carried the pose. If the robot may have been kidnapped meanwhile, a loop near the predicted pose confirms
        nothing. This ends with a pose found by a search of the whole map, or confirmed by light.
        """
        told = ordered or _lit(result)
        if told or (result.loop is not None and (not self._begun or result.loop.reason in TELLING)):
            self._guessed, self._begun = [False] * 3, False
            self._t_shown = [t_mono] * 3
        if result.anew > self._anew or (result.dead_reckoned and not told):
            kidnapped = result.dead_reckoned or result.places is not None
            self._guessed, self._begun = [kidnapped or not self.odometry_ok(t_mono)] * 3, kidnapped
        self._anew = result.anew
        for axis, known in enumerate(match.known):
            if (match.good and known) or self.odometry_ok(t_mono):
                self._t_shown[axis] = t_mono
            elif result.keyframe >= 0 and t_mono - self._t_shown[axis] > GUESS_S:
                self._guessed[axis] = True
        if not any(self._guessed):
            return match
        x, y, yaw = (known and not guess for known, guess in zip(match.known, self._guessed, strict=True))
        return replace(match, known=(x, y, yaw))

    def _sigma(
        self, match: Match | None, result: StepResult | None, ordered: bool, odometry: bool | None
    ) -> tuple[float, float]:
        """Uncertainty gained by motion that no measurement confirmed: larger axis in m, heading in rad.

        It is not the covariance itself: that of a pose in the map grows with the distance from the start, while the
        position in the surroundings stays accurate. With odometry, the growth between two complete matches is drift.
        Without odometry it is a prediction, and it stays one when later scans fit a map that was extended with it. Then
        the uncertainty ends only when the covariance itself is small again.
        """
        if result is None:
            return 0.0, 0.0
        P = result.covariance
        if self._P_complete is None or ordered or not self._mapped:
            self._P_complete = P
        sigma_m, sigma_rad = _growth(P, self._P_complete)
        sigma_rad = max(sigma_rad, result.jumped)
        complete = match is not None and match.good and all(match.known)
        if complete and (odometry or (sigma_m <= VAGUE_M and sigma_rad <= VAGUE_RAD)):
            self._P_complete = P
            return 0.0, result.jumped
        return sigma_m, sigma_rad


def _lit(result: StepResult) -> bool:
    """Whether the light solution is good and agrees with the pose."""
    agrees = result.placed and result.gap is not None and result.gap <= SURPRISE
    return agrees and result.lights is not None and result.lights.fix is Fix.GOOD


def _nearly(lights: LightsResult) -> bool:
    """Whether the light solution has not converged, but has several lamps and a position sigma below the limit."""
    spread = float(lights.covariance[0, 0] + lights.covariance[1, 1])
    return lights.fix is Fix.STARTING and len(lights.accepted) >= SEVERAL and spread < 2.0 * VAGUE_M**2


def _axes(known: Array) -> tuple[bool, bool, bool]:
    x, y, yaw = known.tolist()
    return bool(x), bool(y), bool(yaw)


def _contradicts(lights: LightsResult) -> bool:
    """Whether more received links are inconsistent with the position of the light solution than fit it."""
    fitting = len(lights.accepted) + sum(link.waiting for link in lights.links)
    return sum(link.against for link in lights.links) > fitting


def _places(result: StepResult | None) -> int | None:
    """Number of hypotheses: of relocalisation, otherwise of an ambiguous light solution before the map is aligned."""
    if result is not None and result.places is not None:
        return result.places
    if result is None or result.lights is None or result.placed:
        return None
    return 2 if result.lights.fix is Fix.AMBIGUOUS else None


def _growth(P: Array, before: Array) -> tuple[float, float]:
    """One-sigma of the growth of a 3x3 covariance: larger axis in m, heading in rad."""
    (xx, xy, _), (_, yy, _), (_, _, tt) = (P - before).tolist()
    largest = 0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy)
    return math.sqrt(max(0.0, largest)), math.sqrt(max(0.0, tt))


def good(match: MatchResult) -> bool:
    """Whether a match is valid, finite, and has enough inliers."""
    finite = all(map(math.isfinite, match.T_odom_base.tolist()))
    return match.ok and match.inliers >= ENOUGH_INLIERS * match.queries and finite
