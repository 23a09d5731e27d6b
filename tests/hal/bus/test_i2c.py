"""I2C messages, and the frames that carry them to another process."""

import asyncio
import errno
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from itertools import pairwise

import pytest

from hal.bus import i2c_frames as frames
from hal.bus.i2c import AsyncBus, Message, Transferred, check, read, write
from hal.bus.opening import blocking_opener, open_bus
from hal.clock import LoopClock
from hal.errors import DeviceFault, DeviceMissing, DeviceRefused, HalError
from hal.fake.adc.converter import FakeAdc, FakeBuses
from hal.fake.faults.schedule import FaultSchedule


@pytest.mark.parametrize("name", ["", "1", "i2c-1", "serial:/dev/ttyACM0", "http://x", "udp://127.0.0.1:1"])
def test_a_name_of_no_kind_is_refused_with_the_kinds_there_are(name: str) -> None:
    with pytest.raises(DeviceRefused, match=r"not the name of an I2C bus .*adapter:NAME, unix:/path"):
        asyncio.run(open_bus(name))


def test_names_choose_the_kind() -> None:
    from hal.bus.i2c_linux import open_linux
    from hal.bus.i2c_remote import open_remote

    assert blocking_opener("/dev/i2c-1") is blocking_opener("adapter:bcm2835") is open_linux
    assert blocking_opener("unix:/run/x") is blocking_opener("tcp://robot:10941") is open_remote


@pytest.mark.parametrize(
    ("messages", "says"),
    [
        ((), "0 messages"),
        (tuple(read(0x4D, 2) for _ in range(43)), "43 messages"),
        ((read(0x4D, 8193),), "8193 bytes"),
        ((read(0x4D, 65538),), "65538 bytes"),  # would silently become 2 in 16 bits
        ((read(0x4D, 0),), "0 bytes"),
        ((write(0x4D, b""),), "0 bytes"),
        ((read(0x80, 2),), "0x80"),
        ((Message(0x4D, b"x", 2),), "a message must either write or read"),
    ],
)
def test_what_no_kernel_takes(messages: tuple[Message, ...], says: str) -> None:
    with pytest.raises(OSError, match=says) as caught:
        check(messages)
    assert caught.value.errno == errno.EINVAL


def test_the_longest_that_goes() -> None:
    check(tuple(read(0x7F, 8192) for _ in range(42)))


@asynccontextmanager
async def on_memory(fault: str = "") -> AsyncGenerator[tuple[AsyncBus, FakeAdc]]:
    clock = LoopClock(asyncio.get_running_loop())
    fake = FakeAdc(lambda t: 0.0 * t + 0.5, clock)
    buses = FakeBuses(clock)
    buses.plug("x", fake)
    schedule = FaultSchedule({"adc": fake})
    if fault:
        schedule.load(f"[[fault]]\n{fault}")
        await asyncio.sleep(1e-6)
    yield await buses("x"), fake
    schedule.close()


@pytest.mark.virtual
async def test_a_memory_bus_takes_the_time_of_its_bits() -> None:
    async with on_memory() as (bus, _):
        loop = asyncio.get_running_loop()
        before = loop.time()
        done = await bus.transfer((read(0x4D, 1000),))
        assert done.reads == (b"\x08\x00" * 500,)
        assert done.t0 == before
        assert loop.time() == pytest.approx(done.t1)
        assert done.t1 - done.t0 == pytest.approx(9010 / 400e3, abs=1e-4)


@pytest.mark.virtual
async def test_a_failure_takes_its_time_too() -> None:
    async with on_memory("what = 'timeout'") as (bus, _):
        before = asyncio.get_running_loop().time()
        with pytest.raises(TimeoutError):
            await bus.transfer((read(0x4D, 1000),))
        assert asyncio.get_running_loop().time() - before == pytest.approx(1.0, abs=1e-3)


@pytest.mark.virtual
async def test_transactions_take_turns_with_a_stream() -> None:
    async with on_memory() as (bus, _):
        got: list[Transferred] = []
        task = asyncio.create_task(bus.stream((read(0x4D, 2222),), lambda done, dropped: got.append(done)))
        await asyncio.sleep(0.12)
        between = await bus.transfer((read(0x4D, 2),))
        await asyncio.sleep(0.2)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        assert len(got) >= 5
        assert any(early.t1 <= between.t0 < between.t1 <= late.t0 for early, late in pairwise(got))


@pytest.mark.virtual
async def test_an_unplugged_adapter_stays_dead_for_whoever_had_it_open() -> None:
    async with on_memory() as (bus, fake):
        schedule = FaultSchedule({"adc": fake})
        schedule.load("[[fault]]\nwhat = 'gone'\nfor = 1.0")
        await asyncio.sleep(0.5)
        for _ in range(2):
            with pytest.raises(OSError, match="No such device"):
                await bus.transfer((read(0x4D, 2),))
            await asyncio.sleep(1.0)
        schedule.close()


@pytest.mark.virtual
async def test_an_opener_says_what_is_plugged_in() -> None:
    clock = LoopClock(asyncio.get_running_loop())
    buses = FakeBuses(clock)
    buses.plug("/dev/i2c-1", FakeAdc(lambda t: t, clock))
    with pytest.raises(DeviceMissing, match=r"no such bus .plugged in: /dev/i2c-1"):
        await buses("/dev/i2c-2")


HELLO = bytes.fromhex("00000019 01 4c493243 01 3ff8000000000000 0004") + b"boot" + bytes.fromhex("0003") + b"bcm"
TRANSFER = bytes.fromhex("0000000f 03 00000007 02 48 00 0001 01 48 01 0002")
DONE = bytes.fromhex(
    "00000031 04 00000007 0000 3ff0000000000000 4000000000000000 4008000000000000 4010000000000000 02"
    "0002 0fff 0003 010203"
)


def test_hello() -> None:
    assert frames.hello(1.5, "boot", "bcm") == HELLO
    assert frames.parse_hello(HELLO[5:]) == frames.Hello(1.5, "boot", "bcm")


def test_transfer() -> None:
    messages = (write(0x48, b"\x01"), read(0x48, 2))
    assert frames.transfer(7, messages) == TRANSFER
    assert frames.parse_transfer(TRANSFER[5:]) == (7, messages)


def test_done() -> None:
    done = frames.Done(7, 0, 1.0, 2.0, 3.0, 4.0, (b"\x0f\xff", b"\x01\x02\x03"))
    assert frames.done(done) == DONE
    assert frames.parse_done(DONE[5:]) == done


@pytest.mark.parametrize(
    ("error", "noun"),
    [(DeviceMissing("a", "gone", "connect it"), 1), (DeviceRefused("a", "busy"), 2), (DeviceFault("a", "stuck"), 3)],
)
def test_refused(error: HalError, noun: int) -> None:
    raw = frames.refused(error)
    assert raw[4] == frames.REFUSED
    assert raw[5] == noun
    parsed = frames.parse_refused(raw[5:], "tcp://x")
    assert type(parsed) is type(error)
    assert (parsed.device, parsed.problem, parsed.remedy) == ("tcp://x", error.problem, error.remedy)


@pytest.mark.parametrize("piece", [1, 2, 3, 7, 1000])
def test_frames_are_cut_out_of_any_pieces(piece: int) -> None:
    splitter, found = frames.Splitter(), []
    stream = HELLO + TRANSFER + DONE + TRANSFER
    for start in range(0, len(stream), piece):
        found += splitter.feed(stream[start : start + piece])
    assert [kind for kind, _ in found] == [1, 3, 4, 3]
    assert found[2][1] == DONE[5:]


@pytest.mark.parametrize("length", [0, frames.MAX_FRAME + 1, 0xFFFFFFFF])
def test_a_length_that_cannot_be(length: int) -> None:
    with pytest.raises(frames.BadFrame, match="a message of"):
        frames.Splitter().feed(length.to_bytes(4, "big") + b"\x03")


def test_the_longest_transaction_fits() -> None:
    answer = frames.Done(1, 0, 0.0, 0.0, 0.0, 0.0, (bytes(8192),) * 42)
    (found,) = frames.Splitter().feed(frames.done(answer))
    assert frames.parse_done(found[1]) == answer
    (found,) = frames.Splitter().feed(frames.transfer(1, (write(1, bytes(8192)),) * 42))
    assert len(frames.parse_transfer(found[1])[1]) == 42


@pytest.mark.parametrize("cut", range(len(TRANSFER) - 5))
def test_a_transfer_that_is_cut(cut: int) -> None:
    with pytest.raises(frames.BadFrame):
        frames.parse_transfer(TRANSFER[5 : 5 + cut])


@pytest.mark.parametrize("cut", range(len(DONE) - 5))
def test_an_answer_that_is_cut(cut: int) -> None:
    with pytest.raises(frames.BadFrame):
        frames.parse_done(DONE[5 : 5 + cut])


@pytest.mark.parametrize(
    ("body", "says"),
    [
        (HELLO[5:] + b"x", "too long"),
        (b"\x00" + HELLO[6:], "this is not an I2C bus server"),
        (HELLO[5:9] + b"\x02" + HELLO[10:], "version 2"),
        (HELLO[5:10] + bytes.fromhex("7ff8000000000000") + HELLO[18:], "impossible times"),
        (HELLO[5:-3] + b"\xff\xfe\xfd", "UTF-8"),
    ],
)
def test_greetings_that_are_none(body: bytes, says: str) -> None:
    with pytest.raises(frames.BadFrame, match=says):
        frames.parse_hello(body)


def test_times_must_follow_each_other() -> None:
    with pytest.raises(frames.BadFrame, match="times"):
        frames.parse_done(frames.done(frames.Done(1, 0, 1.0, 3.0, 2.0, 4.0, ()))[5:])


def test_flags_and_nouns_that_do_not_exist() -> None:
    with pytest.raises(frames.BadFrame, match="flags"):
        frames.parse_transfer(bytes.fromhex("00000007 01 48 02 0001"))
    with pytest.raises(frames.BadFrame, match="kind of error"):
        frames.parse_refused(b"\x09\x00\x00\x00\x00", "x")


def test_long_texts_are_cut_without_breaking_a_character() -> None:
    parsed = frames.parse_refused(frames.refused(DeviceFault("x", "ä" * 2000, "b"))[5:], "x")
    assert parsed.problem == "ä" * 500
