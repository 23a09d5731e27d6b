"""Modbus RTU: frames among noise and other devices' traffic, and a line that is a pseudo-terminal."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import struct
import subprocess
import tty
from collections.abc import AsyncIterator, Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.endpoints import RtuLine
from daemon.publish import registers, rtu
from daemon.publish.modbus import ModbusPublisher
from daemon.publish.rtu import RtuServer
from daemon.publish.rtu_frames import MAX_FRAME, RtuFrames, framed
from hal.clock import LoopClock, SystemClock, run_virtual
from hal.errors import DeviceFault, DeviceMissing, DeviceRefused, HalError
from hal.port import MemoryPort, memory_pair
from tests.daemon.publish.network import publishing
from tests.daemon.publish.test_registers import snapshot
from tools.clients import read_rtu

READ = struct.pack(">BHH", 4, 0, 64)
UNIT = 17


def crc(data: bytes) -> bytes:
    """CRC-16 of the standard's appendix, bit by bit: polynomial 0xA001, low byte first."""
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
    return value.to_bytes(2, "little")


def asked(body: bytes = READ, unit: int = UNIT) -> bytes:
    frame = bytes([unit]) + body
    return frame + crc(frame)


def test_a_frame_of_the_standards_own_guide() -> None:
    assert framed(17, bytes.fromhex("03006B0003")) == bytes.fromhex("1103006B00037687")
    assert framed(UNIT, READ) == asked()


@pytest.mark.parametrize("size", [1, 2, 3, 7, 100])
def test_requests_in_pieces(size: int) -> None:
    write = struct.pack(">BHHB6H", 16, 1000, 6, 12, *range(6))
    stream = asked() + asked(write) + asked(b"\x06\x03\xe8\x00\x01") + asked(b"\x07")
    frames = RtuFrames(UNIT)
    found = [body for at in range(0, len(stream), size) for _, body in frames.take(stream[at : at + size])]
    assert found == [READ, write, b"\x06\x03\xe8\x00\x01", b"\x07"]
    assert frames.skipped == 0


def test_what_is_for_others_is_passed_over() -> None:
    frames = RtuFrames(UNIT)
    answer = asked(b"\x04\x80" + registers.encode_block(snapshot()), unit=18)
    assert frames.take(asked(unit=18) + answer + asked()) == [(UNIT, READ)]
    assert frames.take(asked(unit=0)) == [(0, READ)], "0 is for all"
    assert frames.take(asked()[:-1] + b"\x00") == []


def test_a_good_request_is_found_at_once_after_any_garbage() -> None:
    @given(st.binary(max_size=600) | st.lists(st.sampled_from([0, UNIT, 4, 16, 255]), max_size=600).map(bytes))
    def run(garbage: bytes) -> None:
        frames = RtuFrames(UNIT)
        frames.take(garbage)
        assert (UNIT, READ) in frames.take(asked())
        assert len(frames._data) <= MAX_FRAME

    run()


# --- a line ----------------------------------------------------------------------------------------------------------


@contextlib.asynccontextmanager
async def line(baud: int = 115200) -> AsyncIterator[tuple[int, str, RtuServer, ModbusPublisher]]:
    """A server on a pseudo-terminal: its other end, its name."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    tty.setraw(ours)
    name = os.ttyname(theirs)
    os.close(theirs)
    publisher = ModbusPublisher(SystemClock(), write=True)
    publisher.publish(snapshot())
    server = RtuServer(RtuLine(name, baud, "8N1", UNIT), publisher.answer)
    running = asyncio.create_task(server.run())
    while server._port is None:  # noqa: ASYNC110 - opened in a thread
        await asyncio.sleep(0.001)
    try:
        yield ours, name, server, publisher
    finally:
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running
        os.close(ours)


@contextlib.contextmanager
def joined(ours: int) -> Iterator[str]:
    """A second pseudo-terminal for a program, joined with the server's by the loop: its name."""
    joint, theirs = os.openpty()
    tty.setraw(theirs)
    tty.setraw(joint)
    loop = asyncio.get_running_loop()
    loop.add_reader(ours, lambda: os.write(joint, os.read(ours, 4096)))
    loop.add_reader(joint, lambda: os.write(ours, os.read(joint, 4096)))
    try:
        yield os.ttyname(theirs)
    finally:
        loop.remove_reader(ours)
        loop.remove_reader(joint)
        os.close(joint)
        os.close(theirs)


async def answer(ours: int, size: int) -> bytes:
    """So many bytes from the line; fails when they do not come."""
    got = b""
    async with asyncio.timeout(5.0):
        while len(got) < size:
            got += await asyncio.to_thread(os.read, ours, size - len(got))
    return got


def test_a_block_over_a_pseudo_terminal() -> None:
    async def run() -> None:
        async with line() as (ours, _, server, _):
            block = registers.encode_block(snapshot())
            for _ in range(5):
                os.write(ours, asked())
                assert await answer(ours, 133) == asked(b"\x04\x80" + block)
            os.write(ours, asked(b"\x2b\x0e\x01\x00"))
            assert await answer(ours, 5) == asked(b"\xab\x01"), "an exception for what is not served"
            assert (server.requests, server.unsent) == (6, 0)

    asyncio.run(run())


def test_the_reference_client_reads_the_line() -> None:
    """Between them a second pair of pseudo-terminals, joined byte by byte."""

    def read(name: str, unit: int) -> dict[str, float | int | str | None]:
        reader = read_rtu.Line(name, 115200, unit)
        try:
            return reader.read(5.0 if unit == UNIT else 0.1)
        finally:
            reader.close()

    async def run() -> dict[str, float | int | str | None]:
        async with line() as (ours, _, _, _):
            with joined(ours) as name:
                with pytest.raises(TimeoutError):
                    await asyncio.to_thread(read, name, UNIT + 1)
                return await asyncio.to_thread(read, name, UNIT)

    assert asyncio.run(run()) == {
        "seq": 70_000, "state": "TRACKING", "reason": 7, "fault": 9, "flags": 0b10111 | 1 << 5,
        "x": 1.2345, "y": -2.3456, "yaw": 3.0,
    }  # fmt: skip


class Line:
    """A server and a master on a line in memory and in virtual time."""

    def __init__(self, echo: bool = False) -> None:
        loop = asyncio.get_running_loop()
        self.heard: list[tuple[float, bytes]] = []
        self.asked: list[bytes] = []
        self.master, self.slave = memory_pair(LoopClock(loop), "line")
        self.master.start(self._hear, lambda _: None)
        self._loop, self._echo = loop, echo
        self.server = RtuServer(RtuLine("/dev/x", 9600, "8E1", UNIT), self._answer, self._open)

    async def _open(self, device: str, baud: int, *, style: str) -> MemoryPort:
        assert (device, baud, style) == ("/dev/x", 9600, "8E1")
        return self.slave

    def _answer(self, body: bytes) -> bytes:
        self.asked.append(body)
        return body

    def _hear(self, data: bytes, t_rx: float) -> None:
        self.heard.append((t_rx, data))
        if self._echo:
            self.master.write(data)


def test_an_answer_waits_until_the_master_has_let_the_line_go() -> None:
    async def run() -> None:
        at = Line()
        running = asyncio.create_task(at.server.run())
        await asyncio.sleep(1.0)
        at.master.write(asked())
        await asyncio.sleep(1.0)
        ((t, data),) = at.heard
        assert t == pytest.approx(1.0 + 3.5 * 11 / 9600, abs=1e-6)
        assert data == asked()
        at.master.write(asked(unit=0))
        await asyncio.sleep(1.0)
        assert len(at.heard) == 1, "what is for all is not answered"
        assert len(at.asked) == 2
        running.cancel()

    run_virtual(run())


def test_an_adapter_that_sends_our_answer_back() -> None:
    async def run() -> None:
        at = Line(echo=True)
        running = asyncio.create_task(at.server.run())
        await asyncio.sleep(0)
        write = b"\x06\x03\xe8\x00\x01"
        for number in (1, 2):
            at.master.write(asked(write))
            await asyncio.sleep(1.0)
            assert len(at.asked) == number, "the echo is no request, the master's repetition is one"
        running.cancel()

    run_virtual(run())


def test_half_a_request_is_forgotten_when_the_line_falls_silent() -> None:
    async def run() -> None:
        at = Line()
        running = asyncio.create_task(at.server.run())
        await asyncio.sleep(0)
        at.master.write(asked()[:5])
        await asyncio.sleep(2 * rtu.SILENCE_S)
        at.master.write(asked()[5:])
        await asyncio.sleep(1.0)
        assert at.asked == []
        at.master.write(asked())
        await asyncio.sleep(1.0)
        assert at.asked == [READ]
        running.cancel()

    run_virtual(run())


def test_a_line_that_goes_is_told_and_can_be_opened_anew() -> None:
    async def run() -> None:
        at = Line()
        running = asyncio.create_task(at.server.run())
        await asyncio.sleep(0)
        at.master.write(asked())
        await asyncio.sleep(0)
        at.master.close()
        with pytest.raises(HalError):
            await running

    run_virtual(run())


def test_an_answer_that_the_line_does_not_take_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: bytes) -> None:
        raise DeviceFault("line", "full")

    async def run() -> None:
        at = Line()
        running = asyncio.create_task(at.server.run())
        await asyncio.sleep(0)
        monkeypatch.setattr(at.slave, "write", full)
        at.master.write(asked())
        await asyncio.sleep(1.0)
        assert (at.server.requests, at.server.unsent, running.done()) == (1, 1, False)
        running.cancel()

    run_virtual(run())


def test_a_line_that_is_not_there_names_the_key() -> None:
    async def run(path: str) -> None:
        await RtuServer(RtuLine(path, 9600, "8E1", 1), bytes).run()

    with pytest.raises(DeviceMissing, match=r"no such device.*modbus\.serial"):
        asyncio.run(run("/dev/nowhere-at-all"))
    with pytest.raises(DeviceRefused, match="not a serial port"):
        asyncio.run(run("/dev/null"))


MBPOLL = shutil.which("mbpoll")


def polled(*options: str) -> list[int]:
    """What mbpoll reads of registers 0 to 3: values behind their numbers, `[1]: 	19532`."""
    assert MBPOLL is not None
    command = [MBPOLL, "-0", "-r", "0", "-c", "4", "-t", "3", "-1", *options]
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=20)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = [row for row in done.stdout.splitlines() if row.startswith("[")]
    return [int(row.split(":")[1].split("(")[0]) for row in rows]


@pytest.mark.system
@pytest.mark.skipif(MBPOLL is None, reason="mbpoll is not installed (Debian: apt-get install mbpoll)")
def test_mbpoll_reads_tcp_and_rtu() -> None:
    words = list(struct.unpack_from(">4H", registers.encode_block(snapshot())))

    async def run() -> tuple[list[int], list[int]]:
        async with publishing() as publisher:
            tcp = await asyncio.to_thread(polled, "-m", "tcp", "-p", str(publisher.port), "127.0.0.1")
        async with line() as (ours, _, _, _):
            with joined(ours) as name:
                options = ("-m", "rtu", "-a", str(UNIT), "-b", "115200", "-P", "none", name)
                return tcp, await asyncio.to_thread(polled, *options)

    assert asyncio.run(run()) == (words, words)


def test_a_path_that_is_no_serial_port_is_named_with_its_key() -> None:
    with pytest.raises(DeviceRefused, match=r"not a serial port \(name .* in `modbus\.serial`"):
        asyncio.run(rtu.open_line("/dev/null", 19200, style="8E1"))
