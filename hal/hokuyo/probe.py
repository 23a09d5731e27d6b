"""Identifies the lidars at this computer's ports and leaves them idle (``lumiloop probe``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from hal.errors import DeviceMissing, HalError
from hal.hokuyo import discover
from hal.hokuyo.scip import BAUD_RATES
from hal.hokuyo.scip_line import Line
from hal.hokuyo.session import Session
from hal.lidar import LidarGeometry
from hal.port.port import PortOpener

_USB_BAUD = 115200


@dataclass(frozen=True, slots=True)
class Finding:
    """The result at one port: a lidar with its geometry, or an error with its remedy.

    Attributes:
        device: the port. geometry: None where nothing was identified. product, protocol: of VV.
        state: the sensor's health text. baud: of an RS-232 line, else 0. error: None for a lidar.
    """

    device: str
    geometry: LidarGeometry | None = None
    product: str = ""
    protocol: str = ""
    state: str = ""
    baud: int = 0
    error: HalError | None = None

    def __str__(self) -> str:
        if self.error is not None:
            return str(self.error)
        if self.geometry is None:
            return f"{self.device}: no data"
        g = self.geometry
        low, high = ((step - g.afrt) * 360.0 / g.ares for step in (g.amin, g.amax))
        line = f", {self.baud} bit/s" if self.baud else ""
        return (
            f"{self.device}: {g.model}, serial {g.serial}, firmware {g.firmware}, {self.protocol}{line}; "
            f"{g.amax - g.amin + 1} beams from {low:+.1f} to {high:+.1f} deg, {1.0 / g.period_s:.1f} Hz, "
            f"{g.dmin * g.range_unit_m:g} to {g.dmax * g.range_unit_m:g} m; {self.state or 'state unknown'}"
        )


async def probe(opener: PortOpener, devices: Sequence[str] = ()) -> list[Finding]:
    """Identify the lidar at each device; a streaming sensor is stopped and left idle.

    Args:
        opener: opens ports (:func:`hal.port.opening.open_port`).
        devices: paths and ``tcp://`` names; empty: every port at which a HOKUYO may be.
    """
    return [await identify_at(opener, device) for device in devices or discover.candidates()]


async def identify_at(opener: PortOpener, device: str, baud: int = 0) -> Finding:
    """Identify the lidar at one device; errors of the device are returned, not raised.

    ``baud``: the rate of an RS-232 line to try first; 0: unknown.
    """
    try:
        rs232 = discover.is_rs232(device, baud)
        port = await opener(device, (baud or BAUD_RATES[0]) if rs232 else _USB_BAUD)
        session = Session(Line(port))
        try:
            if rs232:
                await session.find_rate(baud)
            await session.settle()
            identity = await session.identify()
            await session.quiet()
        except DeviceMissing as error:  # a server of another protocol hangs up
            raise session.foreign_device(session.line.first_bytes) if session.line.is_foreign else error from error
        finally:
            session.line.close()
    except HalError as error:
        return Finding(device, error=error)
    return Finding(
        device,
        identity.geometry,
        identity.product,
        identity.protocol,
        session.report.health,
        session.baud if rs232 else 0,
    )
