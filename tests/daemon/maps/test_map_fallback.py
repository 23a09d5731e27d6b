"""A stored map without a place in the lamps' survey: what the log says of it, and what becomes of its file."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daemon.maps.autosave import ADRIFT, EVERY_S, FIRST_S
from daemon.maps.map_fallback import another, let_go
from daemon.maps.schema import read
from daemon.maps.store import Start, Store
from estimator.mapping.map_parts import Trial
from estimator.relocalisation import unaligned_map
from estimator.relocalisation.hypothesis_tracking import Seek
from estimator.result import Loop, LoopReason, StepResult
from tests.daemon.maps.autosave_bench import Bench
from tests.daemon.runtime.test_cycle import Bench as Cycling
from tests.daemon.runtime.test_cycle import on_bench
from tests.daemon.support.map_maker import Shape, content

NOW = StepResult(1.0, np.zeros(3), np.zeros(3), np.eye(3), np.zeros(3), np.ones(3), None, -1, None, 0, np.zeros(3), 0)
ASIDE = replace(NOW, aside=True)
GONE = replace(NOW, let_go=1)
FOUND = replace(NOW, loop=Loop(1, 9, 2, 0.01, LoopReason.PLACED))


def test_each_turn_of_it_is_said_once_with_the_map_that_it_is_of(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    steps = [NOW, ASIDE, ASIDE, FOUND, ASIDE, NOW, ASIDE, GONE, GONE]
    gone = [let_go(before, now, 0xABC) for before, now in zip([None, *steps], steps, strict=False)]
    assert [k for k, one in enumerate(gone) if one] == [7]
    said = [record.levelname for record in caplog.records]
    assert said == ["INFO", "INFO", "INFO", "INFO", "WARNING"], "a RESET ends it without a word"
    assert all("00000abc" in record.getMessage() for record in caplog.records)
    assert "was found. The map is now aligned" in caplog.records[1].getMessage()
    assert "was not found" in caplog.records[-1].getMessage()


@pytest.mark.jit
def test_a_map_that_was_let_go_of_is_followed_by_one_of_another_identity() -> None:
    async def work(bench: Cycling) -> None:
        await bench.drive(0, 10)
        step = bench.cycle.parts.step
        bench.cycle.parts.step = lambda records, limits: later(step(records, limits))
        await bench.drive(10, 5)

    def later(result: StepResult) -> StepResult:
        return replace(result, let_go=1)

    bench = on_bench(work)
    ids = [snapshot.map_id for snapshot in bench.snapshots]
    assert len(set(ids)) == 2
    step = next(record for record in bench.records if record.scan == 10)
    assert step.result is not None
    assert ids[-1] == another(ids[0], step.result.t_mono) != another(ids[0], step.result.t_mono + 10.0)


async def test_a_map_set_aside_is_not_saved_over_and_what_follows_it_has_a_file_of_its_own(tmp_path: Path) -> None:
    store = Store(tmp_path)
    stored = content(Shape(map_id=0x77))
    old = store.save(stored, 0x77)
    store.close()
    bench = Bench(tmp_path, start=Start(stored, read(stored)))
    state = bench.state
    assert state is not None
    first = max(state.map.graph.submaps)
    state.map.parts.detached, since = first, state.map.graph.submaps[first].first
    bench.autosaver.loaded()
    unaligned_map.set_aside(state, Trial(first=first, since=since), 0.0, Seek())
    state.map.next_key += 30
    await bench.turn(FIRST_S)
    await bench.turn(2.0 * EVERY_S)
    assert bench.autosaver.saves == 0
    bench.autosaver.ask(bench.told.append)
    assert bench.told == [ADRIFT]
    state.map.parts.aside, bench.map_id = None, 0x78
    await bench.turn(1.0)
    assert bench.autosaver.saves == 1
    assert old.read_bytes() == stored
    ids = sorted(one.map_id for one in Store(tmp_path).generations())
    assert ids == [0x77, 0x78]
