"""The paper's first experiment: position error against the number of links (its Fig. 4).

Conditions, fixed before anything was run: a plain room of 10 x 10 x 3 m, 4 x 4 lamps of Table 1 at 2.9 m, the receiver
at 0.3 m; powers 3 % off, lamps leaning by 1 degree, the receiver by 0.5 degree (each one sigma), walls that reflect
70 %, a diffuse floor of 1.6 % of the strength right below a lamp. Nothing is filtered over time: each place is one
epoch.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from estimator.light_filter.survey import Survey
from estimator.paper.lateration import Doubt, Solver, SolverSettings, without_floor
from tools.ci.figures import Figure
from tools.experiments.paper_figures.fig4_recorded import recorded
from tools.experiments.support.places import CENTRED, Spot, error, grid, sheet_of, spots
from tools.experiments.support.report import COMMAND, Cell, Picture, Report, Skipped, Table, Work
from tools.sim.building.world import Plan
from tools.sim.ceiling.ceiling import IDEAL, Ceiling
from tools.sim.ceiling.lamps import row, with_codes

Array = npt.NDArray[np.float64]

ROOM: Final = (-5.0, -5.0, 5.0, 5.0)
INNER_M: Final = 3.5
LINKS: Final = (3, 4, 5, 6, 7, 8)
EFFECTS: Final = replace(
    IDEAL, gain_spread=0.03, lamp_tilt_deg=1.0, receiver_tilt_deg=0.5, rho=0.7, bounces=1, floor=0.016
)
DOUBT: Final = Doubt(common_ln=0.01, tilt=0.02, floor=0.008, floor_own=0.01)
"""What `ml` is told: leaning by 1.1 degrees, a floor of 1.5 % +- 0.8 %, and 1 % that differs from link to link."""
IGNORANT: Final = Doubt(common_ln=0.0, tilt=0.0, floor=0.0, floor_own=0.0)
SIGMA_LN: Final = 0.03
SEEDS: Final = tuple(range(12))


@dataclass(frozen=True, slots=True)
class Contestant:
    """A way to solve. ``beyond``: it also gets links of lamps out of view, as a decoder reports them."""

    name: str
    method: SolverSettings
    prepare: Callable[[Spot, Survey], tuple[Spot, Survey]] | None = None
    beyond: bool = False


def _no_floor_known(spot: Spot, sheet: Survey) -> tuple[Spot, Survey]:
    return spot, replace(sheet, floor=0.0)


def _floor_taken_off(spot: Spot, sheet: Survey) -> tuple[Spot, Survey]:
    return replace(spot, received=without_floor(spot.received, sheet)), replace(sheet, floor=0.0)


PLAIN: Final = "ls: the paper's Eq. 4"
OURS: Final = "ml: weighted, with floor (ours)"
CONTESTANTS: Final = (
    Contestant(PLAIN, SolverSettings(Solver.LS, rim=0.0)),
    Contestant("lin: linear differences", SolverSettings(Solver.LIN, rim=0.0)),
    Contestant("ml without weights and floor", SolverSettings(Solver.ML, doubt=IGNORANT, rim=0.0), _no_floor_known),
    Contestant("ls with the floor taken off", SolverSettings(Solver.LS, rim=0.0), _floor_taken_off),
    Contestant(OURS, SolverSettings(Solver.ML, doubt=DOUBT)),
    Contestant("ls, lamps out of view too", SolverSettings(Solver.LS, rim=0.0), beyond=True),
    Contestant("ml (ours), lamps out of view too", SolverSettings(Solver.ML, doubt=DOUBT), beyond=True),
)


def plain_room(seed: int) -> Ceiling:
    """The room of the conditions above; the seed decides who is how far off."""
    plan = Plan()
    plan.outline([(ROOM[0], ROOM[1]), (ROOM[2], ROOM[1]), (ROOM[2], ROOM[3]), (ROOM[0], ROOM[3])])
    lamps = with_codes(row(ROOM, 2.9, 2.5))
    return Ceiling(lamps, plan.build(), 3.0, EFFECTS, CENTRED, seed=seed)


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One room: ``errors`` (contestants, numbers of links, places) in m, ``at`` (places, 2), ``seen`` (places,)."""

    errors: Array
    at: Array
    seen: Array


def trial(job: tuple[int, float]) -> Trial:
    """One room (seed) on a grid of places (pitch, m)."""
    seed, pitch = job
    ceiling = plain_room(seed)
    sheet = sheet_of(ceiling, SIGMA_LN)
    at = grid((ROOM[0], ROOM[2]), (ROOM[1], ROOM[3]), pitch)
    sets = [spots(ceiling, sheet, at, np.random.default_rng((seed, 1)), beyond) for beyond in (False, True)]
    errors = np.empty((len(CONTESTANTS), len(LINKS), len(at)))
    for c, contestant in enumerate(CONTESTANTS):
        for k, n in enumerate(LINKS):
            method = replace(contestant.method, link_n=n)
            for i, spot in enumerate(sets[contestant.beyond]):
                given, known = contestant.prepare(spot, sheet) if contestant.prepare else (spot, sheet)
                errors[c, k, i] = error(given, known, method)
    return Trial(errors, at, np.array([len(spot.received.lamps) for spot in sets[0]]))


def run(quick: bool, work: Work) -> Report:
    """Position error by number of links for all contestants."""
    seeds, pitch = (SEEDS[:2], 2.0) if quick else (SEEDS, 0.5)
    trials = work.map(trial, [(seed, pitch) for seed in seeds], "rooms")
    errors = 100.0 * np.concatenate([t.errors for t in trials], axis=2)
    at = np.concatenate([t.at for t in trials])
    seen = np.concatenate([t.seen for t in trials])
    inner = np.max(np.abs(at), axis=1) <= INNER_M
    median = np.nanmedian(errors, axis=2)
    tables = [
        _table("median position error, cm, whole floor", median),
        _table("95th percentile, cm, whole floor", np.nanpercentile(errors, 95, axis=2)),
        _table("median position error, cm, inner 7 x 7 m", np.nanmedian(errors[:, :, inner], axis=2)),
        _table("median, cm, only places with eight lamps in view", np.nanmedian(errors[:, :, seen >= 8], axis=2)),
    ]
    names = [contestant.name for contestant in CONTESTANTS]
    plain, ours = median[names.index(PLAIN)], median[names.index(OURS)]
    best = LINKS[int(np.argmin(plain))]
    falls = float(np.max(np.diff(ours)))
    command = f"{COMMAND} fig4"
    figures = (
        Figure("number of links with the least error, the paper's solver", best, "links", "= 4", best == 4, command),
        Figure("median error with four links, the paper's solver", float(plain[1]), "cm", command=command),
        Figure("median error with eight links, the paper's solver", float(plain[-1]), "cm", command=command),
        Figure("median error with four links, ours", float(ours[1]), "cm", command=command),
        Figure("median error with eight links, ours", float(ours[-1]), "cm", command=command),
        Figure("largest change of ours from one more link", falls, "cm", "<= 0", falls <= 0.0, command),
    )
    notes: tuple[str, ...] = (
        f"{len(seeds)} rooms of {len(at) // len(seeds)} places; {_counts(seen)}",
        "n links: the n shortest of those in view, all of them where fewer are in view; places with fewer than two "
        f"links have no position and are left out ({int(np.sum(np.isnan(errors[0, 0])))} of {len(at)})",
    )
    try:
        tables += recorded(quick, work)
    except Skipped as reason:
        notes = (*notes, f"no table of recorded strengths: {reason}")
    return Report(figures, tuple(tables), (Picture("fig4", _drawing(errors, names)),), seeds, notes)


def _counts(seen: Array) -> str:
    few, many = int(np.min(seen)), int(np.max(seen))
    return f"{few} to {many} lamps in view, median {int(np.median(seen))}"


def _table(title: str, values: Array) -> Table:
    rows: list[tuple[Cell, ...]] = [
        (contestant.name, *(float(v) for v in line)) for contestant, line in zip(CONTESTANTS, values, strict=True)
    ]
    return Table(title, ("links", *(str(n) for n in LINKS)), tuple(rows))


def _drawing(errors: Array, names: list[str]) -> Callable[[Any], None]:
    def draw(canvas: Any) -> None:
        axes = canvas.subplots()
        for name, lines in list(zip(names, errors, strict=True))[:5]:
            low, middle, high = np.nanpercentile(lines, (25, 50, 75), axis=1)
            (line,) = axes.plot(LINKS, middle, marker="o", label=name)
            if name in (PLAIN, OURS):
                axes.fill_between(LINKS, low, high, alpha=0.15, color=line.get_color(), linewidth=0)
        axes.set(xlabel="number of links", ylabel="position error, cm (median; band: middle half)", ylim=(0, None))
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small")

    return draw
