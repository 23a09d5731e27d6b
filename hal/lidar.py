"""The contract between a 2D lidar's driver and the daemon: scans in device units, geometry, status.

Units are the device's own (steps, range units, device ticks). Only ``daemon/devices/conversion.py`` turns them into SI
and frames.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from hal.errors import HalError

VALID: Final = -1
"""Value of :attr:`RawScan.code` where the range is a measured distance."""


@dataclass(frozen=True, slots=True)
class LidarGeometry:
    """Geometry that the device itself reports (SCIP ``VV``/``PP``, a log's header), never hard-coded by model.

    Attributes:
        ares: steps per full turn; not necessarily whole for a log.
        afrt: step that points along the device's x axis (front); not necessarily whole for a log, nor measurable.
        amin, amax: first and last measurable step.
        dmin, dmax: legal distances in range units; below ``dmin`` a value is an error code, above ``dmax`` no return.
            A driver knows further codes between the two.
        range_unit_m: metres per range unit (SCIP: 0.001).
        period_s: nominal time of a revolution in seconds (SCIP ``60 / SCAN``).
        beam_dt_s: time between adjacent steps in seconds; 0 where a log does not give it.
    """

    model: str
    serial: str
    firmware: str
    ares: float
    afrt: float
    amin: int
    amax: int
    dmin: int
    dmax: int
    range_unit_m: float
    period_s: float
    beam_dt_s: float

    def bearings(self, first_step: int, stride: int, count: int) -> npt.NDArray[np.float64]:
        """Bearings in rad of ``count`` beams, counter-clockwise positive seen from above, zero at ``afrt``.

        Each beam stands for ``stride`` adjacent steps, the first one from ``first_step`` on. Its bearing is that of
        their middle.
        """
        steps = first_step + 0.5 * (stride - 1) + stride * np.arange(count, dtype=np.float64)
        return np.asarray((steps - self.afrt) * (2.0 * np.pi / self.ares))


@dataclass(frozen=True, slots=True, eq=False)
class RawScan:
    """One revolution as the device reported it. Arrays have one element per beam, in order of increasing step.

    Attributes:
        seq: counts complete scans of this driver from 0; gaps mean scans that were received but unusable.
        t_rx: ``t_mono`` at which the last byte arrived, taken before any decoding.
        t_mono: ``t_mono`` at which the middle of the first beam was measured (device clock mapped to the host's).
        t_sigma: one-sigma uncertainty of ``t_mono`` in seconds.
        t_tick: the device's own stamp (24-bit milliseconds for SCIP), -1 where there is none.
        first_step: the first step of the first beam. stride: steps of a beam (`LidarGeometry.bearings`).
        ranges: int32, range units, 0 where ``code`` is not :data:`VALID`.
        code: int32, :data:`VALID` or the raw value that was no distance (an error code, or above dmax).
        intensity: int32 or None.
        echoes: int32 of shape (beams, 3), further echoes of a multi-echo device, 0 where none; or None.
    """

    geometry: LidarGeometry
    seq: int
    t_rx: float
    t_mono: float
    t_sigma: float
    t_tick: int
    first_step: int
    stride: int
    ranges: npt.NDArray[np.int32]
    code: npt.NDArray[np.int32]
    intensity: npt.NDArray[np.int32] | None = None
    echoes: npt.NDArray[np.int32] | None = None


class Link(Enum):
    """Connection state of a device, for the daemon's state machine."""

    CLOSED = "closed"
    OPENING = "opening"
    STREAMING = "streaming"
    WAITING = "waiting"  # backing off before the next attempt; the status carries the error


@dataclass(slots=True)
class LidarStatus:
    """Live state and counters of a driver, for the daemon's health and ``lumiloop status``.

    Attributes:
        error: the latest problem, kept until a valid scan has arrived.
        scans: valid scans delivered. missed: revolutions missing according to the stamps.
        invalid: frames dropped (checksum, step count, stamp). resyncs: times the stream had to be found again.
        reconnects: times the device was reopened. clock_resets: times the device clock restarted.
        dialect: protocol variant in use, for people (``SCIP 2.0 MD``).
    """

    link: Link = Link.CLOSED
    error: HalError | None = None
    scans: int = 0
    missed: int = 0
    invalid: int = 0
    resyncs: int = 0
    reconnects: int = 0
    clock_resets: int = 0
    dialect: str = ""
    extra: dict[str, str] = field(default_factory=dict)


class Lidar(Protocol):
    """A lidar driver. It supervises itself: `run` raises for no failure of a device."""

    @property
    def geometry(self) -> LidarGeometry | None:
        """The device's geometry once known."""
        ...

    @property
    def status(self) -> LidarStatus:
        """Live state and counters."""
        ...

    async def run(self, on_scan: Callable[[RawScan], None]) -> None:
        """Open, stream, recover; deliver every valid scan to ``on_scan`` from the loop thread.

        Returns only when the source is exhausted (a log's end); a real device runs until cancelled, and on
        cancellation the laser is switched off (``QT``).
        """
        ...
