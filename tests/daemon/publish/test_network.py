"""ActiveFaults and odometry that come in over Modbus and UDP, through real sockets to the estimate and back."""

import asyncio
import logging
import math
import socket
import struct
import threading
from collections.abc import Callable
from contextlib import closing
from typing import TypeVar

import pytest

from daemon.app import Daemon, Environment
from daemon.config.schema import Config, LidarConfig, MapConfig, ModbusConfig, OdometryConfig, PoseConfig
from daemon.health.faults import Fault
from daemon.health.reasons import Reason
from daemon.publish import udp_subscriptions
from daemon.publish.feeds import Feeds
from daemon.publish.modbus import registers
from daemon.publish.modbus.holding import COMMAND_ADDRESS, CommandCode, Outcome
from daemon.publish.network import Network
from daemon.runtime.budget import FixedBudget
from daemon.runtime.worker import CycleWorker
from daemon.snapshot import Snapshot, State
from hal.clock import LoopClock, SystemClock, run_virtual
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import URG_04LX_UG01
from hal.fake.lidar.scan_world import Room
from hal.fake.transport.memory_host import FakeOpener
from hal.net.inet import numeric
from hal.net.input_codec import IMU_MAGIC, ODOMETRY_MAGIC, InputDatagram, encode
from tools.sim.ports import free_port

T = TypeVar("T")


async def outside(work: Callable[[], T]) -> T:
    """Do blocking socket work as another program would, while virtual time goes on, no faster than that program."""
    found: list[T] = []
    thread = threading.Thread(target=lambda: found.append(work()))
    thread.start()
    while thread.is_alive():
        thread.join(0.001)  # else a busy computer lets seconds of virtual time go by until it answers
        await asyncio.sleep(0.001)
    return found[0]


class Plc:
    """A Modbus client made of nothing but `struct`."""

    def __init__(self, port: int) -> None:
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.settimeout(5.0)
        self._sock.connect(("127.0.0.1", port))

    def close(self) -> None:
        self._sock.close()

    def ask(self, pdu: bytes) -> bytes:
        self._sock.send(struct.pack(">HHHB", 7, 0, len(pdu) + 1, 1) + pdu)
        return self._sock.recv(300)[7:]

    def order(self, number: int, code: int, x: float, y: float, yaw: float) -> None:
        data = struct.pack(">HHiii", number, code, round(x * 1e4), round(y * 1e4), round(yaw * 1e6))
        answer = self.ask(struct.pack(">BHHB", 16, COMMAND_ADDRESS, 8, 16) + data)
        assert answer[0] == 16, f"exception {answer.hex()}"

    def outcome(self) -> tuple[int, int]:
        answer = self.ask(struct.pack(">BHH", 3, COMMAND_ADDRESS + 8, 2))
        acknowledged, result = struct.unpack(">HH", answer[2:])
        return acknowledged, result


class Bench:
    """The daemon with its own sockets on the fake sensor."""

    def __init__(self, settings: Config) -> None:
        clock = LoopClock(asyncio.get_running_loop())
        opener = FakeOpener(clock)
        opener.plug("/dev/lidar", FakeHokuyo(URG_04LX_UG01, Room(URG_04LX_UG01)))
        self.snapshots: list[Snapshot] = []

        async def warm() -> None:
            """Loaded already."""

        world = Environment(
            clock,
            opener=opener,
            make_worker=CycleWorker,
            make_budget=FixedBudget,
            warm_up=warm,
            sinks=(self.snapshots.append,),
        )
        self.daemon = Daemon(settings, world)
        self.stop = asyncio.Event()
        self.running = asyncio.create_task(self.daemon.run(self.stop))

    async def end(self) -> None:
        self.stop.set()
        await self.running


def settings(**more: object) -> Config:
    return Config(lidar=LidarConfig(device="/dev/lidar"), **more)  # type: ignore[arg-type]  # test shorthand


def test_a_plc_sets_the_pose_and_is_told_when_it_is_done() -> None:
    port = free_port()

    async def go() -> None:
        bench = Bench(settings(modbus=ModbusConfig(port=port, write=True)))
        with closing(Plc(port)) as plc:
            await asyncio.sleep(2.0)
            await session(bench, plc)
        await bench.end()

    async def session(bench: Bench, plc: Plc) -> None:
        await outside(lambda: plc.order(1, CommandCode.SET_POSE, 12.5, -3.0, 1.0))
        await asyncio.sleep(0.3)
        assert await outside(plc.outcome) == (1, Outcome.DONE)
        told = bench.snapshots[-1].pose
        assert told is not None
        assert math.hypot(told[0] - 12.5, told[1] + 3.0) < 0.1
        assert told[2] == pytest.approx(1.0, abs=0.1)
        map_id = bench.snapshots[-1].map_id
        await outside(lambda: plc.order(2, CommandCode.RESET, 0, 0, 0))
        await asyncio.sleep(0.3)
        assert await outside(plc.outcome) == (2, Outcome.DONE)
        assert bench.snapshots[-1].map_id not in (0, map_id)
        await outside(lambda: plc.order(3, 99, 0, 0, 0))
        await asyncio.sleep(0.3)
        assert await outside(plc.outcome) == (3, Outcome.UNKNOWN)
        await outside(lambda: plc.order(4, CommandCode.SAVE_MAP, 0, 0, 0))
        await asyncio.sleep(0.3)
        assert await outside(plc.outcome) == (4, Outcome.REFUSED), "this daemon keeps no maps"

    run_virtual(go())


@pytest.mark.virtual
async def test_a_plc_may_not_write_unless_it_is_allowed_to() -> None:
    port = free_port()
    bench = Bench(settings(modbus=ModbusConfig(port=port)))
    with closing(Plc(port)) as plc:
        await asyncio.sleep(1.0)
        answer = await outside(lambda: plc.ask(struct.pack(">BHHBH", 16, COMMAND_ADDRESS, 1, 2, 1)))
    await bench.end()
    assert answer[0] == 0x80 + 16


@pytest.mark.virtual
async def test_datagrams_of_odometry_and_gyro_reach_the_cycle_and_poses_go_out() -> None:
    port = free_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.setblocking(False)
        where = f"127.0.0.1:{receiver.getsockname()[1]}"
        bench = Bench(
            settings(
                modbus=ModbusConfig(port=0),
                odometry=OdometryConfig(port=port),
                pose=PoseConfig(receivers=(where,)),
            )
        )
        await asyncio.sleep(2.5)
        assert bench.snapshots[-1].odometry_ok is False
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.connect(("127.0.0.1", port))
            for i in range(40):
                sender.send(encode(InputDatagram(ODOMETRY_MAGIC, 1, i, 0, 0.05 * i, (0.0, 0.0, 0.0))))
                sender.send(encode(InputDatagram(IMU_MAGIC, 1, i, 0, 0.05 * i, (0.0,))))
                await asyncio.sleep(0.05)
        taken = bench.daemon.cycle.inbox.drain()
        assert (taken.odometry_total, taken.imu_total) == (40, 40)
        assert bench.snapshots[-1].odometry_ok is True
        latest = registers.decode_datagram(receiver.recv(2000))
        assert latest["seq"] == 1
        await bench.end()


@pytest.mark.virtual
async def test_a_receiver_that_cannot_be_sent_to_is_a_fault_until_it_can_be(caplog: pytest.LogCaptureFixture) -> None:
    """As with the network's cable pulled: named by its number, one warning, and one line when it is over."""
    caplog.set_level(logging.INFO)
    pose = PoseConfig(receivers=("255.255.255.255:5600",))  # nothing may be sent there: Permission denied
    bench = Bench(settings(pose=pose, modbus=ModbusConfig(port=0), map=MapConfig(folder="none")))
    await asyncio.sleep(6.0)
    before, sender = bench.daemon.heartbeat.faults, bench.daemon.network.pose
    assert sender is not None
    (sender.receivers[0].address,) = numeric("127.0.0.1", free_port())
    await asyncio.sleep(6.0)
    after = bench.daemon.heartbeat.faults
    await bench.end()
    assert (before, after) == ((Fault.PUBLISHER_FAILED,), ())
    warned = [record.message for record in caplog.records if record.levelno >= logging.WARNING]
    assert len(warned) == 1
    assert "fault 401: " in warned[0]
    assert "pose receiver 255.255.255.255:5600: Permission denied" in caplog.text
    assert "over: fault 401: " in caplog.text


@pytest.mark.virtual
async def test_without_any_socket_the_daemon_runs_for_its_sinks() -> None:
    bench = Bench(settings(modbus=ModbusConfig(port=0)))
    assert list(bench.daemon.network.parts) == []
    await asyncio.sleep(6.0)
    await bench.end()
    assert bench.snapshots[-1].state is State.TRACKING


@pytest.mark.virtual
async def test_a_pause_leaves_the_pose_to_others_until_it_is_resumed() -> None:
    port = free_port()
    bench = Bench(settings(modbus=ModbusConfig(port=port, write=True)))
    with closing(Plc(port)) as plc:
        await asyncio.sleep(3.0)
        await outside(lambda: plc.order(1, CommandCode.PAUSE, 0, 0, 0))
        await asyncio.sleep(1.0)
        assert await outside(plc.outcome) == (1, Outcome.DONE)
        paused = [one for one in bench.snapshots if one.reason is Reason.PAUSED]
        said = [one.state for one in paused if one.t_mono - paused[0].t_mono < 0.35]
        assert len(said) >= 3
        assert set(said) == {State.DEGRADED}, "it drives: without wheels it is LOST soon after"
        await outside(lambda: plc.order(2, CommandCode.RESUME, 0, 0, 0))
        await asyncio.sleep(1.0)
        assert await outside(plc.outcome) == (2, Outcome.DONE)
        assert bench.snapshots[-1].reason is not Reason.PAUSED
    await bench.end()


def test_who_subscribes_gets_poses_and_this_computer_always_may() -> None:
    port = free_port()

    async def answers(allow: tuple[str, ...]) -> int:
        pose = PoseConfig(receivers=(f"*:{port}",))
        bench = Bench(settings(modbus=ModbusConfig(port=0), pose=pose, allow=allow, bind="127.0.0.1"))
        cookie = 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.connect(("127.0.0.1", port))
            client.setblocking(False)
            for _ in range(2):
                await asyncio.sleep(0.5)
                client.send(
                    udp_subscriptions.encode(udp_subscriptions.Message(udp_subscriptions.Status.ASK, 30, cookie))
                )
                await asyncio.sleep(0.01)
                cookie = udp_subscriptions.decode(client.recv(24)).cookie
            await asyncio.sleep(1.0)
            seq = registers.decode_datagram(client.recv(2000))["seq"]
        await bench.end()
        return int(seq or 0)

    assert run_virtual(answers(())) > 0
    assert run_virtual(answers(("10.0.0.0/8",))) > 0, "this computer always is"


def test_each_form_of_publishing_is_a_part_of_its_own() -> None:
    def parts(**more: object) -> tuple[set[str], Network]:
        feeds = Feeds(lambda _: None, lambda _: None, lambda _: None, lambda _: None)
        network = Network(settings(**more), SystemClock(), feeds)
        return set(network.parts), network

    serial = ModbusConfig(port=0, serial="/dev/ttyUSB1@115200#3")
    names, network = parts(modbus=serial, pose=PoseConfig(receivers=("*:5601", "127.0.0.1:9")))
    assert names == {"modbus serial", "pose", "pose subscriptions"}
    assert network.modbus is not None
    assert len(network.sinks) == 3
    assert parts(modbus=ModbusConfig(port=0))[0] == set()
    assert parts()[0] == {"modbus"}
