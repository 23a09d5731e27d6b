"""The table: round trips, saturation, not-known values, frames, and the frozen contract."""

import math
import struct
import zlib
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.publish.modbus import integrity_block, lights_block, registers
from daemon.publish.modbus.points import I16, U16, U32, U64, Point, Rule
from daemon.snapshot import LightFix, LightLink, LightPicture, LinkUse, Snapshot, State, Trust

any_float = st.floats(allow_nan=True, allow_infinity=True)
triple = st.none() | st.tuples(any_float, any_float, any_float)
count = st.integers(0, 2**70)
maybe_bool = st.none() | st.booleans()
snapshots = st.builds(
    Snapshot,
    seq=count,
    t_mono=any_float,
    t_sent=any_float,
    t_utc=any_float,
    state=st.sampled_from(State),
    reason=count,
    pose=triple,
    odom=triple,
    predicted=triple,
    covariance=st.none() | st.tuples(*[any_float] * 6),
    velocity=triple,
    known=st.tuples(st.booleans(), st.booleans(), st.booleans()),
    jumps=count,
    map_id=count,
    loop_counter=count,
    loop_new=st.none() | count,
    loop_old=st.none() | count,
    links=st.none() | count,
    light_id=st.none() | count,
    scan_rate=st.none() | any_float,
    missed=count,
    overruns=count,
    cycle_us=st.none() | count,
    lidar_ok=maybe_bool,
    adc_ok=maybe_bool,
    odometry_ok=maybe_bool,
    fault=count,
    loop_reason=st.none() | count,
    loop_residual=st.none() | any_float,
    trust=st.builds(
        Trust,
        horizontal_m=st.none() | any_float,
        yaw_rad=st.none() | any_float,
        limit_m=st.none() | any_float,
        alert=st.booleans(),
        laser=st.booleans(),
        light=st.booleans(),
        wheels=st.booleans(),
        gap=st.none() | any_float,
        places=st.none() | count,
    ),
    light=st.none()
    | st.builds(
        LightPicture,
        fix=st.sampled_from(LightFix),
        used=count,
        t_mono=st.none() | any_float,
        pose=triple,
        sigma=triple,
        floor=st.none() | any_float,
        clock_ppm=st.none() | any_float,
        blocks=count,
        blocks_lost=count,
        links=st.lists(
            st.builds(
                LightLink,
                code=count,
                lamp_id=st.none() | count,
                use=st.sampled_from(LinkUse),
                strength=any_float,
                residual=st.none() | any_float,
            ),
            max_size=3,
        ).map(tuple),
    ),
)


def snapshot(**changes: Any) -> Snapshot:
    """A plain snapshot in which every value differs from its neighbours."""
    plain: dict[str, Any] = {
        "seq": 70_000,
        "t_mono": 1234.5,
        "t_sent": 1234.525,
        "t_utc": 1_700_000_000.25,
        "state": State.TRACKING,
        "reason": 7,
        "pose": (1.2345, -2.3456, 3.0),
        "odom": (10.0001, 20.0002, -3.0),
        "predicted": (1.2445, -2.3556, 3.01),
        "covariance": (4e-4, 1e-4, 1e-4, -2e-5, 1e-5, 1e-4),
        "velocity": (0.5, -0.01, -0.25),
        "known": (True, False, True),
        "jumps": 3,
        "map_id": 0xDEADBEEF,
        "loop_counter": 2,
        "loop_new": 70_001,
        "loop_old": 12,
        "links": 4,
        "light_id": 77,
        "scan_rate": 39.92,
        "missed": 100_000,
        "overruns": 5,
        "cycle_us": 2500,
        "lidar_ok": True,
        "adc_ok": None,
        "odometry_ok": False,
        "fault": 9,
    }
    return Snapshot(**(plain | changes))


def test_sizes_are_those_promised() -> None:
    assert registers.BLOCK_WORDS <= 64
    assert registers.DATAGRAM_SIZE <= 256
    assert len(registers.encode_block(snapshot())) == 2 * registers.BLOCK_WORDS
    assert len(registers.encode_datagram(snapshot())) == registers.DATAGRAM_SIZE
    assert len(registers.encode_mirror(snapshot())) == 2 * registers.MIRROR_WORDS
    assert len(lights_block.BLOCK.encode(snapshot())) == 2 * lights_block.BLOCK.registers
    assert lights_block.BLOCK.registers <= 125, "the lights must be readable in one request"
    assert lights_block.BLOCK.address + lights_block.BLOCK.registers <= integrity_block.BLOCK.address
    assert len(integrity_block.BLOCK.encode(snapshot())) == 2 * integrity_block.BLOCK.registers
    assert lights_block.BLOCK.address >= registers.MIRROR_ADDRESS + registers.MIRROR_WORDS
    assert registers.BLOCK_WORDS <= registers.MIRROR_ADDRESS
    assert registers.MIRROR_WORDS <= 125, "the mirror must be readable in one request"


def test_wide_points_are_aligned_in_the_datagram() -> None:
    for offset, point in zip(registers.BODY.offsets, registers.BODY.points, strict=True):
        assert (registers.BODY_OFFSET + 2 * offset) % (point.wire.bits // 8) == 0, point.name
    for begin, tail in ((registers.TAIL_OFFSET, lights_block.TAIL), (registers.TRUST_OFFSET, integrity_block.TAIL)):
        for offset, point in zip(tail.offsets, tail.points, strict=True):
            assert (begin + 2 * offset) % (point.wire.bits // 8) == 0, point.name
    assert registers.DATAGRAM_SIZE % 4 == 0, "and so is the CRC"


def test_names_are_unique() -> None:
    sent = registers.BODY.points + lights_block.TAIL.points + integrity_block.TAIL.points
    for points in (sent, registers.MIRROR, lights_block.BLOCK.points, integrity_block.BLOCK.points):
        names = [p.name for p in points]
        assert len(set(names)) == len(names)


def test_block_by_hand() -> None:
    """Bytes at places written down here, not taken from the table."""
    block = registers.encode_block(snapshot())
    words = struct.unpack(">64H", block)
    assert words[0:4] == (0x4C4C, 1, 1, 70_000 - 65_536)
    assert words[4:7] == (3, 7, 9)
    assert words[7] == 0b110111
    assert words[8] == 12_345
    assert words[9] == 250
    assert struct.unpack_from(">Q", block, 20) == (1_234_500_000,)
    assert struct.unpack_from(">Q", block, 28) == (1_700_000_000_250_000,)
    assert struct.unpack_from(">9i", block, 36) == (
        12345, -23456, 3_000_000, 12445, -23556, 3_010_000, 100_001, 200_002, -3_000_000,
    )  # fmt: skip
    assert struct.unpack_from(">3H3h3h", block, 72) == (200, 100, 100, 5000, -1000, 1000, 500, -10, -250)
    assert words[45] == 3
    assert struct.unpack_from(">3I", block, 92) == (0xDEADBEEF, 70_001, 12)
    assert words[52:56] == (2, 4, 77, 3992)
    assert struct.unpack_from(">2I", block, 112) == (100_000, 5)
    assert words[60:64] == (250, 0b010011, 1, 70_000 - 65_536)


def test_datagram_by_hand() -> None:
    data = registers.encode_datagram(snapshot())
    assert data[:8] == b"LUMI\x01\x00\xac\x00"
    assert struct.unpack_from("<IHH", data, 8) == (70_000, 3, 7)
    assert struct.unpack_from("<3i", data, 40) == (12345, -23456, 3_000_000)
    assert struct.unpack_from("<I", data, 168) == (zlib.crc32(data[:168]),)


def test_what_is_not_known_says_so() -> None:
    empty = Snapshot(seq=0, t_mono=0.0, t_sent=0.0, t_utc=0.0, state=State.STARTING, reason=0)
    values = registers.decode_block(registers.encode_block(empty))
    unknown = {name for name, value in values.items() if value is None}
    assert unknown == {
        *(f"{frame}_{axis}" for frame in ("map", "predicted", "odom") for axis in ("x", "y", "yaw")),
        *("sigma_x", "sigma_y", "sigma_yaw", "rho_x_y", "rho_x_yaw", "rho_y_yaw", "v_x", "v_y", "yaw_rate"),
        *("loop_new", "loop_old", "links", "light_id", "scan_rate", "cycle"),
    }
    mirror = registers.decode_mirror(registers.encode_mirror(empty))
    assert {name for name, value in mirror.items() if value is not None} == {"seq", "age"}
    assert struct.unpack_from(">i", registers.encode_block(empty), 36) == (-(2**31),)


@given(snapshots)
def test_no_snapshot_breaks_an_encoder(taken: Snapshot) -> None:
    block = registers.decode_block(registers.encode_block(taken))
    datagram = registers.decode_datagram(registers.encode_datagram(taken))
    assert block == {name: datagram[name] for name in block}
    seen = lights_block.BLOCK.decode(lights_block.BLOCK.encode(taken))
    assert {p.name: seen[p.name] for p in lights_block.TAIL.points} == {
        p.name: datagram[p.name] for p in lights_block.TAIL.points
    }
    assert all(value is None or math.isfinite(value) for value in seen.values())
    trusted = integrity_block.BLOCK.decode(integrity_block.BLOCK.encode(taken))
    assert {p.name: trusted[p.name] for p in integrity_block.POINTS} == {
        p.name: datagram[p.name] for p in integrity_block.POINTS
    }
    assert all(value is None or math.isfinite(value) for value in trusted.values())
    mirror = registers.decode_mirror(registers.encode_mirror(taken))
    assert all(value is None or math.isfinite(value) for value in mirror.values())


def expected(point: Point, value: float | None) -> Any:
    if value is None or math.isnan(value):
        return None if point.can_be_unknown else 0
    if point.rule is Rule.WRAP:
        return value % 2**point.wire.bits
    low, high = point.wire.span
    return max(low / point.per_unit, min(high / point.per_unit, value))


@given(snapshots)
def test_round_trip_keeps_every_value_to_its_step(taken: Snapshot) -> None:
    """Each decoded value is the snapshot's own, to half a step (sigma: never smaller, less than a step larger)."""
    decoded = registers.decode_block(registers.encode_block(taken))
    for point in registers.BODY.points:
        want, got = expected(point, point.value(taken)), decoded[point.name]
        if want is None or point.per_unit == 1:
            assert got == want, point.name
        else:
            assert got is not None
            step, slack = 1.0 / point.per_unit, 4e-16 * abs(want)
            if point.ceil:
                assert -slack <= got - want <= step + slack, point.name
            else:
                assert abs(got - want) <= step / 2 + slack, point.name


@given(st.sampled_from([I16, U16, U32, U64]), st.floats(allow_nan=False) | st.integers(-(2**70), 2**70))
def test_saturation_never_wraps_and_never_reads_as_not_known(wire: Any, value: float) -> None:
    point = Point("p", "p", wire, lambda s: None, "", per_unit=10)
    got = point.decode(point.encode(value))
    assert got is not None
    low, high = wire.span
    assert low / 10 <= got <= high / 10
    if value >= high / 10:
        assert got == high / 10
    if value <= low / 10:
        assert got == low / 10


TURNS = [(math.pi + 0.1, -math.pi + 0.1), (-7.0, -7.0 + math.tau), (50.0, 50.0 - 8 * math.tau)]


@pytest.mark.parametrize(("yaw", "wrapped"), TURNS)
def test_headings_are_wrapped(yaw: float, wrapped: float) -> None:
    values = registers.decode_block(registers.encode_block(snapshot(pose=(0.0, 0.0, yaw), odom=(0.0, 0.0, yaw))))
    assert values["map_yaw"] == pytest.approx(wrapped, abs=1e-6)
    assert values["odom_yaw"] == pytest.approx(wrapped, abs=1e-6)


def test_mirror_has_the_full_covariance() -> None:
    mirror = registers.decode_mirror(registers.encode_mirror(snapshot()))
    names = [f"cov_{n}" for n in ("xx", "xy", "yy", "x_yaw", "y_yaw", "yaw_yaw")]
    assert [mirror[n] for n in names] == pytest.approx([4e-4, 1e-4, 1e-4, -2e-5, 1e-5, 1e-4], rel=1e-6)
    assert mirror["map_x"] == pytest.approx(1.2345, rel=1e-6)


def test_infinite_covariance_saturates_and_has_no_correlation() -> None:
    inf = math.inf
    values = registers.decode_block(registers.encode_block(snapshot(covariance=(inf, 0.0, 1e-4, 0.0, 0.0, 0.0))))
    assert values["sigma_x"] == 6.5534
    assert values["rho_x_y"] is None
    assert values["rho_y_yaw"] == 0.0


def damaged(data: bytes) -> list[bytes]:
    return [bytes([*data[:i], data[i] ^ 1 << bit, *data[i + 1 :]]) for i in range(len(data)) for bit in range(8)]


def test_datagram_notices_every_single_bit() -> None:
    for data in damaged(registers.encode_datagram(snapshot())):
        with pytest.raises(ValueError, match="datagram"):
            registers.decode_datagram(data)


@pytest.mark.parametrize("size", [0, 3, 4, 8, 131])
def test_short_datagrams_are_refused(size: int) -> None:
    with pytest.raises(ValueError, match="not a lumiloop"):
        registers.decode_datagram(registers.encode_datagram(snapshot())[:size])


def test_a_longer_datagram_of_this_version_is_read() -> None:
    """Readers go by `length`: what a later minor revision appends does not break them."""
    data = registers.encode_datagram(snapshot())
    longer = data[:6] + struct.pack("<H", len(data) + 8) + data[8:-4] + b"NEWPOINT"
    longer += struct.pack("<I", zlib.crc32(longer))
    assert registers.decode_datagram(longer) == registers.decode_datagram(data)


@pytest.mark.parametrize(
    ("at", "word", "words"), [(0, 0, "magic"), (1, 2, "version 2"), (3, 1, "torn block"), (63, 1, "torn block")]
)
def test_a_block_that_is_not_ours_is_refused(at: int, word: int, words: str) -> None:
    block = bytearray(registers.encode_block(snapshot()))
    block[2 * at : 2 * at + 2] = word.to_bytes(2, "big")
    with pytest.raises(ValueError, match=words):
        registers.decode_block(bytes(block))


def test_a_torn_mirror_is_refused() -> None:
    mirror = registers.encode_mirror(snapshot())
    with pytest.raises(ValueError, match="torn mirror"):
        registers.decode_mirror(mirror[:-1] + b"\x00")


def test_wrong_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="64 registers, got 63"):
        registers.decode_block(bytes(126))
    with pytest.raises(ValueError, match="registers, got 2"):
        registers.decode_mirror(bytes(4))
