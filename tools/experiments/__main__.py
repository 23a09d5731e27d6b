"""``python -m tools.experiments``: every figure and table of the paper and of this project, made anew.

Each experiment leaves ``<out>/<name>.json`` (figures, tables, seeds, run time), its pictures as PNG and a page; beside
them ``README.md`` says what there is. A run that was interrupted goes on where it was: what this code has made already
is not made again (``--again`` does). Experiments on recorded data need LUMILOOP_DATA (docs/data.md) and are skipped
without it, with the reason. Exit status: 0 all ran or were skipped, 1 one could not run. A missed target is printed and
does not change the status.
"""

import argparse
import importlib
import json
import os
import pkgutil
import sys
import time
from pathlib import Path
from typing import Any, Final

import tools.experiments
from tools.ci.figures import table
from tools.experiments import pages
from tools.experiments.support.report import COMMAND, Report, Skipped, Work, code, save

EXPERIMENTS: Final = {
    "table1": "Table 1", "fig4": "Fig. 4", "fig5": "Fig. 5", "fig5_loops": "Fig. 5, loops closed", "fig6": "Fig. 6",
    "methods": "Sect. 5", "claim": "its claim of cost", "adaptive": "its future work", "beamquality": "Eq. 8 and 9",
    "room": "", "corridor": "", "doors": "", "islands": "", "tones": "", "static": "", "walks": "", "survey": "",
    "relocate": "", "relocate_real": "", "integrity": "", "belief": "", "constants": "",
}  # fmt: skip
"""Of what in the paper each is; nothing: ours alone."""
MODULES: Final = {
    found.name.rpartition(".")[2]: found.name
    for found in pkgutil.walk_packages(tools.experiments.__path__, "tools.experiments.")
    if not found.ispkg
} | {"integrity": "tools.experiments.integrity.campaign"}
"""Module of each experiment."""
RESULTS: Final = Path("docs/results")
QUICK: Final = Path("out/experiments/quick")
ROWS: Final = Path("out/experiments/rows")
"""Results of some rows of an experiment."""
SOURCES: Final = (
    "estimator/**/*.py",
    "hal/**/*.py",
    "daemon/**/*.py",
    "tools/sim/**/*.py",
    "tools/experiments/**/*.py",
)


def show(report: Report) -> None:
    """Figures, tables and notes on the terminal."""
    if report.figures:
        print(table(report.figures))
    for part in report.tables:
        print("\n" + part.text())
    for note in report.notes:
        print(f"note: {note}")


def kept(path: Path) -> dict[str, Any]:
    """What a result says of itself; empty: there is none that can be read."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def run_one(name: str, options: argparse.Namespace) -> bool:
    """Run one experiment and keep what it found; returns whether it ran or had a reason not to."""
    print(f"\n== {name}", flush=True)
    what = {"quick": options.quick, "trials": options.trials, "rows": options.rows, "code": code(*SOURCES)}
    before = kept(options.out / f"{name}.json")
    if not options.again and before.items() >= what.items():
        print(f"made by this code already: {options.out / name}.json; --again makes it anew")
        return True
    begun = time.monotonic()
    try:
        module = importlib.import_module(MODULES[name])
        work = Work(options.jobs, sys.stderr.isatty(), options.trials, tuple(filter(None, options.rows.split(","))))
        report = module.run(options.quick, work)
    except Skipped as reason:
        print(f"skipped: {reason}")
        return True
    except Exception as error:  # noqa: BLE001  one broken experiment must not hide the others' figures
        print(f"{name} could not run: {error!r}")
        return False
    seconds = time.monotonic() - begun
    show(report)
    words = " --quick" * options.quick + f" --rows {options.rows}" * bool(options.rows)
    words += f" --trials {options.trials}" * bool(options.trials)
    facts = {
        "experiment": name, "paper": EXPERIMENTS.get(name, ""), "title": (module.__doc__ or name).splitlines()[0],
        "command": f"{COMMAND} {name}{words}",
        "seconds": round(seconds, 2), "jobs": options.jobs, **what,
    }  # fmt: skip
    paths = save(name, report, facts, options.out)
    pages.write(options.out, list(EXPERIMENTS))
    print(f"{seconds:.1f} s; written: {', '.join(str(path) for path in paths)}")
    return True


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """Options; a name that is not an experiment ends the program with the list of those that are."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.experiments", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", action="append", metavar="NAME", help="run just this one (may be repeated)")
    parser.add_argument("--quick", action="store_true", help="a small part of each, in seconds; figures are rough")
    parser.add_argument("--again", action="store_true", help="make anew what this code has made already")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes (default: one a core)")
    parser.add_argument("--trials", type=int, default=0, help="of experiments that repeat something at random")
    parser.add_argument(
        "--rows", default="", metavar="A,B", help="of an experiment of several rows (belief) only these"
    )
    parser.add_argument("--out", type=Path, help=f"folder (default: {RESULTS}; with --quick {QUICK}, --rows {ROWS})")
    options = parser.parse_args(arguments)
    unknown = set(options.only or ()) - set(EXPERIMENTS)
    if unknown:
        parser.error(f"no such experiment: {', '.join(sorted(unknown))}; there are {', '.join(EXPERIMENTS)}")
    if options.jobs < 1:
        parser.error(f"--jobs {options.jobs}: at least one process is needed")
    options.names = options.only or list(EXPERIMENTS)
    options.out = options.out or (QUICK if options.quick else ROWS if options.rows else RESULTS)
    whole = [
        name for name in options.names if options.quick and kept(options.out / f"{name}.json").get("quick") is False
    ]
    if whole:
        parser.error(
            f"{options.out} holds whole runs of {', '.join(whole)}; name another --out for a quick part of them"
        )
    return options


def main(arguments: list[str] | None = None) -> int:
    """Run what was asked for."""
    options = parse(arguments)
    ran = [run_one(name, options) for name in options.names]
    return int(not all(ran))


if __name__ == "__main__":
    sys.exit(main())
