"""Faults on top of faults: seeded storms of random orders, after which the driver must stand and have told no lie."""

from __future__ import annotations

from random import Random

import pytest

from hal.fake.lidar.faults import LIDAR
from hal.fake.lidar.models import UST_10LX, UTM_30LX, LidarModel
from tests.faults.bench import Run, falsehoods, play

STORM_S = 20.0
UNSEEN = {"wrong", "codes"}
"""Ranges that are not what was measured, but correct on the wire."""
TOGETHER = {"duplicate_line"}
"""A line lost and another doubled in one scan: beyond what SCIP's sums can show."""


def storm(seed: int, words: set[str], orders: int = 30) -> str:
    chance = Random(seed)
    out = []
    for _ in range(orders):
        what = chance.choice(sorted(words))
        lines = [f"what = '{what}'", f"when = {chance.uniform(0.0, STORM_S):.3f}"]
        if LIDAR[what].kind != "once":
            lines.append(f"for = {chance.uniform(0.05, 2.0):.3f}")
        if LIDAR[what].kind == "strikes":
            lines.append(f"share = {chance.choice([0.1, 0.5, 1.0])}")
        out.append("\n".join(["[[fault]]", *lines]))
    return "\n".join(out)


@pytest.mark.parametrize("model", [UTM_30LX, UST_10LX], ids=["UTM", "UST"])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_driver_in_a_storm(seed: int, model: LidarModel) -> None:
    orders = storm(seed, set(LIDAR) - UNSEEN - TOGETHER - {"baud"})
    story = play(Run(model, orders, before_s=2.0, fault_s=STORM_S, after_s=15.0))
    lies = [
        line
        for line in falsehoods(story)
        if "stamp off" not in line or float(line.split()[1][:-1]) > story.t_lifted + 2
    ]
    assert lies == []
    assert story.first_after(story.t_lifted) - story.t_lifted < 12.0
    assert story.looks[-1].problem == ""
    assert sum(scan.t_rx > story.t_end - 3.0 for scan in story.scans) >= 118  # of 119 or 120 revolutions
    assert not story.laser
