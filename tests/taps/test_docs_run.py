"""The commands of the documents, run as they stand there, against the simulated robot; a test for each way of it.

Only places are other ones (a folder of the test's own, this computer in place of a robot's address, free ports), and
times are shorter. What is run elsewhere, or cannot be run, is said in `tests.taps.documented`, with the reason.
"""

import gzip
import itertools
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from urllib.request import urlopen

import pytest

from tests.taps.documented import ELSEWHERE, NOT_RUN, ROOT, RUN, all_documented, to_run
from tools.sim.ports import free_port

AT = "%H:%M:%S"
SHORTER = {"--seconds": "2", "--journal-at": "2"}
PROGRAMS = {"lumiloop": [sys.executable, "-m", "daemon"], "python": [sys.executable]}


def test_every_command_is_run_or_it_is_said_why_not() -> None:
    known = [*(pattern for patterns in RUN.values() for pattern in patterns), *ELSEWHERE, *NOT_RUN]
    for one in all_documented():
        assert len([pattern for pattern in known if re.match(pattern, one)]) == 1, one
    for pattern in known:
        assert any(re.match(pattern, one) for one in all_documented()), f"no page has it any more: {pattern}"
    for test in ELSEWHERE.values():
        file, _, name = test.partition("::")
        assert (ROOT / file).exists(), test
        assert not name or f"def {name}(" in (ROOT / file).read_text(), test


class Desk:
    """A folder in which commands are run as a person would; ``drive/`` is there after the sessions.

    Attributes:
        at: local time, about half-way through the drive.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.at, self._logs = folder, "", itertools.count(1)
        self.modbus, self.odometry, self.metrics, self.foxglove, self.view = (str(free_port()) for _ in range(5))
        (folder / "run" / "lumiloop").mkdir(parents=True)
        self.environment = {
            **os.environ, "PYTHONPATH": str(ROOT), "XDG_STATE_HOME": str(folder), "MPLBACKEND": "Agg",
            "XDG_RUNTIME_DIR": str(folder / "run"),
        }  # fmt: skip

    def words(self, command: list[str]) -> list[str]:
        """A documented command, with the places and times of this test."""
        places = {
            "/tmp/": f"{self.folder}/", "/etc/lumiloop/": f"{self.folder}/", "5601": self.odometry,
            "/run/lumiloop/": f"{self.folder}/run/lumiloop/", "tools/clients": f"{ROOT}/tools/clients",
            "9464": self.metrics, "0.0.0.0:8765": f"127.0.0.1:{self.foxglove}", "21:14:07": self.at,
            "612,1832": "5,9",
        }  # fmt: skip
        told, last = [], ""
        for word in command:
            for old, new in places.items():
                word = word.replace(old, new)
            told.append(SHORTER.get(last, word))
            last = word
        match told[:2]:
            case ["lumiloop", "status"]:
                told[2] = f"127.0.0.1:{self.modbus}"
            case ["mbpoll", _]:
                told = [{"192.168.1.20": "127.0.0.1", "1502": self.modbus}.get(word, word) for word in told]
            case ["lumiloop", "metrics"]:
                told += ["--listen", f"127.0.0.1:{self.metrics}"]
            case ["lumiloop", "view"]:
                told += ["--port", self.view]
            case ["lumiloop", "run"]:
                told += ["--set", f"modbus.port={self.modbus}", "--set", "modbus.write=true"]
                found = "--lidar" in told or (self.folder / "lumiloop.toml").exists()
                told += [] if found else ["--lidar", f"{self.folder}/lidar"]
        return [*PROGRAMS.get(told[0], told[:1]), *told[1:]]

    def do(self, command: list[str], **names: str) -> str:
        """Run one that ends by itself, and well; what it wrote. ``names``: words that stand for other ones."""
        words = [names.get(word, word) for word in self.words(command)]
        done = subprocess.run(
            words, cwd=self.folder, env=self.environment, capture_output=True, text=True, timeout=60.0
        )
        assert done.returncode == 0, f"{words}\n{done.stdout}\n{done.stderr}"
        return done.stdout

    @contextmanager
    def running(self, command: list[str], by: signal.Signals = signal.SIGINT) -> Iterator[subprocess.Popen[bytes]]:
        """Run one that lasts, until a person stops it; it ends well."""
        words, log = self.words(command), self.folder / f"log{next(self._logs)}"
        with log.open("w") as file:
            process = subprocess.Popen(words, cwd=self.folder, env=self.environment, stdout=file, stderr=file)
        try:
            yield process
            assert process.poll() is None, f"{words}\n{log.read_text()}"
            process.send_signal(by)
            assert process.wait(20.0) == 0, f"{words}\n{log.read_text()}"
        finally:
            process.kill()
            process.wait()


def until(what: Callable[[], object], seconds: float = 180.0, every: float = 0.05) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "it has not come about"
        time.sleep(every)


def side_by_side(do: Callable[[list[str]], object], *lanes: Iterable[list[str]]) -> None:
    """Run commands, in each lane one after the other: what needs or overwrites what another has written is in its lane.

    No more at once than the smallest computer has cores.
    """

    def one_by_one(lane: Iterable[list[str]]) -> None:
        for command in lane:
            do(command)

    with ThreadPoolExecutor(max_workers=2) as pool:
        list(pool.map(one_by_one, lanes))  # asks each for its error


def got(address: str) -> bool:
    """Whether there is such a page."""
    try:
        return bool(urlopen(address, timeout=5.0).read())
    except OSError:
        return False


def listens(port: int) -> bool:
    with socket.socket() as tried:
        return tried.connect_ex(("127.0.0.1", port)) == 0


def tracks(desk: Desk) -> bool:
    """Whether the daemon knows where the robot is."""
    words = [*PROGRAMS["lumiloop"], "status", f"127.0.0.1:{desk.modbus}"]
    done = subprocess.run(words, env=desk.environment, capture_output=True, text=True)
    sys.stderr.write(done.stdout + done.stderr)  # shown of a test that fails
    return "TRACKING" in done.stdout


@pytest.fixture(scope="module")
def desk(warm_kernels: None, tmp_path_factory: pytest.TempPathFactory) -> Desk:
    """After every command that runs the daemon, on the simulators of the documents; beside the last one, the others."""
    made = Desk(tmp_path_factory.mktemp("desk"))
    bare, with_light = (command for command in to_run("sessions") if command[0] == "python")
    lone, in_light = (command for command in to_run("sessions") if "--set" in command)
    settings = (
        f'[lidar]\ndevice = "{made.folder}/lidar"\nmount = {{ x = 0.15, y = 0.0, yaw = 0.0, inverted = false }}\n'
        f'[odometry]\nport = {made.odometry}\n[photodiode]\nbus = "unix:{made.folder}/i2c"\n'
        '[lights]\nsurvey = "lamps.toml"\n'
    )
    plain, recording = ["lumiloop", "run"], ["lumiloop", "run", "--record", "drive/"]
    assert all(command in to_run("sessions") for command in (plain, recording))
    with made.running(bare):
        until((made.folder / "lidar").exists)
        for command in (lone, *(one for one in to_run("sessions") if "--record" in one and one != recording)):
            with made.running(command):
                until((made.folder / "run/lumiloop/lumiloop.stream").exists)
                time.sleep(0.5)
    shutil.rmtree(made.folder / "lumiloop" / "maps", ignore_errors=True)  # of one glance, and without lamps
    with made.running(with_light):
        until(lambda: (made.folder / "i2c").exists() and (made.folder / "lamps.toml").exists())
        for command in (in_light, plain):
            with made.running(command):
                until((made.folder / "run/lumiloop/lumiloop.stream").exists)
            (made.folder / "lumiloop.toml").write_text(settings)  # found by those that follow
        shutil.rmtree(made.folder / "drive")
        with made.running(recording):
            until(lambda: tracks(made), every=2.0)  # to ask takes half a processor's second, which the daemon needs
            made.at = time.strftime(AT)
            beside(made)
    return made


def beside(desk: Desk) -> None:
    """What is said to a running daemon, or heard of it."""
    (desk.folder / "view.token").write_text("0123456789abcdef0123456789abcdef")
    (desk.folder / "view.token").chmod(0o600)
    page, pages = f"http://127.0.0.1:{desk.view}/", list[list[str]]()

    def do(command: list[str]) -> None:
        match command[:2]:
            case ["lumiloop", "view"]:
                with desk.running(command):
                    until(lambda: got(page))
                    pages.append(command)
            case ["lumiloop", "metrics"]:
                with desk.running(command):
                    until(lambda: got(f"http://127.0.0.1:{desk.metrics}/vda5050"))
                    (curl,) = (one for one in to_run("beside") if one[0] == "curl")
                    if shutil.which("curl") is not None:
                        until(lambda: '"localized": true' in desk.do(curl))
            case ["lumiloop", "foxglove"]:
                with desk.running(command):
                    until(lambda: listens(int(desk.foxglove)))
            case ["python", _]:
                heard = subprocess.run(
                    ["timeout", "3", *desk.words(command)], env=desk.environment, capture_output=True, text=True
                )
                assert "pose" in heard.stdout, heard.stderr
            case ["mbpoll", _]:
                if shutil.which("mbpoll") is not None:  # a package of Debian's
                    answer = desk.do(command)
                    assert "1000" not in command or re.search(r"Written \d+ references", answer)
            case ["curl", _]:
                pass  # beside the metrics
            case _:
                desk.do(command)

    views = [command for command in to_run("beside") if command[1] == "view"]
    side_by_side(do, views, [command for command in to_run("beside") if command not in views])
    assert pages == views
    assert len(views) > 3


@pytest.mark.realtime
@pytest.mark.system
def test_of_a_drive(desk: Desk) -> None:
    assert re.search(r"^\d\d:\d\d:\d\d$", desk.at)

    def do(command: list[str]) -> None:
        if command[:3] == ["lumiloop", "view", "drive/"]:
            with desk.running(command):
                until(lambda: got(f"http://127.0.0.1:{desk.view}/"), 40.0)
        elif command[0] == "evo_traj":
            program = Path(sys.executable).with_name("evo_traj")
            assert command[-1] == "-p"  # a window; the test has none
            assert "poses" in desk.do(command[:-1], evo_traj=str(program))
        else:
            desk.do(command, LOG="drive", DIR="drive" if command[1] == "why" else "out")

    replays = [command for command in to_run("drive") if command[1] == "replay"]
    side_by_side(do, replays, [command for command in to_run("drive") if command not in replays])
    for name in ("result/trajectory.tum", "result/map.lumimap", "map/map.pgm", "drive.mcap", "drive.tum", "why.png"):
        assert (desk.folder / name).stat().st_size > 0, name
    assert list((desk.folder / "out").glob("match-*.json"))


@pytest.mark.system
def test_of_maps(recording: Path, tmp_path: Path) -> None:
    """Of a drive without lamps: a map that lies in a survey's frame is not to be aligned, which the pages say."""
    desk = Desk(tmp_path)
    desk.do(["lumiloop", "replay", "REC", "--out", "made"], REC=str(recording))
    for name in ("FILE", "hall.lumimap", "maps/map-0000abcd-00000007.lumimap"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(tmp_path / "made/map.lumimap", tmp_path / name)
    for name in ("floor.yaml", "nav2/floor.yaml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(tmp_path / "made/map.yaml", tmp_path / name)
        shutil.copy(tmp_path / "made/map.pgm", (tmp_path / name).with_name("map.pgm"))
    desk.do(["lumiloop", "map", "export", "hall.lumimap", "--carmen", "--out", "scans"])
    for name in ("drive.clf.gz", "intel.clf.gz"):
        (tmp_path / name).write_bytes(gzip.compress((tmp_path / "scans/keyframes.clf").read_bytes()))
    before = len(list(tmp_path.rglob("*.lumimap")))
    kept = [command for command in to_run("maps") if command[2] in ("name", "align", "import")]
    made: dict[str, list[list[str]]] = {}
    for command in to_run("maps"):
        if command not in kept:
            made.setdefault(command[-1], []).append(command)  # its file or folder
    side_by_side(desk.do, kept, *made.values())
    for name in (
        "hall.png",
        "out/hall/map.pgm",
        "out/hall/keyframes.tum",
        "out/drive/map.png",
        "out/intel/map.lumimap",
    ):
        assert (tmp_path / name).stat().st_size > 0, name
    # a name, another frame, two imports; and the replay's
    assert len(list(tmp_path.rglob("*.lumimap"))) == before + 5


@pytest.mark.system
def test_alone(tmp_path: Path) -> None:
    desk = Desk(tmp_path)

    def do(command: list[str]) -> None:
        assert desk.do(command) or "draw" in " ".join(command)

    side_by_side(do, *([command] for command in to_run("alone")))
    assert (tmp_path / "office.png").stat().st_size > 0
    assert (tmp_path / "light.png").stat().st_size > 0
