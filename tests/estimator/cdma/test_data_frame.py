"""Data frames of lamps: coded, accumulated and decoded."""

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.cdma.data_frame import FRAME_BITS, LampFrame, crc16, decode_ring, encode
from estimator.cdma.frame_accumulator import BitRings
from tools.sim.light.transmitter import Lamp

WHOLE = (1 << FRAME_BITS) - 1
FRAME = LampFrame(lamp_id=4711, x_m=-12.345, y_m=100.005, z_m=2.6, power_w=1.5, half_angle_deg=70.0)


def turned(word: int, by: int) -> int:
    return (word << by & WHOLE) | word >> FRAME_BITS - by


def test_a_frame_fits_into_three_seconds() -> None:
    assert FRAME_BITS == 116
    assert FRAME_BITS * 127 / 5000.0 < 3.0


def test_crc_check_value() -> None:
    assert crc16(int.from_bytes(b"123456789", "big"), 72) == 0x29B1


@given(
    st.integers(0, 65535),
    st.tuples(st.integers(-131072, 131071), st.integers(-131072, 131071), st.integers(0, 4095)),
    st.integers(0, 2047),
    st.integers(0, 127),
    st.integers(0, 128),
)
@settings(max_examples=100, deadline=None)
def test_both_encoders_agree(lamp_id: int, steps: tuple[int, int, int], power: int, half_angle: int, code: int) -> None:
    x, y, z = (0.005 * step for step in steps)
    frame = LampFrame(lamp_id, x, y, z, 0.01 * power, float(half_angle))
    word = encode(frame, code)
    lamp = Lamp(
        code=code, current_a=0.0, lamp_id=lamp_id, position_m=(x, y, z), power_w=0.01 * power,
        half_angle_deg=half_angle,
    )  # fmt: skip
    assert format(word, f"0{FRAME_BITS}b") == lamp.frame()
    assert decode_ring(turned(word, lamp_id % FRAME_BITS), code) == frame


@pytest.mark.parametrize("flip", [0, WHOLE])
@pytest.mark.parametrize("turn", [0, 1, 57, 115])
def test_found_at_any_rotation_and_polarity(turn: int, flip: int) -> None:
    assert decode_ring(turned(encode(FRAME, 77), turn) ^ flip, 77) == FRAME


def test_any_single_or_double_error_is_refused() -> None:
    word, rng = encode(FRAME, 77), np.random.default_rng(0)
    for k in range(FRAME_BITS):
        assert decode_ring(word ^ 1 << k, 77) is None
        assert decode_ring(word ^ 1 << k ^ 1 << int((k + rng.integers(1, FRAME_BITS)) % FRAME_BITS), 77) is None


def test_heard_on_another_code_it_is_refused() -> None:
    assert all(decode_ring(encode(FRAME, 77), code) is None for code in range(129) if code != 77)


def test_another_version_is_not_for_us() -> None:
    assert decode_ring(encode(LampFrame(1, 0.0, 0.0, 2.0, 1.0, version=1), 5), 5) is None


def test_random_bits_are_no_frame() -> None:
    rng = np.random.default_rng(5)
    words = [int.from_bytes(rng.bytes(15), "big") & WHOLE for _ in range(2000)]
    assert not any(decode_ring(word, 3) for word in words)


@pytest.mark.parametrize(
    ("field", "value"), [("x_m", 655.4), ("y_m", -656.0), ("z_m", -0.1), ("power_w", 21.0), ("lamp_id", 65536)]
)
def test_what_does_not_fit_is_named(field: str, value: float) -> None:
    values = {"lamp_id": 1, "x_m": 0.0, "y_m": 0.0, "z_m": 2.0, "power_w": 1.0, field: value}
    with pytest.raises(ValueError, match=rf"{field} = {value} does not fit"):
        encode(LampFrame(**values), 1)  # type: ignore[arg-type]  # ints and floats from one table


def soft_bits(word: int, first: int, count: int, amplitude: float, sigma: float, seed: int) -> np.ndarray:
    bits = np.array([int(bit) for bit in format(word, f"0{FRAME_BITS}b")])
    at = np.arange(first, first + count) % FRAME_BITS
    return amplitude * (1.0 - 2.0 * bits[at]) + np.random.default_rng(seed).normal(0.0, sigma, count)


def listen(rings: BitRings, soft: np.ndarray, sigma: float, first: int) -> list[tuple[int, LampFrame]]:
    """Blocks that touch two periods; the second one is completed by the next block. Frames with their block number."""
    found = []
    for k in range(len(soft) - 1):
        rings.add(np.array([2]), np.array([first + k]), soft[None, k : k + 2], sigma**2 / np.array([[0.4, 0.6]]))
        found += [(k, frame) for _, frame in rings.frames(np.array([2]), np.array([77]), np.array([first + k]))]
    return found


def test_one_frames_worth_of_bits_is_enough_wherever_it_begins() -> None:
    soft = soft_bits(encode(FRAME, 77), 1000, FRAME_BITS + 1, 1.0, 0.05, 1)
    assert listen(BitRings(4), soft, 0.05, 1000)[0] == (FRAME_BITS - 2, FRAME)


def test_a_weak_lamp_is_read_by_repetition() -> None:
    word, sigma = encode(FRAME, 77), 0.3
    found = listen(BitRings(4), soft_bits(word, 0, 6 * FRAME_BITS, 1.0, sigma, 1), sigma, 0)
    assert {frame for _, frame in found} == {FRAME}
    assert 1.5 * FRAME_BITS < found[0][0] < 5 * FRAME_BITS


def test_a_lamp_that_is_told_something_new_is_believed_within_four_frames() -> None:
    new = LampFrame(4712, 1.0, 2.0, 3.0, 2.0)
    old = soft_bits(encode(FRAME, 77), 0, 5 * FRAME_BITS, 1.0, 0.05, 1)
    soft = np.concatenate([old, soft_bits(encode(new, 77), 5 * FRAME_BITS, 5 * FRAME_BITS, 1.0, 0.05, 2)])
    found = listen(BitRings(4), soft, 0.05, 0)
    assert {frame for _, frame in found} == {FRAME, new}
    assert found[-1][1] == new
    assert min(k for k, frame in found if frame == new) < 9 * FRAME_BITS


def test_a_forgotten_slot_knows_nothing() -> None:
    rings = BitRings(4)
    listen(rings, soft_bits(encode(FRAME, 77), 0, 2 * FRAME_BITS, 1.0, 0.05, 1), 0.05, 0)
    rings.forget(2)
    assert not rings.frames(np.array([2]), np.array([77]), np.array([10_000]))
    assert rings.before(np.array([2]), np.array([3]))[1] == 0.0


def test_what_was_kept_goes_on_as_the_original() -> None:
    rings = BitRings(3)
    slots, period = np.array([0, 2]), np.array([5, 40])
    soft, variance = np.array([[1.0, -2.0], [0.5, 3.0]]), np.array([[0.1, 0.2], [0.1, np.inf]])
    rings.add(slots, period, soft, variance)
    restored = [pickle.loads(pickle.dumps(rings)), copy.deepcopy(rings)]
    for one in (rings, *restored):
        one.add(slots, period + 1, soft, variance)
    for one in restored:
        for at in (period, period + 1):
            np.testing.assert_array_equal(one.before(slots, at), rings.before(slots, at))
    assert rings.before(slots, period + 1)[0].any()
