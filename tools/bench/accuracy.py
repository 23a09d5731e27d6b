"""Matching against its truth: errors beside the Cramer-Rao bound, success from afar, and whether ellipses are honest.

``LUMILOOP_BENCH=full`` runs 1000 trials a case (about a quarter of an hour), else 100 to 200.
"""

import os
from typing import Final

import numpy as np

from tools.bench.support.scenes import Array, Scene, box, office, paper_room, round_room
from tools.bench.support.trials import CHI2_2, Case, Trials
from tools.bench.support.trials import run as trial
from tools.ci.figures import Figure
from tools.ci.figures import bounded as _bounded

FULL: Final = os.environ.get("LUMILOOP_BENCH") == "full"
COMMAND: Final = "python -m tools.bench accuracy"
SIZES: Final = ((181, 180.0), (361, 270.0), (1081, 270.0))
FAR, NEAR, SMALL = (0.5, 20.0), (0.2, 5.0), (0.1, 3.0)


def trials(case: Case) -> Trials:
    """As many as the mode asks for; maps of many scans take longer to make."""
    if FULL:
        return trial(case, 1000)
    return trial(case, 200 if case.scans == 1 and case.beams < 1000 else 100)


def bounded(name: str, value: float, unit: str, target: str) -> Figure:
    """A figure of this benchmark."""
    return _bounded(name, value, unit, target, COMMAND)


def endless(degrees: float) -> Scene:
    """A plain corridor, 2 m wide, whose ends are out of sight, at an angle to the axes."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    walls = np.array(box(-60, -1, 60, 1), dtype=np.float64).reshape(-1, 2) @ np.array(((c, s), (-s, c)))
    return Scene(walls.reshape(-1, 4), (-0.4, -0.4), (0.4, 0.4))


def run() -> list[Figure]:
    """The paper's room and an office; two more offices when there is time."""
    rooms = {"paper room": paper_room(), "office": office()}
    if FULL:
        rooms |= {"office 5": office(5), "office 7": office(7)}
    figures = []
    for room, scene in rooms.items():
        figures += against_bound(room, scene) + success(room, scene) + consistency(room, scene)
    return figures + degenerate()


def against_bound(room: str, scene: Scene) -> list[Figure]:
    """RMS errors as multiples of the bound, for two scans and for a map of ten."""
    figures = []
    for scans, name in ((1, "scan to scan"), (10, "against a map of ten scans")):
        found = trials(Case(scene, off=(0.17, 4.0), scans=scans))
        for value, least, unit, scale in zip(found.rms(), found.rms_bound(), ("mm", "deg"), (1e3, 1.0), strict=True):
            title = f"{room}, 1081 beams, {name}"
            figures.append(Figure(f"{title}: Cramer-Rao bound", scale * least, unit, command=COMMAND))
            figures.append(Figure(f"{title}: our RMS error", scale * value, unit, command=COMMAND))
            figures.append(bounded(f"{title}: ours / bound ({unit})", value / least, "x", "<= 2"))
    return figures


def success(room: str, scene: Scene) -> list[Figure]:
    """Share within 2 cm and 0.5 deg where the bound allows it, and results that are wrong beyond their own ellipse."""
    figures, wrong, tried = [], 0, 0
    for off, target in ((FAR, ">= 0.99"), (NEAR, ">= 0.999")):
        for beams, fov in SIZES:
            found = trials(Case(scene, beams, fov, off))
            wrong, tried = wrong + found.confident_wrong, tried + len(found.results)
            title = f"{room}, {beams} beams over {fov:.0f} deg, from {off[0]} m / {off[1]:.0f} deg"
            figures.append(bounded(f"{title}: success", found.success, "", target))
    return [*figures, bounded(f"{room}: confident wrong poses, share of {tried}", wrong / tried, "", "<= 0.001")]


def consistency(room: str, scene: Scene) -> list[Figure]:
    """Share of the errors inside the 95 % ellipsoid that the match reports."""
    figures = []
    for sigma in (0.01, 0.03):
        for scans in (1, 10):
            for beams, fov in SIZES:
                found = trials(Case(scene, beams, fov, SMALL, sigma, scans))
                title = f"{room}, {beams} beams, sigma {100 * sigma:.0f} cm, map of {scans}: errors inside 95 %"
                share, slack = found.inside, 2.0 * np.sqrt(0.05 * 0.95 / len(found.results))
                text = f"within 0.03 of 0.95 (+-{slack:.3f} by chance)"
                figures.append(Figure(title, share, "", text, bool(abs(share - 0.95) <= 0.03 + slack), COMMAND))
    return figures


def degenerate() -> list[Figure]:
    """Share of matches that claim to know what cannot be known."""
    figures = []
    for angle in (0.0, 45.0):
        along = np.array((np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0))
        for sigma in (0.01, 0.03):
            for scans in (1, 10):
                found = [trials(Case(endless(angle), beams, fov, SMALL, sigma, scans)) for beams, fov in SIZES]
                title = f"corridor at {angle:.0f} deg, sigma {100 * sigma:.0f} cm, map of {scans}"
                claims = np.concatenate([claimed(each, along) for each in found])
                inside = np.mean(np.concatenate([inside_across(each, along) for each in found]))
                figures.append(bounded(f"{title}: claims the long axis", float(claims.mean()), "", "<= 0"))
                figures.append(Figure(f"{title}: across and heading inside 95 %", float(inside), "", command=COMMAND))
    for scans in (1, 10):
        found = [trials(Case(round_room(), beams, fov, SMALL, 0.01, scans)) for beams, fov in SIZES]
        claims = np.array([result.known_axes[2] for each in found for result in each.results])
        figures.append(bounded(f"round room, map of {scans}: claims a heading", float(claims.mean()), "", "<= 0"))
    return figures


def claimed(found: Trials, along: Array) -> Array:
    """1 where a match has not reported the direction as one it knows nothing of, else 0."""
    blind = [result.blind_directions() for result in found.results]
    return np.array([not any(abs(float(row @ along)) > 0.99 for row in rows) for rows in blind], dtype=np.float64)


def inside_across(found: Trials, along: Array) -> Array:
    """Whether what is known (across the corridor, heading) lies inside its own 95 % ellipse."""
    P = np.linalg.inv(found.information + np.diag((4.0, 4.0, 33.0)))
    known = np.array(((-along[1], along[0], 0.0), (0.0, 0.0, 1.0)))
    e, C = found.error @ known.T, known @ P @ known.T
    return np.asarray(np.einsum("ni,nij,nj->n", e, np.linalg.inv(C), e) < CHI2_2)
