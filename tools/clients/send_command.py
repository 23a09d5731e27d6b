"""Give an order over Modbus UDP and wait for its end, with nothing but the standard library.

    python send_command.py save_map [HOST [PORT]]                 any of the commands, in either case
    python send_command.py set_pose X Y YAW [HOST [PORT]]         m, m, rad
    python send_command.py switch_map 1a2b3c4d [HOST [PORT]]      as `lumiloop map info` names it

Needs `modbus.write = true`. Written from docs/modbus.md alone: it shares no code with the daemon.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import sys
import time

COMMANDS = ("set_pose", "reset", "save_map", "relocalise", "pause", "resume", "dump_recorder", "switch_map")
RESULTS = ("none", "running", "done", "refused", "unknown")
COMMAND, ANSWER, MAP_ID = 1000, 1008, 1010


class Commander:
    """Writes the command block and reads its answer."""

    def __init__(self, host: str = "127.0.0.1", port: int = 1502) -> None:
        family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        self._sock = socket.socket(family, kind)
        self._sock.settimeout(0.5)
        self._sock.connect(address)
        self._transaction, self.close = 0, self._sock.close

    def order(self, name: str, pose: tuple[float, float, float] = (0.0, 0.0, 0.0), map_id: int = 0) -> int:
        """Give an order; returns its number. Raises ValueError for numbers that its registers cannot hold."""
        try:
            place = struct.pack(
                ">iii", *(round(scale * value) for scale, value in zip((1e4, 1e4, 1e6), pose, strict=True))
            )
            switch = struct.pack(">BHHBI", 16, MAP_ID, 2, 4, map_id)
        except (struct.error, OverflowError, ValueError):  # too large, infinite, no number
            raise ValueError("out of range: metres to 214748, radians to 2147, a map's ID of 8 digits") from None
        (before,) = struct.unpack(">H", self._ask(struct.pack(">BHH", 3, COMMAND, 1))[2:])
        number = before % 0xFFFF + 1
        if name == "switch_map":
            self._ask(switch)
        self._ask(struct.pack(">BHHBHH", 16, COMMAND, 8, 16, number, 1 + COMMANDS.index(name)) + place)
        return number

    def wait(self, number: int, seconds: float = 30.0) -> str:
        """How an order ended; "running" where it has not by then."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            acknowledged, result = struct.unpack(">HH", self._ask(struct.pack(">BHH", 3, ANSWER, 2))[2:])
            if acknowledged == number and result != 1:
                return RESULTS[result] if result < len(RESULTS) else str(result)
            time.sleep(0.05)
        return "running"

    def _ask(self, body: bytes) -> bytes:
        """An answer's body. A write is repeated when its answer is lost: the same number does nothing twice."""
        self._transaction = (self._transaction + 1) & 0xFFFF
        frame = struct.pack(">HHHB", self._transaction, 0, len(body) + 1, 1) + body
        for _ in range(5):
            self._sock.send(frame)
            with contextlib.suppress(TimeoutError):
                while True:
                    answer = self._sock.recv(512)
                    if answer[:2] == frame[:2]:
                        if answer[7] & 0x80:
                            hint = " (set modbus.write = true)" if answer[8] in (1, 2) else ""
                            raise ValueError(f"Modbus exception {answer[8]}{hint}")
                        return answer[7:]
        raise TimeoutError("no answer")


def main(words: list[str]) -> str:
    """Run the command line; returns how the order ended. Raises ValueError or OSError with what is wrong."""
    try:
        name = COMMANDS[COMMANDS.index(words[0].lower())]
        count = {"set_pose": 3, "switch_map": 1}.get(name, 0)
        given, where = words[1 : 1 + count], words[1 + count :]
        place = (float(given[0]), float(given[1]), float(given[2])) if count == 3 else (0.0, 0.0, 0.0)
        map_id = int(given[0], 16) if count == 1 else 0
        host, port = where[0] if where else "127.0.0.1", int(" ".join(where[1:]) or 1502)
    except (IndexError, ValueError):
        raise ValueError(f"{__doc__}\nCommands: {', '.join(COMMANDS)}") from None
    with contextlib.closing(Commander(host, port)) as commander:
        return commander.wait(commander.order(name, place, map_id))


if __name__ == "__main__":
    try:
        result = main(sys.argv[1:])
    except ValueError as error:
        sys.exit(str(error))
    except OSError as error:
        sys.exit(f"{error}: is lumiloop running, and do `bind` and `allow` admit this machine?")
    print("refused: the daemon's log says why" if result == "refused" else result)
    sys.exit(result != "done")
