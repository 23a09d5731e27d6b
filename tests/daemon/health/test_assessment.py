"""Faults from vitals: each appears and goes with its cause, the gravest first, said once each way."""

import asyncio
import logging
from dataclasses import replace
from itertools import pairwise

import pytest

from daemon.health.assessment import PUBLISHERS, Vitals, assess, describe
from daemon.health.faults import FAULTS, Fault
from daemon.health.present_faults import PresentFaults
from daemon.health.report import NAMES
from daemon.runtime import heartbeat as module
from daemon.runtime.heartbeat import Heartbeat
from estimator import SlowErrors
from hal.clock import VirtualLoop
from hal.errors import DataInvalid, DeviceFault, DeviceMissing, DeviceRefused
from hal.lidar import Link

INPUTS = {"lidar", "photodiode", "odometry", "imu"}
BEFORE = Vitals(0.0, link=Link.STREAMING)
WELL = replace(BEFORE, t_mono=10.0, scans=400, cycles=400)


def test_all_is_well() -> None:
    assert assess(WELL, BEFORE) == ()


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"link": Link.WAITING, "error": DeviceMissing("/dev/ttyACM0", "gone")}, Fault.LIDAR_MISSING),
        ({"link": Link.WAITING, "error": DeviceRefused("/dev/ttyACM0", "busy")}, Fault.LIDAR_REFUSED),
        ({"link": Link.OPENING, "error": DeviceFault("/dev/ttyACM0", "0L")}, Fault.LIDAR_BROKEN),
        ({"silent": True, "error": DataInvalid("/dev/ttyACM0", "checksum")}, Fault.LIDAR_SILENT),
        ({"silent": True}, Fault.LIDAR_SILENT),
        ({"invalid": 30}, Fault.LIDAR_GARBLED),
        ({"missed": 12}, Fault.LIDAR_GAPS),
        ({"odometry": False}, Fault.ODOMETRY_SILENT),
        ({"odometry": True, "odometry_jumps": 1}, Fault.ODOMETRY_JUMPS),
        ({"odometry": True, "disagree": True}, Fault.ODOMETRY_DISAGREES),
        ({"late": 30}, Fault.LIDAR_LATE),
        ({"lag": 0.3}, Fault.LIDAR_LATE),
        ({"odometry": True, "lag": -0.2}, Fault.ODOMETRY_GAPS),
        ({"misfit": True}, Fault.LIDAR_MISFIT),
        ({"odometry": True, "readings": 100, "readings_missed": 20}, Fault.ODOMETRY_GAPS),
        ({"odometry": True, "readings": 100, "readings_old": 20}, Fault.ODOMETRY_GAPS),
        ({"odometry": True, "readings": 100, "readings_seldom": True}, Fault.ODOMETRY_GAPS),
        ({"lateness": 0.21}, Fault.LOOP_STALLED),
        ({"jobs_failed": 1}, Fault.WORKER_FAILED),
        ({"no_descriptors": True}, Fault.NO_DESCRIPTORS),
        ({"failed": frozenset(["modbus"])}, Fault.PUBLISHER_FAILED),
        ({"failed": frozenset(["publisher"])}, Fault.PUBLISHER_FAILED),
        *(({"failed": frozenset([part])}, Fault.PART_FAILED) for part in sorted(INPUTS | {"stream beat"})),
        ({"failed": frozenset(["recorder"])}, Fault.RECORDER_FAILED),
        ({"failed": frozenset(["map"])}, Fault.MAP_NOT_SAVED),
        ({"failed": frozenset(["stored map"])}, Fault.MAP_REFUSED),
    ],
)
def test_each_cause_has_its_fault(change: dict[str, object], fault: Fault) -> None:
    assert assess(replace(WELL, **change), BEFORE) == (fault,)  # type: ignore[arg-type]  # test shorthand


@pytest.mark.parametrize(
    "change",
    [{"invalid": 15}, {"missed": 7}, {"overruns": 15}, {"lateness": 0.19}, {"error": DataInvalid("lidar", "once")}],
)
def test_a_little_of_it_is_no_fault(change: dict[str, object]) -> None:
    assert assess(replace(WELL, **change), BEFORE) == ()  # type: ignore[arg-type]  # test shorthand


def test_the_first_second_after_a_start_is_no_rate() -> None:
    early = Vitals(1.0, link=Link.STREAMING, scans=8, cycles=8, missed=2, invalid=1, overruns=2)
    assert assess(early, early) == assess(early, BEFORE) == ()


def test_a_loop_that_is_late_while_kernels_are_compiled_is_no_fault() -> None:
    loading = Vitals(1.0, link=Link.STREAMING, lateness=0.5)
    assert assess(loading, loading) == ()
    assert assess(replace(WELL, lateness=0.5), BEFORE) == (Fault.LOOP_STALLED,)


def test_large_errors_of_wheels_and_mount_are_named_with_their_values() -> None:
    value, sigma = (-0.17, 0.02, 0.0, 0.1, 0.01), (0.01, 0.01, 0.002, 0.005, 0.01)
    wheels = replace(WELL, slow=SlowErrors(value, sigma, (True, False, False, False, False)))
    mount = replace(WELL, slow=SlowErrors(value, sigma, (False, False, False, True, False)))
    assert assess(wheels, BEFORE) == (Fault.ODOMETRY_SCALE,)
    assert "multiply its distances by 0.83 and its turns by 1.02" in describe(Fault.ODOMETRY_SCALE, wheels)
    assert assess(mount, BEFORE) == (Fault.LIDAR_TURNED,)
    assert "differs from `lidar.mount` by +5.7 deg (sigma 0.3)" in describe(Fault.LIDAR_TURNED, mount)


def test_a_lidar_that_repeats_one_scan_is_the_cause_of_what_follows_from_it() -> None:
    frozen = replace(WELL, repeated=BEFORE.repeated + 40, misfit=True, disagree=True)
    assert assess(frozen, BEFORE) == (Fault.LIDAR_FROZEN, Fault.LIDAR_MISFIT, Fault.ODOMETRY_DISAGREES)
    assert assess(replace(WELL, repeated=40), replace(BEFORE, repeated=40)) == ()


def test_a_gyro_with_a_wrong_factor_is_named_with_it() -> None:
    now = replace(WELL, gyro=57.3, disagree=True)
    assert assess(now, BEFORE) == (Fault.GYRO_SCALE, Fault.ODOMETRY_DISAGREES)
    assert "it measures 57.30 times the true turn" in describe(Fault.GYRO_SCALE, now)


def test_only_what_is_new_counts() -> None:
    old = replace(BEFORE, invalid=1000, missed=1000, overruns=1000, jobs_failed=5, odometry_jumps=3)
    now = replace(WELL, invalid=1000, missed=1000, overruns=1000, jobs_failed=5, odometry_jumps=3, odometry=True)
    assert assess(now, old) == ()


def test_the_gravest_comes_first() -> None:
    now = replace(WELL, overruns=100, invalid=100, failed=frozenset(["pose"]))
    slow = (Fault.COMPUTER_SLOW, Fault.OVERRUNS)
    assert assess(now, BEFORE) == (Fault.LIDAR_GARBLED, *slow, Fault.PUBLISHER_FAILED)


def test_missing_scans_of_a_lidar_that_is_down_are_no_fault_of_their_own() -> None:
    now = replace(WELL, link=Link.WAITING, error=DeviceMissing("/dev/ttyACM0", "gone"), missed=100)
    assert assess(now, BEFORE) == (Fault.LIDAR_MISSING,)


def test_every_part_is_known_for_what_it_is() -> None:
    assert NAMES.keys() - PUBLISHERS == INPUTS | {"map"}


def test_every_fault_has_a_meaning_and_a_remedy() -> None:
    assert list(FAULTS) == sorted(Fault), "by number, and so are the pages made of it"
    assert all(text for text, _ in FAULTS.values())
    assert [fault for fault, (_, remedy) in FAULTS.items() if not remedy] == [Fault.NONE]
    assert describe(Fault.OVERRUNS).startswith("fault 302: more than 5 % of the cycles")
    gone = replace(WELL, link=Link.WAITING, error=DeviceRefused("tcp://h", "connection refused", "is it on?"))
    assert describe(Fault.LIDAR_REFUSED, gone).endswith("the connection: tcp://h: connection refused (is it on?)")
    assert "dialout" not in describe(Fault.LIDAR_REFUSED, gone), "that is for serial ports"
    assert "dialout" in describe(Fault.LIDAR_REFUSED)


@pytest.mark.parametrize("fault", [Fault.LIDAR_LATE, Fault.ODOMETRY_GAPS])
def test_what_is_stamped_late_may_be_stamped_at_arrival(fault: Fault) -> None:
    text, remedy = FAULTS[fault]
    assert "stamps" in text
    assert "at arrival" in remedy


def test_what_cannot_publish_is_named() -> None:
    now = replace(WELL, failed=frozenset(["stream", "map", "odometry"]))
    assert describe(Fault.PUBLISHER_FAILED, now).endswith("): stream")
    assert describe(Fault.PART_FAILED, now).endswith("): odometry")
    both = replace(WELL, failed=frozenset(["stream", "modbus"]))
    assert describe(Fault.PUBLISHER_FAILED, both).endswith("): modbus, stream")
    assert "stream's socket" in FAULTS[Fault.PUBLISHER_FAILED][1]


class Patient:
    """Vitals that a test sets."""

    def __init__(self) -> None:
        self.now = Vitals(0.0, link=Link.STREAMING)
        self.beats = 0

    def sample(self, lateness: float) -> Vitals:
        self.beats += 1
        self.now = replace(
            self.now,
            t_mono=float(self.beats),
            scans=40 * self.beats,
            cycles=self.now.cycles + 40,
            lateness=lateness,
        )
        return self.now


def test_a_fault_is_said_once_when_it_comes_and_once_when_it_has_gone(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    patient = Patient()
    present = PresentFaults()
    heart = Heartbeat(patient.sample, lambda: "statistics", present=present)
    heart.beat(0.0)
    patient.now = replace(patient.now, invalid=50)
    for _ in range(5):
        heart.beat(0.0)
    assert present.gravest() == Fault.LIDAR_GARBLED
    for _ in range(15):
        heart.beat(0.0)
    assert present.gravest() == 0
    assert [record.message.split(" (")[0] for record in caplog.records] == [
        "fault 105: more than 5 % of the lidar's frames are damaged",
        "over: fault 105: more than 5 % of the lidar's frames are damaged. It lasted 10 s",
    ]


def test_what_is_over_is_said_with_how_long_it_lasted_and_nothing_is_to_be_done(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    patient = Patient()
    heart = Heartbeat(patient.sample, str)
    gone = DeviceMissing("/dev/ttyACM0", "no such device", "connect it")
    for beat in range(30):
        lost = 5 <= beat < 12 and beat != 8  # once back for a second: one fault all the same
        patient.now = replace(patient.now, link=Link.WAITING if lost else Link.STREAMING, error=gone)
        heart.beat(0.0)
    assert caplog.messages[1:] == ["over: fault 101: no lidar is found. It lasted 7 s"]


def test_a_lag_between_laser_and_wheels_is_said_once_each_way_with_its_seconds(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    patient = Patient()
    heart = Heartbeat(patient.sample, str)
    for beat in range(20):
        patient.now = replace(patient.now, lag=0.312 if 5 <= beat < 12 and beat != 8 else 0.0)
        heart.beat(0.0)
    assert [message.split(": ")[0] for message in caplog.messages] == ["fault 107", "over"]
    assert caplog.messages[0].endswith("scan stamps are late by +0.31 s against odometry")
    early = replace(WELL, odometry=True, lag=-0.2)
    assert describe(Fault.ODOMETRY_GAPS, early).endswith("scan stamps are late by -0.20 s against odometry")
    assert "against odometry" not in describe(Fault.LIDAR_MISFIT, early)
    assert assess(replace(early, lag=0.3, silent=True), BEFORE) == (Fault.LIDAR_SILENT,), "no scans come late"


def test_a_stall_is_said_once_and_over_when_none_has_come_for_a_while(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    heart = Heartbeat(Patient().sample, str)
    for beat in range(40):
        heart.beat(0.5 if beat in (5, 8, 12) else 0.001)
        assert (Fault.LOOP_STALLED in heart.faults) == (5 <= beat <= 22)
    assert len(caplog.records) == 2


def test_a_beat_that_comes_late_names_no_device_before_it_has_been_heard(caplog: pytest.LogCaptureFixture) -> None:
    """When a stopped process wakes, nobody has taken what has arrived; what is wrong still, the next beat names."""
    caplog.set_level(logging.INFO)
    patient = Patient()
    heart = Heartbeat(patient.sample, str)
    seen: list[tuple[Fault, ...]] = []
    for beat in range(12):
        woken = beat == 3
        silent = woken or 6 <= beat <= 8
        patient.now = replace(patient.now, silent=silent, odometry=not woken)
        heart.beat(3.0 if woken or beat == 7 else 0.0)
        seen.append(heart.faults)
    assert seen[3] == (Fault.LOOP_STALLED,)
    assert seen[6:9] == [(Fault.LIDAR_SILENT, Fault.LOOP_STALLED)] * 3, "what has been named is not taken back"
    for _ in range(2):
        patient.now = replace(patient.now, silent=True)
        heart.beat(3.0)
    assert Fault.LIDAR_SILENT in heart.faults, "a loop that is always late hides nothing"
    assert [message[:10] for message in caplog.messages[:2]] == ["fault 301:", "fault 104:"]


def test_a_fault_that_comes_and_goes_is_one_fault_and_said_in_the_devices_words(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    patient = Patient()
    heart = Heartbeat(patient.sample, str)
    gone = DeviceMissing("/dev/ttyACM0", "no such device", "connect it")
    for beat in range(30):
        lost = 5 <= beat < 15 and beat % 3 != 0
        patient.now = replace(patient.now, link=Link.WAITING if lost else Link.STREAMING, error=gone)
        heart.beat(0.0)
        assert (Fault.LIDAR_MISSING in heart.faults) == lost, "what is published is what is so now"
    assert len(caplog.records) == 2
    assert caplog.messages[0].startswith("fault 101: no lidar is found (")
    assert caplog.messages[0].endswith(f": {gone}")
    assert caplog.messages[1].startswith("over: fault 101: ")


def test_what_is_lost_before_the_first_cycle_is_no_fault() -> None:
    samples = [
        Vitals(1.0, link=Link.STREAMING, scans=30, missed=10),
        Vitals(2.0, link=Link.STREAMING, scans=60, missed=20),
        Vitals(3.0, link=Link.STREAMING, scans=90, missed=30, cycles=20),
        Vitals(4.0, link=Link.STREAMING, scans=130, missed=30, cycles=60),
        Vitals(5.0, link=Link.STREAMING, scans=150, missed=50, cycles=100),
    ]
    waiting = iter(samples)
    heart = Heartbeat(lambda lateness: next(waiting), str)
    for _ in range(4):
        heart.beat(0.0)
        assert heart.faults == ()
    heart.beat(0.0)
    assert heart.faults == (Fault.LIDAR_GAPS,)


def test_statistics_are_logged_now_and_then(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    heart = Heartbeat(Patient().sample, lambda: "so many cycles")
    for _ in range(2 * module.STATISTICS_BEATS):
        heart.beat(0.0)
    assert [record.message for record in caplog.records] == ["so many cycles"] * 2


def test_the_watchdog_is_fed_only_while_cycles_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(module, "notify", lambda *words: said.extend(words))
    patient = Patient()
    heart = Heartbeat(patient.sample, str)
    for _ in range(3):
        heart.beat(0.0)
    assert said == ["WATCHDOG=1"] * 3
    still = patient.now
    heart = Heartbeat(lambda lateness: still, str)
    for _ in range(5):
        heart.beat(0.0)
    assert len(said) == 4, "the first beat knows no earlier one"


@pytest.mark.virtual
async def test_the_heart_beats_once_a_second_and_tells_lateness() -> None:
    seen: list[float] = []

    def sample(lateness: float) -> Vitals:
        seen.append(lateness)
        return Vitals(asyncio.get_running_loop().time())

    beating = asyncio.create_task(Heartbeat(sample, str).run())
    await asyncio.sleep(10.5)
    beating.cancel()
    assert len(seen) == 10
    assert max(seen) < 1e-6


@pytest.mark.virtual
async def test_after_a_beat_that_came_late_the_next_one_is_a_second_away(monkeypatch: pytest.MonkeyPatch) -> None:
    """At once it would find nothing but what the late one has found."""
    monkeypatch.setattr(module, "BEAT_S", 0.05)
    beats: list[float] = []
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)

    def sample(lateness: float) -> Vitals:
        beats.append(loop.time())
        return Vitals(loop.time())

    beating = asyncio.create_task(Heartbeat(sample, str).run())
    await asyncio.sleep(0.06)
    loop._jumping.virtual_now += 0.23  # the loop stands still: that is what is tested
    await asyncio.sleep(0.2)
    beating.cancel()
    assert len(beats) == 6
    assert min(after - before for before, after in pairwise(beats)) > 0.045


@pytest.mark.virtual
async def test_a_beat_that_fails_is_said_once_and_feeds_no_watchdog_and_the_next_is_tried(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    said: list[str] = []
    monkeypatch.setattr(module, "notify", lambda *words: said.extend(words))
    beats = 0

    def sample(lateness: float) -> Vitals:
        nonlocal beats
        beats += 1
        if 3 <= beats <= 5 or beats == 8:
            raise OSError(24, "Too many open files")
        return Vitals(float(beats), cycles=beats)

    beating = asyncio.create_task(Heartbeat(sample, str).run())
    await asyncio.sleep(10.5)
    assert not beating.done()
    beating.cancel()
    assert beats == 10
    assert said == ["WATCHDOG=1"] * 6
    assert caplog.text.count("a periodic task has failed") == 2


def test_cycles_that_leave_out_map_work_or_laser_are_a_fault_while_they_are_many() -> None:
    before = Vitals(0.0, cycles=400, short=10)
    many, few = replace(before, t_mono=10.0, cycles=800, short=60), replace(before, t_mono=10.0, cycles=800, short=20)
    assert assess(replace(many, link=Link.STREAMING), replace(before, link=Link.STREAMING)) == (
        Fault.COMPUTER_SLOW,
        Fault.OVERLOADED,
    )
    assert assess(replace(few, link=Link.STREAMING), replace(before, link=Link.STREAMING)) == ()


def test_before_the_first_cycle_nobody_has_looked_for_odometry() -> None:
    assert assess(replace(WELL, cycles=0, odometry=False), replace(BEFORE, cycles=0)) == ()
