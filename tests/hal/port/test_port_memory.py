"""The memory port pair: order, arrival times in virtual time, closing from either side."""

import asyncio

import pytest

from hal.clock import LoopClock, run_virtual
from hal.errors import DeviceMissing, DeviceRefused, HalError
from hal.port.opening import open_port
from hal.port.port import MemoryPort, memory_pair


class Ear:
    """Keeps what a port delivers."""

    def __init__(self) -> None:
        self.pieces: list[tuple[bytes, float]] = []
        self.lost: list[HalError] = []

    def listen(self, port: MemoryPort) -> None:
        port.start(lambda data, t_rx: self.pieces.append((data, t_rx)), self.lost.append)


async def pair() -> tuple[MemoryPort, MemoryPort]:
    return memory_pair(LoopClock(asyncio.get_running_loop()), "bench")


def test_pieces_arrive_in_order_from_the_loop_with_their_times() -> None:
    async def body() -> None:
        ours, theirs = await pair()
        ear = Ear()
        ear.listen(ours)
        theirs.write(b"one")
        theirs.write(b"two")
        assert ear.pieces == []  # never inside the writer's call
        await asyncio.sleep(1.5)
        theirs.write(b"three")
        await asyncio.sleep(0)
        assert ear.pieces == [(b"one", 10.0), (b"two", 10.0), (b"three", 11.5)]

    run_virtual(body(), start=10.0)


@pytest.mark.virtual
async def test_what_came_before_start_is_delivered_first() -> None:
    ours, theirs = await pair()
    theirs.write(b"early")
    await asyncio.sleep(0.1)
    ear = Ear()
    ear.listen(ours)
    theirs.write(b"late")
    await asyncio.sleep(0)
    assert [data for data, _ in ear.pieces] == [b"early", b"late"]


@pytest.mark.virtual
async def test_close_tells_the_other_end_once_after_the_bytes() -> None:
    ours, theirs = await pair()
    ear, fake_ear = Ear(), Ear()
    ear.listen(ours)
    fake_ear.listen(theirs)
    theirs.write(b"last words")
    theirs.close()
    theirs.close()
    await asyncio.sleep(0.1)
    assert [data for data, _ in ear.pieces] == [b"last words"]
    assert [type(error) for error in ear.lost] == [DeviceMissing]
    assert fake_ear.lost == []  # a close of our own is not a loss
    assert ours.closed
    assert theirs.closed
    for end in (ours, theirs):
        with pytest.raises(DeviceMissing, match="closed"):
            end.write(b"x")


@pytest.mark.virtual
async def test_nothing_is_delivered_after_our_own_close() -> None:
    ours, theirs = await pair()
    ear = Ear()
    ours.start(lambda data, t_rx: (ear.pieces.append((data, t_rx)), ours.close())[0], ear.lost.append)
    theirs.write(b"one")
    theirs.write(b"two")
    await asyncio.sleep(0.1)
    assert [data for data, _ in ear.pieces] == [b"one"]
    assert ear.lost == []


@pytest.mark.virtual
async def test_line_rate_is_visible_to_the_other_end() -> None:
    ours, theirs = await pair()
    assert theirs.peer_baud == 0
    ours.set_baud(115200)
    assert theirs.peer_baud == 115200


def test_open_port_names_what_it_cannot_read() -> None:
    with pytest.raises(DeviceRefused, match=r"COM3: not a device name .*tcp://host:port"):
        asyncio.run(open_port("COM3", 115200))
