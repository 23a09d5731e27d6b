"""Power cuts under the whole daemon: its real kernels, maps and state are on the disk, and a lidar delivers.

Two starts are recorded, each with the map that is saved at its end; some kernels are compiled by the first one. After a
cut the daemon must start from what is left, and publish a pose.
"""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from daemon.maps.generations import problem_of
from daemon.publish.modbus.client import NoAnswer, Reader
from daemon.runtime.warmup import load
from estimator import CACHE_DIR
from tests.faults.power.disk import Moment, Recording, cut, mounted, place, recorded
from tools.demo.run import free_port, running

DISK_BYTES: Final = 160 << 20
COMPILED: Final = ("block_ldl.*", "covariance3.*", "../warm-*")
"""Kernels that the first start finds missing, in the cache's folder of `numerics`; and the marks that all are there."""
POSE_S: Final = 120.0
LIDAR: Final = "URG-04LX-UG01"


@contextlib.contextmanager
def lidar(work: Path) -> Iterator[Path]:
    """A lidar that delivers."""
    device = work / "lidar"
    words = [sys.executable, "-m", "hal.fake", "--model", LIDAR, "--pty", str(device)]
    with running(words, work / "lidar.log", stdout=subprocess.DEVNULL) as fake:
        while not device.exists():
            assert fake.poll() is None
            time.sleep(0.05)
        yield device


def start(disk: Path, device: Path, work: Path) -> str:
    """Start the daemon and stop it in order after its first pose; what is wrong with that, empty: nothing."""
    port, log = free_port(), work / "daemon.log"
    words = [sys.executable, "-m", "daemon", "run", "--lidar", str(device), "--set", f"modbus.port={port}"]
    space = {"NUMBA_CACHE_DIR": disk / "kernels", "XDG_STATE_HOME": disk / "state", "XDG_RUNTIME_DIR": work / "run"}
    places = {name: str(folder) for name, folder in space.items()}
    end, known = time.monotonic() + POSE_S, False
    with running(words, log, stdout=subprocess.DEVNULL, env={**os.environ, **places}) as daemon:
        with Reader("127.0.0.1", port) as reader:
            while not known and daemon.poll() is None and time.monotonic() < end:
                time.sleep(0.2)
                with contextlib.suppress(NoAnswer):
                    known = reader.read()["map_x"] is not None
        daemon.terminate()
        code = daemon.wait(30.0)
    text = log.read_text(errors="replace")
    if not known or code or "Traceback" in text:
        return f"no start, or no pose: exit code {code}\n{text[-3000:]}"
    return ""


def furnish(disk: Path) -> None:
    """The kernels, but some."""
    load()
    kernels = disk / "kernels" / CACHE_DIR.name
    shutil.copytree(CACHE_DIR, kernels)
    for pattern in COMPILED:
        found = [*(kernels / "numerics_estimator").glob(pattern)]
        assert found, f"{pattern}: no kernel is missing, and none is compiled"
        for path in found:
            path.unlink()
    (disk / "state").mkdir()


def maps(disk: Path) -> int:
    """Number of stored maps that can be used."""
    return sum(problem_of(path) is None for path in (disk / "state").rglob("*.lumimap"))


def main(cuts: int, work: Path) -> list[str]:
    """Record once, cut so often; what was wrong."""
    made, draw, wrong = Recording(), random.Random(7), list[str]()
    with lidar(work) as device:
        with recorded(work, DISK_BYTES, furnish, made) as (disk, at):
            for phase in ("first start", "second start"):
                made.moments.append(Moment(at(), phase, maps(disk)))
                assert not (failed := start(disk, device, work)), failed
            made.moments.append(Moment(at(), "end", maps(disk)))
        spans = list(zip(made.moments, made.moments[1:], strict=False))
        for number in range(cuts):
            begin, end = spans[number % len(spans)]
            last = place(made, begin, end, draw)
            cut(made, work / "base", work / "cut", last, draw, number % 4 % 3)
            with mounted(work / "cut", work / "mount", "defaults") as disk:
                if maps(disk) < begin.saved:
                    wrong.append(f"cut at {last}: {begin.saved} maps were saved, {maps(disk)} are there")
                if failed := start(disk, device, work):
                    wrong.append(f"cut at {last}, in the {begin.phase}: {failed}")
    return wrong
