"""The whole daemon under coded lamps in virtual time: words on a memory bus, or decoded epochs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from daemon.snapshot import Snapshot
from tools.sim.harness import Run, run
from tools.sim.light.scene import LINK, Lights
from tools.sim.scene import Scenario, SimulatedScene

LIT = Scenario(lights=Lights(), seed=1, dwell_s=0.5)


def codes(snapshot: Snapshot) -> set[int]:
    return set() if snapshot.light is None else {link.code for link in snapshot.light.links}


def expected(scenario: Scenario, out: Run, row: int) -> dict[int, float]:
    """Strength of each code where the robot truly was."""
    scene = SimulatedScene(scenario)
    assert scene.light is not None
    ceiling = scene.light.ceiling
    received = ceiling.amplitudes(out.site[row][None], out.t_mono[row][None])[0]
    return {f.code: float(a) for f, a in zip(ceiling.fixtures, received, strict=True)}


@pytest.fixture(scope="module")
def waveform() -> Run:
    return run(4.0, LIT)


@pytest.fixture(scope="module")
def link() -> Run:
    return run(4.0, replace(LIT, lights=Lights(LINK)))


def test_lamps_are_decoded_beside_the_lidar(waveform: Run) -> None:
    last = waveform.snapshots[-1]
    assert last.adc_ok
    assert last.lidar_ok
    assert len(codes(last)) >= 8
    strong = sorted(expected(LIT, waveform, -1).items(), key=lambda item: -item[1])[:5]
    assert {code for code, _ in strong} <= codes(last)
    assert np.nanmax(waveform.error_m) < 0.5  # lamps that nobody has calibrated place it to within decimetres


def test_both_fidelities_report_the_same_lamps(waveform: Run, link: Run) -> None:
    assert link.snapshots[-1].adc_ok
    assert len(codes(waveform.snapshots[-1]) ^ codes(link.snapshots[-1])) <= 2
    for out in (waveform, link):
        assert np.hypot(*(out.site[-1, :2] - out.site[0, :2])) > 1.0


def test_one_seed_gives_one_run(waveform: Run) -> None:
    again = run(4.0, LIT)
    np.testing.assert_array_equal(again.pose, waveform.pose)
    assert [codes(s) for s in again.snapshots] == [codes(s) for s in waveform.snapshots]


def test_without_a_lidar_the_lamps_are_still_seen() -> None:
    scene = SimulatedScene(LIT)
    with pytest.raises(ValueError, match="lights must be in the scenario"):
        run(1.0, Scenario(), lidar=False)
    out = run(12.0, scene=scene, lidar=False)
    assert len(codes(out.snapshots[-1])) >= 8
    assert out.scans_sent == 0
    assert out.placed[-1]


def test_a_fault_of_the_converter_is_ordered_by_its_name() -> None:
    out = run(3.0, LIT, faults='[[fault]]\nwhere = "adc"\nwhat = "off"\nwhen = 2.0\n')
    assert any(snapshot.adc_ok for snapshot in out.snapshots)
    assert out.snapshots[-1].adc_ok is False


def test_a_fidelity_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ValueError, match="expected waveform or link"):
        Lights("ray")
