"""Converts the data replies of one stream to `RawScan`: ranges and codes, ``t_mono`` from stamps, losses counted."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from hal.hokuyo.models import Identity
from hal.hokuyo.payload import Ints, ScanReply, ScanRequest, parse_scan
from hal.hokuyo.scip import Reply
from hal.hokuyo.ticks import ScanTime, TickClock
from hal.lidar import VALID, LidarStatus, RawScan

_SATURATED_2CHAR: Final = 4095  # MS and GS report this for every longer distance


class ScanStream:
    """Turns the data replies to one request into scans.

    Args:
        identity: of the sensor.
        request: of the stream.
        status: its counters ``missed`` and ``clock_resets`` are updated.
        bytes_per_s: speed of the line; part of the time between measurement and arrival.
    """

    def __init__(self, identity: Identity, request: ScanRequest, status: LidarStatus, bytes_per_s: float) -> None:
        self.identity = identity
        self.request = request
        self._status = status
        # data leave right after the last measurable step, whatever part of the turn was requested (C-42-03320B);
        # a UST waits for the next tick of its millisecond clock: one more delay for the envelope
        geometry, turns = identity.geometry, request.skip + 1
        self._clock = TickClock(
            geometry.period_s * turns, geometry.amax / geometry.ares / turns, request.frame_bytes / bytes_per_s
        )
        self._resets_seen = 0

    @property
    def stuck(self) -> bool:
        """The sensor repeats one stamp: it has stopped measuring."""
        return self._clock.stuck

    @property
    def period_s(self) -> float:
        """Learned time between two scans of the stream, host seconds."""
        return self._clock.period_s

    def decode(self, reply: Reply, t_rx: float, seq: int, untimed: bool = False) -> RawScan | None:
        """Decode and time one data reply; None where its time cannot be determined.

        ``untimed``: such a scan gets its arrival time with infinite uncertainty instead.

        Raises:
            BadFrame: the reply is damaged or belongs to another request.
        """
        data = parse_scan(self.request, reply)
        when = self._clock.feed(data.stamp, t_rx)
        if self._clock.resets != self._resets_seen:
            self._status.clock_resets += self._clock.resets - self._resets_seen
            self._resets_seen = self._clock.resets
        if when is None:
            if not untimed:
                return None
            when = ScanTime(t_rx, math.inf, 1)
        self._status.missed += when.periods - 1
        return self._scan(data, when, t_rx, seq)

    def _scan(self, data: ScanReply, when: ScanTime, t_rx: float, seq: int) -> RawScan:
        geometry, request = self.identity.geometry, self.request
        distance = data.distance[: request.whole_groups]
        valid = self._valid(distance)
        beam_dt_s = self._clock.period_s / (request.skip + 1) / geometry.ares
        return RawScan(
            geometry=geometry,
            seq=seq,
            t_rx=t_rx,
            t_mono=when.t_mono + (request.start + 0.5 * (request.stride - 1)) * beam_dt_s,
            t_sigma=when.t_sigma,
            t_tick=data.stamp,
            first_step=request.start,
            stride=request.stride,
            ranges=np.where(valid, distance, np.int32(0)),
            code=np.where(valid, np.int32(VALID), distance),
            intensity=None if data.intensity is None else data.intensity[: request.whole_groups],
            echoes=None if data.echoes is None else self._echoes(data.echoes[: request.whole_groups]),
        )

    def _echoes(self, echoes: Ints) -> Ints:
        return np.where(self._valid(echoes), echoes, np.int32(0))

    def _valid(self, distance: Ints) -> npt.NDArray[np.bool_]:
        valid = self.identity.is_distance(distance)
        return valid & (distance < _SATURATED_2CHAR) if self.request.form.chars == 2 else valid
