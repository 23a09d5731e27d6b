"""Faults on top of faults: seeded storms of random orders, after which the driver must stand and have told no lie."""

from __future__ import annotations

from random import Random

import pytest

from hal.fake.lidar.dialect_grid import State
from hal.fake.lidar.faults import LIDAR
from hal.fake.lidar.models import UST_10LX, UTM_30LX, LidarModel
from tests.faults.bench import Run, falsehoods, play
from tests.hal.fake.bench import Talk, virtual

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


@pytest.mark.parametrize("seed", range(5))
def test_sensor_in_a_storm_of_faults_and_words(seed: int) -> None:
    """Whatever a host says and whatever is ordered, the fake itself never fails, and works after a reboot."""
    chance = Random(seed)
    failures: list[str] = []
    alphabet = "VPIBMQTRSGDNE%0123456789;\n\r\xff "

    async def scene(talk: Talk) -> tuple[State, list[str]]:
        talk.loop.set_exception_handler(lambda _loop, context: failures.append(str(context)))
        talk.schedule.load(storm(seed, set(LIDAR) - {"baud"}))
        for _ in range(400):
            if talk.lost is not None and talk.device.reachable:
                await talk.open()
            if talk.lost is None:
                talk.say("".join(chance.choices(alphabet, k=chance.randrange(1, 30))))
                talk.say(
                    chance.choice(
                        ["MD0000108000000\n", "QT\n", "BM\nGE0000108001\n", "TM0\n", "TM1\n", "TM2\n", "RS\n", "RB\n"]
                    )
                )
            await talk.wait(STORM_S / 400)
        talk.schedule.clear()
        await talk.wait(5.0)
        if talk.lost is not None:
            await talk.open()
        talk.say("\nSCIP2.0\n")
        for _ in range(2):
            talk.say("RB\n")
            await talk.wait(0.1)
        await talk.wait(5.0)
        await talk.open()
        return talk.device.state, [reply.status for reply in await talk.ask("MD0000108000003", 1.0)]

    state, statuses = virtual(scene, UTM_30LX)
    assert failures == []
    assert state is State.IDLE
    assert statuses == ["00", "99", "99", "99"]
