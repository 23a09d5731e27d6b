"""What all appended blocks share: refusals, reads of a part, the frozen contracts and the pages."""

import struct
from dataclasses import dataclass
from typing import Any

import pytest

from daemon.publish import document
from daemon.publish.modbus import dimmed_block, integrity_block, lights_block, parts_block, registers, timing_block
from daemon.publish.modbus.points import Layout
from daemon.publish.modbus.requests import BLOCKS, Responder
from daemon.snapshot import Snapshot
from tests.daemon.publish.modbus.test_light_blocks import DIMMED, picture
from tests.daemon.publish.modbus.test_registers import snapshot
from tests.daemon.publish.modbus.test_state_blocks import CONDITION, PULSE, TRUST


@dataclass(frozen=True)
class Case:
    """A block with its place, an example, a part that a client may read, and ranges it may not.

    ``tail``: its part of the datagram, and the first byte of it.
    """

    block: Any
    example: Snapshot
    address: int
    size: int
    part: tuple[int, int]
    refused: tuple[tuple[int, int], ...]
    tail: tuple[Layout, int] | None = None


CASES = {
    "lights": Case(
        lights_block.BLOCK, snapshot(light=picture()), 200, 120, (222, 6), ((199, 2), (200, 121), (320, 1), (319, 2)),
        (lights_block.TAIL, 128),
    ),
    "integrity": Case(
        integrity_block.BLOCK, snapshot(trust=TRUST), 340, 14, (344, 2), ((339, 2), (340, 15)),
        (integrity_block.TAIL, 152),
    ),
    "pulse": Case(timing_block.BLOCK, snapshot(pulse=PULSE), 354, 46, (358, 1), ((353, 2), (354, 47))),
    "parts": Case(parts_block.BLOCK, snapshot(condition=CONDITION), 400, 34, (407, 1), ((400, 35),)),
    "dimmed": Case(
        dimmed_block.BLOCK, snapshot(light=picture(dimmed=DIMMED)), 440, 24, (444, 2), ((440, 25), (439, 1))
    ),
}  # fmt: skip
EACH = pytest.mark.parametrize("name", CASES)


@EACH
def test_a_block_that_is_not_ours_is_refused(name: str) -> None:
    case = CASES[name]
    for at, word, words in ((0, 0x4C4C, "magic"), (1, 2, "version 2"), (3, 1, "torn"), (case.size - 1, 1, "torn")):
        block = bytearray(case.block.encode(case.example))
        block[2 * at : 2 * at + 2] = word.to_bytes(2, "big")
        with pytest.raises(ValueError, match=words):
            case.block.decode(bytes(block))
    with pytest.raises(ValueError, match=f"{case.size} registers, got 4"):
        case.block.decode(bytes(8))


@EACH
@pytest.mark.parametrize("function", [3, 4])
def test_clients_read_all_of_it_or_a_part(name: str, function: int) -> None:
    case, responder, made = CASES[name], Responder(), list[Any]()

    def encoder(block: Any) -> Any:
        return lambda: made.append(block) or block.encode(case.example)

    def ask(address: int, count: int) -> bytes:
        return responder.answer(struct.pack(">HHHBBHH", 7, 0, 6, 1, function, address, count))

    block, (at, count) = case.block.encode(case.example), case.part
    shown = BLOCKS[: BLOCKS.index(case.block) + 1]
    mirror = registers.encode_mirror(case.example)
    responder.show(registers.encode_block(case.example), lambda: mirror, *map(encoder, shown))
    assert ask(0, 64)[9:] == registers.encode_block(case.example)
    assert not made, "a block is encoded when a client reads it"
    assert ask(case.address, case.size)[9:] == block
    assert ask(at, count)[9:] == block[2 * (at - case.address) : 2 * (at - case.address + count)]
    assert made == [case.block], "once a snapshot, however often it is read"
    for address, registers_asked in case.refused:
        assert ask(address, registers_asked)[7:] == bytes([function | 0x80, 2])


@EACH
def test_the_pages_name_each_place(name: str) -> None:
    case, modbus, udp = CASES[name], document.modbus_page(), document.udp_page()
    for offset, point in zip(case.block.offsets, case.block.points, strict=True):
        if not point.name.startswith(("link_", "dimmed_")) or point.name.startswith(("link_1_", "dimmed_1_")):
            assert f"| {case.address + 2 + offset} | `{point.name}` | {point.wire.name} |" in modbus
    if case.tail:
        for offset, point in zip(case.tail[0].offsets, case.tail[0].points, strict=True):
            assert f"| {case.tail[1] + 2 * offset} | `{point.name}` | {point.wire.name} |" in udp


def test_the_page_places_all_links() -> None:
    names = [point.name for point in lights_block.BLOCK.points]
    assert lights_block.BLOCK.offsets[names.index("link_3_code")] == 222 - 202 + 12
    assert "begins at 222 + 6 (k - 1)" in document.modbus_page()


def test_the_page_places_all_dimmed_lamps() -> None:
    names = [point.name for point in dimmed_block.BLOCK.points]
    assert dimmed_block.BLOCK.offsets[names.index("dimmed_3_frequency")] == 444 - 442 + 12
    assert "Lamp k of 3 begins at 444 + 6 (k - 1)" in document.modbus_page()
