"""What scenarios share: how they are told apart from other functions, and what several of them do and ask."""

import math
import struct
import time
from collections.abc import Callable, Iterable
from typing import Final, Literal

from tools.bench.report.result import Seen
from tools.bench.vm.bench import PLACED, UNIT, Bench, Heard
from tools.bench.vm.machine import Machine, Order, all_well

Scenario = Callable[[Bench], str | Seen]
WRITTEN: Final[list[Scenario]] = []
"""All scenarios, module by module in the order of their lines."""
Daemon = Literal["same", "anew", "restarted", "gone"]
AFTER: Final[dict[Scenario, Daemon]] = {}
"""What the daemon is after each: the same process as before; one that a person or the computer's start has started,
and which has lived since; one that the service manager has restarted once; none."""
TRACKING_S: Final = 60.0
WORST_M: Final = 0.10
RESTING_M: Final = 0.05
RIGHT_S: Final = 2.0
"""Ten poses; a robot that drives goes 0.8 m meanwhile."""
READY_S: Final = 60.0
PACE: Final = "i=0; while [ $i -lt 10000 ]; do i=$((i+1)); done"
PACES: Final = 3
"""A single one was 1.2 to 3.1 times the usual on one machine: it is a moment of a busy one."""
USUAL_S: Final = 0.2
"""What `pace` tells of a usual machine. Measured: 0.33 s on one that boots in 24 s; usual ones boot in 15, so this is
reckoned from that (docs/bench.md)."""


BUDGET: Final = "[cycle]\nbudget_ms = 150.0"
"""Of a scan period of 200 ms: with the usual half of it a loaded computer would leave work undone."""


def scenario(daemon: Daemon = "same") -> Callable[[Scenario], Scenario]:
    """A decorator: it is one of the list, and leaves the daemon so."""

    def kept(function: Scenario) -> Scenario:
        WRITTEN.append(function)
        AFTER[function] = daemon
        return function

    return kept


def unnoticed(bench: Bench, wanted: Daemon) -> str:
    """What has become of the daemon's process that nobody had in mind; empty text: nothing. What it is now is kept."""
    before, now = bench.life, bench.lives()
    bench.life = now
    as_wanted = {
        "same": now == before,
        "anew": now[0] != 0 and now[1] == 0,
        "restarted": now[0] not in (0, before[0]) and now[1] == before[1] + 1,
        "gone": now[0] == 0,
    }[wanted]
    if as_wanted:
        return ""
    told = " has become ".join(f"process {pid} with {count} restarts" for pid, count in (before, now))
    return f"the daemon has died unnoticed: {told} ({wanted} was expected)\n{bench.log(20)}"


class Unmet(Order):
    """What was seen is not what it should be; it is reported with its figures and plots all the same."""

    def __init__(self, text: str, seen: Seen) -> None:
        super().__init__(text)
        self.seen = seen


def need(holds: object, text: str | Callable[[], str]) -> None:
    """Raise `Order` with the text unless it holds; what it takes time to ask for is asked for then."""
    if not holds:
        raise Order(text if isinstance(text, str) else text())


def errors(bench: Bench, heard: Iterable[Heard]) -> list[float]:
    """Metres from the truth, of those that claim a place."""
    found = [bench.error_m(one) for one in heard]
    return [error for error in found if error is not None]


def right(bench: Bench, heard: Iterable[Heard], bound: float = WORST_M) -> list[float]:
    """As :func:`errors`; raises `Order` where one is beyond the bound and three of its own sigma, or there is none."""
    kept = [(error, one.sigma_m) for one in heard if (error := bench.error_m(one)) is not None]
    need(kept, "no pose has come")
    worst = max(kept, key=lambda pair: pair[0] - 3.0 * pair[1])
    need(worst[0] <= bound + 3.0 * worst[1], f"{worst[0]:.3f} m from the truth, sigma said {worst[1]:.3f} m")
    return [error for error, _ in kept]


def map_id(bench: Bench) -> int:
    """Identity of the map frame."""
    return int(struct.unpack(">I", bench.registers(46, 2))[0])


def has_photodiode(bench: Bench) -> bool:
    """Whether the daemon has one in its configuration: then its count of links is a number."""
    return bool(struct.unpack(">H", bench.registers(53, 1))[0] != 0xFFFF)


def pace(machine: Machine) -> float:
    """Seconds that `PACE` takes: of the emulation's processor time, with the time it had to wait for a processor.

    The least of some: what else the computer has to do only adds to it.
    """
    least = math.inf
    for _ in range(PACES):
        worked, waited = machine.worked_s(), machine.waited_s()
        machine.run("sh", "-c", PACE)
        least = min(least, (machine.worked_s() or 0.0) - (worked or 0.0) + machine.waited_s() - waited)
    return least


def come_up(bench: Bench) -> str:
    """Go on with the system inside as it came up when its image was made; raises `Order` if a unit has failed."""
    seconds = bench.machine.go_on()
    all_well(bench.machine)
    bench.slower = pace(bench.machine) / USUAL_S
    return (
        f"up {bench.booted_s:.0f} s after it was switched on, when the image was made; going on after {seconds:.1f} s; "
        f"a fixed piece of work takes it {bench.slower:.1f} times as long as is reckoned with"
    )


def start(bench: Bench, *tables: str) -> float:
    """Configure the daemon and start it for the first time; s until READY."""
    bench.configure(*tables)
    bench.ears.poses.clear()
    begun = time.monotonic()
    bench.machine.run("systemctl", "enable", "--now", UNIT, seconds=300)
    seconds = time.monotonic() - begun
    need(bench.machine.show(UNIT, "ActiveState")["ActiveState"] == "active", lambda: bench.log(30))
    return seconds


def begin(bench: Bench) -> float:
    """The robot has stood still since: its map begins where it stands. The largest error, m."""
    bench.placed(TRACKING_S, PLACED)
    true = bench.ears.true_pose(time.monotonic() - 0.5)
    need(true is not None, "the world does not tell where the robot is")
    bench.start = true
    worst = max(right(bench, bench.collect(2.0), RESTING_M))
    bench.memory["map"] = map_id(bench)
    return worst


def same_process(bench: Bench, pid: int) -> None:
    """Raise `Order` if it has been started anew."""
    now = bench.main_pid()
    need(now == pid, lambda: f"process {pid} has become {now}:\n{bench.log(20)}")


def back(bench: Bench, pid: int, states: tuple[str, ...] = ("TRACKING",)) -> str:
    """Usable again without a person, the same process, and right."""
    seconds = bench.placed(TRACKING_S, states)
    same_process(bench, pid)
    found = right(bench, bench.collect(RIGHT_S))
    return f"{' or '.join(states)} after {seconds:.1f} s, {1e3 * max(found):.0f} mm from the truth"


def signal(bench: Bench, name: str, pid: int) -> None:
    """Send one to a process inside."""
    bench.machine.run("sh", "-c", f"kill -{name} {pid}")  # the shell's own: a small Debian has no /bin/kill


def restarted(bench: Bench, before: int, seconds: float) -> str:
    """``before`` has been replaced within so long, without a person; the new process is right, in the same map."""
    begun = time.monotonic()
    bench.until("another process", seconds, lambda: bench.main_pid() not in (0, before), every=1.0)
    bench.until("started", READY_S, lambda: bench.read().get("state") not in (None, "STARTING"))  # costs it little
    bench.until("READY", READY_S, lambda: bench.machine.show(UNIT, "ActiveState")["ActiveState"] == "active")
    ready = time.monotonic() - begun
    tracking = bench.placed(TRACKING_S)
    need(map_id(bench) == bench.memory["map"], f"map {map_id(bench):08x}, it was {bench.memory['map']:08x}")
    found = right(bench, bench.collect(RIGHT_S))
    told = f"READY {ready:.1f} s later, TRACKING in the same map {tracking:.1f} s after that"
    return f"{told}, {1e3 * max(found):.0f} mm from the truth"
