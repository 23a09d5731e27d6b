"""Parts that fail are restarted, ever more slowly; loss and return are said once."""

import asyncio
import logging
from collections.abc import Awaitable, Callable
from itertools import pairwise
from random import Random

import pytest

from daemon.health.supervisor import LONGEST_S, Supervisor
from hal.clock import run_virtual
from hal.errors import DeviceRefused


def supervise(run: Callable[[], Awaitable[None]], seconds: float) -> tuple[Supervisor, bool]:
    """Keep one part for some virtual time; whether its autosaver ended by itself."""

    async def go() -> tuple[Supervisor, bool]:
        supervisor = Supervisor(random=Random(1))
        autosaver = asyncio.create_task(supervisor.keep("modbus", run))
        await asyncio.sleep(seconds)
        ended = autosaver.done()
        autosaver.cancel()
        return supervisor, ended

    return run_virtual(go())


def test_a_part_that_fails_is_restarted_ever_more_slowly() -> None:
    starts: list[float] = []

    async def fail() -> None:
        starts.append(asyncio.get_running_loop().time())
        raise DeviceRefused("Modbus on 127.0.0.1:1502", "port in use")

    supervisor, _ = supervise(fail, 300.0)
    pauses = [after - before for before, after in pairwise(starts)]
    assert 0.3 < pauses[0] < 0.7
    assert all(later > earlier for earlier, later in pairwise(pauses[:5]))
    assert max(pauses) <= 1.25 * LONGEST_S
    assert len(starts) >= 12
    assert supervisor.failed == {"modbus"}
    assert supervisor.restarts.total() == len(starts)


def test_loss_and_return_are_one_line_each(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    tries = 0

    async def third_time_lucky() -> None:
        nonlocal tries
        tries += 1
        if tries < 3:
            raise DeviceRefused("Modbus on 127.0.0.1:1502", "port in use", "stop the other program")
        await asyncio.Event().wait()

    supervisor, _ = supervise(third_time_lucky, 30.0)
    assert supervisor.failed == set()
    assert [record.message for record in caplog.records] == [
        "modbus: Modbus on 127.0.0.1:1502: port in use (stop the other program); the daemon tries again until it works",
        "modbus works again",
    ]


def test_a_defect_is_logged_in_full_and_the_part_restarted(caplog: pytest.LogCaptureFixture) -> None:
    """Once, not every half minute for as long as it lasts; another one is told, and the same one after a return."""
    tries = 0

    async def defect() -> None:
        nonlocal tries
        tries += 1
        if tries == 9:
            await asyncio.sleep(1.0)  # it works for a while
        raise ValueError("a defect" if tries != 5 else "another")

    supervisor, _ = supervise(defect, 300.0)
    assert supervisor.restarts.total() >= 10
    lost = [
        record for record in caplog.records if "component modbus has failed; the daemon restarts it" in record.message
    ]
    assert [str(record.exc_info[1]) for record in lost if record.exc_info] == [
        "a defect", "another", "a defect", "a defect"
    ]  # fmt: skip


def test_a_part_that_ends_by_itself_is_not_restarted() -> None:
    starts = 0

    async def once() -> None:
        nonlocal starts
        starts += 1

    supervisor, ended = supervise(once, 60.0)
    assert (starts, ended, supervisor.failed) == (1, True, set())


def test_after_a_long_good_run_the_back_off_starts_anew() -> None:
    starts: list[float] = []

    async def run_for_a_while() -> None:
        now = asyncio.get_running_loop().time()
        starts.append(now)
        await asyncio.sleep(0.0 if len(starts) < 6 else 100.0)
        raise DeviceRefused("lidar", "gone")

    supervise(run_for_a_while, 250.0)
    assert starts[6] - starts[5] < 101.0
    assert starts[5] - starts[4] > 4.0


@pytest.mark.virtual
async def test_cancelling_is_no_failure() -> None:
    supervisor = Supervisor()
    autosaver = asyncio.create_task(supervisor.keep("pose", asyncio.Event().wait))  # type: ignore[arg-type]  # waits
    await asyncio.sleep(1.0)
    autosaver.cancel()
    with pytest.raises(asyncio.CancelledError):
        await autosaver
    assert (supervisor.restarts.total(), supervisor.failed) == (0, set())
