"""``python -m tools.experiments lights``: run the experiments of a group, print their tables, keep data and pictures.

Each leaves ``<out>/<name>.json`` (figures, tables, seeds, run time) and its pictures as PNG. Experiments on recorded
data need LUMILOOP_DATA (docs/data.md) and are skipped without it, with the reason. Exit status: 0 all ran or were
skipped, 1 one could not run. A missed target is printed and does not change the status.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import sys
import time
from pathlib import Path
from typing import Final

from tools.experiments.report import Report, Skipped, Work, save
from tools.figures import table

GROUPS: Final = {
    "lights": (
        "fig4", "fig5", "fig5_loops", "fig6", "corridor", "islands", "claim", "adaptive", "room", "tones", "static",
        "walks", "survey", "beamquality", "relocate", "relocate_real",
    ),
}  # fmt: skip


def available(group: str) -> list[str]:
    """Experiments of a group that exist in this tree, in order."""
    return [name for name in GROUPS[group] if importlib.util.find_spec(f"tools.experiments.{name}")]


def show(report: Report) -> None:
    """Figures, tables and notes on the terminal."""
    if report.figures:
        print(table(report.figures))
    for part in report.tables:
        print("\n" + part.text())
    for note in report.notes:
        print(f"note: {note}")


def run_one(name: str, options: argparse.Namespace) -> bool:
    """Run one experiment and keep what it found; returns whether it ran or had a reason not to."""
    print(f"\n== {name}", flush=True)
    begun = time.monotonic()
    try:
        report = importlib.import_module(f"tools.experiments.{name}").run(
            options.quick, Work(options.jobs, sys.stderr.isatty(), options.trials)
        )
    except Skipped as reason:
        print(f"skipped: {reason}")
        return True
    except Exception as error:  # noqa: BLE001  one broken experiment must not hide the others' figures
        print(f"{name} could not run: {error!r}")
        return False
    seconds = time.monotonic() - begun
    show(report)
    command = f"python -m tools.experiments {options.group} --only {name}" + " --quick" * options.quick
    facts = {"experiment": name, "command": command, "quick": options.quick, "seconds": round(seconds, 2)}
    paths = save(name, report, facts, options.out)
    print(f"{seconds:.1f} s; written: {', '.join(str(path) for path in paths)}")
    return True


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Options; a name that is not an experiment of the group ends the program with the list of those that are."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.experiments", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("group", choices=sorted(GROUPS))
    parser.add_argument("--only", action="append", metavar="NAME", help="run just this one (may be repeated)")
    parser.add_argument("--quick", action="store_true", help="a small part of each, in seconds; figures are rough")
    parser.add_argument("--jobs", type=int, default=1, help="processes to spread trials over (default: 1)")
    parser.add_argument("--trials", type=int, default=0, help="of experiments that repeat something at random")
    parser.add_argument("--out", type=Path, default=Path("out/experiments"))
    options = parser.parse_args(arguments)
    names = available(options.group)
    unknown = set(options.only or ()) - set(names)
    if unknown:
        parser.error(f"no such experiment: {', '.join(sorted(unknown))}; there are {', '.join(names)}")
    if options.jobs < 1:
        parser.error(f"--jobs {options.jobs}: at least one process is needed")
    options.names = options.only or names
    return options


def main(arguments: list[str] | None = None) -> int:
    """Run what was asked for."""
    options = parse(arguments)
    ran = [run_one(name, options) for name in options.names]
    return int(not all(ran))


if __name__ == "__main__":
    sys.exit(main())
