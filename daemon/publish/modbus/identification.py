"""Read Device Identification: function 43, MEI type 14 (MODBUS Application Protocol V1.1b3, 6.21).

All objects fit into one reply, so that nothing more follows.
"""

from __future__ import annotations

from typing import Final

from pymodbus.constants import DeviceInformation, ExcCodes
from pymodbus.pdu import ExceptionResponse, ModbusPDU
from pymodbus.pdu.mei_message import ReadDeviceInformationResponse

from daemon.system.versions import release

READ_DEVICE_IDENTIFICATION: Final = 43
MEI_TYPE: Final = 14
CONFORMITY: Final = 0x82
"""Conformity level: the regular objects, by stream and each alone."""
_BASIC: Final = 3
_SIZE: Final = 4  # function, MEI type, kind of access, object

Objects = dict[int, bytes]
"""Values by object ID, ASCII."""


def objects_of(name: str) -> Objects:
    """The objects of this program; ``name``: of the robot, as the user application name."""
    texts = {
        0x00: "lumiloop developers",
        0x01: "lumiloop",
        0x02: release(),
        0x03: "https://lumiloop.example",
        0x04: "lumiloop, indoor robot localisation",
        0x05: "daemon",
        0x06: name,
    }
    return {number: text.encode("ascii", "replace") for number, text in texts.items()}


def identify(objects: Objects, body: bytes) -> ModbusPDU:
    """The reply to a function's body; an access to extended objects returns the regular ones, as the standard demands.

    Raises:
        ValueError: a body of another size, or no such kind of access.
    """
    if len(body) > 1 and body[1] != MEI_TYPE:
        return ExceptionResponse(READ_DEVICE_IDENTIFICATION, ExcCodes.ILLEGAL_FUNCTION)
    if len(body) != _SIZE:
        raise ValueError("a request for the device identification must have four bytes")
    access, first = DeviceInformation(body[2]), body[3]
    if access is DeviceInformation.SPECIFIC:
        if first not in objects:
            return ExceptionResponse(READ_DEVICE_IDENTIFICATION, ExcCodes.ILLEGAL_ADDRESS)
        chosen = {first: objects[first]}
    else:
        offered = {n: text for n, text in objects.items() if n < _BASIC or access is not DeviceInformation.BASIC}
        begin = first if first in offered else 0
        chosen = {number: text for number, text in offered.items() if number >= begin}
    answer = ReadDeviceInformationResponse(read_code=access, information=chosen)
    answer.conformity = CONFORMITY
    return answer
