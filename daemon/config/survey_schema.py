"""Lamp survey schema: the typed file tree, in which every key has a range, a description and an example.

This module contains the tree alone. ``daemon/config/survey_loader.py`` reads and writes it;
``daemon/config/survey_errors.py`` has the error messages.
"""

from __future__ import annotations

import math
from typing import Annotated, Final

import msgspec
from msgspec import Meta

from estimator import PROFILES, Lamp, Profile, Receiver, Survey

Slope = Annotated[float, Meta(ge=-1.0, le=1.0)]
Metres = Annotated[float, Meta(ge=-10_000.0, le=10_000.0)]

_LAMP: Final = Lamp(lamp_id=0, code=0, x=0.0, y=0.0, z=3.0)
_RECEIVER: Final = Receiver()
_SURVEY: Final = Survey()


def last_code(profile: Profile) -> int:
    """Highest code number of an air interface; the lowest is 0 (`estimator.cdma.gold_codes`)."""
    return profile.length + 1


_LAST_CODE: Final = max(map(last_code, PROFILES.values()))
"""Highest code number of all air interfaces; the limit of a file's own profile is checked elsewhere."""


class LampEntry(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """One lamp as stored in the file."""

    lamp_id: Annotated[
        int, Meta(ge=0, le=65535, description="the lamp's number in the building, unique", examples=[10])
    ]
    code: Annotated[int, Meta(ge=0, le=_LAST_CODE, description="number of the CDMA code it sends", examples=[73])]
    x: Annotated[Metres, Meta(description="metres, luminous centre", examples=[2.5])]
    y: Annotated[Metres, Meta(description="metres, luminous centre", examples=[7.5])]
    z: Annotated[float, Meta(ge=0.5, le=100.0, description="metres above the ground", examples=[2.6])]
    power_w: Annotated[float, Meta(ge=1e-4, le=1e4, description="mean radiant power, W")] = _LAMP.power_w
    order: (
        Annotated[float, Meta(ge=0.05, le=60.0, description="Lambert order; or give half_angle_deg", examples=[1.0])]
        | None
    ) = None
    half_angle_deg: (
        Annotated[
            float,
            Meta(ge=5.0, le=89.0, description="angle of half intensity; or give order", examples=[60.0]),
        ]
        | None
    ) = None
    slope_x: Annotated[Slope, Meta(description="tilt of the lamp's axis towards x, metres per metre down")] = 0.0
    slope_y: Annotated[Slope, Meta(description="tilt of the lamp's axis towards y, metres per metre down")] = 0.0
    sigma: Annotated[float, Meta(ge=1e-3, le=2.0, description="one sigma of ln(power); 0.05 is 5 %")] = _LAMP.sigma_ln

    def __post_init__(self) -> None:
        if self.order is not None and self.half_angle_deg is not None:
            raise ValueError("Expected `order` or `half_angle_deg`, got both")

    def lamp(self) -> Lamp:
        """The lamp as an estimator type."""
        order = _LAMP.order if self.order is None else self.order
        if self.half_angle_deg is not None:
            order = order_of(self.half_angle_deg)
        place = (self.lamp_id, self.code, self.x, self.y, self.z)
        return Lamp(*place, self.power_w, order, self.slope_x, self.slope_y, self.sigma)


class ReceiverEntry(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """The photodiode as stored in the file."""

    x: Annotated[float, Meta(ge=-5.0, le=5.0, description="metres ahead of the robot's centre")] = _RECEIVER.x
    y: Annotated[float, Meta(ge=-5.0, le=5.0, description="metres to the left of the robot's centre")] = _RECEIVER.y
    z: Annotated[float, Meta(ge=0.0, le=20.0, description="metres above the ground")] = _RECEIVER.z
    area_cm2: Annotated[float, Meta(ge=1e-4, le=100.0, description="its active area, cm^2")] = 1e4 * _RECEIVER.area_m2
    responsivity: Annotated[float, Meta(ge=1e-3, le=2.0, description="A per W")] = _RECEIVER.responsivity
    order: Annotated[float, Meta(ge=0.05, le=10.0, description="exponent of its cosine; 1 for a bare diode")] = (
        _RECEIVER.order
    )
    half_fov_deg: Annotated[float, Meta(ge=5.0, le=90.0, description="largest angle from its axis")] = 60.0
    slope_x: Annotated[Slope, Meta(description="tilt of its axis forward, metres per metre up")] = 0.0
    slope_y: Annotated[Slope, Meta(description="tilt of its axis to the left, metres per metre up")] = 0.0

    def receiver(self) -> Receiver:
        """The receiver as an estimator type."""
        area, half_fov = round(1e-4 * self.area_cm2, 12), math.radians(self.half_fov_deg)
        arm = (self.x, self.y, self.z)
        return Receiver(*arm, area, self.responsivity, self.order, half_fov, self.slope_x, self.slope_y)


class SurveyTree(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """The whole survey file."""

    lamp: Annotated[
        tuple[LampEntry, ...],
        Meta(
            description="the lamps; [] with a [receiver]: the lamps send their own positions",
            examples=[[{"lamp_id": 10, "code": 73, "x": 2.5, "y": 7.5, "z": 2.6}]],
        ),
    ]
    floor: Annotated[
        float, Meta(ge=0.0, le=0.5, description="diffuse light as a share of a lamp's RSS at its nadir")
    ] = _SURVEY.floor
    depth: (
        Annotated[
            float,
            Meta(
                ge=0.002, le=0.95, description="modulation depth of the lamps; default: the profile's", examples=[0.25]
            ),
        ]
        | None
    ) = None
    receiver: ReceiverEntry | None = None

    def __post_init__(self) -> None:
        if not self.lamp and self.receiver is None:
            raise ValueError("Expected lamps, or a [receiver] for lamps that send their own positions, got neither")

    @property
    def eye(self) -> ReceiverEntry:
        """The receiver, with default values where the file contains none."""
        return self.receiver or ReceiverEntry()

    def survey(self, profile: Profile | None) -> Survey:
        """The survey as an estimator type, lamps by number; a missing modulation depth is the profile's."""
        lamps = sorted((entry.lamp() for entry in self.lamp), key=lambda lamp: lamp.lamp_id)
        return Survey(tuple(lamps), self.eye.receiver(), self.floor, self._depth(profile))

    def _depth(self, profile: Profile | None) -> float:
        if self.depth is not None:
            return self.depth
        return _SURVEY.depth if profile is None else profile.depth


def order_of(half_angle_deg: float) -> float:
    """Lambert order of a lamp whose intensity halves at this angle in degrees (Eq. 1)."""
    return -math.log(2.0) / math.log(math.cos(math.radians(half_angle_deg)))
