"""``python -m tests.fuzz.together [SECONDS]``: damaged bytes at every door of the real processes at once.

The daemon with a simulated robot, its taps, and a fleet of one run as they do on a robot. Meanwhile damage comes by the
lidar's line, the Modbus ports and line, the datagrams, the local sockets, the I2C server, the taps' ports, and the
messages of other robots; damaged recordings are replayed. Prints one JSON object: what was sent, how many tracebacks
the logs hold, growth of each process's memory after a third of the time, and answers to an honest client. Ends with 1
where there is a traceback, a process has ended, or one has grown by more than :data:`GROWN_MB`.
"""

import base64
import contextlib
import importlib
import json
import os
import random
import re
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import tty
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

import msgspec
import zenoh

from daemon.config.paths import commands_beside, stream_path
from daemon.publish.modbus.client import NoAnswer, Reader
from taps.fleet import messages
from taps.zenoh_session import session_config
from tests.fuzz.mutator import damaged
from tools.demo.folder import SURVEY, Wiring
from tools.demo.run import BUS, DemoError, Patience, free_port, running, wait_for_pose, wait_for_simulator
from tools.soak.watched import process

SECONDS: Final = 60.0
SETTLED: Final = 1.0 / 3.0
SPOILT: Final = 0.02
"""Share of the lidar's pieces that are damaged on the way: scans come between."""
GROWN_MB: Final = 5.0
REPLAY_S: Final = 120.0
"""Time limit in s of the replay of a damaged file."""
PAUSE_S: Final = 0.005
"""After each input of an attacker: some hundred a second, from each."""
ORDERS: Final = [
    json.dumps({"command": name, **more}).encode() + b"\n"
    for name, more in (
        ("save_map", {}),
        ("relocalise", {}),
        ("set_pose", {"x_m": 1.0, "y_m": 1.0, "yaw_rad": 0.0}),
        ("switch_map", {"map_id": 7}),
        ("pause", {}),
        ("resume", {}),
    )
]
PAGES: Final = [
    f"{verb} {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: {length}\r\n{more}\r\n{body}".encode()
    for verb, path, length, more, body in (
        ("GET", "/", 0, "", ""),
        ("GET", "/metrics", 0, "Accept-Encoding: gzip\r\n", ""),
        ("GET", "/agv-position", 0, "", ""),
        ("POST", "/order", 2, "Content-Type: application/json\r\nAuthorization: Bearer x\r\n", "{}"),
    )
]
UPGRADE: Final = (
    b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Protocol: foxglove.sdk.v1\r\nSec-WebSocket-Key: " + base64.b64encode(bytes(16)) + b"\r\n\r\n"
)
FRAMES: Final = [
    UPGRADE,
    *(UPGRADE + bytes([first, 0x80 | len(text)]) + bytes(4) + text for first in (0x81, 0x82, 0x88, 0x89) for text in (
        b'{"op":"subscribe","subscriptions":[{"id":1,"channelId":1}]}', b'{"op":"getParameters"}', b"\x01\0\0\0\0"
    )),
]  # fmt: skip
Send = Callable[[bytes], object]


@dataclass
class Attack:
    """What was sent, by door, until ``over`` is set; ``broken``: defects of the attackers themselves."""

    over: threading.Event = field(default_factory=threading.Event)
    sent: Counter[str] = field(default_factory=Counter)
    broken: list[str] = field(default_factory=list)
    _threads: list[threading.Thread] = field(default_factory=list)

    def begin(self, door: str, send: Send, kept: list[bytes], mend: Callable[[bytes], bytes] = bytes) -> None:
        """Damage by one door, from a thread."""

        def go() -> None:
            chance = random.Random(door)
            while not self.over.wait(PAUSE_S):
                data = damaged(chance.choice(kept), kept, chance)
                try:
                    send(mend(data) if chance.random() < 0.5 else data)
                except OSError:  # it hangs up, as it may
                    self.sent[f"{door} refused"] += 1
                except Exception as error:  # noqa: BLE001  an attacker's thread must not end unseen; it is shown with the result
                    self.broken.append(f"{door}: {error!r}")
                    return
                self.sent[door] += 1

        self.go(go)

    def go(self, work: Callable[[], None]) -> None:
        """Work in a thread of its own, until it sees that all is over; an error of it is a defect."""

        def guarded() -> None:
            try:
                work()
            except Exception as error:  # noqa: BLE001  an attacker's thread must not end unseen; it is shown with the result
                self.broken.append(repr(error)[:500])

        thread = threading.Thread(target=guarded, daemon=True)
        self._threads.append(thread)
        thread.start()

    def end(self) -> None:
        """Wait for all threads."""
        self.over.set()
        for thread in self._threads:
            thread.join(REPLAY_S)
        self.broken += [f"{thread.name} does not end" for thread in self._threads if thread.is_alive()]


def to_stream(family: socket.AddressFamily, address: Any) -> Send:
    """One connection an input; TCP from an address of its own, which has its share of connections."""

    def send(data: bytes) -> None:
        with socket.socket(family, socket.SOCK_STREAM) as sock:
            sock.settimeout(0.1)
            if family == socket.AF_INET:
                sock.bind(("127.0.0.2", 0))
            sock.connect(address)
            sock.sendall(data)
            with contextlib.suppress(TimeoutError):
                sock.recv(4096)

    return send


def to_datagrams(port: int) -> Send:
    """A datagram an input."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    return lambda data: sock.sendto(data[:1400], ("127.0.0.1", port))


def line(path: Path) -> int:
    """A serial line at a path; its other end."""
    master, slave = os.openpty()
    tty.setraw(slave)
    path.symlink_to(os.ttyname(slave))
    os.set_blocking(master, False)
    return master


def to_line(master: int) -> Send:
    """Bytes on a serial line, whose answers are thrown away."""

    def send(data: bytes) -> None:
        os.write(master, data[:600])  # BlockingIOError: nobody reads the line, which counts as refused
        with contextlib.suppress(BlockingIOError):
            os.read(master, 4096)

    return send


def relay(sensor: Path, master: int, attack: Attack) -> None:
    """Join a line with the sensor's; what the sensor sends is damaged now and then."""
    chance, device = random.Random("lidar"), os.open(sensor, os.O_RDWR | os.O_NOCTTY)
    tty.setraw(device)
    while not attack.over.is_set():
        for ready in select.select([device, master], [], [], 0.2)[0]:
            with contextlib.suppress(BlockingIOError):
                data = os.read(ready, 4096)
                if ready == device and chance.random() < SPOILT:
                    data = damaged(data, [data], chance)
                    attack.sent["lidar"] += 1
                os.write(master if ready == device else device, data)


def to_fleet(session: zenoh.Session) -> Send:
    """Messages of a robot that is none, and in the place of the true one."""
    chance = random.Random("keys")

    def send(data: bytes) -> None:
        key = messages.key(chance.choice(("ghost", "together")), chance.choice(messages.TOPICS))
        session.put(key, data, attachment=chance.choice((None, data[:300])))

    return send


def replays(kept: list[bytes], folder: Path, attack: Attack) -> None:
    """Damaged recordings and logs, by the installed command; what it prints goes to a log."""
    chance, mend = random.Random("replay"), target("log").mend
    work = folder / "replay"  # what is replayed is no log of a process
    work.mkdir()
    with (folder / "replay.log").open("wb") as log:
        while not attack.over.wait(1.0):
            whole = chance.choice(kept)
            file = work / ("a.lumirec" if whole.startswith(b"LUMIREC") else "a.log")
            file.write_bytes(mend(damaged(whole, kept, chance)))
            words = [sys.executable, "-m", "daemon", "replay", str(file), "--out", str(work / "out")]
            subprocess.run(words, stdout=log, stderr=log, timeout=REPLAY_S, check=False)
            attack.sent["replay"] += 1


def target(name: str) -> Any:
    """A module of `tests.fuzz.targets`."""
    return importlib.import_module(f"tests.fuzz.targets.{name}")


@contextlib.contextmanager
def robot(folder: Path) -> Iterator[tuple[Attack, Reader, dict[str, int]]]:
    """All processes, the attack on them, a client of the daemon, and the process numbers by name."""
    ports = {name: free_port() for name in ("modbus", "odometry", "view", "metrics", "foxglove", "router", "pose")}
    attack, router = Attack(), f"127.0.0.1:{ports['router']}"
    wiring = Wiring("together", folder / "lidar", ports["odometry"], ports["modbus"], f"unix:{folder / BUS}")
    config = folder / "robot.toml"
    more = f'[pose]\nreceivers = ["*:{ports["pose"]}"]\n\n[modbus]\nserial = "{folder / "rtu"}"\n'
    config.write_text(wiring.config().replace("[modbus]\n", more))
    rtu, lidar = line(folder / "rtu"), line(folder / "lidar")
    space = dict(os.environ, XDG_STATE_HOME=str(folder / "state"), XDG_RUNTIME_DIR=str(folder / "run"))
    os.environ["XDG_RUNTIME_DIR"] = space["XDG_RUNTIME_DIR"]
    program = [sys.executable, "-m"]
    sim: list[object] = [
        "tools.sim",
        "--building",
        "paper_room",
        "--hold",
        "--pty",
        folder / "sensor",
        "--control",
        folder / "c",
    ]
    sim += ["--odometry", f"udp://127.0.0.1:{ports['odometry']}", "--truth", f"udp://127.0.0.1:{free_port()}"]
    sim += ["--light", f"unix:{folder / BUS}", "--survey", folder / SURVEY]
    taps: dict[str, list[object]] = {
        "router": ["fleet", "router", "--listen", router],
        "view": ["view", "--port", ports["view"], "--config", config],
        "metrics": ["metrics", "--listen", f"127.0.0.1:{ports['metrics']}", "--config", config],
        "foxglove": ["foxglove", "--listen", f"127.0.0.1:{ports['foxglove']}", "--config", config],
        "join": ["fleet", "join", "--router", router, "--config", config],
        "watch": ["fleet", "--watch", "--router", router],
    }
    with contextlib.ExitStack() as stack:

        def start(name: str, *words: object, **more: Any) -> subprocess.Popen[str]:
            command = [*program, *map(str, words)]
            child = running(command, folder / f"{name}.log", env=space, **{"stdout": subprocess.DEVNULL, **more})
            return stack.enter_context(child)

        patience = Patience(folder)
        simulator = start("simulator", *sim, stdout=subprocess.PIPE)
        wait_for_simulator(simulator, patience)
        attack.go(partial(relay, folder / "sensor", lidar, attack))
        recording = ["--record", folder / "record", "--last", "1", "--set", f"map.folder={folder / 'maps'}"]
        daemon = start("daemon", "daemon", "run", "--config", config, *recording)
        reader = stack.enter_context(Reader("127.0.0.1", ports["modbus"]))
        wait_for_pose(daemon, reader, patience)
        children = {"daemon": daemon, "simulator": simulator}
        children |= {name: start(name, "daemon", *words) for name, words in taps.items()}
        simulator.send_signal(signal.SIGUSR1)
        time.sleep(5.0)
        fleet = stack.enter_context(zenoh.open(session_config("client", router)))
        stack.callback(attack.end)
        attack_all(attack, folder, ports, to_line(rtu), to_fleet(fleet))
        yield attack, reader, {name: child.pid for name, child in children.items()}
        ended = [name for name, child in children.items() if child.poll() is not None]
        attack.broken += [f"{name} ended" for name in ended]


def attack_all(attack: Attack, folder: Path, ports: dict[str, int], rtu: Send, fleet: Send) -> None:
    """Damage at every door, and damaged recordings."""
    stream = stream_path("together")
    modbus, asked, udp, bus = target("modbus"), target("stream"), target("udp"), target("bus")
    inet, unix = socket.AF_INET, socket.AF_UNIX
    attack.begin("modbus tcp", to_stream(inet, ("127.0.0.1", ports["modbus"])), modbus.seeds(), modbus.mend)
    attack.begin("modbus udp", to_datagrams(ports["modbus"]), modbus.seeds(), modbus.mend)
    attack.begin("modbus line", rtu, modbus.seeds())
    attack.begin("odometry", to_datagrams(ports["odometry"]), udp.seeds(), udp.mend)
    attack.begin("subscriptions", to_datagrams(ports["pose"]), udp.seeds(), udp.mend)
    attack.begin("stream", to_stream(unix, str(stream)), asked.seeds(), asked.mend)
    attack.begin("commands", to_stream(unix, str(commands_beside(stream))), ORDERS)
    attack.begin("i2c server", to_stream(unix, str(folder / BUS)), bus.seeds(), bus.mend)
    attack.begin("view", to_stream(inet, ("127.0.0.1", ports["view"])), PAGES)
    attack.begin("metrics", to_stream(inet, ("127.0.0.1", ports["metrics"])), PAGES)
    attack.begin("foxglove", to_stream(inet, ("127.0.0.1", ports["foxglove"])), FRAMES)
    attack.begin("fleet", fleet, fleet_seeds())
    kept = target("log").seeds()
    attack.go(partial(replays, kept, folder, attack))


def fleet_seeds() -> list[bytes]:
    """Messages as robots send them."""
    told = [
        messages.PoseMessage(
            seq=1, t_utc=1.7e9, agvPosition={"x": 1.0, "y": 2.0, "theta": 0.1}, velocity=(0.1, 0.0, 0.0)
        ),
        messages.StateMessage(t_utc=1.7e9, state=3, state_name="TRACKING", held={"map": messages.Held(1, "0" * 64)}),
        messages.LoopMessage(t_utc=1.7e9, counter=1, at_new=(1.0, 2.0, 0.0)),
        messages.MapHead(t_utc=1.7e9, map_id=1, resolution=0.1, columns=10, rows=10, origin=(0.0, 0.0)),
    ]
    return [msgspec.json.encode(one) for one in told]


def main(seconds: float) -> dict[str, Any]:
    """Attack for so long; what came of it."""
    with tempfile.TemporaryDirectory(prefix="lumiloop-together-") as name:
        folder, memory, answers = Path(name), dict[str, list[float]](), Counter[str]()
        with robot(folder) as (attack, reader, numbers):
            begun, longest = time.monotonic(), 0.0
            while (since := time.monotonic() - begun) < seconds:
                time.sleep(0.5)
                asked = time.monotonic()
                with contextlib.suppress(NoAnswer):
                    answers[str(reader.read()["state"])] += 1
                longest = max(longest, time.monotonic() - asked)
                if since > SETTLED * seconds:
                    for one, pid in numbers.items():
                        memory.setdefault(one, []).append(process(pid)[0])
        logs = {log.stem: log.read_text(errors="replace") for log in folder.glob("*.log")}
    third = {one: max(1, len(found) // 3) for one, found in memory.items()}
    growth = {
        one: round(sum(found[-third[one] :]) / third[one] - sum(found[: third[one]]) / third[one], 1)
        for one, found in memory.items()
    }
    attack.broken += [f"{one} grew by {more} MB" for one, more in growth.items() if more > GROWN_MB]
    return {
        "sent": dict(sorted(attack.sent.items())),
        "broken": attack.broken,
        "tracebacks": {one: text.count("Traceback") for one, text in logs.items() if "Traceback" in text},
        "lines": {one: text.count("\n") for one, text in logs.items()},
        "memory_mb": {one: round(max(found[-third[one] :]), 1) for one, found in memory.items()},
        "growth_mb": growth,
        "answers": dict(answers),
        "longest_answer_s": round(longest, 3),
        "first": {one: first for one, text in logs.items() if (first := traceback_in(text))},
    }


def traceback_in(text: str) -> str:
    """The first traceback of a log."""
    found = re.search(r"^.*\n?Traceback(?:.|\n){0,1500}", text, re.MULTILINE)
    return found[0] if found else ""


if __name__ == "__main__":
    try:
        result = main(float(sys.argv[1]) if len(sys.argv) > 1 else SECONDS)
    except DemoError as error:
        raise SystemExit(str(error)) from error
    sys.stdout.write(json.dumps(result, indent=1) + "\n")
    raise SystemExit(1 if result["tracebacks"] or result["broken"] else 0)
