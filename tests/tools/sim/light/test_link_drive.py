"""Link-level drives: what is reported of the lamps, and how far the wheels go wrong."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.cdma.epoch import LightEpoch, LinkFlag
from estimator.measurements import Odometry
from tools.sim.ceiling.ceiling import IDEAL, Effects, paper_ceiling
from tools.sim.ceiling.lamps import Fixture
from tools.sim.ceiling.links import ACQUIRE, GIVE_UP, HEARD, Links
from tools.sim.ceiling.records import frames, light_epoch, survey
from tools.sim.light.link_drive import LightRun, room_run

BRIGHT, DIM, DARK = 5e-7, 2e-8, 0.0


@pytest.fixture(scope="module")
def drive() -> LightRun:
    return room_run(seed=2)


def test_the_room_drive_is_the_papers_length_and_dead_reckoning_ends_one_to_two_metres_off(drive: LightRun) -> None:
    assert drive.drive.length_m == pytest.approx(160.0, abs=3.0)
    assert drive.seconds == pytest.approx(320.0, abs=10.0)
    assert drive.world.clearance(drive.truth(np.linspace(0, drive.seconds, 2000))[:, :2]).min() > 0.4
    for run in (drive, room_run(seed=5), room_run(seed=6)):
        off = run.dead_reckoning()[-1, :2] - run.truth(np.array([run.seconds]))[0, :2]
        assert 1.0 < np.hypot(*off) < 2.0


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


def test_the_same_seed_gives_the_same_drive(drive: LightRun) -> None:
    first, again = next(iter(drive.light())), next(iter(drive.light()))
    np.testing.assert_array_equal(first.amplitude, again.amplitude)


def test_the_survey_is_the_plan_not_the_truth(drive: LightRun) -> None:
    told = survey(drive.ceiling)
    assert len(told.lamps) == 16
    assert {lamp.power_w for lamp in told.lamps} == {1.5}
    assert told.lamps[0].order == pytest.approx(0.6461, abs=1e-3)
    assert np.ptp(drive.ceiling.power_w) > 0.05
    assert (told.lamps[5].x, told.lamps[5].y) == (-1.25, -1.25)
    assert frames(drive.ceiling)[5].x_m == pytest.approx(-1.25)


def links_of(*codes: int) -> tuple[Links, object]:
    ceiling = paper_ceiling(IDEAL)
    ceiling.fixtures = tuple(
        Fixture(f.x, f.y, f.z, f.zone, f.lamp_id, code) for f, code in zip(ceiling.fixtures, codes, strict=False)
    )
    return Links(ceiling), ceiling


def test_a_lamp_is_believed_after_a_while_faint_when_dark_and_then_forgotten() -> None:
    links, _ = links_of(1, 2, 3)
    lit, shaded = np.array([BRIGHT, DIM, 0.5e-9]), np.array([BRIGHT, DARK, 0.5e-9])
    reports = [links.report(0.05 * k, 0.05 * (k + 1), lit) for k in range(HEARD + ACQUIRE)]
    assert len(reports[ACQUIRE - 2].lamp) == 0
    assert reports[ACQUIRE].lamp.tolist() == [0, 1]
    assert not reports[-8].told.any()
    assert reports[-1].told.all()
    dark = [links.report(9.0 + 0.05 * k, 9.05 + 0.05 * k, shaded) for k in range(GIVE_UP + 2)]
    assert dark[0].faint.tolist() == [False, True]
    assert dark[-1].lamp.tolist() == [0]
    back = [links.report(19.0 + 0.05 * k, 19.05 + 0.05 * k, lit) for k in range(ACQUIRE + 1)]
    assert back[-1].lamp.tolist() == [0, 1]
    assert back[-1].told.tolist() == [True, False]


def test_two_lamps_of_one_code_are_twins() -> None:
    links, ceiling = links_of(7, 9, 7)
    for k in range(ACQUIRE + 1):
        report = links.report(0.05 * k, 0.05 * (k + 1), np.array([BRIGHT, BRIGHT, DIM]))
    epoch = light_epoch(ceiling, report)  # type: ignore[arg-type]
    assert epoch.ids.tolist() == [7, 9, 7]
    assert (epoch.flags & LinkFlag.TWIN).astype(bool).tolist() == [True, False, True]


def test_errors_are_what_they_are_said_to_be() -> None:
    links, _ = links_of(1, 2)
    reports = [links.report(0.05 * k, 0.05 * (k + 1), np.array([BRIGHT, DIM])) for k in range(2000)][10:]
    error = np.array([r.amplitude - r.truth for r in reports])
    assert error[:, 1].std() == pytest.approx(0.205e-9, rel=0.1)
    assert np.abs(error.mean(axis=0)).max() < 0.02e-9
    assert np.mean(error[:, 1] ** 2 / reports[0].variance[1]) == pytest.approx(0.89, abs=0.08)


def test_more_spread_is_said_in_the_survey() -> None:
    assert survey(paper_ceiling(Effects(gain_spread=0.15))).lamps[0].sigma_ln == pytest.approx(0.15)
