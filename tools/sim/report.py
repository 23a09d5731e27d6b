"""One virtual run of daemon and world, told to a person: errors, what was said about the pose, and when it changed.

::

    python -m tools.sim.report paper_room --seconds 275
    python -m tools.sim.report paper_room --lights link --seconds 300 --no-lidar
    python -m tools.sim.report corridor_loop --lidar UST-20LX --seconds 200 --empty --csv run.csv
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np

from daemon.health.reasons import REASONS, Reason
from daemon.snapshot import State
from hal.fake.lidar.models import MODELS
from tools.sim.building.buildings import BUILDINGS
from tools.sim.ceiling.ceiling import Effects
from tools.sim.harness import Run, run
from tools.sim.light.scene import LINK, WAVEFORM, Lights
from tools.sim.scene import Scenario

WRONG_M = 0.3
"""A pose further off than this is wrong, whatever is said about it."""


def describe(out: Run) -> str:
    """The run in a dozen lines."""
    off, turned = out.error_m, np.degrees(np.abs(out.error_rad))
    tracking = out.state == State.TRACKING
    states = Counter(State(int(state)).name for state in out.state)
    lines = [
        f"{len(out.t_mono)} snapshots of {out.scans_sent} scans, {out.snapshots[-1].missed} missed",
        f"position error: median {np.nanmedian(off):.3f} m, largest {np.nanmax(off):.3f} m, at the end {off[-1]:.3f} m",
        f"heading error: median {np.nanmedian(turned):.3f} deg, largest {np.nanmax(turned):.3f} deg",
        "states: " + ", ".join(f"{name} {count / len(out.state):.1%}" for name, count in states.most_common()),
        f"TRACKING and more than {WRONG_M} m off: {np.mean(tracking & (off > WRONG_M)):.1%} of the time",
    ]
    return "\n".join(lines + alone(out) + changes(out))


def alone(out: Run) -> list[str]:
    """A line about the position from lights alone, where there are any."""
    rows = [(k, s.light) for k, s in enumerate(out.snapshots) if s.light is not None]
    if not rows:
        return []
    known = [(k, light.pose) for k, light in rows if light.pose is not None]
    if not known:
        return ["lights alone: never a position"]
    off = np.array([np.hypot(pose[0] - out.site[k, 0], pose[1] - out.site[k, 1]) for k, pose in known])
    text = f"lights alone: known {len(known) / len(rows):.0%} of the time, "
    text += f"rms {np.sqrt(np.mean(off**2)):.3f} m, median {np.median(off):.3f} m, largest {off.max():.3f} m"
    return [text + f"; {np.mean([len(light.links) for _, light in rows]):.1f} links"]


def changes(out: Run) -> list[str]:
    """A line for every change of state or reason."""
    pairs = np.column_stack([out.state, out.reason])
    at = np.flatnonzero(np.any(np.diff(pairs, axis=0) != 0, axis=1)) + 1
    return [
        f"{out.t_mono[k]:8.2f} s  {State(int(out.state[k])).name:<10} {out.error_m[k]:.3f} m off; "
        f"{REASONS[Reason(int(out.reason[k]))][0]}"
        for k in at
    ]


def write_csv(out: Run, path: Path) -> None:
    """Time, published pose, truth, sigma, state and reason, a row a snapshot."""
    table = np.column_stack([out.t_mono, out.pose, out.truth, out.sigma, out.state, out.reason])
    header = "t_mono,x,y,yaw,true_x,true_y,true_yaw,sigma_x,sigma_y,sigma_yaw,state,reason"
    np.savetxt(path, table, fmt="%.6f", delimiter=",", header=header, comments="")


def main(arguments: list[str] | None = None) -> int:
    """Run and report."""
    parser = argparse.ArgumentParser(prog="python -m tools.sim.report", description=__doc__.splitlines()[0])
    parser.add_argument("building", nargs="?", default="paper_room", choices=sorted(BUILDINGS))
    parser.add_argument("--lidar", default="paper", choices=sorted(MODELS))
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--empty", action="store_true", help="nobody walks about")
    parser.add_argument("--no-odometry", action="store_true", help="the laser alone")
    parser.add_argument("--no-lidar", action="store_true", help="lights alone (with --lights)")
    parser.add_argument("--lights", choices=(WAVEFORM, LINK), help="coded lamps overhead, at this fidelity")
    parser.add_argument("--spread", type=float, default=0.05, help="of the lamps' powers (default %(default)s)")
    parser.add_argument("--faults", type=Path, help="TOML schedule of faults of lidar and adc")
    parser.add_argument("--csv", type=Path, help="write every snapshot beside the truth")
    options = parser.parse_args(arguments)
    lights = Lights(options.lights, Effects(gain_spread=options.spread)) if options.lights else None
    scenario = Scenario(options.building, options.lidar, options.seed, people=not options.empty, lights=lights)
    faults = options.faults.read_text(encoding="utf-8") if options.faults else ""
    begin = time.perf_counter()
    lidar, odometry = not options.no_lidar, not options.no_odometry
    out = run(options.seconds, scenario, faults=faults, odometry=odometry, lidar=lidar)
    print(describe(out))
    print(f"{options.seconds / (time.perf_counter() - begin):.1f} times as fast as real time")
    if options.csv:
        write_csv(out, options.csv)
    return 0


if __name__ == "__main__":
    sys.exit(main())
