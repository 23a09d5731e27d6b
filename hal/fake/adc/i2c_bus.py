"""A simulated I2C bus at message level: addresses, acknowledgements, SCL timing, limits of the adapter, faults.

It is a memory bus (:class:`hal.bus.i2c_memory.MemoryBus`): the end time of a transaction is known at its beginning, its
bytes are computed at that time.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random

from hal.bus.i2c import Message, Transferred, check
from hal.fake.adc.chips import FakeChip
from hal.fake.adc.damage import DAMAGE
from hal.fake.adc.faults import number_of
from hal.fake.adc.i2c_adapters import Adapter
from hal.fake.adc.i2c_timing import SclTiming
from hal.fake.faults.orders import Fault
from hal.fake.faults.schedule import ActiveFaults

BLOCK: int = 60
"""A read of at least this many bytes counts as a block."""
REFUSED_S = 10e-6
"""Duration of a transaction that is refused before it reaches the bus."""
AROUND = 10
"""Clocks of START, address with acknowledgement, and STOP."""


@dataclass(slots=True)
class Transaction:
    """A transaction in progress; see :class:`hal.bus.i2c_memory.Pending`.

    Attributes:
        t0, t_end: ``t_mono`` of call and return. code: errno it fails with, 0: none.
        lines: SCL timing of each message. is_block: it reads a block from the converter.
    """

    bus: FakeBus
    messages: tuple[Message, ...]
    t0: float
    t_end: float
    code: int = 0
    lines: list[SclTiming] = field(default_factory=list)
    is_block: bool = False

    def finish(self) -> Transferred:
        """The result; raises `OSError` if it failed."""
        code = self.code or self.bus.gone()
        if code:
            raise OSError(code, os.strerror(code))
        return Transferred(self.t0, self.t_end, self.bus.carry_out(self))


class FakeBus:
    """One bus, its adapter, and the chips on it.

    Args:
        adapter: of the host. now: the clock. seed: of jitter and of random faults.
        scl_error: relative error of SCL.
    """

    def __init__(self, adapter: Adapter, now: Callable[[], float], *, seed: int = 0, scl_error: float = 0.0) -> None:
        self.adapter, self.now = adapter, now
        self.scl_error = scl_error
        self.chips: dict[int, FakeChip] = {}
        self.converter = 0
        self.orders = ActiveFaults(seed + 1)
        self.chance = Random(seed)
        self.transactions = 0
        self._free_at = float("-inf")
        self._fails_next = False

    @property
    def about(self) -> str:
        """The adapter's own name."""
        return self.adapter.name

    def begin(self, messages: tuple[Message, ...], *, dead: bool = False) -> Transaction:
        """Begin one transaction now; it waits for the end of the one before.

        Args:
            messages: joined by repeated starts.
            dead: the caller's handle belongs to an unplugged adapter.
        """
        self.transactions += 1
        t0 = self.now()
        code = errno.ENODEV if dead else self.gone() or self._refusal(messages)
        begun = Transaction(self, messages, t0, t0 + REFUSED_S, code)
        if begun.code:
            return begun
        begun.is_block = any(m.length >= BLOCK and m.address == self.converter for m in messages)
        t_bus = max(t0, self._free_at) + self.adapter.start_s + self._jitter()
        busy = self.orders.strike("busy") if begun.is_block else None
        t_stop = self._walk(begun, t_bus + (busy.number("by_s") if busy else 0.0))
        self._free_at = t_stop
        begun.t_end = t_stop + self.adapter.end_s + self._jitter() + self._lateness(begun)
        return begun

    def transfer(self, messages: tuple[Message, ...]) -> Transferred:
        """Carry out one transaction at once, with an end in the future of the clock; see :class:`hal.bus.i2c.Bus`."""
        return self.begin(messages).finish()

    def gone(self) -> int:
        """Errno while the adapter is unplugged, else 0."""
        return errno.ENODEV if self.orders.on("gone") else 0

    def carry_out(self, done: Transaction) -> tuple[bytes, ...]:
        """Let the chips act, at the end time of the transaction."""
        reads: list[bytes] = []
        for message, line in zip(done.messages, done.lines, strict=True):
            chip = self.chips.get(message.address)
            if message.data:
                if chip is not None:
                    chip.write(message.data, line.t_start)
                continue
            released = b"\xff" * message.length  # the chip was removed meanwhile
            data = released if chip is None else chip.read(message.length, line)
            reads.append(self._damaged(data) if done.is_block and message.length >= BLOCK else data)
        return tuple(reads)

    # messages

    def _refusal(self, messages: tuple[Message, ...]) -> int:
        """Errno with which the kernel or the adapter's driver refuses the messages; 0: none."""
        try:
            check(messages)
        except OSError as error:
            return error.errno or errno.EINVAL
        adapter = self.adapter
        reads = [message for message in messages if message.length]
        too_long = any(m.length > adapter.max_read or len(m.data) > adapter.max_write for m in messages)
        layout = adapter.one_read_last and (len(reads) > 1 or (bool(reads) and not messages[-1].length))
        if too_long or layout or len(messages) > adapter.max_messages:
            return errno.EOPNOTSUPP
        if self._fails_next:
            self._fails_next = False
            return errno.ETIMEDOUT
        return 0

    def _walk(self, begun: Transaction, t_bus: float) -> float:
        """Process the messages: set the errno of a failure, return the time of STOP."""
        scl_hz = self._scl_hz()
        fails = self._disturbance(begun)
        t = t_bus
        for message in begun.messages:
            length = len(message.data) or message.length
            stalls = self._stalls(length, is_block=begun.is_block and message.length >= BLOCK)
            line = SclTiming(t, scl_hz, stalls)
            begun.lines.append(line)
            if fails == errno.ETIMEDOUT:
                return self._time_out(begun, t_bus)
            if fails:
                begun.code = self._own(fails)
                return line.time(min(9 + 4 * length, 100))
            acknowledged = self._acknowledged(message)
            if acknowledged < length:
                begun.code = self._own(self.adapter.nack)
                return line.time(AROUND + 9 * max(acknowledged, 0))
            t = line.time(AROUND + 9 * length)
            if t - t_bus > self.adapter.timeout_s:
                return self._time_out(begun, t_bus)
        return t

    def _acknowledged(self, message: Message) -> int:
        """Acknowledged bytes of a message, -1 where the address is not. The host acknowledges reads."""
        chip = self.chips.get(message.address)
        if chip is None:
            return -1
        if message.length:
            return message.length
        return len(message.data) if chip.acknowledges_data else 0

    def _own(self, code: int) -> int:
        return self.adapter.any_error or code

    def _time_out(self, begun: Transaction, t_bus: float) -> float:
        begun.code = self._own(errno.ETIMEDOUT)
        self._fails_next = self.adapter.fails_after_timeout
        return t_bus + self.adapter.timeout_s

    def _disturbance(self, begun: Transaction) -> int:
        """Errno of a fault that strikes this transaction; 0: none."""
        orders = self.orders
        if orders.on("hang"):
            return errno.ETIMEDOUT
        if not any(message.address == self.converter for message in begun.messages):
            return 0
        if orders.on("off"):
            return self.adapter.nack
        kinds = {"nack": self.adapter.nack, "intermittent": self.adapter.nack}
        kinds |= {"timeout": errno.ETIMEDOUT, "arbitration": errno.EAGAIN, "error": 0}
        for what, code in kinds.items():
            fault = self._strike(what, begun)
            if fault is not None:
                return code or number_of(fault.text("name"))
        return 0

    def _strike(self, what: str, begun: Transaction) -> Fault | None:
        """Faults ``on = "blocks"`` get an opportunity with every block, those ``on = "all"`` with every transaction."""
        return self.orders.strike(what, on="blocks") if begun.is_block else self.orders.strike(what, on="all")

    # time

    def _scl_hz(self) -> float:
        slow, off = self.orders.on("slow"), self.orders.on("scl")
        hz = self.adapter.scl_hz * (1.0 + self.scl_error)
        hz *= 1.0 + 0.01 * off.number("percent") if off else 1.0
        return hz / slow.number("factor") if slow else hz

    def _jitter(self) -> float:
        return self.chance.expovariate(1.0 / self.adapter.jitter_s) if self.adapter.jitter_s else 0.0

    def _lateness(self, begun: Transaction) -> float:
        delayed = self.orders.on("delayed")
        late = self.orders.strike("late") if begun.is_block else None
        return (delayed.number("by_s") if delayed else 0.0) + (late.number("by_s") if late else 0.0)

    def _stalls(self, length: int, is_block: bool) -> tuple[tuple[float, float], ...]:
        """Stalls of SCL (clock, seconds), always between two bytes."""
        adapter, chance = self.adapter, self.chance
        found: list[tuple[float, float]] = []
        if adapter.chunk:
            found += [(9.5 + 9 * k, adapter.chunk_pause_s) for k in range(adapter.chunk, length, adapter.chunk)]
        if adapter.preempt_s:
            at = 0.0
            while (at := at + chance.expovariate(1.0 / adapter.preempt_every_s) * adapter.scl_hz) < 9 * length:
                found.append((at, chance.expovariate(1.0 / adapter.preempt_s)))
        fault = self.orders.strike("stall") if is_block else None
        if fault is not None:
            first = fault.number("at") if fault.number("at") >= 0 else None
            for _ in range(int(fault.number("pieces"))):
                share, first = (chance.random() if first is None else first), None
                found.append((9.5 + 9 * int(share * length), 1e-6 * fault.number("us")))
        return tuple(found)

    def _damaged(self, data: bytes) -> bytes:
        for what, harm in DAMAGE.items():
            fault = self.orders.strike(what)
            if fault is not None:
                data = harm(data, fault, self.chance)
        return data
