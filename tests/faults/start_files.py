"""A start and a save as far as files go, in a folder of their own: failing calls and power cuts are tried on it."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Final

from daemon.config import loader
from daemon.config.survey_loader import SurveyError
from daemon.devices.light_setup import load_lights
from daemon.devices.sample_clock import SampleClock
from daemon.maps.container import BadMap, unpack
from daemon.maps.initial_state import NoMap, started_in_time
from daemon.maps.last_pose import LastPose, Remembered
from daemon.maps.schema import read
from daemon.system.atomic_file import write_whole
from estimator.numerics.jit_cache_file import _CheckedFile
from tests.daemon.maps.killed_saves import MAP, numbered
from tests.daemon.support.map_maker import Shape, content

SAID: Final = (loader.ConfigError, SurveyError, NoMap)
"""Errors with which a start ends in order: the program prints them with their remedy."""
KERNEL: Final = list(range(1000))
CONFIG: Final = '[photodiode]\nbus = "/dev/i2c-1"\n[lights]\nsurvey = "lights.toml"\n[map]\nfolder = "maps"\n'
SURVEY: Final = "lamp = [{ lamp_id = 1, code = 5, x = 0.0, y = 0.0, z = 2.6 }]\n"
WHOLE: Final = content(Shape(submaps=3, frames=2, beams=31, map_id=MAP))
TABLES: Final = unpack(WHOLE)
META: Final = read(WHOLE).meta


def prepare(folder: Path) -> None:
    """Write the configuration, the survey, and what four runs leave."""
    (folder / "kernels").mkdir(parents=True)
    (folder / "robot.toml").write_text(CONFIG)
    (folder / "lights.toml").write_text(SURVEY)
    for _ in range(4):
        run(folder)


def run(folder: Path) -> int:
    """Read all that a start reads, and write all that it and its first save write; the number of the map at its start.

    Raises:
        Exception: one of `SAID`, or a defect.
    """
    _kernels(folder / "kernels")
    settings = loader.load(folder / "robot.toml")
    clock = SampleClock(settings.photodiode, folder)
    load_lights(settings, clock.ppm)
    store, start = started_in_time(settings.map, None)
    assert store is not None
    pose = LastPose(folder / "maps")
    session = 0 if start is None else start.stored.meta.session
    store.trial.begin()
    clock._write(float(session))
    pose._next, pose._stop = Remembered(MAP, (1.0, 2.0, 3.0), 1.7e9, pose._number + 1), True
    pose._turn()
    with contextlib.suppress(OSError, BadMap):  # the autosaver names it as a fault, and tries again
        store.save(numbered(TABLES, META, session + 1), MAP)
    store.lasted()
    store.close()
    return session


def sessions_in(folder: Path) -> list[int]:
    """Numbers of the good maps, the newest last."""
    found = []
    for path in sorted((folder / "maps").glob("map-*.lumimap")):
        with contextlib.suppress(BadMap):
            found.append(read(path.read_bytes()).meta.session)
    return found


def _kernels(folder: Path) -> None:
    """As the warm-up does with two kernels: load them, or store them and then the mark."""
    files = [
        _CheckedFile(cache_path=str(folder), filename_base=name, source_stamp=b"stamp") for name in ("first", "second")
    ]
    found = [file.load("signature") for file in files]
    assert all(one in (None, KERNEL) for one in found), "a kernel that is not the one that was stored"
    with contextlib.suppress(OSError):  # each start compiles it
        for file, one in zip(files, found, strict=True):
            if one is None:
                file.save("signature", KERNEL)
        if None in found:
            write_whole(folder / "warm", b"")
