"""An upgrade is built beside the version in use: whatever happens to it, the version of before runs on."""

import fcntl
import mmap
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.systemd.installing import SITE, SYSTEMD, Bench, killed

SCRIPT = SYSTEMD / "environment.py"


@pytest.fixture
def memory() -> Iterator[Path]:
    """A folder in memory, where that is to be had: an installation waits for its disk."""
    shm = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=shm if os.access(shm, os.W_OK) else None) as folder:
        yield Path(folder)


@pytest.fixture
def bench(memory: Path) -> Bench:
    """A place with one version."""
    made = Bench(memory)
    done = made.order("install")
    assert done.returncode == 0, done.stderr
    return made


@pytest.fixture
def packages(memory: Path) -> Bench:
    """What dpkg has unpacked of lumiloop and of lumiloop-taps, put together."""
    bench = Bench(memory)
    assert bench.order("install").returncode == 0
    (bench.versions / ".taps" / SITE).mkdir(parents=True)
    bench.root.resolve().rename(bench.versions / ".package")
    bench.root.unlink()
    taps = bench.versions / ".taps" / SITE
    (taps / "aiohttp-1.0.dist-info").mkdir()
    (taps / "aiohttp-1.0.dist-info/METADATA").write_text("Name: aiohttp\nVersion: 1.0\n")
    (taps / "aiohttp.py").touch()
    done = bench.order("compose", script="environment.py")
    assert done.returncode == 0, done.stderr
    return bench


def test_an_upgrade_takes_the_place_of_the_version_of_before(bench: Bench) -> None:
    before = bench.root.readlink()
    assert before.parent == Path("lumiloop-versions"), "the link holds below DESTDIR, too"
    assert bench.order("install").returncode == 0
    assert bench.root.readlink() != before
    assert bench.kept() == [bench.root.readlink().name]
    first = (bench.root / "bin/lumiloop").read_text().splitlines()[0]
    assert first == f"#!/opt/lumiloop-versions/{bench.root.readlink().name}/bin/python"
    assert str(bench.dest) not in (bench.root / "pyvenv.cfg").read_text()
    assert not list(bench.dest.rglob("*.lumiloop-new"))


@pytest.mark.parametrize(
    ("how", "at"), [("fail", (1, 2, 3, 4, 5)), ("kill", (2,)), ("kill parent", (2, 4)), ("stop parent", (4,))]
)
def test_an_upgrade_that_fails_at_any_step_leaves_the_version_of_before(
    bench: Bench, how: str, at: tuple[int, ...]
) -> None:
    bench.add("aiohttp")
    before = bench.listing()
    for step in at:
        done = bench.order("build", script="environment.py", SPOIL=f"{step}:{how}")
        assert done.returncode != 0
        assert bench.listing() == before
        if how in ("fail", "kill"):
            assert f"the one in {bench.root} is unchanged" in done.stderr
            assert ("want of memory" in done.stderr) is (how == "kill")
        if how != "kill parent":
            assert len(bench.kept()) == 1, "nothing half done is left"
    assert bench.order("build", script="environment.py").returncode == 0
    assert len(bench.steps) == 6, "venv, three times pip install, pip uninstall, compileall"
    assert len(bench.kept()) == 1


def test_a_full_disk_and_a_memory_limit_are_named(bench: Bench) -> None:
    before = bench.listing()
    done = bench.changed("versions.FULL_BYTES = 1 << 60", "build", SPOIL="2:fail")
    assert "is full; the one in" in done.stderr
    no_room = "def fails(*_): raise OSError(28, 'No space left on device')\nenvironment.strip = fails"
    assert "No space left on device; the one in" in bench.changed(no_room, "build").stderr.replace("] ", "")
    no_memory = "def fails(*_): raise MemoryError\nenvironment.strip = fails"
    assert "not enough memory; the one in" in bench.changed(no_memory, "build").stderr
    assert bench.listing() == before


def test_files_that_cannot_be_written_to_the_disk_are_not_put_into_use(bench: Bench) -> None:
    before = bench.listing()
    for call in ("sync", "rename"):
        fails = f"def fails(*_): raise OSError(5, 'Input/output error')\nversions.{call if call == 'sync' else 'Path'}"
        change = f"{fails} = fails" if call == "sync" else f"{fails}.replace = fails"
        done = bench.changed(change, "build")
        assert (done.returncode, "unchanged" in done.stderr) == (1, True)
        assert bench.listing() == before


def test_extras_and_drivers_that_a_person_has_added_are_there_after_an_upgrade(bench: Bench) -> None:
    bench.add("aiohttp")  # the extra `view`
    bench.add("a-lidar-driver")
    done = bench.order(
        "build", script="environment.py", EXTRAS='aiohttp<5,>=4; extra == "view"|eclipse-zenoh; extra == "zenoh"'
    )
    assert done.returncode == 0, done.stderr
    (fetched,) = [step for step in bench.steps if " -c " in step]
    assert fetched.endswith("aiohttp<5,>=4"), "as the new version asks for it, and no other extra"
    assert bench.has("aiohttp")
    assert bench.has("a-lidar-driver")
    assert not bench.has("eclipse-zenoh")
    assert bench.order("build", script="environment.py").returncode == 0
    assert bench.has("a-lidar-driver"), "and after the next one"


def test_what_another_python_has_is_named_and_not_taken_over(bench: Bench) -> None:
    bench.add("a-lidar-driver")
    lib = bench.root.resolve() / "lib"
    (lib / "python3.11").rename(lib / "python3.10")
    done = bench.order("build", script="environment.py")
    assert done.returncode == 0
    assert "not taken over, because made for another Python: a-lidar-driver" in done.stderr


def test_two_installations_at_once_are_refused(bench: Bench) -> None:
    with (bench.versions / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = bench.order("install")
    assert done.returncode == 1
    assert "another installation into" in done.stderr


def test_a_program_that_runs_keeps_its_version(bench: Bench) -> None:
    before = bench.root.resolve()
    library = before / "lib/library.so"
    library.write_bytes(b"library")
    with library.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ):
        assert bench.order("build", script="environment.py").returncode == 0
        assert bench.root.resolve() != before
        assert library.exists()
    assert bench.order("build", script="environment.py").returncode == 0
    assert not before.exists()


def test_an_environment_in_the_folder_itself_is_exchanged(bench: Bench) -> None:
    """As versions before this one were laid down."""
    environment = bench.root.resolve()
    bench.root.unlink()
    environment.rename(bench.root)
    shutil.rmtree(bench.versions)
    assert bench.order("install", SPOIL="3:fail").returncode == 1
    assert (bench.root / "bin/lumiloop").exists()
    assert bench.order("install").returncode == 0
    assert bench.root.is_symlink()
    assert bench.kept() == [bench.root.readlink().name]


def test_a_removal_leaves_nothing_but_the_configuration(bench: Bench) -> None:
    assert bench.order("uninstall").returncode == 0
    left = [path for path in bench.dest.rglob("*") if not path.is_dir() or path.is_symlink()]
    assert left == [bench.dest / "etc/lumiloop/lumiloop.toml"]


def test_packages_put_together_have_the_taps_and_what_was_added(packages: Bench) -> None:
    assert packages.has("aiohttp")
    assert packages.has("lumiloop")
    packages.add("a-lidar-driver")
    assert packages.order("compose", script="environment.py").returncode == 0
    assert packages.has("a-lidar-driver")
    assert len(packages.kept()) == 1
    shutil.rmtree(packages.versions / ".taps")
    assert packages.order("compose", script="environment.py").returncode == 0
    assert packages.has("a-lidar-driver")
    assert not packages.has("aiohttp"), "a removed package takes its libraries along"


def test_what_dpkg_does_to_its_own_files_does_not_reach_the_version_in_use(packages: Bench) -> None:
    """It renames new files over them, or removes them, and may be interrupted between any two."""
    before = packages.listing()
    unpacked = packages.versions / ".package"
    for path in [path for path in unpacked.rglob("*") if path.is_file()]:
        new = path.with_name(f"{path.name}.dpkg-new")
        new.write_bytes(b"half")
        new.replace(path)
    assert packages.listing() == before
    done = packages.order("compose", script="environment.py")
    assert done.returncode == 1
    assert "unchanged" in done.stderr
    assert packages.listing() == before


def kills(bench: Bench, order: str, share: int) -> None:
    """End an order before each ``share``-th of its changes of files: a version is in use, and it is whole."""
    whole = {name.partition("lumiloop-versions/")[2].partition("/")[2]: text for name, text in bench.listing().items()}
    calls = int(killed(bench, SCRIPT, order, 0).stdout)
    assert calls > 40
    for at in range(1, calls + 1, share):
        killed(bench, SCRIPT, order, at)
        found = bench.listing()
        names = {name.partition("lumiloop-versions/")[2].partition("/")[2] for name in found}
        assert names >= set(whole), at
    assert bench.order(order, script="environment.py").returncode == 0
    assert len(bench.kept()) == 1


@pytest.mark.parametrize("order", ["build", "compose"])
def test_a_kill_at_any_change_of_a_file_leaves_a_version(packages: Bench, order: str) -> None:
    kills(packages, order, share=40)


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("order", ["build", "compose"])
def test_a_kill_at_more_changes_of_files_leaves_a_version(packages: Bench, order: str) -> None:
    kills(packages, order, share=7)
