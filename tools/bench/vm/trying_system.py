"""Scenarios: the system comes up with the service in it, and others see its pose."""

import json
import re
import statistics
import time
from typing import Final

from tools.bench.report.plots import Plot, Series, histogram
from tools.bench.report.result import Figure, Seen
from tools.bench.vm.bench import CONFIG, DONE, PLACED, SAVE_MAP, UNIT, Bench, Heard
from tools.bench.vm.common import (
    BUDGET,
    TRACKING_S,
    Unmet,
    begin,
    come_up,
    errors,
    map_id,
    need,
    right,
    scenario,
    start,
)
from tools.bench.vm.machine import Order
from tools.bench.world.room import LIDAR
from tools.sim.robot.truth import in_map

DRIVE_S: Final = 30.0
FIFO: Final = 1
MARKS: Final = "/var/cache/private/lumiloop/kernels-*/warm-*"
"""They say that an earlier start has compiled the kernels."""
ASKED: Final = 50
LOST_UDP: Final = 1
"""A datagram that nobody repeats may be lost in the emulated network, and its loss is no fault of the daemon; what is
sent over TCP may not."""
MOST: Final = 0.9
"""Of the scans: at the ends of the time that is listened, one more or less may fall into it. So much of a drive is
TRACKING, too."""


# the system as it comes up


@scenario()
def boots(bench: Bench) -> str:
    """Debian boots with the package installed, and no unit has failed."""
    return f"{come_up(bench)}; kernel {bench.machine.run('uname', '-r').strip()}"


@scenario()
def names_the_lidar(bench: Bench) -> str:
    """Udev gives the lidar its name and its group, and keeps ModemManager away."""
    link = bench.machine.run("readlink", "-f", "/dev/lumiloop/lidar").strip()
    group = bench.machine.run("stat", "-c", "%G %a", link).strip()
    told = bench.machine.run("udevadm", "info", "--query=property", "--name", link)
    need(link == "/dev/ttyACM0" and group == "dialout 660", f"{link}: {group}")
    need("ID_MM_DEVICE_IGNORE=1" in told, told)
    need("lumiloop/lidar-H0000001" in told, told)
    return f"/dev/lumiloop/lidar is {link}, {group}"


@scenario()
def probes(bench: Bench) -> str:
    """`lumiloop probe` finds the lidar before anything is configured."""
    said = bench.machine.run("lumiloop", "probe", check=False, seconds=120)
    found = next((line.strip() for line in said.splitlines() if "serial H0000001" in line), "")
    need(found and "/dev/i2c-1: bench" in said, said)
    return found


@scenario("anew")
def starts(bench: Bench) -> str:
    """`systemctl enable --now lumiloop`: warmed up and READY; `lumiloop check` finds nothing wrong."""
    bench.machine.run("sh", "-c", f"rm {MARKS}")
    seconds = start(bench, BUDGET)
    bench.machine.run("lumiloop", "check", CONFIG)
    warm = bench.machine.run("journalctl", "-q", "--no-pager", "-o", "cat", "-u", "lumiloop-warmup.service")
    told = re.search(r"kernels compiled in [\d.]+ s", warm)
    need(told, f"it was not warmed up: {warm}")
    return f"READY after {seconds:.1f} s, the warm-up before it included: {told.group() if told else ''}"


@scenario()
def is_restricted(bench: Bench) -> str:
    """It runs as nobody in particular, without any capability, in its two groups, with its system calls filtered."""
    status = bench.machine.run("cat", f"/proc/{bench.main_pid()}/status")
    fields = dict(line.split(":\t", 1) for line in status.splitlines() if ":\t" in line)
    need(61184 <= int(fields["Uid"].split()[0]) <= 65519, fields["Uid"])
    need(int(fields["CapEff"], 16) == 0 and fields["Seccomp"].strip() == "2", f"{fields['CapEff']} {fields['Seccomp']}")
    groups = bench.machine.run("getent", "group", "dialout", "i2c")
    need({line.split(":")[2] for line in groups.splitlines()} <= set(fields["Groups"].split()), fields["Groups"])
    exposure = bench.machine.run("systemd-analyze", "security", "--no-pager", UNIT)
    level = re.search(r"exposure level for \S+: ([\d.]+)", exposure)
    need(level and float(level.group(1)) <= 2.0, exposure[-200:])
    return f"user {fields['Uid'].split()[0]}, exposure {level.group(1) if level else '?'}"


@scenario()
def takes_real_time(bench: Bench) -> str:
    """The loop's thread has SCHED_FIFO and memory is locked, as the unit's limits allow."""
    pid = bench.main_pid()
    bench.until("SCHED_FIFO", 30.0, lambda: _policy(bench, pid) == FIFO)
    status = bench.machine.run("cat", f"/proc/{pid}/status")
    locked = int(next(line.split()[1] for line in status.splitlines() if line.startswith("VmLck")))
    threads = bench.machine.run("sh", "-c", f"cat /proc/{pid}/task/*/stat")
    fifo = sum(int(line.rsplit(")", 1)[1].split()[38]) == FIFO for line in threads.splitlines())
    need(locked > 0, "no memory is locked")
    kept = int(next(line.split()[1] for line in status.splitlines() if line.startswith("VmRSS")))
    return f"{fifo} of {len(threads.splitlines())} threads under SCHED_FIFO, memory locked, {kept // 1024} MB resident"


def _policy(bench: Bench, pid: int) -> int:
    return int(bench.machine.run("cat", f"/proc/{pid}/task/{pid}/stat").rsplit(")", 1)[1].split()[38])


# the pose, from outside


@scenario()
def answers_modbus(bench: Bench) -> Seen:
    """The same block over Modbus UDP and TCP, from another computer, whenever it is asked; a datagram may be lost."""
    bench.placed(TRACKING_S, PLACED)
    udp, tcp = bench.read(), bench.read(tcp=True)
    need(udp and tcp, f"UDP {udp}, TCP {tcp}")
    need(tcp["seq"] >= udp["seq"], f"UDP {udp['seq']}, TCP {tcp['seq']}")
    figures: list[Figure] = []
    for name, over_tcp, may_be_lost in (("UDP", False, LOST_UDP), ("TCP", True, 0)):
        begun = time.monotonic()
        answered = sum(bool(bench.read(over_tcp, tries=1)) for _ in range(ASKED))
        each = 1e3 * (time.monotonic() - begun) / ASKED
        figures.append(
            Figure(f"{name}: answered", 100.0 * answered / ASKED, "%", "less", 0.0, 100.0 * may_be_lost / ASKED)
        )
        figures.append(Figure(f"{name}: a read takes", each, "ms"))
        if answered < ASKED - may_be_lost:
            said = f"{answered} of {ASKED} reads over {name} answered at once, where {may_be_lost} may be lost"
            raise Unmet(said, Seen(said, tuple(figures)))
    return Seen(f"asked {ASKED} times over each", tuple(figures))


@scenario()
def sends_datagrams(bench: Bench) -> str:
    """Pose datagrams arrive at another computer, one for each scan."""
    waited = bench.machine.waited_s()
    heard = bench.collect(5.0)
    rate, own = len(heard) / 5.0, 5.0 - (bench.machine.waited_s() - waited)
    scans = int(own / LIDAR.true_period_s)
    need(len(heard) >= MOST * scans, f"{len(heard)} datagrams of {scans} scans in {own:.1f} s of its own")
    delay = statistics.median(one.t_came - one.t_pose for one in heard)
    return f"{rate:.1f} a second; the pose is {1e3 * delay:.0f} ms old when it is sent (median)"


@scenario()
def begins_where_it_stands(bench: Bench) -> str:
    """A robot that stands still at its first start is where the map begins."""
    return f"{1e3 * begin(bench):.0f} mm at most"


@scenario()
def drives(bench: Bench) -> Seen:
    """Half a minute at 0.4 m/s: TRACKING, never further from the truth than 10 cm and three of its own sigma."""
    bench.drive()
    bench.until("the robot sets off", 30.0, lambda: abs(_true_speed(bench)) > 0.1)
    heard = bench.collect(DRIVE_S)
    found = errors(bench, heard)
    need(found, "no pose has come")
    _keep(bench, heard)
    tracked = sum(one.state == 3 for one in heard) / len(heard)
    middle = statistics.median(found)
    ages = [1e3 * (one.t_came - one.t_pose) for one in heard]
    figures = (
        Figure("error, median", 1e3 * middle, "mm", "more", 0.5, 5.0),
        Figure("error, largest", 1e3 * max(found), "mm", "more", 0.5, 10.0),
        Figure("TRACKING", 100.0 * tracked, "%", "less", 0.1),
        Figure("age of a pose that comes, median", statistics.median(ages), "ms", "more", 0.5, 20.0),
    )
    plots = (_way(bench, heard), histogram("age of a pose that comes", "ms", ages))
    seen = Seen(f"{len(heard)} poses", figures, plots)
    try:
        right(bench, heard)
        need(tracked >= MOST, f"TRACKING for {100.0 * tracked:.0f} % of {len(heard)} poses; {_trouble(heard)}")
        bench.placed(TRACKING_S)
    except Order as error:
        raise Unmet(f"{error}", seen) from error
    return seen


def _keep(bench: Bench, heard: list[Heard]) -> None:
    """For who wants to look into one pose: all of the drive, and the truth meanwhile; goes with the results."""
    poses = [(one.t_came, one.t_pose, one.pose, one.missed, one.overruns, one.fault) for one in heard]
    truth = [(t, pose) for t, pose in list(bench.ears.truth) if t >= heard[0].t_pose - 1.0]
    head = (
        "poses: came, true at, (x, y, yaw), missed scans, cycles over budget, fault; truth: at, (x, y, yaw); s, m, rad"
    )
    (bench.folder / "drive").write_text(json.dumps({"what": head, "poses": poses, "truth": truth}))


def _work_left(first: Heard, one: Heard) -> tuple[int, int]:
    """Scans missed and cycles over their budget, since the first."""
    return one.missed - first.missed, one.overruns - first.overruns


def _trouble(drive: list[Heard]) -> str:
    """What the emulated processor left undone meanwhile."""
    missed, over = _work_left(drive[0], drive[-1])
    faults = sorted({one.fault for one in drive} - {0})
    return f"meanwhile {missed} scans missed, {over} cycles over their budget, faults {faults or 'none'}"


@scenario()
def saves_its_map(bench: Bench) -> str:
    """Command SAVE_MAP over Modbus."""
    bench.placed(TRACKING_S)
    need(bench.command(SAVE_MAP) == DONE, lambda: bench.log(10))
    need(map_id(bench) == bench.memory["map"], f"map {map_id(bench):08x}, it was {bench.memory['map']:08x}")
    return bench.machine.run("sh", "-c", "ls /var/lib/lumiloop/maps").replace("\n", " ")


def _way(bench: Bench, heard: list[Heard]) -> Plot:
    if bench.start is None:
        raise Order("where it began is not known")
    begun = heard[0].t_pose if heard else 0.0
    true = [in_map(pose, bench.start, (0.0, 0.0, 0.0)) for t, pose in list(bench.ears.truth) if t >= begun]
    said = [one.pose for one in heard if one.pose is not None]
    lines = (("truth", true), ("published", said))
    series = tuple(Series(name, [x for x, _, _ in line], [y for _, y, _ in line]) for name, line in lines)
    return Plot("trajectory", "x m", "y m", series, square=True)


def _true_speed(bench: Bench) -> float:
    told = list(bench.ears.truth)[-30:]
    (t0, a), (t1, b) = told[0], told[-1]
    return ((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2) ** 0.5 / max(t1 - t0, 1e-3)
