"""How late cycles begin at 40 Hz while other programs keep both cores busy, against a bare loop in C in the same run.

The daemon (a process of its own, whole but for the sensors' wires: `tools.bench.support.paced`) is fed 1081 beams,
wheels and 16 lamps by a kernel timer. Stretches of ten seconds take turns (A B C C B A): *quiet*, the computer to
itself; *alone*, beside two burners that walk through memory; and *loaded*, beside them with 8 Modbus readers at 100 Hz
each, a stream client that never reads, and the graph of 1000 submaps solved without a pause. Before and after, beside
the burners, the C program (`_timerloop.c`) waits for the same timer at the same priority.

With ``--beside browsers`` twenty browsers watch `lumiloop view`, with ``--beside hanging`` eight connections want every
topic of the stream, read nothing, and are killed. Then there are no burners, and stretches come in pairs, *alone* and
*loaded*, every other pair the other way round (A B B A): what grows evenly cancels. The first second after a change
counts for neither.

``make bench ARGS=latency`` takes 90 s with SCHED_FIFO and as many without; for figures that are statistically firm
``python -m tools.bench.system.latency --turns 30`` (16 minutes each).
"""

import argparse
import json
import os
import pickle
import shutil
import signal
import socket
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np

from daemon.devices.light_setup import Lights
from daemon.runtime.warmup import load
from daemon.system.realtime import PRIORITY
from estimator.cdma.air_interface import PROFILE_A
from tools.bench.support.beside import BROWSERS, KINDS, Beside, Readers
from tools.bench.support.children import CannotRun, child, ended, finished, lines
from tools.bench.support.drive import PERIOD_S, EndlessDrive
from tools.bench.support.paced import SETTLE_S
from tools.ci.figures import Figure, bounded, save, table
from tools.sim.ports import free_port

COMMAND: Final = "python -m tools.bench.system.latency"
STRETCH_S: Final = 10.0
BARE_S: Final = 10.0
BURNERS: Final = 2
COMPILE_S: Final = 60.0
CHANGE_S: Final = 1.0
LEAST_HZ: Final = 15.0
"""Messages a second to each browser; with fewer, nothing was watched that would cost anything (a page has 25)."""
LATE_S: Final = 60.0
"""By so much a bare loop may be later than its turns take."""
DAEMON: Final = (sys.executable, "-m", "tools.bench.support.paced")


def compiled(folder: Path) -> Path:
    """The C program.

    Raises:
        CannotRun: no compiler, or none that works.
    """
    compiler, program = shutil.which("cc") or shutil.which("gcc"), folder / "timerloop"
    if compiler is None:
        raise CannotRun("no C compiler: apt-get install gcc")
    words = [compiler, "-O2", "-o", str(program), str(Path(__file__).parents[1] / "support" / "timerloop.c")]
    done = finished(words, f"{compiler} _timerloop.c", COMPILE_S)
    if done.returncode:
        raise CannotRun(f"{compiler} _timerloop.c: {done.stderr.strip()}")
    return program


def bare(program: Path, fifo: bool, seconds: float = BARE_S) -> list[float]:
    """Microseconds by which each turn of the C program was late."""
    count, priority = round(seconds / PERIOD_S), PRIORITY if fifo else 0
    words = [str(program), "wait", str(round(1e6 * PERIOD_S)), str(count), str(priority)]
    done = finished(words, "the loop in C", seconds + LATE_S)
    if done.returncode:
        raise CannotRun(f"the loop in C: {done.stderr.strip()}; SCHED_FIFO needs root or CAP_SYS_NICE")
    return [float(line) for line in done.stdout.split()]


@contextmanager
def burning(program: Path) -> Iterator[Callable[[bool], None]]:
    """Both cores busy, or not for a while: what is yielded is called with which of the two."""
    with ExitStack() as undo:
        burners = [undo.enter_context(child(str(program), "burn")) for _ in range(BURNERS)]

        def turn(on: bool) -> None:
            for burner in burners:
                burner.send_signal(signal.SIGCONT if on else signal.SIGSTOP)

        yield turn


def prepared(folder: Path, seconds: float) -> Path:
    """What the sensors deliver in so many seconds, in a file."""
    drive, path = EndlessDrive(), folder / "drive"
    deliveries = [next(drive) for _ in range(round(seconds / PERIOD_S))]
    with path.open("wb") as file:
        pickle.dump((drive.geometry, drive.survey, drive.scene.mount, deliveries), file)
    return path


def paced(
    folder: Path, wanted: dict[str, Any], make: Callable[[str, int], Beside], burn: Callable[[bool], None]
) -> dict[str, Any]:
    """One run of the daemon: its outcome, with the counts of what is ``make``-d of its stream and its Modbus port."""
    stream, modbus = str(folder / "stream"), free_port()
    with ExitStack() as undo:
        sink = undo.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        sink.bind(("127.0.0.1", 0))
        ends = {"stream": stream, "modbus": modbus, "receiver": f"127.0.0.1:{sink.getsockname()[1]}"}
        words = json.dumps(wanted | ends | {"stretch_s": STRETCH_S})
        beside = make(stream, modbus)
        undo.callback(beside.kill)
        daemon = undo.enter_context(child(*DAEMON, words, ask=True, hear=True))
        assert daemon.stdin is not None
        counts, on = (0, 0), False
        for line in map(str.strip, lines(daemon, "the daemon")):
            if line.startswith("told "):
                if ended(daemon, "the daemon"):
                    break
                outcome: dict[str, Any] = json.loads(line[5:])
                return outcome | {"counts": counts}
            if line == "ended":  # it still serves: what is asked until now is answered
                counts = beside.end()
                daemon.stdin.close()
                continue
            if (line == "loaded") != on:
                on = not on
                beside.turn(on)
            burn(line != "quiet")
    raise CannotRun("the daemon ended before its time; its log says why")


def measure(turns: int, fifos: tuple[bool, ...] = (True, False)) -> dict[str, dict[str, Any]]:
    """Both runs beside readers, by name."""
    load(Lights(EndlessDrive().survey, PROFILE_A))
    found = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        program, drive = compiled(folder), prepared(folder, SETTLE_S + 3 * turns * STRETCH_S)
        for fifo in fifos:
            with burning(program) as burn:
                before = bare(program, fifo)
                wanted = {"drive": str(drive), "fifo": fifo, "turns": turns, "quiet": True}
                told = paced(folder, wanted, Readers, burn)
                told["asked"], told["answered"] = told["counts"]
                told["bare"] = before + bare(program, fifo)
            found["SCHED_FIFO" if fifo else "ordinary"] = told
    return found


def in_pairs(kind: str, turns: int) -> list[Figure]:
    """What browsers, or taps that hang, change: stretches in pairs, every other pair the other way round."""
    load(Lights(EndlessDrive().survey, PROFILE_A))
    command = f"{COMMAND} --beside {kind}"
    with tempfile.TemporaryDirectory() as name:
        drive = prepared(Path(name), SETTLE_S + 2 * turns * STRETCH_S)
        wanted = {"drive": str(drive), "fifo": os.geteuid() == 0, "turns": turns, "solve": False, "change_s": CHANGE_S}
        told = paced(Path(name), wanted, KINDS[kind], lambda on: None)
    rows = compared(told, kind, command)
    if kind == "browsers":
        each_s = turns * STRETCH_S * BROWSERS
        messages, size = told["counts"]
        rows.append(Figure("kB a second to each browser", 1e-3 * size / each_s, "", command=command))
        name = "messages a second to each browser"
        rows.append(bounded(name, messages / each_s, "", f">= {LEAST_HZ:g}", command))
    return rows


def compared(told: dict[str, Any], other: str, command: str) -> list[Figure]:
    """What is later, and what takes longer, in the stretches that are ``other``."""
    rows = []
    for what in ("late", "cycle"):
        alone, loaded = (1e-3 * np.array(told[what][stretch]) for stretch in ("alone", "loaded"))
        words = {"late": "cycles begin late", "cycle": "a cycle takes"}[what]
        for q in (50.0, 99.0):
            rows.append(Figure(f"{words}, p{q:g}, alone", float(np.percentile(alone, q)), "ms", command=command))
            rows.append(Figure(f"{words}, p{q:g}, {other}", float(np.percentile(loaded, q)), "ms", command=command))
        more = float(np.percentile(loaded, 99) - np.percentile(alone, 99))
        rows.append(bounded(f"{words}, p99, {other} over alone", more, "ms", "<= 0.5", command))
        pairs = by_pair(told, what)
        name = f"{words}, p99, {other} over alone, of {len(pairs)} pairs"
        rows.append(bounded(f"{name}, median", float(np.median(pairs)), "ms", "<= 0.5", command))
        for q, end in ((25.0, "lower quarter"), (75.0, "upper quarter")):
            rows.append(Figure(f"{name}, {end}", float(np.percentile(pairs, q)), "ms", command=command))
    counted = float(sum(len(stretch) for stretch in told["late"].values()))
    rows.append(Figure(f"cycles, alone and {other}", counted, "", command=command))
    rows.append(Figure("scans missed", float(told["missed"]), "", command=command))
    return rows


def by_pair(told: dict[str, Any], what: str) -> list[float]:
    """What p99 is higher by, loaded, in each pair of stretches, ms."""
    found = []
    for number in sorted(set(told["pair"]["alone"]) & set(told["pair"]["loaded"])):
        alone, loaded = (
            np.percentile(1e-3 * np.array(told[what][stretch])[np.array(told["pair"][stretch]) == number], 99)
            for stretch in ("alone", "loaded")
        )
        found.append(float(loaded - alone))
    return found


def figures(found: dict[str, dict[str, Any]]) -> list[Figure]:
    """All rows."""
    rows = []
    for name, told in found.items():
        bound = name == "SCHED_FIFO"
        late = {what: 1e-3 * np.array(told["late"][what]) for what in told["late"]}
        every = np.concatenate([late["alone"], late["loaded"]])
        bare_ms = 1e-3 * np.array(told["bare"])
        bare_worst = float(np.percentile(bare_ms, 99.9))
        rows += _late(f"{name}: bare C loop", bare_ms)
        rows += _late(f"{name}: cycles, quiet", late["quiet"])
        rows += _late(f"{name}: cycles, alone", late["alone"], 1.5 if bound else None)
        rows += _late(f"{name}: cycles, loaded", late["loaded"])
        worst = float(np.percentile(every, 99.9)) - bare_worst
        more = float(np.percentile(late["loaded"], 99) - np.percentile(late["alone"], 99))
        share = 100.0 * told["missed"] / told["scans"]
        limits = (("<= 1", worst), ("<= 1", more), ("<= 0.01", share))
        names = ("p99.9 of all cycles over the bare loop's", "p99, loaded over alone", "scans missed")
        for what, (limit, value), unit in zip(names, limits, ("ms", "ms", "%"), strict=True):
            full = f"{name}: {what}"
            rows.append(
                bounded(full, value, unit, limit, COMMAND) if bound else Figure(full, value, unit, command=COMMAND)
            )
        rows += _costs(name, told)
    return rows


def _late(name: str, ms: np.ndarray[Any, Any], bound: float | None = None) -> list[Figure]:
    rows = [Figure(f"{name}: turns", float(len(ms)), "", command=COMMAND)]
    for q in (50.0, 99.0, 99.9, 100.0):
        value, what = float(np.percentile(ms, q)), f"{name}: late, p{q:g}"
        if q == 99.0 and bound is not None:
            rows.append(bounded(what, value, "ms", f"<= {bound:g}", COMMAND))
        else:
            rows.append(Figure(what, value, "ms", command=COMMAND))
    return rows


def _costs(name: str, told: dict[str, Any]) -> list[Figure]:
    rows = []
    for what in ("quiet", "alone", "loaded"):
        cycle = 1e-3 * np.array(told["cycle"][what])
        rows += [
            Figure(f"{name}: a cycle, {what}, median", float(np.median(cycle)), "ms", command=COMMAND),
            Figure(f"{name}: a cycle, {what}, p99.9", float(np.percentile(cycle, 99.9)), "ms", command=COMMAND),
        ]
    for what in ("quiet", "alone", "loaded"):
        full, share = f"{name}: all threads, share of one core, {what}", 100.0 * float(np.mean(told["share"][what]))
        rows.append(
            bounded(full, share, "%", "<= 15", COMMAND)
            if what == "quiet"
            else Figure(full, share, "%", command=COMMAND)
        )
    return [
        *rows,
        Figure(f"{name}: graphs solved", float(told["solved"]), "", command=COMMAND),
        Figure(f"{name}: Modbus requests unanswered", float(told["asked"] - told["answered"]), "", command=COMMAND),
        Figure(f"{name}: stalls", float(told["stalls"]), "", command=COMMAND),
    ]


def run(turns: int = 2, beside: str = "readers") -> list[Figure]:
    """Some 60 s of cycles with SCHED_FIFO, where it may be had, and as many without."""
    if beside != "readers":
        return in_pairs(beside, turns)
    fifos = (True, False) if os.geteuid() == 0 else (False,)
    return figures(measure(turns, fifos))


def main() -> None:
    """The command by itself, for figures that are firm."""
    parser = argparse.ArgumentParser(prog=COMMAND)
    parser.add_argument("--beside", choices=sorted(KINDS), default="readers", help="clients of every other stretch")
    parser.add_argument("--turns", type=int, default=30, help="times 10 s alone and 10 s loaded")
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    options = parser.parse_args()
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # daemon, readers and burners must not outlive this one
    try:
        rows = run(options.turns, options.beside)
    except CannotRun as reason:
        sys.exit(f"latency could not run: {reason}")
    print(table(rows))
    name = "latency" if options.beside == "readers" else f"latency-{options.beside}"
    print(f"written: {save(name, rows, options.out)}")


if __name__ == "__main__":
    main()
