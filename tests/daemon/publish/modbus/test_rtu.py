"""Modbus RTU: a line that is a pseudo-terminal, and one in memory."""

import asyncio
import contextlib
import os
import shutil
import struct
import subprocess
import sys
import termios
import time
import tty
from collections.abc import AsyncIterator, Iterator

import pytest

from daemon.config.endpoints import RtuLine
from daemon.publish.modbus import registers, rtu
from daemon.publish.modbus.rtu import RtuServer
from daemon.publish.modbus.server import ModbusPublisher
from hal.clock import LoopClock, SystemClock
from hal.errors import DeviceFault, DeviceMissing, DeviceRefused, HalError
from hal.port.port import MemoryPort, memory_pair
from tests.daemon.publish.modbus.test_registers import snapshot
from tests.daemon.publish.modbus.test_rtu_frames import READ, UNIT, asked
from tests.daemon.publish.network import publishing
from tools.clients import read_rtu


@contextlib.asynccontextmanager
async def line(
    baud: int = 115200, patience_s: float = 60.0
) -> AsyncIterator[tuple[int, str, RtuServer, ModbusPublisher]]:
    """A server on a pseudo-terminal: its other end, its name. It is patient: the tests' computer may be slow."""
    patch = pytest.MonkeyPatch()
    patch.setattr(rtu, "PATIENCE_S", patience_s)
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
        patch.undo()


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


async def test_a_block_over_a_pseudo_terminal() -> None:
    async with line() as (ours, _, server, _):
        block = registers.encode_block(snapshot())
        for _ in range(5):
            os.write(ours, asked())
            assert await answer(ours, 133) == asked(b"\x04\x80" + block)
        os.write(ours, asked(b"\x2b\x0d\x01\x00"))
        assert await answer(ours, 5) == asked(b"\xab\x01"), "an exception for what is not served"
        assert (server.requests, server.unsent) == (6, 0)


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


def test_the_reference_client_does_not_read_a_line_that_it_could_not_set(monkeypatch: pytest.MonkeyPatch) -> None:
    """An adapter that cannot do parity would give nothing but damaged answers."""

    def refuses(*_: object) -> None:
        raise termios.error(22, "Invalid argument")

    ours, theirs = os.openpty()
    name = os.ttyname(theirs)
    monkeypatch.setattr("tools.clients.read_rtu.termios.tcsetattr", refuses)
    monkeypatch.setattr("tools.clients.read_rtu.tty.setraw", lambda _: None)
    read_rtu.Line(name, 115200, UNIT).close()  # a pseudo-terminal has no parity
    monkeypatch.setattr("tools.clients.read_rtu.os.ttyname", lambda _: "/dev/ttyUSB0")
    with pytest.raises(OSError, match="cannot do 115200 bit/s with even parity: Invalid argument"):
        read_rtu.Line(name, 115200, UNIT)
    os.close(ours)
    os.close(theirs)


@pytest.mark.parametrize("words", [["/dev/null"], ["/dev/nowhere"], ["/dev/pts/ptmx", "12345"], ["/dev/null", "fast"]])
def test_the_reference_client_says_what_it_cannot_open(words: list[str]) -> None:
    told = subprocess.run([sys.executable, read_rtu.__file__, *words], capture_output=True, text=True, check=False)
    assert told.returncode == 1
    assert "Traceback" not in told.stderr
    assert told.stderr.startswith(words[0])
    assert "19200" in told.stderr


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


@pytest.mark.virtual
async def test_an_answer_waits_until_the_master_has_let_the_line_go() -> None:
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


@pytest.mark.virtual
async def test_an_adapter_that_sends_our_answer_back() -> None:
    at = Line(echo=True)
    running = asyncio.create_task(at.server.run())
    await asyncio.sleep(0)
    write = b"\x06\x03\xe8\x00\x01"
    for number in (1, 2):
        at.master.write(asked(write))
        await asyncio.sleep(1.0)
        assert len(at.asked) == number, "the echo is no request, the master's repetition is one"
    running.cancel()


@pytest.mark.virtual
async def test_half_a_request_is_forgotten_when_the_line_falls_silent() -> None:
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


@pytest.mark.virtual
async def test_an_answer_for_which_the_master_waits_no_longer_is_not_sent() -> None:
    """Its next request begins within the pause before the answer: what was sent then would collide with it."""
    at = Line()
    running = asyncio.create_task(at.server.run())
    await asyncio.sleep(1.0)
    for first in (asked(), asked() + b"\x00"):  # and a stray byte where the direction changes
        at.heard.clear()
        at.master.write(first)
        await asyncio.sleep(0.002)
        at.master.write(asked(b"\x07")[:3])
        await asyncio.sleep(0.02)
        assert at.heard == []
        at.master.write(asked(b"\x07")[3:])
        await asyncio.sleep(1.0)
        assert [data for _, data in at.heard] == [asked(b"\x07")]
    assert at.server.late == 2
    at.master.write(asked())
    await asyncio.sleep(0.002)
    at.master.write(b"\xff")
    await asyncio.sleep(1.0)
    assert at.heard[-1][1] == asked(), "a stray byte is no request"
    running.cancel()


@pytest.mark.realtime
async def test_what_waited_while_the_computer_had_no_time_is_not_answered() -> None:
    """On a pseudo-terminal: the loop stands still for longer than a master waits, then goes on as ever."""
    async with line(patience_s=rtu.PATIENCE_S) as (ours, _, server, publisher):
        await asyncio.sleep(2 * rtu.TURN_S)
        write = struct.pack(">BHHB4H", 16, 1000, 4, 8, 1, 2, 0, 0)  # a RESET that its master has given up
        os.write(ours, asked(write))
        time.sleep(rtu.PATIENCE_S + 0.2)  # noqa: ASYNC251 - it is to stand still
        os.set_blocking(ours, False)
        await asyncio.sleep(0.1)
        with pytest.raises(BlockingIOError):
            os.read(ours, 1)
        os.set_blocking(ours, True)
        assert (server.late, server.requests) == (1, 0)
        assert publisher.answer(struct.pack(">BHH", 3, 1000, 1))[2:] == bytes(2), "it was not carried out, either"
        os.write(ours, asked())
        assert len(await answer(ours, 133)) == 133


@pytest.mark.virtual
async def test_a_line_that_goes_is_told_and_can_be_opened_anew() -> None:
    at = Line()
    running = asyncio.create_task(at.server.run())
    await asyncio.sleep(0)
    at.master.write(asked())
    await asyncio.sleep(0)
    at.master.close()
    with pytest.raises(HalError):
        await running


@pytest.mark.virtual
async def test_a_line_that_takes_no_answers_is_opened_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """A single one is only counted; the supervisor opens again what has raised."""

    def full(_: bytes) -> None:
        raise DeviceFault("line", "full")

    at = Line()
    running = asyncio.create_task(at.server.run())
    await asyncio.sleep(0)
    for blocked in (True, True, False, True, True):
        with monkeypatch.context() as patch:
            if blocked:
                patch.setattr(at.slave, "write", full)
            at.master.write(asked())
            await asyncio.sleep(1.0)
    assert (at.server.requests, at.server.unsent, running.done()) == (5, 4, False)
    monkeypatch.setattr(at.slave, "write", full)
    at.master.write(asked())
    await asyncio.sleep(1.0)
    with pytest.raises(DeviceFault, match="full"):
        await running


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
