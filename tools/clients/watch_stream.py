"""Watch what a lumiloop on this computer says on its local stream. Needs `msgpack` or `msgspec`, nothing of lumiloop.

    python watch_stream.py SOCKET [TOPIC...]    topics: pose, lights, scan, state, loop, faults, statistics, raw, map

Written from docs/stream.md alone, so it can be copied into any program.
"""

from __future__ import annotations

import socket
import struct
import sys
from collections.abc import Iterator
from typing import Any

try:
    from msgspec.msgpack import decode, encode
except ImportError:
    from msgpack import packb as encode  # type: ignore[import-not-found, no-redef]  # either will do
    from msgpack import unpackb as decode  # type: ignore[no-redef]


def frames(sock: socket.socket) -> Iterator[dict[str, Any]]:
    """Every frame until the daemon closes."""
    file = sock.makefile("rb")
    while len(head := file.read(4)) == 4:
        body = file.read(struct.unpack("<I", head)[0])
        yield decode(body)


def ask(sock: socket.socket, topics: list[str]) -> None:
    """Say what is wanted; may be said again at any time."""
    body = encode({"want": topics})
    sock.sendall(struct.pack("<I", len(body)) + body)


def line_of(topic: str, data: dict[str, Any]) -> str:
    """One line for a person."""
    if topic == "pose":
        pose = data["pose"]
        where = "no pose" if pose is None else f"x {pose[0]:.3f} m, y {pose[1]:.3f} m, yaw {pose[2]:.4f} rad"
        return f"{data['t_mono']:.3f} {data['state_name']:10s} {where}"
    if topic == "scan":
        ranges = struct.unpack(f"<{len(data['ranges']) // 4}f", data["ranges"])
        seen = [r for r in ranges if r == r]
        nearest = min(seen, default=0.0)
        return f"{data['t_mono']:.3f} scan {data['seq']}: {len(seen)} of {len(ranges)} beams, nearest {nearest:.2f} m"
    if topic == "map":
        return f"map {data['map_id']:08x} version {data['version']}: {len(data['tiles'])} tiles" + " ..." * data["more"]
    if topic == "state":
        remedy = f" ({data['remedy']})" if data["remedy"] else ""
        return f"{data['t_mono']:.3f} {data['state_name']}: {data['meaning']}{remedy}"
    if topic == "faults":
        said = [f"{one['fault']} {one['meaning']} ({one['remedy']})" for one in data["present"]]
        return "faults: " + ("; ".join(said) or "none")
    return f"{topic}: {data}"


def told(frame: dict[str, Any]) -> str:
    """One line for a person, of any frame."""
    if frame["topic"] == "hello":
        return f"this is lumiloop {frame['name']!r}, process {frame['pid']}; topics: {', '.join(frame['topics'])}"
    if frame["topic"] == "error":
        return f"refused: {frame['text']}"
    return line_of(frame["topic"], frame["data"])


def main() -> int:
    """Print frames until interrupted."""
    if len(sys.argv) < 2:
        print(__doc__)
        return 2
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
        sock.connect(sys.argv[1])
        ask(sock, sys.argv[2:] or ["pose", "state", "loop"])
        for frame in frames(sock):
            print(told(frame), flush=True)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (FileNotFoundError, ConnectionRefusedError):
        sys.exit(f"{sys.argv[1]}: nobody listens there; the start of the daemon's log names its stream")
    except KeyboardInterrupt:
        sys.exit(130)
