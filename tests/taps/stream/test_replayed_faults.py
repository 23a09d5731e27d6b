"""Faults of a recorded run: a replay shows them as the daemon did, to files and to browsers."""

from pathlib import Path

import msgspec
import pytest

from daemon.config.schema import Config
from daemon.health.assessment import REPLAYED
from daemon.health.faults import FAULTS, Fault
from daemon.integrity.lamp_monitor import LASTS_S
from daemon.publish.stream.messages import Faults
from daemon.replay.sources import open_log
from taps.stream.recording_source import RecordingSource
from tests.daemon.replay.test_recorded_lights import Recorded, record
from tests.daemon.replay.test_recorded_run import pulled
from tests.daemon.replay.test_recorded_run import record as record_run
from tests.daemon.scenarios.test_lights import decoded

LATER_S = 3.0


async def lamps_go_out(bench: Recorded) -> None:
    """All of them; and come back."""
    await bench.until(decoded, 6.0)
    await bench.drive(2.0)
    bench.source.under(())
    await bench.drive(LASTS_S + LATER_S)
    bench.source.under((5, 17, 60, 101))
    await bench.drive(14.0)


@pytest.fixture(scope="module")
def dark(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, set[int]]:
    """The recording, and the numbers that the daemon told while it was made."""
    folder = tmp_path_factory.mktemp("dark") / "rec"
    bench = record(folder, lamps_go_out, lidar=True)
    told = {number for one in bench.snapshots if one.condition is not None for number in one.condition.faults}
    assert Fault.NO_LAMPS in told
    return folder, told & REPLAYED


def test_an_export_tells_them(dark: tuple[Path, set[int]]) -> None:
    recording, live = dark
    told = [
        frame for frame in RecordingSource(open_log(recording), Config()).frames(raw=False) if isinstance(frame, Faults)
    ]
    assert {one.fault for frame in told for one in frame.present} == live
    (came, *_) = (frame for frame in told if any(one.fault == Fault.NO_LAMPS for one in frame.present))
    (fault,) = (one for one in came.present if one.fault == Fault.NO_LAMPS)
    assert (fault.meaning, fault.remedy) == FAULTS[Fault.NO_LAMPS]
    assert came.t_mono is not None
    assert all(one.fault != Fault.NO_LAMPS for one in told[-1].present), "the lamps are on again"


def test_a_film_shows_them_when_they_were(dark: tuple[Path, set[int]], tmp_path: Path) -> None:
    from taps.view.replay_file import ReplayFile
    from taps.view.replay_recorder import make

    recording, live = dark
    make(open_log(recording), Config(), (False, ()), tmp_path / "film")
    film = ReplayFile(recording, tmp_path / "film")
    film.refresh()
    assert (film.done, film.error) == (True, "")
    reel = film.tracks["faults"]
    told = [msgspec.msgpack.decode(film.piece(reel, index))["data"]["present"] for index in range(len(reel.times))]
    assert {one["fault"] for present in told for one in present} == live
    came = next(t for t, present in zip(reel.times, told, strict=True) if any(one["fault"] == 171 for one in present))
    assert film.t_first + LASTS_S < came < film.t_last
    film.close()


def test_what_devices_said_is_told_as_it_was_published(tmp_path: Path) -> None:
    """A replay has no devices."""
    record_run(tmp_path / "rec", pulled)
    told = [
        frame
        for frame in RecordingSource(open_log(tmp_path / "rec"), Config()).frames(raw=False)
        if isinstance(frame, Faults)
    ]
    assert [any(one.fault == Fault.LIDAR_MISSING for one in frame.present) for frame in told] == [True, False]
    came, gone = (frame.t_mono for frame in told)
    assert came is not None
    assert gone is not None
    assert 4.0 < came < 6.0
    assert 8.0 < gone < 11.0, "once the lidar has started up"
