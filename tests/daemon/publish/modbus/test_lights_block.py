"""The block of lights and the end of the datagram: places, units, what is not known, and the frozen contract."""

from __future__ import annotations

import json
import math
import struct
import zlib
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from daemon.publish import document
from daemon.publish.modbus import lights_block, registers
from daemon.publish.modbus.points import Layout
from daemon.publish.modbus.requests import Responder
from daemon.snapshot import LightFix, LightLink, LightPicture, LinkUse, Snapshot
from estimator.result import Fix, LinkState
from tests.daemon.publish.modbus.test_registers import snapshot

FROZEN = Path(__file__).parent / "frozen" / f"lights_v{lights_block.BLOCK.version}.json"

LINKS = (
    LightLink(17, 1017, LinkUse.ACCEPTED, 1.25e-6, -0.031),
    LightLink(60, None, LinkUse.TWIN, 0.5e-6),
    LightLink(101, 65_000, LinkUse.OCCLUDED, 3.1e-9, -4.0),
)


def picture(**changes: Any) -> LightPicture:
    plain: dict[str, Any] = {
        "fix": LightFix.GOOD,
        "used": 5,
        "t_mono": 1234.475,
        "pose": (-1.2345, 7.25, 3.5),
        "sigma": (0.02101, 0.03, 0.01),
        "floor": 0.0153,
        "clock_ppm": -2750.4,
        "blocks": 70_001,
        "blocks_lost": 3,
        "links": LINKS,
    }
    return LightPicture(**(plain | changes))


def test_every_state_of_the_estimator_has_a_number() -> None:
    assert {fix.name for fix in Fix} == set(LightFix.__members__)
    assert {state.name for state in LinkState} == set(LinkUse.__members__) - {"OTHER"}


def test_block_by_hand() -> None:
    """Bytes at places written down here, not taken from the table."""
    words = struct.unpack(">120H", lights_block.BLOCK.encode(snapshot(light=picture())))
    assert words[:4] == (0x4C49, 1, 1, 70_000 - 65_536)
    assert words[4:6] == (2, 5)
    assert struct.unpack(">iii", struct.pack(">6H", *words[6:12])) == (-12_345, 72_500, round(1e6 * (3.5 - math.tau)))
    assert words[12:17] == (211, 300, 100, 500, 153)
    assert words[17] == 65_536 - 2750
    assert words[18:22] == (1, 4465, 0, 3)
    assert words[22:28] == (17, 1017, 1, 1_250_000 >> 16, 1_250_000 & 0xFFFF, 65_536 - 310)
    assert words[28:34] == (60, 0xFFFF, 6, 500_000 >> 16, 500_000 & 0xFFFF, 0x8000)
    assert words[34:40] == (101, 65_000, 2, 0, 3100, 65_536 - 32_767), "a residual beyond the range saturates"
    assert set(words[40:118:6]) == {0xFFFF}, "no further link"
    assert words[118:] == words[2:4]


def test_a_reader_gets_values_in_si_units() -> None:
    reading = lights_block.BLOCK.decode(lights_block.BLOCK.encode(snapshot(light=picture())))
    assert (reading["light_fix"], reading["light_used"], reading["seq"]) == (2, 5, 70_000)
    assert reading["light_x"] == -1.2345
    assert reading["light_age"] == pytest.approx(0.05)
    assert reading["sample_clock"] == -2750
    assert reading["link_1_strength"] == pytest.approx(1.25e-6)
    assert reading["link_1_residual"] == -0.031
    assert reading["link_2_lamp"] is None
    assert reading["link_4_code"] is None


@pytest.mark.parametrize("light", [None, LightPicture()])
def test_what_is_not_known_says_so(light: LightPicture | None) -> None:
    reading = lights_block.BLOCK.decode(lights_block.BLOCK.encode(snapshot(light=light)))
    counted = {"seq": 70_000, "blocks": 0, "blocks_lost": 0}
    known = {name: value for name, value in reading.items() if value is not None and name not in counted}
    assert known == ({} if light is None else {"light_fix": 0, "light_used": 0})
    assert {name: reading[name] for name in counted} == counted


def test_only_the_strongest_sixteen_are_shown() -> None:
    many = tuple(LightLink(code, code, LinkUse.ACCEPTED, 1e-6 / (code + 1)) for code in range(40))
    reading = lights_block.BLOCK.decode(lights_block.BLOCK.encode(snapshot(light=picture(links=many))))
    assert [reading[f"link_{row}_code"] for row in range(1, 17)] == list(range(16))


@pytest.mark.parametrize(
    ("at", "word", "words"), [(0, 0x4C4C, "magic"), (1, 2, "version 2"), (3, 1, "torn"), (119, 1, "torn")]
)
def test_a_block_that_is_not_ours_is_refused(at: int, word: int, words: str) -> None:
    block = bytearray(lights_block.BLOCK.encode(snapshot(light=picture())))
    block[2 * at : 2 * at + 2] = word.to_bytes(2, "big")
    with pytest.raises(ValueError, match=words):
        lights_block.BLOCK.decode(bytes(block))


def test_the_wrong_size_is_refused() -> None:
    with pytest.raises(ValueError, match="120 registers, got 64"):
        lights_block.BLOCK.decode(bytes(128))


def test_the_end_of_the_datagram_by_hand() -> None:
    data = registers.encode_datagram(snapshot(light=picture()))
    assert len(data) == 172
    assert struct.unpack_from("<HHiii", data, 128) == (2, 5, -12_345, 72_500, round(1e6 * (3.5 - math.tau)))
    assert struct.unpack_from("<4H", data, 144) == (211, 300, 100, 500)
    assert registers.decode_datagram(data)["light_y"] == 7.25


def test_a_datagram_of_a_program_that_knew_no_lights_is_read() -> None:
    data = registers.encode_datagram(snapshot(light=picture()))
    shorter = data[:6] + struct.pack("<H", 132) + data[8:128]
    shorter += struct.pack("<I", zlib.crc32(shorter))
    reading = registers.decode_datagram(shorter)
    assert reading["map_x"] == 1.2345
    assert "light_x" not in reading


def ask(responder: Responder, address: int, count: int, function: int = 4) -> bytes:
    return responder.answer(struct.pack(">HHHBBHH", 7, 0, 6, 1, function, address, count))


@pytest.mark.parametrize("function", [3, 4])
def test_clients_read_all_of_it_or_a_part(function: int) -> None:
    responder, taken = Responder(), snapshot(light=picture())
    made: list[Snapshot] = []

    def make() -> bytes:
        made.append(taken)
        return lights_block.BLOCK.encode(taken)

    responder.show(registers.encode_block(taken), partial(registers.encode_mirror, taken), make)
    assert ask(responder, 0, 64, function)[9:] == registers.encode_block(taken)
    assert not made, "nobody has asked for the lights"
    assert ask(responder, 200, 120, function)[9:] == lights_block.BLOCK.encode(taken)
    assert ask(responder, 222, 6, function)[9:] == lights_block.BLOCK.encode(taken)[44:56]
    assert len(made) == 1, "made once a snapshot, however often it is read"
    for address, count in ((199, 2), (200, 121), (320, 1), (319, 2)):
        assert ask(responder, address, count, function)[7:] == bytes([function | 0x80, 2])


def layout(points: Layout) -> list[dict[str, Any]]:
    return [
        {
            "name": p.name, "offset": offset, "type": p.wire.name, "per_unit": p.per_unit, "unit": p.unit,
            "rule": p.rule.value, "not_known": p.wire.not_known if p.can_be_unknown else None,
        }
        for offset, p in zip(points.offsets, points.points, strict=True)
    ]  # fmt: skip


def contract() -> dict[str, Any]:
    return {
        "version": lights_block.BLOCK.version,
        "magic": lights_block.BLOCK.magic,
        "address": lights_block.BLOCK.address,
        "registers": lights_block.BLOCK.registers,
        "datagram_from": registers.TAIL_OFFSET,
        "block": layout(lights_block.BLOCK),
        "tail": layout(lights_block.TAIL),
        "fixes": {fix.name: fix.value for fix in LightFix},
        "uses": {use.name: use.value for use in LinkUse},
    }


def test_the_contract_is_the_frozen_one() -> None:
    """A published layout is never edited: fixes and uses may be appended, anything else needs a new version."""
    frozen, now = json.loads(FROZEN.read_text()), contract()
    for key in ("fixes", "uses"):
        before = frozen.pop(key)
        assert {name: now[key].get(name) for name in before} == before
        now.pop(key)
    assert now == frozen


def test_the_pages_say_where_everything_is() -> None:
    modbus, udp = document.modbus_page(), document.udp_page()
    for offset, point in zip(lights_block.BLOCK.offsets, lights_block.BLOCK.points, strict=True):
        if not point.name.startswith("link_") or point.name.startswith("link_1_"):
            assert f"| {202 + offset} | `{point.name}` | {point.wire.name} |" in modbus
    assert (
        lights_block.BLOCK.offsets[
            lights_block.BLOCK.points.index(next(p for p in lights_block.BLOCK.points if p.name == "link_3_code"))
        ]
        == 222 - 202 + 12
    )
    assert "begins at 222 + 6 (k - 1)" in modbus
    for offset, point in zip(lights_block.TAIL.offsets, lights_block.TAIL.points, strict=True):
        assert f"| {128 + 2 * offset} | `{point.name}` | {point.wire.name} |" in udp
