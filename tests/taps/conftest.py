"""A short recorded drive, made once for all tests of the taps."""

from pathlib import Path

import pytest

from tests.daemon.replay.test_recorded_run import Bench, record


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight seconds with lidar, wheels and gyro."""
    folder = tmp_path_factory.mktemp("taps") / "rec"

    async def drive(bench: Bench) -> None:
        await bench.drive(8.0)

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(folder.parent / "state"))
        record(folder, drive)
    return folder
