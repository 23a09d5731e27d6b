"""Where the bench works and keeps things, and what a machine must have for it."""

import errno
import fcntl
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

MEMORY = Path("/dev/shm")
TOOLS = {
    "qemu-system-x86_64": "qemu-system-x86",
    "qemu-img": "qemu-utils",
    "mmdebstrap": "mmdebstrap",
    "mkfs.ext4": "e2fsprogs",
    "dpkg-deb": "dpkg",
    "chroot": "coreutils",
    "setpriv": "util-linux",
    "unshare": "util-linux",
}
BUILDING = frozenset({"qemu-img", "mmdebstrap", "mkfs.ext4", "dpkg-deb", "chroot", "unshare"})
"""Those that only making an image takes; running one takes QEMU alone."""


class CannotBench(Exception):
    """The bench cannot run here; the text says what is missing and how to get it."""


class BrokenOff(Exception):
    """Somebody wants the run to end before its end."""


def missing(build: bool = True) -> str:
    """What this machine lacks, with the remedy; empty if nothing."""
    path = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
    wanted = {tool: package for tool, package in TOOLS.items() if build or tool not in BUILDING}
    packages = sorted({package for tool, package in wanted.items() if shutil.which(tool, path=path) is None})
    if packages:
        return f"missing programs: apt-get install --no-install-recommends {' '.join(packages)}"
    if build and os.geteuid() != 0:
        return "making the image needs root (it is a Debian of its own, installed below a folder); run it once as root"
    return ""


def cache() -> Path:
    """The folder for what is made once."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lumiloop" / "vm"


@contextmanager
def workspace(name: str, room: int) -> Iterator[Path]:
    """A folder of this process that is gone afterwards, in memory where there is twice the room of ``room`` bytes.

    What a killed process of the same ``name`` could not remove is removed now, also where its number is ours by now.
    """
    in_memory = MEMORY.is_dir() and shutil.disk_usage(MEMORY).free > room and _memory_available() > 2 * room
    parent = MEMORY if in_memory else Path(tempfile.gettempdir())
    folder = parent / f"{name}-{os.getpid()}"
    for left in parent.glob(f"{name}-*"):
        number = re.fullmatch(rf"{re.escape(name)}-([0-9]+)", left.name)  # another workspace's name may begin so, too
        if number and (left == folder or not Path("/proc", number[1]).exists()):
            shutil.rmtree(left, ignore_errors=True)
    folder.mkdir(mode=0o755)
    try:
        yield folder
    finally:
        shutil.rmtree(folder)


def remedy(folder: Path) -> str:
    """What to do about something in the cache that is of no use."""
    return (
        f"remove {folder} as its owner or as root, then it is made anew; XDG_CACHE_HOME can name another place for "
        "what is kept"
    )


def missing_of(parts: Sequence[Path]) -> str:
    """Which of these files are missing or empty; empty text: none."""
    return ", ".join(f"no {part.name}" for part in parts if not part.is_file() or not part.stat().st_size)


def clear(folder: Path, lacks: str) -> None:
    """Remove what is not whole; raises `CannotBench` where this user may not."""
    shutil.rmtree(folder, ignore_errors=True)
    if folder.exists():
        raise CannotBench(f"{folder} is not whole ({lacks}), and this user may not remove it: {remedy(folder)}")


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Meanwhile :func:`discard` of any process leaves the folder alone; who may only read it can hold it, too.

    Raises:
        FileNotFoundError: it is not there, or was removed while somebody held it to do so.
    """
    kept = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(kept, fcntl.LOCK_SH)
        if not (folder.exists() and os.path.samestat(os.fstat(kept), folder.stat())):
            raise FileNotFoundError(errno.ENOENT, "removed by another process", str(folder))
        yield
    finally:
        os.close(kept)


def discard(folder: Path) -> bool:
    """Remove a folder that nobody holds; whether it is gone."""
    try:
        kept = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError:  # it is gone; or another user's, who lets nobody in
        return not folder.exists()
    try:
        fcntl.flock(kept, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    else:
        shutil.rmtree(folder, ignore_errors=True)
        return not folder.exists()
    finally:
        os.close(kept)


def _memory_available() -> int:
    lines = Path("/proc/meminfo").read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
