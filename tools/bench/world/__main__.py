"""``python -m tools.bench.world SCENARIO ...``: this computer plays the world for a robot computer under test.

::

    python -m tools.bench.world lap cable --lidar /dev/ttyGS0 --modbus 192.168.0.20:1502 --odometry udp://192.168.0.20:5601
    python -m tools.bench.world my.toml --lidar tcp://0.0.0.0:10940 --light dac:/dev/i2c-1@0x60 --modbus 192.168.0.20
    python -m tools.bench.world lap --local

The same words and ``--write-config DIR`` write what the robot computer needs for it; docs/bench.md has the wiring.
Ends with 0 if everything is as expected, 1 if not, 2 if it cannot be played.
"""

import argparse
import asyncio
import signal
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Final

from daemon.runtime.warmup import CannotLoad
from hal.errors import HalError
from tools.bench.report.against import SCENARIO, Before, CannotCompare, digest, read
from tools.bench.report.page import CannotReport, demand_apart, demand_room, facts, write
from tools.bench.report.result import About, Result
from tools.bench.world import agreement
from tools.bench.world.judge import Played, judged, pictures
from tools.bench.world.local import robot, warm
from tools.bench.world.robotside import write_config
from tools.bench.world.scenario import BUILT_IN, Scenario, find, load
from tools.bench.world.stage import LINES, CannotPlay, Ends, is_line, is_port, play

CANNOT: Final = 2
ELSEWHERE: Final = ("lidar", "modbus", "odometry", "light", "anyone")
"""Words that say where a robot computer is reached, and by whom this one is: a daemon of this computer needs none."""
TCP: Final = "tcp://"
SERVED: Final = {"lidar": "tcp://0.0.0.0:10940", "light": "tcp://0.0.0.0:7777"}
"""Words that may name an address to serve at, each with one that is good."""
LIGHT: Final = ("dac:", "unix:", TCP)
"""Beginnings of what light may come out of."""
APART_M: Final = 0.01
LEAST_S, LEAST_M = 2.0, 1.0
"""Of driving until a fault, for two runs to be compared, and so much way with poses that are."""
NAME: Final = "bench-world"
TITLE: Final = "The world played to a robot computer"


def say(text: str) -> None:
    """To the terminal."""
    print(text, flush=True)


def _parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(prog="python -m tools.bench.world", description=__doc__.split("\n")[0])
    add = made.add_argument
    add("scenario", nargs="*", help="files, or names of those that come with the bench (default: lap)")
    add("--list", action="store_true", help="say which come with it")
    add(
        "--lidar", default="", help="line that the lidar is to come out of: /dev/ttyGS0, /dev/ttyUSB0@115200, tcp://..."
    )
    add("--modbus", default="", metavar="HOST[:PORT]", help="robot computer")
    add(
        "--odometry", default="", metavar="udp://HOST:PORT",
        help="where the wheels' odometry goes; without it none is sent: the robot computer must not expect any "
        "(odometry.port left out, as --write-config then does), or says DEGRADED",
    )  # fmt: skip
    add("--light", default="", help="dac:/dev/i2c-1@0x60, or a bus to serve: unix:/path, tcp://0.0.0.0:7777")
    add("--anyone", action="store_true", help="serve that bus to other computers, without authentication")
    add(
        "--local", action="store_true",
        help="no robot computer: a daemon of this tree on a pty of this computer, with wheels and lamps of its own; "
        "beside none of the words above",
    )  # fmt: skip
    add("--twin", action="store_true", help="compare with the same scenario in virtual time: to agree to 1 cm")
    add("--out", type=Path, default=Path("out/bench-world"), help="for the report (default %(default)s)")
    add("--against", type=Path, help="another run's folder, or its results.json, to compare with")
    add(
        "--write-config", type=Path, metavar="DIR",
        help="play nothing: write configuration and survey that the robot computer needs for one scenario, with all "
        "other words as for the drive",
    )  # fmt: skip
    return made


def tried(scenario: Scenario, ends: Ends, twin: bool) -> list[Result]:
    """Play one scenario; a result for each thing that is expected, the pictures with the first."""
    begun = time.monotonic()
    played = asyncio.run(play(scenario, ends, say))
    results = []
    for number, (name, expected) in enumerate(zip(scenario.names, scenario.expect, strict=True)):
        passed, seen = judged(expected, played)
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
        either = "" if options.write_config is not None else ", or --local without any"
        raise CannotPlay(f"{' and '.join(missing)} missing (docs/bench.md has the wiring){either}")
    if not (options.lidar.startswith(("pty:", TCP)) or is_line(options.lidar)):
        raise CannotPlay(f"--lidar {options.lidar}: not a line: expected {LINES}")
    if port and not is_port(port):
        raise CannotPlay(f"--modbus {options.modbus}: expected HOST:PORT, as 192.168.0.20:1502")
    for name, as_here in SERVED.items():
        address = getattr(options, name)
        at, _, number = address.removeprefix(TCP).rpartition(":")
        if address.startswith(TCP) and not (at and is_port(number)):
            raise CannotPlay(f"--{name} {address}: no port to listen at: expected tcp://HOST:PORT, as {as_here}")
    if options.light and not any(options.light.startswith(one) and options.light != one for one in LIGHT):
        raise CannotPlay(f"--light {options.light}: expected dac:/dev/i2c-1@0x60, unix:/path or {SERVED['light']}")
    return Ends(options.lidar, (host, int(port or 1502)), options.odometry, options.light, options.anyone)


@contextmanager
def opposite(options: argparse.Namespace, scenario: Scenario) -> Generator[Ends]:
    """The robot computer: the one that is named, or a process here, which finds all of its kernels compiled."""
    if options.local:
        warm(scenario.world.lamps, say)
    with robot(scenario) if options.local else nullcontext(ends_of(options)) as ends:
        yield ends


def chosen(options: argparse.Namespace) -> list[Scenario]:
    """The scenarios that are named, each of which can be played with these ends as far as can be told beforehand."""
    beside = [f"--{name}" for name in ELSEWHERE if getattr(options, name)]
    if options.local and beside:
        raise CannotPlay(
            f"--local is a daemon of this computer, without {', '.join(beside)}: leave one or the other out"
        )
    files = [find(name) for name in options.scenario or ["lap"]]
    _told_apart(files)
    scenarios = [load(file) for file in files]
    for one in scenarios:
        if options.light.startswith("dac:") and any(fault.get("where") == "adc" for fault in one.faults):
            raise CannotPlay(f"{one.name}: no fault can be ordered of the robot computer's converter, behind a DAC")
    return scenarios


def _told_apart(files: list[Path]) -> None:
    """Refuse two of one name: in the report one's results would stand for the other's."""
    for file in files:
        if (first := next(one for one in files if one.stem == file.stem)) is not file:
            why = f"{first} and {file} are both called so: name one of them otherwise"
            twice = first.resolve() == file.resolve()
            raise CannotPlay(f"{file.stem}: {'named twice: a run plays it once' if twice else why}")


def configured(options: argparse.Namespace, scenarios: list[Scenario]) -> int:
    """Write what the robot computer needs, and say what to do with it."""
    if options.local:
        raise CannotPlay("--write-config is for a robot computer; --local configures its own daemon: leave one out")
    if len(scenarios) > 1:
        names = ", ".join(one.name for one in scenarios)
        raise CannotPlay(
            f"--write-config takes one scenario, and {len(scenarios)} are named ({names}): name one of them"
        )
    try:
        files = write_config(options.write_config, scenarios[0], ends_of(options))
    except OSError as error:
        where = f"--write-config {options.write_config}"
        raise CannotPlay(f"{where}: {error.strerror}: name a folder that can be made and written") from error
    for file in files:
        say(f"written: {file}")
    say("Look through it, copy all of it to the robot computer's /etc/lumiloop, and there: systemctl restart lumiloop")
    return 0


def compared_with(options: argparse.Namespace, scenarios: list[Scenario]) -> Before | None:
    """The run to compare with, if one is named, and it has something of these."""
    if options.against is None:
        return None
    before = read(options.against, NAME)
    before.demand([name for one in scenarios for name in one.names])
    return before


def main(arguments: list[str] | None = None) -> int:
    """Play, judge, report."""
    options = _parser().parse_args(arguments)
    if options.list:
        for path in sorted(BUILT_IN.glob("*.toml")):
            say(f"{path.stem}: {load(path).title}")
        return 0
    results: list[Result] = []
    scenarios: list[Scenario] = []
    left: list[Scenario] = []
    why = ""
    before = None
    try:
        scenarios = chosen(options)
        if options.write_config is not None:
            return configured(options, scenarios)
        before = compared_with(options, scenarios)
        demand_room(options.out)
        demand_apart(options.out, before)
        left = list(scenarios)
        while left:
            with opposite(options, left[0]) as ends:
                results += tried(left[0], ends, options.twin)
            del left[0]
    except (CannotPlay, CannotLoad, CannotCompare, CannotReport, HalError, ValueError, OSError) as reason:
        why = f"cannot be played: {reason}"
    except KeyboardInterrupt:
        why = "ended before its end"
    if why:
        say(why)
        if not results:
            return CANNOT
        results += [Result(one.name, one.title, False, 0.0, "", skipped=f"not played: {why}") for one in left]
    return told(options, results, About(NAME, TITLE, known(options, scenarios)), before, broken_off=bool(why))


def known(options: argparse.Namespace, scenarios: list[Scenario]) -> dict[str, str]:
    """Facts of the run: where things went, and what was played, as it was read."""
    played = {f"{SCENARIO}{one.name}": digest(one.text) for one in scenarios}
    return facts(
        robot="a process here" if options.local else options.modbus, lidar=options.lidar or "pty",
        light=options.light or "-", odometry=options.odometry or "-",
        scenarios="\n".join(one.text for one in scenarios), **played,
    )  # fmt: skip


def told(
    options: argparse.Namespace, results: list[Result], about: About, before: Before | None, broken_off: bool
) -> int:
    """Write the report and say what came of it; the exit status."""
    compared = write(options.out, results, about, before)
    done = [one for one in results if not one.skipped]
    passed = sum(one.passed for one in done)
    say(f"{passed} of {len(done)} as expected; {options.out}/report.html")
    for text in compared.closing():
        say(text)
    return CANNOT if broken_off else int(passed < len(done) or bool(compared.worse))


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.exit(main())
