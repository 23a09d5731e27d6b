"""A bench computer as the world: scenario files, the judge, the DAC's wire, the serial end, and a robot computer."""

from __future__ import annotations

import asyncio
import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hal.errors import DeviceMissing
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.scan_world import Room
from tests.hil.programs import served_receiver
from tools.bench.report.result import Result, Seen
from tools.bench.world import __main__ as world
from tools.bench.world import agreement, room
from tools.bench.world.__main__ import main, twins
from tools.bench.world.judge import Played, Read, errors_of, judged, pictures
from tools.bench.world.local import robot
from tools.bench.world.scenario import BUILT_IN, Expectation, Scenario, find, load
from tools.bench.world.serialend import SerialEnd
from tools.bench.world.stage import CannotPlay, Ends
from tools.sim.light.scene import SceneLight

ROOT = Path(__file__).parents[4]
Floats = np.ndarray
"""4.7 kOhm and 10 nF."""
LEAST = '[[expect]]\nwhat = "never"\nis = "LOST"\n'


# files


@pytest.mark.parametrize("path", sorted(BUILT_IN.glob("*.toml")), ids=lambda path: path.stem)
def test_scenarios_that_come_with_the_bench_are_whole(path: Path) -> None:
    made = load(path)
    assert made.title != path.stem
    assert all(one.until <= made.drive.seconds and one.from_ < made.drive.seconds for one in made.expect)
    assert made.scene(held=True).held
    assert find(path.stem) == path


def test_a_dac_that_is_not_there_is_named_and_not_the_robot(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the bench's own bus nobody acknowledges its address; else all that is said is that no lamp was received."""
    file = tmp_path / "short.toml"
    file.write_text('[world]\nlamps = true\nbuilding = "paper_room"\n[drive]\nsettle = 20.0\n' + LEAST)
    monkeypatch.setattr(SceneLight, "prepare", lambda light: None)
    monkeypatch.setattr(SceneLight, "sample", lambda light, t: np.zeros(len(t)))
    with served_receiver(tmp_path) as served:
        dac = f"dac:{served.partition('@')[0]}@0x60"
        line = ["--modbus", "127.0.0.1:9", "--lidar", f"pty:{tmp_path / 'l'}", "--light", dac]
        assert main([str(file), *line]) == 2
    said = capsys.readouterr().out
    assert "nobody answers" not in said
    assert "MCP4725" in said
    assert "0x60" in said


def test_a_robot_computer_that_does_not_answer_is_told_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "short.toml"
    file.write_text("[drive]\nsettle = 0.2\n" + LEAST)
    assert main([str(file), "--modbus", "127.0.0.1:9", "--lidar", f"pty:{tmp_path / 'l'}"]) == 2
    assert "nobody answers at 127.0.0.1 port 9" in capsys.readouterr().out
    assert not (tmp_path / "l").exists()


@pytest.mark.parametrize(("raised", "says"), [(CannotPlay("no answer"), "no answer"), (KeyboardInterrupt(), "ended")])
def test_what_was_played_before_the_end_is_reported(
    raised: BaseException,
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The second of three cannot be played; it is told of, and the first one's results are not lost."""

    def tried(scenario: Scenario, ends: Ends, twin: bool) -> list[Result]:
        if scenario.name != "lap":
            raise raised
        return [Result("lap.error", "a lap", True, 17.0, "seen")]

    monkeypatch.setattr(world, "tried", tried)
    words = ["lap", "cable", "garbage", "--lidar", "pty:x", "--modbus", "127.0.0.1", "--out", str(tmp_path)]
    assert main(words) == 2
    said = capsys.readouterr().out
    assert says in said
    assert f"1 of 1 as expected; {tmp_path}/report.html" in said
    kept = json.loads((tmp_path / "results.json").read_text())["results"]
    assert [(one["name"], one["passed"]) for one in kept] == [
        ("lap.error", True),
        ("cable", False),
        ("garbage", False),
    ]
    assert all(says in one["skipped"] for one in kept[1:])


@pytest.mark.system
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_bench_that_is_ended_leaves_no_daemon(number: int, tmp_path: Path) -> None:
    """In the middle of waiting for a pose."""
    command = [sys.executable, "-m", "tools.bench.world", "lap", "--local", "--out", str(tmp_path / "out")]
    environment = {**os.environ, "TMPDIR": str(tmp_path)}
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, env=environment) as bench:
        assert bench.stdout is not None
        assert "waiting for a pose" in bench.stdout.readline()
        (log,) = tmp_path.glob("lumiloop-world-*/daemon.log")
        (child,) = Path(f"/proc/{bench.pid}/task/{bench.pid}/children").read_text().split()
        bench.send_signal(number)
        said = bench.communicate(timeout=60.0)[0]
    end = time.monotonic() + 10.0
    while Path("/proc", child).exists() and "Z" not in Path("/proc", child, "stat").read_text().rpartition(")")[2]:
        assert time.monotonic() < end, "the daemon goes on"
        time.sleep(0.02)
    if number != signal.SIGKILL:
        assert bench.returncode == 2
        assert "ended before its end" in said
        assert not log.parent.exists()


# the judge


SCENARIO = Scenario("x", "x", expect=(Expectation("never", ("LOST",)),), faults=({"when": 3.0, "for": 1.0},))
SCENARIO = replace(SCENARIO, drive=replace(SCENARIO.drive, seconds=10.0))


def way(t: Floats) -> Floats:
    """East at 0.5 m/s from (1, 2), heading north."""
    return np.column_stack([1.0 + 0.5 * t, np.full(len(t), 2.0), np.full(len(t), math.pi / 2)])


def played(off: Callable[[float], float] = lambda t: 0.0, **change: object) -> Played:
    """Reads every 0.1 s, the pose 0.05 s old, ``off`` m to the robot's left of where it is."""
    reads = []
    for k in range(100):
        t = 0.1 * k
        y = -0.5 * max(t - 0.05, 0.0)  # seen from a robot that looks north, east is to the right
        pose = (off(t), y, 0.0)
        reads.append(replace(Read(t, "TRACKING", 0, t - 0.05, pose, 0.01, True, True), **change))  # type: ignore[arg-type]  # test shorthand
    return Played(SCENARIO, reads, lambda t: way(np.maximum(t, 0.0)), [(0.0, 0.0, 0.0)])


def test_a_pose_is_compared_with_the_truth_where_the_robot_said_it_was() -> None:
    assert errors_of(played()).metres.max() < 1e-9
    found = errors_of(played(lambda t: 0.2 if t > 5.0 else 0.0))
    assert found.metres.max() == pytest.approx(0.2)
    holds, seen = judged(Expectation("error", at_most=0.1), played(lambda t: 0.2))
    assert not holds
    assert "[lidar] mount = { x = 0.15 }" in seen.said
    assert "mount" not in judged(Expectation("error", at_most=0.15), played(lambda t: 0.2))[1].said
    assert judged(Expectation("error", at_most=0.1, until=4.0), played(lambda t: 0.2 if t > 5.0 else 0.0))[0]
    assert judged(Expectation("error", at_most=0.1, sigmas=11.0), played(lambda t: 0.2))[0]
    assert judged(Expectation("error", at_most=0.1), played(pose=None))[0] is False


@pytest.mark.parametrize(
    ("expected", "change", "passed"),
    [
        (Expectation("state", ("TRACKING",), from_=2.0, within=1.0), {}, True),
        (Expectation("state", ("NO_LIDAR",), from_=2.0, within=1.0), {}, False),
        (Expectation("state", ("TRACKING",), from_=2.0, within=1.0), {"answered": False}, False),
        (Expectation("never", ("TRACKING",)), {}, False),
        (Expectation("never", ("LOST",)), {}, True),
        (Expectation("never", ("LOST",)), {"answered": False, "state": ""}, False),
        (Expectation("share", ("TRACKING",), at_least=0.9), {}, True),
        (Expectation("share", ("TRACKING",), at_least=0.9), {"state": "DEGRADED"}, False),
        (Expectation("fault", (104,), within=1.0), {"fault": 104}, True),
        (Expectation("fault", (104,), within=1.0), {"fault": 101}, False),
        (Expectation("clear", within=1.0), {}, True),
        (Expectation("clear", within=1.0), {"fault": 101}, False),
        (Expectation("age", at_most=0.06), {}, True),
        (Expectation("age", at_most=0.04), {}, False),
        (Expectation("answers", at_least=0.99), {}, True),
        (Expectation("answers", at_least=0.99), {"answered": False}, False),
        (Expectation("lamps", at_least=0.9), {"lamps": ((7, 1e-6), (8, 1e-7))}, True),
        (Expectation("lamps", at_least=0.9), {"lamps": ((8, 1e-6), (7, 1e-7))}, False),
        (Expectation("lamps", at_least=0.9), {"lamps": ((7, 1e-6), (99, 1e-7))}, False),
        (Expectation("lamps", at_least=0.9), {}, False),
        (Expectation("never", ("LOST",), from_=50.0), {}, False),
    ],
)
def test_expectations_pass_and_fail(expected: Expectation, change: dict[str, object], passed: bool) -> None:
    run = replace(played(**change), lamps=frozenset({7, 8}), strongest=lambda t: 7)
    holds, seen = judged(expected, run)
    assert holds is passed
    assert isinstance(seen, Seen)
    assert len(pictures(run)) == 4


def test_two_runs_are_compared_at_equal_ways() -> None:
    one, other = played(), played(lambda t: 0.004)
    shifted = replace(other, reads=[replace(read, t_pose=read.t_pose + 0.031) for read in played().reads])
    _, gap = agreement.differences(agreement.trace(one), agreement.trace(other))
    assert gap == pytest.approx(0.004, abs=1e-6)
    assert agreement.differences(agreement.trace(one), agreement.trace(shifted))[1].max() > 0.01  # poses 31 ms too late
    seen, _ = agreement.figures(agreement.trace(one), agreement.trace(other), "x")
    assert seen[-1].value == pytest.approx(4.0, abs=1e-3)
    assert seen[0].value == pytest.approx(1.45, abs=0.06), "to the fault at 3 s"


def told(off_m: float, again: float = math.inf, counted: bool = True) -> Played:
    """The map lies in the survey from 4 s on, until ``again``, which jumps that are ``counted`` have done."""
    run = replace(played(), lamps=frozenset({7}))
    site = [(*xy, yaw) for *xy, yaw in way(np.array([max(one.t_pose, 0.0) for one in run.reads])).tolist()]
    reads = [
        replace(one, pose=(x + off_m, y, yaw), jumps=int(counted)) if 4.0 < one.t < again else one
        for one, (x, y, yaw) in zip(run.reads, site, strict=True)
    ]
    return replace(run, reads=reads)


def test_under_surveyed_lamps_the_map_lies_in_the_survey_once_light_has_told() -> None:
    """Until then where the robot said it was while it stood; a pose that is off is off in either frame."""
    assert errors_of(told(0.0)).metres.max() < 1e-9
    assert np.abs(errors_of(told(0.0)).off[:, 2]).max() < 1e-9
    assert errors_of(told(0.3)).metres.max() == pytest.approx(0.3)
    assert errors_of(told(0.0, again=6.0)).metres.max() > 1.0, "a map that goes back to where it lay is no place"
    assert errors_of(replace(told(0.0), lamps=frozenset())).metres.max() > 1.0
    assert errors_of(told(0.0)).t_site == pytest.approx(4.05)


def test_a_pose_that_is_wrong_does_not_choose_the_frame_it_is_judged_in() -> None:
    """Without a jump that is counted the map is where it was; a survey that is never found is no place in it."""
    assert errors_of(told(0.0, counted=False)).metres.max() > 1.0
    never = replace(played(), lamps=frozenset({7}))
    holds, seen = judged(Expectation("error", at_most=0.1), never)
    assert not holds
    assert "never told" in seen.said
    assert judged(Expectation("error", at_most=0.1), replace(never, lamps=frozenset()))[0]
    assert judged(Expectation("error", at_most=0.1), told(0.0))[0]


def test_two_runs_are_compared_until_a_fault_strikes() -> None:
    """What a fault does depends on the scan that it strikes; before it both say the same."""
    moved = played(lambda t: 0.5 if t > 3.1 else 0.0)
    assert agreement.alike_s(moved.scenario) == 3.0
    assert agreement.differences(agreement.trace(played()), agreement.trace(moved))[1].max() < 1e-9
    whole = replace(SCENARIO, faults=())
    apart = agreement.differences(
        agreement.trace(replace(played(), scenario=whole)), agreement.trace(replace(moved, scenario=whole))
    )
    assert apart[1].max() == pytest.approx(0.5, abs=1e-6)
    early = replace(moved, scenario=replace(SCENARIO, faults=({"when": 1.0},)))
    assert "before it has driven" in twins(early.scenario, early).skipped


def test_two_runs_are_compared_until_one_closes_a_loop() -> None:
    """With which keyframe depends on the scans, and what that is good for is centimetres."""
    moved = played(lambda t: 0.02 if t > 2.0 else 0.0)
    closed = replace(moved, reads=[replace(one, loops=5 if one.t < 1.95 else 6) for one in moved.reads])
    at, gap = agreement.differences(agreement.trace(played()), agreement.trace(closed))
    assert gap.max() < 1e-9
    assert at[-1] == pytest.approx(0.9, abs=0.1)
    assert agreement.differences(agreement.trace(played()), agreement.trace(moved))[1].max() > 0.019
    whole = replace(SCENARIO, faults=())
    early = replace(moved, scenario=whole, reads=[replace(one, loops=int(one.t > 0.5)) for one in moved.reads])
    assert "could be compared" in twins(whole, early).said
    at_once = replace(moved, reads=[replace(one, loops=int(one.t > 0.05)) for one in moved.reads])
    way, _, largest = agreement.figures(agreement.trace(at_once), agreement.trace(moved), "x")[0]
    assert way.value == 0.0
    assert not largest.value <= 10.0, "what could not be compared does not agree"


def test_the_benchs_room_and_lidar_stand_beside_the_others() -> None:
    assert room.model("bench").steps == 181
    assert room.place("bench").name == "bench"
    assert room.place("office_floor").name != "bench"
    with pytest.raises(ValueError, match="no building is called"):
        room.place("barn")


# the DAC


def test_the_lidar_comes_out_of_a_serial_port() -> None:
    async def talk() -> tuple[bytes, DeviceMissing]:
        master, slave = os.openpty()
        tty.setraw(slave)
        device = FakeHokuyo(room.LIDAR, Room(room.LIDAR))
        end = SerialEnd(device, os.ttyname(slave))
        os.write(master, b"QT\nVV\nMD0000018001000\n")
        heard = b""
        os.set_blocking(master, False)
        for _ in range(200):
            await asyncio.sleep(0.01)
            with suppressed():
                heard += os.read(master, 65536)
            if heard.count(b"MD0000018001000\n99b") >= 2:
                break
        os.close(slave)
        os.close(master)
        await asyncio.sleep(0.05)
        lost = end.lost
        end.close()
        device.close()
        assert isinstance(lost, DeviceMissing)
        return heard, lost

    heard, lost = asyncio.run(talk())
    assert b"SERI:" in heard
    assert heard.count(b"MD0000018001000\n99b") >= 2
    assert "start anew" in str(lost)


@contextmanager
def suppressed() -> Generator[None]:
    try:
        yield
    except BlockingIOError:
        return


@contextmanager
def null_modem() -> Generator[tuple[str, str]]:
    """Two serial ports with a cable between them."""
    (a, a_slave), (b, b_slave) = os.openpty(), os.openpty()
    for slave in (a_slave, b_slave):
        tty.setraw(slave)
    names = os.ttyname(a_slave), os.ttyname(b_slave)

    def carry(source: int, sink: int) -> None:
        with suppressed_end():
            while True:
                os.write(sink, os.read(source, 4096))

    threads = [threading.Thread(target=carry, args=pair, daemon=True) for pair in ((a, b), (b, a))]
    for thread in threads:
        thread.start()
    try:
        yield names
    finally:
        for fd in (a_slave, b_slave):
            os.close(fd)
        for thread in threads:
            thread.join(2.0)
        for fd in (a, b):
            os.close(fd)


@contextmanager
def suppressed_end() -> Generator[None]:
    try:
        yield
    except OSError:
        return


@pytest.mark.system
def test_a_robot_computer_drives_in_the_played_world(tmp_path: Path) -> None:
    """`lumiloop run` at one end of a serial cable, the bench at the other, faults included."""
    file = tmp_path / "short.toml"
    file.write_text(
        '[drive]\nseconds = 18.0\n[[fault]]\nwhat = "silence"\nwhere = "lidar"\nwhen = 8.0\nfor = 2.0\n'
        '[[expect]]\nwhat = "state"\nis = ["NO_LIDAR", "DEGRADED"]\nfrom = 8.0\nwithin = 3.0\n'
        '[[expect]]\nwhat = "state"\nis = ["TRACKING"]\nfrom = 10.0\nwithin = 6.0\n'
        '[[expect]]\nwhat = "error"\nuntil = 8.0\nat_most = 0.1\nsigmas = 3.0\n'
    )
    scenario = load(file)
    with null_modem() as (here, there), robot(scenario, serial=there) as ends:
        host, port = ends.modbus
        words = ["--lidar", here, "--modbus", f"{host}:{port}", "--odometry", ends.odometry]
        command = [sys.executable, "-m", "tools.bench.world", str(file), *words, "--out", str(tmp_path / "out")]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "3 of 3 as expected" in done.stdout
    assert "<svg" in (tmp_path / "out" / "report.html").read_text()
