"""Recorded teach drive: poses by the lidar alone, and the RSS of each lamp at these poses.

The poses are those of a replay without lights, by the final map. The calibrated quantities therefore do not affect
them. The light is decoded again from the recorded blocks. A computer without a robot to drive permits more effort for
that than a cycle.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from daemon.config.schema import Config
from daemon.devices.conversion import SampleBridge
from daemon.replay.recorded_inputs import Given, config_for, lights_for
from daemon.replay.results import Trajectory, doubt
from daemon.replay.runner import Rerun
from daemon.replay.sources import Source
from estimator import UNUSABLE, Array, LightEpoch, Profile, Survey, decode, new_decoder, search
from estimator.calibration import Heard, Rows
from hal.adc import RawSamples
from hal.errors import DataInvalid, HalError
from hal.odometry import RawOdometry

SEARCH_CODES: Final = 2000
"""Codes searched per block; a replay has no cycle to keep."""
GAP_S: Final = 0.3
"""Largest gap between two poses, s; an RSS in a larger gap has no position."""


@dataclass(slots=True, eq=False)
class Drive:
    """Content of a recording.

    Attributes:
        path: of the recording. poses: T_map_base by the lidar, with stamps. survey: as it was when recorded.
        epochs: decoded, with stamps of their middles on the same clock, s.
        readings: of the odometry, (n, 4) stamp, x, y, yaw (s, m, m, rad).
        config: the recording's, or the requested one.
        profile: air interface of the light, None without a photodiode.
        stopped: why reading ended early, empty otherwise. doubt: why its poses are not reliable, empty if they are.
    """

    path: Path
    poses: Trajectory
    survey: Survey
    epochs: list[tuple[float, LightEpoch]] = field(default_factory=list)
    readings: Array = field(default_factory=lambda: np.zeros((0, 4)))
    config: Config = field(default_factory=Config)
    profile: Profile | None = None
    stopped: str = ""
    doubt: str = ""

    @property
    def warnings(self) -> list[str]:
        """What limits the use of the drive, one sentence each."""
        return [
            *([f"{self.stopped}; the drive is used up to there"] if self.stopped else []),
            *filter(None, [self.doubt]),
        ]

    @property
    def mount(self) -> Array:
        """(3,) x, y, yaw of the lidar on the robot, with which the poses were computed; m and rad."""
        mount = self.config.lidar.mount
        return np.array((mount.x, mount.y, np.radians(mount.yaw)))


def read_drive(source: Source, settings: Config, given: Given) -> Drive:
    """Replays a recording for its poses and decodes its light.

    Raises:
        HalError: it has no scans, or its light setup is not of this version.
    """
    used = config_for(source, settings, given)
    lights = lights_for(source, used, given)
    drive = Drive(source.path, Trajectory(np.zeros(0), np.zeros((0, 3))), Survey() if lights is None else lights.survey)
    drive.config, drive.profile = used, None if lights is None else lights.profile
    rerun, readings = Rerun(source, used), []
    bridge = None if lights is None else SampleBridge(lights.profile)
    decoder = None if lights is None else new_decoder(lights.profile, lights.clock_ppm)
    try:
        for event in source.events():
            if isinstance(event, RawSamples):
                block = None if bridge is None else bridge.block(event)
                if block is not None and decoder is not None:
                    epoch = decode(decoder, block)
                    search(decoder, SEARCH_CODES)
                    drive.epochs.append((source.utc(0.5 * (epoch.t_begin + epoch.t_end)), epoch))
                continue
            if isinstance(event, RawOdometry):
                readings.append((source.utc(event.t_mono), event.x, event.y, event.yaw))
            rerun.feed(event)
    except HalError as error:
        drive.stopped = str(error)
    rerun.finish()
    drive.doubt = doubt(rerun.ledger.online())
    drive.poses, drive.readings = rerun.ledger.final(), np.array(readings).reshape(-1, 4)
    _check(source, drive)
    return drive


def _check(source: Source, drive: Drive) -> None:
    if len(drive.poses.stamps) < 2:
        remedy = "record the drive with the lidar on; the lidar gives the poses"
        raise DataInvalid(str(source.path), f"{source.kind} without scans that gave a pose", remedy)


def heard(drive: Drive) -> Heard:
    """Returns every RSS without a flag, at the pose of its instant.

    Raises:
        DataInvalid: no light was decoded.
    """
    parts = [part for stamp, epoch in drive.epochs for part in _strengths(stamp, epoch)]
    if not parts:
        remedy = "configure the photodiode (photodiode.bus) and drive with lamps in view; see docs/calibration.md"
        raise DataInvalid(str(drive.path), "no lamp was decoded in the recording", remedy)
    t, code, amplitude, sigma, name = np.array(parts).T
    pose, known = poses_at(drive.poses, t)
    rows = Rows(pose[known], code[known].astype(np.int64), amplitude[known], sigma[known], t[known])
    return Heard(rows, name[known].astype(np.int64))


def _strengths(stamp: float, epoch: LightEpoch) -> Iterator[tuple[float, ...]]:
    """Yields stamp, code, amplitude, sigma of its ln, and lamp ID (-1: unknown) of each link without a flag."""
    if epoch.block & UNUSABLE:
        return
    columns = (epoch.ids.tolist(), epoch.amplitude.tolist(), epoch.variance.tolist(), epoch.flags.tolist())
    for code, amplitude, variance, flag, frame in zip(*columns, epoch.lamps, strict=True):
        if flag == 0 and amplitude > 0.0:
            yield stamp, code, amplitude, variance**0.5 / amplitude, -1 if frame is None else frame.lamp_id


def poses_at(trajectory: Trajectory, t: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Returns poses (n, 3) interpolated at ``t`` (n,), s, and (n,) whether the poses on both sides are near enough."""
    order = np.argsort(trajectory.stamps, kind="stable")
    stamps, poses = trajectory.stamps[order], trajectory.poses[order]
    yaw = np.unwrap(poses[:, 2])
    after = np.clip(np.searchsorted(stamps, t), 1, len(stamps) - 1)
    between = (stamps[after - 1] <= t) & (t <= stamps[after]) & (stamps[after] - stamps[after - 1] < GAP_S)
    columns = [np.interp(t, stamps, values) for values in (poses[:, 0], poses[:, 1], yaw)]
    return np.column_stack(columns), between


def rows_for(survey: Survey, strengths: Heard, T_survey_drive: Array) -> Rows:
    """Returns the rows of the survey's lamps: matched by the received lamp ID, else by code and the nearest such lamp.

    ``rows.lamp`` is the index in the survey; poses stay in the drive's frame. An RSS with a code outside the survey is
    omitted.
    """
    x, y, yaw = T_survey_drive
    c, s = np.cos(yaw), np.sin(yaw)
    pose = strengths.rows.pose
    there = np.column_stack((x + c * pose[:, 0] - s * pose[:, 1], y + s * pose[:, 0] + c * pose[:, 1]))
    best, far = np.full(len(pose), -1, dtype=np.int64), np.full(len(pose), np.inf)
    for k, lamp in enumerate(survey.lamps):
        mine = (strengths.rows.lamp == lamp.code) & ((strengths.lamp_id < 0) | (strengths.lamp_id == lamp.lamp_id))
        distance = np.hypot(there[:, 0] - lamp.x, there[:, 1] - lamp.y)
        nearer = mine & (distance < far)
        best[nearer], far[nearer] = k, distance[nearer]
    known = best >= 0
    rows = strengths.rows.chosen(known)
    return Rows(rows.pose, best[known], rows.amplitude, rows.sigma, rows.t)
