"""Text replies of the fake sensor: identity (VV), parameters (PP), state (II), and the V reply of SCIP 1.1."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from hal.fake.lidar.dialect_grid import State
from hal.fake.lidar.models import LidarModel, Unit

Lines = list[tuple[str, str]]
TextLine = Callable[[str, str], bytes]

SPEEDS = {"usb": "USB Full Speed", "ethernet": "Ethernet 100[Mbps]"}


@dataclass(slots=True)
class LiveState:
    """Values of II that change at run time. ``trouble`` and ``mode`` replace the health and the mode text."""

    state: State
    laser: bool
    baud: int
    tick: int
    trouble: str = ""
    mode: str = ""


def identity(model: LidarModel, unit: Unit, suffix: str = "") -> Lines:
    """Key and value of each VV line; ``suffix`` is appended to the firmware's text."""
    protocol = "SCIP 2.0" if model.profile == "2.0" else "SCIP 2.2"
    return [
        ("VEND", model.vend),
        ("PROD", model.prod),
        ("FIRM", model.firm + suffix),
        ("PROT", protocol),
        ("SERI", unit.serial),
    ]


def parameters(model: LidarModel, dmax: int) -> Lines:
    """Key and value of each PP line, with the reported DMAX."""
    return [
        ("MODL", model.modl),
        ("DMIN", str(model.dmin)),
        ("DMAX", str(dmax)),
        ("ARES", str(model.ares)),
        ("AMIN", str(model.amin)),
        ("AMAX", str(model.amax)),
        ("AFRT", str(model.afrt)),
        ("SCAN", str(model.rpm)),
    ]


def state(model: LidarModel, live: LiveState) -> Lines:
    """Key and value of each II line; TIME is six hexadecimal digits of the clock."""
    mode = {State.BOOTING: 1, State.SINGLE: 2, State.MULTI: 3}.get(live.state, 0)
    link = SPEEDS.get(model.link, f"{live.baud}[bps]<-Default setting by user")
    return [
        ("MODL", model.modl),
        ("LASR", "ON" if live.laser else "OFF"),
        ("SCSP", f"Initial({model.rpm}[rpm])<-Default setting by user"),
        ("MESM", live.mode or model.modes[mode]),
        ("SBPS", link),
        ("TIME", f"{live.tick:06X}"),
        ("STAT", live.trouble or model.stat),
    ]


def lines(pairs: Lines, line: TextLine) -> bytes:
    """The body of a text reply, each line summed by ``line``."""
    return b"".join(line(key, value) for key, value in pairs)


def scip1(model: LidarModel, unit: Unit) -> bytes:
    """Body of the SCIP 1.1 ``V`` reply: no sums."""
    pairs = identity(model, unit)
    return b"".join(f"{key}:{'SCIP 1.1' if key == 'PROT' else value}\n".encode("ascii") for key, value in pairs)
