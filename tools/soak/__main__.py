"""``python -m tools.soak``: simulated days, or hours of the real processes; whether anything grows.

    python -m tools.soak --days 1          # the daemon's cycle, one scan a second, as fast as it goes
    python -m tools.soak --days 30
    python -m tools.soak --building office_floor
    python -m tools.soak --real 60         # daemon and simulator as in the demo, 40 Hz, sixty minutes

A table, out/soak/*.json and a graph; 1 where a bound is broken.
"""

import argparse
import signal
import time
from pathlib import Path
from typing import Final

from tools.ci.figures import Figure, save, table
from tools.sim.building.buildings import BUILDINGS
from tools.soak.watched import Watch

COMMAND: Final = "python -m tools.soak"


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=(__doc__ or "").partition("\n")[0])
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--days", type=float, default=1.0, help="simulated (default %(default)s)")
    kind.add_argument("--real", type=float, metavar="MINUTES", help="real processes in real time")
    parser.add_argument("--building", default="paper_room", choices=sorted(BUILDINGS), help="of simulated days")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/soak"))
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # what is watched must not outlive this one
    rows, watch = (
        of_processes(options.real, options.seed, options.out)
        if options.real
        else of_days(options.days, options.building, options.seed)
    )
    name = "real" if options.real else "days"
    print(table(rows))
    watch.draw(options.out / f"{name}.png")
    print(f"written: {save(name, rows, options.out)}, {options.out / name}.png")
    return int(any(row.ok is False for row in rows))


def of_days(days: float, building: str, seed: int) -> tuple[list[Figure], Watch]:
    """Simulated days."""
    from tools.soak import virtual

    command, begin = f"{COMMAND} --days {days:g} --building {building}", time.monotonic()
    outcome = virtual.run(days, building, seed, lambda text: print(text, flush=True))
    rows = [
        *outcome.watch.figures(command),
        Figure("cycles in TRACKING", outcome.tracking, "", command=command),
        Figure("position error, median", outcome.error_m, "m", command=command),
        Figure("took", time.monotonic() - begin, "s", command=command),
    ]
    return rows, outcome.watch


def of_processes(minutes: float, seed: int, out: Path) -> tuple[list[Figure], Watch]:
    """The real processes."""
    from tools.soak import real

    watch = real.run(60.0 * minutes, seed, out, lambda text: print(text, flush=True))
    return watch.figures(f"{COMMAND} --real {minutes:g}"), watch


if __name__ == "__main__":
    raise SystemExit(main())
