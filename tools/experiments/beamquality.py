"""How well the beam model (Eq. 8-9) tells true from false matches, beside what the verdict goes by; what it costs.

Pairs of scans a step apart are matched from far too wrong a start (0.4 to 1.5 m, 10 to 60 deg). Where the iteration has
come to rest in a wrong place, every measure is asked about it, and about the match from a good start: the beam model in
nats per beam, the share of the beams that fit, and the share of the evidence that does not speak against the place.
"""

import time
from dataclasses import replace
from typing import Any, Final

import numpy as np

from estimator.measurements import Beam, Scan
from estimator.numerics import se2
from estimator.paper import beam_model
from estimator.paper.beam_model import BeamModel
from estimator.scan_matching import local_map
from estimator.scan_matching.scan_matcher import Attempt, MatchSettings, Prior, attempt
from tools.bench.match import map_of
from tools.bench.support.scenes import Array, Scene, bearings, office, paper_room
from tools.bench.support.trials import scan_at, view_of
from tools.ci.figures import Figure
from tools.experiments.support.report import COMMAND, Picture, Report, Table, Work

SIGMA: Final = 0.01
SEED: Final = 12
SETTINGS: Final = MatchSettings()
WIDE: Final = Prior(np.zeros(3), np.diag((4.0, 4.0, 10.0)))
PLACES: Final = {"paper room": (paper_room, 0.05), "office": (office, 0.05), "office, crowded": (office, 0.35)}
"""Where, and the share of beams stopped by somebody."""
Scores = dict[str, tuple[Array, Array]]


def scan(scene: Scene, T: Array, stopped: float, rng: np.random.Generator) -> Scan:
    """What a lidar at ``T`` measures, this share of its beams stopped by somebody, several at a time."""
    seen = scan_at(scene, T, bearings(361, 270.0), rng, SIGMA)
    n = len(seen.range_m)
    legs = np.repeat(rng.random(n // 6 + 1) < stopped, 6)[:n] & (seen.beam == Beam.HIT)
    distance = np.where(legs, seen.range_m * np.repeat(rng.uniform(0.2, 1.0, n // 6 + 1), 6)[:n], seen.range_m)
    return replace(seen, range_m=distance)


def points(of: Scan) -> Array:
    """Cartesian, in order of measurement."""
    hit = of.beam == Beam.HIT
    a, r = of.bearing_rad[hit], of.range_m[hit]
    return np.column_stack((r * np.cos(a), r * np.sin(a)))


def off(T: Array, rng: np.random.Generator, metres: tuple[float, float], degrees: tuple[float, float]) -> Array:
    """A pose so far from ``T``, in any direction."""
    a, r = rng.uniform(-np.pi, np.pi), rng.uniform(*metres)
    turn = np.radians(rng.uniform(*degrees)) * rng.choice((-1.0, 1.0))
    return se2.compose(T, np.array((r * np.cos(a), r * np.sin(a), turn)))


def scores(scene: Scene, stopped: float, trials: int) -> Scores:
    """By measure: what it says of true matches, and of false ones."""
    rng, model = np.random.default_rng(SEED), BeamModel(sigma_m=3.0 * SIGMA)
    said: tuple[list[tuple[float, ...]], list[tuple[float, ...]]] = ([], [])
    for _ in range(trials):
        T = scene.place(rng)
        T_new = off(T, rng, (0.0, 0.25), (0.0, 15.0))
        if not scene.clear(T_new, 0.15):
            continue
        reference, view = scan(scene, T, stopped, rng), view_of(scan(scene, T_new, stopped, rng))
        local, segments, true = map_of(reference), beam_model.segments_of(points(reference)), se2.between(T, T_new)

        def judged(found: Attempt) -> tuple[float, ...]:
            against = local_map.contradicted(local, found.T, view.beams, SIGMA)  # noqa: B023  called at once
            good = beam_model.quality(segments, found.T, view.beams, model)  # noqa: B023  called at once
            return good, found.share, 1.0 - against

        for far, metres, degrees in ((0, (0.0, 0.1), (0.0, 3.0)), (1, (0.4, 1.5), (10.0, 60.0))):
            found = attempt(view, local, replace(WIDE, T=off(true, rng, metres, degrees)), 30, SETTINGS)
            e = se2.between(true, found.T)
            away, turned = float(np.hypot(e[0], e[1])), abs(float(np.degrees(e[2])))
            if (away > 0.15 or turned > 5.0) if far else (away < 0.03 and turned < 1.0):
                said[far].append(judged(found))
    true_said, false_said = (np.nan_to_num(np.array(one), nan=-9.0) for one in said)
    names = ("beam model", "share that fits", "evidence not against")
    return {name: (true_said[:, k], false_said[:, k]) for k, name in enumerate(names)}


def roc(true: Array, false: Array) -> tuple[Array, Array]:
    """Share of false and of true poses that pass, as the threshold falls."""
    cuts = np.sort(np.concatenate((true, false)))[::-1]
    return np.array([(false >= cut).mean() for cut in cuts]), np.array([(true >= cut).mean() for cut in cuts])


def area(true: Array, false: Array) -> float:
    """Probability that a true pose scores higher than a false one (ties count half)."""
    return float((true[:, None] > false).mean() + 0.5 * (true[:, None] == false).mean())


def cost_ms() -> float:
    """Least time of one judgement with 1081 beams."""
    bearing = bearings(1081, 270.0)
    reference = scan_at(paper_room(), np.zeros(3), bearing, np.random.default_rng(SEED), SIGMA)
    segments, seen = beam_model.segments_of(points(reference)), (bearing, reference.range_m, reference.beam)
    best = np.inf
    for _ in range(200):
        begin = time.perf_counter()
        beam_model.quality(segments, np.zeros(3), seen, BeamModel())
        best = min(best, time.perf_counter() - begin)
    return 1e3 * float(best)


def draw(found: dict[str, Scores], canvas: Any) -> None:
    """One curve for each measure, one panel for each place; the corner in which they differ."""
    panels = canvas.subplots(1, len(found), sharey=True)
    for axes, (name, scored) in zip(panels, found.items(), strict=True):
        for measure, (true, false) in scored.items():
            axes.plot(*roc(true, false), label=f"{measure}, {area(true, false):.4f}", drawstyle="steps-post")
        axes.set(xlim=(0.0, 1.0), ylim=(0.5, 1.01), xlabel="share of false matches that pass", title=name)
        axes.set_xscale("symlog", linthresh=0.01)
        axes.legend(fontsize=7, loc="lower right", title="measure, area under its curve")
    panels[0].set_ylabel("share of true matches that pass")


def run(quick: bool, work: Work) -> Report:
    """Scores, curves and cost."""
    trials = 40 if quick else 500
    found = {name: scores(make(), stopped, trials) for name, (make, stopped) in PLACES.items()}
    rows = tuple(
        (name, measure, len(true), len(false), area(true, false), float((true > np.quantile(false, 0.99)).mean()))
        for name, scored in found.items()
        for measure, (true, false) in scored.items()
    )
    head = ("place", "measure", "true", "false", "area under the curve", "true kept where 1 % of false pass")
    command = f"{COMMAND} beamquality"
    figures = (
        Figure("beam model, office: area under the curve", area(*found["office"]["beam model"]), "", command=command),
        Figure("beam model, 1081 beams: one judgement", cost_ms(), "ms", command=command),
    )
    return Report(
        figures=figures,
        tables=(Table("true against false matches", head, rows),),
        pictures=(Picture("beamquality", lambda canvas: draw(found, canvas), (11.0, 3.8)),),
        notes=("Aliases of a symmetric room are no false matches here: no laser can tell them.",),
        seeds=(SEED,),
    )
