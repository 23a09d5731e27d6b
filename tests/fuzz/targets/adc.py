"""What a converter and a remote bus send: blocks of words, and the frames that carry them."""

import math
import struct
from collections.abc import Callable

import numpy as np

from hal.adc import Blemish
from hal.bus import i2c_frames as frames
from hal.bus.i2c import Transferred, read, write
from hal.photodiode.adapter_limits import AdapterLimits
from hal.photodiode.block_check import inspect
from hal.photodiode.diagnosis import BlockDiagnosis
from hal.photodiode.mcp3221 import CHIP
from hal.photodiode.sampler import Sampler
from tests.fuzz.targets import refused

MEGABYTES = 10

LENGTH, SCL = 2222, 400e3
SPAN = (10 + 9 * LENGTH) / SCL + 60e-6


def seeds() -> list[bytes]:
    t = np.arange(LENGTH // 2) / 22.2e3
    light = 2048 + 900 * np.sin(2 * np.pi * 100.0 * t) + 200 * np.sign(np.sin(2 * np.pi * 5e3 * t))
    words = light.astype(">u2").tobytes()
    done = frames.done(frames.Done(1, 0, 1.0, 1.0, 1.0, 1.0001, (b"\x12\x34",)))
    return [
        words,
        words[:1111],
        words[:1000] + b"\xff" * 1222,
        np.full(1111, 4095, ">u2").tobytes(),
        bytes(2222),
        frames.hello(1.0, "clock", "adapter") + done,
        frames.transfer(1, (write(0x48, b"\x01"), read(0x48, 2))) * 3,
        done + frames.done(frames.Done(2, 5, 1.0, 1.0, 1.0, 1.0001, ())),
    ]


def mend(data: bytes) -> bytes:
    """Of a frame, a head that says the length that follows; words have no sums."""
    return (
        data
        if len(data) < 5 or data[4] not in range(1, 5) or len(data) == LENGTH
        else struct.pack(">I", len(data) - 4) + data[4:]
    )


def feeder() -> Callable[[bytes], None]:
    state = {"t": 0.0, "seq": 0, "level": 0.0}
    sampler = Sampler(CHIP, AdapterLimits(LENGTH, SPAN, 28 / SCL + 60e-6))
    diagnosis = BlockDiagnosis("x", CHIP, 0x4D, lambda: state["level"] or None)
    whole = seeds()[0]

    def block(data: bytes) -> bool:
        late = (len(data) % 7) * 1e-3
        state["seq"] += 1 + len(data) % 3
        t = state["t"]
        taken, defects = sampler.to_block(Transferred(t, t + SPAN + late, (data,)), int(state["seq"]))
        state["level"] = defects.clipped
        verdict = diagnosis.add(taken, defects)
        state["t"] = t + SPAN + late + 1e-4
        assert taken.words.size <= LENGTH // 2
        assert taken.words.size == 0 or 0 <= int(taken.words.min()) <= int(taken.words.max()) <= 4095
        assert t <= taken.t_first <= taken.t1
        assert 0.0 <= taken.slack_s < 10.0
        assert 1e3 < taken.rate_hz < 1e5
        assert verdict.error is None or verdict.error.remedy
        return verdict.sound

    def feed(data: bytes) -> None:
        words, blemish, _ = inspect(data, LENGTH, 0xF000, 12)
        assert blemish != Blemish.NONE or 0 < words.min() <= words.max() < 4095
        block(data[:LENGTH])
        assert any(block(whole) for _ in range(2)), "a good block is not taken"
        refused(frames_of, data, by=frames.BadFrame)

    return feed


def frames_of(data: bytes) -> None:
    for kind, body in frames.Splitter().feed(data):
        parse(kind, body)


def parse(kind: int, body: bytes) -> None:
    if kind == frames.DONE:
        done = frames.parse_done(body)
        assert all(map(math.isfinite, (done.t0, done.t1)))
    elif kind == frames.HELLO:
        frames.parse_hello(body)
    elif kind == frames.TRANSFER:
        frames.parse_transfer(body)
    elif kind == frames.REFUSED and body:
        assert str(frames.parse_refused(body, "x"))
