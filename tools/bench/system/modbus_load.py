"""The Modbus server under load: eight clients' reads none of which may be lost, and floods that must not delay cycles.

The server has a process of its own with a tick of 3 ms work 40 times a second, under SCHED_FIFO where that is allowed,
as the daemon's loop has it; how late its ticks begin is measured in turns without and with a flood.
"""

import argparse
import asyncio
import gc
import json
import multiprocessing
import os
import selectors
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Final

import numpy as np

from daemon.publish.modbus import registers
from daemon.publish.modbus.server import ModbusPublisher
from hal.clock import SystemClock
from tools.bench.support.children import child, ended, lines
from tools.bench.system.modbus import connected, example, request
from tools.ci.figures import Figure, bounded

COMMAND: Final = "python -m tools.bench modbus_load"
CLIENTS: Final = 8
READS: Final = 100_000
FLOODS: Final = ("UDP", "rubbish", "TCP", "connections")
ROUNDS: Final = 6
ROUND_S: Final = 5.0
_PERIOD_S: Final = 0.025
_WORK_S: Final = 0.003
_PATIENCE_S: Final = 1.0
_PRIORITY: Final = 40


async def serve() -> None:
    """Tick until standard input ends; at each line, tell how late the ticks since the last line were (us)."""
    publisher = ModbusPublisher(SystemClock())
    await publisher.start("127.0.0.1", 0)
    gc.collect()
    gc.freeze()
    fifo = True
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(_PRIORITY))
    except OSError:
        fifo = False
    print(json.dumps({"port": publisher.port, "fifo": fifo}), flush=True)
    late: list[float] = []
    loop, ended = asyncio.get_running_loop(), asyncio.Event()

    def told() -> None:
        if not sys.stdin.buffer.raw.read(1):  # type: ignore[attr-defined]  # standard input is a pipe, so raw is there
            ended.set()
            return
        print(json.dumps(late), flush=True)
        late.clear()

    loop.add_reader(sys.stdin, told)
    due, seq = loop.time() + _PERIOD_S, 0
    while not ended.is_set():
        await asyncio.sleep(due - loop.time())
        late.append((loop.time() - due) * 1e6)
        seq += 1
        until = time.thread_time() + _WORK_S
        publisher.publish(example(seq))
        while time.thread_time() < until:
            pass
        due += _PERIOD_S
    await publisher.close()


@contextmanager
def server() -> Iterator[tuple[int, bool, Callable[[], list[float]]]]:
    """Port of a server in its own process, whether it runs under FIFO, and what asks for its lateness."""
    command = [sys.executable, "-m", "tools.bench.system.modbus_load", "--serve"]
    with child(*command, ask=True, hear=True) as process:
        assert process.stdin is not None
        stdin, said = process.stdin, lines(process, "the server")

        def late() -> list[float]:
            stdin.write(b"\n")
            stdin.flush()
            return [float(value) for value in json.loads(next(said))]

        facts = json.loads(next(said))
        yield facts["port"], facts["fifo"], late
        stdin.close()
        ended(process, "the server")


def reads(port: int, total: int) -> tuple[int, int, float]:
    """Answers lost and wrong of so many reads by eight UDP clients, nothing repeated; and answers per second."""
    selector = selectors.DefaultSelector()
    socks = [connected(port, socket.SOCK_DGRAM) for _ in range(CLIENTS)]
    asked, lost, wrong, got = 0, 0, 0, 0
    for sock in socks:
        asked += 1
        selector.register(sock, selectors.EVENT_READ, [sock, asked])
        sock.send(request(asked))
    begin = time.perf_counter()
    while got + lost < total:
        ready = selector.select(_PATIENCE_S)
        for key in [key for key, _ in ready] or list(selector.get_map().values()):
            sock, number = key.data
            if ready:
                answer = sock.recv(512)
                got += 1
                good = len(answer) == 9 + 2 * registers.BLOCK_WORDS and answer[9:11] == b"LL"
                wrong += not good or int.from_bytes(answer[:2], "big") != number & 0xFFFF
            else:
                lost += 1
            if asked < total:
                asked += 1
                key.data[1] = asked
                sock.send(request(asked))
            else:
                selector.unregister(sock)
    rate = got / (time.perf_counter() - begin)
    for sock in socks:
        sock.close()
    selector.close()
    return lost, wrong, rate


def flood(port: int, kind: str) -> None:
    """As fast as this process can, for ever: whole requests or rubbish by UDP, pipelined by TCP, or new connections."""
    while kind == "connections":
        with suppress(OSError):
            connected(port, socket.SOCK_STREAM).close()
    if kind == "TCP":
        socks = [connected(port, socket.SOCK_STREAM) for _ in range(CLIENTS)]
        data = b"".join(request(number) for number in range(100))
        for sock in socks:
            sock.setblocking(False)
        while True:
            for sock in socks:
                with suppress(BlockingIOError):
                    sock.send(data)
                with suppress(BlockingIOError):
                    sock.recv(1 << 16)
    sock = connected(port, socket.SOCK_DGRAM)
    data = request(1) if kind == "UDP" else os.urandom(24)
    sock.setblocking(False)
    while True:
        with suppress(OSError):
            sock.send(data)


def added(port: int, late: Callable[[], list[float]], kind: str) -> tuple[float, float, int]:
    """99th percentile of the lateness (ms) without and with a flood, in turns; and ticks of each."""
    quiet: list[float] = []
    busy: list[float] = []
    for _ in range(ROUNDS):
        late()
        time.sleep(ROUND_S)
        quiet += late()
        process = multiprocessing.get_context("spawn").Process(target=flood, args=(port, kind), daemon=True)
        process.start()
        time.sleep(0.5)  # it has to begin
        late()
        time.sleep(ROUND_S)
        busy += late()
        process.kill()
        process.join()
        time.sleep(0.1)
    return float(np.percentile(quiet, 99)) * 1e-3, float(np.percentile(busy, 99)) * 1e-3, len(busy)


def run() -> list[Figure]:
    """Every figure."""
    figures = []
    with server() as (port, fifo, late):
        lost, wrong, rate = reads(port, READS)
        figures.append(bounded(f"of {READS} reads by {CLIENTS} UDP clients lost", lost, "", "<= 0", COMMAND))
        figures.append(bounded("answers to another's or an earlier request", wrong, "", "<= 0", COMMAND))
        figures.append(bounded("reads per second", rate, "1/s", ">= 5000", COMMAND))
        scheduling = "SCHED_FIFO" if fifo else "ordinary scheduling"
        for kind in FLOODS:
            quiet, busy, ticks = added(port, late, kind)
            name = f"lateness p99, {scheduling}, {ticks} ticks"
            figures.append(Figure(f"{name}, no flood", quiet, "ms", command=COMMAND))
            figures.append(Figure(f"{name}, flood of {kind}", busy, "ms", command=COMMAND))
            figures.append(bounded(f"p99 that a flood of {kind} adds", busy - quiet, "ms", "<= 1", COMMAND))
    return figures


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--serve", action="store_true", required=True, help=argparse.SUPPRESS)
    parser.parse_args()
    asyncio.run(serve())
