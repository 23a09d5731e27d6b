"""A robot with lamps that begins in a map without a place in their survey: a glance, half the building, another one.

Also in one that hangs on lamps which have been moved since. What is said is never a wrong place.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from heapq import merge
from typing import Any

import numpy as np
import pytest

from daemon.integrity.observer import Observer
from daemon.recording.checkpoint import capture
from daemon.recording.restore import restore
from daemon.snapshot import State as Said
from estimator.light_filter.light_channel import LightsSetup
from estimator.mapping.map_snapshot import MapImage, finished
from estimator.measurements import Array, Command, Order, Record, Scan
from estimator.numerics import se2
from estimator.pipeline import Settings, new_state
from estimator.relocalisation import unaligned_map
from estimator.relocalisation.global_scan_match import Fit, Verdict
from estimator.relocalisation.hypothesis_tracking import Hypothesis, SearchedAside
from estimator.state import State
from estimator.stored_map import image_of, restored
from tools.experiments.relocation.maps import drive_of
from tools.experiments.relocation.trial import Moment, Robot
from tools.experiments.relocation.worlds import PERIOD_S, Place, Site, lit_house, odometry
from tools.sim.building.people import Crowd
from tools.sim.ceiling.ceiling import Effects

pytestmark = pytest.mark.jit

HOUSE = Site(lit_house(), Effects(), 1)
OTHER = Site(lit_house(seed=11), Effects(), 2)
FRAME = np.array((7.0, -4.0, 1.1))
"""T_own_survey: where the survey lies in the frame of maps made without lamps."""
SOON_S = 10.0
"""From the start; light knows the place after some 7 s."""


def records(site: Site, begin: float, seconds: float, lit: bool) -> Iterator[list[Record]]:
    """What arrives from scan to scan of a part of the building's tour."""

    def at(t: Array) -> Array:
        return drive_of(site.place).pose(np.asarray(t) + begin)

    streams: list[Any] = [odometry(at, (0.0, seconds), np.random.default_rng(3))]
    streams.append(site.scan(k, at, Crowd(())) for k in range(int(seconds / PERIOD_S)))
    if lit:
        streams.append(site.light(at, (0.0, seconds), 3))
    pending: list[Record] = []
    for record in merge(*streams, key=lambda one: one.t_end):
        pending.append(record)
        if isinstance(record, Scan):
            yield pending
            pending = []


@cache
def made(site: Site, begin: float, seconds: float, lit: bool = False) -> MapImage:
    """A map of a part of the tour; one without lamps lies in a frame of its own."""
    lights = LightsSetup(site.survey, clock_ppm=0.0) if lit else None
    robot = Robot(new_state(None, lights), Observer(0.0, odometry=True, lights=lit))
    start = se2.compose(FRAME, drive_of(site.place).pose(np.array([begin]))[0])
    for k, arrived in enumerate(records(site, begin, seconds, lit)):
        order: list[Record] = [Command(0.0, Order.SET_POSE, start)] if k == 0 and not lit else []
        robot.take(arrived[-1].t_end, [*order, *arrived])  # type: ignore[union-attr]
    robot.take(seconds, [])
    image = finished(image_of(robot.state))
    assert image.identity.surveyed is lit
    return image


@dataclass
class Drive:
    """A robot under lamps on the tour, switched on in a stored map."""

    image: MapImage
    begin: float
    site: Site = HOUSE
    settings: Settings = field(default_factory=Settings)
    longest: float = 90.0
    said: list[Moment] = field(default_factory=list)

    def __post_init__(self) -> None:
        lights = LightsSetup(self.site.survey, clock_ppm=0.0)
        state = restored(self.image, self.settings, lights)
        self.robot = Robot(state, Observer(0.0, odometry=True, lidar=True, lights=True))
        self._records = records(self.site, self.begin, self.longest, lit=True)

    @property
    def state(self) -> State:
        return self.robot.state

    def on(self, seconds: float) -> list[Moment]:
        """So much further; what was said then."""
        for arrived in itertools.islice(self._records, round(seconds / PERIOD_S)):
            t = arrived[-1].t_end  # type: ignore[union-attr]
            self.robot.take(t, arrived)
            true = drive_of(self.site.place).pose(np.array([self.robot.t_mono + self.begin]))[0]
            self.said.append(self.robot.moment(t, true))
        return self.said[-round(seconds / PERIOD_S) :]

    def tracking_since(self) -> float:
        """When TRACKING was said first, s."""
        return next(one.t for one in self.said if one.state == Said.TRACKING)

    def never_wrong(self) -> bool:
        """Whether nothing was given that is far off, nor TRACKING said of what is off."""
        return not any(one.astray or one.far for one in self.said)

    def stored_off(self) -> float:
        """By how much (m) a submap of the stored map is off in the survey's frame, at most."""
        off = [
            se2.between(se2.between(FRAME, piece.T_map_submap), self.state.map.graph.submaps[piece.key].T_map_submap)
            for piece in self.image.submaps
            if piece.key in self.state.map.graph.submaps
        ]
        assert off
        return float(np.max(np.hypot(*np.array(off)[:, :2].T)))


def test_a_map_of_one_glance_is_no_reason_to_be_lost_and_is_let_go_of_where_it_is_driven_out_of() -> None:
    drive = Drive(made(HOUSE, 0.0, 4.0), 60.0)
    drive.on(8.0)
    assert drive.robot.result is not None
    assert drive.robot.result.aside
    assert drive.state.relocalisation.maps_dropped == 0
    drive.on(17.0)
    assert drive.tracking_since() < SOON_S
    assert drive.never_wrong()
    assert drive.robot.result.let_go == 1
    assert not drive.robot.result.aside
    image = image_of(drive.state)
    assert image.identity.surveyed
    assert min(piece.key for piece in image.submaps) > max(piece.key for piece in drive.image.submaps)


def test_until_that_is_decided_the_stored_map_is_what_there_is_to_be_saved() -> None:
    drive = Drive(made(HOUSE, 0.0, 4.0), 60.0)
    drive.on(9.0)
    assert drive.state.map.parts.aside is not None
    assert drive.state.map.parts.unproved == drive.state.map.parts.aside.first
    image = image_of(drive.state)
    assert not image.identity.surveyed
    assert [one.key for one in image.submaps] == [one.key for one in drive.image.submaps]
    assert all(a.T_map_submap is not None and np.array_equal(a.T_map_submap, b.T_map_submap)
               for a, b in zip(image.submaps, drive.image.submaps, strict=True))  # fmt: skip
    assert len(image.frames) == len(list(drive.image.keyframes()))


@pytest.mark.slow
@pytest.mark.parametrize("localise", [False, True])
def test_half_of_the_building_is_found_on_the_way_and_laid_to_where_it_belongs(localise: bool) -> None:
    """The pose does not jump for that; what is only used is not let go of by being found."""
    drive = Drive(made(HOUSE, 60.0, 40.0), 20.0, settings=Settings(localise=localise))
    drive.on(9.0)
    assert drive.state.map.parts.aside is not None
    assert not drive.state.map.parts.fixed, "loops of a map that is its own do not move a robot that light holds"
    assert drive.tracking_since() < SOON_S
    while drive.state.map.parts.aside is not None and len(drive.said) < 450:
        jumps = drive.state.pose.jumps
        drive.on(PERIOD_S)
    assert drive.state.pose.jumps == jumps
    assert drive.state.map.parts.fixed is localise
    assert drive.state.relocalisation.maps_dropped == 0
    assert drive.state.map.parts.unproved is not None
    assert not image_of(drive.state).identity.surveyed  # while it is watched
    while drive.state.map.parts.trial is not None:
        drive.on(1.0)
    assert drive.never_wrong()
    assert drive.stored_off() < 0.25
    assert image_of(drive.state).identity.surveyed
    assert drive.said[-1].off_m < 0.15
    assert set(drive.state.map.keyframes) <= {key for keys in drive.state.map.places.values() for key in keys}


@pytest.mark.slow
def test_a_map_of_another_building_is_let_go_of_when_as_much_was_driven_as_it_is_of() -> None:
    drive = Drive(made(OTHER, 0.0, 15.0), 60.0)
    drive.on(9.0)
    aside_now = drive.state.map.parts.aside
    assert isinstance(aside_now, SearchedAside)
    enough = unaligned_map.enough(drive.state.map.settings.keyframe_m, aside_now)
    assert unaligned_map.LEAST_M < enough < unaligned_map.MOST_M
    while drive.state.map.parts.aside is not None:
        drive.on(PERIOD_S)
    assert drive.state.map.graph.way_m - aside_now.begun_m >= enough
    assert drive.state.relocalisation.maps_dropped == 1
    assert drive.tracking_since() < SOON_S
    assert drive.never_wrong()


def test_a_building_that_was_taken_for_this_one_is_taken_out_again_and_nobody_is_lost_for_it() -> None:
    drive = Drive(made(OTHER, 0.0, 15.0), 60.0)
    drive.on(9.0)
    stored = drive.state.map.parts.aside
    assert isinstance(stored, SearchedAside)
    frame, key = drive.state.map.keyframes[drive.state.pose.anchor], max(stored.submaps)
    T_map = stored.submaps[key].T_map_submap
    fit = Fit(T_map, np.diag((1e-4, 1e-4, 1e-5)), 0.9, 0.0, 0.01, key, se2.identity(), Verdict.HOLDS)
    mapped = set(drive.state.map.graph.submaps)
    unaligned_map.found(drive.state, stored, Hypothesis(se2.identity(), ((frame, fit),), 1, 0, 0.9, (frame, fit), 1))
    assert set(stored.submaps) | mapped == set(drive.state.map.graph.submaps)
    while drive.state.map.parts.aside is None and len(drive.said) < 300:
        drive.on(PERIOD_S)
    again = drive.state.map.parts.aside
    assert again is not None
    assert again.begun_m == stored.begun_m
    assert not set(again.submaps) & set(drive.state.map.graph.submaps)
    joined = set(drive.state.map.graph.constraints.between.ravel().tolist())
    assert joined <= set(drive.state.map.graph.submaps)
    drive.on(10.0)
    assert drive.never_wrong()
    assert drive.said[-1].off_m < 0.15
    assert drive.state.map.parts.detached is None


def test_carried_off_beside_a_map_that_is_set_aside_the_search_in_that_begins_anew() -> None:
    drive = Drive(made(HOUSE, 60.0, 40.0), 20.0)
    drive.on(12.0)
    stored = drive.state.map.parts.aside
    assert isinstance(stored, SearchedAside)
    search = stored.search
    drive.robot.take(drive.said[-1].t, [Command(drive.said[-1].t, Order.RELOCALISE)])
    assert drive.state.map.parts.detached is not None
    assert drive.state.map.parts.aside is stored
    assert stored.search is not search
    drive.on(5.0)
    assert drive.state.map.parts.detached is None
    assert drive.never_wrong()
    drive.robot.take(drive.said[-1].t, [Command(drive.said[-1].t, Order.RESET)])
    assert drive.state.map.parts.aside is None
    assert drive.state.map.parts.unproved is None
    assert drive.state.relocalisation.maps_dropped == 0


def test_a_kept_state_holds_what_was_set_aside() -> None:
    drive = Drive(made(HOUSE, 0.0, 4.0), 60.0)
    drive.on(8.0)
    state, _ = restore(capture(drive.state, {}).nodes())
    stored, kept = state.map.parts.aside, drive.state.map.parts.aside
    assert isinstance(stored, SearchedAside)
    assert kept is not None
    assert list(stored.submaps) == list(kept.submaps)
    assert all(frame.submap.key in stored.submaps for frame in stored.frames.values())


@pytest.mark.parametrize(("begin", "soon_s"), [pytest.param(30.0, 7.0, marks=pytest.mark.slow), (100.0, 15.0)])
def test_lamps_that_were_moved_and_surveyed_anew_cost_neither_the_map_nor_the_place(
    begin: float, soon_s: float
) -> None:
    """In what is mapped, where laser and the other lamps tell it, and beyond, where light alone has to for a while."""
    place = HOUSE.place
    moved = [replace(one, x=one.x + 0.8, y=one.y + 0.5) if n % 5 < 2 else one for n, one in enumerate(place.lamps)]
    site = Site(Place(place.building, tuple(moved), place.rooms), Effects(), 1)
    image = made(HOUSE, 0.0, 60.0, lit=True)
    drive = Drive(replace(image, gains={}), begin, site)
    drive.on(20.0)
    assert drive.tracking_since() < soon_s
    assert drive.never_wrong()
    assert drive.state.relocalisation.maps_dropped == 0
    assert all(piece.key in drive.state.map.graph.submaps for piece in image.submaps[-2:])
