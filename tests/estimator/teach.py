"""A teach drive by the estimator's own forward model, with errors that stay where they are on the floor."""

from dataclasses import replace

import numpy as np

from estimator.calibration.observations import Rows, joined, model
from estimator.light_filter.lambertian import pack_lamps, pack_receiver
from estimator.light_filter.survey import Lamp, Survey
from estimator.measurements import Array


def nominal(side: int = 3) -> Survey:
    """Lamps on a 2.5 m grid."""
    at = [(1.25 + 2.5 * i, 1.25 + 2.5 * j) for j in range(side) for i in range(side)]
    return Survey(tuple(Lamp(k + 1, 7 * k, x, y, 2.9) for k, (x, y) in enumerate(at)))


def real(survey: Survey, seed: int) -> Survey:
    """As it really is: every parameter off by about its prior."""
    g = np.random.default_rng(seed)

    def off(lamp: Lamp) -> Lamp:
        gain, order, sx, sy = g.normal(0.0, (0.15, 0.1, 0.03, 0.03))
        power = lamp.power_w * float(np.exp(gain + 0.1))
        return replace(lamp, power_w=power, order=lamp.order + order, slope_x=float(sx), slope_y=float(sy))

    receiver = replace(survey.receiver, order=1.1, slope_x=0.02, slope_y=-0.015, x=0.02, y=-0.03)
    return replace(survey, lamps=tuple(off(lamp) for lamp in survey.lamps), receiver=receiver, floor=0.02)


def drive(survey: Survey, seed: int, n: int = 3000) -> tuple[Array, Array]:
    """Times, and poses that wind through the whole room in all directions."""
    g = np.random.default_rng(seed)
    reach = np.array([(lamp.x, lamp.y) for lamp in survey.lamps]).max(axis=0) + 1.25
    t = 0.1 * np.arange(n)
    x = reach[0] * (0.5 + 0.44 * np.sin(0.111 * t + g.uniform(0, 6)))
    y = reach[1] * (0.5 + 0.44 * np.sin(0.077 * t + g.uniform(0, 6)))
    return t, np.column_stack((x, y, np.arctan2(np.gradient(y), np.gradient(x))))


def received(survey: Survey, t: Array, pose: Array, seed: int, error: float = 0.0) -> Rows:
    """What the receiver gets; ``error`` of ln strength with a correlation length of about 0.5 m."""
    g = np.random.default_rng(seed)
    parts = []
    for k in range(len(survey.lamps)):
        which = np.full(len(pose), k, dtype=np.int64)
        lamps, receiver = pack_lamps(survey.lamps, survey.depth), pack_receiver(survey.receiver)
        out, _ = model(lamps, receiver, pose, which, survey.floor)
        phase, wave = g.uniform(0, 6, 6), g.normal(0.0, 2.0, (6, 2))
        ripple = error * np.sqrt(1.0 / 3.0) * np.sin(pose[:, :2] @ wave.T + phase).sum(axis=1)
        amplitude = out[:, 0] * np.exp(ripple + 0.003 * g.normal(size=len(pose)))
        parts.append(Rows(pose, which, amplitude, np.full(len(pose), 0.003), t))
    return joined(parts)
