"""Facts about HOKUYO models: safe commands, error codes, intensity limits, line speeds; identification from VV and PP.

Geometry is never taken from here: a sensor reports it in ``PP``. Sources: SCIP specifications C-42-03320B, C-42-04076,
C-42-03907; field reports named at the entries.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from hal.errors import DeviceRefused
from hal.hokuyo.payload import ScanRequest
from hal.lidar import LidarGeometry

_CORE: Final = frozenset(["VV", "PP", "II", "BM", "QT", "RS", "TM", "SS", "MD", "MS", "GD", "GS"])
_INTENSITY: Final = _CORE | {"ME", "GE", "RT"}
_MULTI_ECHO: Final = _INTENSITY | {"ND", "NE", "HD", "HE", "RB"}

_URG_CODES: Final = {
    0: "no return, perhaps far beyond range",
    1: "reflected light too weak",
    2: "reflected light too weak",
    3: "reflected light too weak",
    4: "reflected light too weak",
    5: "reflected light too weak",
    6: "other",
    7: "neighbouring steps also in error",
    8: "intensity differs too much from the neighbours",
    9: "same step failed in the last two scans",
    16: "at the 4096 mm limit",
    18: "reflection too strong",
    19: "not measurable",
}
_UTM_CODES: Final = {
    0: "no return",
    1: "no object in range",
    2: "too near, or reflection inside the window",
    3: "interference or measurement error",
    4: "out of range at the near end",
    5: "other",
}


NEAREST_MM: Final = 20
"""No model measures below this; smaller values are error codes even where DMIN allows them (C-42-03320B: 0 to 19)."""
NO_RETURN: Final = (65533, 65534, 65535, 0x3FFFF)
"""Words for a missing echo or an error, and all bits set; no distances even where DMAX allows them."""


@dataclass(frozen=True, slots=True)
class ModelFacts:
    """Facts of a family of sensors.

    Attributes:
        family: name for people and for the status.
        commands: two-letter commands that are safe to send; old firmware wedges on others until a power cycle
            (ros-drivers/urg_c PR 4, ros-drivers/urg_node issue 23).
        codes: meaning of values below DMIN.
        no_return_from: values from here on are no distance even if DMAX allows them; 0: DMAX and NO_RETURN decide.
        line: usual connection, where the port's name does not show it.
        intensity_swath_deg: widest safe field of view with intensity at cluster 1, by firmware; "" is any other
            firmware. Empty: no limit.
    """

    family: str
    commands: frozenset[str]
    codes: dict[int, str] = field(default_factory=dict)
    no_return_from: int = 0
    line: Literal["usb", "ethernet"] = "usb"
    intensity_swath_deg: dict[str, float] = field(default_factory=dict)

    def allows(self, command: str) -> bool:
        """True where ``command`` (two letters) is safe to send."""
        return command[:2] in self.commands


_FAMILIES: Final[tuple[tuple[str, ModelFacts], ...]] = (
    # a fragment of PROD (of VV) or MODL (of PP); the first match counts
    ("URG-04LX", ModelFacts("URG-04LX", _CORE, _URG_CODES)),
    ("UBG-04LX", ModelFacts("UBG-04LX", _CORE, _URG_CODES)),
    ("UHG-08LX", ModelFacts("UHG-08LX", _CORE, _URG_CODES)),
    ("UTM-30LX-EW", ModelFacts("UTM-30LX-EW", _MULTI_ECHO, _UTM_CODES, no_return_from=65533, line="ethernet")),
    (
        "UTM-30LX",
        # hokuyo_node and PR2/pr2_robot issue 137: a wider request gives wrong data or a crash that needs a power cycle
        ModelFacts(
            "UTM-30LX",
            _INTENSITY,
            _UTM_CODES,
            no_return_from=65533,
            intensity_swath_deg={"": 95.0, "1.16.01(16/Nov./2009)": 190.0},
        ),
    ),
    ("UST-", ModelFacts("UST", _INTENSITY | {"RB"}, _UTM_CODES, no_return_from=65533, line="ethernet")),
    ("UXM-30LX", ModelFacts("UXM-30LX", _MULTI_ECHO, _UTM_CODES, line="ethernet")),
)
UNKNOWN_MODEL: Final = ModelFacts("unknown model", _INTENSITY)
"""For models not listed; intensity is still tested with one counted scan before use."""

BEFORE_IDENTIFIED: Final = ModelFacts("not yet identified", frozenset({"VV", "PP", "QT", "RS", "TM", "SC"}))
"""Commands that are safe before the sensor is identified."""


def facts_of(product: str, model: str) -> ModelFacts:
    """Facts for the product of VV and the model of PP."""
    for text in (product, model):
        for fragment, facts in _FAMILIES:
            if fragment in text:
                return facts
    return UNKNOWN_MODEL


@dataclass(frozen=True, slots=True)
class Identity:
    """A sensor as it describes itself in VV and PP."""

    product: str
    protocol: str
    geometry: LidarGeometry
    facts: ModelFacts

    def is_distance(self, values: npt.NDArray[np.int32]) -> npt.NDArray[np.bool_]:
        """Mask of the values that are distances, of any shape; all others are codes, whatever DMIN and DMAX are."""
        highest = min(self.geometry.dmax, (self.facts.no_return_from or 0x3FFFF) - 1)
        found = (values >= max(self.geometry.dmin, NEAREST_MM)) & (values <= highest)
        for word in NO_RETURN:
            if word <= highest:
                found &= values != word
        return np.asarray(found)

    def code_text(self, value: int) -> str:
        """Meaning of a value that is no distance, for people."""
        if value > self.geometry.dmax or value >= NO_RETURN[0]:
            return "no return"
        return self.facts.codes.get(value, "error code without published meaning")


_UNIT: Final = r"\s*(?:[\[(<{].*|[A-Za-z/%.]+(?:[\s,;\[(<{].*)?)?"
_NUMBER: Final = re.compile(rf"([+-]?[0-9]{{1,9}}(?:\.[0-9]{{1,9}})?){_UNIT}", re.DOTALL)
"""A decimal number with or without its unit: ``2400``, ``2400[rpm]``, ``60000 mm``."""
_PP_NUMBERS: Final = ("DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN")


def identify(device: str, vv: dict[str, str], pp: dict[str, str]) -> Identity:
    """Build the identity from the text lines of VV (may be empty) and PP.

    Raises:
        DeviceRefused: PP lacks a key or contradicts itself, or the firmware is older than SCIP 2.0.
    """
    numbers = {key: _number(device, key, pp.get(key, "")) for key in _PP_NUMBERS}
    ares, amin, amax = (_whole(device, key, numbers[key]) for key in ("ARES", "AMIN", "AMAX"))
    dmin, dmax = (_whole(device, key, numbers[key]) for key in ("DMIN", "DMAX"))
    dmax = min(dmax, 0x3FFFF)  # the largest value that a reply can carry
    front = abs(numbers["AFRT"]) <= 2 * ares  # it may lie outside the field of view
    if not (numbers["SCAN"] > 0 and 0 <= amin < amax <= ares <= 9999 and front and 0 <= dmin < dmax):
        raise DeviceRefused(device, f"PP reply is inconsistent: {pp}", "check that it is a HOKUYO 2D lidar")
    period_s = 60.0 / numbers["SCAN"]
    product, firmware = vv.get("PROD", ""), vv.get("FIRM", "")
    model = pp.get("MODL", "") or product
    facts = facts_of(product, model)
    if facts.family == "URG-04LX" and firmware[:2] in ("0.", "1.", "2."):
        raise DeviceRefused(device, f"URG-04LX firmware {firmware} has no full SCIP 2.0", "update it to 3.x")
    geometry = LidarGeometry(
        model=model.partition("(")[0].strip(),
        serial=vv.get("SERI", ""),
        firmware=firmware,
        ares=float(ares),
        afrt=numbers["AFRT"],
        amin=amin,
        amax=amax,
        dmin=dmin,
        dmax=dmax,
        range_unit_m=0.001,
        period_s=period_s,
        beam_dt_s=period_s / ares,
    )
    return Identity(product, vv.get("PROT", ""), geometry, facts)


def _number(device: str, key: str, text: str) -> float:
    """The number in a value of PP, without its unit; raises `DeviceRefused`."""
    found = _NUMBER.fullmatch(text)
    if found is None:
        raise DeviceRefused(
            device, f"PP reply has {key}={text[:20]!r}, expected a number", "check that it is a HOKUYO 2D lidar"
        )
    return float(found[1])


def _whole(device: str, key: str, value: float) -> int:
    if not value.is_integer():
        raise DeviceRefused(
            device, f"PP reply has {key}={value:g}, expected a whole number", "check that it is a HOKUYO 2D lidar"
        )
    return int(value)


def stream_request(identity: Identity, *, intensity: bool, bytes_per_s: float) -> ScanRequest:
    """The endless stream to request: all steps of all revolutions if model and line can carry it.

    A slow line first gets clusters of 2 and 3 steps, then every second to tenth revolution.

    Args:
        identity: of the sensor.
        intensity: request ME; clusters are formed where a model's intensity mode is unsafe over the full field of view.
        bytes_per_s: capacity of the line.
    """
    geometry, facts = identity.geometry, identity.facts
    name = "ME" if intensity and facts.allows("ME") else "MD"
    least = 1
    limits = facts.intensity_swath_deg
    if name == "ME" and limits:
        swath = (geometry.amax - geometry.amin) * 360.0 / geometry.ares
        safe = limits.get(geometry.firmware, limits[""])
        while safe * least < swath:
            least += 1
    request = ScanRequest(name, geometry.amin, geometry.amax, least)
    for cluster in range(least, max(least, 3) + 1):
        request = ScanRequest(name, geometry.amin, geometry.amax, cluster)
        if request.frame_bytes <= bytes_per_s * geometry.period_s:
            return request
    for skip in range(1, 10):
        request = ScanRequest(name, geometry.amin, geometry.amax, max(least, 3), skip)
        if request.frame_bytes <= bytes_per_s * geometry.period_s * (skip + 1):
            break
    return request


_BYTES_PER_S: Final = {"usb": 1.0e6, "ethernet": 12.5e6}  # USB full speed in practice; 100 Mbit/s


def line_speed(device: str, baud: int, facts: ModelFacts) -> float:
    """Bytes per second of the line behind a port's name.

    Args:
        device: as opened; symbolic links already followed where it is a path.
        baud: rate of an RS-232 line in bit/s, 0 where there is none.
        facts: give the usual line where the name does not show it.
    """
    if baud > 0:
        return baud / 10.0
    if device.startswith("tcp://"):
        return _BYTES_PER_S["ethernet"]
    return _BYTES_PER_S["usb" if "ttyACM" in device else facts.line]
