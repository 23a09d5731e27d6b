"""``python -m tools.bench.world SCENARIO ...``: this computer plays the world for a robot computer under test.

::

    python -m tools.bench.world lap cable --lidar /dev/ttyGS0 --modbus 192.168.0.20:1502 --odometry udp://192.168.0.20:5601
    python -m tools.bench.world my.toml --lidar tcp://0.0.0.0:10940 --light dac:/dev/i2c-1@0x60 --modbus 192.168.0.20
    python -m tools.bench.world lap --local

docs/bench.md has the wiring. Ends with 0 if everything is as expected, 1 if not, 2 if it cannot be played.
"""

from __future__ import annotations

import argparse
import asyncio
import signal
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Final

from hal.errors import HalError
from hal.fake.faults import FaultError
from tools.bench.report import About, CannotCompare, Result, facts, read, write
from tools.bench.world import agreement
from tools.bench.world.judge import Played, judged, pictures
from tools.bench.world.local import robot
from tools.bench.world.scenario import BUILT_IN, Scenario, ScenarioError, find, load
from tools.bench.world.stage import CannotPlay, Ends, play

CANNOT: Final = 2
APART_M: Final = 0.01
LEAST_S, LEAST_M = 2.0, 1.0
"""Of driving until a fault, for two runs to be compared, and so much way with poses that are."""
TITLE: Final = "The world played to a robot computer"


def say(text: str) -> None:
    """To the terminal."""
    print(text, flush=True)


def _parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(prog="python -m tools.bench.world", description=__doc__.split("\n")[0])
    add = made.add_argument
    add("scenario", nargs="*", help="files, or names of those that come with the bench")
    add("--list", action="store_true", help="say which come with it")
    add(
        "--lidar", default="", help="line that the lidar is to come out of: /dev/ttyGS0, /dev/ttyUSB0@115200, tcp://..."
    )
    add("--modbus", default="", metavar="HOST[:PORT]", help="robot computer")
    add("--odometry", default="", metavar="udp://HOST:PORT", help="where odometry goes")
    add("--light", default="", help="dac:/dev/i2c-1@0x60, or a bus to serve: unix:/path, tcp://0.0.0.0:7777")
    add("--anyone", action="store_true", help="serve that bus to other computers, without authentication")
    add("--local", action="store_true", help="no robot computer: a daemon of this tree on a pty of this computer")
    add("--twin", action="store_true", help="compare with the same scenario in virtual time: to agree to 1 cm")
    add("--out", type=Path, default=Path("out/bench-world"), help="for the report (default %(default)s)")
    add("--against", type=Path, help="results.json of another run, to compare with")
    return made


def tried(scenario: Scenario, ends: Ends, twin: bool) -> list[Result]:
    """Play one scenario; a result for each thing that is expected, the pictures with the first."""
    begun = time.monotonic()
    played = asyncio.run(play(scenario, ends, say))
    results = []
    for number, expected in enumerate(scenario.expect):
        passed, seen = judged(expected, played)
        name = f"{scenario.name}.{number + 1}-{expected.what}"
        title = f"{scenario.title}: {expected}"
        plots = pictures(played) if number == 0 else ()
        seconds = time.monotonic() - begun if number == 0 else 0.0
        results.append(Result(name, title, passed, seconds, seen.said, figures=seen.figures, plots=plots))
    if twin:
        results.append(twins(scenario, played))
    for one in results:
        told = "; ".join(filter(None, (one.skipped, one.said, *map(str, one.figures))))
        say(f"{one.outcome}  {one.title}\n        {told}")
    return results


def twins(scenario: Scenario, played: Played) -> Result:
    """The same scenario with the daemon in this process, in virtual time, until the first fault."""
    until = f", until the fault at {agreement.alike_s(scenario):g} s" if scenario.faults else ""
    until += ", until a loop is closed"
    name, title = f"{scenario.name}.twin", f"{scenario.title}: poses agree with virtual time to {1e3 * APART_M:.0f} mm"
    if scenario.world.lamps:
        why = "under surveyed lamps a place is known to decimetres at first, and depends on which samples were taken"
        return Result(name, title, False, 0.0, "", skipped=why)
    if agreement.alike_s(scenario) < scenario.drive.dwell + LEAST_S:
        return Result(name, title, False, 0.0, "", skipped="a fault strikes before it has driven any way")
    found = agreement.trace(played)
    if not len(found.driven):
        return Result(name, title + until, False, 0.0, "no pose was read in that time")
    figures, plots = agreement.figures(found, agreement.reference(scenario), "from virtual time")
    passed = figures[-1].value <= 1e3 * APART_M and figures[0].value >= LEAST_M
    said = "" if figures[0].value >= LEAST_M else f"less than {LEAST_M:g} m of its way could be compared"
    return Result(name, title + until, passed, 0.0, said, figures=figures, plots=plots)


def ends_of(options: argparse.Namespace) -> Ends:
    """Where things go, by the command line."""
    host, _, port = options.modbus.partition(":")
    missing = [f"--{name}" for name in ("lidar", "modbus") if not getattr(options, name)]
    if missing:
        raise CannotPlay(f"{' and '.join(missing)} missing (docs/bench.md has the wiring), or --local without any")
    if port and not port.isdigit():
        raise CannotPlay(f"--modbus {options.modbus}: expected HOST:PORT, as 192.168.0.20:1502")
    return Ends(options.lidar, (host, int(port or 1502)), options.odometry, options.light, options.anyone)


@contextmanager
def opposite(options: argparse.Namespace, scenario: Scenario) -> Generator[Ends]:
    """The robot computer: the one that is named, or a process here."""
    with robot(scenario) if options.local else nullcontext(ends_of(options)) as ends:
        yield ends


def main(arguments: list[str] | None = None) -> int:
    """Play, judge, report."""
    options = _parser().parse_args(arguments)
    if options.list:
        for path in sorted(BUILT_IN.glob("*.toml")):
            say(f"{path.stem}: {load(path).title}")
        return 0
    results: list[Result] = []
    left: list[Scenario] = []
    why = ""
    try:
        if options.against is not None:
            read(options.against)
        left = [load(find(name)) for name in options.scenario or ["lap"]]
        while left:
            with opposite(options, left[0]) as ends:
                results += tried(left[0], ends, options.twin)
            del left[0]
    except (ScenarioError, CannotPlay, CannotCompare, HalError, FaultError, ValueError, OSError) as reason:
        why = f"cannot be played: {reason}"
    except KeyboardInterrupt:
        why = "ended before its end"
    if why:
        say(why)
        if not results:
            return CANNOT
        results += [Result(one.name, one.title, False, 0.0, "", skipped=f"not played: {why}") for one in left]
    told = facts(
        robot="a process here" if options.local else options.modbus, lidar=options.lidar or "pty",
        light=options.light or "-", scenarios="\n".join(find(name).read_text() for name in options.scenario or ["lap"]),
    )  # fmt: skip
    worse = write(options.out, results, About("bench-world", TITLE, told), options.against)
    for text in worse:
        say(f"worse than before: {text}")
    done = [one for one in results if not one.skipped]
    passed = sum(one.passed for one in done)
    say(f"{passed} of {len(done)} as expected; {options.out}/report.html")
    return CANNOT if why else int(passed < len(done) or bool(worse))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.exit(main())
