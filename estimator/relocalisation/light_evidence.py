"""Light evidence for relocalisation: search windows from the lamps received, and confirmation or rejection of a pose.

Light identifies lamps, and with stored gains their RSS gives the position to a decimetre from the first epochs on.
Where codes repeat there are several positions. Light gives little information on the heading until the robot has moved:
that, and the confirmation, come from the lidar. Nothing here changes the light filter, which never receives a pose by
lidar.

It counts only in a map whose frame is the survey frame (`told`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from estimator.cdma.epoch import UNUSABLE
from estimator.fusion.map_pose import SurveyAlignment
from estimator.light_filter.collinear_lamps import ACROSS_M, ROW_M, spread
from estimator.light_filter.filter_state import SILENT_S, Lights, Track
from estimator.light_filter.grid_likelihood import CAP
from estimator.light_filter.initialisation import RIVAL, Place, direct, places, probabilities, straight
from estimator.light_filter.light_channel import Asked, LightChannel, silent, too_strong_at
from estimator.light_filter.link_association import NEARER_M, strong_at
from estimator.mapping.submap_graph import SubmapGraph
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import invert3
from estimator.result import SURPRISE, Fix, Link, LinkState

CHANCE: Final = 1e-4
"""Smallest probability of a light hypothesis in use."""
TOGETHER_M: Final = 1.0
"""Largest distance (m) of hypotheses in one window."""
MARGIN_M: Final = 0.25
"""Margin (m) of a window beyond three sigma of light: reflections of walls and ground are not in the model."""
GUESS_M: Final = 0.6
"""Radius (m) of a window around a single-epoch fix."""
WIDEST_M: Final = 3.0
"""Largest window (m); with a larger one light gives no information."""
FACTOR: Final = 6.0
"""Inflation of the variance of a light hypothesis: it has not converged, and its model has errors."""
SLACK: Final = np.diag((0.1**2, 0.1**2, 0.05**2))
LEAST: Final = 3
"""Fewest links in use for a confirmation by light."""
AGAINST: Final = 0.34
"""Share of inconsistent links above which there is no confirmation."""

HEADED_M: Final = 3.0
"""Path length (m) since the last start of the light filter, below which its heading excludes nothing.

RSS gives the heading through motion. Wheel slip, or reflecting walls, bias all its young hypotheses together. The lidar
sees the heading at once, and where it sees two the search continues.
"""

UNHEARD: Final = (LinkState.FAINT, LinkState.MISSING, LinkState.UNSURVEYED, LinkState.TWIN)
"""States of a link without information on the receiver's position."""
ASKED_M: Final = 0.1
"""Distance (m) of two poses with the same received lamps: a robot drives less from one epoch to the next."""
MISPLACED: Final = 2
"""Fewest received lamps that are impossible at a pose: a single one may be a lamp that was moved."""


@dataclass(frozen=True, slots=True)
class Window:
    """Region of the base in the map by light: within ``reach_m`` of (x, y), at any heading; with its probability."""

    x: float
    y: float
    reach_m: float
    chance: float


def told(light: LightChannel | None, graph: SubmapGraph) -> bool:
    """Whether there is light, and the map frame is the survey frame."""
    if light is None:
        return False
    return any(submap.light is not None for submap in graph.settled())


def windows(light: LightChannel | None, graph: SubmapGraph, T_base_frame: Array | None = None) -> tuple[Window, ...]:
    """Regions of the robot by light, most probable first; none without information.

    The links may be inconsistent with the position of the light filter, as after kidnapping. Then the latest epoch
    alone gives the windows.

    Args:
        light: decoder and light filter.
        graph: of the map.
        T_base_frame: pose of the searched frame relative to the present base; None: the base itself.
    """
    if not told(light, graph):
        return ()
    assert light is not None
    lights, epoch = light.filter, light.epoch
    if epoch is None or lights.course.t_mono - lights.t_epoch > SILENT_S:
        return ()
    if contradicted(lights):
        return tuple(about(lights, place) for place in glimpsed(light))
    if lights.result is not None and lights.result.fix is Fix.HELD:
        return ()
    return clustered(lights, se2.identity() if T_base_frame is None else T_base_frame)


def glimpsed(light: LightChannel) -> tuple[Place, ...]:
    """Positions at which the latest epoch fits, without any prior; computed once per epoch.

    One more link that does not fit excludes a position only if its lamp is too strong there. A reflection counts as
    direct in one epoch and not in the next. The position where it does may be the correct one.
    """
    lights, epoch = light.filter, light.epoch
    if epoch is None or epoch.block & UNUSABLE or len(epoch.ids) == 0:
        return ()
    if light.glimpse is None or light.glimpse[0] is not epoch:
        found = places(lights, epoch, RIVAL + CAP)
        near = [one.cost < found[0].cost + RIVAL or not any(strong_at(lights, epoch, one.x, one.y)) for one in found]
        light.glimpse = epoch, tuple(one for one, it in zip(found, near, strict=True) if it)
    return light.glimpse[1]


def contradicted(lights: Lights) -> bool:
    """Whether the links are inconsistent with the position of the light filter."""
    return len(lights.tracks) == 1 and (math.isfinite(lights.t_lost) or math.isfinite(lights.t_odd))


def disputed(light: LightChannel | None, graph: SubmapGraph) -> bool:
    """Whether the links are inconsistent with the position so far, or the light filter has had to restart."""
    return light is not None and (contradicted(light.filter) or light.filter.lost) and told(light, graph)


def elsewhere(light: LightChannel | None, graph: SubmapGraph, T_map_base: Array) -> bool:
    """Whether light gives a position under one set of lamps, and not here."""
    return compatible(light, graph, T_map_base) is False and under_the_same_lamps(light, graph)


def out_of_place(light: LightChannel | None, T_map_base: Array) -> bool:
    """Whether a received lamp is impossible at a pose with that RSS.

    It uses the latest epoch alone, not the light filter, which wheel slip can bias. It does not use the heading, which
    RSS does not depend on. Of lamps of one code the nearest counts.
    """
    return any(too_strong_at(light, T_map_base))


def misplaced(light: LightChannel | None, alignment: SurveyAlignment | None, T_map_base: Array) -> bool:
    """Whether most of the received lamps, at least two, are stronger than possible at a pose.

    Obstacles only reduce light, and one lamp that was moved, or shares its code, is not the majority. So the robot is
    elsewhere, whatever the light filter has estimated so far. An epoch is evaluated once, unless the pose moves
    meanwhile.
    """
    if light is None or alignment is None or silent(light):
        return False
    asked, epoch, compared = light.asked, light.epoch, alignment.gap is not None
    same = asked is not None and asked.epoch is epoch and asked.compared == compared
    if asked is None or not same or math.hypot(*(T_map_base - asked.T_map_base)[:2].tolist()) > ASKED_M:
        assert epoch is not None
        light.asked = asked = Asked(epoch, T_map_base, compared, _misplaced(light, T_map_base, compared))
    return asked.misplaced


def _misplaced(light: LightChannel, T_map_base: Array, compared: bool) -> bool:
    result = light.result
    heard = sum(link.state not in UNHEARD for link in result.links)
    if heard < MISPLACED or (compared and 2 * len(result.accepted) >= heard):
        return False  # cheaper: used links fit the filter's position, and that is compared with the pose
    strong = too_strong_at(light, T_map_base)
    return sum(strong) >= MISPLACED and 2 * sum(strong) > len(strong)


def glimpsed_elsewhere(light: LightChannel | None, T_map_base: Array) -> bool:
    """Whether the latest epoch alone gives positions, but none within `NEARER_M` of the pose.

    Wheel slip biases the filter, but not one epoch. The test is stricter than the lamps received, which are the same a
    few metres away.
    """
    if light is None or not too_strong_at(light, T_map_base):
        return False
    rx, found = light.filter.survey.receiver, glimpsed(light)
    (x, y) = se2.apply(T_map_base, np.array(((rx.x, rx.y),)))[0].tolist()
    return len(found) > 0 and all(math.hypot(one.x - x, one.y - y) > NEARER_M for one in found)


def in_place(light: LightChannel | None, T_map_base: Array) -> bool:
    """Whether enough lamps are received, all possible at a pose, and the latest epoch alone allows it."""
    strong = too_strong_at(light, T_map_base)
    return len(strong) >= LEAST and not any(strong) and not glimpsed_elsewhere(light, T_map_base)


def about(lights: Lights, place: Place) -> Window:
    """The window around a position of the receiver."""
    rx = lights.survey.receiver
    return Window(place.x, place.y, GUESS_M + math.hypot(rx.x, rx.y), math.exp(-0.5 * place.cost))


def clustered(lights: Lights, T_base_frame: Array) -> tuple[Window, ...]:
    """A window for each group of close hypotheses; none where they are too uncertain for a search."""
    if not lights.tracks:
        return ()
    chances = probabilities(lights.tracks).tolist()
    groups: list[list[tuple[Array, float, float]]] = []
    for track, chance in zip(lights.tracks, chances, strict=True):
        if chance < CHANCE:
            continue
        at = se2.compose(track.x[:3], T_base_frame)[:2]
        spread = 3.0 * math.sqrt(max(float(track.P[0, 0] + track.P[1, 1]), 0.0))
        near = next((group for group in groups if math.hypot(*(group[0][0] - at)) < TOGETHER_M), None)
        if near is None:
            groups.append([(at, spread, chance)])
        else:
            near.append((at, spread, chance))
    more = MARGIN_M + beside(lights)
    made = [window_of(group, more) for group in groups]
    made.sort(key=lambda window: -window.chance)
    return () if any(window.reach_m > WIDEST_M for window in made) else tuple(made)


def window_of(group: list[tuple[Array, float, float]], more: float) -> Window:
    """The circle that contains all hypotheses (position, spread, probability)."""
    x, y = np.mean([at for at, _, _ in group], axis=0).tolist()
    reach = max(math.hypot(at[0] - x, at[1] - y) + spread for at, spread, _ in group)
    return Window(x, y, reach + more, sum(chance for _, _, chance in group))


def beside(lights: Lights) -> float:
    """Enlargement (m) of a window under collinear lamps: the other side of their line fits nearly as well."""
    lamps = lights.catalogue.by_id
    seen = () if lights.result is None else lights.result.accepted
    at = [(lamps[k].x, lamps[k].y) for k in seen if k in lamps]
    return ACROSS_M * math.exp(-spread(at)[1] / ROW_M**2) if at else ACROSS_M


def compatible(light: LightChannel | None, graph: SubmapGraph, T_map_base: Array) -> bool | None:
    """Whether light allows a pose of the robot now; None without information."""
    around = windows(light, graph)
    if not around:
        return None
    x, y, _ = T_map_base.tolist()
    if not any(math.hypot(window.x - x, window.y - y) < window.reach_m for window in around):
        return False
    assert light is not None
    lights = light.filter
    if contradicted(lights) or lights.course.way - lights.way_start < HEADED_M:
        return True
    return any(fits(track, T_map_base) for track in likely(lights))


def likely(lights: Lights) -> list[Track]:
    """The hypotheses with sufficient probability."""
    chances = probabilities(lights.tracks).tolist()
    return [track for track, chance in zip(lights.tracks, chances, strict=True) if chance >= CHANCE]


def fits(track: Track, T_map_base: Array) -> bool:
    """Whether a pose agrees with a hypothesis, including the heading as far as it is known."""
    off = T_map_base - track.x[:3]
    off[2] = se2.wrap(float(off[2]))
    return float(off @ invert3(FACTOR * track.P[:3, :3] + SLACK) @ off) < SURPRISE


def witness(light: LightChannel | None, graph: SubmapGraph, T_map_base: Array) -> bool:
    """Whether light confirms a pose that the lidar has found.

    Lamps must be in use, few inconsistent, and the same lamps must allow no other part of the building. Where codes
    repeat there are several. On which side of collinear lamps the robot is, the lidar decides.
    """
    if compatible(light, graph, T_map_base) is not True or not under_the_same_lamps(light, graph):
        return False
    assert light is not None
    lights = light.filter
    if contradicted(lights):
        x, y, _ = T_map_base.tolist()
        place = min(glimpsed(light), key=lambda one: math.hypot(one.x - x, one.y - y))
        return place.of - place.fits <= AGAINST * place.of
    if lights.result is None:
        return False
    links = lights.result.links
    used = sum(link.state is LinkState.ACCEPTED for link in links)
    against = sum(link.against and not hidden(lights, link) for link in links)
    return used >= LEAST and against <= AGAINST * (used + against)


def under_the_same_lamps(light: LightChannel | None, graph: SubmapGraph) -> bool:
    """Whether the received lamps are the same at all positions that light allows."""
    around = windows(light, graph)
    if len(around) < 2:
        return True
    assert light is not None
    lights, epoch = light.filter, light.epoch
    assert epoch is not None
    seen = {frozenset(s.lamp.lamp_id for s in direct(lights, epoch, one.x, one.y) if s.lamp) for one in around}
    return len(seen) == 1


def hidden(lights: Lights, link: Link) -> bool:
    """Whether a lamp is received so weakly that a wall unknown to the survey must stand before it."""
    lamp = None if link.lamp_id is None else lights.catalogue.by_id.get(link.lamp_id)
    return lamp is not None and not straight(lights, lamp, link.amplitude)
