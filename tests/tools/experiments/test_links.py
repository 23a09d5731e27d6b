from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimator.light_filter.survey import Survey
from estimator.paper.lateration import Solver, SolverSettings
from tools.experiments import adaptive
from tools.experiments.paper_figures import fig4, fig4_recorded
from tools.experiments.support.places import CENTRED, error, grid, sheet_of, spots
from tools.experiments.support.report import Work
from tools.sim.building.world import Plan
from tools.sim.ceiling.ceiling import IDEAL, Ceiling
from tools.sim.ceiling.lamps import row, with_codes


def ideal(seed: int = 0) -> tuple[Ceiling, Survey]:
    """Lambertian lamps in empty space."""
    plan = Plan()
    plan.outline([(-5.0, -5.0), (5.0, -5.0), (5.0, 5.0), (-5.0, 5.0)])
    ceiling = Ceiling(with_codes(row(fig4.ROOM, 2.9, 2.5)), plan.build(), 3.0, IDEAL, CENTRED, seed=seed)
    return ceiling, replace(sheet_of(ceiling, 0.01), floor=0.0)


def test_simulator_and_solver_agree_where_nothing_departs_from_the_book() -> None:
    """Two implementations of Eq. 1 and 2 that share no code; what is left is noise, lamps' size and smooth edges."""
    ceiling, sheet = ideal()
    at = grid((-4.5, 4.5), (-4.5, 4.5), 1.5)
    for spot in spots(ceiling, sheet, at, np.random.default_rng(1)):
        assert 3 <= len(spot.received.lamps) <= 12
        assert error(spot, sheet, SolverSettings(Solver.ML, None)) < 0.02


def test_lamps_out_of_view_are_told_apart() -> None:
    ceiling = fig4.plain_room(0)
    sheet = sheet_of(ceiling, 0.03)
    at = np.array([(0.1, 0.2)])
    seen, heard = (spots(ceiling, sheet, at, np.random.default_rng(1), beyond)[0] for beyond in (False, True))
    assert len(seen.received.lamps) < len(heard.received.lamps) == 16
    in_view = {lamp.lamp_id for lamp in seen.received.lamps}
    far = [
        a for lamp, a in zip(heard.received.lamps, heard.received.amplitude, strict=True) if lamp.lamp_id not in in_view
    ]
    assert max(far) < min(seen.received.amplitude)


def test_grid_is_centred() -> None:
    at = grid((-5.0, 5.0), (0.0, 2.0), 1.0)
    assert at.shape == (20, 2)
    np.testing.assert_allclose(at.mean(axis=0), (0.0, 1.0))
    assert at[:, 0].min() == -4.5


def test_tour_stays_in_its_zone() -> None:
    at = adaptive.tour(adaptive.ROOMS[0], 160)
    assert len(at) > 40
    assert np.abs(at).max() < 5.0
    assert len(adaptive.tour(adaptive.ROOMS[1], 30)) == 30


def test_comparison_knows_better_worse_and_equal() -> None:
    rng = np.random.default_rng(2)
    fixed = rng.uniform(10.0, 20.0, (3, 200)) * np.array([[1.0], [1.1], [1.3]])
    for factor in (0.8, 1.0, 1.25):
        best, ratio, low, high = adaptive.compared(np.vstack([fixed, factor * fixed[:1]]), adaptive.rms, rng)
        assert best == 0
        assert ratio == pytest.approx(factor)
        assert low - 1e-9 <= factor <= high + 1e-9
        assert (high < 1.0) == (factor < 1.0)
        assert (low > 1.0) == (factor > 1.0)


@pytest.mark.slow
def test_number_of_links_experiment_runs() -> None:
    report = fig4.run(True, Work())
    names = [row[0] for row in report.tables[0].rows]
    values = {str(row[0]): np.array(row[1:], dtype=float) for row in report.tables[0].rows}
    assert names[0] == fig4.PLAIN
    assert np.all(values[fig4.OURS] < values[fig4.PLAIN])
    assert values["ls with the floor taken off"][3] < values[fig4.PLAIN][3]
    beyond = values["ls, lamps out of view too"]
    assert beyond[-1] > 2.0 * values[fig4.PLAIN][-1]


@pytest.mark.slow
def test_adaptive_experiment_runs() -> None:
    report = adaptive.run(True, Work())
    assert len(report.tables) == 2 * len(adaptive.ROOMS)
    for part in report.tables:
        for line in part.rows:
            values = [float(v) for v in line[1 : len(adaptive.FIXED) + 2]]
            assert np.isfinite(values).all()
            assert line[-2] == pytest.approx(values[-1] / min(values[:-1]))


def test_recorded_strengths(log_root: Path) -> None:
    """The weighted solver gains with every link on real light, too; the plain one does not."""
    for part in fig4_recorded.recorded(True, Work()):
        rows = {str(row[0]): np.array(row[1:], dtype=float) for row in part.rows}
        assert rows["ml, median"][2] <= 1.1 * rows["ml, median"][0]
        assert rows["ml, median"][2] < 10.0
        assert rows["ml, 90th percentile"][2] < rows["ls, 90th percentile"][2]
