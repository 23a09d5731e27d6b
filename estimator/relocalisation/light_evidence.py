"""What light says of the place while the robot is being relocalised in a stored map: windows to look in, and a witness.

Light names lamps, and with stored gains their strengths give the position to a decimetre from the first epochs on;
where codes repeat there are several. It says little of the heading until the robot has moved: that, and the
confirmation, come from the laser. Nothing here is ever told to the `lights` filter, which hears of no place by laser.

It counts only in a map whose frame is that of the light survey (`told`).
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
"""A hypothesis of light less likely than that is none."""
TOGETHER_M: Final = 1.0
"""Hypotheses no farther apart are looked for in one window."""
MARGIN_M: Final = 0.25
"""By which a window is larger than three deviations of what light says: walls and floor reflect as no model knows."""
GUESS_M: Final = 0.6
"""Size of a window about a place read off a single epoch."""
WIDEST_M: Final = 3.0
"""Light that is vaguer than that says nothing."""
FACTOR: Final = 6.0
"""By which the variance of a hypothesis of light counts: what is young about it, and what its model does not know."""
SLACK: Final = np.diag((0.1**2, 0.1**2, 0.05**2))
LEAST: Final = 3
"""Links used without which light is no witness."""
AGAINST: Final = 0.34
"""Share of links against the place from which on it is none."""

HEADED_M: Final = 3.0
"""Way since the `lights` filter last looked for its place, before which its heading rules nothing out: strengths tell
it by how the robot moves, and with wheels that turn, or walls that reflect, young hypotheses of it go astray together.
The laser sees it at once, and where it sees two it goes on looking."""

UNHEARD: Final = (LinkState.FAINT, LinkState.MISSING, LinkState.UNSURVEYED, LinkState.TWIN)
"""States of a link that say nothing of where the receiver is."""
ASKED_M: Final = 0.1
"""Within that far of each other two poses receive the same lamps: a robot drives less from one epoch to the next."""
MISPLACED: Final = 2
"""So many lamps at least have to be received that cannot be at a pose: a single one may be a lamp that was moved."""


@dataclass(frozen=True, slots=True)
class Window:
    """Where light allows the base to be in the map: within ``reach_m`` of (x, y), at any heading; how likely."""

    x: float
    y: float
    reach_m: float
    chance: float


def told(light: LightChannel | None, graph: SubmapGraph) -> bool:
    """Whether there is light, and the map's frame is that of its survey."""
    if light is None:
        return False
    return any(submap.light is not None for submap in graph.settled())


def windows(light: LightChannel | None, graph: SubmapGraph, T_base_frame: Array | None = None) -> tuple[Window, ...]:
    """Where light allows the robot to be, likeliest first; none where it says nothing.

    Where the links contradict the place that the `lights` filter still holds, as when the robot has been carried off,
    the latest epoch is read by itself.

    Args:
        light: decoder and light filter.
        graph: of the map.
        T_base_frame: where, seen from the base now, what is to be looked for was seen; None: here.
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
    """Places at which the latest epoch fits, whatever was known before; read once.

    One link more that does not fit rules no place out unless its lamp is too strong there: what a wall reflects counts
    as direct in one epoch and not in the next, and the place where it does may be the right one.
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
    """Whether what is received does not fit the place that the filter holds."""
    return len(lights.tracks) == 1 and (math.isfinite(lights.t_lost) or math.isfinite(lights.t_odd))


def disputed(light: LightChannel | None, graph: SubmapGraph) -> bool:
    """Whether what is received does not fit the place that was held, or a new one has had to be looked for."""
    return light is not None and (contradicted(light.filter) or light.filter.lost) and told(light, graph)


def elsewhere(light: LightChannel | None, graph: SubmapGraph, T_map_base: Array) -> bool:
    """Whether light has the robot under one set of lamps, and not here."""
    return compatible(light, graph, T_map_base) is False and under_the_same_lamps(light, graph)


def out_of_place(light: LightChannel | None, T_map_base: Array) -> bool:
    """Whether a lamp is received now that cannot be received about a pose, as strong as it is.

    It asks the latest epoch alone, not the `lights` filter, which wheels that turn more than they say can lead astray;
    and not the heading, of which strengths know nothing. Of lamps of one code the nearest counts.
    """
    return any(too_strong_at(light, T_map_base))


def misplaced(light: LightChannel | None, alignment: SurveyAlignment | None, T_map_base: Array) -> bool:
    """Whether most of the lamps received, two at least, are stronger than they can be about a pose.

    What stands in the way only ever takes light away, and one lamp that hangs elsewhere, or whose code another has, is
    not the most of them: so it is the robot that is elsewhere, whatever the `lights` filter has made of it so far.
    An epoch is asked once, unless the pose is moved meanwhile.
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
        return False  # what is used fits where the filter is, and where that is, is held against the pose: costs less
    strong = too_strong_at(light, T_map_base)
    return sum(strong) >= MISPLACED and 2 * sum(strong) > len(strong)


def glimpsed_elsewhere(light: LightChannel | None, T_map_base: Array) -> bool:
    """Whether the latest epoch, read by itself, has the robot nowhere within `NEARER_M`, but somewhere.

    Wheels that turn more than they say lead the filter astray, and not one epoch; it says more than that the lamps of
    the place are received, which they are a few metres beside it too.
    """
    if light is None or not too_strong_at(light, T_map_base):
        return False
    rx, found = light.filter.survey.receiver, glimpsed(light)
    (x, y) = se2.apply(T_map_base, np.array(((rx.x, rx.y),)))[0].tolist()
    return len(found) > 0 and all(math.hypot(one.x - x, one.y - y) > NEARER_M for one in found)


def in_place(light: LightChannel | None, T_map_base: Array) -> bool:
    """Whether lamps enough are received now, all of them as strong as they can be about a pose, and it may be there."""
    strong = too_strong_at(light, T_map_base)
    return len(strong) >= LEAST and not any(strong) and not glimpsed_elsewhere(light, T_map_base)


def about(lights: Lights, place: Place) -> Window:
    """The window about a place of the receiver."""
    rx = lights.survey.receiver
    return Window(place.x, place.y, GUESS_M + math.hypot(rx.x, rx.y), math.exp(-0.5 * place.cost))


def clustered(lights: Lights, T_base_frame: Array) -> tuple[Window, ...]:
    """A window for each group of hypotheses that lie together; none where they are too vague to look in."""
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
    """The circle about hypotheses (place, spread, chance) in which all of them lie."""
    x, y = np.mean([at for at, _, _ in group], axis=0).tolist()
    reach = max(math.hypot(at[0] - x, at[1] - y) + spread for at, spread, _ in group)
    return Window(x, y, reach + more, sum(chance for _, _, chance in group))


def beside(lights: Lights) -> float:
    """What is added to a window where the lamps in use stand in one row: the other side of it fits nearly as well."""
    lamps = lights.catalogue.by_id
    seen = () if lights.result is None else lights.result.accepted
    at = [(lamps[k].x, lamps[k].y) for k in seen if k in lamps]
    return ACROSS_M * math.exp(-spread(at)[1] / ROW_M**2) if at else ACROSS_M


def compatible(light: LightChannel | None, graph: SubmapGraph, T_map_base: Array) -> bool | None:
    """Whether light allows a pose of the robot now; None where it says nothing."""
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
    """The hypotheses that count."""
    chances = probabilities(lights.tracks).tolist()
    return [track for track, chance in zip(lights.tracks, chances, strict=True) if chance >= CHANCE]


def fits(track: Track, T_map_base: Array) -> bool:
    """Whether a pose is that of a hypothesis, heading included as far as that is known."""
    off = T_map_base - track.x[:3]
    off[2] = se2.wrap(float(off[2]))
    return float(off @ invert3(FACTOR * track.P[:3, :3] + SLACK) @ off) < SURPRISE


def witness(light: LightChannel | None, graph: SubmapGraph, T_map_base: Array) -> bool:
    """Whether light counts as the second witness of a pose that the laser has found.

    It does where lamps are used and few are against it, and where the same lamps allow no other part of the building:
    where codes repeat there are several. On which side of a row of lamps it stands the laser tells.
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
    """Whether what is received comes from the same lamps at all places that light allows."""
    around = windows(light, graph)
    if len(around) < 2:
        return True
    assert light is not None
    lights, epoch = light.filter, light.epoch
    assert epoch is not None
    seen = {frozenset(s.lamp.lamp_id for s in direct(lights, epoch, one.x, one.y) if s.lamp) for one in around}
    return len(seen) == 1


def hidden(lights: Lights, link: Link) -> bool:
    """Whether a lamp is received so weakly that a wall stands before it, of which the survey knows nothing."""
    lamp = None if link.lamp_id is None else lights.catalogue.by_id.get(link.lamp_id)
    return lamp is not None and not straight(lights, lamp, link.amplitude)
