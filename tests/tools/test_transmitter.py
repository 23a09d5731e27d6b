"""The lamp's program in C: its bits against the code tables, and its light against the decoder."""

import shutil
import subprocess
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from estimator.cdma.data_frame import FRAME_BITS, LampFrame, encode
from estimator.cdma.gold_codes import gold_codes
from tests.estimator.cdma_scene import Run, ceiling
from tools.sim.light.transmitter import Lamp

SOURCE = Path(__file__).parents[2] / "tools" / "transmitter" / "transmitter.c"
FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-Wconversion")
Array = npt.NDArray[np.float64]


def build(folder: Path, *flags: str) -> Path:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler (cc) on this computer")
    program = folder / "transmitter"
    subprocess.run([compiler, *FLAGS, *flags, "-o", program, SOURCE], check=True)
    return program


@pytest.fixture(scope="module")
def transmitter(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("transmitter"))


def arguments(code: int, frame: LampFrame) -> list[str]:
    numbers = (code, frame.lamp_id, 1e3 * frame.x_m, 1e3 * frame.y_m, 1e3 * frame.z_m, 1e3 * frame.power_w)
    return [str(round(number)) for number in (*numbers, frame.half_angle_deg)]


def half_chips(program: Path, code: int, frame: LampFrame, count: int) -> npt.NDArray[np.int64]:
    """What the compiled program sends, 1 bright, 0 dark."""
    command = [str(program), *arguments(code, frame), str(count)]
    sent = subprocess.run(command, capture_output=True, check=True).stdout
    return np.frombuffer(sent, np.uint8).astype(np.int64) - ord("0")


def expected(degree: int, code: int, frame: LampFrame) -> npt.NDArray[np.int64]:
    """One whole frame by the decoder's own tables."""
    chips = gold_codes(degree)[code]
    bits = encode(frame, code)
    data = np.array([1 - 2 * (bits >> (FRAME_BITS - 1 - k) & 1) for k in range(FRAME_BITS)])
    halves = np.outer(data, np.stack([chips, -chips], axis=1).ravel()).ravel()
    return (halves > 0).astype(np.int64)


FRAME = LampFrame(lamp_id=40001, x_m=-123.455, y_m=77.2, z_m=2.6, power_w=1.5, half_angle_deg=70)
EXTREMES = (
    LampFrame(0, -655.36, 655.355, 0.0, 0.0, 0.0),
    LampFrame(65535, 655.355, -655.36, 20.475, 20.47, 127.0),
)


@pytest.mark.parametrize("frame", [FRAME, *EXTREMES])
def test_a_whole_frame_and_its_repetition(transmitter: Path, frame: LampFrame) -> None:
    one = expected(7, 5, frame)
    sent = half_chips(transmitter, 5, frame, 2 * len(one) + 10)
    assert np.array_equal(sent, np.concatenate([one, one, one[:10]]))


def test_all_codes(transmitter: Path) -> None:
    for code in range(129):
        frame = replace(FRAME, lamp_id=1000 + code)
        assert np.array_equal(half_chips(transmitter, code, frame, 116 * 254), expected(7, code, frame)), code


@pytest.mark.parametrize(("degree", "code"), [(6, 0), (6, 63), (6, 64), (9, 17), (9, 511), (9, 512)])
def test_the_other_profiles(degree: int, code: int, tmp_path: Path) -> None:
    program = build(tmp_path, f"-DDEGREE={degree}")
    one = expected(degree, code, FRAME)
    assert np.array_equal(half_chips(program, code, FRAME, len(one)), one)


def test_positions_are_rounded_to_the_nearest_step(transmitter: Path) -> None:
    for x_mm, steps in ((2, 0), (3, 1), (-2, 0), (-3, -1), (1002, 200), (1003, 201)):
        sent = half_chips(transmitter, 5, replace(FRAME, x_m=1e-3 * x_mm), 116 * 254)
        assert np.array_equal(sent, expected(7, 5, replace(FRAME, x_m=0.005 * steps))), x_mm


def test_the_core_needs_nothing_but_a_compiler(tmp_path: Path) -> None:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler (cc) on this computer")
    flags = [
        "-DLAMP_EMBEDDED",
        "-ffreestanding",
        "-nostdlib",
        "-fno-builtin",
        "-Os",
        "-c",
        "-o",
        str(tmp_path / "lamp.o"),
    ]
    subprocess.run([compiler, "-std=c99", "-Wall", "-Wextra", "-Werror", *flags, str(SOURCE)], check=True)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ([], "usage"),
        (["129", "1", "0", "0", "2600", "1500", "70", "10"], "CODE 129: expected 0 to 128"),
        (["0", "70000", "0", "0", "2600", "1500", "70", "10"], "LAMP 70000: expected 0 to 65535"),
        (["0", "1", "-700000", "0", "2600", "1500", "70", "10"], "X_MM -700000: expected -655360 to 655355"),
        (["0", "1", "0", "0", "-5", "1500", "70", "10"], "Z_MM -5: expected 0 to 20475"),
        (["0", "1", "0", "0", "2600", "1500", "128", "10"], "HALF_ANGLE_DEG 128"),
        (["0", "1", "0", "x", "2600", "1500", "70", "10"], "Y_MM x"),
        (["0", "1", "0", "0", "2600", "99999999999999999999", "70", "10"], "POWER_MW 9999"),
    ],
)
def test_what_cannot_be_sent_is_named(transmitter: Path, words: list[str], says: str) -> None:
    done = subprocess.run([str(transmitter), *words], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert says in done.stderr
    assert not done.stdout


@dataclass(frozen=True)
class Compiled(Lamp):
    """A lamp whose half chips come from the compiled program."""

    halves: tuple[int, ...] = ()

    def edges(self, begin: float, end: float, chip_rate: float, degree: int) -> tuple[Array, Array]:
        rate = 2.0 * chip_rate * (1.0 + 1e-6 * self.ppm)
        numbers = np.arange(int(np.ceil(begin * rate)), int(np.floor(end * rate)) + 1)
        bright = np.array(self.halves)[numbers % len(self.halves)]
        level = self.current_a * np.where(bright == 1, 1.0 + self.depth, 1.0 - self.depth)
        return numbers / rate, np.diff(level, prepend=0.0)


def test_the_decoder_reads_what_the_program_sends(transmitter: Path) -> None:
    """Three lamps of the compiled program under mains flicker, through receiver and converter, from cold."""
    frames = {3: FRAME, 100: replace(FRAME, lamp_id=7, x_m=12.0), 127: replace(FRAME, lamp_id=8, y_m=-3.5)}
    scene = ceiling(1, np.array([2e-6, 1.5e-6, 1e-6]))
    scene.lamps = [
        Compiled(
            code, lamp.current_a, ppm=lamp.ppm, halves=tuple(half_chips(transmitter, code, frame, 116 * 254).tolist())
        )
        for (code, frame), lamp in zip(frames.items(), scene.lamps, strict=True)
    ]
    epoch = Run(scene).settle(130)
    assert sorted(epoch.ids.tolist()) == sorted(frames)
    heard = dict(zip(epoch.ids.tolist(), epoch.lamps, strict=True))
    for code, frame in frames.items():
        said = heard[code]
        assert said is not None, code
        assert said.lamp_id == frame.lamp_id
        assert (said.x_m, said.y_m, said.z_m) == pytest.approx((frame.x_m, frame.y_m, frame.z_m))
        assert (said.power_w, said.half_angle_deg) == pytest.approx((frame.power_w, frame.half_angle_deg))
