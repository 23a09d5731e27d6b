"""Condition of a map folder: usable map, write permission, and lock; nothing in it is changed."""

from __future__ import annotations

import contextlib
import fcntl
import os
from enum import Enum, auto
from pathlib import Path
from typing import Final

from daemon.config.paths import can_be_made, stored_maps
from daemon.config.schema import Config
from daemon.system.folder_lock import locked

LOCKS: Final = Path("/proc/locks")


class Maps(Enum):
    """Condition of a map folder."""

    READY = auto()
    EMPTY = auto()
    FROZEN = auto()
    TAKEN = auto()
    BROKEN = auto()


def look_at_maps(settings: Config) -> tuple[Maps, str]:
    """Returns the condition of the map folder and one line about it; nothing in it is changed.

    READY: there is a map to begin with. EMPTY: there is none yet, and maps can be stored. FROZEN: there is a map, but
    changes cannot be stored although they should be. TAKEN: the same while another process holds the folder; that may
    be the very daemon of this configuration. BROKEN: no map is usable, or none can be stored. The store logs each
    unusable file. The folder often belongs to another user.
    """
    folder = stored_maps(settings.map.folder)
    if not os.access(folder, os.F_OK):
        if not can_be_made(folder):
            text = (
                f"{folder}: this user cannot create the folder, so maps cannot be stored; name another in `map.folder`"
            )
            return Maps.BROKEN, text
        return Maps.EMPTY, f"{folder}: the folder does not exist yet; the daemon creates it for its maps"
    if not folder.is_dir():
        return Maps.BROKEN, f"{folder}: this is not a folder, so maps cannot be stored; name another in `map.folder`"
    if not os.access(folder, os.R_OK | os.X_OK):
        return Maps.BROKEN, f"{folder}: this user cannot read the maps in it"
    from daemon.config.survey_loader import SurveyError  # imports numpy, which no other remark needs
    from daemon.devices.light_setup import load_lights
    from daemon.maps.store import Store, judge_for, unjudged

    store = Store(folder, mend=False)
    try:
        judge = judge_for(load_lights(settings))
    except SurveyError:  # reported separately
        judge = unjudged
    start = store.load(judge)
    unwritten = not settings.map.localise and not os.access(folder, os.W_OK | os.X_OK)
    other = "" if settings.map.localise else _keeper(folder)
    more = "; this user cannot write to it (fault 403)" if unwritten else ""
    more += f"; {other} stores its maps there, so a second daemon would report fault 403" if other else ""
    if start is None:
        broken = store.refused or unwritten
        text = f"{folder}: {'no map in it can be used' if store.refused else 'no map in it yet'}{more}"
        return Maps.BROKEN if broken else Maps.TAKEN if other else Maps.EMPTY, text
    meta, count = start.stored.meta, len(start.stored.tables["submap.key"])
    named = f" ({meta.name})" if meta.name else ""
    text = f"{folder}: map {meta.map_id:08x}{named} of {count} submaps is valid{more}"
    return Maps.FROZEN if unwritten else Maps.TAKEN if other else Maps.READY, text


def _keeper(folder: Path) -> str:
    """Returns the holder of the folder's lock as text; empty if there is none."""
    try:
        for handle in locked(folder, fcntl.LOCK_SH):  # released at once: a starting daemon tries again
            os.close(handle)
    except BlockingIOError:
        about = folder.stat()
        named = f"{os.major(about.st_dev):02x}:{os.minor(about.st_dev):02x}:{about.st_ino}"
    except OSError:
        return ""
    else:
        return ""
    with contextlib.suppress(OSError):
        for line in LOCKS.read_text().splitlines():
            words = line.split()  # 3: FLOCK  ADVISORY  WRITE 1234 08:01:5678 0 EOF
            if "FLOCK" in words and words[-3] == named:
                return f"process {words[-4]}"
    return "another process"  # in another container, or on a file system with different device numbers
