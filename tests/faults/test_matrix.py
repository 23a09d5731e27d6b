"""The fault matrix through the whole daemon in virtual time: {8 words} x {3 devices} x {start, run, stop}.

A third of the cells runs with the system tests, another third with every commit; all of them with the slow ones.
"""

from __future__ import annotations

import dataclasses
import logging

import pytest

from hal.fake.lidar.device import FakeHokuyo
from tests.faults.house import House
from tests.faults.matrix import DEVICES, TIMES, WORDS, Cell, cells, objections, play
from tests.rotation import share

CELLS = cells()


def third(cell: Cell) -> int:
    """Which third a cell belongs to: each has every word at every device."""
    return (DEVICES.index(cell.device) + WORDS.index(cell.word) + TIMES.index(cell.time)) % 3


def marked(cell: Cell) -> object:
    """A cell with the row of tests that it runs in; a known defect has to show."""
    marks = [pytest.mark.system, *share(third(cell), 3)]
    if cell.defect:
        marks.append(pytest.mark.xfail(reason=cell.defect, strict=True, raises=AssertionError))
    return pytest.param(cell, marks=marks, id=cell.name.replace(" ", "-"))


@pytest.mark.jit
@pytest.mark.timeout(600)
@pytest.mark.parametrize("cell", [marked(cell) for cell in CELLS])
def test_survived(cell: Cell) -> None:
    said = objections(cell, play(cell))
    assert said == [], f"{cell.name}:\n" + "\n".join(said)


def test_the_matrix_is_whole() -> None:
    assert len(CELLS) == len(set(CELLS)) == len(WORDS) * len(DEVICES) * len(TIMES) == 72
    for number in range(3):
        mine = [cell for cell in CELLS if third(cell) == number]
        assert {(cell.device, cell.word) for cell in mine} == {(device, word) for device in DEVICES for word in WORDS}
        assert {cell.time for cell in mine} == set(TIMES)


@pytest.mark.system
@pytest.mark.jit
@pytest.mark.timeout(600)
def test_a_cell_that_is_not_survived_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """The judge is no friend: a fault that goes unnamed, a lost pose and a strange code are all objected to.

    So are, in every cell, a laser that is on after a stop, and a warning at the very end.
    """
    stop = House.stop

    async def grudging(house: House) -> float:
        logging.getLogger("daemon.app").warning("lidar does not stop")
        return await stop(house)

    cell = next(cell for cell in CELLS if (cell.device, cell.word, cell.time) == ("odometry", "off", "run"))
    fine = dataclasses.replace(cell, word="ok", codes=(), silent=0.0, states=("TRACKING",), back=0.0, gone=0.0)
    assert objections(fine, play(fine)) == []
    monkeypatch.setattr(House, "stop", grudging)
    monkeypatch.setattr(FakeHokuyo, "laser", True)
    out = play(dataclasses.replace(cell, defect=""))
    told = objections(dataclasses.replace(cell, codes=(153,), silent=0.1, states=("TRACKING",), back=0.0), out)
    for words in (
        *("fault 153 was never named", "strange faults", "silence was shown", "said DEGRADED"),
        *("the laser was left on", "lidar does not stop"),
    ):
        assert any(words in one for one in told), told
