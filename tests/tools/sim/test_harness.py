"""The whole daemon in the simulated world in virtual time: bytes on a memory port, datagrams for the wheels."""

from pathlib import Path

import numpy as np
import pytest

from hal.replay.carmen import read_carmen
from tools.sim.harness import Run, run
from tools.sim.hybrid import HybridScene
from tools.sim.scene import Scenario


@pytest.fixture(scope="module")
def paper() -> Run:
    """Twenty seconds of the paper's robot in the paper's room."""
    return run(20.0)


def test_the_pose_follows_the_truth_in_the_paper_room(paper: Run) -> None:
    """Laser errors here are biased by up to 2 cm; 10 cm is what nobody may exceed."""
    moved = np.hypot(*(paper.truth[-1, :2] - paper.truth[0, :2]))
    assert moved > 3.0
    assert np.nanmedian(paper.error_m) < 0.05
    assert np.nanmax(paper.error_m) < 0.10
    assert np.degrees(np.nanmedian(np.abs(paper.error_rad))) < 0.3


def test_no_scan_is_lost_between_sensor_and_snapshot(paper: Run) -> None:
    assert paper.snapshots[-1].missed == 0
    assert paper.scans_sent == pytest.approx(20.0 / 0.02505, abs=10)
    assert len(paper.t_mono) == pytest.approx(paper.scans_sent, abs=3)


def test_one_seed_gives_one_run() -> None:
    a, b, c = run(4.0, Scenario(seed=3)), run(4.0, Scenario(seed=3)), run(4.0, Scenario(seed=4))
    np.testing.assert_array_equal(a.pose, b.pose)
    np.testing.assert_array_equal(a.state, b.state)
    assert a.pose.shape != c.pose.shape or not np.array_equal(a.pose, c.pose, equal_nan=True)


def test_other_buildings_and_lidars_run() -> None:
    out = run(8.0, Scenario("office_floor", "UST-20LX", people=False))
    assert np.nanmax(out.error_m) < 0.10
    out = run(8.0, Scenario("warehouse_hall", "URG-04LX-UG01"))
    assert out.scans_sent > 60


def test_a_real_log_drives_the_whole_daemon(log_root: Path) -> None:
    """The first minute of a real log as bytes of a HOKUYO: the pose keeps near the log's own odometry."""
    log = read_carmen(log_root / "intel" / "intel.clf.gz")
    records = []
    for record in log.events(2.0):
        if record.t_mono > 62.0:
            break
        records.append(record)
    out = run(60.0, scene=HybridScene(records, mount=log.mount))
    assert np.isfinite(out.pose[-1]).all()
    assert len(np.unique(out.t_mono)) > 100
    driven = np.hypot(*np.diff(out.truth[:, :2], axis=0).T).sum()
    assert np.nanmax(out.error_m) < 0.3 + 0.05 * driven
