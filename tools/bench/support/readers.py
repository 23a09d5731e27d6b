"""``python -m tools.bench.support.readers PORT``: eight Modbus clients over UDP, 100 requests a second each.

They run until SIGTERM.

Prints when it ends how many were asked and answered.
"""

import asyncio
import signal
import struct
import sys
from typing import Final

CLIENTS: Final = 8
RATE_HZ: Final = 100.0
REGISTERS: Final = 64
PATIENCE_S: Final = 1.0


class Client(asyncio.DatagramProtocol):
    """One client; counts answers."""

    def __init__(self) -> None:
        self.asked = self.answered = 0

    def datagram_received(self, data: bytes, addr: object) -> None:
        """An answer."""
        self.answered += len(data) == 9 + 2 * REGISTERS


async def go(port: int) -> tuple[int, int]:
    """Ask until told to end."""
    loop, stop = asyncio.get_running_loop(), asyncio.Event()
    loop.add_signal_handler(signal.SIGTERM, stop.set)
    to = ("127.0.0.1", port)
    clients = [await loop.create_datagram_endpoint(Client, remote_addr=to) for _ in range(CLIENTS)]
    begun, turn = loop.time(), 0
    while not stop.is_set():
        for transport, client in clients:
            if stop.is_set():
                break
            client.asked += 1
            transport.sendto(struct.pack(">HHHBBHH", client.asked & 0xFFFF, 0, 6, 1, 4, 0, REGISTERS))
            await asyncio.sleep(1.0 / RATE_HZ / CLIENTS / 2)
        turn += 1
        now = loop.time()
        if now - begun > turn / RATE_HZ + 0.5:
            begun, turn = now, 0  # it was stopped for a while
        await asyncio.sleep(max(0.0, begun + turn / RATE_HZ - now))
    asked, until = sum(client.asked for _, client in clients), loop.time() + PATIENCE_S
    while sum(client.answered for _, client in clients) < asked and loop.time() < until:  # noqa: ASYNC110
        await asyncio.sleep(0.01)
    for transport, _ in clients:
        transport.close()
    return asked, sum(client.answered for _, client in clients)


def main() -> None:
    """What the benchmark starts."""
    asked, answered = asyncio.run(go(int(sys.argv[1])))
    print(asked, answered)


if __name__ == "__main__":
    main()
