"""Hold a running process to a share of one core, by whatever this machine offers: control groups, else stop and go."""

import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PERIOD_US = 10_000
V2, V1 = Path("/sys/fs/cgroup"), Path("/sys/fs/cgroup/cpu")


@contextmanager
def held_back(pid: int, share: float) -> Iterator[str]:
    """All threads of a process get ``share`` of one core while the block runs; yields by which means."""
    group = _v2(share) or _v1(share)
    if group is None:
        with _stop_and_go(pid, share):
            yield "stop and go"
        return
    (group / "cgroup.procs").write_text(str(pid))
    try:
        yield str(group.parent)
    finally:
        with suppress(OSError):  # the process may have ended
            (group.parent / "cgroup.procs").write_text(str(pid))
        with suppress(OSError):
            group.rmdir()


def _v2(share: float) -> Path | None:
    """A group of the unified hierarchy, None where there is none or it may not be made."""
    group = V2 / f"lumiloop-{os.getpid()}"
    try:
        if "cpu" not in (V2 / "cgroup.subtree_control").read_text().split():
            return None
        group.mkdir()
        (group / "cpu.max").write_text(f"{round(share * PERIOD_US)} {PERIOD_US}")
    except OSError:
        with suppress(OSError):
            group.rmdir()
        return None
    return group


def _v1(share: float) -> Path | None:
    """The same of the older kind."""
    group = V1 / f"lumiloop-{os.getpid()}"
    try:
        group.mkdir()
        (group / "cpu.cfs_period_us").write_text(str(PERIOD_US))
        (group / "cpu.cfs_quota_us").write_text(str(round(share * PERIOD_US)))
    except OSError:
        with suppress(OSError):
            group.rmdir()
        return None
    return group


@contextmanager
def _stop_and_go(pid: int, share: float) -> Iterator[None]:
    """The process runs for a share of each period; what it did not need of it is lost, so this is the stricter way."""
    over = threading.Event()

    def turn() -> None:
        period = 1e-6 * PERIOD_US
        while not over.is_set():
            os.kill(pid, signal.SIGSTOP)
            time.sleep((1.0 - share) * period)
            os.kill(pid, signal.SIGCONT)
            time.sleep(share * period)

    thread = threading.Thread(target=turn, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
        os.kill(pid, signal.SIGCONT)


def cpu_s(pid: int) -> float:
    """Processor time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
