"""Fault orders as data: reading, refusing with the path, chance, count and time."""

import asyncio
from collections.abc import Callable
from typing import ClassVar

import pytest

from hal.clock import run_virtual
from hal.fake.faults.control import Control
from hal.fake.faults.orders import Fault, FaultError, Parameter, Vocabulary, Word, read_schedule
from hal.fake.faults.schedule import ActiveFaults, FaultSchedule
from hal.fake.lidar.faults import LIDAR

TWO: dict[str, Vocabulary] = {"lidar": LIDAR, "adc": {"off": Word("no power", "lasts")}}


def test_a_schedule_is_read() -> None:
    text = """
    [[fault]]
    what = "bit_flip"
    where = "lidar"
    when = 2
    for = 1.5
    count = 3
    every = 10
    share = 0.5
    part = "sum"

    [[fault]]
    what = "off"
    where = "adc"
    """
    flip, off = read_schedule(text, TWO)
    assert (flip.what, flip.where, flip.when, flip.lasts, flip.count, flip.every) == (
        "bit_flip",
        "lidar",
        2.0,
        1.5,
        3,
        10,
    )
    assert flip.share == 0.5
    assert dict(flip.values) == {"on": "scans", "part": "sum", "bit": -1}
    assert (off.where, off.when, off.lasts) == ("adc", 0.0, 0.0)
    assert str(flip) == "lidar:bit_flip for=1.5 count=3 on=scans part=sum bit=-1"


def test_the_general_words_are_there() -> None:
    assert {"off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent"} <= set(LIDAR)


def test_intermittent_has_a_share_of_its_own() -> None:
    (fault,) = read_schedule('[[fault]]\nwhat = "intermittent"', {"lidar": LIDAR})
    assert fault.share == 0.5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "[[fault]]\nwhat = 'bitflip'\nwhere = 'lidar'",
            r"^fault\[0\]\.what: 'bitflip' is not a fault of 'lidar'; available: alien",
        ),
        ("[[fault]]\nwhere = 'lidar'", r"^fault\[0\]\.what: None is not a fault"),
        ("[[fault]]\nwhat = 3\nwhere = 'lidar'", r"^fault\[0\]\.what: expected a text, got 3"),
        ("[[fault]]\nwhat = 'off'", r"^fault\[0\]\.where: name one of lidar, adc"),
        ("[[fault]]\nwhat = 'off'\nwhere = 'gyro'", r"^fault\[0\]\.where: 'gyro'"),
        ("[[fault]]\nwhat='off'\nwhere='adc'\n[[fault]]\nwhat='dark'\nwhere='adc'", r"^fault\[1\]\.what: 'dark'"),
        (
            "[[fault]]\nwhat='bit_flip'\nwhere='lidar'\npart='dta'",
            r"^fault\[0\]\.part: 'dta' is not one of echo, status",
        ),
        ("[[fault]]\nwhat='bit_flip'\nwhere='lidar'\nbit=8", r"^fault\[0\]\.bit: 8 is outside -1\.\.\.7"),
        ("[[fault]]\nwhat='bit_flip'\nwhere='lidar'\nbit='3'", r"^fault\[0\]\.bit: expected a int, got '3'"),
        ("[[fault]]\nwhat='bit_flip'\nwhere='lidar'\ncount=true", r"^fault\[0\]\.count: expected a int, got True"),
        ("[[fault]]\nwhat='bit_flip'\nwhere='lidar'\ncount=0", r"^fault\[0\]\.count: 0 is outside"),
        ("[[fault]]\nwhat='silence'\nwhere='lidar'\nfor=-1", r"^fault\[0\]\.for: -1\.0 is outside"),
        (
            "[[fault]]\nwhat='silence'\nwhere='lidar'\ncount=2",
            r"^fault\[0\]\.count: 'silence' takes: what, where, when, for",
        ),
        ("[[fault]]\nwhat='inject'\nwhere='lidar'\nfor=2.0", r"^fault\[0\]\.for: 'inject' takes"),
        ("[[fault]]\nwhat='dark'\nwhere='lidar'\nwehn=2", r"^fault\[0\]\.wehn: 'dark' takes"),
        ("[[fault]]\nwhat='stamp_jump'\nwhere='lidar'\nby_ms=nan", r"^fault\[0\]\.by_ms: expected a int"),
        ("[[fault]]\nwhat='delayed'\nwhere='lidar'\nby_s=nan", r"^fault\[0\]\.by_s: nan is outside"),
        ("[[faults]]\nwhat='dark'", r"^faults: a schedule must have only \[\[fault\]\] tables"),
        ("fault = 3", r"^fault: expected \[\[fault\]\] tables"),
        ("[[fault]\n", r"^schedule: not TOML"),
    ],
)
def test_what_cannot_be_understood_is_refused_with_its_path(text: str, message: str) -> None:
    with pytest.raises(FaultError, match=message):
        read_schedule(text, TWO)


@pytest.mark.parametrize("name", LIDAR)
def test_every_word_of_the_lidar_is_described_and_its_defaults_are_legal(name: str) -> None:
    lines = [f"{key} = {_toml(rule.default)}" for key, rule in LIDAR[name].parameters.items()]
    (fault,) = read_schedule("\n".join(["[[fault]]", f"what = '{name}'", *lines]), {"lidar": LIDAR})
    assert fault.what == name
    assert LIDAR[name].help


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return '"AT\\r"' if value == "AT\r" else repr(value)


def strikes(orders: ActiveFaults, what: str, times: int, **match: str) -> str:
    return "".join("x" if orders.strike(what, **match) else "." for _ in range(times))


@pytest.mark.parametrize(
    ("fault", "pattern"),
    [
        (Fault("f", "lidar"), "xxxxxxxxxxxx"),
        (Fault("f", "lidar", count=3), "xxx........."),
        (Fault("f", "lidar", every=4), "...x...x...x"),
        (Fault("f", "lidar", every=4, count=2), "...x...x...."),
        (Fault("f", "lidar", share=0.0), "............"),
    ],
)
def test_when_a_fault_strikes(fault: Fault, pattern: str) -> None:
    orders = ActiveFaults()
    orders.add(fault)
    assert strikes(orders, "f", 12) == pattern
    assert orders.struck.get("f", 0) == pattern.count("x")


def test_share_is_left_to_a_seeded_chance() -> None:
    def run(seed: int) -> str:
        orders = ActiveFaults(seed)
        orders.add(Fault("f", "lidar", share=0.3))
        return strikes(orders, "f", 1000)

    assert 240 < run(1).count("x") < 360
    assert run(1) == run(1) != run(2)


def test_a_fault_may_be_meant_for_some_opportunities_only() -> None:
    orders = ActiveFaults()
    orders.add(Fault("f", "lidar", count=2, values={"on": "replies"}))
    assert strikes(orders, "f", 3, on="scans") == "..."
    assert strikes(orders, "f", 3, on="replies") == "xx."
    orders.add(Fault("f", "lidar", values={"on": "all"}))
    assert strikes(orders, "f", 2, on="scans") == "xx"


class Probe:
    """A device of another kind: the schedule knows nothing of lidars."""

    vocabulary: ClassVar[Vocabulary] = {
        "hot": Word("too hot", "lasts", {"by": Parameter(1.0)}),
        "bump": Word("a bump", "once"),
    }

    def __init__(self, now: Callable[[], float]) -> None:
        self.now = now
        self.events: list[tuple[float, str, str]] = []
        self.held: list[Fault] = []

    def check(self, fault: Fault) -> None:
        if fault.values.get("by") == 9.0:
            raise FaultError("by", "this one cannot be that hot")

    def in_force(self) -> list[Fault]:
        return self.held

    def begin(self, fault: Fault) -> None:
        self.events.append((self.now(), "begin", fault.what))
        if fault.what == "hot":
            self.held.append(fault)

    def end(self, fault: Fault) -> None:
        self.events.append((self.now(), "end", fault.what))
        self.held.remove(fault)


def play(script: Callable[[FaultSchedule, Control, Probe], None], seconds: float) -> Probe:
    async def main() -> Probe:
        loop = asyncio.get_running_loop()
        probe = Probe(loop.time)
        schedule = FaultSchedule({"probe": probe})
        script(schedule, Control(schedule), probe)
        await asyncio.sleep(seconds)
        schedule.close()
        return probe

    return run_virtual(main())


def test_faults_begin_and_end_at_their_times() -> None:
    text = (
        "[[fault]]\nwhat='hot'\nwhen=2.0\nfor=3.0\n[[fault]]\nwhat='bump'\nwhen=1.0\n[[fault]]\nwhat='hot'\nwhen=20.0"
    )
    events = play(lambda schedule, _c, _p: schedule.load(text) and None, 30.0).events
    assert events == [
        (1.0, "begin", "bump"),
        (2.0, "begin", "hot"),
        (5.0, "end", "hot"),
        (20.0, "begin", "hot"),
        (30.0, "end", "hot"),  # closing lifts what is left
    ]


def test_a_schedule_with_one_wrong_order_starts_nothing() -> None:
    def script(schedule: FaultSchedule, _control: Control, _probe: Probe) -> None:
        with pytest.raises(FaultError, match="cannot be that hot"):
            schedule.load("[[fault]]\nwhat='bump'\n[[fault]]\nwhat='hot'\nby=9.0")
        with pytest.raises(FaultError, match=r"fault\[1\]"):
            schedule.load("[[fault]]\nwhat='bump'\n[[fault]]\nwhat='cold'")

    assert play(script, 5.0).events == []


def test_live_orders() -> None:
    answers: list[str] = []

    def script(schedule: FaultSchedule, control: Control, _probe: Probe) -> None:
        loop = asyncio.get_running_loop()
        lines = [
            (1.0, "order hot for=5 by=2.5"),
            (2.0, "list"),
            (2.1, "order bump when=100"),
            (2.5, "list"),
            (3.0, "clear hot"),
            (4.0, "clear"),
            (5.0, "list"),
            (5.1, "words"),
            (5.2, "order hot by=9.0"),
            (5.3, "order cold"),
            (5.4, "order hot by"),
            (5.5, "dance"),
            (5.6, "order 'hot"),
        ]
        for t, line in lines:
            loop.call_at(t, lambda line=line: answers.append(control.answer(line)))

    probe = play(script, 10.0)
    assert probe.events == [(1.0, "begin", "hot"), (3.0, "end", "hot")]
    assert answers[:8] == [
        "ordered probe:hot for=5.0 by=2.5\nok\n",
        "in force probe:hot for=5.0 by=2.5\nok\n",
        "ordered probe:bump\nok\n",
        "in force probe:hot for=5.0 by=2.5\nto come probe:bump\nok\n",
        "cleared probe:hot for=5.0 by=2.5\nok\n",
        "cleared probe:bump\nok\n",
        "ok\n",
        "probe: hot (lasts) by=1.0 - too hot\nprobe: bump (once) - a bump\nok\n",
    ]
    assert [answer.partition(":")[0] for answer in answers[8:]] == ["refused"] * 5


def test_a_device_that_is_not_there() -> None:
    def script(schedule: FaultSchedule, _control: Control, _probe: Probe) -> None:
        with pytest.raises(FaultError, match="'lidar' is not a device here"):
            schedule.order(Fault("hot", "lidar"))

    play(script, 0.1)
