"""A row of lamps whose light changes from one moment to the next: how far the heading goes astray in sixteen drives."""

from __future__ import annotations

import math

import numpy as np
import pytest

from estimator.light_filter import iterated_update
from estimator.light_filter import light_filter as lf
from estimator.light_filter.survey import Lamp, Survey
from estimator.measurements import Array
from estimator.numerics import se2
from tests.estimator.light_room import RECEIVER, Room, drive

pytestmark = [pytest.mark.jit, pytest.mark.slow, pytest.mark.no_cover]

ROW = tuple(Lamp(k + 1, k, 2.5 * k, 0.0, 2.9, sigma_ln=0.05) for k in range(10))
LAMPS = ROW + tuple(Lamp(20 + k, 10 + k, 22.5, 2.5 * (k + 1), 2.9, sigma_ln=0.05) for k in range(4))
CHANGE, EPOCH_S = 0.12, 0.1


def astray(seed: int, *, lasts: bool) -> float:
    """Largest error of the heading, deg, in the 4 s after every other lamp is stronger, and the others weaker."""
    rng = np.random.default_rng(seed)
    across, speed, begins = rng.uniform(-0.5, 0.5), rng.uniform(0.3, 0.9), rng.uniform(9.0, 11.0)
    change = CHANGE * rng.choice([-1, 1])

    def cover(lamp: int, t: float) -> float:
        changed = t > begins and (lasts or t < begins + EPOCH_S)
        return 1.0 + (change * (1 if lamp % 2 else -1) if changed else 0.0)

    def along(t: float) -> Array:
        return np.array((1.0 + speed * t, across, 0.0))

    true = tuple(
        Lamp(one.lamp_id, one.code, one.x, one.y, one.z, one.power_w * math.exp(0.05 * rng.standard_normal()))
        for one in LAMPS
    )
    room = Room(lamps=true, survey=Survey(LAMPS, RECEIVER), cover=cover, seed=seed)
    filter_ = lf.new_lights(Survey(LAMPS, RECEIVER))
    lf.place(filter_, along(0.0) + np.array((0.02, 0.05, 0.03)), np.diag((0.1**2, 0.2**2, 0.1**2)))
    worst = 0.0
    for t, odometry, epoch in drive(room, along, begins + 4.0, 0.0):
        lf.predict(filter_, odometry)
        result = lf.update(filter_, epoch)
        if t > begins:
            worst = max(worst, abs(math.degrees(se2.wrap(float(result.T_map_base[2])))))
    return worst


@pytest.mark.parametrize(("lasts", "most", "unbounded"), [(False, 15.0, 100.0), (True, 60.0, 100.0)])
def test_one_epoch_leads_the_heading_no_farther_than_it_may_be(
    monkeypatch: pytest.MonkeyPatch, lasts: bool, most: float, unbounded: float
) -> None:
    assert max(astray(seed, lasts=lasts) for seed in range(16)) < most
    monkeypatch.setattr(iterated_update, "nis_bound", lambda _: math.inf)
    assert max(astray(seed, lasts=lasts) for seed in range(16)) > unbounded, "else this would test nothing"
