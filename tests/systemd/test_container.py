"""The package on a fresh Debian under its real service manager: start, READY, devices, watchdog, kill, stop."""

import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from daemon.health import journal_fields
from tests.systemd import container, kernels
from tests.systemd.container import Container
from tests.systemd.pages import dead_links
from tools.bench.vm.places import workspace

ROOT = Path(__file__).parents[2]
UNIT, WARM_UP, METRICS = "lumiloop.service", "lumiloop-warmup.service", "lumiloop-metrics.service"
READY_S = 12.0
"""Four times the three seconds that a warm start may take from kill to READY."""
COMPILE_S = 600.0
ROOM = 3_000_000_000
"""Bytes that a session may need: the tree, its package, the base and what is installed there."""

CONFIG = """
[lidar]
device = "/dev/ttyACM0"
"""
DROP_IN = """
[Service]
DeviceAllow=char-pts rw
WatchdogSec=4
"""

CACHE = "var/cache/private/lumiloop"

pytestmark = [pytest.mark.system, pytest.mark.timeout(1500)]


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    """Where all of it happens."""
    if reason := container.missing():
        pytest.skip(reason)
    with workspace("lumiloop-container", ROOM) as made:
        yield made


@pytest.fixture(scope="module")
def tree(folder: Path) -> Path:
    """What `make install` yields below a directory of its own."""
    made = folder / "install"
    environment = {**os.environ, "DESTDIR": str(made), "PYTHON": "/usr/bin/python3"}
    subprocess.run([ROOT / "systemd/install.sh", "install"], check=True, env=environment, capture_output=True)
    return made


@pytest.fixture(scope="module")
def package(folder: Path, tree: Path) -> Path:
    """The Debian package of that tree; that of the taps lies beside it."""
    out = folder / "package"
    environment = {**os.environ, "TREE": str(tree), "PYTHON": "/usr/bin/python3"}
    done = subprocess.run([ROOT / "systemd/package.sh", out], check=True, env=environment, capture_output=True)
    return Path(done.stdout.decode().split()[-1])


@pytest.fixture(scope="module")
def lidar(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A UTM-30LX on a pseudo-terminal that the group dialout may use."""
    link = tmp_path_factory.mktemp("lidar") / "tty"
    command = [sys.executable, "-m", "hal.fake", "--model", "UTM-30LX", "--pty", str(link)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as fake:
        while not link.exists():
            assert fake.poll() is None
            time.sleep(0.02)
        device = link.resolve()
        shutil.chown(device, 0, "dialout")
        device.chmod(0o660)
        yield device
        fake.send_signal(signal.SIGINT)


@pytest.fixture(scope="module")
def machine(folder: Path, package: Path, lidar: Path) -> Iterator[Container]:
    """A Debian with the package installed by its own package manager."""
    root = folder / "root"
    container.unpack(root)
    for path in package.parent.glob("*.deb"):
        path.rename(root / path.name)
    container.inside(root, "dpkg", "-i", f"/{package.name}")
    (root / "etc/lumiloop/lumiloop.toml").write_text(CONFIG)
    drop_in = root / "etc/systemd/system/lumiloop.service.d"
    drop_in.mkdir(parents=True)
    (drop_in / "test.conf").write_text(DROP_IN)
    with container.booted(root, f"{lidar}:/dev/ttyACM0") as booted:
        yield booted


@pytest.fixture(scope="module")
def left_out(machine: Container, warm_kernels: None) -> list[Path]:
    """Kernels that the machine has to compile itself; it has all others."""
    from estimator.numerics.jit_cache import CACHE_DIR

    return kernels.plant(CACHE_DIR, machine.root / CACHE)


def listing(tree: Path) -> dict[str, str]:
    """Every file with what is in it, whatever the folder of the environment is called."""
    found = {}
    for path in sorted(tree.rglob("*")):
        name = re.sub(r"^(opt/lumiloop-versions)/[^/]+/", r"\1/*/", str(path.relative_to(tree)))
        if name.startswith(("DEBIAN/", "usr/lib/lumiloop/")) or name in ("opt/lumiloop", "opt/lumiloop-versions/.lock"):
            continue
        if path.is_symlink():
            found[name] = f"-> {path.readlink()}"
        elif path.is_file():
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


def test_the_package_is_what_the_installation_yields(tree: Path, package: Path, folder: Path) -> None:
    unpacked = folder / "unpacked"
    subprocess.run(["dpkg-deb", "-x", package, unpacked], check=True)
    assert listing(unpacked) == listing(tree)
    shutil.rmtree(unpacked)


def test_nothing_installed_names_the_place_where_it_was_built(tree: Path) -> None:
    for path in [*(tree / "opt/lumiloop/bin").iterdir(), tree / "opt/lumiloop/pyvenv.cfg"]:
        if path.is_file() and not path.is_symlink():
            assert str(tree) not in path.read_text(errors="replace"), path


def test_links_of_the_pages_lead_somewhere(tree: Path) -> None:
    assert dead_links(tree) == []


def test_the_installation_stays_below_its_bound(tree: Path) -> None:
    size = sum(path.lstat().st_size for path in tree.rglob("*") if path.is_file() and not path.is_symlink())
    assert size < 480e6


def test_it_compiles_what_is_missing_starts_and_says_ready(machine: Container, left_out: list[Path]) -> None:
    assert left_out
    machine.run("systemctl", "start", UNIT, seconds=COMPILE_S)
    machine.until(UNIT, READY_S, ActiveState="active", SubState="running")
    assert machine.show(WARM_UP, "Result") == {"Result": "success"}
    # not all: the tests' own kernels, which no start needs, lie in the same cache
    assert any(path.exists() for path in left_out)


def test_the_rest_was_found_where_an_earlier_start_would_have_left_it(machine: Container, left_out: list[Path]) -> None:
    """Else the test would take minutes, and say nothing about a start with kernels."""
    said = machine.run("journalctl", "--no-pager", "-u", WARM_UP)
    seconds = re.search(r"kernels compiled in ([\d.]+) s", said)
    assert seconds is not None, said
    packages = [package.parent.relative_to(ROOT) for package in (ROOT / "estimator").rglob("__init__.py")]
    expected = {"_".join(reversed(package.parts)) for package in packages}
    places = {path.name for path in left_out[0].parents[1].iterdir() if path.is_dir()}
    assert places <= expected
    assert {path.parent.name for path in left_out} <= places


def test_it_runs_as_nobody_in_particular_with_its_two_groups(machine: Container) -> None:
    status = Path(f"/proc/{_main(machine)}/status").read_text()
    fields = dict(line.split(":\t", 1) for line in status.splitlines() if ":\t" in line)
    assert 61184 <= int(fields["Uid"].split()[0]) <= 65519
    groups = machine.run("getent", "group", "dialout", "i2c")
    assert {line.split(":")[2] for line in groups.splitlines()} <= set(fields["Groups"].split())
    assert int(fields["CapEff"], 16) == 0
    assert fields["Seccomp"].strip() == "2"
    assert fields["NoNewPrivs"].strip() == "1"


def test_it_reads_the_lidar_and_publishes_a_pose(machine: Container) -> None:
    end = time.monotonic() + 20.0
    while True:
        last = machine.run("lumiloop", "status", "--json").splitlines()[-1]  # the first names the configuration
        said = json.loads(last)
        if said.get("state") in ("MAPPING", "TRACKING", "DEGRADED"):
            return
        assert time.monotonic() < end, said
        time.sleep(0.2)


def test_what_listens_to_the_daemon_reaches_it_by_its_group_and_others_do_not(machine: Container) -> None:
    """The unit of the metrics, which needs no extra; it is started first, and waits for the stream."""
    shutil.copy(ROOT / "systemd/drop-ins/stream-group.conf", machine.root / "etc/systemd/system/lumiloop.service.d")
    ask = "from urllib.request import urlopen as get; print(get('http://127.0.0.1:9464/metrics').read().decode())"
    assert machine.show(METRICS, "UnitFileState") == {"UnitFileState": "disabled"}
    machine.run("systemctl", "daemon-reload")
    machine.run("systemctl", "stop", UNIT)
    machine.run("systemctl", "start", METRICS)
    try:
        _until(lambda: "\nlumiloop_up 0\n" in machine.run("python3", "-c", ask, check=False))
        machine.run("systemctl", "start", UNIT)
        machine.until(UNIT, READY_S, ActiveState="active", SubState="running")
        _until(lambda: "\nlumiloop_up 1\n" in machine.run("python3", "-c", ask))
        assert "Permission denied" in machine.run("su", "nobody", "-s", "/bin/ls", "/run/lumiloop", check=False)
        status = machine.run("cat", f"/proc/{machine.show(METRICS, 'MainPID')['MainPID']}/status")
        assert "CapEff:\t0000000000000000\n" in status
        assert machine.show(METRICS, "NRestarts") == {"NRestarts": "0"}
    finally:
        machine.run("systemctl", "stop", METRICS)


def test_the_journal_has_fields(machine: Container) -> None:
    text = machine.run("journalctl", "--no-pager", "-o", "json", "-u", UNIT)
    entries = [json.loads(line) for line in text.splitlines() if line.startswith("{")]
    told = [entry for entry in entries if entry.get("MESSAGE_ID") == journal_fields.STATE_ID]
    assert told
    assert all(entry["LUMILOOP_STATE"] and entry["_SYSTEMD_UNIT"] == UNIT for entry in told)
    assert "What to do, if needed" in machine.run("journalctl", "--no-pager", "--catalog", "-u", UNIT)


def test_it_may_write_only_where_it_should(machine: Container) -> None:
    root = Path(f"/proc/{_main(machine)}/root")
    mounts = Path(f"/proc/{_main(machine)}/mountinfo").read_text()
    options = {line.split()[4]: line.split()[5] for line in mounts.splitlines()}
    assert re.match(r"ro\b", options["/"])
    for place in ("/var/lib/private/lumiloop", "/var/cache/private/lumiloop"):
        assert re.match(r"rw\b", options[place]), place
    assert (root / "var/cache/private/lumiloop").is_dir()


def test_a_hang_is_ended_by_the_watchdog(machine: Container) -> None:
    before = _main(machine)
    os.kill(before, signal.SIGSTOP)
    _restarted(machine, before, 4.0 + READY_S)
    log = machine.run("journalctl", "--no-pager", "-u", UNIT)
    assert "Watchdog timeout" in log


def test_a_killed_one_is_back_within_seconds(machine: Container) -> None:
    before = _main(machine)
    os.kill(before, signal.SIGKILL)
    _restarted(machine, before, READY_S)


@pytest.mark.slow
def test_the_first_start_of_a_version_compiles_everything_under_the_unit_s_restrictions(machine: Container) -> None:
    machine.run("systemctl", "stop", UNIT, WARM_UP)
    for old in (machine.root / CACHE).glob("kernels-*"):
        shutil.rmtree(old)
    machine.run("systemctl", "start", UNIT, seconds=COMPILE_S)
    machine.until(UNIT, READY_S, ActiveState="active", SubState="running")
    assert list((machine.root / CACHE).glob("kernels-*/warm-*"))  # made when all have been compiled


def test_the_taps_come_with_their_libraries_and_stay_through_an_upgrade(machine: Container) -> None:
    """The daemon that runs keeps its files; only an upgrade of its own package starts it anew."""
    core = next(path.name for path in machine.root.glob("lumiloop_*.deb"))
    taps = next(path.name for path in machine.root.glob("lumiloop-taps_*.deb"))
    needs = ("/opt/lumiloop/bin/python", "-c", "import aiohttp, foxglove, mcap, rosbags, zenoh")
    versions = machine.root / "opt/lumiloop-versions"
    before = _main(machine)
    machine.run("dpkg", "-i", f"/{taps}", seconds=300.0)
    machine.run(*needs)
    assert _main(machine) == before
    assert len([path for path in versions.iterdir() if path.name[0] != "."]) == 2, "one in use, one that runs"
    machine.run("dpkg", "-i", f"/{core}", seconds=300.0)
    _restarted(machine, before, READY_S)
    machine.run(*needs)
    assert len([path for path in versions.iterdir() if path.name[0] != "."]) <= 2
    assert machine.show(UNIT, "Result") == {"Result": "success"}
    machine.run("dpkg", "--remove", "lumiloop-taps")
    assert "No module named" in machine.run(*needs, check=False)
    for path in machine.root.glob("*.deb"):
        path.unlink()


def test_it_stops_cleanly(machine: Container) -> None:
    begun = time.monotonic()
    machine.run("systemctl", "stop", UNIT)
    assert time.monotonic() - begun < 8.0
    assert machine.show(UNIT, "Result", "ExecMainStatus") == {"Result": "success", "ExecMainStatus": "0"}


def test_it_is_removed_without_a_trace_but_what_it_has_learned(machine: Container) -> None:
    machine.run("systemctl", "enable", "--now", UNIT, seconds=READY_S)
    machine.until(UNIT, READY_S, ActiveState="active", SubState="running")
    machine.run("dpkg", "--remove", "lumiloop")
    assert machine.show(UNIT, "ActiveState")["ActiveState"] != "active"
    assert _main(machine) == 0
    assert list((machine.root / "etc/systemd/system").glob("*.wants/lumiloop*")) == []
    places = [machine.root / place for place in ("opt", "usr/bin", "usr/lib", "usr/share")]
    assert [path for place in places for path in place.rglob("*lumiloop*")] == []
    own = [machine.root / place for place in ("etc/lumiloop/lumiloop.toml", "var/lib/private/lumiloop", CACHE)]
    assert [path for path in own if not path.exists()] == []
    assert [path.name for path in own[1].rglob("*") if path.is_file()] != [], "what it has learned"
    machine.run("dpkg", "--purge", "lumiloop")
    kept = [machine.root / place for place in ("etc", "var/lib/private", "var/lib", "var/cache/private", "var/cache")]
    assert [path for place in kept for path in place.glob("lumiloop*")] == []


def _main(machine: Container) -> int:
    """The daemon's process as this machine numbers it; 0: none that has come so far."""
    inner = machine.show(UNIT, "MainPID")["MainPID"]
    for status in Path("/proc").glob("[0-9]*/status"):
        try:
            text = status.read_text()
            if re.search(rf"^NSpid:\t\d+\t{inner}$", text, re.MULTILINE) and "lumiloop" in text.split("\n", 1)[0]:
                return int(status.parent.name)
        except OSError:
            continue
    return 0


def _until(what: Callable[[], bool], seconds: float = READY_S) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, f"it has not come about within {seconds} s"
        time.sleep(0.1)


def _restarted(machine: Container, before: int, seconds: float) -> None:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        seen = machine.show(UNIT, "ActiveState", "SubState", "MainPID")
        up = (seen["ActiveState"], seen["SubState"]) == ("active", "running")
        if up and _main(machine) not in (0, before):
            return
        time.sleep(0.05)
    raise AssertionError(f"not back within {seconds} s: {seen}\n{machine.run('journalctl', '--no-pager', '-n', '30')}")
