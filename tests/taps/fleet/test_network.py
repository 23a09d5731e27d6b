"""Five robots and a router, each in a network of its own on this computer: a lossy line, a partition, a dead router.

The robots' streams are served by this process; what joins, shares, fetches and looks are the commands themselves.
"""

import asyncio
import json
import os
import queue
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import pytest

pytest.importorskip("zenoh", reason="pip install 'lumiloop[zenoh]'")

from daemon.publish.modbus.holding import Outcome, Request
from tests.daemon.publish.network import publishing
from tests.daemon.support import map_maker
from tests.daemon.support.map_maker import Shape
from tests.taps.serving import served
from tests.taps.test_docs import commands
from tools.sim.ports import free_port

ROOT = Path(__file__).parents[3]
ROBOTS: Final = 5
HUB, VIEWER = "hub", "viewer"
ROUTER: Final = "10.77.0.1:7447"
LOSSY, CUT = "agv2", "agv3"

pytestmark = [pytest.mark.system, pytest.mark.timeout(180)]


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


class Network:
    """Namespaces on one bridge, and programs in them."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._folder, self._stack, self._tag = folder, stack, f"ll{os.getpid()}"
        self._add(HUB)
        ip("-n", self.space(HUB), "link", "add", "bridge", "type", "bridge")
        ip("-n", self.space(HUB), "addr", "add", "10.77.0.1/24", "dev", "bridge")
        ip("-n", self.space(HUB), "link", "set", "bridge", "up")
        for number, name in enumerate([VIEWER, *names()], 2):
            self._add(name)
            peer = ("type", "veth", "peer", "name", "eth0", "netns", self.space(name))
            ip("-n", self.space(HUB), "link", "add", name, *peer)
            ip("-n", self.space(HUB), "link", "set", name, "master", "bridge", "up")
            ip("-n", self.space(name), "addr", "add", f"10.77.0.{number}/24", "dev", "eth0")
            ip("-n", self.space(name), "link", "set", "eth0", "up")

    def space(self, name: str) -> str:
        return f"{self._tag}-{name}"

    def _add(self, name: str) -> None:
        ip("netns", "add", self.space(name))
        self._stack.callback(ip, "netns", "del", self.space(name))
        ip("-n", self.space(name), "link", "set", "lo", "up")

    def link(self, name: str, state: str) -> None:
        ip("-n", self.space(HUB), "link", "set", name, state)

    def narrow(self, name: str) -> None:
        """A line to the robot with room for three packets: what comes faster is lost."""
        shape = ["root", "tbf", "rate", "20mbit", "burst", "3100", "limit", "4600"]
        command = ["tc", "-n", self.space(HUB), "qdisc", "add", "dev", name, *shape]
        subprocess.run(command, check=True, capture_output=True)

    def lost(self, name: str) -> int:
        """Packets that the narrow line has lost."""
        command = ["tc", "-n", self.space(HUB), "-j", "-s", "qdisc", "show", "dev", name]
        return int(json.loads(subprocess.run(command, check=True, capture_output=True).stdout)[0]["drops"])

    @contextmanager
    def program(self, name: str, *words: str) -> Iterator[Path]:
        """A lumiloop that runs as long as the context; what it says, in a file."""
        log = self._folder / f"{name}-{words[1] if len(words) > 1 else 'show'}.log"
        with log.open("w") as out:
            running = subprocess.Popen(self._command(name, *words), cwd=ROOT, stdout=out, stderr=subprocess.STDOUT)
        try:
            yield log
            assert running.poll() is None, log.read_text()
        finally:
            running.terminate()
            running.wait(10.0)

    def run(self, name: str, state: Path, *words: str) -> str:
        """A lumiloop that ends by itself; what it says."""
        environment = {**os.environ, "XDG_STATE_HOME": str(state)}
        done = subprocess.run(
            self._command(name, *words), cwd=ROOT, env=environment, capture_output=True, text=True, timeout=60.0
        )
        assert done.returncode == 0, done.stderr
        return done.stderr

    def _command(self, name: str, *words: str) -> list[str]:
        return ["ip", "netns", "exec", self.space(name), sys.executable, "-m", "daemon", *words]


def names() -> list[str]:
    return [f"agv{number}" for number in range(1, ROBOTS + 1)]


class View:
    """What `lumiloop fleet --watch --json` says last."""

    def __init__(self, log: Path) -> None:
        self._log = log

    def told(self) -> dict[str, Any]:
        lines = [line for line in self._log.read_text().splitlines() if line.startswith("{")]
        found: dict[str, Any] = json.loads(lines[-1]) if lines else {"router": False, "robots": {}, "problems": []}
        return found

    def fresh(self) -> set[str]:
        """Robots that speak, and have told something in the last two seconds."""
        return {name for name, one in self.told()["robots"].items() if one["alive"] and one["age_s"] < 2.0}

    def until(self, what: Callable[[], object], seconds: float) -> None:
        """Wait until something is true."""
        begun = time.monotonic()
        while not what():
            assert time.monotonic() < begun + seconds, self.told()
            time.sleep(0.1)


@contextmanager
def obedient() -> Iterator[int]:
    """Port of a daemon's Modbus, in a thread of its own, that does what it is asked."""
    ready: queue.SimpleQueue[tuple[int, asyncio.AbstractEventLoop, asyncio.Event]] = queue.SimpleQueue()

    async def serve() -> None:
        loop, end = asyncio.get_running_loop(), asyncio.Event()

        def obey(asked: Request) -> None:
            loop.call_soon(modbus.acknowledge, asked.number, Outcome.DONE)

        async with publishing(write=True, on_command=obey) as modbus:
            ready.put((modbus.port, loop, end))
            await end.wait()

    thread = threading.Thread(target=lambda: asyncio.run(serve()))
    thread.start()
    port, loop, end = ready.get(timeout=10.0)
    try:
        yield port
    finally:
        loop.call_soon_threadsafe(end.set)
        thread.join()


def test_the_commands_of_the_documents(tmp_path: Path) -> None:
    """In their order, against a router of their own: what ends by itself ends well, the rest runs until it is told."""
    address, lasting = f"127.0.0.1:{free_port()}", []
    shutil.copy(ROOT / "systemd/lights/room-of-16.toml", tmp_path / "lights.toml")
    (tmp_path / "hall.lumimap").write_bytes(map_maker.content(Shape(map_id=0x77)))
    (tmp_path / "run" / "lumiloop").mkdir(parents=True)
    environment = {"XDG_STATE_HOME": str(tmp_path), "XDG_RUNTIME_DIR": str(tmp_path / "run"), "PYTHONPATH": str(ROOT)}
    with ExitStack() as stack:
        modbus = f"[modbus]\nport = {stack.enter_context(obedient())}\nwrite = true\n"
        (tmp_path / "lumiloop.toml").write_text(f'name = "agv1"\n{modbus}[lights]\nsurvey = "own.toml"\n')
        for name in ("agv1", "lumiloop"):
            stack.enter_context(served(tmp_path / "run" / "lumiloop" / f"{name}.stream"))
        for words in commands(ROOT / "docs" / "fleet.md"):
            told = [address if word.endswith(":7447") else word for word in words]
            told += [] if address in told else ["--router", address]
            command, given = [sys.executable, "-m", "daemon", *told], {**os.environ, **environment}
            if {"router", "ros2", "join", "share", "--watch", "--follow"} & set(words):
                running = subprocess.Popen(command, cwd=tmp_path, env=given, stdout=subprocess.DEVNULL)
                stack.callback(running.wait)
                stack.callback(running.kill)
                lasting.append(running)
                time.sleep(3.0)
            else:
                subprocess.run(command, cwd=tmp_path, env=given, check=True, timeout=60.0, stdout=subprocess.DEVNULL)
        assert [one.poll() for one in lasting] == [None] * 6
        for one in reversed(lasting):
            one.terminate()
            assert one.wait(10.0) == 0, one.args
    assert (tmp_path / "fleet.png").exists()
    assert (tmp_path / "own.toml").exists()
    assert len(list((tmp_path / "lumiloop" / "maps").glob("*.lumimap"))) == 1


@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("ip") is None, reason="needs root and iproute2")
def test_five_robots_a_lossy_line_a_partition_and_a_dead_router(tmp_path: Path) -> None:
    shared = tmp_path / "hall.lumimap"
    shared.write_bytes(map_maker.content(Shape(submaps=60, frames=12, beams=1081, map_id=0x77)))
    router = ("fleet", "router", "--listen", ROUTER)
    with ExitStack() as stack:
        network = Network(tmp_path, stack)
        network.narrow(LOSSY)
        hub = ExitStack()
        stack.callback(hub.close)
        hub.enter_context(network.program(HUB, *router))
        for number, name in enumerate(names()):
            stream = tmp_path / f"{name}.stream"
            stack.enter_context(served(stream, place=(float(number), 1.0, 0.0)))
            words = ("fleet", "join", "--router", ROUTER, "--stream", str(stream), "--set", f"name={name}")
            stack.enter_context(network.program(name, *words))
        log = stack.enter_context(network.program(VIEWER, "fleet", "--watch", "--json", "--router", ROUTER))
        view = View(log)
        everybody = set(names())
        view.until(lambda: view.fresh() == everybody, 30.0)
        for number, name in enumerate(names()):
            assert view.told()["robots"][name]["pose"]["agvPosition"]["x"] == number

        # a map of 1.5 MB through the narrow line, while the robots go on telling
        offer = ("fleet", "share", "--map", str(shared), "--version", "3", "--router", ROUTER)
        with network.program(HUB, *offer) as sharing:
            view.until(lambda: "SHA-256" in sharing.read_text(), 30.0)
            said = network.run(LOSSY, tmp_path / LOSSY, "fleet", "fetch", "map", "--router", ROUTER)
            assert "map hall.lumimap version 3 is in" in said
            (placed,) = (tmp_path / LOSSY / "lumiloop" / "maps").glob("*.lumimap")
            assert placed.read_bytes() == shared.read_bytes()
            assert network.lost(LOSSY) > 10
            assert view.fresh() == everybody

        # one robot is cut off: it is seen to be gone, the others are not touched, and it comes back by itself
        network.link(CUT, "down")
        view.until(lambda: not view.told()["robots"][CUT]["alive"], 20.0)
        assert view.fresh() == everybody - {CUT}
        assert view.told()["problems"] == []
        view.until(lambda: "is lost; waiting for it" in (tmp_path / f"{CUT}-join.log").read_text(), 20.0)
        network.link(CUT, "up")
        view.until(lambda: view.fresh() == everybody, 25.0)

        # the router dies: all say so, and go on when it is back
        hub.close()
        view.until(lambda: not view.told()["router"] and not view.fresh(), 10.0)
        hub.enter_context(network.program(HUB, *router))
        view.until(lambda: view.told()["router"] and view.fresh() == everybody, 25.0)
        for name in names():
            assert "again" in (tmp_path / f"{name}-join.log").read_text()
