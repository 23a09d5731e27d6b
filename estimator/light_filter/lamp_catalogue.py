"""Lamp catalogue: the lamps of the survey, and those that described themselves in their data frames."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from estimator.cdma.data_frame import LampFrame
from estimator.light_filter.lambertian import pack_lamps
from estimator.light_filter.survey import Lamp, Receiver, Survey
from estimator.numerics.arrays import Array

CONTRADICTION_M = 0.3
"""Distance (m) between data frame and survey above which they disagree: another lamp, a moved one, or a wrong entry."""
CONTRADICTION_LN = 0.25
"""Difference of ln power above which they disagree, beyond three sigmas of the survey."""
FRAME_SIGMA_LN = 0.15
"""One sigma of ln power of a lamp that described itself: it sends its rated power, not what is left of it."""


def lamp_of(frame: LampFrame, code: int) -> Lamp:
    """Lamp as described in its data frame; the usual half angle where the frame has none."""
    lamp = Lamp(frame.lamp_id, code, frame.x_m, frame.y_m, frame.z_m, sigma_ln=FRAME_SIGMA_LN)
    order = lamp.order
    if 1.0 <= frame.half_angle_deg < 90.0:
        order = -math.log(2.0) / math.log(math.cos(math.radians(frame.half_angle_deg)))
    power = frame.power_w if frame.power_w > 0.0 else lamp.power_w
    return Lamp(lamp.lamp_id, code, lamp.x, lamp.y, lamp.z, power, order, sigma_ln=FRAME_SIGMA_LN)


def contradicts(frame: LampFrame, code: int, lamp: Lamp) -> bool:
    """Whether a data frame disagrees with a lamp of the catalogue."""
    away = math.dist((frame.x_m, frame.y_m, frame.z_m), (lamp.x, lamp.y, lamp.z))
    power = abs(math.log(frame.power_w / lamp.power_w)) if frame.power_w > 0.0 and lamp.power_w > 0.0 else 0.0
    return code != lamp.code or away > CONTRADICTION_M or power > CONTRADICTION_LN + 3.0 * lamp.sigma_ln


def rim_amplitude(lamp: Lamp, rx: Receiver, depth: float) -> float:
    """RSS of a lamp at the very edge of the field of view of a level receiver, A."""
    h = max(lamp.z - rx.z, 0.1)
    nadir = (lamp.order + 1.0) * rx.area_m2 / (2.0 * math.pi * h * h) * rx.responsivity
    return depth * lamp.power_w * nadir * math.pow(math.cos(min(rx.half_fov_rad, 1.5)), lamp.order + rx.order + 2.0)


@dataclass(slots=True, eq=False)
class Catalogue:
    """Lamps by ID and by code.

    Attributes:
        by_id, by_code: the lamps. surveyed: IDs of those in the survey. rows: by ID, for the kernels.
        rims: by ID, RSS at the very edge of the field of view of a level receiver, A.
        heard: by ID, instant of the last reception of each lamp outside the survey, oldest first.
        told: by ID, the frame and code last learned, its lamp, and whether the survey disagrees.
        doubts: by set of IDs, extra covariance of collinear lamps (`collinear_lamps.doubt`).
    """

    depth: float
    receiver: Receiver
    by_id: dict[int, Lamp] = field(default_factory=dict)
    by_code: dict[int, list[Lamp]] = field(default_factory=dict)
    surveyed: set[int] = field(default_factory=set)
    rows: dict[int, Array] = field(default_factory=dict)
    rims: dict[int, float] = field(default_factory=dict)
    heard: dict[int, float] = field(default_factory=dict)
    told: dict[int, tuple[LampFrame, int, Lamp, bool]] = field(default_factory=dict)
    doubts: dict[frozenset[int], Array] = field(default_factory=dict)

    def add(self, lamp: Lamp) -> None:
        """Add a lamp; one of the same ID is replaced."""
        self.doubts.clear()
        old = self.by_id.get(lamp.lamp_id)
        if old is not None:
            self.by_code[old.code].remove(old)
        self.by_id[lamp.lamp_id] = lamp
        self.by_code.setdefault(lamp.code, []).append(lamp)
        self.rows[lamp.lamp_id] = np.ascontiguousarray(pack_lamps([lamp], self.depth)[0])
        self.rims[lamp.lamp_id] = rim_amplitude(lamp, self.receiver, self.depth)

    def touch(self, lamp_id: int, t_mono: float) -> None:
        """Record the reception of a lamp."""
        if lamp_id not in self.surveyed:
            self.heard.pop(lamp_id, None)
            self.heard[lamp_id] = t_mono

    def drop(self, lamp_id: int) -> None:
        """Remove a lamp outside the survey."""
        self.doubts.clear()
        lamp = self.by_id.pop(lamp_id)
        self.by_code[lamp.code].remove(lamp)
        del self.rows[lamp_id], self.rims[lamp_id], self.heard[lamp_id]
        self.told.pop(lamp_id, None)

    def learn(self, frame: LampFrame, code: int, t_mono: float) -> tuple[Lamp, bool]:
        """Lamp of a data frame, and whether the survey (which takes precedence) disagrees with the frame."""
        known, told = self.by_id.get(frame.lamp_id), self.told.get(frame.lamp_id)
        if told is not None and told[0] is frame and told[1] == code and told[2] is known:  # unchanged since then
            self.touch(frame.lamp_id, t_mono)
            return known, told[3]
        if known is None or (frame.lamp_id not in self.surveyed and contradicts(frame, code, known)):
            self.add(lamp_of(frame, code))
            known = self.by_id[frame.lamp_id]
        self.touch(frame.lamp_id, t_mono)
        contradicted = frame.lamp_id in self.surveyed and contradicts(frame, code, known)
        self.told[frame.lamp_id] = frame, code, known, contradicted
        return known, contradicted

    def candidates(self, code: int) -> list[Lamp]:
        """All lamps of a code."""
        return self.by_code.get(code, [])


def catalogue_of(survey: Survey) -> Catalogue:
    """Catalogue of the survey's lamps.

    Raises:
        ValueError: two lamps have the same ID.
    """
    catalogue = Catalogue(survey.depth, survey.receiver)
    for lamp in survey.lamps:
        if lamp.lamp_id in catalogue.by_id:
            raise ValueError(f"the survey has lamp {lamp.lamp_id} twice; lamp numbers must be unique in the building")
        catalogue.add(lamp)
        catalogue.surveyed.add(lamp.lamp_id)
    return catalogue
