"""The Modbus server against pymodbus's own server: both in one process, asked in turns by one plain-socket client."""

import argparse
import asyncio
import json
import selectors
import socket
import statistics
import struct
import sys
import time
import timeit
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

import pymodbus
from pymodbus.server import ModbusTcpServer, ModbusUdpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from daemon.publish.modbus import registers
from daemon.publish.modbus.server import ModbusPublisher
from daemon.snapshot import Snapshot, State
from hal.clock import SystemClock
from tools.bench.support.children import child, ended, lines
from tools.ci.figures import Figure, bounded, table
from tools.sim.ports import free_port

COMMAND: Final = "python -m tools.bench.system.modbus"
PEER: Final = f"pymodbus {pymodbus.__version__} server"
OURS: Final = "ours"
PAIRS: Final = 12
READS: Final = 250
CLIENTS: Final = 8
ROUNDS: Final = 60
PIPELINED: Final = 2000
_PATIENCE_S: Final = 0.03
_HOST: Final = "127.0.0.1"
_PERIOD_S: Final = 0.025


def example(seq: int) -> Snapshot:
    """A snapshot with everything in it."""
    pose, t = (1.0 + seq * 1e-3, -2.0, 0.5), seq * _PERIOD_S
    return Snapshot(
        seq=seq, t_mono=t, t_sent=t + 0.01, t_utc=1.7e9 + t, state=State.TRACKING, reason=0, pose=pose, odom=pose,
        predicted=pose, covariance=(1e-4, 1e-6, 1e-4, 1e-7, 1e-7, 1e-5), velocity=(0.5, 0.0, 0.1),
        known=(True, True, True), scan_rate=40.0, cycle_us=2500, lidar_ok=True,
    )  # fmt: skip


def request(transaction: int) -> bytes:
    """A read of the whole block."""
    return struct.pack(">HHHBBHH", transaction & 0xFFFF, 0, 6, 1, 4, 0, registers.BLOCK_WORDS)


async def serve() -> None:
    """Both servers on loopback until standard input ends; ours gets a new snapshot 40 times a second, the peer none."""
    publisher = ModbusPublisher(SystemClock())
    await publisher.start(_HOST, 0)
    peer_port = free_port()
    words = list(struct.unpack(f">{registers.BLOCK_WORDS}H", registers.encode_block(example(1))))
    servers = [
        kind(SimDevice(0, simdata=[SimData(0, values=words, datatype=DataType.REGISTERS)]), address=(_HOST, peer_port))
        for kind in (ModbusUdpServer, ModbusTcpServer)
    ]
    running = [asyncio.create_task(server.serve_forever()) for server in servers]
    await asyncio.sleep(0.2)
    sys.stdout.write(json.dumps({OURS: publisher.port, PEER: peer_port}) + "\n")
    sys.stdout.flush()
    ended = asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)
    seq = 0
    while not ended.done():
        seq += 1
        publisher.publish(example(seq))
        await asyncio.sleep(_PERIOD_S)
    await publisher.close()
    for server in servers:
        await server.shutdown()
    await asyncio.gather(*running, return_exceptions=True)


@contextmanager
def servers() -> Iterator[dict[str, int]]:
    """Ports of both servers by name, in a process of their own."""
    command = [sys.executable, "-m", "tools.bench.system.modbus", "--serve"]
    with child(*command, ask=True, hear=True) as process:
        yield json.loads(next(lines(process, "the servers")))
        assert process.stdin is not None
        process.stdin.close()
        ended(process, "the servers")


def connected(port: int, kind: socket.SocketKind) -> socket.socket:
    """A socket that talks to one server."""
    sock = socket.socket(socket.AF_INET, kind)
    sock.settimeout(1.0)
    sock.connect((_HOST, port))
    if kind == socket.SOCK_STREAM:
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return sock


def round_trips(ports: dict[str, int], kind: socket.SocketKind) -> dict[str, float]:
    """Median round trip of a whole-block read in microseconds, servers asked in turns of some hundred reads."""
    socks = {name: connected(port, kind) for name, port in ports.items()}
    times: dict[str, list[float]] = {name: [] for name in ports}
    for _ in range(PAIRS):
        for name, sock in socks.items():
            for number in range(READS):
                begin = time.perf_counter()
                sock.send(request(number))
                answer = sock.recv(512)
                times[name].append(time.perf_counter() - begin)
                assert len(answer) == 9 + 2 * registers.BLOCK_WORDS
    for sock in socks.values():
        sock.close()
    return {name: 1e6 * statistics.median(taken) for name, taken in times.items()}


def lost_in_bursts(port: int) -> float:
    """Percent of answers lost or repeated when eight UDP clients ask at the same moment, each once per round."""
    socks = [connected(port, socket.SOCK_DGRAM) for _ in range(CLIENTS)]
    wrong = 0
    for number in range(ROUNDS):
        for sock in socks:
            sock.send(request(number))
        for sock in socks:
            sock.settimeout(_PATIENCE_S)
            got = _transactions(sock, number)
            wrong += got != 1
    for sock in socks:
        sock.close()
    return 100.0 * wrong / (ROUNDS * CLIENTS)


def _transactions(sock: socket.socket, number: int) -> int:
    """How many answers to one request come: waits for the first, then looks for more."""
    count = 0
    try:
        while True:
            count += int.from_bytes(sock.recv(512)[:2], "big") == number
            sock.settimeout(0.001)
    except (TimeoutError, BlockingIOError):
        return count


def rate_udp(port: int, duration: float = 1.0) -> float:
    """Requests per second of eight UDP clients, each with one request outstanding."""
    selector, count = selectors.DefaultSelector(), 0
    for _ in range(CLIENTS):
        sock = connected(port, socket.SOCK_DGRAM)
        selector.register(sock, selectors.EVENT_READ, sock)
        sock.send(request(0))
    begin = time.perf_counter()
    while time.perf_counter() - begin < duration:
        for key, _ in selector.select(0.1):
            key.data.recv(512)
            key.data.send(request(0))
            count += 1
    rate = count / (time.perf_counter() - begin)
    for key in list(selector.get_map().values()):
        key.data.close()
    selector.close()
    return rate


def pipelined(port: int, requests: int) -> tuple[int, float]:
    """Answers to requests sent in one go on one TCP connection, and answers per second."""
    size = 9 + 2 * registers.BLOCK_WORDS
    with connected(port, socket.SOCK_STREAM) as sock:
        begin, got = time.perf_counter(), 0
        stream = b"".join(request(number) for number in range(requests))
        sock.settimeout(0.5)
        try:
            for start in range(0, len(stream), 1200):
                sock.sendall(stream[start : start + 1200])
                while got < size * (start + 1200) // 12 and got < size * requests:
                    got += len(sock.recv(1 << 16))
        except TimeoutError:
            pass
        return got // size, got / size / (time.perf_counter() - begin)


def cost_us(function: Callable[[Snapshot], bytes]) -> float:
    """Time to encode one snapshot, microseconds (best of five)."""
    taken = example(1)
    return min(timeit.repeat(lambda: function(taken), number=1000, repeat=5)) * 1e3


def run() -> list[Figure]:
    """Every figure."""
    figures = []
    with servers() as ports:
        for label, kind in (("UDP", socket.SOCK_DGRAM), ("TCP", socket.SOCK_STREAM)):
            median = round_trips(ports, kind)
            figures.append(Figure(f"{label} round trip, 64 registers", median[OURS], "us", command=COMMAND))
            figures.append(Figure(f"{label} round trip, {PEER}", median[PEER], "us", command=COMMAND))
            ratio = median[OURS] / median[PEER]
            figures.append(bounded(f"{label} round trip / {PEER}", ratio, "", "<= 1", COMMAND))
        figures.append(Figure("UDP requests/s, 8 clients", rate_udp(ports[OURS]), "1/s", command=COMMAND))
        answers, rate = pipelined(ports[OURS], PIPELINED)
        figures.append(Figure("TCP requests/s, pipelined", rate, "1/s", command=COMMAND))
        figures.append(bounded("TCP pipelined unanswered", PIPELINED - answers, "", "<= 0", COMMAND))
        unanswered = 5 - pipelined(ports[PEER], 5)[0]
        figures.append(Figure(f"of 5 pipelined unanswered, {PEER}", unanswered, "", command=COMMAND))
        figures.append(bounded("UDP burst of 8, lost or repeated", lost_in_bursts(ports[OURS]), "%", "<= 0", COMMAND))
        figures.append(Figure(f"UDP burst of 8, {PEER}", lost_in_bursts(ports[PEER]), "%", command=COMMAND))
    for name, function in (("block", registers.encode_block), ("datagram", registers.encode_datagram)):
        figures.append(Figure(f"encode {name}", cost_us(function), "us", command=COMMAND))
    return figures


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    if parser.parse_args().serve:
        asyncio.run(serve())
    else:
        print(table(run()))
