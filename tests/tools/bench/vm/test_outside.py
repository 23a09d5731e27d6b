"""What the virtual bench asks from outside: orders to its world, reads over Modbus, poses on wheels; each can fail."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Container, Generator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from tools.bench.report.result import Seen
from tools.bench.vm import bench as benches
from tools.bench.vm import common, places, trying_devices, trying_system
from tools.bench.vm.bench import Bench, Heard
from tools.bench.vm.machine import Machine, Order, Ports


def outside(folder: Path) -> Bench:
    """A bench whose emulated computer is a process that sleeps."""
    bench = Bench.__new__(Bench)
    bench.folder = folder
    bench.machine = Machine.__new__(Machine)
    bench.machine.broken_off, bench.machine.ports = threading.Event(), Ports(1, 2, 3)
    bench.machine.process = SimpleNamespace(poll=lambda: None)  # type: ignore[assignment]  # all that is asked
    return bench


@contextmanager
def world(folder: Path, *answers: bytes, stays: bool = False) -> Generator[None]:
    """A world that answers one order with these pieces, and hangs up or says no more."""
    done = threading.Event()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(folder / "control"))
        listener.listen()

        def talk() -> None:
            link = listener.accept()[0]
            with link:
                assert link.recv(4096) == b"order silence for=2\n"
                for piece in answers:
                    link.sendall(piece)
                    time.sleep(0.02)
                if stays:
                    done.wait(20.0)

        talking = threading.Thread(target=talk)
        talking.start()
        yield
        done.set()
        talking.join()


def test_an_order_to_the_world_is_answered(tmp_path: Path) -> None:
    with world(tmp_path, b"silence:", b" on\no", b"k\n", stays=True):
        assert outside(tmp_path).orders("order silence for=2") == "silence: on\nok\n"


@pytest.mark.parametrize(
    ("answer", "says"), [(b"silence: on\n", "it has hung up"), (b"", "it has hung up"), (b"refused: no", "refused: no")]
)
@pytest.mark.timeout(30)
def test_a_world_that_hangs_up_fails_the_order_at_once(answer: bytes, says: str, tmp_path: Path) -> None:
    with world(tmp_path, *filter(None, [answer])), pytest.raises(Order, match=f"order silence for=2: .*{says}"):
        outside(tmp_path).orders("order silence for=2")


@pytest.mark.timeout(30)
def test_a_world_that_says_nothing_is_not_waited_for_for_ever(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benches, "WORLD_ANSWERS_S", 0.4)
    with world(tmp_path, b"silence:", stays=True), pytest.raises(Order, match=r"no answer within 0\.4 s"):
        outside(tmp_path).orders("order silence for=2")
    (tmp_path / "control").unlink()
    with pytest.raises(Order, match="the simulated world does not take it"):
        outside(tmp_path).orders("order silence for=2")


@pytest.mark.timeout(30)
def test_an_order_ends_when_the_run_is_broken_off(tmp_path: Path) -> None:
    bench = outside(tmp_path)
    threading.Timer(0.1, bench.machine.broken_off.set).start()
    begun = time.monotonic()
    with world(tmp_path, stays=True), pytest.raises(places.BrokenOff):
        bench.orders("order silence for=2")
    assert time.monotonic() - begun < 3.0


class Loses:
    """A reader of a network that loses some requests, by their number over UDP and over TCP; counts them."""

    def __init__(self, udp: Container[int], tcp: Container[int]) -> None:
        self.lost, self.asked = {False: udp, True: tcp}, {False: 0, True: 0}

    def __call__(self, host: str, port: int, tcp: bool) -> SimpleNamespace:
        return SimpleNamespace(read=lambda: self.read(tcp), close=lambda: None)

    def read(self, tcp: bool) -> dict[str, object]:
        self.asked[tcp] += 1
        if self.asked[tcp] in self.lost[tcp]:
            raise TimeoutError
        return {"state": "TRACKING", "seq": 7}


@pytest.mark.parametrize(
    ("udp", "tcp", "says"),
    [
        ((), (), ""),
        ((20,), (), ""),
        ((20, 30), (), "48 of 50 reads over UDP answered at once, where 1 may be lost"),
        ([k for k in range(99) if k % 4], (), r"12 of 50 reads over UDP"),
        ((), (20,), "49 of 50 reads over TCP answered at once, where 0 may be lost"),
    ],
)
def test_reads_are_counted_as_they_are_asked(
    udp: Container[int], tcp: Container[int], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not as often as it takes: three of four lost are no network that a controller could use."""
    loses = Loses(udp, tcp)
    monkeypatch.setattr(benches, "Reader", loses)
    bench = outside(tmp_path)
    monkeypatch.setattr(bench, "placed", lambda *_: 0.0)
    if not says:
        seen = trying_system.answers_modbus(bench)
        assert isinstance(seen, Seen)
        assert [one.name for one in seen.figures if one.worse] == ["UDP: answered", "TCP: answered"]
        assert loses.asked == {False: 51, True: 51}
        return
    with pytest.raises(common.Unmet, match=says) as unmet:
        trying_system.answers_modbus(bench)
    assert any(one.value < 100.0 for one in unmet.value.seen.figures if one.unit == "%")


def poses(off_m: float) -> Callable[[float], list[Heard]]:
    return lambda seconds: [Heard(0.2 * k, 0.2 * k, 4, (0.0, off_m, 0.0), 0.01) for k in range(15)]


@pytest.mark.parametrize(
    ("heard", "says"),
    [
        (poses(0.02), ""),
        (poses(0.2), r"0\.200 m from the truth"),
        (lambda seconds: [], "no pose has come"),
        (lambda seconds: [Heard(0.1, 0.1, 1, None, 0.0)], "no pose has come"),
    ],
)
def test_without_a_laser_wheels_carry_the_pose(
    heard: Callable[[float], list[Heard]], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = outside(tmp_path)
    bench.ears, bench.start = benches.Ears(), (0.0, 0.0, 0.0)
    bench.ears.truth.extend((0.1 * k, (0.0, 0.0, 0.0)) for k in range(100))
    monkeypatch.setattr(bench.machine, "run", lambda *words, **more: "ls: cannot access")
    for name, made in (
        ("main_pid", lambda: 7), ("until", lambda *_: 0.7), ("fault", lambda *_: None), ("collect", heard),
    ):  # fmt: skip
        monkeypatch.setattr(bench, name, made)
    if not says:
        assert str(trying_devices.is_unplugged(bench)).endswith("20 mm off after 3 s on wheels")
        return
    with pytest.raises(Order, match=says):
        trying_devices.is_unplugged(bench)
