"""Pictures of buildings, drives and scans, for people (needs matplotlib, extra ``plot``).

``python -m tools.sim.building.draw paper_room out.png`` draws a building, its tour and a few scans along it.
"""

from __future__ import annotations

import argparse
from typing import Any, Final

import numpy as np

from tools.sim.building.beams import UTM_30LX, Posture, Scanner, Sweep
from tools.sim.building.building import Building
from tools.sim.building.buildings import BUILDINGS, building
from tools.sim.building.people import Crowd
from tools.sim.building.world import CIRCLE, MATERIAL_ID, Array
from tools.sim.robot.drive import Body, Drive

COLOURS: Final = {"glass": "deepskyblue", "black": "black", "steel": "tab:gray", "wood": "peru", "polished": "tab:pink"}


def draw_building(axes: Any, place: Building) -> None:
    """Walls by material, polished floor, and the tour."""
    names = {number: name for name, number in MATERIAL_ID.items()}
    for x_min, y_min, x_max, y_max in place.world.polished:
        axes.fill([x_min, x_max, x_max, x_min], [y_min, y_min, y_max, y_max], color="lavender")
    turn = np.linspace(0.0, 2 * np.pi, 25)
    for kind, a, b, c, d, material in place.world.shapes:
        colour = COLOURS.get(names[int(material)], "dimgray")
        if kind == CIRCLE:
            axes.plot(a + c * np.cos(turn), b + c * np.sin(turn), color=colour, linewidth=0.8)
        else:
            axes.plot([a, c], [b, d], color=colour, linewidth=0.8)
    axes.set_aspect("equal")


def draw_scan(axes: Any, place: Building, drive: Drive, t: float, seed: int = 1) -> None:
    """One scan of a 270 deg lidar at ``t``, first echoes in red and further ones in orange, and people's legs."""
    sweep = Sweep(np.radians(np.arange(-540, 541) * 0.25), 0.0, 0.01875)
    scanner = Scanner(place.world, sweep, UTM_30LX, seed)
    legs = Crowd(place.people).legs(t, drive.pose(np.array([t]))[0])
    pitch, roll = drive.tilt(t)
    seen = scanner.measure(t, drive.pose, legs, Posture(0.3, pitch, roll))
    pose = drive.pose(t + np.linspace(0.0, sweep.sweep_s, len(sweep.bearing_rad)))
    for echo, colour in ((0, "red"), (1, "orange")):
        points = _points(pose, sweep.bearing_rad, seen.range_m[:, echo])
        axes.plot(points[:, 0], points[:, 1], ".", color=colour, markersize=1.5)
    axes.plot(pose[0, 0], pose[0, 1], "k>", markersize=4)
    for leg in legs:
        axes.plot(leg[1], leg[2], "o", color="green", markersize=2)


def _points(pose: Array, bearing: Array, reach: Array) -> Array:
    angle = pose[:, 2] + bearing
    points = np.column_stack([pose[:, 0] + reach * np.cos(angle), pose[:, 1] + reach * np.sin(angle)])
    return np.asarray(points[reach > 0.0])


def main(name: str, path: str) -> None:
    """Draw a building with five scans along its tour to an image file."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    place = building(name)
    drive = Drive(place.route, Body())
    figure, axes = pyplot.subplots(figsize=(16, 12))
    draw_building(axes, place)
    track = drive.pose(np.linspace(0.0, drive.lap_s, 4000))
    axes.plot(track[:, 0], track[:, 1], "b-", linewidth=0.6)
    for t in np.linspace(0.05, 0.85, 5) * drive.lap_s:
        draw_scan(axes, place, drive, float(t))
    axes.set_title(f"{name}: {len(place.world.shapes)} surfaces, tour {drive.length_m:.1f} m, {drive.lap_s:.0f} s")
    figure.savefig(path, dpi=80)


def asked(program: str, about: str) -> tuple[str, str]:
    """Building and file of the command line; what is wrong with it ends the program with a sentence."""
    parser = argparse.ArgumentParser(prog=f"python -m {program}", description=about.splitlines()[0])
    parser.add_argument("building", choices=sorted(BUILDINGS))
    parser.add_argument("picture", help="file to write, *.png")
    options = parser.parse_args()
    return options.building, options.picture


if __name__ == "__main__":
    main(*asked("tools.sim.building.draw", __doc__))
