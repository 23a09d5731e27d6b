"""``make demo``: the real daemon and a simulated robot under coded lamps; live pose against truth, a map picture.

The simulator is one process (a lidar on a pty, a photodiode's converter on an I2C bus behind a socket, odometry and
truth as datagrams), the daemon another (``lumiloop run``), its web page a third (``lumiloop view``). This process reads
the pose and the links over Modbus, as any PLC would, and compares the pose with the truth of the same instant. On the
way the photodiode and then the lidar are switched off and on again, or, with --kidnap, the robot is carried away; keys
do the same at any time. At the end map, recording and configuration lie in a folder to go on with. Loopback only;
nothing is left running.
"""

import argparse
import contextlib
import importlib.util
import json
import math
import os
import re
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from daemon.cli.tap_parsers import demo_arguments
from daemon.publish.modbus.client import NoAnswer, Reader, Reading
from daemon.snapshot import State
from estimator import CACHE_DIR
from tools.demo.acts import ROBOT, OrderRefused, Stage, complaint, keyboard, pressed, programme
from tools.demo.folder import CONFIG, KEPT, RECORDING, SURVEY, Wiring, clear, keep
from tools.demo.score import READY, Score, Track, cause, pose_of, summary, told, verdict
from tools.sim.ports import NoFreePort, free_port

ROOT: Final = Path(__file__).parents[2]
READ_PERIOD_S: Final = 0.05
LINE_PERIOD_S: Final = 1.0
COLD_START_S: Final = 300.0
"""Longest wait for the first start ever, which compiles. From `TELL_S` on the progress is shown, every `TELL_S`."""
TELL_S: Final = 4.0
STOP_S: Final = 10.0
LOADING: Final = "loading"
INTERRUPTED: Final = 130
PAGE_LOG: Final = "page.log"
BUS: Final = "i2c"
CONTROL: Final = "control"
OLD_S: Final = 1.0
"""Links that have not been told anew for so long are not shown."""
SHOWN: Final = 4
"""Links in a line, the strongest."""
PAGE_PORT: Final = 8090
"""Where the web page is, if nobody else is there. After `PAGE_S` the demo goes on without it."""
PAGE_S: Final = 30.0


class DemoError(Exception):
    """The demo cannot go on; the text says why and where to look."""


# processes


@contextlib.contextmanager
def running(command: list[str], log: Path, **kw: Any) -> Iterator[subprocess.Popen[str]]:
    """A child process in a session of its own (a Ctrl-C here must not reach it first); stopped on the way out."""
    with log.open("w") as errors:
        child = subprocess.Popen(command, cwd=ROOT, stderr=errors, text=True, start_new_session=True, **kw)
        try:
            yield child
        finally:
            stop(child)


def stop(child: subprocess.Popen[str]) -> None:
    """Ask it to end, then make it."""
    try:
        if child.poll() is None:
            child.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(STOP_S)
    finally:
        if child.poll() is None:  # it does not listen, or a second Ctrl-C came while we waited
            child.kill()
            child.wait()
        if child.stdout is not None:
            child.stdout.close()


def write_config(folder: Path, modbus: int, odometry: int, lights: bool = True) -> Path:
    """The daemon's configuration for this run; its stream is found by the name, which no other run has."""
    path = folder / CONFIG
    bus = f"unix:{folder / BUS}" if lights else ""
    path.write_text(Wiring(f"demo-{os.getpid()}", folder / "lidar", odometry, modbus, bus).config())
    return path


class Patience:
    """Waits for a child and shows, after a few seconds, how far the compiler is: a first start takes long."""

    def __init__(self, out: Path) -> None:
        self._out, self._begin, self._wall = out, time.monotonic(), time.time()
        self._next, self._explained = TELL_S, False

    def wait(self, child: subprocess.Popen[str], log: str) -> None:
        """A moment.

        Raises:
            DemoError: the child has ended, or the wait is over.
        """
        waited = time.monotonic() - self._begin
        if child.poll() is not None:
            raise DemoError(
                f"the process ended with code {child.returncode} before it was ready; read {self._out / log}"
            )
        if waited > COLD_START_S:
            raise DemoError(f"the process is not ready after {COLD_START_S:.0f} s; read {self._out / log}")
        if waited > self._next:
            self._next = waited + TELL_S
            progress = self._progress(log)
            if progress != LOADING and not self._explained:
                print("a first start compiles the numerical kernels, for a minute or two; later starts take seconds")
                self._explained = True
            print(f"{waited:5.0f} s: {progress}", flush=True)
        time.sleep(0.05)

    def _progress(self, log: str) -> str:
        """How many kernels have been compiled since the begin; the daemon says out of how many."""
        said = re.findall(r"compiling: (\d+ of \d+ kernels)", (self._out / log).read_text(errors="replace"))
        if said:
            return f"the daemon has compiled {said[-1]}"
        with contextlib.suppress(OSError):
            if count := sum(path.stat().st_mtime >= self._wall for path in CACHE_DIR.rglob("*.nbc")):
                return f"{count} kernels compiled so far"
        return LOADING


def wait_for_simulator(simulator: subprocess.Popen[str], patience: Patience) -> None:
    """Until its devices are there, which it says on its first line."""
    assert simulator.stdout is not None
    while not select.select([simulator.stdout], [], [], 0.0)[0]:
        patience.wait(simulator, "simulator.log")


def wait_for_pose(daemon: subprocess.Popen[str], reader: Reader, patience: Patience) -> None:
    """Until the daemon says that it follows a sensor."""
    while True:
        with contextlib.suppress(NoAnswer):
            if int(reader.read()["state"] or 0) in READY:
                return
        patience.wait(daemon, "daemon.log")


@contextlib.contextmanager
def web_page(config: Path, log: Path) -> Iterator[subprocess.Popen[str] | None]:
    """Serves the web page of the daemon, and says in its log where; None where the library is missing that it needs."""
    if importlib.util.find_spec("aiohttp") is None:
        yield None
        return
    with socket.socket() as probe:
        port = 0 if probe.connect_ex(("127.0.0.1", PAGE_PORT)) == 0 else PAGE_PORT
    words = [sys.executable, "-m", "daemon", "view", "--config", str(config), "--port", str(port), "--write"]
    with running(words, log, stdout=subprocess.DEVNULL) as server:
        yield server


def page_address(server: subprocess.Popen[str] | None, log: Path) -> str:
    """Where the page is, as its server says; empty: there is none."""
    end = time.monotonic() + PAGE_S
    while server is not None and server.poll() is None and time.monotonic() < end:
        address = log.read_text().partition("http://")[2]
        if address.endswith("\n"):
            return f"http://{address.split()[0]}"
        time.sleep(0.05)
    return ""


# the show


@dataclass(frozen=True, slots=True)
class Show:
    """What the demo watches and moves."""

    reader: Reader
    track: Track
    stage: Stage
    children: list[subprocess.Popen[str]]


def watch(show: Show, score: Score, seconds: float) -> None:
    """Read the pose twenty times a second and print a line every second; 0 seconds: for ever."""
    reader, track, children = show.reader, show.track, show.children
    print("    t |      x       y     yaw |  error          | state       scans  cycle  reads | lamp:strength, uA")
    print("    s |      m       m     deg |     cm     deg  |                Hz     ms  per s |")
    begin = time.monotonic()
    line_at, read_at = begin + LINE_PERIOD_S, begin
    reads = 0
    while not seconds or time.monotonic() - begin < seconds:
        for child in children:
            if child.poll() is not None:
                raise DemoError(f"a process ended with code {child.returncode}: {' '.join(child.args[1:4])}")  # type: ignore[index, arg-type]  # a list
        asked = time.monotonic()
        try:
            reading = reader.read()
        except NoAnswer:
            score.unanswered += 1
            continue
        now = time.monotonic()
        score.watched_s = now - begin
        score.trip_s.append(now - asked)
        track.collect(lifted=any(act.device == ROBOT and act.state == "off" for act in show.stage.acts))
        score.driven_m = track.driven_m
        score.take(reading, None if reading["t_mono"] is None else track.at(float(reading["t_mono"])))
        show.stage.press(pressed(), now - begin)
        off_m, jumps = (score.error_m[-1] if score.error_m else None), int(reading["jumps"] or 0)
        for news in [*show.stage.play(now - begin, int(reading["state"] or 0), off_m, jumps), *score.news()]:
            print(f"----- {news}", flush=True)
        if now >= line_at:
            print(line(now - begin, score, (score.reads - reads) / (now - line_at + LINE_PERIOD_S)), flush=True)
            line_at, reads = now + LINE_PERIOD_S, score.reads
        read_at = max(read_at + READ_PERIOD_S, now)
        time.sleep(read_at - now)


def line(t: float, score: Score, rate: float) -> str:
    """One line about the latest reading."""
    reading = score.last
    pose = pose_of(reading)
    where = "        no pose yet    " if pose is None else f"{pose[0]:7.3f} {pose[1]:7.3f} {math.degrees(pose[2]):7.1f}"
    off = "               "
    if score.error_m:
        off = f"{100 * score.error_m[-1]:6.1f}  {math.degrees(score.error_rad[-1]):+7.2f}"
    state = State(int(reading["state"] or 0)).name
    scans, cycle = reading["scan_rate"] or 0.0, 1e3 * float(reading["cycle"] or 0.0)
    return f"{t:5.1f} |{where} |{off}  | {state:<11}{scans:6.1f} {cycle:6.2f} {rate:6.1f} | {links(reading)}"


def links(reading: Reading) -> str:
    """How many lamps the position rests on, and the strongest with their IDs and strengths in microamperes."""
    if reading.get("light_fix") is None:
        return "no photodiode" if reading.get("links") is None else f"{reading['links']} links"
    if not reading["links"] or float(reading["light_age"] or 0.0) > OLD_S:
        return "no light"
    shown = []
    for row in range(1, SHOWN + 1):
        lamp, strength = reading[f"link_{row}_lamp"], reading[f"link_{row}_strength"]
        if lamp is not None and strength is not None:
            shown.append(f"{int(lamp)}:{1e6 * float(strength):.3f}")
    return f"{int(reading['light_used'] or 0):2d} of {int(reading['links']):2d} used  {'  '.join(shown)}"


def simulator_words(options: argparse.Namespace, folder: Path, odometry: int, truth: int) -> list[str]:
    """The simulator's command line."""
    words = [sys.executable, "-m", "tools.sim", "--building", options.building, "--seed", str(options.seed), "--hold"]
    words += ["--pty", str(folder / "lidar"), "--odometry", f"udp://127.0.0.1:{odometry}"]
    words += ["--truth", f"udp://127.0.0.1:{truth}", "--control", str(folder / CONTROL)]
    if not options.dark:
        words += ["--light", f"unix:{folder / BUS}", "--survey", str(folder / SURVEY)]
    return words


def play(options: argparse.Namespace, folder: Path, out: Path, score: Score) -> None:
    """Run simulator and daemon, and watch; everything is stopped when this returns or raises."""
    modbus, odometry = free_port(), free_port()
    config = write_config(folder, modbus, odometry, lights=not options.dark)
    daemon_words = [sys.executable, "-m", "daemon", "run", "--config", str(config), "--record", str(folder / RECORDING)]
    acts = programme(options.seconds, options.kidnap) if options.kidnap or not options.dark else []
    stage = Stage(folder / CONTROL, acts)
    score.acts, score.surveyed = stage.acts, not options.dark
    with contextlib.ExitStack() as stack:
        truth = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        truth.bind(("127.0.0.1", 0))
        truth.setblocking(False)
        words = simulator_words(options, folder, odometry, truth.getsockname()[1])
        patience = Patience(out)
        simulator = stack.enter_context(running(words, out / "simulator.log", stdout=subprocess.PIPE))
        wait_for_simulator(simulator, patience)
        daemon = stack.enter_context(running(daemon_words, out / "daemon.log", stdout=subprocess.DEVNULL))
        page = stack.enter_context(web_page(config, out / PAGE_LOG))
        if address := page_address(page, out / PAGE_LOG):
            print(f"watch it in a browser: {address}", flush=True)
        reader = stack.enter_context(Reader("127.0.0.1", modbus))
        wait_for_pose(daemon, reader, patience)
        print(f"{options.building}: the robot starts to drive; its pose is on Modbus 127.0.0.1:{modbus} (UDP and TCP)")
        if sys.stdin.isatty() and not options.dark:
            print("keys: p switches the photodiode off or on, l the lidar, c moves the robot by hand")
        simulator.send_signal(signal.SIGUSR1)
        stack.enter_context(keyboard())
        watch(Show(reader, Track(truth), stage, [daemon, simulator]), score, options.seconds)


def show(options: argparse.Namespace, folder: Path, out: Path) -> int:
    """The demo itself; returns the exit code."""
    score, wrong, interrupted = Score(), "", False
    try:
        play(options, folder, out, score)
    except KeyboardInterrupt:
        interrupted = True
        if not score.reads:
            return INTERRUPTED
    except (DemoError, NoFreePort, OrderRefused) as error:
        wrong = str(error)
    figures = summary(score)
    early = interrupted and not score.error_m  # nothing is wrong with a run that had no time to show anything
    wrong = wrong or ("" if early else verdict(figures)) or complaint(score.acts)
    kept = keep(folder, out, options.building)
    wrong = wrong or kept
    print("\n".join(told(figures)))
    for act in score.acts:
        print(act.words)
        if act.device == ROBOT:
            print(f"map jumps counted: {act.jumps[0]} before, {act.jumps[1]} at the end")
    (out / "summary.json").write_text(json.dumps({"ok": not wrong, "problem": wrong, **figures}, indent=1) + "\n")
    print(f"in {out}: {', '.join(name for name in KEPT if (out / name).exists())}")
    if wrong:
        print(f"FAILED: {wrong}{cause(figures)} (logs: {out})", file=sys.stderr)
    return 1 if wrong else 0


def main(arguments: list[str] | None = None) -> int:
    """Run the demo; 0 if the pose was good, 1 if not, 130 if interrupted before there was anything to show."""
    parser = argparse.ArgumentParser(prog="python -m tools.demo", description=__doc__.splitlines()[0])
    demo_arguments(parser)
    return run(parser.parse_args(arguments))


def run(options: argparse.Namespace) -> int:
    """Run the demo with these options, those of :func:`daemon.cli.tap_parsers.demo_arguments`."""
    out = options.out.absolute()
    out.mkdir(parents=True, exist_ok=True)
    clear(out)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.default_int_handler)
    os.environ.setdefault("PYTHONUNBUFFERED", "1")
    try:
        with tempfile.TemporaryDirectory(prefix="lumiloop-demo-") as folder:
            return show(options, Path(folder), out)
    except KeyboardInterrupt:
        return INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
