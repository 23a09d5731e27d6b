"""Every fault of the fake converter against the real driver: noticed, survived, never turned into untrue samples.

One table: what is ordered, as what the driver notices it and how soon, and how soon after the fault is lifted a good
block must come that was measured after that. In every case silence shows within five blocks. All in virtual time.
"""

from __future__ import annotations

import asyncio
import errno
import re
from dataclasses import dataclass
from typing import Any

import pytest

from hal.adc import AdcStatus, Blemish
from hal.errors import DataInvalid, DeviceFault, DeviceMissing, DeviceRefused, HalError
from hal.fake.adc.faults import ADC, ERRORS, number_of
from hal.lidar import Link
from hal.photodiode.io_errors import POLICIES
from tests.hal.photodiode.bench import Bench, falsehoods, on_fake
from tests.rotation import share

AT_ONCE = 0.2
SILENCE = 5 * 0.05 + 0.02
"""Five blocks, and the interval at which the test looks."""
FIRST = 0.05 + SILENCE
"""The block that is running when the fault is ordered is still read."""
TIME_OUT = 1.1
"""What fails by the adapter's time-out is named then; the silence shows before."""
PERSISTS = 1.3
"""Conditions of the light are told after a second."""
STEP = 6.0
"""What was measured is kept for 5 s."""
REOPEN = 7.0
"""Pauses double up to 5 s, and a bus that hangs costs a second for every try."""


@dataclass(frozen=True)
class Case:
    """A row of the table.

    Attributes:
        fault: TOML, keys separated by semicolons. noun, says: error in the status while it lasts; None: none shows.
        blemish: on at least one block during the fault. within: seconds from lifting to the first good block.
        blocks: at least this many come while the fault lasts (8 s). start: it is there before the driver is.
        noticed: seconds from the order to this error.
    """

    fault: str
    noun: type[HalError] | None = None
    says: str = ""
    blemish: Blemish = Blemish.NONE
    within: float = AT_ONCE
    blocks: int = 0
    noticed: float = FIRST
    start: bool = False
    address: int = 0x4D
    chip: str = "MCP3221"

    @property
    def name(self) -> str:
        chip = "" if self.chip == "MCP3221" else f" of {self.chip}"
        start = " from the start" if self.start else ""
        return self.fault.replace("what = ", "").replace("'", "") + chip + start


ADC121: dict[str, Any] = {"chip": "ADC121C021", "address": 0x54}
CHIP = [
    Case("what = 'off'", DeviceMissing, "no MCP3221 answers at address 0x4d", within=REOPEN),
    Case("what = 'off'", DeviceMissing, "no MCP3221 answers at address 0x4d", within=REOPEN, start=True),
    Case("what = 'moved'; address = 0x4f", DeviceMissing, "no MCP3221 answers.*i2cdetect", within=REOPEN),
    Case("what = 'brownout'", blocks=150),
    Case("what = 'brownout'", blocks=150, **ADC121),
]
WRONG = [
    Case(f"what = 'replaced'; chip = '{chip}'", noun, says, within=REOPEN, noticed=PERSISTS, start=start, **where)
    for chip, noun, says, start, where in (
        ("ADS1115", DeviceRefused, "is not an MCP3221: it has registers", False, {}),
        ("ADS1115", DeviceRefused, "is not an MCP3221: it has registers", True, {}),
        ("LM75", DataInvalid, "data words with bits that it keeps at zero.*check converter type", False, {}),
        ("24C02", DeviceRefused, "bit 1 at zero", True, ADC121),
        ("MCP3221", DeviceRefused, "has no registers", True, ADC121),
        ("LM75", DeviceRefused, "is not an ADC121C021", True, ADC121),
    )
]

BUS = [
    Case("what = 'gone'", DeviceMissing, "the adapter was removed.*connect it", within=REOPEN),
    Case("what = 'gone'", DeviceMissing, "no such bus", within=REOPEN, start=True),
    Case("what = 'refuse'", DeviceRefused, "permission denied .*group i2c", within=REOPEN, start=True),
    Case("what = 'refuse'; why = 'busy'", DeviceRefused, "in use", within=REOPEN, start=True),
    Case("what = 'refuse'", blocks=150),
    Case("what = 'hang'", DeviceFault, "no data were read for 5 blocks", within=REOPEN),
    Case("what = 'hang'; for = 60", DeviceFault, "bus is stuck.*power off and on", within=REOPEN, noticed=TIME_OUT),
    Case("what = 'hang'", DeviceFault, "bus is stuck", within=REOPEN, start=True, noticed=TIME_OUT),
    Case("what = 'nack'; every = 10", blemish=Blemish.GAP, blocks=100),
    Case("what = 'nack'; on = 'all'", DeviceMissing, "no MCP3221", within=REOPEN),
    Case("what = 'intermittent'; share = 0.2", blemish=Blemish.GAP, within=REOPEN, blocks=40),
    Case("what = 'timeout'; every = 20", DeviceFault, "no data were read for", Blemish.GAP, 3.0, 20, noticed=1.4),
    Case("what = 'timeout'", DeviceFault, "no data were read for 5 blocks", within=REOPEN),
    Case("what = 'timeout'; for = 60", DeviceFault, "timed out", within=REOPEN, noticed=TIME_OUT),
    Case("what = 'arbitration'; every = 3", blemish=Blemish.GAP, blocks=90),
    Case("what = 'arbitration'", DeviceFault, "arbitration on the bus is lost repeatedly", within=REOPEN),
    Case("what = 'delayed'; by_s = 0.15", blemish=Blemish.STRETCHED, within=STEP, blocks=15),
    Case("what = 'delayed'; by_s = 4.0", DeviceFault, "not returned for 3 s.*unbind", within=6.0, noticed=3.2),
]

PASSING = ("EIO", "ENXIO", "EREMOTEIO", "EAGAIN", "EBUSY")
"""Tried again on the open bus, so that they do not even show. ETIMEDOUT is tried again as well, but takes a second."""
TRANSIENT = [
    Case(
        f"what = 'error'; name = '{name}'; count = 1",
        None if name in PASSING else HalError,
        blemish=Blemish.GAP,
        within=REOPEN,
        blocks=20,
    )
    for name in ERRORS
]
LASTING = [
    Case(
        f"what = 'error'; name = '{name}'; on = 'all'",
        noun,
        says,
        within=REOPEN,
        noticed=TIME_OUT if name == "ETIMEDOUT" else FIRST,
    )
    for name, noun, says in (
        ("EIO", DeviceFault, "EIO"),
        ("ENXIO", DeviceMissing, "no MCP3221"),
        ("EREMOTEIO", DeviceMissing, "no MCP3221"),
        ("EAGAIN", DeviceFault, "arbitration"),
        ("EBUSY", DeviceRefused, "address 0x4d is in use by another lumiloop or program, or by a kernel driver"),
        ("EOPNOTSUPP", DeviceRefused, "the adapter does not support these reads"),
        ("EINVAL", DeviceRefused, "the adapter does not support these reads"),
        ("ENODEV", DeviceMissing, "the adapter was removed"),
        ("ESHUTDOWN", DeviceMissing, "the adapter was removed"),
        ("ENOENT", DeviceMissing, "the adapter was removed"),
        ("EACCES", DeviceRefused, "permission denied.*group i2c"),
        ("EPROTO", DeviceFault, "EPROTO"),
        ("ETIMEDOUT", DeviceFault, "bus is stuck"),
        ("ENOMEM", DeviceFault, "unexpected error: Cannot allocate memory"),
    )
]

TIME = [
    Case("what = 'stall'; us = 500; every = 5", blemish=Blemish.STRETCHED, blocks=150),
    Case("what = 'stall'; us = 20; every = 5", blocks=150),
    Case("what = 'stall'; us = 30; pieces = 20; every = 5", blemish=Blemish.STRETCHED, blocks=150),
    Case("what = 'busy'; by_s = 0.003; every = 5", blemish=Blemish.STRETCHED, blocks=140),
    Case("what = 'late'; by_s = 0.003; every = 5", blemish=Blemish.STRETCHED, blocks=140),
    Case("what = 'slow'; factor = 1.6", blemish=Blemish.STRETCHED, within=STEP, blocks=80),
    Case("what = 'scl'; percent = -1.0", blemish=Blemish.STRETCHED, within=STEP, blocks=130),
    Case("what = 'scl'; percent = 1.0", blemish=Blemish.STRETCHED, within=STEP, blocks=130),
    Case("what = 'scl'; percent = 0.05", blocks=150),
]  # fmt: skip

BYTES = [
    Case(
        "what = 'stuck'",
        DeviceFault,
        "no light, or so much that the amplifier is.*or a defective converter",
        Blemish.STUCK,
        noticed=PERSISTS,
    ),
    Case("what = 'stuck'; every = 3", None, "", Blemish.STUCK, blocks=150),
    Case("what = 'garbage'", DataInvalid, "data words with bits that it keeps at zero", Blemish.MISALIGNED, REOPEN),
    Case("what = 'garbage'; every = 3", None, "", Blemish.MISALIGNED, blocks=150),
    Case(
        "what = 'shift'",
        DataInvalid,
        "bits that it keeps at zero|without their highest bits",
        Blemish.MISALIGNED,
        REOPEN,
    ),
    Case("what = 'shift'; bits = 4; every = 5", None, "", Blemish.MISALIGNED, blocks=150),
    Case("what = 'hit'", None, "", Blemish.REPAIRED, blocks=150),
    Case("what = 'hit'; words = 15; mask = 0xffff", None, "", Blemish.REPAIRED, blocks=150),
    Case(
        "what = 'hit'; words = 100",
        DataInvalid,
        "data words with bits that it keeps at zero",
        Blemish.MISALIGNED,
        REOPEN,
    ),
    Case("what = 'floats'", DeviceFault, "the bus floats", Blemish.MISALIGNED, REOPEN),
    Case("what = 'released'; at = 0.4; every = 4", None, "", Blemish.SHORT, blocks=150),
    Case("what = 'short'; bytes = 301; every = 4", None, "", Blemish.SHORT, blocks=150),
    Case(
        "what = 'wrong'; by = 2000", DeviceFault, "20 % of the samples are at the limits", Blemish.CLIPPED, noticed=2.0
    ),
    Case(
        "what = 'wrong'; by = -4095",
        DeviceFault,
        "every data word is at the same limit of the",
        Blemish.CLIPPED,
        noticed=PERSISTS,
    ),
]

LIGHT = [
    Case(
        "what = 'clip'; gain = 20", DeviceFault, "at the limits.*shade", Blemish.CLIPPED, blocks=150, noticed=PERSISTS
    ),
    Case(
        "what = 'dark'",
        DeviceFault,
        "no light, or so much that the amplifier is .* DC channel",
        blocks=150,
        noticed=PERSISTS,
    ),
    Case("what = 'saturated'", DeviceFault, "no light, or so much that the amplifier is", blocks=150, noticed=PERSISTS),
]


def name(case: Case) -> str:
    return case.name


CASES = CHIP + WRONG + BUS + TRANSIENT + LASTING + TIME + BYTES + LIGHT


@pytest.mark.parametrize("case", [pytest.param(case, marks=share(k, 2)) for k, case in enumerate(CASES)], ids=name)
def test_fault(case: Case) -> None:
    async def body(bench: Bench) -> None:
        driver = bench.driver()
        if case.start:
            bench.order(case.fault)
            await asyncio.sleep(1e-6)
        async with bench.running(driver):
            if not case.start:
                await bench.more(60, 10.0, driver)
                bench.order(case.fault)
            check_during(case, bench, await watch(bench, driver.status, 8.0))
            assert bench.faults is not None
            bench.faults.clear()
            lifted = bench.clock.now()
            await asyncio.sleep(case.within + 1.5)
            good = [b.t1 for b in bench.blocks if b.t0 > lifted and not b.blemish & ~Blemish.GAP]
            assert good, driver.status
            assert good[0] - lifted <= case.within, driver.status
            assert driver.status.link is Link.STREAMING
            assert driver.status.error is None
        assert falsehoods(bench, bench.blocks) == []

    on_fake(body, case.chip, case.address)


@dataclass(frozen=True)
class Seen:
    """An error of the status, and how long after the order it showed first."""

    after: float
    error: HalError


async def watch(bench: Bench, status: AdcStatus, seconds: float) -> list[Seen]:
    """Look at the status for a while; the errors it shows. Silence for more than five blocks must show."""
    seen: dict[str, Seen] = {}
    begin = heard = bench.clock.now()
    while (now := bench.clock.now()) < begin + seconds:
        heard = bench.blocks[-1].t1 if bench.blocks else begin
        error = status.error
        if error is not None:
            seen.setdefault(str(error), Seen(now - begin, error))
        if now - max(heard, begin) > SILENCE:
            assert status.link is not Link.STREAMING, f"{now - heard:.2f} s of silence: {status}"
        await asyncio.sleep(0.01)
    return list(seen.values())


def check_during(case: Case, bench: Bench, seen: list[Seen]) -> None:
    during = bench.blocks if case.start else bench.blocks[60:]
    assert len(during) >= case.blocks
    if case.blemish:
        assert any(case.blemish in block.blemish for block in during)
    if case.noun is None:
        assert not seen
        return
    meant = [s for s in seen if isinstance(s.error, case.noun) and re.search(case.says, str(s.error))]
    assert meant, seen
    assert meant[0].after <= case.noticed, seen
    assert all(s.error.remedy for s in seen)


def test_every_word_and_every_errno_is_in_the_table() -> None:
    text = " ".join(case.fault for case in CASES)
    assert {word for word in ADC if f"'{word}'" not in text} == {"dc_off", "foreign"}  # of the DC channel
    assert {name for name in ERRORS if f"'{name}'" not in text} == set()
    assert set(POLICIES) - {number_of(name) for name in ERRORS} == {errno.EPERM}  # treated as EACCES
