"""Scans at the level of `step` are those that the fake sensor would have been given."""

import numpy as np

from estimator.measurements import Beam
from tools.sim.light.link_drive import tour_run
from tools.sim.scan_drive import Laser
from tools.sim.scene import Scenario, SimulatedScene


def test_a_scan_is_what_the_whole_scene_sees() -> None:
    run = tour_run("paper_room", seed=3)
    laser = Laser(run)
    scene = SimulatedScene(Scenario(seed=3, people=False, laps=1))
    scene.begin(0.0)
    for k in (0, 517, 3000):
        scan = laser.scan(k)
        words = scene.scan(k * laser.model.true_period_s).ranges_mm
        heard = (words >= laser.model.dmin) & (words <= laser.model.dmax)
        np.testing.assert_allclose(1e3 * scan.range_m, np.where(heard, words, 0), atol=1e-6)
        np.testing.assert_array_equal(scan.beam == Beam.HIT, heard)
        assert len(scan.range_m) == 721
        assert np.degrees(np.ptp(scan.bearing_rad)) == 180.0


def test_scans_of_a_span_follow_one_another() -> None:
    laser = Laser(tour_run("paper_room", seed=3))
    seen = list(laser.scans((10.0, 10.2)))
    assert [scan.seq for scan in seen] == list(range(seen[0].seq, seen[0].seq + len(seen)))
    assert seen[0].t_begin >= 10.0
    assert seen[-1].t_end < 10.2
    assert len(seen) == 7
