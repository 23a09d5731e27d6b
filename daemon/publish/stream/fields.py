"""Field names and types of each topic of the local stream, part of the contract (docs/stream.md).

Types are those of msgpack; ``s`` is a float, ``f32[]`` bytes of little-endian float32. Under one `stream.SCHEMA` no
field is removed or changed; fields may be added.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from daemon.snapshot import LightPicture, Snapshot

Fields = Mapping[str, str]

_SAID: Final = {"state_name": "str", "meaning": "str", "remedy": "str"}
RECORDS: Final[Mapping[str, type]] = {"pose": Snapshot, "lights": LightPicture}
"""Topics that contain a record of `daemon.snapshot` with all its fields."""
FIELDS: Final[Mapping[str, Fields]] = {
    "hello": {"schema": "int", "name": "str", "pid": "int", "topics": "map of str"},
    "error": {"text": "str"},
    "pose": _SAID,
    "lights": {},
    "scan": {
        "seq": "int", "t_mono": "s, of the first beam", "bearing_first": "rad", "bearing_step": "rad",
        "ranges": "f32[] m, not a number: none", "range_min": "m", "range_max": "m", "beam_dt": "s", "period": "s",
    },
    "state": {"t_mono": "s", "state": "int", **_SAID},
    "loop": {
        "t_mono": "s", "counter": "int", "keyframe_new": "int", "keyframe_old": "int", "reason": "int",
        "residual": "m", "at_new": "[m, m, rad] or nil", "at_old": "[m, m, rad] or nil",
    },
    "faults": {"t_mono": "s or nil", "present": "list of {fault: int, meaning: str, remedy: str, cause: int}"},
    "statistics": {
        "t_mono": "s", "uptime": "s", "memory_mb": "MB", "cycles": "int", "overruns": "int", "cycle_us": "us or nil",
        "jobs_failed": "int", "scan_period": "s", "scans": "int", "scans_missed": "int", "scans_invalid": "int",
        "scans_dropped": "int", "resyncs": "int", "reconnects": "int", "blocks": "int or nil",
        "blocks_lost": "int or nil", "odometry_jumps": "int",
    },
    "raw": {"device": "str", "kind": "str", "t_mono": "s", "bytes": "bytes"},
    "raw of samples": {"rate": "Hz", "bits": "int"},
    "map": {
        "map_id": "int", "resolution": "m", "side": "int", "unit": "float", "version": "int", "more": "bool",
        "tiles": "list of [column: int, row: int, cells: deflated int8[side * side]]",
    },
}  # fmt: skip
"""Fields by topic; `pose` and `lights` in addition to :data:`RECORDS`."""
