"""The unit files as they are shipped: valid, hardened, and free of what would break the compiler."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

from daemon.cli import parser
from daemon.system.console import USAGE
from tests.systemd import pages

SYSTEMD = Path(__file__).parents[2] / "systemd"
UNIT = SYSTEMD / "lumiloop.service"
UNITS = sorted(path.name for path in (*SYSTEMD.glob("*.service"), *SYSTEMD.glob("*.timer")))
MOST_EXPOSED = 2.0
TAPS = {
    "view": "view", "foxglove": "foxglove", "metrics": "metrics", "record": "record-mcap", "ros2": "ros2",
    "fleet": "fleet join", "fleet-router": "fleet router",
}  # fmt: skip
"""Units of what listens to the daemon, and the commands that they start."""

needs_analyze = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")


def installed(order: str, dest: Path, prefix: str = "/opt/lumiloop", **more: str) -> subprocess.CompletedProcess[str]:
    """Carry out an order of the installer below a folder."""
    environment = {**os.environ, "DESTDIR": str(dest), "PREFIX": prefix, **more}
    return subprocess.run([SYSTEMD / "install.sh", order], env=environment, capture_output=True, text=True)


def settings(path: Path) -> list[tuple[str, str]]:
    lines = (line for line in path.read_text().splitlines() if line and line[0] not in "#[")
    return [(name, value) for name, _, value in (line.partition("=") for line in lines)]


@needs_analyze
@pytest.mark.parametrize("name", UNITS)
def test_the_service_manager_accepts_it(name: str, tmp_path: Path) -> None:
    for path in map(SYSTEMD.joinpath, UNITS):
        text = path.read_text().replace("/opt/lumiloop/bin/lumiloop", "/bin/true")
        (tmp_path / path.name).write_text(text)
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", "--recursive-errors=no", str(tmp_path / name)],
        capture_output=True, text=True,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")


@needs_analyze
@pytest.mark.parametrize("drop_in", sorted((SYSTEMD / "drop-ins").glob("*.conf")), ids=lambda path: path.stem)
def test_the_service_manager_accepts_it_with_a_drop_in(drop_in: Path, tmp_path: Path) -> None:
    for path in (*SYSTEMD.glob("*.service"), drop_in):
        place = tmp_path / ("lumiloop.service.d" if path == drop_in else "") / path.name
        place.parent.mkdir(exist_ok=True)
        place.write_text(path.read_text().replace("/opt/lumiloop/bin/lumiloop", "/bin/true"))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", "--recursive-errors=no", str(tmp_path / "lumiloop.service")],
        capture_output=True, text=True,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")


def test_a_drop_in_starts_the_unit_s_own_program() -> None:
    """With the words of the unit's, and more: the two must not part."""
    own = dict(settings(UNIT))["ExecStart"]
    starts = [
        line for path in (SYSTEMD / "drop-ins").glob("*.conf") for line in settings(path) if line[0] == "ExecStart"
    ]
    assert [value.startswith(own) for name, value in starts if value] == [True]


@needs_analyze
@pytest.mark.parametrize("name", [name for name in UNITS if name.endswith(".service")])
def test_it_is_hardened(name: str) -> None:
    done = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--no-pager", str(SYSTEMD / name)],
        capture_output=True, text=True,
    )  # fmt: skip
    exposure = re.search(rf"exposure level for {re.escape(name)}: ([\d.]+)", done.stdout)
    assert exposure is not None, done.stderr
    assert float(exposure.group(1)) <= MOST_EXPOSED


@pytest.mark.parametrize("name", ["lumiloop.service", "lumiloop-warmup.service"])
def test_kernels_may_be_compiled(name: str) -> None:
    """LLVM makes memory executable after writing it: with MemoryDenyWriteExecute= no start would succeed."""
    assert "MemoryDenyWriteExecute" not in dict(settings(SYSTEMD / name))


def test_both_units_share_user_and_cache() -> None:
    daemon, warmup = (dict(settings(SYSTEMD / name)) for name in ("lumiloop.service", "lumiloop-warmup.service"))
    for name in ("DynamicUser", "User", "CacheDirectory", "StateDirectory"):
        assert daemon[name] == warmup[name]


def test_lamps_are_looked_at_where_the_daemon_has_its_maps_and_its_stream() -> None:
    """Its folder of maps, by the same user; and its socket, in a folder that must outlast this unit."""
    daemon, lamps = (dict(settings(SYSTEMD / name)) for name in ("lumiloop.service", "lumiloop-lamps.service"))
    for name in ("DynamicUser", "User", "StateDirectory", "ConfigurationDirectory", "UMask"):
        assert daemon[name] == lamps[name]
    assert lamps["Environment"] == f"RUNTIME_DIRECTORY=/run/{daemon['RuntimeDirectory']}"
    assert "RuntimeDirectory" not in lamps
    assert lamps["ExecStart"].endswith("lumiloop lamps --config /etc/lumiloop/lumiloop.toml")
    assert dict(settings(SYSTEMD / "lumiloop-lamps.timer"))["OnCalendar"] == "daily"


def tap(name: str) -> list[tuple[str, str]]:
    return settings(SYSTEMD / f"lumiloop-{name}.service")


@pytest.mark.parametrize(("name", "command"), TAPS.items())
def test_what_listens_to_the_daemon_is_started_again_but_not_with_what_cannot_be(name: str, command: str) -> None:
    told = dict(tap(name))
    program = told["ExecStart"].replace("$$", "$")
    words = re.search(r"/opt/lumiloop/bin/lumiloop ([^']+)", program)
    assert words is not None
    given = [word for word in words[1].split() if word != "$OPTIONS"]
    assert " ".join(given).startswith(command)
    if name != "record":  # whose words are the shell's
        assert parser.parser().parse_args(given).config == Path("/etc/lumiloop/lumiloop.toml")
    assert program.rstrip("'").endswith("--config /etc/lumiloop/lumiloop.toml $OPTIONS")
    assert (told["Restart"], told["RestartPreventExitStatus"]) == ("always", str(USAGE))


@pytest.mark.parametrize("name", TAPS)
def test_what_listens_to_the_daemon_may_reach_its_stream_and_little_else(name: str) -> None:
    told, daemon = dict(tap(name)), dict(settings(UNIT))
    assert ("Environment", f"RUNTIME_DIRECTORY=/run/{daemon['RuntimeDirectory']}") in tap(name)
    assert "RuntimeDirectory" not in told  # it would be removed at the end of this
    assert told["SupplementaryGroups"] == "lumiloop-stream"
    assert (told["DynamicUser"], told["MemoryDenyWriteExecute"], told["PrivateDevices"]) == 3 * ("yes",)
    if name == "fleet":
        assert (told["User"], told["ReadOnlyPaths"]) == (daemon["User"], "/var/lib/private/lumiloop")
    else:
        assert told.get("User") is None


def test_what_listens_to_the_daemon_is_protected_alike() -> None:
    alike = [
        {
            pair
            for pair in tap(name)
            if re.match(r"Protect|Private|Restrict(?!Addr)|SystemCall|.*Cap|Lock|Proc", pair[0])
        }
        for name in TAPS
    ]
    assert len(alike[0]) > 20
    assert all(one == alike[0] for one in alike)


def test_nothing_is_switched_on_by_the_installation() -> None:
    for script in ("install.sh", "package.sh"):
        orders = re.findall(r"^\s*systemctl (\S+)", (SYSTEMD / script).read_text(), re.MULTILINE)
        assert set(orders) <= {"daemon-reload", "stop", "try-restart", "disable"}, script


RECORDER: Final = {"KEEP": "24", "SECONDS": "3600", "RESERVE": "200", "ROOM": "800"}


def pruned(folder: Path, **environment: str) -> list[str]:
    """What the shell's words before a recording leave, as the service manager would have them said."""
    told = dict(tap("record"))["ExecStartPre"].replace("$$", "$").replace("%%", "%")
    environment = {**os.environ, **RECORDER, "STATE_DIRECTORY": str(folder), **environment}
    subprocess.run(shlex.split(told), env=environment, check=True)
    return sorted(path.name for path in folder.glob("*.mcap"))


def recorded(folder: Path, hours: int) -> None:
    folder.mkdir()
    for hour in range(hours):
        (folder / f"20260101T{hour:02d}0000Z.mcap").touch()


def test_files_of_an_hour_are_kept_so_many(tmp_path: Path) -> None:
    told = dict(pair for pair in tap("record") if "KEEP" in pair[1])["Environment"]
    assert dict(word.split("=") for word in told.split()) == RECORDER
    recorded(tmp_path / "kept", 30)
    (tmp_path / "kept" / "other").touch()
    for _ in range(2):
        kept = pruned(tmp_path / "kept", RESERVE="0", ROOM="0")
        assert (len(kept), kept[0]) == (24, "20260101T060000Z.mcap")
    assert (tmp_path / "kept" / "other").exists()
    recorded(tmp_path / "empty", 0)
    assert pruned(tmp_path / "empty", RESERVE=str(10**9)) == []


@pytest.mark.parametrize(
    ("disk", "before", "after"),
    [
        (5000, 3, 3),  # there is room
        (5000, 7, 5),  # the oldest make room for an hour's, beside the reserve
        (1000, 1, 1),  # the newest stays for as long as the reserve is there
        (850, 1, 0),
    ],
)
def test_on_a_small_disk_the_newest_files_are_kept_and_the_reserve_stays_free(
    disk: int, before: int, after: int, tmp_path: Path
) -> None:
    """Files of 700 MB on a disk of so many: the oldest go, and the recorder is not refused for months."""
    recorded(tmp_path / "kept", before)
    (tmp_path / "stat").write_text(f'#!/bin/sh\necho "$(({disk} - 700 * $(ls *.mcap | wc -l)))*1048576"\n')
    (tmp_path / "stat").chmod(0o755)
    kept = pruned(tmp_path / "kept", PATH=f"{tmp_path}:{os.environ['PATH']}")
    assert kept == [f"20260101T{hour:02d}0000Z.mcap" for hour in range(before - after, before)]


def test_room_is_looked_for_on_the_recordings_own_disk(tmp_path: Path) -> None:
    recorded(tmp_path / "kept", 3)
    free = shutil.disk_usage(tmp_path).free >> 20
    assert len(pruned(tmp_path / "kept", RESERVE=str(free // 2), ROOM="0")) == 3
    assert len(pruned(tmp_path / "kept", RESERVE="0", ROOM=str(2 * free))) == 1
    assert pruned(tmp_path / "kept", RESERVE=str(2 * free)) == []


def test_every_unit_is_installed_and_removed(tmp_path: Path) -> None:
    script = (SYSTEMD / "install.sh").read_text()
    (taps,) = re.findall(r'^TAP_UNITS="(.*)"$', script, re.MULTILINE)
    assert taps.split() == [f"lumiloop-{name}.service" for name in TAPS]
    (told,) = re.findall(r'^UNIT_FILES="(.*)"$', script, re.MULTILINE)
    told = told.replace("$TAP_UNITS", taps)
    assert sorted(told.split()) == UNITS
    for name in told.split():
        unit = tmp_path / "usr/lib/systemd/system" / name
        unit.parent.mkdir(parents=True, exist_ok=True)
        unit.touch()
    installed("uninstall", tmp_path).check_returncode()
    assert not list(unit.parent.iterdir())
    (stopped,) = re.findall(r"disable --now (.*) \|\|", (SYSTEMD / "package.sh").read_text())
    assert sorted(stopped.replace("TAPS", taps).split()) == UNITS


def test_links_of_the_installed_pages_lead_somewhere(tmp_path: Path) -> None:
    """Pages lie beside other things there than in the tree; the environment is stood for by the code they name."""
    code = tmp_path / "opt/lumiloop/lib/python3.11/site-packages/estimator"
    code.mkdir(parents=True)
    for path in (SYSTEMD.parent / "estimator").rglob("*.py"):
        copy = code / path.relative_to(SYSTEMD.parent / "estimator")
        copy.parent.mkdir(exist_ok=True)
        copy.touch()
    for _ in range(2):  # an installation over an older one
        installed("files", tmp_path).check_returncode()
    assert len(list((tmp_path / pages.DOCUMENTS).rglob("*.md"))) > 40
    assert pages.dead_links(tmp_path) == []
    assert (tmp_path / pages.DOCUMENTS / "LICENSE").read_text() == (SYSTEMD.parent / "LICENSE").read_text()
    (tmp_path / pages.DOCUMENTS / "LICENSE").unlink()
    shutil.rmtree(code)
    dead = pages.dead_links(tmp_path)
    assert "README.md: LICENSE" in dead
    assert "docs/theory.md: ../estimator/light_filter/lambertian.py" in dead


def test_a_purge_leaves_nothing_that_a_unit_has_written(tmp_path: Path) -> None:
    """The recordings of a day are 17 GB, which nobody would look for once the program is gone."""
    kinds = {"StateDirectory": "var/lib", "CacheDirectory": "var/cache"}
    units = [pair for name in UNITS for pair in settings(SYSTEMD / name)]
    places = {f"{kinds[key]}/private/{value}" for key, value in units if key in kinds}
    assert len(places) >= 3
    for place in places:
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place.replace("/private", "")).symlink_to(f"private/{Path(place).name}")
    installed("uninstall", tmp_path).check_returncode()
    assert all((tmp_path / place).is_dir() for place in places)
    installed("uninstall", tmp_path, PURGE="1").check_returncode()
    assert [path for path in tmp_path.rglob("*lumiloop*") if "doc" not in path.parts] == []
    package = (SYSTEMD / "package.sh").read_text()
    for place in places:
        assert re.search(rf"rm -rf .*/{place}( |$)", package, re.MULTILINE), place
        assert re.search(rf"rm -f .*/{place.replace('/private', '')}( |$)", package, re.MULTILINE), place


def test_it_is_started_again_for_ever_but_not_with_a_configuration_that_is_wrong() -> None:
    told = dict(settings(UNIT))
    assert (told["StartLimitIntervalSec"], told["Restart"]) == ("0", "always")
    assert told["RestartPreventExitStatus"] == str(USAGE)


def test_the_page_names_the_devices_that_the_service_may_open() -> None:
    """Also those of a Raspberry Pi's own pins: a lidar by RS-232, a PLC by Modbus RTU."""
    allowed = [value for key, value in settings(UNIT) if key == "DeviceAllow"]
    assert "char-ttyAMA rw" in allowed
    page = (SYSTEMD.parent / "docs" / "installation.md").read_text()
    told = page.partition("The devices that it may open")[2].partition("`DeviceAllow=`")[0]
    names = re.findall(r"`(?:/dev/)?(\w+)-?\*`", told)
    assert [f"char-{name} rw" for name in names] == allowed


def test_devices_are_named_by_what_they_are() -> None:
    rules = (SYSTEMD / "60-lumiloop.rules").read_text()
    assert 'ATTRS{idVendor}=="15d1"' in rules
    assert 'ENV{ID_MM_DEVICE_IGNORE}="1"' in rules
    groups = set(re.findall(r'GROUP="(\w+)"', rules))
    assert groups == set(dict(settings(UNIT))["SupplementaryGroups"].split())
    made = set(re.findall(r"^g (\S+)", (SYSTEMD / "lumiloop.sysusers").read_text(), re.MULTILINE))
    assert made == groups | {dict(tap("view"))["SupplementaryGroups"]}


@pytest.mark.parametrize("order", ["install", "uninstall"])
def test_a_prefix_that_holds_other_things_is_left_alone(order: str, tmp_path: Path) -> None:
    """PREFIX=/usr/local is what other programs take; here it would be a directory that is removed as a whole."""
    other = tmp_path / "usr/local/bin/other"
    other.parent.mkdir(parents=True)
    other.touch()
    done = installed(order, tmp_path, "/usr/local", PYTHON=sys.executable)
    assert done.returncode == 1
    assert "must name a directory of its own" in done.stderr
    assert other.exists()


def test_what_an_interrupted_installation_has_left_is_removed(tmp_path: Path) -> None:
    made = tmp_path / "opt/lumiloop"
    made.mkdir(parents=True)
    (made / ".lumiloop").touch()
    installed("uninstall", tmp_path).check_returncode()
    assert not made.exists()
