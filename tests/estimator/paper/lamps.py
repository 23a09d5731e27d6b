"""A grid of level lamps, and epochs of what a level receiver gets of them by Eq. 1 and 2: exact, no floor, no noise."""

import math
from collections.abc import Iterable

import numpy as np

from estimator.cdma.data_frame import LampFrame
from estimator.cdma.epoch import BlockFlag
from estimator.light_filter.survey import Lamp, Receiver, Survey
from estimator.measurements import Array, LightEpoch
from estimator.numerics import se2

RECEIVER = Receiver(x=0.2, y=-0.1, z=0.3, half_fov_rad=math.radians(80.0))
GRID = tuple(
    Lamp(lamp_id=100 + code, code=code, x=2.5 * (code % 3), y=2.5 * (code // 3), z=2.9, power_w=1.0 + 0.1 * code)
    for code in range(9)
)
SURVEY = Survey(GRID, RECEIVER, floor=0.0)
SIGMA = 1e-10
"""Noise of an RSS, A: far below all of them."""


def rss_of(lamp: Lamp, xy: Array, survey: Survey = SURVEY) -> float:
    """RSS (A) of a lamp with the receiver at ``xy``, by Eq. 1 and 2 as printed."""
    rx, h = survey.receiver, lamp.z - survey.receiver.z
    d2 = (lamp.x - float(xy[0])) ** 2 + (lamp.y - float(xy[1])) ** 2 + h * h
    cosine = h / math.sqrt(d2)
    H = (lamp.order + 1.0) * rx.area_m2 / (2.0 * math.pi * d2) * cosine**lamp.order * cosine**rx.order
    return H * lamp.power_w * survey.depth * rx.responsivity


def receiver_at(T: Array, survey: Survey = SURVEY) -> Array:
    """Place (2,) of the receiver with the base at ``T``."""
    return se2.apply(T, np.array(((survey.receiver.x, survey.receiver.y),)))[0]


def epoch_of(
    links: Iterable[tuple[int, float]],
    t: float = 0.0,
    flags: dict[int, int] | None = None,
    frames: dict[int, LampFrame] | None = None,
    block: BlockFlag = BlockFlag.NONE,
) -> LightEpoch:
    """An epoch of 50 ms about ``t`` with these links (code, RSS in A)."""
    codes, rss = (np.array(side) for side in zip(*links, strict=True))
    n = len(codes)
    return LightEpoch(
        t_begin=t - 0.025,
        t_end=t + 0.025,
        ids=codes.astype(np.int64),
        amplitude=rss.astype(float),
        variance=np.full(n, SIGMA**2),
        flags=np.array([(flags or {}).get(int(code), 0) for code in codes]),
        lamps=tuple((frames or {}).get(int(code)) for code in codes),
        block=block,
        noise_a=SIGMA,
        clock_ppm=0.0,
    )


def epoch_at(T: Array, t: float = 0.0, codes: Iterable[int] = range(9)) -> LightEpoch:
    """What these lamps of the grid give with the base at ``T``."""
    xy = receiver_at(T)
    return epoch_of([(code, rss_of(GRID[code], xy)) for code in codes], t)
