"""Network services: Modbus, pose datagrams, local stream, and the input port of odometry and gyro readings.

Each is a component of the supervisor, and is imported only if it is configured.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from daemon.config.endpoints import ANYBODY, interface_of, parse_endpoint, subscription_port
from daemon.config.paths import commands_beside
from daemon.config.schema import Config, ModbusConfig
from daemon.health.reasons import REASONS, Reason
from daemon.integrity.arrival_monitor import ODOMETRY_SILENT_S
from daemon.publish.allow_list import Access
from daemon.publish.commands import Orders
from daemon.publish.feeds import Feeds, OnOdometry
from daemon.runtime.cycle_parts import Sink
from hal.clock import Clock
from hal.odometry import RawOdometry

if TYPE_CHECKING:
    from daemon.publish.modbus.holding import Outcome
    from daemon.publish.modbus.server import ModbusPublisher
    from daemon.publish.stream.server import StreamServer
    from daemon.publish.udp_sender import PoseSender

log = logging.getLogger(__name__)

CALM_S: Final = 60.0
"""Time in s without an ignored reading after which the next one is logged again."""

Run = Callable[[], Awaitable[None]]


class OneSender:
    """Filter that accepts one sender of odometry at a time: two cumulative poses are unrelated."""

    def __init__(self, on_odometry: OnOdometry) -> None:
        self.refused = 0
        self._refused_at = -math.inf
        self._on_odometry = on_odometry
        self._sender = ""
        self._heard = 0.0

    def receive(self, sender: str, reading: RawOdometry) -> None:
        """Pass a reading on if it is the present sender's, or if that one has timed out."""
        if sender != self._sender and self._sender and reading.t_rx - self._heard <= ODOMETRY_SILENT_S:
            self.refused += 1
            if reading.t_rx - self._refused_at > CALM_S:
                log.warning("odometry from %s is ignored while %s sends odometry too", sender, self._sender)
            self._refused_at = reading.t_rx
            return
        self._sender, self._heard = sender, reading.t_rx
        self._on_odometry(reading)


class Network:
    """All configured network services.

    Attributes:
        sinks: receive every snapshot. parts: by name, for the supervisor. modbus, pose, stream: None: not configured.
    """

    def __init__(self, settings: Config, clock: Clock, feeds: Feeds, stream: Path | None = None) -> None:
        self.sinks: list[Sink] = []
        self.parts: dict[str, Run] = {}
        self._settings = settings
        self._clock = clock
        self._feeds = feeds
        self._access = Access(settings.allow, settings.bind)
        self._odometry = OneSender(feeds.on_odometry)
        self._orders = Orders(clock, feeds)
        self.modbus: ModbusPublisher | None = None
        self.pose: PoseSender | None = None
        if settings.modbus.port or settings.modbus.line is not None:
            self._add_modbus(settings.modbus)
        if settings.pose.receivers:
            self._add_pose()
        if settings.odometry.port:
            self._add_inputs()
        self.stream: StreamServer | None = None
        if stream is not None:
            self._add_stream(stream)
            self._add_commands(commands_beside(stream))
        self.sinks.append(self._orders.published)  # last: a client that is told of the end finds the snapshot published

    @property
    def failing(self) -> set[str]:
        """Names of components that run but cannot do their work at present."""
        return {"pose"} if self.pose is not None and self.pose.failing else set()

    def _add_modbus(self, settings: ModbusConfig) -> None:
        from daemon.publish.modbus.server import ModbusPublisher

        orders = self._orders
        modbus = ModbusPublisher(
            self._clock,
            name=self._settings.name,
            write=settings.write,
            allowed=self._access,
            on_command=lambda request: orders.handle(request, partial(_acknowledge, modbus, request.number)),
            on_odometry=self._from("Modbus"),
            on_loop_seen=self._feeds.on_loop_seen,
        )
        self.modbus = modbus
        self.sinks.append(modbus.publish)
        if settings.port:
            self.parts["modbus"] = lambda: _open(lambda: modbus.start(self._settings.bind, settings.port), modbus.close)
        if settings.line is not None:
            from daemon.publish.modbus.rtu import RtuServer

            self.parts["modbus serial"] = RtuServer(settings.line, modbus.answer).run

    def _add_pose(self) -> None:
        from daemon.publish.udp_sender import PoseSender
        from daemon.publish.udp_subscriptions import Subscriptions

        settings, subscriptions = self._settings, None
        if port := subscription_port(settings.pose.receivers):
            subscriptions = Subscriptions(settings.bind, port, self._access)
            self.parts["pose subscriptions"] = lambda: _open(subscriptions.start, subscriptions.close)
        fixed = [receiver for receiver in settings.pose.receivers if parse_endpoint(receiver)[0] != ANYBODY]
        self.pose = sender = PoseSender(fixed, interface_of(settings.bind), subscriptions)
        self.sinks.append(sender.publish)
        self.parts["pose"] = lambda: _open(sender.start, sender.close)

    def _add_stream(self, path: Path) -> None:
        from daemon.publish.stream.server import StreamServer

        server = StreamServer(path, self._settings.name, lambda reason: REASONS[Reason(reason)])
        self.stream = server
        self.sinks.append(server.publish)
        self.parts["stream"] = server.run

    def _add_commands(self, path: Path) -> None:
        from daemon.publish.command_socket import CommandSocket

        server = CommandSocket(path, self._orders.handle)
        self.sinks.append(server.publish)
        self.parts["commands"] = server.run

    def _add_inputs(self) -> None:
        from hal.net.inputs import InputPort

        port = InputPort(self._clock, self._settings.bind, self._settings.odometry.port, allowed=self._access)
        on_odometry, on_imu = self._from("UDP"), self._feeds.on_imu
        self.parts["odometry"] = lambda: port.odometry.run(on_odometry)
        self.parts["imu"] = lambda: port.imu.run(on_imu)

    def _from(self, sender: str) -> OnOdometry:
        """Callback for the readings of one sender."""
        return lambda reading: self._odometry.receive(sender, reading)


def _acknowledge(modbus: ModbusPublisher, number: int, outcome: Outcome, reason: str) -> None:
    """Report the end of a Modbus client's command; the reason is in the log."""
    modbus.acknowledge(number, outcome)


async def _open(start: Callable[[], Awaitable[None]], close: Callable[[], Awaitable[None]]) -> None:
    """Run a component that works by callbacks: start it, wait for ever, and close it at the end."""
    await start()
    try:
        await asyncio.Event().wait()
    finally:
        await close()
