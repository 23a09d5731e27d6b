"""Position error against the number of links on recorded strengths: the same solvers on the public static campaigns.

Split half, as in `static`: the optics are calibrated at half of the places, each place of the other half is located
from one set of strengths, and the halves change roles. `ml` gets gains, orders, lean and floor; `ls` and `lin`, which
can use gains and orders only, get a calibration without the rest. No residual map, no prior.
"""

from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.calibration.calibrate import calibrate_lamps
from estimator.light_filter.survey import Survey
from estimator.paper.lateration import Doubt, Received, Solver, SolverSettings, locate
from tools.experiments.recorded.static import PRIORS, halves, nominal, rows_of, unit_of
from tools.experiments.recorded.vlp import CAMPAIGNS, Campaign, campaign
from tools.experiments.support.report import Cell, Table, Work

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

LINKS: Final = (3, 4, 5)
SOLVERS: Final = (Solver.LS, Solver.LIN, Solver.ML)
SPLITS: Final = (None, 0, 1, 2, 3)
DOUBT: Final = Doubt(common_ln=0.02, tilt=0.02, floor=0.005, floor_own=0.01)
NOISE: Final = 0.005
LEVEL: Final = replace(PRIORS, slope=0.0, rx_slope=0.0, floor=0.0)


def taught(data: Campaign, train: Index, unit: float, solver: Solver) -> Survey:
    """The calibration that a solver can use, lamps trusted as far as it fits."""
    known = nominal(data)
    if solver is not Solver.ML:
        known = replace(known, floor=0.0)
    found = calibrate_lamps(known, rows_of(data, train, unit), PRIORS if solver is Solver.ML else LEVEL)
    lamps = tuple(replace(lamp, sigma_ln=max(found.scale, 0.01)) for lamp in found.survey.lamps)
    return replace(found.survey, lamps=lamps)


def trial(job: tuple[str, int | None]) -> Array:
    """(solvers, numbers, places) errors in m of one campaign with one way to split it (see `static.halves`)."""
    name, seed = job
    data = campaign(name)
    first, second = halves(data, seed)
    parts = []
    for train, test in ((first, second), (second, first)):
        unit = unit_of(data, train)
        surveys = {solver: taught(data, train, unit, solver) for solver in SOLVERS}
        found = np.full((len(SOLVERS), len(LINKS), len(test)), np.nan)
        for i, place in enumerate(test.tolist()):
            a = unit * data.rss[place]
            for s, (solver, survey) in enumerate(surveys.items()):
                received = Received(survey.lamps, a, (NOISE * a) ** 2)
                for k, n in enumerate(LINKS):
                    located = locate(received, survey, SolverSettings(solver, n, doubt=DOUBT, rim=0.0))
                    if located.places:
                        found[s, k, i] = np.hypot(*(located.places[0].xy - data.places[place, :2]))
        parts.append(found)
    return np.concatenate(parts, axis=2)


def recorded(quick: bool, work: Work) -> tuple[Table, ...]:
    """Median and 90th percentile by solver and number of links, one table per campaign.

    Raises:
        Skipped: the recordings are not there.
    """
    splits = SPLITS[:1] if quick else SPLITS
    tables = []
    for name in CAMPAIGNS:
        campaign(name)  # missing data shows before any work is spread
        errors = 100.0 * np.concatenate(work.map(trial, [(name, seed) for seed in splits], name), axis=2)
        rows: tuple[tuple[Cell, ...], ...] = tuple(
            (f"{solver.value}, {label}", *(float(v) for v in np.nanpercentile(part, percent, axis=1)))
            for solver, part in zip(SOLVERS, errors, strict=True)
            for label, percent in (("median", 50), ("90th percentile", 90))
        )
        tables.append(Table(f"recorded, {name}: position error, cm, split half", ("links", *map(str, LINKS)), rows))
    return tuple(tables)
