"""Sensor models of the fake: identity, geometry, timing, dialect (data sheets, SCIP documents).

Values marked *assumed* have no source. Drivers must not depend on them, since every sensor reports its geometry in
``PP``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

Link = Literal["usb", "rs232", "ethernet"]

PLAIN = frozenset({"MD", "MS", "GD", "GS"})
INTENSITY = PLAIN | {"ME", "GE"}
ECHOES = INTENSITY | {"ND", "NE", "HD", "HE"}


@dataclass(frozen=True, slots=True)
class LidarModel:
    """One type of sensor.

    Attributes:
        modl, prod, firm: texts of ``PP MODL``, ``VV PROD`` and ``VV FIRM``. vend: text of ``VV VEND``.
        dmin, dmax: legal distances in mm. ares: steps a turn. amin, amax, afrt: first, last and front step.
        rpm: nominal speed (``PP SCAN``). true_period_s: real period of the motor.
        profile: dialect, ``2.0`` (URG, UTM) or ``2.2`` (UST). link: default connection.
        measures: supported measurement commands; any other is unknown (``0E``).
        latency_s, jitter_s: time to a reply is ``latency_s + |N(0, jitter_s)|``.
        tick_s: replies and scans leave on multiples of this on the sensor's clock; 0: at once. (UST firmware 4.0.0 to
            4.0.2: 5 ms.)
        boot_s: power-on to ready. reset_s: time a reset command takes before its reply.
        speeds: supports CR, which slows the motor down.
        modes: texts of ``II MESM`` for idle, booting, single, streaming. stat: text of ``II STAT`` while healthy.
    """

    modl: str
    prod: str
    firm: str
    dmin: int
    dmax: int
    ares: int
    amin: int
    amax: int
    afrt: int
    rpm: int
    true_period_s: float
    profile: Literal["2.0", "2.2"] = "2.0"
    link: Link = "usb"
    measures: frozenset[str] = PLAIN
    latency_s: float = 0.5e-3
    jitter_s: float = 0.4e-3
    tick_s: float = 0.0
    boot_s: float = 1.0
    reset_s: float = 0.8
    speeds: bool = False
    vend: str = "Hokuyo Automatic Co.,Ltd."
    modes: tuple[str, str, str, str] = ("IDLE", "001 Booting", "SINGLE", "CLASSIC")
    stat: str = "Sensor works well."

    @property
    def steps(self) -> int:
        """Elements of a :class:`hal.fake.lidar.scan.FakeScan` array: steps 0 to AMAX."""
        return self.amax + 1


URG_04LX = LidarModel(
    modl="URG-04LX(Hokuyo Automatic Co.,Ltd.)",
    prod="SOKUIKI Sensor URG-04LX",
    firm="3.1.04(02/Aug./2007)",
    dmin=20, dmax=5600, ares=1024, amin=44, amax=725, afrt=384, rpm=600,
    true_period_s=0.1002, link="rs232", speeds=True,
)  # fmt: skip

URG_04LX_UG01 = replace(
    URG_04LX,
    prod="SOKUIKI Sensor URG-04LX-UG01(Simple-URG)",
    firm="3.3.01(23/Jun./2008)",
    link="usb",
    speeds=False,
    modes=("IDLE", "001 Booting", "Measuring by Normal Mode", "Measuring by Normal Mode"),
)

UBG_04LX_F01 = replace(
    URG_04LX,
    modl="UBG-04LX-F01(Hokuyo Automatic Co.,Ltd.)",
    prod="SOKUIKI Sensor UBG-04LX-F01(Rapid-URG)",
    firm="1.1.00(10/Jan./2008)",  # assumed
    rpm=2142,  # assumed
    true_period_s=0.02806,
    speeds=False,
)

UHG_08LX = replace(
    URG_04LX,
    modl="UHG-08LX(Hokuyo Automatic Co.,Ltd.)",
    prod="SOKUIKI Sensor UHG-08LX",
    firm="1.0.00(01/Apr./2008)",  # assumed
    dmax=8000, amin=0, amax=768, rpm=900,  # assumed
    true_period_s=0.0668, link="usb", speeds=False,
)  # fmt: skip

UTM_30LX = LidarModel(
    modl="UTM-30LX[Hokuyo Automatic Co.,Ltd.]",
    prod="SOKUIKI Sensor TOP-URG UTM-30LX",
    firm="P.1.05(17/Apr./2009)",
    dmin=23, dmax=60000, ares=1440, amin=0, amax=1080, afrt=540, rpm=2400,
    true_period_s=0.02505, measures=INTENSITY,
)  # fmt: skip

UST_10LX = LidarModel(
    modl="UST-10LX",
    prod="SOKUIKI Sensor UST-10LX",  # assumed
    firm="CUS0.0.1(01/Jan./2014)",  # assumed
    dmin=20, dmax=30000, ares=1440, amin=0, amax=1080, afrt=540, rpm=2400,
    true_period_s=0.02505, profile="2.2", link="ethernet", measures=ECHOES,
    latency_s=0.4e-3, jitter_s=0.05e-3, tick_s=1e-3, reset_s=0.05,
    modes=("000 Idle", "001 Booting", "003 Single_scan", "004 Multi_scan"),
    stat="Stable 000 no error.",
)  # fmt: skip

UST_20LX = replace(UST_10LX, modl="UST-20LX", prod="SOKUIKI Sensor UST-20LX", dmax=60000)

UXM_30LX_E = replace(
    UTM_30LX,
    modl="UXM-30LX-E[Hokuyo Automatic Co.,Ltd.]",
    prod="SOKUIKI Sensor UXM-30LX-E",
    firm="1.1.0(01/Jan./2012)",  # assumed
    dmin=100, dmax=100000, amax=760, afrt=380, rpm=1200,
    true_period_s=0.0501, link="ethernet", measures=ECHOES,
)  # fmt: skip

PAPER = replace(
    UTM_30LX,
    modl="PAPER-180[180 degrees, 721 beams, 40 Hz]",
    prod="Simulated sensor of 180 degrees",
    firm="1.0.0(01/Jan./2020)",
    amax=720, afrt=360, measures=ECHOES,
)  # fmt: skip

MODELS: dict[str, LidarModel] = {
    "URG-04LX": URG_04LX,
    "URG-04LX-UG01": URG_04LX_UG01,
    "UBG-04LX-F01": UBG_04LX_F01,
    "UHG-08LX": UHG_08LX,
    "UTM-30LX": UTM_30LX,
    "UST-10LX": UST_10LX,
    "UST-20LX": UST_20LX,
    "UXM-30LX-E": UXM_30LX_E,
    "paper": PAPER,
}
"""By the name a person types."""


@dataclass(frozen=True, slots=True)
class Unit:
    """Properties of one sensor of a model.

    Attributes:
        serial: text of ``VV SERI``. clock_ms: initial reading of the 24-bit clock.
        clock_gain: relative error of the clock, 50e-6 = 50 ppm fast. baud: rate of the RS-232 line after power-on.
        strict_time: ``TM1`` outside time-adjust mode is refused with ``04`` (most real sensors answer).
        booted: True: already booted at the start; False: starts in BOOTING.
        scip1: starts in SCIP 1.1 (old URG-04LX) and returns to it at every power-on.
        spin_up_s: time from power-on to the first scan.
        seed: of the jitter and of random faults.
    """

    serial: str = "H0706400"
    clock_ms: int = 0
    clock_gain: float = 0.0
    baud: int = 19200
    strict_time: bool = False
    booted: bool = True
    scip1: bool = False
    spin_up_s: float = 0.0
    seed: int = 0
