"""Link-level drives: records in order, and errors of the stated size."""

import numpy as np
import pytest

from estimator.cdma.epoch import LightEpoch
from estimator.measurements import Odometry
from tools.sim.ceiling.ceiling import IDEAL, paper_ceiling
from tools.sim.ceiling.lamps import Fixture
from tools.sim.ceiling.links import Links
from tools.sim.light.link_drive import LightRun, room_run

BRIGHT, DIM, DARK = 5e-7, 2e-8, 0.0


@pytest.fixture(scope="module")
def drive() -> LightRun:
    return room_run(seed=2)


def test_records_come_in_order_and_say_what_is_true(drive: LightRun) -> None:
    records = []
    for record in drive.records():
        if record.t_end > 20.0:
            break
        records.append(record)
    ends = [record.t_end for record in records]
    assert ends == sorted(ends)
    light = [record for record in records if isinstance(record, LightEpoch)]
    wheels = [record for record in records if isinstance(record, Odometry)]
    assert len(wheels) == pytest.approx(1000, abs=2)
    assert len(light) == pytest.approx(20.0 / 0.0503, abs=2)
    last = light[-1]
    truth = drive.ceiling.amplitudes(drive.truth(np.array([last.t_begin + 0.025])), np.array([last.t_begin + 0.025]))[0]
    rows = [k for code in last.ids for k, f in enumerate(drive.ceiling.fixtures) if f.code == code]
    error = (last.amplitude - truth[rows]) / np.sqrt(last.variance)
    assert len(rows) >= 8
    assert np.abs(error).max() < 5.0
    assert all(lamp is not None and lamp.lamp_id == row + 1 for lamp, row in zip(last.lamps, rows, strict=True))


def links_of(*codes: int) -> tuple[Links, object]:
    ceiling = paper_ceiling(IDEAL)
    ceiling.fixtures = tuple(
        Fixture(f.x, f.y, f.z, f.zone, f.lamp_id, code) for f, code in zip(ceiling.fixtures, codes, strict=False)
    )
    return Links(ceiling), ceiling


def test_errors_are_what_they_are_said_to_be() -> None:
    links, _ = links_of(1, 2)
    reports = [links.report(0.05 * k, 0.05 * (k + 1), np.array([BRIGHT, DIM])) for k in range(2000)][10:]
    error = np.array([r.amplitude - r.truth for r in reports])
    assert error[:, 1].std() == pytest.approx(0.205e-9, rel=0.1)
    assert np.abs(error.mean(axis=0)).max() < 0.02e-9
    assert np.mean(error[:, 1] ** 2 / reports[0].variance[1]) == pytest.approx(0.89, abs=0.08)
