"""How far the lit world departs from the book, and the photodiode in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Effects:
    """How far the world departs from the book. 0 switches an effect off; one standard deviation where one is meant.

    Attributes:
        gain_spread: of ln power, lamp by lamp. receiver_gain: of ln sensitivity, one for all.
        ageing: largest relative change of a lamp's power within ``ageing_s``; each goes its own way, up or down.
        warm_up: how much brighter a lamp is when it is switched on at time 0, fading with ``warm_up_s``.
        drift: amplitude of a slow swing of power with the building's temperature.
        lamp_tilt_deg, receiver_tilt_deg: lean of each lamp and of the photodiode, about each axis. sway: whether the
            robot's body leans as it drives.
        survey_m: by which the survey is wrong about a lamp's place, along each axis.
        emission, acceptance: departure of lamps and photodiode from powers of a cosine; 1 as measured.
        rho: reflectance of a painted wall. bounces: reflections from walls that are followed, 0 to 2.
        floor: diffuse light of a lamp in its room, as a share of what arrives directly below it. floor_swing: by which
            share that differs over the room at most.
        people, obstacles: whether people, and walls, columns and shelves, stand in the way.
    """

    gain_spread: float = 0.05
    receiver_gain: float = 0.05
    ageing: float = 0.0
    ageing_s: float = 320.0
    warm_up: float = 0.02
    warm_up_s: float = 600.0
    drift: float = 0.005
    lamp_tilt_deg: float = 1.0
    receiver_tilt_deg: float = 0.5
    sway: bool = True
    survey_m: float = 0.005
    emission: float = 1.0
    acceptance: float = 1.0
    rho: float = 0.5
    bounces: int = 1
    floor: float = 0.015
    floor_swing: float = 0.5
    people: bool = True
    obstacles: bool = True


IDEAL: Final = Effects(
    gain_spread=0.0, receiver_gain=0.0, warm_up=0.0, drift=0.0, lamp_tilt_deg=0.0, receiver_tilt_deg=0.0, sway=False,
    survey_m=0.0, emission=0.0, acceptance=0.0, rho=0.0, bounces=0, floor=0.0, floor_swing=0.0, people=False,
    obstacles=False,
)  # fmt: skip
"""Lambertian lamps, a cosine receiver, empty space: only for tests of the simulator itself."""


@dataclass(frozen=True, slots=True)
class Photodiode:
    """The receiver as built; the paper's Table 1 gives area and field of view.

    Attributes:
        x, y: lever arm in base_link. z: height above the floor. area_m2, responsivity: m^2, A/W.
        half_fov_deg: half of the full field of view of 120 degrees.
    """

    x: float = -0.10
    y: float = 0.03
    z: float = 0.30
    area_m2: float = 1.2e-4
    responsivity: float = 0.4
    half_fov_deg: float = 60.0
