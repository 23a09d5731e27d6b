"""The vocabulary of faults of the fake light receiver: converter, bus, light."""

from __future__ import annotations

import errno

from hal.fake.faults.orders import Parameter, Vocabulary, Word

ERRORS = (
    *("EIO", "ENXIO", "EREMOTEIO", "ETIMEDOUT", "EAGAIN", "EBUSY", "EOPNOTSUPP", "EINVAL"),
    *("ENODEV", "ESHUTDOWN", "ENOENT", "EACCES", "EPROTO", "ENOMEM"),
)
CHIPS = ("ADS1115", "ADC121C021", "MCP3221", "LM75", "24C02")
WHY = ("permission", "busy")
ON = {"on": Parameter("blocks", choices=("blocks", "all"))}

ADC: Vocabulary = {
    # the general words
    "off": Word("no power: the chip acknowledges nothing, and starts from its reset state", "lasts"),
    "stuck": Word("the same word repeatedly", "strikes"),
    "garbage": Word("random bytes instead", "strikes"),
    "wrong": Word("words off by `by`, clipped", "strikes", {"by": Parameter(100, -4095, 4095)}),
    "slow": Word("SCL is slower by `factor`", "lasts", {"factor": Parameter(1.6, 1.0, 100.0)}),
    "delayed": Word("transactions return `by_s` later", "lasts", {"by_s": Parameter(0.3, 0.0, 60.0)}),
    "intermittent": Word("transactions are not acknowledged", "strikes", ON, share=0.5),
    # transactions that fail
    "nack": Word("the address is not acknowledged", "strikes", ON),
    "error": Word("a transaction fails with `name`", "strikes", ON | {"name": Parameter("EIO", choices=ERRORS)}),
    "timeout": Word("a transaction takes the adapter's time-out and fails", "strikes", ON),
    "hang": Word("SDA is held low: every transaction times out", "lasts"),
    "arbitration": Word("another master wins the bus in the middle", "strikes", ON),
    # adapter and chip
    "gone": Word("the adapter is unplugged; open connections remain dead", "lasts"),
    "refuse": Word("the bus cannot be opened", "lasts", {"why": Parameter("permission", choices=WHY)}),
    "moved": Word("the chip answers at another address", "lasts", {"address": Parameter(0x4E, 0x08, 0x77)}),
    "replaced": Word("another chip answers at the address", "lasts", {"chip": Parameter("ADS1115", choices=CHIPS)}),
    "brownout": Word("the chip falls back into its reset state", "once"),
    "dc_off": Word("the DC channel's chip acknowledges nothing", "lasts"),
    "foreign": Word(
        "another program writes `config` to the DC channel's chip every `every_s`; its input AIN1 is at `volts`",
        "lasts",
        {
            "config": Parameter(0x5283, 0, 0xFFFF),
            "every_s": Parameter(0.1, 0.001, 3600.0),
            "volts": Parameter(3.2, 0.0, 6.0),
        },
    ),
    # time
    "stall": Word(
        "SCL is held low for `us` at `pieces` points, the first at share `at` of the block (-1: anywhere)",
        "strikes",
        {"us": Parameter(100.0, 0.0, 1e6), "at": Parameter(-1.0, -1.0, 1.0), "pieces": Parameter(1, 1, 1000)},
    ),
    "busy": Word("another client has the bus for `by_s` first", "strikes", {"by_s": Parameter(2e-3, 0.0, 10.0)}),
    "late": Word("the return is `by_s` late", "strikes", {"by_s": Parameter(2e-3, 0.0, 10.0)}),
    "scl": Word("SCL is off by `percent`", "lasts", {"percent": Parameter(-1.0, -50.0, 50.0)}),
    # bytes
    "short": Word("`bytes` fewer than requested", "strikes", {"bytes": Parameter(100, 1, 8192)}),
    "released": Word(
        "the chip releases the bus at share `at` of the block", "strikes", {"at": Parameter(0.5, 0.0, 1.0)}
    ),
    "floats": Word("every bit reads 1", "strikes"),
    "shift": Word("`bits` clocks too few: everything is shifted", "strikes", {"bits": Parameter(1, 1, 15)}),
    "hit": Word(
        "bits `mask` of `words` words, evenly spread over the block, are inverted",
        "strikes",
        {"words": Parameter(1, 1, 1000), "mask": Parameter(0x8000, 1, 0xFFFF)},
    ),
    # light
    "clip": Word(
        "the signal is `gain` times as large, and the amplifier stops `stop` of the supply short of either rail",
        "lasts",
        {"gain": Parameter(20.0, 1.0, 1e6), "stop": Parameter(0.004, 0.0, 0.4)},
    ),
    "dark": Word("no light: only electronic noise", "lasts"),
    "saturated": Word("so much light that the amplifier is saturated", "lasts"),
}
"""By word. ``off stuck garbage wrong slow delayed intermittent`` are common to all devices."""


def number_of(name: str) -> int:
    """An errno by its name."""
    return int(getattr(errno, name))
