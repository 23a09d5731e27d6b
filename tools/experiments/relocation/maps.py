"""The maps that robots are switched on with: made by one drive through the building, and kept.

In the light the drive starts knowing nothing; without light it is told where it starts, so that map and truth have one
frame. All background jobs answer with the next scan.
"""

from __future__ import annotations

import copyreg
import pickle
from heapq import merge
from pathlib import Path
from typing import Any, Final
from weakref import WeakSet

import numpy as np

from daemon.integrity.observer import Observer
from estimator.light_filter.light_channel import LightsSetup
from estimator.mapping.map_snapshot import MapImage
from estimator.measurements import Array, Command, Order, Record, Scan
from estimator.pipeline import new_state
from estimator.stored_map import image_of
from tools.experiments.relocation.trial import Robot
from tools.experiments.relocation.worlds import BODY, PERIOD_S, Place, Site, odometry
from tools.sim.building.people import Crowd
from tools.sim.robot.drive import Drive

LAPS: Final = 1


def drive_of(place: Place) -> Drive:
    """The drive that makes the map."""
    return Drive(place.building.route, BODY, 2.0, LAPS)


def mapped(site: Site, lights: LightsSetup | None, seconds: float = float("inf")) -> tuple[MapImage, Array]:
    """The map, and (n, 4) rows of instant and error (m, m, rad) of the pose as published live."""
    drive = drive_of(site.place)
    end = min(seconds, LAPS * drive.lap_s + 1.0)
    robot = Robot(new_state(None, lights), Observer(0.0, odometry=True, lights=lights is not None))
    rng = np.random.default_rng((site.seed, 6))
    nobody = Crowd(())
    streams: list[Any] = [odometry(drive.pose, (0.0, end), rng)]
    streams.append(site.scan(k, drive.pose, nobody) for k in range(int(end / PERIOD_S)))
    pending: list[Record] = []
    if lights is None:
        pending.append(Command(0.0, Order.SET_POSE, drive.pose(np.zeros(1))[0]))
    else:
        streams.append(site.light(drive.pose, (0.0, end), site.seed))
    errors = []
    for record in merge(*streams, key=lambda one: one.t_end):
        pending.append(record)
        if not isinstance(record, Scan):
            continue
        robot.take(record.t_end, pending)
        pending = []
        now = robot.moment(record.t_end, drive.pose(np.array([robot.t_mono]))[0])
        errors.append((now.t, now.off_m, now.off_rad, float(now.given)))
    while robot.waiting:
        robot.take(end, [])
    return image_of(robot.state), np.array(errors)


def kept_map(path: Path, site: Site, lights: LightsSetup | None) -> MapImage:
    """The map of a site, from the file where it was kept or by a drive."""
    if path.exists():
        found = unpickled(path)
        assert isinstance(found, MapImage)
        return found
    image, _ = mapped(site, lights)
    pickled(path, image)
    return image


def pickled(path: Path, what: object) -> None:
    """Keep something for other processes of the same program."""
    copyreg.pickle(WeakSet, lambda _: (WeakSet, ()))  # of what hangs on a submap an image has a table of its own
    with path.open("wb") as kept:
        pickle.dump(what, kept)


def unpickled(path: Path) -> object:
    """What was kept."""
    with path.open("rb") as kept:
        return pickle.load(kept)
