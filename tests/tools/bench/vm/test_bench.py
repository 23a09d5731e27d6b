"""The virtual bench, but for the computer it emulates: needs, wires, report; and all of it, slowly."""

from __future__ import annotations

import json
import lzma
import math
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daemon.health.faults import Fault
from daemon.publish.modbus import parts_block, registers
from daemon.snapshot import NO_CONDITION
from tools.bench.support import children
from tools.bench.support.other_clock import OtherClock
from tools.bench.system.modbus import example
from tools.bench.vm import __main__ as command
from tools.bench.vm import bench, image, places, reference, trying_system, whole, world
from tools.bench.vm.__main__ import chosen
from tools.bench.vm.common import ALONE
from tools.bench.vm.guest import agent
from tools.bench.vm.machine import Machine, Order, Ports, _waited_s
from tools.bench.vm.scenarios import PARTS, SCENARIOS, SHARES, WRITTEN
from tools.bench.world import agreement
from tools.bench.world.room import room
from tools.sim.harness import run
from tools.sim.robot.truth import in_map
from tools.sim.scene import SimulatedScene

ROOT = Path(__file__).parents[4]


def test_every_scenario_is_in_the_list_once_and_has_a_title() -> None:
    assert len(SCENARIOS) == len(set(SCENARIOS)) == len(WRITTEN)
    assert len(SCENARIOS) >= 25
    assert {trying_system.drives} == ALONE
    assert all(one.__doc__ and len(one.__doc__.splitlines()) == 1 for one in SCENARIOS)
    names = [[part.__name__.rpartition("_")[2] for part in parts] for parts in PARTS]
    assert names == [["system", "devices", "surroundings"], ["photodiode", "process"], ["computer"]]


def test_scenarios_up_to_the_named_ones_and_only_the_computers_that_they_take() -> None:
    assert chosen([]) == SHARES
    assert [[one.__name__ for one in share] for share in chosen(["boots"])] == [["boots"], [], []]
    assert [share[-1].__name__ for share in chosen(["hangs", "boots", "starts"]) if share] == ["starts", "hangs"]
    assert [len(share) > 0 for share in chosen(["drives", "is_rebooted"])] == [True, False, True], "a number stays"
    with pytest.raises(places.CannotBench, match="no such scenario: flies; there are boots"):
        chosen(["flies"])


def test_what_is_missing_is_said_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places.shutil, "which", lambda tool, path: None if tool.startswith("qemu") else "/usr/bin/it")
    assert places.missing() == "missing programs: apt-get install --no-install-recommends qemu-system-x86 qemu-utils"
    monkeypatch.setattr(places.shutil, "which", lambda tool, path: "/usr/bin/it")
    monkeypatch.setattr(places.os, "geteuid", lambda: 1000)
    assert "run it once as root" in places.missing()
    assert places.missing(build=False) == ""


def test_a_machine_without_qemu_is_told_so_and_nothing_is_left(tmp_path: Path) -> None:
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "PATH": str(tmp_path)}
    command = [sys.executable, "-m", "tools.bench.vm", "--out", str(tmp_path / "out")]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 2
    assert "missing programs: apt-get install" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_what_may_not_be_read_or_written_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["vm", "--out", "/dev/null/out"])
    assert command.main() == 2
    assert "nothing can be written to /dev/null/out; name another folder with --out" in capsys.readouterr().out

    def closed(say: object) -> None:
        raise PermissionError(13, "Permission denied", "/root/.cache/lumiloop/vm")

    monkeypatch.setattr("sys.argv", ["vm", "--out", str(tmp_path)])
    monkeypatch.setattr(command, "image", closed)
    assert command.main() == 2
    assert "/root/.cache/lumiloop/vm: Permission denied; what is kept there is of" in capsys.readouterr().out


def test_a_folder_left_by_a_killed_process_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places, "MEMORY", tmp_path)
    left, running = tmp_path / "some-999999999", tmp_path / f"some-{os.getppid()}"
    others = tmp_path / f"some-image-{os.getppid()}"  # of another name, which begins with this one
    for one in (left, running, others, tmp_path / f"some-{os.getpid()}"):  # numbers of processes come again
        one.mkdir()
    with places.workspace("some", 1000) as folder:
        assert folder == tmp_path / f"some-{os.getpid()}"
        (folder / "file").touch()
    assert set(tmp_path.iterdir()) == {running, others}


def test_what_the_bench_starts_ends_with_it_however_it_ends() -> None:
    """QEMU and the world, when the bench is killed."""
    words = [*children.LEASH, "sleep", "60"]
    code = f"import subprocess, time; print(subprocess.Popen({words}).pid, flush=True); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        child = Path("/proc", parent.stdout.readline().strip())
        end = time.monotonic() + 10.0
        while child.joinpath("comm").read_text() != "sleep\n":
            assert time.monotonic() < end
        parent.kill()
    while child.exists() and "Z" not in child.joinpath("stat").read_text().rpartition(")")[2]:
        assert time.monotonic() < end, "it goes on"
        time.sleep(0.02)


def test_the_image_depends_on_what_is_in_it_and_on_nothing_else() -> None:
    key = image.digest(ROOT / "systemd")
    assert key == image.digest(ROOT / "systemd")
    assert key != image.digest(ROOT / "systemd", ROOT / "pyproject.toml")
    assert key != image.digest(ROOT / "systemd", extra="another recipe")


def test_an_image_that_is_not_whole_is_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(image, "missing", lambda build: "" if not build else "it would be made anew")
    half = image.Image(image.cache() / f"image-{image.image_key()}")
    half.folder.mkdir(parents=True)
    half.kernel.write_bytes(b"x")
    half.disk.touch()
    left = (image.cache() / "part-999999999", image.cache() / "part-999999999.tar")
    left[0].mkdir()
    left[1].touch()
    said: list[str] = []
    with pytest.raises(places.CannotBench, match="it would be made anew"), image.image(said.append):
        pass
    assert "no disk, no initrd" in said[-1]
    assert [path.name for path in image.cache().iterdir()] == []
    half.folder.mkdir()
    for path in (half.disk, half.kernel, half.initrd):
        path.write_bytes(b"x")
    whole.note(half.folder, half.parts)
    with image.image(said.append) as made:
        assert made == half


def test_the_kernel_is_taken_out_of_its_boot_image() -> None:
    elf = b"\x7fELF" + bytes(range(256)) * 40
    boot_image = b"\x1f\x8b\x08 setup" + lzma.compress(elf, check=lzma.CHECK_CRC32) + b"appended"
    assert image.unpacked(boot_image) == elf
    for wrong in (b"no kernel", lzma.compress(b"no ELF"), boot_image[:60]):
        with pytest.raises(places.CannotBench, match="holds no kernel"):
            image.unpacked(wrong)


def test_what_was_published_inside_is_compared_with_outside() -> None:
    """The scenario's own arithmetic: a drive in virtual time against itself as the bench would hear it."""
    seconds = 24.0
    scene = SimulatedScene(world.scenario(), room())
    made = run(seconds, scene=scene)
    outside = agreement.reference_of(SimulatedScene(world.scenario(), room()), seconds)
    fine = np.arange(made.t_mono[0], made.t_mono[-1], 0.01)
    inside = agreement.trace_of(made.t_mono, made.pose, fine, scene.truth(fine))
    assert agreement.differences(inside, outside)[1].max() < 2e-3
    off = agreement.trace_of(made.t_mono, made.pose + np.array((0.02, 0.0, 0.0)), fine, scene.truth(fine))
    assert agreement.differences(off, outside)[1].max() > 0.015

    true_late = np.where(made.t_mono < made.t_mono[0] + 10.0, 0.004, 0.012)  # others have begun to use the processor

    def traced(part: slice, by: np.ndarray[Any, Any]) -> agreement.Trace:
        stamps = made.t_mono[part] + true_late[part] - by
        return agreement.trace_of(stamps, made.pose[part], fine, scene.truth(fine))

    count, every = len(made.t_mono), slice(None)
    assert agreement.differences(traced(every, np.zeros(count)), outside)[1].max() > 0.0045, "12 ms at 0.4 m/s"
    late = agreement.lateness(np.arange(0.0, 0.04, 0.001), traced, count, outside)
    assert late[-1] == pytest.approx(0.012, abs=0.0011)
    assert np.median(late[made.t_mono < made.t_mono[0] + 9.0][-10:]) == pytest.approx(0.004, abs=0.0011)
    assert agreement.differences(traced(every, late), outside)[1].max() < 3.5e-3, "one group has both"


class Agent(Machine):
    """A machine whose agent says these things from the beginning."""

    def __init__(self, answer: bytes, folder: Path) -> None:
        super().__init__(subprocess.Popen(["sleep", "60"]), folder, Ports(1, 2, 3), threading.Event())
        (folder / "qemu").touch()
        self._agent, self.far = socket.socketpair()
        self.far.sendall(answer)

    def close(self) -> None:
        self._drop()
        self.far.close()
        self.process.kill()
        self.process.wait()


def test_an_inside_that_is_started_anew_fails_its_order_and_not_the_bench(tmp_path: Path) -> None:
    inside = Agent(b'{"up": true}\n', tmp_path)
    with pytest.raises(Order, match="started anew while"):
        inside.run("true")
    inside.close()
    inside = Agent(b'{"id": 1, "code": 0, "out": ""}\n', tmp_path)
    inside.reboot()
    asked = json.loads(inside.far.recv(4096))["run"]
    begun = time.monotonic()
    done = agent.obey({"run": [*asked[:2], asked[2].replace("systemctl reboot", "sleep 5")]})
    assert done == {"code": 0, "out": ""}
    assert time.monotonic() - begun < 0.4, "it is answered before it is carried out"
    inside.close()


def test_an_answer_that_comes_too_late_is_not_taken_for_the_next_ones(tmp_path: Path) -> None:
    inside = Agent(b'{"id": 1, "code": 0, ', tmp_path)
    with pytest.raises(Order, match=r"no answer to .*first.* within 0 s"):
        inside.order(0.05, run=["first"])
    inside.far.sendall(b'"out": "first"}\n{"id": 2, "code": 0, "out": "second"}\n')
    assert inside.order(5.0, run=["second"])["out"] == "second"
    inside.far.sendall(b'{"id": 3, "co\n{"id": 3, "code": 0, "out": "third"}\n')
    assert inside.run("third") == "third", "half a line of an agent that was ended"
    inside.far.close()
    inside.process.kill()
    for _ in range(2):
        with pytest.raises(places.CannotBench, match="QEMU has ended with -9"):
            inside.run("fourth")
    inside.close()


class Looked(bench.Bench):
    """A bench in time of its own, which goes on by ``wait``; its processor is kept waiting for a share of it."""

    def __init__(self, starved: float = 0.0) -> None:
        self.now, self.starved, self.machine = 0.0, starved, self  # type: ignore[assignment]  # all that is asked

    def monotonic(self) -> float:
        return self.now

    def waited_s(self) -> float:
        return 7.0 + self.starved * self.now

    def wait(self, seconds: float) -> None:
        self.now += seconds

    def read(self, tcp: bool = False) -> dict[str, object]:
        return {}

    def log(self, lines: int) -> str:
        return "its log"


@pytest.mark.parametrize(("starved", "most"), [(0.0, 60.0), (0.5, 120.0), (0.95, 300.0)])
def test_time_in_which_the_emulated_processor_could_not_run_does_not_count(
    starved: float, most: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = Looked(starved)
    monkeypatch.setattr(bench, "time", one)
    assert one.until("READY", 60.0, lambda: one.now > most - 1.0) == pytest.approx(most, abs=1.5)
    begun = one.now
    with pytest.raises(Order, match=rf"not within 60 s of its own, {most:.0f} s in all: READY; .*\nits log"):
        one.until("READY", 60.0, lambda: False)
    assert one.now - begun == pytest.approx(most, abs=1.5)


def test_what_a_computer_has_worked_is_the_system_s_own_count(tmp_path: Path) -> None:
    inside = Agent(b"", tmp_path)
    inside.close()
    code = "print(flush=True); import time\nwhile time.process_time() < 0.3: pass\nprint(flush=True); input()"
    words = [sys.executable, "-c", code]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as inside.process:
        assert inside.process.stdout is not None
        inside.process.stdout.readline()
        before = inside.worked_s() or 0.0
        inside.process.stdout.readline()
        assert 0.2 < (inside.worked_s() or 0.0) - before < 0.5
        inside.process.communicate(b"\n")
    assert inside.worked_s() is None, "it has ended"
    assert inside.waited_s() == 0.0


def test_what_the_emulated_processor_has_waited_is_its_own_thread_s(tmp_path: Path) -> None:
    """An idle thread of the emulation may have waited longer, long ago."""
    task = tmp_path / "task"
    for thread, name, waited in ((1, "qemu-system-x86", 10), (2, "CPU 0/TCG", 7), (3, "IO mon_iothread", 3)):
        (task / str(thread)).mkdir(parents=True)
        (task / str(thread) / "comm").write_text(f"{name}\n")
        (task / str(thread) / "schedstat").write_text(f"123 {waited * 10**9} 45\n")
    (task / "4").mkdir()  # it has ended
    assert _waited_s(task) == 7.0


def test_faults_that_are_present_are_read_where_the_daemon_puts_them() -> None:
    """By the number of the register, as a controller would."""
    condition = replace(NO_CONDITION, faults=(Fault.ADC_MISSING, Fault.ADC_BUS_STUCK))
    block = parts_block.BLOCK.encode(replace(example(7), condition=condition))
    one = Looked()
    one.registers = lambda first, count: block[2 * (first - 400) :][: 2 * count]  # type: ignore[method-assign,misc]
    assert one.present(151, 153, 155) == [153, 155]
    assert bench.FAULTS == parts_block.FAULTS


def test_a_long_answer_comes_whole_through_a_port_that_takes_little_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    taken = b""

    def write(port: int, data: bytes) -> int:
        nonlocal taken
        taken += data[:32768]
        return min(len(data), 32768)

    monkeypatch.setattr(agent.os, "write", write)
    agent.write_all(3, bytes(100_000))
    assert taken == bytes(100_000)


def test_a_command_that_takes_too_long_ends_with_all_that_it_has_started() -> None:
    begun = time.monotonic()
    assert agent.obey({"run": ["sh", "-c", "sleep 20; true"], "seconds": 0.2})["code"] == 127
    assert time.monotonic() - begun < 5.0, "it waits for the sleep, which holds the line that it writes to"


def test_what_is_waited_for_ends_when_the_run_is_broken_off(tmp_path: Path) -> None:
    inside = Agent(b"", tmp_path)
    threading.Timer(0.3, inside.broken_off.set).start()
    begun = time.monotonic()
    with pytest.raises(places.BrokenOff):
        inside.run("sleep", "60", seconds=60.0)
    assert time.monotonic() - begun < 5.0
    inside.close()


def test_the_drive_outside_is_driven_once_for_its_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    driven: list[int] = []

    def drive() -> agreement.Trace:
        driven.append(1)
        return agreement.Trace(np.arange(3.0), np.ones((3, 2)))

    monkeypatch.setattr(reference, "_driven", drive)
    assert reference.outside().off.sum() == 6.0
    assert driven == [1]
    image.cache().mkdir(parents=True)
    for _ in range(3):
        assert reference.outside().off.sum() == 6.0
    assert driven == [1, 1]
    monkeypatch.setattr(reference, "SOURCES", ("daemon",))
    reference.outside()
    assert driven == [1, 1, 1]
    assert len(list(image.cache().iterdir())) == 1


def test_a_transaction_of_the_adapter_is_understood() -> None:
    data = struct.pack("=Ii4H4H", 7, 2, 0x48, 0, 3, 0, 0x4D, agent.READ, 512, 0) + b"\x01\x83\x05"
    assert agent.transaction(data) == (7, [(0x48, b"\x01\x83\x05", 0), (0x4D, b"", 512)])


def test_orders_are_carried_out_and_answered(tmp_path: Path) -> None:
    assert agent.obey({"run": ["sh", "-c", "echo here; exit 3"]}) == {"code": 3, "out": "here\n"}
    assert agent.obey({"run": ["sleep", "9"], "seconds": 0.05})["code"] == 127
    assert agent.obey({"write": str(tmp_path / "a/b"), "text": "c"})["code"] == 0
    assert (tmp_path / "a/b").read_text() == "c"
    assert agent.obey({"fly": True})["code"] == 126


def test_a_line_that_nobody_reads_loses_what_is_sent_and_stops_nobody() -> None:
    source, feed = os.pipe()
    end, sink = os.pipe()
    os.set_blocking(sink, False)
    try:
        os.write(feed, b"first")
        agent.hand_over(source, sink)
        assert os.read(end, 16) == b"first"
        while True:
            try:
                os.write(sink, bytes(4096))
            except BlockingIOError:
                break
        os.write(feed, b"lost")
        agent.hand_over(source, sink)
        os.close(feed)
        with pytest.raises(OSError, match="hung up"):
            agent.hand_over(source, sink)
    finally:
        for one in (source, end, sink):
            os.close(one)


def test_a_pose_is_compared_where_the_map_begins() -> None:
    x, y, yaw = in_map((1.0, 3.0, math.pi), (1.0, 2.0, math.pi / 2), (0.0, 0.0, 0.0))
    assert (x, y, yaw) == pytest.approx((1.0, 0.0, math.pi / 2))


def test_a_datagram_that_was_under_way_for_long_does_not_shift_its_pose() -> None:
    clock = OtherClock()
    apart, age = 500.0, 0.02
    for k, delay in enumerate((0.003, 0.060, 0.001, 0.200)):
        t = 10.0 + k
        here = clock.here(t, t + age, t + age + apart + delay)
        assert here == pytest.approx(t + apart + (0.003, 0.003, 0.001, 0.001)[k])
    assert clock.here(1.0, 1.02, 700.02) == pytest.approx(700.0), "switched on anew"
    assert clock.here(3.0, 3.02, 760.02) == pytest.approx(760.0), "and again, longer ago than it had run before"


def test_a_pose_datagram_is_read_as_the_daemon_writes_it() -> None:
    one = replace(example(7), t_mono=12.5, t_sent=12.53, missed=4, overruns=5, fault=106)
    read = bench.heard(registers.encode_datagram(one), 100.03, OtherClock())
    assert read.t_pose == pytest.approx(100.0, abs=2e-4)
    assert one.pose is not None
    assert read.pose == pytest.approx(one.pose, abs=1e-4)
    assert (read.t_came, read.state, read.loops) == (100.03, one.state, one.loop_counter)
    assert (read.missed, read.overruns, read.fault) == (one.missed, one.overruns, one.fault) == (4, 5, 106)


def test_the_truth_is_interpolated() -> None:
    ears = bench.Ears()
    ears.truth.extend([(1.0, (0.0, 0.0, 3.1)), (2.0, (1.0, 2.0, -3.1))])
    pose = ears.true_pose(1.5)
    assert pose == pytest.approx((0.5, 1.0, math.pi), abs=1e-9)
    assert ears.true_pose(0.5) is None


@pytest.mark.system
@pytest.mark.timeout(600)
def test_six_scenarios_where_there_is_an_image_of_these_sources(tmp_path: Path) -> None:
    """Boots, is found, starts, is restricted, keeps real time; making the image takes too long here."""
    made = image.Image(image.cache() / f"image-{image.image_key()}")
    if reason := places.missing(build=False) or (made.lacks() and "no image of these sources: make bench-vm makes it"):
        pytest.skip(reason)
    assert [one.__name__ for one in SCENARIOS].index("takes_real_time") == 5
    command = [sys.executable, "-m", "tools.bench.vm", "takes_real_time", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    assert "6 of 6 passed" in done.stdout


@pytest.mark.system
@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.timeout(3600)
def test_the_package_in_an_emulated_computer(tmp_path: Path) -> None:
    if reason := places.missing():
        pytest.skip(reason)
    command = [sys.executable, "-m", "tools.bench.vm", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
