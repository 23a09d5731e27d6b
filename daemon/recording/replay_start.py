"""Start of a replay within a recording: finds the checkpoint beside a segment and loads it into a cycle."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from hal.errors import DataInvalid
from hal.replay.recording import STATE_SUFFIX, Recording
from hal.replay.text import unreadable

if TYPE_CHECKING:  # loads the estimator
    from daemon.recording.state_schema import Node
    from daemon.runtime.cycle import Cycle
    from estimator import Job, State


CYCLE_PARTS: Final = (
    "period", "odometry", "imu", "cycles", "overruns", "verdict", "result", "observer", "_builder", "blocks", "lamps",
    "alarm", "trust", "inbox", "paused", "watch", "_left_out",
)  # fmt: skip
"""Attributes of `Cycle` that a checkpoint contains."""


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """A checkpoint on the disk.

    Attributes:
        path: of the file. t_mono: time of the capture, s. cycle: the last one before it.
        line: bytes of the lidar line that the codec needs, as records.
    """

    path: Path
    t_mono: float
    cycle: int
    line: bytes
    versions: dict[str, str]
    nodes: Iterator[Node]

    def load(self) -> Restored:
        """Returns the content; works once.

        Raises:
            DataInvalid: other software made it, or it is damaged.
        """
        from daemon.recording.restore import CannotRestore, restore
        from daemon.recording.state_file import BadState

        try:
            state, rest = restore(self.nodes)
            _check(rest)
        except (CannotRestore, BadState, ValueError) as error:
            made = ", ".join(f"{name} {number}" for name, number in sorted(self.versions.items()))
            raise DataInvalid(
                str(self.path), f"the checkpoint cannot be restored: {error}", f"replay it with {made}"
            ) from error
        return Restored(state, rest["jobs"], rest)


def _check(rest: dict[str, Any]) -> None:
    """Checks that the rest of a state has its parts.

    Raises:
        ValueError: one is missing, or there are others.
    """
    parts = [rest.get(name) for name in ("cycle", "jobs")] + [rest.get(name) or {} for name in ("samples", "blocks")]
    if not all(type(part) is dict for part in parts) or not isinstance(rest["cycle"].get("cycles"), int):
        raise ValueError("a cycle or its jobs are missing")
    if unknown := set(rest["cycle"]) - set(CYCLE_PARTS):
        raise ValueError(f"a cycle has no {', '.join(sorted(map(str, unknown)))}")


@dataclass(frozen=True, slots=True, eq=False)
class Restored:
    """A restored state of estimator and cycle.

    Attributes:
        state: estimator state. jobs: pending jobs by ID. rest: attributes of the cycle and its parts.
    """

    state: State
    jobs: dict[int, Job]
    rest: dict[str, Any]

    def keep_history(self) -> State:
        """Returns the state with its history enabled, which a replay reads at its end."""
        self.state.use(replace(self.state.settings, history=True))
        return self.state

    def put_into(self, cycle: Cycle) -> None:
        """Sets the stored attributes of a cycle and its parts."""
        for name, value in self.rest["cycle"].items():
            setattr(cycle, name, value)
        for part, remembered in (
            (cycle.parts.samples, self.rest["samples"]),
            (cycle.parts.blocks, self.rest["blocks"]),
        ):
            if part is not None and remembered is not None:
                for name in vars(part).keys() & remembered.keys() - {"status"}:
                    setattr(part, name, remembered[name])


def state_beside(segment: Path) -> Path:
    """Returns the path of a segment's checkpoint, whether the file exists or not."""
    return segment.with_suffix(STATE_SUFFIX)


def read_moment(path: Path) -> Moment:
    """Returns the checkpoint in a file.

    Raises:
        DataInvalid: the file is no checkpoint, or damaged. HalError: it cannot be read.
    """
    from daemon.recording.state_file import BadState, read_state

    try:
        header, line, nodes = read_state(path)
        return Moment(path, float(header["t_state"]), int(header["cycle"]), line, dict(header["versions"]), nodes)
    except OSError as error:
        raise unreadable(path, error) from error
    except BadState as error:
        raise DataInvalid(str(path), str(error), error.remedy) from error
    except (KeyError, TypeError, ValueError) as error:
        raise DataInvalid(str(path), str(error), BadState.remedy) from error


def beginning(recording: Recording, until: float = -math.inf) -> Recording:
    """Returns the recording from its beginning, or from the last checkpoint before ``until`` if that is later.

    ``until``: t_mono, s.

    The beginning is the start of the run, or else the first segment with a checkpoint. Without any checkpoint it is the
    first segment.

    Raises:
        DataInvalid: the run began before the first segment, and its states are of another format version.
    """
    from daemon.recording.state_file import BadState, OtherVersion, read_header

    begin, other = None, None
    for index, segment in enumerate(recording.segments):
        if segment.stem == "000000":
            begin = index if begin is None else begin
            continue
        try:
            header = read_header(state_beside(segment))
        except OtherVersion as error:
            other = other or DataInvalid(str(segment.parent), str(error), error.remedy)
            continue
        except (OSError, BadState, ValueError):
            continue
        if begin is None or float(header.get("t_state", math.inf)) <= until:
            begin = index
    if begin is None and other is not None:
        raise other
    segments = recording.segments[begin or 0 :]
    stem = segments[0].stem
    return replace(recording, segments=segments, first=int(stem) if begin is not None and stem.isdigit() else 0)
