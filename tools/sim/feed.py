"""From a scene to the daemon's other inputs: odometry datagrams, and the ground truth for whoever compares."""

from __future__ import annotations

import asyncio
import json
import math
import socket
from collections.abc import Callable
from pathlib import Path
from typing import IO, Final

import numpy as np

from hal.net.input_codec import ODOMETRY_MAGIC, SHARED_CLOCK, InputDatagram, encode
from tools.sim.scene import Scene

TRUTH_PERIOD_S: Final = 0.01
Send = Callable[[bytes], None]


async def feed_odometry(scene: Scene, send: Send, session: int = 1) -> None:
    """Send each wheel odometry reading when it is due, in the loop's time; returns when the scene has no more."""
    loop = asyncio.get_running_loop()
    t, seq = loop.time(), 0
    while (reading := scene.odometry_after(t)) is not None:
        t, pose = reading
        await asyncio.sleep(t - loop.time())
        values = (float(pose[0]), float(pose[1]), float(pose[2]))
        send(encode(InputDatagram(ODOMETRY_MAGIC, session, seq, SHARED_CLOCK, t, values)))
        seq = (seq + 1) % (1 << 32)


async def feed_truth(scene: Scene, tell: Callable[[float, tuple[float, float, float]], None]) -> None:
    """Tell the true pose a hundred times a second: ``t_mono`` and (x, y, yaw) in the scene's frame."""
    loop = asyncio.get_running_loop()
    while True:
        t = loop.time()
        x, y, yaw = scene.truth(np.array([t]))[0]
        tell(t, (float(x), float(y), math.remainder(float(yaw), math.tau)))
        await asyncio.sleep(TRUTH_PERIOD_S)


class UdpSender:
    """Sends datagrams to one ``udp://host:port`` and minds nothing when nobody listens there."""

    def __init__(self, target: str) -> None:
        address = udp_target(target)
        family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._address = address
        self.unsent = 0

    def send(self, data: bytes) -> None:
        """Send, or count that it could not be sent (nobody listens, buffer full)."""
        try:
            self._socket.sendto(data, self._address)
        except OSError:
            self.unsent += 1

    def tell(self, t_mono: float, pose: tuple[float, float, float]) -> None:
        """A true pose as one JSON object."""
        x, y, yaw = pose
        self.send(json.dumps({"t_mono": t_mono, "x": x, "y": y, "yaw": yaw}).encode())

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class TumWriter:
    """Writes true poses as a trajectory file in TUM format (t_mono x y z qx qy qz qw)."""

    def __init__(self, path: Path) -> None:
        self._file: IO[str] = path.open("w", encoding="ascii")

    def tell(self, t_mono: float, pose: tuple[float, float, float]) -> None:
        """One line."""
        x, y, yaw = pose
        self._file.write(f"{t_mono:.6f} {x:.6f} {y:.6f} 0 0 0 {math.sin(yaw / 2):.9f} {math.cos(yaw / 2):.9f}\n")

    def close(self) -> None:
        """Finish the file."""
        self._file.close()


def udp_target(text: str) -> tuple[str, int]:
    """Host and port of ``udp://host:port``; raises ValueError that says what was expected."""
    host, colon, port = text.removeprefix("udp://").rpartition(":")
    if not text.startswith("udp://") or not colon or not port.isdigit() or not 0 < int(port) < 65536:
        raise ValueError(f"{text!r} is no datagram target; expected udp://HOST:PORT, e.g. udp://127.0.0.1:5601")
    return host.strip("[]"), int(port)
