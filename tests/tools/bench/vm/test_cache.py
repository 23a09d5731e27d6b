"""The virtual bench's cache: what others use stays, and what a killed making or first boot has left goes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tools.bench.vm import image, places
from tools.bench.vm.whole import note

ROOT = Path(__file__).parents[4]
HOLDS = """
import sys
from pathlib import Path
from tools.bench.vm.places import held
with held(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty one, in which an image is made in no time."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(image, "missing", lambda build: "")
    monkeypatch.setattr(image, "workspace", lambda name, room: places.held(tmp_path))
    monkeypatch.setattr(image, "_make_image", lambda folder, made, say: whole(made.folder))
    made = places.cache()
    made.mkdir(parents=True)
    return made


def whole(folder: Path) -> Path:
    """An image to look at."""
    folder.mkdir()
    for name in ("disk", "vmlinux", "initrd"):
        (folder / name).write_bytes(b"x")
    note(folder, image.Image(folder).parts)
    return folder


@contextmanager
def held_by_another(folder: Path) -> Generator[None]:
    """A process that uses it meanwhile."""
    words = [sys.executable, "-c", HOLDS, str(folder)]
    with subprocess.Popen(words, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == b"held\n"
        yield
        holder.communicate()


def test_an_image_that_another_run_uses_is_not_removed(cache: Path) -> None:
    """Its computers may be about to start from it."""
    used, unused = whole(cache / "image-used"), whole(cache / "image-unused")
    said: list[str] = []
    with held_by_another(used), image.image(said.append) as made:
        assert not made.lacks()
        assert set(cache.iterdir()) == {used, made.folder}, "the one that nobody uses is gone"
        assert not unused.exists()
        assert f"{used} stays: another run uses it" in said[-1]
        assert not places.discard(made.folder), "this run uses its own"
    assert places.discard(used)
    assert places.discard(used), "it is gone already"


def test_an_image_that_is_removed_before_it_is_held_is_made_once_more(
    cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken: list[Path] = []

    def late(folder: Path) -> object:
        if not taken:
            shutil.rmtree(folder)
        taken.append(folder)
        return places.held(folder)

    monkeypatch.setattr("tools.bench.vm.image.held", late)
    with image.image(lambda text: None) as made:
        assert not made.lacks()
    assert len(taken) == 2


def test_what_is_held_is_the_folder_that_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One who waits while it is removed and made anew holds nothing of the new one."""
    folder = tmp_path / "image-1"
    folder.mkdir()

    def removed_meanwhile(file: int, how: int) -> None:
        folder.rename(tmp_path / "old")
        folder.mkdir()

    monkeypatch.setattr("tools.bench.vm.places.fcntl.flock", removed_meanwhile)
    with pytest.raises(FileNotFoundError, match="removed by another process"), places.held(folder):
        pass


@pytest.mark.parametrize("number", [999999999, os.getpid()], ids=["nobody's", "ours"])
def test_what_a_killed_first_boot_has_left_is_removed(number: int, cache: Path) -> None:
    """Also where this process has got its number, and would make a folder of that name."""
    made = whole(cache / f"image-{image.image_key()}")
    left, others = made / f"part-{number}", made / f"part-{os.getppid()}"
    for one in (left, others):
        one.mkdir()
        (one / "memory").write_bytes(b"x")
    said: list[str] = []
    with image.image(said.append):
        assert not left.exists()
        assert others.exists(), "that process goes on"
    assert said == [f"removing {left}: left half done by a process that was ended"]
