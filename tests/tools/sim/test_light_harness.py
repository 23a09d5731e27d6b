"""The whole daemon under coded lamps in virtual time: words on a memory bus, or decoded epochs."""

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
