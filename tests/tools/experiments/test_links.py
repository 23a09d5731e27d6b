from dataclasses import replace
from pathlib import Path

import numpy as np

from estimator.light_filter.survey import Survey
from estimator.paper.lateration import Solver, SolverSettings
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


def test_recorded_strengths(log_root: Path) -> None:
    """The weighted solver gains with every link on real light, too; the plain one does not."""
    for part in fig4_recorded.recorded(True, Work()):
        rows = {str(row[0]): np.array(row[1:], dtype=float) for row in part.rows}
        assert rows["ml, median"][2] <= 1.1 * rows["ml, median"][0]
        assert rows["ml, median"][2] < 10.0
        assert rows["ml, 90th percentile"][2] < rows["ls, 90th percentile"][2]
