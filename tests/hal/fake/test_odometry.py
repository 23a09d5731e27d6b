"""The fake motor controller: its datagrams are those of docs/udp.md, and each order does what its word says."""

import asyncio
import math

import pytest

from hal.clock import run_virtual
from hal.fake.faults.orders import FaultError
from hal.fake.faults.schedule import FaultSchedule
from hal.fake.odometry import ODOMETRY, FakeOdometry
from hal.net.input_codec import InputDatagram, decode

HZ, SPEED = 50.0, 0.5


def source(t: float) -> tuple[float, tuple[float, float, float]]:
    """Half a metre a second along x since t = 0, turning a little."""
    k = math.floor(t * HZ + 1e-6) + 1
    return k / HZ, (SPEED * k / HZ, 0.0, 0.0)


def heard(order: str = "", seconds: float = 4.0) -> list[tuple[float, InputDatagram | None]]:
    """Arrivals of a run in which an order is given after one second; None for what is no datagram."""
    got: list[tuple[float, InputDatagram | None]] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()

        def take(data: bytes) -> None:
            try:
                got.append((loop.time(), decode(data)))
            except Exception:  # noqa: BLE001  # whatever it is, it is no datagram
                assert len(data) == 60
                got.append((loop.time(), None))

        device = FakeOdometry(source, take)
        faults = FaultSchedule({"odometry": device})
        if order:
            faults.load(f"[[fault]]\nwhen = 1.0\n{order.replace('; ', chr(10))}")
        running = asyncio.create_task(device.run())
        await asyncio.sleep(seconds)
        running.cancel()
        faults.close()

    run_virtual(main())
    return got


def between(got: list[tuple[float, InputDatagram | None]], a: float, b: float) -> list[InputDatagram]:
    return [datagram for t, datagram in got if a <= t < b and datagram is not None]


def test_what_it_sends_is_what_the_codec_knows() -> None:
    got = heard()
    assert len(got) == pytest.approx(4.0 * HZ, abs=2)
    for t, datagram in got:
        assert datagram is not None
        assert (datagram.time, datagram.session) == (pytest.approx(t), 1)
    first, last = between(got, 0.0, 0.1)[0], between(got, 3.9, 4.1)[-1]
    assert last.values[0] - first.values[0] == pytest.approx(SPEED * (last.time - first.time))
    assert last.seq - first.seq == len(got) - 1


def test_off_is_silence_and_then_another_session_from_zero() -> None:
    got = heard("what = 'off'; for = 1.0")
    assert between(got, 1.05, 1.95) == []
    after = between(got, 2.0, 3.0)[0]
    assert (after.session, after.seq) == (2, 0)
    assert after.values[0] == pytest.approx(0.0, abs=0.02)


def test_stuck_repeats_a_pose_and_then_has_caught_up() -> None:
    got = heard("what = 'stuck'; for = 1.0")
    during = between(got, 1.05, 1.95)
    assert len({datagram.values for datagram in during}) == 1
    assert len({datagram.seq for datagram in during}) == len(during)
    assert between(got, 3.9, 4.1)[-1].values[0] == pytest.approx(SPEED * 4.0, abs=0.03)


def test_blocked_counters_lose_the_way() -> None:
    got = heard("what = 'blocked'; for = 1.0")
    assert between(got, 3.9, 4.1)[-1].values[0] == pytest.approx(SPEED * 3.0, abs=0.05)


def test_wrong_stretches_the_way() -> None:
    got = heard("what = 'wrong'; factor = 2.0; for = 1.0")
    assert between(got, 3.9, 4.1)[-1].values[0] == pytest.approx(SPEED * 5.0, abs=0.05)


def test_garbage_has_the_length_and_nothing_else() -> None:
    assert between(heard("what = 'garbage'; for = 1.0"), 1.05, 1.95) == []


@pytest.mark.parametrize(("order", "share"), [("what = 'slow'; factor = 5.0", 0.2), ("what = 'intermittent'", 0.5)])
def test_fewer_arrive(order: str, share: float) -> None:
    got = heard(f"{order}; for = 2.0")
    assert len(between(got, 1.05, 2.95)) == pytest.approx(1.9 * HZ * share, abs=12)
    seqs = [datagram.seq for datagram in between(got, 1.05, 2.95)]
    assert (max(seqs) - min(seqs) + 1 > len(seqs)) == ("intermittent" in order), "only what was sent can be missed"


def test_delayed_keeps_the_time_of_the_reading() -> None:
    late = [t - d.time for t, d in heard("what = 'delayed'; by_s = 0.3; for = 1.0") if d is not None and 1.4 <= t < 1.9]
    assert late
    assert late == pytest.approx([0.3] * len(late))


@pytest.mark.parametrize("word", ["jump", "restart"])
def test_what_happens_once(word: str) -> None:
    before, after = (between(heard(f"what = '{word}'"), a, b) for a, b in ((0.9, 0.999), (1.001, 1.1)))
    assert abs(after[0].values[0] - before[-1].values[0]) > 0.4
    assert (after[0].session != before[-1].session) == (word == "restart")


def test_orders_are_checked() -> None:
    with pytest.raises(FaultError, match="factor"):
        heard("what = 'slow'; factor = 0.1")
    assert {"off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent"} <= set(ODOMETRY)
