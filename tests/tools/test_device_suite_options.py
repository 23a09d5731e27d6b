"""What the suite on devices is told by its options: what cannot be is refused at once, before anything is compiled."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests import conftest
from tests.hil.ends import LidarEnd, place_of
from tests.hil.programs import ROOT, demand_lumiloop, program

SAYS = '#!/bin/sh\n[ "$1" = --version ] && echo {}\n'


def made(path: Path, text: str, mode: int = 0o755) -> str:
    """A program of a few words."""
    path.write_text(text)
    path.chmod(mode)
    return str(path)


def collected(*options: str) -> tuple[int, str]:
    """The suite, asked what it would try: exit code and output."""
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/hil", "--collect-only"]
    done = subprocess.run([*words, *options], cwd=ROOT, capture_output=True, text=True, timeout=60)
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize(
    ("option", "says"),
    [
        ("--lidar=", "argument --lidar: it is empty: name one, or leave the option out"),
        ("--adc=", "argument --adc: it is empty: name one, or leave the option out"),
        ("--program=", "argument --program: it is empty: name one, or leave the option out"),
        ("--lidar=/dev/ttyUSB0@1234", "--lidar /dev/ttyUSB0@1234: Expected a line rate of 19200, "),
        ("--odometry-port=99999999", "--odometry-port 99999999: name a port from 1 to 65535"),
        ("--odometry-port=0", "--odometry-port 0: name a port from 1 to 65535"),
        ("--program=/nosuch", "--program /nosuch: no such program; an installation has /opt/lumiloop/bin/lumiloop"),
    ],
)
def test_an_option_that_cannot_be_is_refused_at_once(option: str, says: str) -> None:
    """Also where no test that is chosen would come upon it."""
    code, said = collected(option, "-k", "light_levels")
    assert (code, says in said, "Traceback" in said) == (4, True, False), said


def test_a_program_that_is_no_lumiloop_is_told_by_what_it_says(tmp_path: Path) -> None:
    demand_lumiloop(made(tmp_path / "good", SAYS.format("lumiloop 0.1.0")))
    other = made(tmp_path / "other", SAYS.format("robotd 3") + "echo by somebody else\n")
    with pytest.raises(pytest.UsageError, match=r"other: no lumiloop: .* ends with 0 and says 'robotd 3'; an install"):
        demand_lumiloop(other)
    with pytest.raises(pytest.UsageError, match="ends with 3 and says 'nothing'"):
        demand_lumiloop(made(tmp_path / "fails", "#!/bin/sh\nexit 3\n"))
    with pytest.raises(pytest.UsageError, match=r"says nothing within 0\.1 s"):
        demand_lumiloop(made(tmp_path / "hangs", "#!/bin/sh\nexec sleep 20\n"), 0.1)
    with pytest.raises(pytest.UsageError, match="text: it may not be executed"):
        demand_lumiloop(made(tmp_path / "text", "", 0o644))
    with pytest.raises(pytest.UsageError, match="it cannot be started: "):
        demand_lumiloop(made(tmp_path / "empty", "no words of any program"))


def test_a_program_is_found_from_where_it_was_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is started in another folder."""
    made(tmp_path / "lumiloop", SAYS.format("lumiloop 1"))
    monkeypatch.chdir(tmp_path)
    assert program("./lumiloop") == [str(tmp_path / "lumiloop")]


def test_a_program_of_its_own_needs_no_kernels_of_this_tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From an empty folder of them; without the compiler, which would take a minute or more, there are none to come."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    shipped = made(tmp_path / "lumiloop", f'#!/bin/sh\ncd {ROOT} && exec {sys.executable} -m daemon "$@"\n')
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/hil", "-k", "probe_finds_it"]
    done = subprocess.run([*words, "--program", shipped], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stdout
    assert "compiled" not in done.stdout
    assert not list(tmp_path.glob("cache/*/warm-*")), "nothing was loaded"


def test_a_lidar_may_be_named_with_its_rate() -> None:
    """As `lumiloop probe` writes it."""
    end = LidarEnd("/dev/ttyUSB0@19200")
    assert (end.device, end.place.baud) == ("/dev/ttyUSB0", 19200)
    assert LidarEnd("tcp://10.0.0.1:10940").device == "tcp://10.0.0.1:10940"
    assert LidarEnd("fake").device.startswith("/dev/tty")
    with pytest.raises(pytest.UsageError, match=r"fast: Expected a line rate of 19200, .*; without one it is found"):
        place_of("/dev/ttyS0@fast")


@pytest.mark.timeout(200)
def test_what_is_compiled_takes_no_time_of_the_test_that_waits_for_it(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A small computer compiles for longer than a test may take."""
    left: list[float] = []

    def compiles(words: list[str], **how: object) -> SimpleNamespace:
        left.append(signal.getitimer(signal.ITIMER_REAL)[0])
        return SimpleNamespace(returncode=0)

    assert signal.getitimer(signal.ITIMER_REAL)[0] > 0.0, "this test's time is taken"
    monkeypatch.setattr(subprocess, "run", compiles)
    conftest.compile_kernels(request.config)
    assert left == [0.0]
    assert signal.getitimer(signal.ITIMER_REAL)[0] > 190.0, "from now on"
