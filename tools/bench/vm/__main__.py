"""``python -m tools.bench.vm``: the shipped package in an emulated computer, tried from outside.

Ends with 0 if every scenario passed, 1 if one did not, 2 if this machine cannot run it (the text says what is missing).
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
import time
from pathlib import Path

from tools.bench.report import About, CannotCompare, Result, Seen, facts, read, write
from tools.bench.vm.bench import Bench, bench
from tools.bench.vm.common import Scenario
from tools.bench.vm.image import Image, image
from tools.bench.vm.machine import Order
from tools.bench.vm.places import CannotBench, workspace
from tools.bench.vm.scenarios import SCENARIOS

ROOM = 2_000_000_000
CANNOT = 2
CONFIGURATION = Path(__file__).parent / "guest" / "lumiloop.toml"


def say(text: str) -> None:
    """To the terminal."""
    print(text, flush=True)


def tried(scenario: Scenario, bench: Bench) -> Result:
    """One scenario's result."""
    title = (scenario.__doc__ or scenario.__name__).splitlines()[0].rstrip(".")
    begun = time.monotonic()
    try:
        told, passed = scenario(bench), True
        seen = told if isinstance(told, Seen) else Seen(told)
    except LookupError as error:
        seen, passed = Seen(f"what it builds on has not been seen: {error!r}"), False
    except (Order, OSError, ValueError, StopIteration) as error:
        seen, passed = Seen(f"{error}" or repr(error)), False
    seconds = time.monotonic() - begun
    result = Result(scenario.__name__, title, passed, seconds, seen.said, figures=seen.figures, plots=seen.plots)
    say(f"{result.outcome} {seconds:6.1f} s  {title}\n{' ' * 17}{seen.said}")
    return result


def chosen(names: list[str]) -> list[Scenario]:
    """All scenarios, or those up to the last that is named: each builds on the ones before."""
    if not names:
        return SCENARIOS
    known = [one.__name__ for one in SCENARIOS]
    unknown = [name for name in names if name not in known]
    if unknown:
        raise CannotBench(f"no such scenario: {', '.join(unknown)}; there are {', '.join(known)}")
    return SCENARIOS[: max(known.index(name) for name in names) + 1]


def run(made: Image, scenarios: list[Scenario], out: Path) -> list[Result]:
    """Try them; the console and the daemon's log stay in ``out``."""
    out.mkdir(parents=True, exist_ok=True)
    with workspace("lumiloop-vm", ROOM) as folder:
        try:
            with bench(made, folder) as whole:
                results = [tried(scenario, whole) for scenario in scenarios]
                with contextlib.suppress(Order, OSError):
                    words = ["journalctl", "--no-pager", "-o", "short-monotonic"]
                    (out / "journal.log").write_text(whole.machine.run(*words, seconds=120))
                return results
        finally:
            for name in ("console", "qemu", "world"):
                if (folder / name).exists():
                    (out / f"{name}.log").write_bytes((folder / name).read_bytes())


def main() -> int:
    """Make what is missing, run, report."""
    parser = argparse.ArgumentParser(prog="python -m tools.bench.vm", description=__doc__)
    parser.add_argument("scenario", nargs="*", help="up to which (default: all)")
    parser.add_argument("--out", type=Path, default=Path("out/bench-vm"), help="for results (default %(default)s)")
    parser.add_argument("--against", type=Path, help="results.json of another run, to compare with")
    parser.add_argument("--image-only", action="store_true", help="make the image and stop")
    parser.add_argument("--list", action="store_true", help="say what is tried")
    options = parser.parse_args()
    if options.list:
        for one in SCENARIOS:
            say(f"{one.__name__}: {(one.__doc__ or '').splitlines()[0]}")
        return 0
    begun = time.monotonic()
    try:
        if options.against is not None:
            read(options.against)  # what is wrong with it is told now, not in eight minutes
        made = image(say)
        if options.image_only:
            return 0
        results = run(made, chosen(options.scenario), options.out)
    except (CannotBench, CannotCompare) as reason:
        say(f"the virtual bench cannot run: {reason}")
        return CANNOT
    except KeyboardInterrupt:
        say("ended before its end; nothing of it is left running")
        return CANNOT
    seconds = f"{time.monotonic() - begun:.0f}"
    told = facts(image=made.folder.name, configuration=CONFIGURATION.read_text(), **{"seconds in all": seconds})
    worse = write(options.out, results, About("bench-vm", "Virtual bench", told), options.against)
    failed = [one.name for one in results if not one.passed]
    for text in worse:
        say(f"worse than before: {text}")
    say(f"{len(results) - len(failed)} of {len(results)} passed in {seconds} s; {options.out}/report.html")
    return int(bool(failed or worse))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.exit(main())
