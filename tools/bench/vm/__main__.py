"""``python -m tools.bench.vm``: the shipped package in an emulated computer, tried from outside.

Ends with 0 if every scenario passed, 1 if one did not or was not run, 2 if this machine cannot run it (the text says
what is missing).
"""

import argparse
import signal
import sys
import time
from pathlib import Path

from tools.bench.report.against import CannotCompare, read
from tools.bench.report.page import CannotReport, demand_apart, demand_room, facts, write
from tools.bench.report.result import About, Result
from tools.bench.vm.booted import Booted, booted
from tools.bench.vm.common import Scenario
from tools.bench.vm.guests import Guest, run_all
from tools.bench.vm.image import image
from tools.bench.vm.places import CannotBench, workspace
from tools.bench.vm.scenarios import SCENARIOS, SHARES

ROOM = 4_000_000_000
CANNOT = 2
OTHERS = "run it as that user, or name another place for it with XDG_CACHE_HOME"
NAME = "bench-vm"
CONFIGURATION = Path(__file__).parent / "guest" / "lumiloop.toml"


def say(text: str) -> None:
    """To the terminal."""
    print(text, flush=True)


def chosen(names: list[str]) -> list[list[Scenario]]:
    """All shares; or of each what goes up to the last that is named, if any: a scenario builds on those before it."""
    known = [one.__name__ for one in SCENARIOS]
    unknown = [name for name in names if name not in known]
    if unknown:
        raise CannotBench(f"no such scenario: {', '.join(unknown)}; there are {', '.join(known)}")
    if not names:
        return SHARES
    ends = [max((k + 1 for k, one in enumerate(share) if one.__name__ in names), default=0) for share in SHARES]
    return [share[:end] for share, end in zip(SHARES, ends, strict=True)]


def run(made: Booted, shares: list[list[Scenario]], out: Path) -> tuple[bool, list[Result]]:
    """Try them; whether that went to its end, and the results."""
    out.mkdir(parents=True, exist_ok=True)
    guests = [Guest(number, share) for number, share in enumerate(shares, 1) if share]
    with workspace("lumiloop-vm", ROOM) as folder:
        whole = run_all(guests, made, folder, out, say)
    return whole, [one for guest in guests for one in guest.results]


def main() -> int:
    """Make what is missing, run, report."""
    parser = argparse.ArgumentParser(prog="python -m tools.bench.vm", description=__doc__)
    parser.add_argument("scenario", nargs="*", help="up to which (default: all)")
    parser.add_argument("--out", type=Path, default=Path("out/bench-vm"), help="for results (default %(default)s)")
    parser.add_argument("--against", type=Path, help="another run's folder, or its results.json, to compare with")
    parser.add_argument("--image-only", action="store_true", help="make the image and stop")
    parser.add_argument("--list", action="store_true", help="say what is tried")
    options = parser.parse_args()
    begun = time.monotonic()
    try:
        shares = chosen(options.scenario)
        if options.list:
            for one in (one for share in shares for one in share):
                say(f"{one.__name__}: {(one.__doc__ or '').splitlines()[0]}")
            return 0
        before = None
        if options.against is not None:  # what is wrong with it is told now, not in eight minutes
            before = read(options.against, NAME)
            before.demand([one.__name__ for share in shares for one in share])
        demand_room(options.out)
        demand_apart(options.out, before)
        with image(say) as system:
            made = booted(system, say)
            if options.image_only:
                return 0
            whole, results = run(made, shares, options.out)
    except (CannotBench, CannotCompare, CannotReport) as reason:
        say(f"the virtual bench cannot run: {reason}")
        return CANNOT
    except OSError as error:
        owner = (
            f"; what is kept there is of the user who made it: {OTHERS}" if isinstance(error, PermissionError) else ""
        )
        say(f"the virtual bench cannot run: {error.filename or 'this computer'}: {error.strerror}{owner}")
        return CANNOT
    except KeyboardInterrupt:
        say("ended before it began; nothing of it is left running")
        return CANNOT
    seconds = f"{time.monotonic() - begun:.0f}"
    told = facts(image=made.image.folder.name, configuration=CONFIGURATION.read_text(), **{"seconds in all": seconds})
    if not whole:
        told["broken off"] = "before its end; what was not run by then is named below"
    compared = write(options.out, results, About(NAME, "Virtual bench", told), before)
    failed = [one.name for one in results if not one.passed]
    left = sum(bool(one.skipped) for one in results)
    count = f"{len(results) - len(failed)} of {len(results)} passed{f', {left} not run' if left else ''}"
    say(f"{count} in {seconds} s; {options.out}/report.html")
    for text in compared.closing():
        say(text)
    return int(bool(failed or compared.worse))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.exit(main())
