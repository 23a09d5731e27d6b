"""The whole daemon in the simulated world in virtual time: bytes on a memory port, datagrams for the wheels."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from daemon.snapshot import State
from hal.replay.carmen import read_carmen
from tools.sim.harness import Run, run
from tools.sim.hybrid import HybridScene
from tools.sim.report import describe, write_csv
from tools.sim.robot.truth import in_map
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


def test_the_daemon_ends_up_tracking(paper: Run) -> None:
    assert paper.state[-1] == State.TRACKING
    assert paper.share(State.TRACKING, State.MAPPING) > 0.95
    assert paper.share(*State) == 1.0
    assert np.all(paper.known[-100:])


def test_a_run_can_be_told_and_written(paper: Run, tmp_path: Path) -> None:
    text = describe(paper)
    assert f"{len(paper.t_mono)} snapshots of {paper.scans_sent} scans, 0 missed" in text
    assert "TRACKING and more than 0.3 m off: 0.0% of the time" in text
    assert "the pose is confirmed" in text
    write_csv(paper, tmp_path / "run.csv")
    rows = np.genfromtxt(tmp_path / "run.csv", delimiter=",", names=True)
    np.testing.assert_allclose(
        np.hypot(rows["x"] - rows["true_x"], rows["y"] - rows["true_y"]), paper.error_m, atol=2e-6
    )


def test_one_seed_gives_one_run() -> None:
    a, b, c = run(4.0, Scenario(seed=3)), run(4.0, Scenario(seed=3)), run(4.0, Scenario(seed=4))
    np.testing.assert_array_equal(a.pose, b.pose)
    np.testing.assert_array_equal(a.state, b.state)
    assert a.pose.shape != c.pose.shape or not np.array_equal(a.pose, c.pose, equal_nan=True)


def test_without_wheels_the_laser_alone_does() -> None:
    blind = run(10.0, odometry=False)
    assert blind.snapshots[-1].odometry_ok is None
    assert np.nanmax(blind.error_m) < 0.2


def test_a_pulled_plug_is_seen_and_survived() -> None:
    faults = '[[fault]]\nwhere = "lidar"\nwhat = "hangup"\nwhen = 5.0\nfor = 1.5\n'
    out = run(14.0, faults=faults)
    during = (out.t_mono > 0) & (out.state == State.NO_LIDAR)
    assert during.any()
    assert out.state[-1] in (State.TRACKING, State.MAPPING, State.DEGRADED)
    assert out.error_m[-1] < 0.3


def test_other_buildings_and_lidars_run() -> None:
    out = run(8.0, Scenario("office_floor", "UST-20LX", people=False))
    assert np.nanmax(out.error_m) < 0.10
    out = run(8.0, Scenario("warehouse_hall", "URG-04LX-UG01"))
    assert out.scans_sent > 60


def test_a_daemon_that_never_gets_a_scan_is_an_error() -> None:
    faults = '[[fault]]\nwhere = "lidar"\nwhat = "off"\n'
    with pytest.raises(RuntimeError, match="never published a pose; its last state was"):
        run(3.0, faults=faults, odometry=False)


def test_truth_is_seen_from_the_map() -> None:
    truth = np.array([[1.0, 1.0, np.pi / 2], [1.0, 3.0, np.pi / 2]])
    seen = in_map(truth, truth[0], np.array([0.0, 0.0, 0.0]))
    np.testing.assert_allclose(seen, [[0, 0, 0], [2, 0, 0]], atol=1e-12)


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
