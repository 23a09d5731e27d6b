"""``make pictures``: the README's picture and animation, from drives of the daemon in the simulated room.

Daemon and world run in one process and in virtual time, so a slow computer does not change the pictures.
"""

import argparse
import re
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Final

import numpy as np
from PIL import Image

from daemon.cli import parser as cli
from daemon.snapshot import LinkUse, Snapshot, State
from tools.demo.folder import MARGIN_M
from tools.docs.animation import PERIOD_S, Ground, Moment, write
from tools.docs.pageshots import smaller
from tools.sim.harness import Run, run
from tools.sim.light.scene import Lights
from tools.sim.light_harness import lights_of
from tools.sim.scene import Scenario, SimulatedScene

PICTURE: Final = "demo-map.png"
ANIMATION: Final = "kidnap.gif"
DRIVE_S: Final = 75.0
UP_S, DOWN_S, AHEAD_S = 24.0, 26.0, 32.0
"""The robot is lifted, put down, and this much further along its tour."""
SHOWN_S: Final = (18.0, 36.0)
LOW_M, HIGH_M = (-5.8, -5.6), (6.4, 5.6)
"""The room, in the map frame."""
ORDER: Final = (
    f'[[fault]]\nwhere = "robot"\nwhat = "carry"\nwhen = {UP_S}\nahead = {AHEAD_S}\ntakes = {DOWN_S - UP_S}\n'
)


class NoPicture(RuntimeError):
    """A command of the program failed; the text says which."""


def export(recording: Path, out: Path, *words: str) -> None:
    """Map and picture of a recording.

    Raises:
        NoPicture: it failed.
    """
    if cli.main(["map", "export", str(recording), "--out", str(out), *words]) != 0:
        raise NoPicture(f"lumiloop map export {recording} failed")


def ground_of(folder: Path, lamps: dict[int, tuple[float, float]]) -> Ground:
    """The room of an exported map, and the lamps in it."""
    described = (folder / "map.yaml").read_text()
    found = re.search(r"resolution: (\S+)\norigin: \[(\S+), (\S+),", described)
    if found is None:
        raise NoPicture(f"{folder / 'map.yaml'}: no resolution and origin")
    cell, left, below = (float(number) for number in found.groups())
    inside = {
        number: place
        for number, place in lamps.items()
        if all(low < at < high for low, at, high in zip(LOW_M, place, HIGH_M, strict=True))
    }
    with Image.open(folder / "map.pgm") as picture:
        return Ground(np.array(picture), (left, below), cell, inside).part(LOW_M, HIGH_M)


def moments(out: Run) -> list[Moment]:
    """A moment for each frame of the part that is shown."""
    wanted, made = SHOWN_S[0], []
    for snapshot, truth in zip(out.snapshots, out.truth, strict=True):
        if wanted <= snapshot.t_mono <= SHOWN_S[1]:
            wanted += PERIOD_S
            made.append(moment(snapshot, (float(truth[0]), float(truth[1]), float(truth[2]))))
    return made


def moment(snapshot: Snapshot, truth: tuple[float, float, float]) -> Moment:
    """One of them."""
    links = snapshot.light.links if snapshot.light is not None else ()
    used = frozenset(link.lamp_id for link in links if link.use == LinkUse.ACCEPTED and link.lamp_id is not None)
    lifted = UP_S <= snapshot.t_mono < DOWN_S
    return Moment(snapshot.t_mono, State(snapshot.state), snapshot.reason, snapshot.pose, truth, used, lifted)


def main(arguments: list[str] | None = None) -> int:
    """Exit code 1 where a command of the program fails."""
    parser = argparse.ArgumentParser(prog="python -m tools.docs.drives", description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs/images"), help="default: %(default)s")
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    scenario = Scenario(lights=Lights())
    survey = lights_of(SimulatedScene(scenario))
    assert survey is not None
    lamps = {lamp.lamp_id: (lamp.x, lamp.y) for lamp in survey.survey.lamps}
    with tempfile.TemporaryDirectory(prefix="lumiloop-drives-") as name:
        folder = Path(name)
        try:
            run(DRIVE_S, scenario, record=folder / "drive")
            export(folder / "drive", folder / "map", "--margin", f"{MARGIN_M:g}")
            shutil.copyfile(folder / "map" / "map.png", options.out / PICTURE)
            kidnap = run(SHOWN_S[1] + 1.0, scenario, faults=ORDER, record=folder / "kidnap")
            export(folder / "kidnap", folder / "room")
        except NoPicture as error:
            print(error, file=sys.stderr)
            return 1
        size = write(options.out / ANIMATION, ground_of(folder / "room", lamps), moments(kidnap))
    smaller(options.out / PICTURE)
    print(f"written: {options.out / PICTURE}, {options.out / ANIMATION} ({size / 1e6:.2f} MB)")
    return 0


if __name__ == "__main__":
    sys.exit(main())
