"""What the tests of faults on the wire share: orders, what arrives, and whether it is sound."""

from __future__ import annotations

import asyncio

from hal.fake.lidar.models import UTM_30LX
from tests.hal.fake.bench import Talk, read, summed, virtual

PERIOD = UTM_30LX.true_period_s


MD = "MD0000108000000"


FRAME = 3372


def order(what: str, **values: object) -> str:
    lines = [f"{key} = {value!r}".replace("True", "true") for key, value in values.items()]
    return "\n".join(["[[fault]]", f"what = '{what}'", *lines])


def pieces(toml: str, seconds: float = 1.0, command: str = MD) -> list[bytes]:
    """What arrives write by write (whole replies, unless the fault says otherwise), acknowledgement first."""

    async def scene(talk: Talk) -> list[bytes]:
        talk.schedule.load(toml)
        talk.say(command + "\n")
        await asyncio.sleep(seconds)
        return [data for _, data in talk.pieces]

    return virtual(scene)


def sound(data: bytes) -> bool:
    try:
        reply = read(data)
        return len(reply.values()) == 1081 and summed(reply.lines[0]) != ""
    except (AssertionError, UnicodeDecodeError, ValueError):
        return False


def differing(one: bytes, other: bytes) -> list[int]:
    assert len(one) == len(other)
    return [i for i, (a, b) in enumerate(zip(one, other, strict=True)) if a != b]
