"""The suite itself: the same bodies on a tty and over the network, and what it says where it cannot."""

from __future__ import annotations

import asyncio
import errno
import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast
from xml.etree import ElementTree

import pytest

from hal.bus.i2c import AsyncBus, Message, Transferred
from hal.errors import DeviceMissing, HalError
from tests.hil import presence
from tests.hil.conftest import result_name
from tests.hil.ends import AdcEnd, operator_for, where_on_a_bus
from tests.hil.programs import ROOT, free_port, program, served_lidar, served_receiver

ON_DEVICES = 8
"""Tests of the lidar that need no minutes, and the probe."""


def words_of(tmp_path: Path, *options: str, only: str = "not system") -> list[str]:
    """The command."""
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/hil", "-m", only]
    return [*words, "--ignore=tests/hil/test_ends.py", "--hil-report", str(tmp_path / "report"), *options]


def results_of(tmp_path: Path) -> dict[str, Any]:
    """What came of it, by name."""
    file = tmp_path / "report" / "results.json"
    return {one["name"]: one for one in json.loads(file.read_text())["results"]} if file.exists() else {}


def suite(tmp_path: Path, *options: str) -> tuple[int, str, dict[str, Any]]:
    """Run it as a person does: exit code, output, results by name."""
    done = subprocess.run(words_of(tmp_path, *options), cwd=ROOT, capture_output=True, text=True, timeout=250)
    return done.returncode, done.stdout + done.stderr, results_of(tmp_path)


@contextmanager
def at_a_terminal(words: list[str]) -> Generator[tuple[subprocess.Popen[bytes], Callable[[str], str], int]]:
    """A program in a session of its own, its terminal a pty: what it shows up to some words, and the keyboard."""
    screen, line = os.openpty()
    with subprocess.Popen(["setsid", "--ctty", *words], cwd=ROOT, stdin=line, stdout=subprocess.PIPE) as child:
        os.close(line)

        def shows(wanted: str, patience_s: float = 60.0) -> str:
            said, end = "", time.monotonic() + patience_s
            while wanted not in said:
                if not select.select([screen], [], [], max(end - time.monotonic(), 0.0))[0]:
                    raise TimeoutError(f"{wanted!r} is not shown: {said!r}")
                said += os.read(screen, 4096).decode()
            return said

        try:
            yield child, shows, screen
        finally:
            child.kill()
            os.close(screen)


@pytest.mark.system
@pytest.mark.realtime
@pytest.mark.parametrize("line", ["tty", "tcp"])
def test_the_same_bodies_pass_on_a_tty_and_over_tcp(line: str, tmp_path: Path) -> None:
    """Fakes in other processes, met through the kernel; the fake's control socket is the operator."""
    where = () if line == "tty" else ("--tcp", f"127.0.0.1:{free_port()}")
    with served_lidar(tmp_path, *where) as lidar:
        device = str(tmp_path / "lidar") if line == "tty" else f"tcp://{where[1]}"
        named = ["--lidar", device, "--operator", str(tmp_path / "lidar.control")]
        code, said, results = suite(tmp_path, *named, "-k", "lidar or probe")
        assert lidar.folder == tmp_path
    assert code == 0, said
    assert len(results) == ON_DEVICES
    assert {one["name"] for one in results.values() if one["skipped"]} == set(), said
    assert ElementTree.parse(tmp_path / "report" / "junit.xml").getroot().get("failures") == "0"
    assert "<svg" in (tmp_path / "report" / "report.html").read_text()


@pytest.mark.system
def test_the_same_bodies_pass_on_a_remote_bus(tmp_path: Path) -> None:
    """The converter in another process."""
    with served_receiver(tmp_path) as adc:
        named = ["--adc", adc, "--have", "light", "--operator", str(tmp_path / "adc.control")]
        code, said, results = suite(tmp_path, *named, "-k", "photodiode")
        assert code == 0, said
        assert not any(one["skipped"] for one in results.values())
        assert {figure["name"] for figure in results["test_photodiode.py::test_in_the_dark"]["figures"]}


@pytest.mark.system
def test_a_person_at_the_terminal_is_asked_and_presses_enter(tmp_path: Path) -> None:
    """Somebody with no other hands than the fake's control socket, who does what is asked when it is asked."""
    orders = {"pull the lidar's cable": "order hangup where=lidar", "plug it in again": "clear hangup lidar"}
    with served_lidar(tmp_path) as lidar:
        asked = ["--lidar", lidar.device, "--operator", "terminal", "-k", "lidar and unplugged"]
        assert lidar.operator is not None
        with at_a_terminal(words_of(tmp_path, *asked)) as (child, shows, keyboard):
            for request, order in orders.items():
                assert request in shows("then press Enter: ")
                time.sleep(0.5)  # it takes a person a moment
                lidar.operator.tell(request, order)
                os.write(keyboard, b"\n")
            said = child.communicate(timeout=120.0)[0].decode()
    assert child.returncode == 0, said
    (result,) = results_of(tmp_path).values()
    assert result["passed"]
    assert {one["name"] for one in result["figures"]} >= {"scans again after"}


def test_a_key_that_was_pressed_too_often_is_no_answer_to_the_next_question() -> None:
    ask = "from tests.hil.ends import Person; [Person().tell(text, '') for text in ('pull', 'plug')]"
    with at_a_terminal([sys.executable, "-c", ask]) as (child, shows, keyboard):
        assert "pull" in shows("press Enter: ")
        os.write(keyboard, b"\n\n\n")
        assert "plug" in shows("press Enter: ")
        with pytest.raises(subprocess.TimeoutExpired):
            child.wait(0.5)
        os.write(keyboard, b"\n")
        assert child.wait(10.0) == 0


def test_a_terminal_that_is_closed_is_no_answer() -> None:
    ask = "from tests.hil.ends import Person; Person().tell('pull', '')"
    with at_a_terminal([sys.executable, "-c", f"try:\n {ask}\nexcept OSError as e: print(e)"]) as (
        child,
        shows,
        keyboard,
    ):
        shows("press Enter: ")
        os.write(keyboard, b"\x04")  # Ctrl-D
        assert b"nobody answers at the terminal" in child.communicate(timeout=10.0)[0]


def test_what_cannot_be_is_said_or_skipped_with_its_reason(tmp_path: Path) -> None:
    """A device that is not there, and a bench with nobody and nothing at hand."""
    devices = ["--lidar", str(tmp_path / "nothing"), "--adc", f"unix:{tmp_path}/none@0x4d"]
    code, _, results = suite(tmp_path, *devices, "-k", "unplugged or light_levels or who_it_is")
    assert code == 1
    who = results["test_lidar.py::test_says_who_it_is"]
    assert not who["passed"]
    assert "no such device" in who["said"]
    skipped = {name: one["skipped"] for name, one in results.items() if one["skipped"]}
    assert len(skipped) == 3
    assert skipped["test_photodiode.py::test_light_levels"].startswith("needs light on unix:")
    assert "--operator terminal" in skipped["test_lidar.py::test_is_unplugged_and_plugged_in_again"]


def test_a_device_that_is_not_there_is_said_once_and_no_other_test_of_it_is_run(tmp_path: Path) -> None:
    """In the reports, too: one failure with its remedy; what was not run says for what reason."""
    missing = ["--lidar", "/dev/ttyNOPE", "--adc", "/dev/i2c-NOPE@0x4d", "--have", "light"]
    code, said, results = suite(tmp_path, *missing, "-k", "lidar or photodiode")
    assert (code, said.count("ERROR at setup")) == (1, 2), said
    listed = said.partition(" short test summary ")[0]  # that repeats as much as the terminal is wide
    for option, problem, remedy in (
        ("lidar", "/dev/ttyNOPE: no such device", "plug the sensor in"),
        ("adc", "/dev/i2c-NOPE: no such bus", "enable I2C"),
    ):
        (failed,) = [one for one in results.values() if one["said"].startswith(f"--{option}=/dev/")]
        assert f"no test of it is run: {problem} ({remedy}" in failed["said"]
        assert sum(one["skipped"] == f"not run: {problem}" for one in results.values()) >= 2
        assert listed.count(remedy) == 1, said
    root = ElementTree.parse(tmp_path / "report" / "junit.xml").getroot()
    assert root.get("failures") == "2"
    assert "not run: /dev/ttyNOPE: no such device" in {case.get("message") for case in root.iter("skipped")}
    assert "not run: /dev/ttyNOPE: no such device" in (tmp_path / "report" / "report.html").read_text()


def test_a_wrong_device_is_said_before_kernels_are_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From an empty folder of them; without the compiler, which would take a minute or more, there are none to come."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    code, said, results = suite(tmp_path, "--lidar", "/dev/ttyNOPE", "-k", "probe_finds_it")
    assert code == 1
    assert "no such device" in results["test_shipped.py::test_probe_finds_it"]["said"]
    assert "compiled" not in said
    assert not list(tmp_path.glob("cache/*/warm-*")), "nothing was loaded"


def test_a_device_that_has_gone_in_the_middle_is_looked_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    answers: list[HalError | None] = [None, DeviceMissing("line", "gone")]
    monkeypatch.setitem(presence.LACKS, "lidar", lambda name: answers.pop(0))
    seen = presence.Presence()
    seen.demand("lidar", "line")
    seen.demand("lidar", "line")
    seen.doubt()
    with pytest.raises(pytest.fail.Exception, match="line: gone"):
        seen.demand("lidar", "line")
    with pytest.raises(pytest.skip.Exception, match="not run: line: gone"):
        seen.demand("lidar", "line")


@dataclass
class OneBus:
    """A bus at which some addresses answer (0) or fail in their way; at all others nothing is."""

    at: dict[int, int]
    name: str = "unix:/bus"
    about: str = ""

    async def open(self, name: str) -> AsyncBus:
        return cast("AsyncBus", self)

    async def transfer(self, messages: Sequence[Message]) -> Transferred:
        if number := self.at.get(messages[0].address, errno.ENXIO):
            raise OSError(number, os.strerror(number))
        return Transferred(0.0, 0.0, tuple(bytes(one.length) for one in messages))

    async def close(self) -> None: ...


@pytest.mark.parametrize(
    ("at", "says"),
    [
        ({}, "nothing answers at 0x4d (check power"),
        ({0x4E: 0}, "nothing answers at 0x4d (name one of 0x4e with --adc)"),
        ({0x4D: errno.EBUSY}, "address 0x4d is in use by another program"),
        ({0x4D: errno.ETIMEDOUT}, "the bus is stuck"),
        ({0x4D: errno.EIO}, "transactions fail"),
        ({0x48: errno.ETIMEDOUT, 0x4D: 0}, "None"),
    ],
)
def test_a_converter_is_looked_for_at_its_own_address(at: dict[int, int], says: str) -> None:
    """What is wrong there is said; what is wrong at another one is not its fault."""
    assert says in str(presence.adc_lacks("unix:/bus@0x4d", OneBus(at).open))


def test_a_converter_that_is_asked_for_too_soon_is_asked_again() -> None:
    """`lumiloop probe` has an address for some hundredths of a second."""
    bus = OneBus({0x4D: errno.EBUSY})

    async def later(name: str) -> AsyncBus:
        asyncio.get_running_loop().call_later(0.02, bus.at.update, {0x4D: 0})
        return await bus.open(name)

    assert presence.adc_lacks("unix:/bus@0x4d", later) is None


def test_a_figure_that_is_worse_than_in_another_run_fails_this_one(tmp_path: Path) -> None:
    code, said, _ = suite(tmp_path, "-k", "light_levels")
    assert code == 0, said
    file = tmp_path / "old.json"
    old = json.loads((tmp_path / "report" / "results.json").read_text())
    file.write_text(json.dumps(old))
    code, said, _ = suite(tmp_path, "-k", "light_levels", "--against", str(file))
    assert code == 0, said
    (swing,) = [one for one in old["results"][0]["figures"] if one["name"] == "swing of the signal"]
    swing["value"] *= 3.0
    file.write_text(json.dumps(old))
    code, said, _ = suite(tmp_path, "-k", "light_levels", "--against", str(file))
    assert code == 1
    assert "worse than before: test_photodiode.py::test_light_levels: swing of the signal" in said
    assert said.splitlines()[-1] == "FAILED: 1 worse than before", said
    assert "swing of the signal" in (tmp_path / "report" / "report.html").read_text()


def test_what_nothing_can_be_compared_with_is_refused_before_anything_is_tried(tmp_path: Path) -> None:
    """A folder does as well as its file; another bench's report does not, nor one of other tests."""
    ours = {"bench": "hil", "about": {}, "results": [{"name": "x.py::test", "passed": True, "seconds": 1.0}]}
    olds = {"folder": (ours, "has nothing of what is to be tried now (test_photodiode.py::test_light_levels)"),
            "theirs": (ours | {"bench": "bench-vm"}, "is a report of bench-vm, and this is hil")}  # fmt: skip
    for name, (old, says) in olds.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "results.json").write_text(json.dumps(old))
        code, said, results = suite(tmp_path, "-k", "light_levels", "--against", str(tmp_path / name))
        assert (code, says in said, results) == (4, True, {}), said
    code, said, _ = suite(tmp_path, "-k", "light_levels", "--against", str(tmp_path / "none.json"))
    assert (code, "name the results.json" in said) == (4, True)
    (tmp_path / "report" / "results.json").write_text(json.dumps(ours))
    code, said, _ = suite(tmp_path, "-k", "light_levels", "--against", str(tmp_path / "report"))
    assert (code, "would overwrite it; name another folder with --hil-report" in said) == (4, True), said


def test_beside_a_real_device_no_fake_counts(tmp_path: Path) -> None:
    """Of the one that is not named nothing is tried, nor of the suite itself; where all are fakes that is said."""
    words = words_of(tmp_path, "--lidar", "/dev/ttyNOPE", "-k", "who_it_is or light_levels or named_wrongly")
    words.remove("--ignore=tests/hil/test_ends.py")
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=100)
    results = results_of(tmp_path)
    assert {name.partition("::")[0] for name in results} == {"test_lidar.py", "test_photodiode.py"}, done.stdout
    assert results["test_photodiode.py::test_light_levels"]["skipped"] == "no --adc named"
    assert not any(one["fake"] for one in results.values())
    code, said, results = suite(tmp_path, "-k", "light_levels")
    assert (code, [one["fake"] for one in results.values()]) == (0, [True]), said
    assert "1 of 1 passed (1 of them on fakes)" in (tmp_path / "report" / "report.html").read_text()
    told = json.loads((tmp_path / "report" / "results.json").read_text())
    assert (told["bench"], told["about"]["lidar"], told["about"]["adc"]) == ("hil", "fake", "fake")
    assert (told["about"]["have"], told["about"]["walk-s"]) == ("-", "60.0"), "they are compared with another run's"


def test_a_terminal_that_is_not_there_is_said_once(tmp_path: Path) -> None:
    words = ["setsid", "--wait", *words_of(tmp_path, "--operator", "terminal", "-k", "unplugged")]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=100)
    assert (done.returncode, results_of(tmp_path)) == (4, {}), done.stdout
    assert done.stderr.count("Run it in a terminal") == 1


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--against", "old.json"], "say with --hil-report where it goes"),
        (["--hil-report", "/proc/here"], "--hil-report /proc/here: No such file or directory; name a folder"),
        (["--hil-report", "/dev/null"], "--hil-report /dev/null: File exists"),
        (["--hil-report", "/dev/null", "-n", "2"], "--hil-report tells of one process: leave -n out"),
    ],
)
def test_a_report_that_cannot_be_is_refused_before_anything_is_tried(options: list[str], says: str) -> None:
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/hil", "-k", "light_levels"]
    done = subprocess.run([*words, *options], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (done.returncode, says in done.stderr) == (4, True), done.stderr


def test_a_result_is_named_with_all_of_its_parameters() -> None:
    """Two that differ behind a slash are two, in the report and to what a later run is compared with."""
    for parameter in ("tcp://h/1", "a::/dev/ttyACM0"):
        name = f"test_lidar.py::test_line[{parameter}]"
        assert result_name(f"tests/hil/{name}") == name
    assert result_name("tests/hil/test_lidar.py") == "test_lidar.py"


STARTS = """
import sys, time
from pathlib import Path
from tests.hil.programs import Served, daemon, process
folder = Path(sys.argv[1])
waits = "import signal, sys, time; signal.signal(15, lambda *_: sys.exit(open(sys.argv[-1], 'w').close()))"
words = [sys.executable, "-c", waits + "; print('on', file=sys.stderr, flush=True); time.sleep(60)"]
with process([*words, str(folder / "fake")], lambda said: "on" in said) as one:
    with daemon(words, Served("line", None, folder), str(folder / "ended")) as other:
        time.sleep(1.0)
        print(one.pid, other.child.pid, flush=True)
        time.sleep(60)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_suite_that_is_killed_leaves_no_program_behind(number: int, tmp_path: Path) -> None:
    """What it has started for itself ends; the program under test is told to end, so that the laser is switched off."""
    with subprocess.Popen([sys.executable, "-c", STARTS, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE) as suite:
        assert suite.stdout is not None
        started = [Path("/proc", word) for word in suite.stdout.readline().decode().split()]
        assert len(started) == 2
        suite.send_signal(number)
        suite.wait(10.0)
    end = time.monotonic() + 10.0
    while any(one.exists() and "Z" not in (one / "stat").read_text().rpartition(")")[2] for one in started):
        assert time.monotonic() < end, "they go on"
        time.sleep(0.05)
    assert (tmp_path / "ended").exists()


@pytest.mark.parametrize("name", ["/dev/i2c-1", "@0x4d", "/dev/i2c-1@4d,", "/dev/i2c-1@"])
def test_a_converter_that_is_named_wrongly(name: str) -> None:
    with pytest.raises(pytest.UsageError, match="as /dev/i2c-1@0x4d"):
        AdcEnd(name)


def test_a_converter_is_named_by_bus_address_and_chip() -> None:
    assert where_on_a_bus("unix:/a@b@0x54,adc121c021") == ("unix:/a@b", 0x54, "ADC121C021")
    with pytest.raises(pytest.UsageError, match="chip foo: not known"):
        where_on_a_bus("/dev/i2c-1@0x4d,foo")
    with pytest.raises(pytest.UsageError, match="0x60: an MCP3221 answers at one of 0x48, "):
        where_on_a_bus("/dev/i2c-1@0x60")


def test_programs_and_operators_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(pytest.UsageError, match="no such program"):
        program(str(tmp_path / "lumiloop"))
    with pytest.raises(pytest.UsageError, match="no socket"):
        operator_for(str(tmp_path / "control"))
    assert operator_for("") is None
    if not _terminal():
        with pytest.raises(pytest.UsageError, match="Run it in a terminal"):
            operator_for("terminal")


def _terminal() -> bool:
    try:
        Path("/dev/tty").open("r+b", buffering=0).close()
    except OSError:
        return False
    return True
