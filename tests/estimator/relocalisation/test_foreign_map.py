"""A map that was made without light, in a frame of its own, and the robot that is switched on in it under lamps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from heapq import merge
from typing import Any

import numpy as np
import pytest

from daemon.integrity.observer import Observer
from daemon.snapshot import State as Said
from estimator.light_filter.light_channel import LightsSetup
from estimator.mapping.map_snapshot import MapImage
from estimator.measurements import Command, Order, Record, Scan
from estimator.numerics import se2
from estimator.pipeline import Settings, new_state
from estimator.stored_map import image_of, restored
from tools.experiments.relocation.trial import Robot
from tools.experiments.relocation.worlds import Site, Stroll, lit_house, odometry
from tools.sim.building.people import Crowd
from tools.sim.ceiling.ceiling import Effects

pytestmark = pytest.mark.jit

MILD = Effects(gain_spread=0.02, bounces=0, obstacles=False, people=False, sway=False)
SITE = Site(lit_house(), MILD, 1)
WAY = Stroll(np.array((2.2, 3.2, 0.3)), 0.5, 0.55)
FRAME = np.array((7.0, -4.0, 1.1))
"""T_own_survey: where the survey lies in the map's own frame."""


def records(end: float, lit: bool) -> Iterator[list[Record]]:
    """What arrives from scan to scan."""
    streams: list[Any] = [odometry(WAY.at, (0.0, end), np.random.default_rng(3))]
    streams.append(SITE.scan(k, WAY.at, Crowd(())) for k in range(int(end / 0.1)))
    if lit:
        streams.append(replace(one, lamps=(None,) * len(one.ids)) for one in SITE.light(WAY.at, (0.0, end), 1))
    pending: list[Record] = []
    for record in merge(*streams, key=lambda one: one.t_end):
        pending.append(record)
        if isinstance(record, Scan):
            yield pending
            pending = []


def made() -> MapImage:
    robot = Robot(new_state(), Observer(0.0, odometry=True))
    at = se2.compose(FRAME, WAY.at(np.zeros(1))[0])
    for k, arrived in enumerate(records(13.0, lit=False)):
        orders: list[Record] = [Command(0.0, Order.SET_POSE, at)] if k == 0 else []
        robot.take(arrived[-1].t_end, [*orders, *arrived])  # type: ignore[union-attr]
    assert not image_of(robot.state).identity.surveyed
    return image_of(robot.state)


def test_a_map_of_another_frame_comes_to_where_light_has_the_robot_and_is_the_surveys_from_then_on() -> None:
    image = made()
    before = {piece.key: piece.T_map_submap for piece in image.submaps}
    state = restored(image, Settings(), LightsSetup(SITE.survey, clock_ppm=0.0))
    assert state.relocalisation.unaligned
    robot = Robot(state, Observer(0.0, odometry=True, lidar=True, lights=True))
    off, said = [], []
    for arrived in records(50.0, lit=True):
        t = arrived[-1].t_end  # type: ignore[union-attr]
        robot.take(t, arrived)
        off.append(robot.moment(t, WAY.at(np.array([robot.t_mono]))[0]).off_m)
        said.append(robot.memory.state)
        if said[-1] is Said.TRACKING and state.map.parts.trial is not None:
            assert not image_of(state).identity.surveyed
        if len(said) > 140 and state.map.parts.trial is None:
            break
    assert state.map.parts.detached is None
    assert not state.relocalisation.unaligned
    assert max(off[-20:]) < 0.15
    wrong = [m for m, state_said in zip(off, said, strict=True) if state_said is Said.TRACKING and m > 0.5]
    assert not wrong
    for key, T_own in before.items():
        true = se2.between(FRAME, T_own)
        x, y, yaw = se2.between(true, state.map.graph.submaps[key].T_map_submap).tolist()
        assert np.hypot(x, y) < 0.2
        assert abs(yaw) < 0.06
    assert image_of(state).identity.surveyed
    listed = {key for keys in state.map.places.values() for key in keys}
    assert set(state.map.keyframes) <= listed
