"""Modbus requests and their replies: one application data unit in, one out. Pure: no sockets, no clock.

pymodbus's framer and message classes encode and decode application data units and function bodies. Reading the
published block has a fast path, because nearly every request is one; a test compares its bytes with those of the
general path.

Functions: 3 and 4 (read holding, read input registers: both return the published blocks, 3 also the writable ones), 6,
16 and 23 (write, write and read, where writing is allowed), 43 with MEI type 14 (device identification). Any unit
identifier is accepted and returned: there is one device behind it.
(MODBUS Application Protocol V1.1b3; MODBUS Messaging on TCP/IP Implementation Guide V1.0b.)
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable
from typing import Final

from pymodbus.constants import ExcCodes
from pymodbus.exceptions import ModbusException
from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadHoldingRegistersResponse,
    ReadInputRegistersRequest,
    ReadInputRegistersResponse,
    ReadWriteMultipleRegistersRequest,
    ReadWriteMultipleRegistersResponse,
    WriteMultipleRegistersRequest,
    WriteMultipleRegistersResponse,
    WriteSingleRegisterRequest,
    WriteSingleRegisterResponse,
)

from daemon.publish.modbus import dimmed_block, integrity_block, lights_block, parts_block, timing_block
from daemon.publish.modbus.holding import Holding, Refused
from daemon.publish.modbus.identification import READ_DEVICE_IDENTIFICATION, identify, objects_of
from daemon.publish.modbus.registers import MIRROR_ADDRESS, MIRROR_WORDS
from daemon.system.defects import Place, log_once

HEADER_SIZE: Final = 7  # transaction, protocol, length, unit
MAX_FRAME: Final = 260  # header and a body of at most 253 bytes
READ_HOLDING: Final = 3
READ_INPUT: Final = 4
WRITE_SINGLE: Final = 6
WRITE_MULTIPLE: Final = 16
READ_WRITE: Final = 23
MAX_READ: Final = 125
MAX_WRITE: Final = 123
MAX_READ_WRITE: Final = 121
"""Registers that one request may write that also reads."""

log = logging.getLogger(__name__)

_READ: Final = struct.Struct(">HHHBBHH")
_READ_ANSWER: Final = struct.Struct(">HHHBBB")
_FIXED_BODY: Final = 5  # function, address, count or value
_READ_WRITE_HEAD: Final = 10  # function, address and count of both, number of bytes

Make = Callable[[], bytes]
BLOCKS: Final = (lights_block.BLOCK, integrity_block.BLOCK, timing_block.BLOCK, parts_block.BLOCK, dimmed_block.BLOCK)
"""The blocks beside the first one, by address."""
_BESIDE: Final = ((MIRROR_ADDRESS, MIRROR_WORDS), *((block.address, block.registers) for block in BLOCKS))
"""First address and size of the blocks beside the first one, in the order in which :meth:`Responder.show` takes them.
"""


def frame_size(data: bytes | bytearray) -> int:
    """Size of the application data unit that starts here, from its header; 0: incomplete header; -1: not Modbus."""
    if len(data) < HEADER_SIZE + 1:
        return 0
    length = data[4] << 8 | data[5]
    if data[2] or data[3] or not 2 <= length <= MAX_FRAME - 6:
        return -1
    return 6 + length


class Responder:
    """Replies to requests from the latest published blocks.

    Args:
        holding: writable registers, or None where writing is not allowed.
        name: of the robot, for the device identification.
    """

    def __init__(self, holding: Holding | None = None, name: str = "lumiloop") -> None:
        self._holding = holding
        self._identity = objects_of(name)
        self._framer = FramerSocket(DecodePDU(is_server=True))
        self._block = b""
        self._make: tuple[Make, ...] = ()
        self._made: dict[int, bytes] = {}
        self._defects: set[Place] = set()

    def show(self, block: bytes, *beside: Make) -> None:
        """Replace all blocks at once: no reply ever mixes two snapshots.

        ``beside`` encode the blocks of the same snapshot that few clients read (float mirror, lights, integrity). They
        are called when a client reads those.
        """
        self._block = block
        self._make, self._made = beside, {}

    def answer(self, frame: bytes) -> bytes:
        """Reply to one complete application data unit that :func:`frame_size` has accepted."""
        if len(frame) == _READ.size:
            transaction, _, _, unit, function, address, count = _READ.unpack(frame)
            if function in (READ_INPUT, READ_HOLDING) and 0 < count <= MAX_READ:
                block = self._block
                if address + count <= len(block) >> 1:
                    head = _READ_ANSWER.pack(transaction, 0, 3 + 2 * count, unit, function, 2 * count)
                    return head + block[2 * address : 2 * (address + count)]
        return self.answer_any(frame)

    def answer_any(self, frame: bytes) -> bytes:
        """The same reply without the fast path."""
        _, unit, transaction, body = self._framer.decode(frame)
        message = self._respond(body)
        message.dev_id, message.transaction_id = unit, transaction
        return self._framer.buildFrame(message)

    def answer_body(self, body: bytes) -> bytes:
        """Reply to a function's body alone, as on serial lines."""
        message = self._respond(body)
        return bytes([message.function_code]) + message.encode()

    def _respond(self, body: bytes) -> ModbusPDU:
        function = body[0]
        try:
            if function in (READ_HOLDING, READ_INPUT):
                return self._read(function, body)
            if function == WRITE_SINGLE and self._holding is not None:
                return self._write_single(self._holding, body)
            if function == WRITE_MULTIPLE and self._holding is not None:
                return self._write_multiple(self._holding, body)
            if function == READ_WRITE and self._holding is not None:
                return self._read_write(self._holding, body)
            if function == READ_DEVICE_IDENTIFICATION:
                return identify(self._identity, body)
        except Refused:
            return ExceptionResponse(function, ExcCodes.ILLEGAL_ADDRESS)
        except (ValueError, IndexError, struct.error, ModbusException):
            return ExceptionResponse(function, ExcCodes.ILLEGAL_VALUE)
        except Exception as error:  # noqa: BLE001  any failure is reported to the client and logged
            log_once(log, self._defects, error, "a Modbus request has failed; its client receives exception 4")
            return ExceptionResponse(function, ExcCodes.DEVICE_FAILURE)
        return ExceptionResponse(function, ExcCodes.ILLEGAL_FUNCTION)

    def _read(self, function: int, body: bytes) -> ModbusPDU:
        holding = function == READ_HOLDING
        request = ReadHoldingRegistersRequest() if holding else ReadInputRegistersRequest()
        if len(body) != _FIXED_BODY:
            raise ValueError("a read request must have five bytes")
        request.decode(body[1:])
        data = self._registers(request.address, request.count, holding)
        registers = list(struct.unpack(f">{request.count}H", data))
        return (
            ReadHoldingRegistersResponse(registers=registers)
            if holding
            else ReadInputRegistersResponse(registers=registers)
        )

    def _registers(self, address: int, count: int, holding: bool) -> bytes:
        start, memory = 0, self._block
        for (first, words), make in zip(_BESIDE, self._make, strict=False):
            if first <= address < first + words:
                if first not in self._made:
                    self._made[first] = make()
                start, memory = first, self._made[first]
        if 2 * (address - start + count) <= len(memory):
            return memory[2 * (address - start) : 2 * (address - start + count)]
        if holding and self._holding is not None:
            return self._holding.read(address, count)
        raise Refused

    def _write_single(self, holding: Holding, body: bytes) -> ModbusPDU:
        if len(body) != _FIXED_BODY:
            raise ValueError("a write of one register must have five bytes")
        request = WriteSingleRegisterRequest()
        request.decode(body[1:])
        holding.write(request.address, request.registers[0].to_bytes(2, "big"))
        return WriteSingleRegisterResponse(address=request.address, registers=request.registers)

    def _write_multiple(self, holding: Holding, body: bytes) -> ModbusPDU:
        request = WriteMultipleRegistersRequest()
        request.decode(body[1:])
        data = body[6:]
        if (
            not 1 <= request.count <= MAX_WRITE
            or request.byte_count != 2 * request.count
            or len(data) != 2 * request.count
        ):
            raise ValueError("count and bytes disagree")
        holding.write(request.address, data)
        return WriteMultipleRegistersResponse(address=request.address, count=request.count)

    def _read_write(self, holding: Holding, body: bytes) -> ModbusPDU:
        """Write, then read; nothing is written where the read is not possible."""
        request = ReadWriteMultipleRegistersRequest()
        request.decode(body[1:])
        data = body[_READ_WRITE_HEAD:]
        sizes = {request.write_byte_count, 2 * request.write_count, len(data)}
        if not 1 <= request.read_count <= MAX_READ or not 1 <= request.write_count <= MAX_READ_WRITE or len(sizes) > 1:
            raise ValueError("count and bytes disagree")
        self._registers(request.read_address, request.read_count, holding=True)
        holding.write(request.write_address, data)
        read = self._registers(request.read_address, request.read_count, holding=True)
        return ReadWriteMultipleRegistersResponse(registers=list(struct.unpack(f">{request.read_count}H", read)))
