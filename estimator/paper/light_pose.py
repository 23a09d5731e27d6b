"""The paper's light filter: an EKF of odometry and of positions by the shortest links (Eq. 5-7).

    Eq. 5    z = h(x) + delta, delta ~ N(0, Q):    z receiver position by Eq. 3, 4; h(x) = p + R(theta) l
    Eq. 6    p(z | x):                             Q the position's covariance; `misfit` is the fit of the links
    Eq. 7    J = dh/dx = [1  R'(theta) l]

x = (p, theta) is the pose of the base in the survey frame, l the receiver's lever arm. A single photodiode gives no
heading. So the initialisation collects positions along the odometry path and aligns the two by Eq. 13.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

import numpy as np

from estimator.cdma import decoder
from estimator.cdma.epoch import BlockFlag
from estimator.fusion.motion_model import MotionNoise, odometry_variance
from estimator.light_filter.lamp_catalogue import catalogue_of
from estimator.light_filter.light_channel import LightsSetup
from estimator.measurements import LightEpoch, Odometry, Record, SampleBlock
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import symmetric
from estimator.paper.lateration import Place, Prior
from estimator.paper.lateration_model import LINK_N, Solver, SolverSettings
from estimator.paper.point_to_point_sums import align
from estimator.paper.shortest_link import PAUSED, links_of, misfit, select
from estimator.result import Fix, LightsResult, Virtual

BASE_M: Final = 1.0
"""Extent of the path over which the initialisation aligns, m."""
SPACING_M: Final = 0.05
"""Path length between two positions of the initialisation, m."""
CAPACITY: Final = 200
"""Most positions of an initialisation; the oldest are dropped, so that wheel slip does not block it for good."""
FITS: Final = 0.5
"""Largest RMS distance of the positions from the aligned path, as a share of the path's RMS extent, for acceptance."""
STALE_S: Final = 0.5
"""Age (s) from which the latest epoch gives no pose any more."""


class LightPose:
    """The light solution by the paper's means.

    Attributes:
        settings: solver and Link_n.
        T, P: pose (x, y, yaw) and covariance (3, 3) at ``t_mono``. In the survey frame once ``aligned``, before
            that in the frame of the odometry's start.
        velocity: (v_x, v_y, yaw rate), base frame.
        selection: links and position of the latest epoch.
        result: after the latest epoch.
    """

    def __init__(self, setup: LightsSetup, noise: MotionNoise, link_n: int = LINK_N) -> None:
        """Create the initial state; raises ValueError for an impossible survey or stored sample clock."""
        self.setup, self.noise = setup, noise
        self.settings = SolverSettings(Solver.LS, link_n)
        self.decoder = decoder.new_decoder(setup.profile, setup.clock_ppm, {lamp.code for lamp in setup.survey.lamps})
        self.catalogue = catalogue_of(setup.survey)
        self.lever = np.array((setup.survey.receiver.x, setup.survey.receiver.y))
        self.T, self.P, self.velocity = se2.identity(), np.zeros((3, 3)), np.zeros(3)
        self.t_mono = self.t_epoch = -math.inf
        self.aligned = False
        self.selection = PAUSED
        self._start: deque[tuple[Array, Array]] = deque(maxlen=CAPACITY)
        self.result = self._result(None)

    def receive(self, record: Record) -> None:
        """Process odometry, a block of samples or an epoch; ignore other records."""
        match record:
            case Odometry():
                self.predict(record)
            case SampleBlock():
                self.update(decoder.decode(self.decoder, record))
            case LightEpoch():
                self.update(record)

    def search(self, codes: int) -> None:
        """Continue the acquisition of lamps, with an effort of so many codes."""
        decoder.search(self.decoder, codes)

    def predict(self, record: Odometry) -> None:
        """Prediction: the pose and its covariance after an odometry increment."""
        dt = record.t_end - record.t_begin
        if not (dt > 0.0 and np.isfinite(record.delta).all()):
            return
        R, x, y = se2.rotation(self.T[2]), float(record.delta[0]), float(record.delta[1])
        turned = R[:2, :2] @ (-y, x)
        F = np.array(((1.0, 0.0, turned[0]), (0.0, 1.0, turned[1]), (0.0, 0.0, 1.0)))
        self.P = F @ self.P @ F.T + R @ np.diag(odometry_variance(record.delta, dt, self.noise)) @ R.T
        self.T, self.t_mono = se2.compose(self.T, record.delta), record.t_end
        self.velocity = se2.log(record.delta) / dt

    def at(self, t_mono: float) -> Array:
        """The pose at an instant near the latest increment, at constant velocity."""
        dt = t_mono - self.t_mono
        return se2.compose(self.T, se2.exp(self.velocity * dt)) if abs(dt) < STALE_S else self.T

    def update(self, epoch: LightEpoch) -> None:
        """Eq. 3-7: select the links, solve for the position, and update the pose or the initialisation with it."""
        T = self.at(0.5 * (epoch.t_begin + epoch.t_end))
        receiver, J = self._receiver(T)
        prior = Prior(receiver, J @ self.P @ J.T + 1e-6 * np.eye(2)) if self.aligned else None
        self.selection = select(epoch, self.catalogue, self.setup.survey, self.settings, prior)
        self.t_epoch = epoch.t_end
        position = self.selection.position
        if position is not None and self.aligned:
            self._correct(position, receiver, J)
        elif position is not None:
            self._align(position, receiver)
        self.result = self._result(epoch)

    def virtual(self, t_mono: float) -> Virtual | None:
        """The light solution at an instant: the virtual components; None while light is paused."""
        accepted = self.selection.accepted
        if not (self.aligned and accepted and t_mono - self.t_epoch < STALE_S):
            return None
        return Virtual(self.at(t_mono), self.P, accepted)

    def misfit(self) -> float:
        """Mean squared normalised residual of the links in use at the pose; 0 without any."""
        used = self.selection.used
        return 0.0 if used is None else misfit(used, self.settings, self._receiver(self.at(self.t_epoch))[0])

    def _receiver(self, T: Array) -> tuple[Array, Array]:
        """Position (2,) of the receiver with the base at ``T``, and its Jacobian (2, 3) by that pose (Eq. 7)."""
        lever = se2.rotation(T[2])[:2, :2] @ self.lever
        return T[:2] + lever, np.array(((1.0, 0.0, -lever[1]), (0.0, 1.0, lever[0])))

    def _correct(self, position: Place, receiver: Array, J: Array) -> None:
        """EKF update by a position (Joseph form)."""
        K = self.P @ J.T @ np.linalg.inv(J @ self.P @ J.T + position.covariance)
        keep = np.eye(3) - K @ J
        self.T = self.T + K @ (position.xy - receiver)
        self.T[2] = se2.wrap(float(self.T[2]))
        self.P = symmetric(keep @ self.P @ keep.T + K @ position.covariance @ K.T)

    def _align(self, position: Place, receiver: Array) -> None:
        """Keep a position, and align the odometry path with the positions once it is long enough (Eq. 13)."""
        if self._start and math.dist(self._start[-1][0], receiver) < SPACING_M:
            return
        self._start.append((receiver, position.xy))
        path, positions = (np.ascontiguousarray(side) for side in zip(*self._start, strict=True))
        around = path - path.mean(axis=0)
        if 2.0 * float(np.hypot(*around.T).max()) < BASE_M:
            return
        T_map_odom = np.empty(3)
        align(path, positions, T_map_odom)
        extent2 = float(np.mean((around**2).sum(axis=1)))
        square = float(np.mean(((se2.apply(T_map_odom, path) - positions) ** 2).sum(axis=1)))
        if square > FITS**2 * extent2:
            return
        variance = 0.5 * max(square, float(np.trace(position.covariance)))
        self.T = se2.compose(T_map_odom, self.T)
        self.P = np.diag((variance, variance, 2.0 * variance / extent2))
        self.aligned = True
        self._start.clear()

    def _result(self, epoch: LightEpoch | None) -> LightsResult:
        """The result after an epoch."""
        accepted, nothing = self.selection.accepted, np.zeros((3, 3))
        found, paused = (Fix.GOOD, Fix.HELD) if self.aligned else (Fix.STARTING, Fix.NONE)
        xy = self._receiver(self.at(self.t_epoch))[0] if self.aligned else None
        return LightsResult(
            t_mono=self.t_epoch,
            fix=found if accepted else paused,
            T_map_base=self.T,
            covariance=self.P,
            links=links_of(self.selection, self.settings, xy),
            accepted=accepted,
            gained=nothing,
            gained_by=np.zeros(3),
            floor=self.setup.survey.floor,
            block=BlockFlag.NONE if epoch is None else epoch.block,
            clock_ppm=None if epoch is None else epoch.clock_ppm,
            t_pose=self.t_mono,
        )
