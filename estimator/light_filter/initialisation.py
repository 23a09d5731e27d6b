"""Multi-hypothesis initialisation: positions by maximum likelihood, several headings each, until motion decides."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from estimator.cdma.epoch import LightEpoch
from estimator.light_filter import grid_likelihood, state_vector
from estimator.light_filter.collinear_lamps import Under
from estimator.light_filter.filter_state import Lights, Track
from estimator.light_filter.lambertian import pack_lamps, pack_receiver
from estimator.light_filter.link_association import Sight, sights
from estimator.light_filter.link_gating import ACCEPTED, DIFFUSE, remembered
from estimator.light_filter.model_consistency import Bent
from estimator.light_filter.survey import Lamp
from estimator.numerics import se2
from estimator.numerics.arrays import Array

LEAST = 3
"""Links needed for a start: two leave two positions, and their gains are uncertain."""
STEP_M = 0.35
"""Spacing of the grid, m."""
APART_M = 0.8
"""Distance (m) below which two minima are one; the filter finds its lowest point."""
PLACES = 6
"""Most positions of a start."""
RIVAL = 9.0
"""Cost above the best up to which a position is kept as a competing hypothesis."""
SEEDS = 3
"""Number of strongest links whose lamps are tried."""
SIGMA_M = 0.4
"""Initial sigma of a position, m."""
GIVEN_UP = 15.0
"""ln probability below the best one's at which a hypothesis is dropped."""
SAME_M, SAME_RAD = 0.15, 0.25
"""Differences of position (m) and heading (rad) below which two hypotheses are the same."""
REVERSE = 1.0
"""Loss of ln probability per epoch of a hypothesis that drives backward without odometry to confirm it. RSS alone
cannot distinguish a robot that drives from its mirror image that reverses.
"""
MOVED_M = 0.3
"""Path length (m) before which no heading is accepted."""


@dataclass(frozen=True, slots=True)
class Place:
    """Candidate position of the receiver: x, y (m), cost, common ln gain, number of links that fit, number of links."""

    x: float
    y: float
    cost: float
    gain: float
    fits: int
    of: int


def places(lights: Lights, epoch: LightEpoch, rival: float = RIVAL) -> list[Place]:
    """Positions at which an epoch's direct links fit, best first; empty if too few links are direct or fit.

    ``rival``: cost above the best at which a position is discarded.
    """
    found: list[Place] = []
    tried: set[tuple[int, ...]] = set()
    for seed in seeds(lights, epoch):
        used = direct(lights, epoch, seed.x, seed.y)
        key = tuple(sorted(sight.lamp.lamp_id for sight in used if sight.lamp is not None))
        if len(used) < LEAST or key in tried:
            continue
        tried.add(key)
        found += minima(lights, used)
    good = sorted((p for p in found if p.fits >= LEAST and 2 * p.fits >= p.of), key=lambda p: p.cost)
    kept: list[Place] = []
    for place in good:
        apart = all(math.hypot(place.x - k.x, place.y - k.y) > APART_M for k in kept)
        if apart and place.cost < good[0].cost + rival and len(kept) < PLACES:
            kept.append(place)
    return kept


def seeds(lights: Lights, epoch: LightEpoch) -> list[Lamp]:
    """Lamps from which one of the strongest links may come."""
    out: dict[int, Lamp] = {}
    order = [i for i in np.argsort(-epoch.amplitude) if np.isfinite(epoch.amplitude[i])]
    for i in order[:SEEDS]:
        frame, code = epoch.lamps[i], int(epoch.ids[i])
        lamps = lights.catalogue.candidates(code)
        if frame is not None:
            lamps = [lights.catalogue.learn(frame, code, lights.course.t_mono)[0]]
        out.update({lamp.lamp_id: lamp for lamp in lamps})
    return list(out.values())


def direct(lights: Lights, epoch: LightEpoch, x: float, y: float) -> list[Sight]:
    """Line-of-sight links, each with its lamp, for a receiver near (x, y) in m."""
    return [
        sight
        for sight in sights(lights, epoch, x, y)
        if sight.lamp is not None and sight.state is ACCEPTED and straight(lights, sight.lamp, sight.amplitude)
    ]


def straight(lights: Lights, lamp: Lamp, amplitude: float) -> bool:
    """Whether the RSS proves line of sight: a hidden lamp is received more weakly at any position."""
    gain = float(remembered(lights, lamp)[0][0])
    return amplitude > DIFFUSE * math.exp(gain) * lights.catalogue.rims[lamp.lamp_id]


def minima(lights: Lights, used: list[Sight]) -> list[Place]:
    """Lowest minima of a grid around the strongest lamp."""
    lamps = [sight.lamp for sight in used if sight.lamp is not None]
    table = pack_lamps(lamps, lights.survey.depth)
    receiver = replace(lights.survey.receiver, x=0.0, y=0.0, slope_x=0.0, slope_y=0.0)
    links = np.zeros((len(used), 2))
    for i, (sight, lamp) in enumerate(zip(used, lamps, strict=True)):
        gain, variance = (float(of[0]) for of in remembered(lights, lamp))
        lean = math.hypot(lights.survey.receiver.slope_x, lights.survey.receiver.slope_y)
        links[i] = math.log(sight.amplitude) - gain, variance + 0.06**2 + (1.5 * lean) ** 2
    reach = (lamps[0].z - receiver.z) * math.tan(min(receiver.half_fov_rad, 1.3)) + STEP_M
    poses = grid(lamps[0].x, lamps[0].y, max(reach, 1.0))
    out = np.zeros((len(poses), 3))
    grid_likelihood.search(table, pack_receiver(receiver), links, poses, lights.survey.floor, out)
    found: list[Place] = []
    for g in np.argsort(out[:, 0])[: len(poses) // 4]:
        x, y = float(poses[g, 0]), float(poses[g, 1])
        if all(math.hypot(x - p.x, y - p.y) > APART_M for p in found):
            found.append(Place(x, y, float(out[g, 0]), float(out[g, 1]), int(out[g, 2]), len(used)))
        if len(found) >= PLACES:
            break
    return found


def grid(x: float, y: float, reach: float) -> Array:
    """Poses (n, 3) in a circle around a point."""
    axis = np.arange(-reach, reach + STEP_M, STEP_M)
    u, v = np.meshgrid(axis, axis)
    inside = np.hypot(u, v) <= reach
    return np.ascontiguousarray(np.column_stack([x + u[inside], y + v[inside], np.zeros(int(inside.sum()))]))


def begin(lights: Lights, found: list[Place], yaws: Array, sigma_yaw: float) -> None:
    """Create one hypothesis per position and heading; gains and sensor states are kept.

    Their covariances share one block of memory, which is freed as a whole after the start. Separate blocks left holes
    in the heap at each start.
    """
    old = lights.tracks[0] if lights.tracks else lights.before
    lights.tracks = []
    block = np.zeros((len(found) * len(yaws), state_vector.SIZE, state_vector.SIZE))
    for place in found:
        for yaw in yaws.tolist():
            rx = lights.survey.receiver
            arm = se2.apply(np.array((0.0, 0.0, yaw)), np.array(((rx.x, rx.y),)))[0]
            T = np.array((place.x - arm[0], place.y - arm[1], se2.wrap(yaw)))
            covariance = np.diag((SIGMA_M**2, SIGMA_M**2, sigma_yaw**2))
            track = new_track(lights, T, covariance, old, block[len(lights.tracks)])
            track.weight = -0.5 * place.cost
            lights.tracks.append(track)
    lights.way_start, lights.under = lights.course.way, Under()
    lights.bent = Bent()


def new_track(lights: Lights, T_map_base: Array, covariance: Array, old: Track | None, zeros: Array) -> Track:
    """Hypothesis at a pose, independent of everything else; sensor states and diffuse floor come from an old one.

    ``zeros``: (SIZE, SIZE), becomes its covariance.
    """
    track, motion, model = Track(P=zeros), lights.settings.motion, lights.settings.model
    track.x[:3], track.P[:3, :3] = T_map_base, covariance
    if not lights.course.wheels:
        begun = (motion.speed, motion.sideways, 0.5)
        (
            track.P[state_vector.SPEED, state_vector.SPEED],
            track.P[state_vector.SIDE, state_vector.SIDE],
            track.P[state_vector.TURN, state_vector.TURN],
        ) = (v**2 for v in begun)
    variance = {
        state_vector.SCALE: motion.scale,
        state_vector.TURN_SCALE: motion.turn_scale,
        state_vector.CURVE: motion.curve,
        state_vector.GYRO: motion.gyro_bias,
        state_vector.COMMON: model.common,
        state_vector.FLOOR: model.floor_ln,
        state_vector.LEAN_X: model.tilt,
        state_vector.LEAN_Y: model.tilt,
        state_vector.ORDER: model.order,
    }
    track.x[state_vector.FLOOR] = math.log(max(lights.survey.floor, 1e-4))
    for j, sigma in variance.items():
        track.P[j, j] = sigma**2
        if old is not None and not (
            lights.course.matched and old is lights.before and j <= state_vector.CURVE
        ):  # scales of wheels do not apply to scan matches
            track.x[j], track.P[j, j] = old.x[j], min(2.0 * float(old.P[j, j]) + (0.2 * sigma) ** 2, sigma**2)
    return track


def headings(count: int) -> tuple[Array, float]:
    """Evenly spread headings (rad), and the sigma with which they cover the circle."""
    return np.asarray(2.0 * math.pi / count * np.arange(count)), 0.5 * 2.0 * math.pi / count


def decide(lights: Lights) -> None:
    """Rank the hypotheses, merge equal ones, drop improbable ones, and end the start when one is left."""
    if not lights.course.wheels:
        for track in lights.tracks:
            sigma = math.sqrt(max(float(track.P[state_vector.SPEED, state_vector.SPEED]), 0.0))
            track.weight -= REVERSE * (track.x[state_vector.SPEED] < -max(0.08, 2.0 * sigma))
    lights.tracks.sort(key=lambda track: -track.weight)
    kept: list[Track] = []
    for track in lights.tracks:
        if track.weight < lights.tracks[0].weight - GIVEN_UP:
            break
        twin = next((k for k in kept if same(k, track)), None)
        if twin is None:
            kept.append(track)
        else:
            twin.weight = float(np.logaddexp(twin.weight, track.weight))
    chances = probabilities(kept)
    driven = lights.course.way - lights.way_start > MOVED_M
    if driven and chances[0] > lights.settings.decided and math.sqrt(kept[0].P[2, 2]) < 0.3:
        kept = kept[:1]
    go_on(lights, kept)


def go_on(lights: Lights, kept: list[Track]) -> None:
    """Drop all other hypotheses and, with one left, their shared memory block."""
    if len(kept) == 1 and kept[0].P.base is not None:
        kept[0].P = kept[0].P.copy()
    lights.tracks = kept


def rule_out(lights: Lights, epoch: LightEpoch) -> None:
    """Drop hypotheses that cannot see lamps whose data frames were received.

    Where codes repeat this decides, even at rest. The last hypotheses are dropped, and the start restarts with the
    frames, under one condition: most of these lamps, and at least two, are out of sight. A single one may have been
    moved.
    """
    named = [
        (lights.catalogue.by_id[frame.lamp_id], float(epoch.amplitude[i]))
        for i, frame in enumerate(epoch.lamps)
        if frame is not None and frame.lamp_id in lights.catalogue.by_id
    ]
    direct = [lamp for lamp, amplitude in named if amplitude > lights.catalogue.rims[lamp.lamp_id]]
    unseen = [sum(out_of_sight(lights, track, lamp) for lamp in direct) for track in lights.tracks]
    kept = [track for track, count in zip(lights.tracks, unseen, strict=True) if count == 0]
    if kept or min(unseen) >= max(2.0, 0.5 * len(direct)):
        go_on(lights, kept)


def out_of_sight(lights: Lights, track: Track, lamp: Lamp) -> bool:
    """Whether a lamp is beyond the field of view for every position that a hypothesis allows."""
    rx = lights.survey.receiver
    spread = 3.0 * math.sqrt(max(float(track.P[0, 0] + track.P[1, 1]), 0.0)) + APART_M
    reach = (lamp.z - rx.z) * math.tan(min(rx.half_fov_rad, 1.3)) + spread
    return math.hypot(lamp.x - float(track.x[0]), lamp.y - float(track.x[1])) > reach


def same(a: Track, b: Track) -> bool:
    """Whether two hypotheses have become one."""
    near = math.hypot(*(a.x[:2] - b.x[:2]).tolist()) < SAME_M
    return near and abs(se2.wrap(float(a.x[2] - b.x[2]))) < SAME_RAD and a.slots.keys() == b.slots.keys()


def probabilities(tracks: list[Track]) -> Array:
    """Probability of each hypothesis, summing to one."""
    weights = np.array([track.weight for track in tracks])
    chances = np.exp(weights - weights.max())
    return np.asarray(chances / chances.sum())


def mixture(tracks: list[Track]) -> tuple[Array, Array]:
    """Pose of the likeliest hypothesis, and the covariance of all of them around it."""
    best, P = tracks[0].x[:3].copy(), np.zeros((3, 3))
    for track, chance in zip(tracks, probabilities(tracks).tolist(), strict=True):
        off = track.x[:3] - best
        off[2] = se2.wrap(float(off[2]))
        P += chance * (track.P[:3, :3] + np.outer(off, off))
    return best, P
