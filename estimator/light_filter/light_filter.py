"""Light filter: EKF of odometry and links for pose, lamp gains and sensor errors (Eq. 5-7).

    predict -> (start) -> associate links -> linearise -> gate -> update -> decide -> result

It never uses the lidar's position. As an independent solution it gives the paper's T_1 and virtual consistent
components. Equations are in lambertian.py (1, 2, 7), state_vector.py and measurement_update.py (5-7). docs/lights.md
links equations and code.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from estimator.cdma.epoch import UNUSABLE, BlockFlag, LightEpoch
from estimator.light_filter import collinear_lamps, iterated_update, measurement_update, motion_update, state_vector
from estimator.light_filter.filter_state import Corrections, Lights, LightsSettings, Pause, Track
from estimator.light_filter.gain_memory import bend, fresh_gains
from estimator.light_filter.initialisation import Place, begin, decide, headings, mixture, new_track, places, rule_out
from estimator.light_filter.lamp_catalogue import catalogue_of
from estimator.light_filter.link_association import Learned, Sight, absent, sights
from estimator.light_filter.link_gating import distrust, forget, judge, relearn, table, view_of
from estimator.light_filter.model_consistency import Bent
from estimator.light_filter.survey import Survey
from estimator.measurements import Imu, Odometry
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import invert3, positive_part
from estimator.result import Fix, LightsResult, Link, LinkState, speaks_against, waits

__all__ = [
    "Lights",
    "LightsSettings",
    "Pause",
    "carry_to",
    "lean",
    "move",
    "new_lights",
    "place",
    "predict",
    "reset",
    "result",
    "update",
]

HELD_S = 1.0
"""Time (s) without a used link after which the pose is predicted only (`Fix.HELD`)."""
LOST_S = 2.0
LOST_SHARE = 0.5
"""A new start is tried if more than this share of the links is inconsistent for `LOST_S` (s)."""
ODD_S, ODD_SHARE = 0.15, 0.4
"""The pose is rejected if two links, and more than this share, are stronger than possible for `ODD_S` (s)."""
PROOF_M = 3.0
"""Path length (m) without inconsistency that confirms a new pose."""
DRIFTED_M = 0.7
"""Position sigma (m) above which the filter restarts instead of updating: the model is too nonlinear there."""
ANEW_M = 0.02
"""Path length (m) over which RSS brings new information about the heading. A robot at rest, or turning on the spot,
repeats its measurements. It sways, and errors of a percent would reject the right heading within a second. Without
odometry only motion faster than a crawl counts as path, and that is new information.
"""


def new_lights(
    survey: Survey, settings: LightsSettings | None = None, corrections: Corrections | None = None
) -> Lights:
    """Light filter without any light yet.

    Args:
        survey: lamps and receiver; without lamps in it, they have to describe themselves.
        settings: one set for every building.
        corrections: residual map of this building, or None.

    Raises:
        ValueError: the survey is impossible.
    """
    return Lights(survey, settings or LightsSettings(), catalogue_of(survey), corrections=corrections)


def predict(lights: Lights, record: Odometry | Imu) -> None:
    """Predict with odometry or gyro; a reading that is not finite, or is out of order, is ignored."""
    if not (math.isfinite(record.t_begin) and math.isfinite(record.t_end)):
        return
    if isinstance(record, Odometry):
        motion_update.on_odometry(lights, record)
    else:
        motion_update.on_imu(lights, record)


def move(lights: Lights, record: Odometry, velocity: Array) -> None:
    """Predict with lidar odometry, where there are no wheels; not while the lamps in use are collinear.

    Args:
        lights: state of the filter.
        record: motion between the last two scans.
        velocity: (v_x, v_y, yaw rate) at its end.
    """
    if in_a_row(lights, record.t_end):
        left_alone(lights)
    else:
        motion_update.on_odometry(lights, record, velocity)


def left_alone(lights: Lights) -> None:
    """End the lidar odometry: from now on the velocity is estimated."""
    if lights.course.wheels and lights.course.matched:
        motion_update.release(lights)


def in_a_row(lights: Lights, t_mono: float) -> bool:
    """Whether the lamps in use have been collinear long enough for lidar odometry to be harmful.

    The distance from the line and the heading have the same error in every epoch. With precise odometry it would soon
    seem certain. Lamps that are no longer received do not count. A robot that turns on the spot still has its position
    from the earlier lamps, and needs the measured turn.
    """
    under = lights.under
    return under.lasts(t_mono) and under.far >= collinear_lamps.LASTING_M and t_mono - lights.t_used < HELD_S


def carry_to(lights: Lights, t_mono: float) -> None:
    """Extrapolate the pose to an instant at the present velocity; an earlier instant changes nothing."""
    if math.isfinite(t_mono):
        motion_update.carry_to(lights, t_mono)


def lean(lights: Lights, slope_x: float, slope_y: float) -> None:
    """Set the present tilt of the robot, measured by an IMU from gravity, relative to that at calibration.

    Args:
        lights: state of the filter.
        slope_x: of the receiver's axis in base_link, as in `survey.Receiver`.
        slope_y: the same, to the left.
    """
    if math.isfinite(slope_x) and math.isfinite(slope_y):
        lights.lean = (slope_x, slope_y)


def place(lights: Lights, T_map_base: Array, covariance: Array) -> None:
    """Set the pose (operator pose): a single hypothesis there; gains and sensor states are kept.

    Args:
        lights: state of the filter.
        T_map_base: (x, y, yaw).
        covariance: 3x3; m^2, rad^2.
    """
    if not (np.isfinite(T_map_base).all() and np.isfinite(covariance).all()):
        return
    old = lights.tracks[0] if lights.tracks else lights.before
    keep_gains(lights)
    zeros = np.zeros((state_vector.SIZE, state_vector.SIZE))
    lights.tracks = [new_track(lights, np.asarray(T_map_base), np.asarray(covariance), old, zeros)]
    lights.t_lost, lights.t_odd, lights.under, lights.lost = math.inf, math.inf, collinear_lamps.Under(told=True), False
    lights.bent = Bent()


def reset(lights: Lights) -> None:
    """Clear the pose and everything learned about lamps; lamps that described themselves stay in the catalogue."""
    lights.tracks, lights.gains, lights.absent, lights.before = [], {}, {}, None
    lights.recalled, lights.bent = {}, Bent()
    lights.t_lost, lights.t_odd, lights.under, lights.lost, lights.result = (
        math.inf,
        math.inf,
        collinear_lamps.Under(),
        False,
        None,
    )


def update(lights: Lights, epoch: LightEpoch) -> LightsResult:
    """Update with an epoch of light, on time or late (up to a second), and return the result.

    Args:
        lights: state of the filter.
        epoch: decoded light. One without a usable block brings no links.
    """
    middle = 0.5 * (epoch.t_begin + epoch.t_end)
    if not math.isfinite(middle):
        return result(lights)
    carry_to(lights, middle)
    usable = not epoch.block & UNUSABLE and len(epoch.ids) > 0
    seen: list[Sight] = []
    gained, gained_by = np.zeros((3, 3)), np.zeros(3)
    if usable:
        look_around(lights, epoch)
        single = len(lights.tracks) == 1
        before = (lights.tracks[0].x[:3].copy(), lights.tracks[0].P[:3, :3].copy()) if single else None
        seen = take_in(lights, epoch, middle)
        if before is not None and lights.tracks:
            gained, gained_by = gain(before, lights.tracks[0])
        follow_up(lights, epoch, seen)
    if not lights.tracks:
        seen = sights(lights, epoch, 0.0, 0.0) if usable else []
    lights.t_epoch = max(lights.t_epoch, epoch.t_end)
    forget(lights)
    best = lights.tracks[0] if lights.tracks else None
    learned = Learned(best)
    bend(lights, [sight for sight in seen if sight.state is LinkState.ACCEPTED])
    lights.result = describe(lights, [sight.link(learned) for sight in seen], epoch, (gained, gained_by))
    return lights.result


def result(lights: Lights) -> LightsResult:
    """Present result: the latest links, with the pose predicted since."""
    if lights.result is None:
        return describe(lights, [], None)
    fresh = describe(lights, list(lights.result.links), None)
    old = lights.result
    return replace(fresh, accepted=old.accepted, block=old.block, clock_ppm=old.clock_ppm, pwm=old.pwm, slow=old.slow)


def look_around(lights: Lights, epoch: LightEpoch) -> None:
    """Start where there is no hypothesis; restart where the covariance of all is too large."""
    yaws, sigma = headings(lights.settings.headings)
    if lights.tracks:
        if min(float(track.P[0, 0] + track.P[1, 1]) for track in lights.tracks) < DRIFTED_M**2:
            return
        track = lights.tracks[0]
        if len(lights.tracks) == 1 and track.P[2, 2] < 0.35**2:
            yaws, sigma = np.array((float(track.x[2]),)), math.sqrt(float(track.P[2, 2])) + 0.05
    found = places(lights, epoch)
    if lights.tracks:
        found = [place for place in found if fits_prior(lights.tracks[0], place)] or found
    if found:
        keep_gains(lights)
        begin(lights, found, yaws, sigma)
        lights.way_epoch = lights.course.way


def fits_prior(track: Track, place: Place) -> bool:
    """Whether a position lies within four sigmas of a hypothesis."""
    spread = math.sqrt(float(track.P[0, 0] + track.P[1, 1])) + 0.5
    return math.hypot(place.x - float(track.x[0]), place.y - float(track.x[1])) < 4.0 * spread


def keep_gains(lights: Lights) -> None:
    """Store the lamp gains of the hypothesis for later ones, if its pose is certain."""
    lights.gains.update(fresh_gains(lights))


def take_in(lights: Lights, epoch: LightEpoch, middle: float) -> list[Sight]:
    """Update every hypothesis with the links of an epoch; returns the links as the likeliest one sees them."""
    back = motion_update.back_to(lights, middle)
    way, dt = lights.course.way - lights.way_epoch, middle - lights.t_epoch
    lights.way_epoch = lights.course.way
    news = min(way / ANEW_M, 1.0) if lights.course.wheels else float(way > 0.0)
    views: list[tuple[Track, list[Sight]]] = []
    likeliest = lights.tracks[:1]
    for track in lights.tracks:
        if len(lights.tracks) > 1:  # with one left the heading is known, and robots do reverse
            motion_update.face_forward(lights, track)
        age(lights, track, way, dt)
        if len(lights.tracks) == 1 and lights.result is not None:
            narrow, angle = collinear_lamps.shape(lights.catalogue, lights.result.accepted)
            if collinear_lamps.several(lights.catalogue, lights.result.accepted):
                lights.under.take(middle, narrow, lights.course.T[:2], track.P[:3, :3])
            if lights.course.wheels and lights.under.lasts(middle) and middle - lights.t_used < HELD_S:
                collinear_lamps.loosen(narrow, angle, track.P, lights.under.least(angle))
        seen = sights(lights, epoch, float(track.x[0]), float(track.x[1]))
        likelihood = absorb(lights, track, seen, view_of(lights, back), news)
        track.weight += likelihood * news
        views.append((track, seen))
    if len(lights.tracks) > 1:
        rule_out(lights, epoch)
    if len(lights.tracks) > 1:
        decide(lights)
    if lights.tracks[:1] != likeliest:
        lights.bent.elsewhere()
    return next((seen for track, seen in views if lights.tracks and track is lights.tracks[0]), [])


def age(lights: Lights, track: Track, way: float, dt: float) -> None:
    """Process noise and decay of the slow states over a path length (m) and time (s).

    Model errors decorrelate; gains, diffuse floor and sensor errors wander.
    """
    model, n = lights.settings.model, track.n
    dt = min(max(dt, 0.0), 1e6) if math.isfinite(dt) else 0.0
    keep, grow = np.ones(n), np.zeros(n)
    fade = math.exp(-way / model.fade_m - dt / model.fade_s)
    errors = slice(state_vector.FIRST + state_vector.ERROR, n, state_vector.OWN)
    keep[errors], grow[errors] = fade, 1.0 - fade * fade
    grow[state_vector.FIRST : n : state_vector.OWN] = model.gain_m**2 * way
    grow[state_vector.COMMON], grow[state_vector.FLOOR] = model.common_m**2 * way, model.floor_m**2 * way
    grow[state_vector.GYRO] = 1e-8 * min(dt, 10.0)
    state_vector.fade(track.x, track.P, n, keep, grow)


def absorb(lights: Lights, track: Track, seen: list[Sight], view: Array, news: float) -> float:
    """Update one hypothesis with the links; returns ln of their likelihood."""
    kept, links = table(lights, track, seen)
    if not kept:
        return 0.0
    out = np.zeros((len(kept), measurement_update.OUT_COLUMNS))
    measurement_update.linearise(track.x, track.P, links, track.lamps, view, out)
    likelihood = judge(lights, track, kept, out, news)
    compared, alone = iterated_update.Seen(links, track.lamps, view), len(lights.tracks) == 1
    return likelihood + iterated_update.take_in(track.x, track.P, track.n, compared, out, bounded=alone)


def gain(before: tuple[Array, Array], track: Track) -> tuple[Array, Array]:
    """Information that links added to the pose (positive part only), and the correction they made."""
    x, P = before
    more = invert3(np.ascontiguousarray(track.P[:3, :3])) - invert3(np.ascontiguousarray(P))
    step = track.x[:3] - x
    step[2] = se2.wrap(float(step[2]))
    return positive_part(more), step


def follow_up(lights: Lights, epoch: LightEpoch, seen: list[Sight]) -> None:
    """Record the used links; restart at a better position when most links are inconsistent for long."""
    if len(lights.tracks) != 1:
        return
    states = [sight.state for sight in seen]
    doubtful = [sight.state for sight in seen if speaks_against(sight.state, sight.residual, sight.sigma)]
    against, used = len(doubtful), states.count(LinkState.ACCEPTED) - doubtful.count(LinkState.ACCEPTED)
    fitting = used + sum(waits(sight.state, sight.residual, sight.sigma) for sight in seen)
    now = lights.course.t_mono
    if used:
        lights.t_used = now
    relearn(lights, lights.tracks[0])
    distrust(lights, lights.tracks[0])
    rejected = states.count(LinkState.REJECTED)
    odd = rejected >= 2 and rejected > ODD_SHARE * (fitting + against)
    lights.t_odd = min(lights.t_odd, now) if odd else math.inf
    if against <= LOST_SHARE * (fitting + against):
        lights.t_lost = math.inf
        return
    lights.t_lost = min(lights.t_lost, now)
    if now - lights.t_lost < LOST_S:
        return
    lights.t_lost = now
    found = places(lights, epoch)
    if found and found[0].fits >= fitting + 2:
        keep_gains(lights)
        begin(lights, found, *headings(lights.settings.headings))
        lights.lost = True


NOTHING_GAINED = (np.zeros((3, 3)), np.zeros(3))


def describe(
    lights: Lights, links: list[Link], epoch: LightEpoch | None, news: tuple[Array, Array] = NOTHING_GAINED
) -> LightsResult:
    """Assemble the result of the present state.

    ``news``: information gain and correction of :func:`gain`; not reported while the pose is lost.
    """
    pose, P, floor = np.zeros(3), np.zeros((3, 3)), 0.0
    if lights.tracks:
        pose, P = mixture(lights.tracks)
        floor = math.exp(float(lights.tracks[0].x[state_vector.FLOOR]))
    fix = fix_of(lights, P)
    if fix is Fix.GOOD:
        lights.lost = False
    if epoch is not None:
        links = absent(lights, links, pose, fix)
    gained, gained_by = NOTHING_GAINED if fix is Fix.LOST else news
    return LightsResult(
        t_mono=lights.t_epoch,
        fix=fix,
        T_map_base=pose,
        covariance=0.5 * (P + P.T),
        links=tuple(links),
        accepted=frozenset(k.lamp_id for k in links if k.state is LinkState.ACCEPTED and k.lamp_id is not None),
        gained=gained,
        gained_by=gained_by,
        floor=floor,
        block=epoch.block if epoch is not None else BlockFlag.NONE,
        clock_ppm=epoch.clock_ppm if epoch is not None else None,
        t_pose=lights.course.t_mono,
        bent=lights.bent.anew,
        pwm=epoch.pwm if epoch is not None else (),
        slow=epoch.slow if epoch is not None else frozenset(),
    )


def fix_of(lights: Lights, P: Array) -> Fix:
    """Status of the position estimate."""
    if not lights.tracks:
        return Fix.NONE
    spread = math.sqrt(max(float(P[0, 0] + P[1, 1]), 0.0))
    if len(lights.tracks) > 1:
        if lights.lost and lights.course.way == lights.way_start:
            return Fix.LOST
        return Fix.AMBIGUOUS if spread > 0.8 else Fix.STARTING
    if lights.course.t_mono - lights.t_odd > ODD_S:
        lights.lost, lights.way_odd = True, lights.course.way
        lights.bent.elsewhere()
        return Fix.LOST
    if lights.lost and lights.course.way - max(lights.way_start, lights.way_odd) < PROOF_M:
        return Fix.STARTING
    if lights.course.t_mono - lights.t_used > HELD_S:
        return Fix.HELD
    return Fix.GOOD if spread < 0.5 and P[2, 2] < 0.25**2 else Fix.STARTING
