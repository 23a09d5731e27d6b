"""`lumiloop pause` and the like against a running daemon's network: what is said, and the exit code."""

import asyncio
import json
import math
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from daemon.cli import parser
from daemon.cli.orders.parsers import heading
from daemon.config.paths import commands_beside
from daemon.config.schema import Config, ModbusConfig
from daemon.publish.feeds import Feeds
from daemon.publish.network import Network
from daemon.snapshot import State
from daemon.system import console
from daemon.system.callbacks import OnDone
from estimator import Command, Order
from hal.clock import SystemClock
from tests.daemon.publish.modbus.test_registers import snapshot
from tests.daemon.publish.network import until
from tests.daemon.publish.test_network import free_port


class Robot:
    """The network of a daemon named agv, whose cycle publishes a snapshot after each command."""

    def __init__(self, folder: Path, write: bool = True) -> None:
        self.port = free_port()
        self.commands: list[Command] = []
        self.switched: list[int] = []
        self.states: list[State] = []  # of the next snapshots; then TRACKING
        feeds = Feeds(
            on_odometry=lambda _: None,
            on_imu=lambda _: None,
            on_command=self._command,
            on_save=lambda on_done: on_done(""),
            on_dump=lambda on_done: on_done("the disk is full"),
            on_switch=self._switch,
        )
        settings = Config(name="agv", modbus=ModbusConfig(port=self.port, write=write))
        self.network = Network(settings, SystemClock(), feeds, folder / "lumiloop" / "agv.stream")

    def _command(self, command: Command) -> None:
        self.commands.append(command)
        for later in range(1, 1 + max(1, len(self.states))):
            asyncio.get_running_loop().call_later(0.01 * later, self.publish)

    def publish(self) -> None:
        state = self.states.pop(0) if self.states else State.TRACKING
        for sink in self.network.sinks:
            sink(snapshot(state=state, pose=(1.0, 2.0, math.pi / 2)))

    def _switch(self, map_id: int, on_done: OnDone) -> None:
        self.switched.append(map_id)
        on_done("" if map_id == 0x1A2B3C4D else "no such map is stored")


@asynccontextmanager
async def driving(folder: Path, monkeypatch: pytest.MonkeyPatch, write: bool = True) -> AsyncIterator[Robot]:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    robot = Robot(folder, write)
    parts = [asyncio.create_task(run(), name=name) for name, run in robot.network.parts.items()]
    socket = commands_beside(folder / "lumiloop" / "agv.stream")
    await until(lambda: socket.exists() and robot.network.modbus is not None and robot.network.modbus.port > 0)
    try:
        yield robot
    finally:
        for part in parts:
            part.cancel()
        await asyncio.gather(*parts, return_exceptions=True)


Said = Callable[..., Any]


@pytest.fixture
def lumiloop(capsys: pytest.CaptureFixture[str]) -> Said:
    """Runs a command beside the daemon; returns exit code, stdout and stderr."""

    async def run(*words: str) -> tuple[int, str, str]:
        code = await asyncio.to_thread(parser.main, [*words, "--set", "name=agv"])
        return code, *capsys.readouterr()

    return run


async def test_orders_of_this_computer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lumiloop: Said) -> None:
    """`modbus.write` does not matter to them."""
    async with driving(tmp_path, monkeypatch, write=False) as robot:
        code, out, err = await lumiloop("set-pose", "1", "-2.5", "-90deg")
        assert (code, err) == (console.OK, "")
        assert out.startswith("pose set; state ")
        assert out.endswith(", x 1.000 m, y 2.000 m, yaw 90.00 deg\n")
        assert robot.commands[0].order is Order.SET_POSE
        assert robot.commands[0].T_map_base == pytest.approx((1.0, -2.5, -math.pi / 2))
        assert (await lumiloop("relocalise"))[1].startswith("search ended; state ")
        assert (await lumiloop("pause"))[1].startswith("paused: ")
        assert (await lumiloop("resume"))[1].startswith("pause ended; ")
        assert (await lumiloop("reset"))[1].startswith("new map started; stored maps remain; state ")
        orders = [Order.RELOCALISE, Order.PAUSE, Order.RESUME, Order.RESET]
        assert [command.order for command in robot.commands[1:]] == orders
        assert (await lumiloop("save-map"))[:2][1].startswith("map saved and read back")
        assert (await lumiloop("switch-map", "1a2b3c4d"))[0] == console.OK
        assert robot.switched == [0x1A2B3C4D]


async def test_a_refusal_is_said_and_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lumiloop: Said) -> None:
    async with driving(tmp_path, monkeypatch):
        assert await lumiloop("dump") == (console.FAILED, "", "lumiloop: refused: the disk is full\n")
        assert await lumiloop("switch-map", "77") == (console.FAILED, "", "lumiloop: refused: no such map is stored\n")
        code, out, err = await lumiloop("dump", "--json")
        assert (code, err) == (console.FAILED, "")
        told = json.loads(out)
        assert (told["schema"], told["command"], told["result"]) == ("lumiloop.command/1", "dump_recorder", "refused")


async def test_orders_over_modbus(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lumiloop: Said) -> None:
    async with driving(tmp_path, monkeypatch) as robot:
        host = f"127.0.0.1:{robot.port}"
        code, out, err = await lumiloop("set-pose", "1", "2", "1.5rad", "--host", host)
        assert (code, err) == (console.OK, "")
        assert out.startswith("pose set; state ")
        assert out.endswith(", x 1.000 m, y 2.000 m, yaw 90.00 deg\n")
        assert robot.commands[0].T_map_base == pytest.approx((1.0, 2.0, 1.5))
        assert (await lumiloop("switch-map", "0x1a2b3c4d", "--host", host))[0] == console.OK
        code, _, err = await lumiloop("dump", "--host", host)
        assert code == console.FAILED
        assert "refused: the log of the daemon" in err
    async with driving(tmp_path, monkeypatch, write=False) as robot:
        code, _, err = await lumiloop("pause", "--host", f"127.0.0.1:{robot.port}")
        assert code == console.FAILED
        assert "set `modbus.write = true`" in err
        assert robot.commands == []


async def test_a_search_over_modbus_is_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lumiloop: Said
) -> None:
    async with driving(tmp_path, monkeypatch) as robot:
        words = ("relocalise", "--host", f"127.0.0.1:{robot.port}")
        robot.states = [State.RELOCATING, State.RELOCATING]
        asked = asyncio.create_task(lumiloop(*words))
        await until(lambda: not robot.states)
        await asyncio.sleep(0.3)
        assert not asked.done()
        robot.publish()
        code, out, _ = await asked
        assert code == console.OK
        assert out.startswith("search ended; state TRACKING, x 1.000 m")
        robot.states = [State.LOST]
        code, _, err = await lumiloop(*words, "--timeout", "0.5")
        assert code == console.FAILED
        assert "not finished in time" in err


async def test_an_order_that_does_not_end_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lumiloop: Said
) -> None:
    async with driving(tmp_path, monkeypatch) as robot:
        monkeypatch.setattr(robot, "publish", lambda: None)
        code, _, err = await lumiloop("relocalise", "--timeout", "0.2")
        assert code == console.FAILED
        assert "not finished after 0.2 s; the command continues" in err


async def test_where_no_daemon_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lumiloop: Said) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    code, _, err = await lumiloop("pause")
    assert code == console.FAILED
    assert "no daemon runs; start one with `lumiloop run`" in err


async def test_a_daemon_of_another_name_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async with driving(tmp_path, monkeypatch):
        code = await asyncio.to_thread(parser.main, ["pause", "--set", "name=other"])
        assert code == console.FAILED
        assert "no daemon has the name other; running daemons: agv" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "rad"), [("90", math.pi / 2), ("-90deg", -math.pi / 2), ("1.5rad", 1.5), ("270", -math.pi / 2)]
)
def test_headings(text: str, rad: float) -> None:
    assert heading(text) == pytest.approx(rad)


@pytest.mark.parametrize("words", [["set-pose", "1", "2", "north"], ["set-pose", "nan", "2", "0"], ["set-pose", "1"]])
def test_what_is_no_pose_is_wrong_usage(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        parser.main(words)
    assert caught.value.code == console.USAGE


@pytest.mark.parametrize("text", ["hall", "0", "123456789", "-1"])
def test_what_is_no_map_is_wrong_usage(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert parser.main(["switch-map", "--", text] if text[0] == "-" else ["switch-map", text]) == console.USAGE
    assert "eight hexadecimal digits" in capsys.readouterr().err
