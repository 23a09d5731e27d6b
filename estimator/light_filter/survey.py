"""Survey types: ceiling lamps, photodiode receiver, and the survey of both.

Frames: lamps are in the survey's frame, which is the map frame. There x, y are in the ground plane, z points up. The
receiver is in base_link. A direction is given by its slopes: unit vectors (s_x, s_y, +-1) / norm. All SI.
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Lamp:
    """One ceiling lamp, as surveyed, as described in its data frames, or as calibrated.

    Attributes:
        lamp_id: its number in the building, unique. code: of its CDMA code; a large building reuses codes.
        x, y, z: of its luminous centre, m.
        power_w: mean radiant power P_t; the modulated part is the profile's depth times that.
        order: Lambert order m_t of Eq. (1), ``-ln 2 / ln cos(half angle)``.
        slope_x, slope_y: tilt of its axis: it shines along (slope_x, slope_y, -1).
        sigma_ln: one sigma of ln power by its source (0.05: 5 %).
    """

    lamp_id: int
    code: int
    x: float
    y: float
    z: float
    power_w: float = 1.5
    order: float = 0.6461
    slope_x: float = 0.0
    slope_y: float = 0.0
    sigma_ln: float = 0.15


@dataclass(frozen=True, slots=True)
class Receiver:
    """The photodiode on the robot.

    Attributes:
        x, y: lever arm in base_link, m. z: height above the ground, m.
        area_m2: A of Eq. (1). responsivity: A of photocurrent per W. order: m_r, 1 for a bare photodiode.
        half_fov_rad: angle from its axis beyond which it receives nothing.
        slope_x, slope_y: tilt in base_link: its axis is (slope_x, slope_y, 1).
    """

    x: float = 0.0
    y: float = 0.0
    z: float = 0.3
    area_m2: float = 1.2e-4
    responsivity: float = 0.4
    order: float = 1.0
    half_fov_rad: float = 1.0471975511965976
    slope_x: float = 0.0
    slope_y: float = 0.0


@dataclass(frozen=True, slots=True)
class Survey:
    """All lamps of a building with the receiver they were calibrated for.

    Attributes:
        floor: diffuse floor: light that one lamp adds everywhere. It is a share of the direct light below a lamp of
            equal power. Theory gives 1 % to 2 % in furnished rooms. It is the start value of the state.
        depth: modulation depth of the lamps, the profile's.
    """

    lamps: tuple[Lamp, ...] = ()
    receiver: Receiver = field(default_factory=Receiver)
    floor: float = 0.015
    depth: float = 0.30
