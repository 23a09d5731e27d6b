"""The demo: its verdict, a run from end to end, an interrupted run, and a daemon that dies."""

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from daemon.cli import parser
from daemon.config.loader import load as load_config
from daemon.health.reasons import Reason
from daemon.snapshot import State
from tests.rotation import share
from tools.demo import run
from tools.demo.acts import Stage, complaint, programme
from tools.demo.folder import KEPT, Wiring, clear, note
from tools.demo.run import Patience
from tools.demo.score import Score, Track, summary, told, verdict


def reading(state: State = State.TRACKING, pose: tuple[float, float, float] | None = (0.0, 0.0, 0.0)) -> Any:
    x, y, yaw = pose or (None, None, None)
    return {
        "state": int(state), "map_x": x, "map_y": y, "map_yaw": yaw, "cycle": 0.001, "scan_rate": 40.0, "missed": 0,
        "overruns": 0, "t_mono": 1.0,
    }  # fmt: skip


def test_the_way_counts_from_the_start_and_not_in_the_air() -> None:
    datagrams = socket.AF_INET, socket.SOCK_DGRAM
    with socket.socket(*datagrams) as sock, socket.socket(*datagrams) as to:
        sock.bind(("127.0.0.1", 0))
        sock.setblocking(False)
        track = Track(sock)

        def drive(xs: list[float], lifted: bool = False) -> None:
            for x in xs:
                datagram = json.dumps({"t_mono": x, "x": x, "y": 0.0, "yaw": 0.0}).encode()
                to.sendto(datagram, sock.getsockname())
            time.sleep(0.05)
            track.collect(lifted)

        drive([1.0, 1.5, 2.0])
        drive([5.0, 9.0], lifted=True)
        drive([9.5, 9.0])
    assert track.driven_m == pytest.approx(2.0)


def test_the_summary_names_the_way_and_a_slow_computer() -> None:
    score = Score(driven_m=31.26, watched_s=60.0)
    for k in range(10):
        score.take({**reading(), "reason": int(Reason.OVERLOADED) if k < 3 else 0}, (0.05, 0.0, 0.0))
    assert told(summary(score))[0] == "31.3 m driven in 60 s"
    assert "the computer was too slow for 30 % of the time" in told(summary(score))[-1]
    score.slow = 0
    assert "too slow" not in " ".join(told(summary(score)))
    score.last["missed"] = 400
    assert "400 of about 2400 scans were missed" in told(summary(score))[-1]
    assert len(told(summary(Score(driven_m=1.0, watched_s=2.0)))) == 1


def test_the_progress_of_the_first_compilation_is_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "daemon.log"
    log.write_text("starting\n")
    with subprocess.Popen(["sleep", "60"], text=True) as child:
        monkeypatch.setattr("tools.demo.run.CACHE_DIR", tmp_path)
        patience = Patience(tmp_path)
        patience.wait(child, log.name)
        assert capsys.readouterr().out == ""
        now = time.monotonic()
        monkeypatch.setattr("tools.demo.run.time.monotonic", lambda: now + 9.0)
        patience.wait(child, log.name)
        assert capsys.readouterr().out == "    9 s: loading\n"
        log.write_text("compiling: 41 of 97 kernels after 5 s\ncompiling: 58 of 97 kernels after 10 s\n")
        monkeypatch.setattr("tools.demo.run.time.monotonic", lambda: now + 14.0)
        patience.wait(child, log.name)
        first, second = capsys.readouterr().out.splitlines()
        assert "a first start compiles the numerical kernels" in first
        assert second == "   14 s: the daemon has compiled 58 of 97 kernels"
        child.kill()


def test_the_folder_has_a_good_configuration_and_is_cleared(tmp_path: Path) -> None:
    (tmp_path / "demo.toml").write_text(Wiring("demo", tmp_path / "lidar", 5601, 1502, "", "maps").config())
    assert load_config(tmp_path / "demo.toml").odometry.port == 5601
    (tmp_path / "recording").mkdir()
    (tmp_path / "mine.txt").touch()
    assert "lumiloop run --config" in note(tmp_path, "paper_room", lit=True)
    clear(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.parametrize(
    ("state", "off", "complaint"),
    [
        (State.TRACKING, 0.02, ""),
        (State.MAPPING, 0.02, ""),
        (State.LOST, 0.02, "never MAPPING or TRACKING"),
        (State.TRACKING, 0.9, "the median position error is 0.90 m"),
    ],
)
def test_verdict(state: State, off: float, complaint: str) -> None:
    score = Score()
    score.take(reading(), (0.0, 0.0, 0.0))
    score.states.clear()
    for _ in range(4):
        score.take(reading(state, (off, 0.0, 0.0)), (0.0, 0.0, 0.0))
    assert verdict(summary(score)) == complaint or (complaint and complaint in verdict(summary(score)))


@contextlib.contextmanager
def simulator(path: Path, answer: str) -> Iterator[list[str]]:
    """Something that takes orders as the simulator does; yields the orders as they come."""
    orders: list[str] = []
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        server.listen()

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    connection, _ = server.accept()
                    with connection, connection.makefile("rw") as lines:
                        orders.append(lines.readline().strip())
                        lines.write(f"ordered\n{answer}\n")
                        lines.flush()

        threading.Thread(target=serve, daemon=True).start()
        yield orders
        server.shutdown(socket.SHUT_RDWR)


def test_the_programme_switches_each_sensor_off_and_on_and_notes_what_became_of_the_state(tmp_path: Path) -> None:
    acts = programme(60.0)
    assert programme(20.0) == programme(0.0) == []
    tracking, degraded = int(State.TRACKING), int(State.DEGRADED)
    with simulator(tmp_path / "control", "ok") as orders:
        stage = Stage(tmp_path / "control", acts)
        for tenth in range(600):
            t = 0.1 * tenth
            off = any(act.begin + 0.5 <= t < act.end + 2.0 for act in acts)
            stage.play(t, degraded if off else tracking)
    assert orders == ["order off where=adc", "clear off adc", "order off where=lidar", "clear off lidar"]
    assert [act.seen for act in acts] == pytest.approx([0.5, 0.5], abs=0.11)
    assert [act.back for act in acts] == pytest.approx([2.0, 2.0], abs=0.11)
    assert complaint(acts) == ""
    acts[0].seen = None
    assert "stayed TRACKING" in complaint(acts)
    acts[0].seen, acts[1].back = 0.5, None
    assert "has not become TRACKING" in complaint(acts)


def test_a_robot_is_carried_away_and_watched_until_it_is_found(tmp_path: Path) -> None:
    [act] = programme(60.0, kidnap=True)
    tracking, lost = int(State.TRACKING), int(State.LOST)
    told: list[str] = []
    with simulator(tmp_path / "control", "ok") as orders:
        stage = Stage(tmp_path / "control", [act])
        for tenth in range(600):
            t = 0.1 * tenth
            away, found = t >= act.begin + 0.45, t >= act.end + 0.95
            off_m = 3.0 if away and not found else 0.04
            told += stage.play(t, lost if away and t < act.end + 5.95 else tracking, off_m, 4 if found else 3)
    assert orders == ["order carry where=robot ahead=32 takes=2"]
    assert (act.seen, act.right, act.back) == pytest.approx((0.5, 1.0, 6.0), abs=0.11)
    assert act.jumps == (3, 4)
    assert told[:2] == ["the robot is lifted and moved to another position", "the robot is put down"]
    assert "right again" in told[2]
    assert complaint([act]) == ""
    act.right = None
    assert "not right" in complaint([act])
    act.back = None
    assert "not become TRACKING" in complaint([act])
    act.seen = None
    assert "stayed TRACKING" in complaint([act])


def left_behind(mark: str) -> list[str]:
    """Command lines of processes that still use files below ``mark``."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:  # it has ended meanwhile
            continue
        if mark in words and "tools.demo" not in words:
            found.append(words)
    return found


def start(folder: Path, *words: str) -> subprocess.Popen[str]:
    """A demo whose temporary files are below ``folder``, which is how its children are told from others.

    Where the tests run in the background, an interrupt is ignored; the demo must not inherit that.
    """
    command = [
        "env",
        "--default-signal=INT",
        sys.executable,
        "-m",
        "tools.demo.run",
        "--out",
        str(folder / "out"),
        *words,
    ]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env={**os.environ, "TMPDIR": str(folder)}
    )


def test_the_installed_command_is_the_demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[Any] = []
    monkeypatch.setattr(run, "show", lambda options, folder, out: shown.append((options, out)) or 7)
    monkeypatch.setattr(run.signal, "signal", lambda *_: None)
    assert parser.main(["demo", "--kidnap", "--seconds", "50", "--out", str(tmp_path / "out")]) == 7
    assert run.main(["--kidnap", "--seconds", "50", "--out", str(tmp_path / "out")]) == 7
    (options, out), (same, _) = shown
    assert (options.kidnap, options.seconds, out) == (True, 50.0, tmp_path / "out")
    assert vars(same).items() <= vars(options).items()


@pytest.mark.system
@pytest.mark.realtime
def test_half_a_minute(tmp_path: Path) -> None:
    demo = start(tmp_path, "--seconds", "30")
    text, _ = demo.communicate(timeout=240)
    assert demo.returncode == 0, text
    assert "TRACKING" in text
    waiting = r"(.*: (loading|.* kernels.*)\n|a first start .*\n)*"
    assert re.match(waiting + "watch it in a browser: http://127.0.0.1:", text), "before all else"
    figures = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert figures["ok"]
    assert figures["driven_m"] > 3.0
    assert figures["error_m"]["median"] < 0.10
    assert figures["scan_rate_hz"] == pytest.approx(39.9, abs=0.5)
    assert figures["modbus_reads_per_s"] > 5.0
    assert (tmp_path / "out" / "map.png").read_bytes().startswith(b"\x89PNG")
    for name in KEPT:
        assert (tmp_path / "out" / name).exists(), name
    settings = load_config(tmp_path / "out" / "demo.toml")
    assert (tmp_path / "out" / settings.lights.survey).exists()
    assert list(Path(settings.map.folder).glob("*.lumimap"))
    assert left_behind(str(tmp_path)) == []
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.system
@pytest.mark.realtime
@pytest.mark.parametrize(
    "number", [pytest.param(one, marks=share(k, 2)) for k, one in enumerate((signal.SIGINT, signal.SIGTERM))]
)
def test_interrupted_it_shows_what_it_has_and_leaves_nothing(tmp_path: Path, number: signal.Signals) -> None:
    demo = start(tmp_path, "--forever")
    assert demo.stdout is not None
    try:
        for text in demo.stdout:
            if "TRACKING" in text:
                break
        demo.send_signal(number)
        rest, _ = demo.communicate(timeout=60)
        assert demo.returncode == 0, rest
        assert "map.png" in rest
    finally:
        demo.kill()
        demo.wait()
    time.sleep(0.1)
    assert left_behind(str(tmp_path)) == []
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.system
@pytest.mark.realtime
def test_a_daemon_that_dies_is_reported(tmp_path: Path) -> None:
    demo = start(tmp_path, "--seconds", "60")
    assert demo.stdout is not None
    try:
        for text in demo.stdout:
            if "TRACKING" in text or "MAPPING" in text:
                break
        [daemon] = [
            int(path.parent.name)
            for path in Path("/proc").glob("[0-9]*/cmdline")
            if f"run\0--config\0{tmp_path}".encode() in path.read_bytes()
        ]
        os.kill(daemon, signal.SIGKILL)
        rest, _ = demo.communicate(timeout=60)
    finally:
        demo.kill()
        demo.wait()
    assert demo.returncode == 1
    assert "a process ended with code -9" in rest
    assert left_behind(str(tmp_path)) == []
