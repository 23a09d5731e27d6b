"""The only place where the ceiling meets the estimator's record types: light epochs, and the survey of a building."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from estimator.cdma.data_frame import LampFrame
from estimator.cdma.epoch import BlockFlag, LightEpoch, LinkFlag
from estimator.light_filter.survey import Lamp, Receiver, Survey
from tools.sim.ceiling.ceiling import Array, Ceiling
from tools.sim.ceiling.links import EPOCH_S, PERIOD_S, Links, Reception, Report
from tools.sim.ceiling.optics import lambert_order

Poses = Callable[[Array], Array]
"""(n, 3) poses at (n,) times."""


def survey(ceiling: Ceiling) -> Survey:
    """What the plan says: lamps where they were meant to hang, with the data sheet's power and Lambert order."""
    fx, pd = ceiling.effects, ceiling.photodiode
    spread = float(np.hypot(fx.gain_spread, fx.ageing))
    lamps = tuple(
        Lamp(f.lamp_id, f.code, f.x, f.y, f.z, f.power_w, lambert_order(f.half_angle_deg), sigma_ln=max(spread, 0.01))
        for f in ceiling.fixtures
    )
    half_fov = float(np.radians(pd.half_fov_deg))
    return Survey(lamps, Receiver(pd.x, pd.y, pd.z, pd.area_m2, pd.responsivity, 1.0, half_fov), 0.015, ceiling.depth)


def frames(ceiling: Ceiling) -> list[LampFrame]:
    """What each lamp says of itself, rounded as the air interface rounds it."""
    return [
        LampFrame(
            f.lamp_id, round(f.x / 0.005) * 0.005, round(f.y / 0.005) * 0.005, round(f.z / 0.005) * 0.005,
            round(f.power_w / 0.01) * 0.01, round(f.half_angle_deg),
        )
        for f in ceiling.fixtures
    ]  # fmt: skip


def light_epoch(ceiling: Ceiling, report: Report, told: list[LampFrame] | None = None) -> LightEpoch:
    """A report as the record `step` takes; ``told`` are the frames of :func:`frames`."""
    told = told or frames(ceiling)
    codes = np.array([lamp.code for lamp in ceiling.fixtures], dtype=np.int64)
    flags = report.faint * int(LinkFlag.FAINT) + report.twin * int(LinkFlag.TWIN)
    return LightEpoch(
        t_begin=report.t_begin,
        t_end=report.t_end,
        ids=codes[report.lamp],
        amplitude=report.amplitude,
        variance=report.variance,
        flags=flags.astype(np.int64),
        lamps=tuple(told[k] if known else None for k, known in zip(report.lamp, report.told, strict=True)),
        block=BlockFlag.NONE,
        noise_a=report.noise_a,
        clock_ppm=0.0,
    )


def epochs(
    ceiling: Ceiling, pose: Poses, span: tuple[float, float], seed: int = 0, reception: Reception | None = None
) -> Iterator[LightEpoch]:
    """Light epochs of a drive, one every 50.3 ms.

    Args:
        ceiling: the lamps.
        pose: where the robot truly is.
        span: begin and end, s.
        seed: of the decoder's errors.
        reception: noise; None: profile A at 500 lx.
    """
    begin = np.arange(span[0], span[1] - EPOCH_S, PERIOD_S)
    middle = begin + 0.5 * EPOCH_S
    links, told = Links(ceiling, reception, seed), frames(ceiling)
    for first in range(0, len(begin), 256):
        part = slice(first, first + 256)
        received = ceiling.amplitudes(pose(middle[part]), middle[part])
        for t, row in zip(begin[part], received, strict=True):
            yield light_epoch(ceiling, links.report(float(t), float(t) + EPOCH_S, row), told)
