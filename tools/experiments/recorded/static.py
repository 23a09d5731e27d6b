"""Static grids of real received strengths: how well a calibration made from some places locates the others.

Two campaigns of one room (5 lamps, 5 x 5 m, 73 and 81 surveyed places). Split half: calibration, hyperparameters and
residual map come from one half of the places, each place of the other half is located by itself from one set of
strengths, with no start value; then the halves change roles. Across campaigns: everything comes from one campaign, the
gains are brought up to date at ten places of the other, and its remaining places are located. The ten places follow
from their coordinates alone: the one nearest to the middle of the room, then nine times the one farthest from those
already taken.
"""

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from estimator.calibration.calibrate import calibrate_lamps
from estimator.calibration.observations import Rows, model
from estimator.calibration.parameters import Priors
from estimator.calibration.residual_map_fit import learn
from estimator.light_filter.lambertian import pack_lamps, pack_receiver
from estimator.light_filter.residual_lookup import look_up
from estimator.light_filter.residual_map import ResidualMap
from estimator.light_filter.survey import Lamp, Receiver, Survey
from tools.ci.figures import Figure, bounded
from tools.experiments.recorded.vlp import Campaign, campaign
from tools.experiments.support.report import COMMAND, Picture, Report, Table, Work

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

PRIORS: Final = Priors(gain=3.0, order=0.4, slope=0.15, rx_slope=0.05, lever=0.0, floor=0.01)
"""The lamps' data sheets are not known; nothing but their places is."""
UPDATE: Final = Priors(gain=0.5, order=0.0, slope=0.0, floor=0.0, rx_order=0.0, rx_slope=0.0, lever=0.0)
UPDATE_RECEIVER: Final = replace(UPDATE, rx_slope=0.1, rx_order=0.25, floor=0.01)
"""The receiver may have been put up anew: its lean and cosine are looked for too, five numbers at ten places."""
DRIFT_LN: Final = 0.06
"""How far one lamp, or what the map has learned of it, may have drifted from the others between campaigns."""
CELL_M: Final = 0.05
COARSE_M: Final = 0.15
NAMED: Final = 10
SPLITS: Final = 20
ROOM: Final = (-0.3, -0.3, 5.3, 5.3)
"""x and y between which a place is looked for, m."""


@dataclass(frozen=True, slots=True, eq=False)
class Taught:
    """A calibration with its residual map."""

    survey: Survey
    residuals: ResidualMap | None
    scale: float


def nominal(data: Campaign) -> Survey:
    """What is known beforehand: where the lamps hang, and a first guess of everything else."""
    lamps = tuple(Lamp(k + 1, k, *(float(v) for v in at), order=0.6, sigma_ln=1.0) for k, at in enumerate(data.lamps))
    receiver = Receiver(z=float(data.places[:, 2].mean()), half_fov_rad=float(np.radians(90.0)))
    return Survey(lamps, receiver, floor=0.01)


def rows_of(data: Campaign, at: Index, unit: float = 1.0) -> Rows:
    """Strengths at some places; the receiver was not turned."""
    n, K = len(at), data.rss.shape[1]
    pose = np.zeros((n * K, 3))
    pose[:, :2] = np.repeat(data.places[at, :2], K, axis=0)
    lamp = np.tile(np.arange(K), n).astype(np.int64)
    return Rows(pose, lamp, unit * data.rss[at].ravel(), np.full(n * K, 0.005), np.zeros(n * K))


def unit_of(data: Campaign, at: Index) -> float:
    """A per recorders' unit, roughly, so that gains start near zero."""
    survey = nominal(data)
    rows = rows_of(data, at)
    out, _ = model(pack_lamps(survey.lamps, survey.depth), pack_receiver(survey.receiver), rows.pose, rows.lamp, 0.01)
    return float(np.exp(np.median(np.log(out[:, 0] / rows.amplitude))))


def teach(data: Campaign, at: Index, unit: float, with_map: bool = True) -> Taught:
    """Calibrate on some places."""
    rows = rows_of(data, at, unit)
    found = calibrate_lamps(nominal(data), rows, PRIORS)
    return Taught(found.survey, learn(found.survey, rows, cell=CELL_M) if with_map else None, found.scale)


def explained(taught: Taught, rows: Rows) -> tuple[Array, Array]:
    """(n,) what the map adds to ln expected, and one sigma of it."""
    mean, sigma, out = np.zeros(len(rows)), np.zeros(len(rows)), np.zeros(4)
    if taught.residuals is not None:
        r = taught.residuals
        for i, (k, pose) in enumerate(zip(rows.lamp.tolist(), rows.pose, strict=True)):
            look_up(r.mean[k], r.sigma[k], r.grid[k], float(pose[0]), float(pose[1]), out)
            mean[i], sigma[i] = out[0], out[1]
    return mean, sigma


def updated(taught: Taught, data: Campaign, at: Index, unit: float, priors: Priors) -> Taught:
    """Bring gains up to date at a few places, on top of the map."""
    rows = rows_of(data, at, unit)
    mean, sigma = explained(taught, rows)
    flat = replace(rows, amplitude=rows.amplitude * np.exp(-mean), sigma=np.hypot(rows.sigma, sigma))
    z = float(data.places[:, 2].mean())
    lamps = tuple(replace(lamp, sigma_ln=DRIFT_LN) for lamp in taught.survey.lamps)
    survey = replace(taught.survey, lamps=lamps, receiver=replace(taught.survey.receiver, z=z))
    survey = calibrate_lamps(survey, flat, priors).survey
    if taught.residuals is None:
        return replace(taught, survey=survey)
    aged = replace(taught.residuals, noise=float(np.hypot(taught.residuals.noise, DRIFT_LN)))
    return replace(taught, survey=survey, residuals=aged)


class Locator:
    """Maximum likelihood over the whole room: no start value, no prior but the walls."""

    def __init__(self, taught: Taught) -> None:
        self._taught = taught
        x0, y0, x1, y1 = ROOM
        x, y = np.meshgrid(np.arange(x0, x1, COARSE_M), np.arange(y0, y1, COARSE_M))
        self._coarse = self._predict(np.column_stack((x.ravel(), y.ravel())))

    def _predict(self, places: Array) -> tuple[Array, Array, Array]:
        """Places with ln expected (n, K) and its sigma."""
        survey, K = self._taught.survey, len(self._taught.survey.lamps)
        pose = np.zeros((len(places) * K, 3))
        pose[:, :2] = np.repeat(places, K, axis=0)
        lamp = np.tile(np.arange(K), len(places)).astype(np.int64)
        tables = pack_lamps(survey.lamps, survey.depth), pack_receiver(survey.receiver)
        out, _ = model(*tables, pose, lamp, survey.floor)
        rows = Rows(pose, lamp, np.maximum(out[:, 0], 1e-15), np.zeros(len(lamp)), np.zeros(len(lamp)))
        mean, sigma = explained(self._taught, rows)
        least = self._taught.scale if self._taught.residuals is None else self._taught.residuals.noise
        total = np.sqrt(np.maximum(sigma, 0.0) ** 2 + max(least, 0.01) ** 2)
        return places, (np.log(rows.amplitude) + mean).reshape(-1, K), total.reshape(-1, K)

    def locate(self, strengths: Array) -> Array:
        """The likeliest place (2,) of strengths (K,)."""
        best = self._best(self._coarse, strengths)
        for step in (0.03, 0.006):
            offset = step * np.arange(-6, 7)
            x, y = np.meshgrid(best[0] + offset, best[1] + offset)
            best = self._best(self._predict(np.column_stack((x.ravel(), y.ravel()))), strengths)
        return best

    @staticmethod
    def _best(predicted: tuple[Array, Array, Array], strengths: Array) -> Array:
        places, ln, sigma = predicted
        share = (np.log(strengths) - ln) / sigma
        # Student-t with 4 degrees of freedom, as in the map
        cost = (2.5 * np.log1p(share**2 / 4.0) + np.log(sigma)).sum(axis=1)
        found: Array = places[int(np.argmin(cost))]
        return found


def errors(taught: Taught, data: Campaign, at: Index, unit: float) -> Array:
    """Distances between located and surveyed places, m."""
    locator = Locator(taught)
    found = np.array([locator.locate(unit * data.rss[i]) for i in at.tolist()])
    distance: Array = np.hypot(*(found - data.places[at, :2]).T)
    return distance


def named(data: Campaign) -> Index:
    """The ten places of an update, by the rule at the head of this file."""
    places = data.places[:, :2]
    middle = 0.5 * (places.min(axis=0) + places.max(axis=0))
    taken = [int(np.argmin(np.hypot(*(places - middle).T)))]
    while len(taken) < NAMED:
        nearest = np.min([np.hypot(*(places - places[i]).T) for i in taken], axis=0)
        taken.append(int(np.argmax(nearest)))
    return np.array(taken, dtype=np.int64)


def halves(data: Campaign, seed: int | None) -> tuple[Index, Index]:
    """Two halves of the places: every other one in the order of the file, or drawn."""
    n = len(data.places)
    order = np.arange(n) if seed is None else np.random.default_rng(seed).permutation(n)
    return np.sort(order[0::2]), np.sort(order[1::2])


def split(job: tuple[str, int | None, bool]) -> Array:
    """Errors of all places of a campaign, each located with the other half."""
    name, seed, with_map = job
    data = campaign(name)
    first, second = halves(data, seed)
    parts = []
    for train, test in ((first, second), (second, first)):
        unit = unit_of(data, train)
        parts.append(errors(teach(data, train, unit, with_map), data, test, unit))
    return np.concatenate(parts)


def across(job: tuple[str, str, str]) -> Array:
    """Errors in campaign ``then`` at all but the ten places, calibrated in campaign ``first``."""
    first, then, how = job
    old, new = campaign(first), campaign(then)
    everywhere = np.arange(len(old.places))
    unit = unit_of(old, everywhere)
    taught = teach(old, everywhere, unit)
    ten = named(new)
    if how == "none":
        receiver = replace(taught.survey.receiver, z=float(new.places[:, 2].mean()))
        taught = replace(taught, survey=replace(taught.survey, receiver=receiver))
    else:
        taught = updated(taught, new, ten, unit, UPDATE if how == "gains" else UPDATE_RECEIVER)
    rest = np.setdiff1d(np.arange(len(new.places)), ten)
    return errors(taught, new, rest, unit)


def row(title: str, errors_m: Array) -> tuple[str | float, ...]:
    """Median, p90 and largest in cm."""
    return (title, *(float(100.0 * v) for v in np.percentile(errors_m, (50.0, 90.0, 100.0))))


def run(quick: bool, work: Work) -> Report:
    """Split half of both campaigns, and across them."""
    names = ("RSS", "RSS_0923")
    jobs = [(name, None, with_map) for name in names for with_map in (True, False)]
    alternate = dict(zip(jobs, work.map(split, jobs, "split half"), strict=True))
    seeds = range(1 if quick else SPLITS)
    drawn = {name: work.map(split, [(name, seed, True) for seed in seeds], f"splits of {name}") for name in names}
    pairs = [(a, b, how) for a, b in (names, names[::-1]) for how in ("none", "gains", "gains and receiver")]
    between = dict(zip(pairs, work.map(across, pairs, "across"), strict=True))
    head = ("", "median cm", "p90 cm", "largest cm")
    rows = [row(f"{n}, {'with' if m else 'without'} residual map", e) for (n, _, m), e in alternate.items()]
    rows += [row(f"{n}, {len(drawn[n])} drawn splits together", np.concatenate(drawn[n])) for n in names]
    cross = [row(f"{a} -> {b}, update: {how}", e) for (a, b, how), e in between.items()]
    return Report(
        figures=tuple(_figures(alternate, between)),
        tables=(
            Table("Split half, every other place of the file", head, tuple(rows)),
            Table("Across campaigns, ten named places for the update, the rest located", head, tuple(cross)),
        ),
        pictures=(Picture("static", lambda canvas: _draw(canvas, alternate, between)),),
        seeds=tuple(seeds),
        notes=("Each place is located by itself over the whole room; nothing of the half it is in was used.",),
    )


def _figures(alternate: dict[Any, Array], between: dict[Any, Array]) -> list[Figure]:
    command = f"{COMMAND} static"
    first, second = alternate["RSS", None, True], alternate["RSS_0923", None, True]
    figures = [
        bounded("split half RSS, median", float(np.median(first)), "m", "<= 0.05", command),
        bounded("split half RSS, p90", float(np.percentile(first, 90)), "m", "<= 0.12", command),
        bounded("split half RSS_0923, median", float(np.median(second)), "m", "<= 0.07", command),
    ]
    for (a, b, how), e in between.items():
        if how != "none":
            name = f"{a} to {b}, {how} from ten places, median"
            figures.append(bounded(name, float(np.median(e)), "m", "<= 0.13", command))
    return figures


def _draw(canvas: Any, alternate: dict[Any, Array], between: dict[Any, Array]) -> None:
    axes = canvas.add_subplot()
    for (name, _, with_map), e in alternate.items():
        label = f"{name}, split half{'' if with_map else ', no residual map'}"
        axes.plot(np.sort(100.0 * e), np.linspace(0.0, 1.0, len(e)), "-" if with_map else ":", label=label)
    for (a, b, how), e in between.items():
        if how == "gains":
            axes.plot(np.sort(100.0 * e), np.linspace(0.0, 1.0, len(e)), "--", label=f"{a} to {b}, gains updated")
    axes.set(xlabel="error, cm", ylabel="share of places", xlim=(0.0, 40.0))
    axes.legend(fontsize=7)
