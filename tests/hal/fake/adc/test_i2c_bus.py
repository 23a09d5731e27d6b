"""The fake bus: time on the wire, adapters with their limits, and what each fault does there."""

import errno
import itertools

import numpy as np
import pytest

from hal.bus.i2c import Message, Transferred, read, write
from hal.fake.adc.converter import FakeAdc
from hal.fake.adc.faults import ADC
from hal.fake.adc.i2c_adapters import BCM2835, CP2112, DESIGNWARE, FT260, I2C_GPIO, Adapter
from hal.fake.faults.orders import FaultError, read_fault

BLOCK = (read(0x4D, 1000),)
QUIET = Adapter("quiet", jitter_s=0.0, nack=errno.ENXIO)


class Now:
    """A clock that stands where it is put."""

    t = 100.0

    def now(self) -> float:
        return self.t

    def utc(self) -> float:
        return 0.0


def adc(adapter: Adapter = QUIET, chip: str = "MCP3221", seed: int = 0) -> FakeAdc:
    return FakeAdc(lambda t: 0.5 + 0.4 * np.sin(500.0 * t), Now(), chip=chip, adapter=adapter, seed=seed)


def order(device: FakeAdc, **table: object) -> None:
    device.begin(read_fault(table, "order", {"adc": ADC}))


def words(done: Transferred) -> np.ndarray:  # type: ignore[type-arg]  # of big-endian words
    return np.frombuffer(done.reads[0][: len(done.reads[0]) // 2 * 2], ">u2").astype(int)


def code_of(device: FakeAdc, messages: tuple[Message, ...] = BLOCK) -> int:
    try:
        device.bus.transfer(messages)
    except OSError as error:
        return error.errno or -1
    return 0


def test_joined_messages_take_a_start_and_an_address_each() -> None:
    device = adc()
    device.add_level(lambda t: t)
    done = device.bus.transfer((write(0x48, b"\x01"), read(0x48, 2)))
    assert done.reads == (b"\x85\x83",)
    assert done.t1 - done.t0 == pytest.approx((19 + 28) / 400e3 + QUIET.start_s + QUIET.end_s)


def test_transactions_do_not_overlap() -> None:
    device = adc()
    first, second = device.bus.begin(BLOCK), device.bus.begin(BLOCK)
    assert second.t_end - first.t_end == pytest.approx(9010 / 400e3 + QUIET.start_s)


def test_who_is_not_there_does_not_acknowledge() -> None:
    assert code_of(adc(), (read(0x4C, 2),)) == errno.ENXIO
    assert code_of(adc(BCM2835), (read(0x4C, 2),)) == errno.EREMOTEIO
    assert code_of(adc(FT260), (read(0x4C, 2),)) == errno.EIO
    assert code_of(adc(), (write(0x4D, b"\x01"),)) == errno.ENXIO  # an MCP3221 takes no data


@pytest.mark.parametrize(
    ("adapter", "messages", "code"),
    [
        (BCM2835, (read(0x4D, 2), read(0x4D, 2)), errno.EOPNOTSUPP),
        (BCM2835, (read(0x4D, 2), write(0x48, b"x")), errno.EOPNOTSUPP),
        (DESIGNWARE, (read(0x4D, 2), read(0x4D, 2)), 0),
        (CP2112, (read(0x4D, 513),), errno.EOPNOTSUPP),
        (CP2112, (read(0x4D, 512),), 0),
        (CP2112, (read(0x4D, 2),) * 3, errno.EOPNOTSUPP),
        (DESIGNWARE, (read(0x4D, 8193),), errno.EINVAL),
        (DESIGNWARE, (read(0x4D, 2),) * 43, errno.EINVAL),
        (DESIGNWARE, (), errno.EINVAL),
    ],
)
def test_adapters_have_limits(adapter: Adapter, messages: tuple[Message, ...], code: int) -> None:
    assert code_of(adc(adapter), messages) == code


def test_a_slow_bus_runs_into_the_time_out_and_is_lame_once() -> None:
    device = adc(Adapter("old", scl_hz=100e3, timeout_s=0.15, fails_after_timeout=True))
    begun = device.bus.begin((read(0x4D, 2000),))
    assert begun.code == errno.ETIMEDOUT
    assert begun.t_end - begun.t0 == pytest.approx(0.15, abs=1e-3)
    assert code_of(device, (read(0x4D, 2),)) == errno.ETIMEDOUT
    assert code_of(device, (read(0x4D, 2),)) == 0


@pytest.mark.parametrize("adapter", [FT260, I2C_GPIO], ids=["FT260", "i2c-gpio"])
def test_bridges_and_bit_banging_stretch(adapter: Adapter) -> None:
    done = adc(adapter).bus.transfer(BLOCK)
    plain = 9010 / adapter.scl_hz + adapter.start_s + adapter.end_s
    assert done.t1 - done.t0 > plain + 1e-4


@pytest.mark.parametrize(
    ("table", "code"),
    [
        ({"what": "off"}, errno.ENXIO),
        ({"what": "nack"}, errno.ENXIO),
        ({"what": "intermittent", "share": 1.0}, errno.ENXIO),
        ({"what": "timeout"}, errno.ETIMEDOUT),
        ({"what": "hang"}, errno.ETIMEDOUT),
        ({"what": "arbitration"}, errno.EAGAIN),
        ({"what": "gone"}, errno.ENODEV),
        ({"what": "moved"}, errno.ENXIO),
        ({"what": "error", "name": "EPROTO"}, errno.EPROTO),
    ],
)
def test_faults_that_fail_a_block(table: dict[str, object], code: int) -> None:
    device = adc()
    order(device, **table)
    assert code_of(device) == code
    for fault in device.in_force():
        device.end(fault)
    assert code_of(device) == 0


def test_faults_of_blocks_leave_short_reads_alone() -> None:
    device = adc()
    order(device, what="nack")
    assert code_of(device, (read(0x4D, 2),)) == 0
    order(device, what="nack", on="all")
    assert code_of(device, (read(0x4D, 2),)) == errno.ENXIO


def test_a_chip_that_has_moved_answers_there() -> None:
    device = adc()
    order(device, what="moved", address=0x4F)
    assert code_of(device, (read(0x4F, 2),)) == 0


@pytest.mark.parametrize(
    ("table", "longer"),
    [
        ({"what": "stall", "us": 200.0}, 200e-6),
        ({"what": "stall", "us": 200.0, "pieces": 5}, 1e-3),
        ({"what": "busy", "by_s": 0.01}, 0.01),
        ({"what": "late", "by_s": 0.01}, 0.01),
        ({"what": "delayed", "by_s": 0.25}, 0.25),
        ({"what": "scl", "percent": -1.0}, 9010 / 396e3 - 9010 / 400e3),
        ({"what": "slow", "factor": 2.0}, 9010 / 400e3),
    ],
)
def test_faults_of_time(table: dict[str, object], longer: float) -> None:
    plain, device = adc().bus.transfer(BLOCK), adc()
    order(device, **table)
    done = device.bus.transfer(BLOCK)
    assert done.t1 - plain.t1 == pytest.approx(longer, abs=1e-9)


def test_a_stall_shifts_the_samples_after_it() -> None:
    plain, device = words(adc().bus.transfer(BLOCK)), adc()
    order(device, what="stall", us=300.0, at=0.5)
    stalled = words(device.bus.transfer(BLOCK))
    differing = np.flatnonzero(plain != stalled)
    assert 248 <= differing[0] <= 252
    assert differing.size > 200


def test_faults_of_bytes() -> None:
    plain = adc().bus.transfer(BLOCK).reads[0]
    damaged = {}
    for what in ("stuck", "garbage", "wrong", "short", "released", "floats", "shift"):
        device = adc()
        order(device, what=what)
        damaged[what] = device.bus.transfer(BLOCK).reads[0]
    assert damaged["stuck"] == plain[:2] * 500
    assert len(damaged["garbage"]) == 1000
    assert damaged["garbage"] != plain
    assert damaged["wrong"] == b"".join(
        min(int.from_bytes(plain[k : k + 2], "big") + 100, 4095).to_bytes(2, "big") for k in range(0, 1000, 2)
    )
    assert damaged["short"] == plain[:900]
    assert damaged["released"] == plain[:500] + b"\xff" * 500
    assert damaged["floats"] == b"\xff" * 1000
    assert damaged["shift"] == ((int.from_bytes(plain, "big") << 1 | 1) % (1 << 8000)).to_bytes(1000, "big")


@pytest.mark.parametrize(("what", "level"), [("dark", 0), ("saturated", round(3.3 / 4.096 * 32768))])
def test_dark_and_dazzled_differ_in_the_dc_channel_only(what: str, level: int) -> None:
    device = adc()
    device.add_level(lambda t: np.full_like(t, 0.3))
    device.bus.transfer((write(0x48, b"\x01\x42\x83"),))
    order(device, what=what)
    found = words(device.bus.transfer(BLOCK))
    assert abs(found.mean() - 2047.5) < 0.2
    assert 0.3 < found.std() < 0.7  # the electronics' own noise
    device._clock.t += 1.0  # type: ignore[attr-defined]  # the clock of this test
    (answer,) = device.bus.transfer((write(0x48, b"\x00"), read(0x48, 2))).reads
    assert int.from_bytes(answer, "big") == level


def test_clip() -> None:
    device = adc()
    order(device, what="clip")
    found = words(device.bus.transfer(BLOCK))
    assert np.mean((found == 16) | (found == 4079)) > 0.8  # as far as the amplifier gets


@pytest.mark.parametrize(
    ("table", "says"),
    [
        ({"what": "dc_off"}, "no DC channel"),
        ({"what": "foreign"}, "no DC channel"),
        ({"what": "moved", "address": 0x4D}, "another device has this address already"),
    ],
)
def test_orders_that_make_no_sense(table: dict[str, object], says: str) -> None:
    device = adc()
    with pytest.raises(FaultError, match=says):
        device.check(read_fault(table, "order", {"adc": ADC}))


def test_two_runs_are_the_same() -> None:
    def run() -> list[object]:
        device = adc(BCM2835, seed=7)
        order(device, what="stall", us=50.0, share=0.5)
        order(device, what="garbage", share=0.3)
        return [device.bus.transfer(BLOCK) for _ in itertools.repeat(None, 20)]

    assert run() == run()
