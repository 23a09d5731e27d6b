"""The paper's Table 1: its sensors and lamps as given there, and as the simulated room of Fig. 4 to 6 has them.

Below the table's own rows stand those that the paper's text gives. What the room has is read from what is simulated, a
scan of the drive included, and is not written down a second time.
"""

from typing import Final

import numpy as np

from tools.ci.figures import bounded
from tools.experiments.support.outings import outing
from tools.experiments.support.report import COMMAND, Cell, Report, Table, Work
from tools.sim.building.buildings import building
from tools.sim.ceiling.ceiling import Photodiode, paper_ceiling

SEED: Final = 1
SCAN_S: Final = 0.2


def run(quick: bool, work: Work) -> Report:
    """The same with ``quick``: it takes seconds."""
    rows = conditions()
    off = sum(theirs != ours for _, theirs, ours, _ in rows)
    head = ("", "paper", "simulated", "unit")
    return Report(
        (bounded("conditions that the simulated room does not have", off, "", "<= 0", f"{COMMAND} table1"),),
        (Table("Relevant parameters of the sensors and LEDs (Table 1); robot and room (section 5)", head, rows),),
        seeds=(SEED,),
        notes=(
            "not in the paper: beams and rate of the lidar (here 721, 40 Hz), number and places of lamps (here 4 x 4)",
        ),
    )  # fmt: skip


def conditions() -> tuple[tuple[Cell, ...], ...]:
    """Name, the paper's value, ours, unit."""
    ceiling, place, diode = paper_ceiling(seed=SEED), building("paper_room"), Photodiode()
    drive = outing("tour", SEED, np.inf)
    scans = list(outing("tour", SEED, SCAN_S).scans(0))
    bearing = scans[0].bearing_rad
    way = drive.run.truth(np.linspace(0.0, drive.seconds, 5000))
    (lamp,) = {(fixture.power_w, fixture.half_angle_deg) for fixture in ceiling.fixtures}
    x_min, y_min, x_max, y_max = ceiling.fixtures[0].zone
    return (
        ("photodiode: field of view", 120, round(2.0 * diode.half_fov_deg), "deg"),
        ("photodiode: detectable area", 1.2, round(1e4 * diode.area_m2, 3), "cm2"),
        ("LED: transmission power", 1.5, lamp[0], "W"),
        ("LED: half power angle", 70, round(lamp[1]), "deg"),
        ("room", "10 x 10 x 3", f"{x_max - x_min:g} x {y_max - y_min:g} x {place.height_m:g}", "m"),
        ("lidar: field of view", 180, round(np.degrees(bearing[-1] - bearing[0])), "deg"),
        ("way", 160, round(float(np.hypot(*np.diff(way[:, :2], axis=0).T).sum()) / 10) * 10, "m"),
    )  # fmt: skip
