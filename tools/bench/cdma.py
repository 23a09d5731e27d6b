"""The light decoder of profile A in front of the waveform simulator: accuracy, acquisition, stalls, time.

``python -m tools.bench.cdma --epochs 100000`` counts false IDs over that many blocks (a quarter of an hour).
"""

import argparse
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.cdma.air_interface import PROFILE_A, PROFILES, Profile
from estimator.cdma.decoder import Decoder, decode, new_decoder, search
from estimator.cdma.epoch import BlockFlag, LightEpoch, LinkFlag, SampleBlock
from tools.ci.figures import Figure, bounded, table
from tools.sim.light.flicker import worst as worst_line
from tools.sim.light.transmitter import Lamp
from tools.sim.light.waveform import Ambient, Block, Bus, Ceiling, Receiver

Array = npt.NDArray[np.float64]

COMMAND: Final = "python -m tools.bench.cdma"
SAMPLES: Final = 1111
SWEEP: Final = 129
EFFORT: Final = 150
"""Codes that fit into 1 ms of search."""
NADIR_A: Final = 2.79e-6
"""Photocurrent right below a 1.5 W lamp at 2.6 m: 1.2 cm2, 0.4 A/W, half angle 70 degrees."""


def ceiling(seed: int, place: tuple[float, float] | None = None, scl_error: float = 0.0) -> Ceiling:
    """16 asynchronous lamps in a 10 x 10 m room, +-50 ppm, data on, 500 lx with 20 % flicker, 12 bit."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(2.0, 8.0, 2) if place is None else place
    grid = np.array([1.25, 3.75, 6.25, 8.75])
    r2 = ((grid[:, None] - x) ** 2 + (grid - y) ** 2).ravel()
    current = np.sort(NADIR_A * (2.6**2 / (r2 + 2.6**2)) ** 1.823)[::-1]
    return Ceiling(lamps(rng, current), bus=Bus(scl_error=scl_error), seed=seed)


def lamps(rng: np.random.Generator, current: Array) -> list[Lamp]:
    """Lamps with random codes, crystals, phases and places."""
    codes = rng.choice(SWEEP, len(current), replace=False)
    return [
        Lamp(
            code=int(code), current_a=float(a), lamp_id=int(code), position_m=(*rng.uniform(0, 10, 2).tolist(), 2.6),
            ppm=float(rng.uniform(-50, 50)), phase_chips=float(rng.uniform(0, 127 * 116)),
        )
        for code, a in zip(codes, current, strict=True)
    ]  # fmt: skip


class Drive:
    """A decoder in front of a ceiling; two cycles, and so two slices of search, per block."""

    def __init__(self, world: Ceiling, clock_ppm: float | None = 0.0, profile: Profile = PROFILE_A) -> None:
        self.world, self.t = world, 1.0
        self.samples = round(profile.epoch_s * profile.sample_rate)
        self.decoder: Decoder = new_decoder(profile, clock_ppm)
        self.decode_s: list[float] = []
        self.search_s: list[float] = []

    def block(self, stalls: tuple[tuple[int, float], ...] = ()) -> tuple[Block, LightEpoch]:
        """The next 50 ms."""
        block = self.world.block(self.t, self.samples, stalls)
        self.t = block.t1 + float(self.world.rng.uniform(1e-4, 1e-3))
        before = time.process_time()
        epoch = decode(self.decoder, SampleBlock(block.t0, block.t1, block.words, block.nominal_rate))
        self.decode_s.append(time.process_time() - before)
        for _ in range(2):
            before = time.process_time()
            search(self.decoder, EFFORT)
            self.search_s.append(time.process_time() - before)
        return block, epoch

    def settle(self, count: int) -> LightEpoch:
        """Let blocks go by."""
        return [self.block()[1] for _ in range(count)][-1]

    def errors(self, block: Block, epoch: LightEpoch) -> Array:
        """Relative amplitude error of each lamp, strongest first; NaN where it is not reported."""
        row = np.full(len(self.world.lamps), np.nan)
        place = {lamp.code: k for k, lamp in enumerate(self.world.lamps)}
        for code, amplitude in zip(epoch.ids.tolist(), epoch.amplitude, strict=True):
            if code in place:
                row[place[code]] = amplitude / block.truth_a[place[code]] - 1.0
        return row[np.argsort(-block.truth_a)]


def accuracy() -> list[Figure]:
    """Amplitude errors of the strongest and the eighth lamp, and what a bright day costs."""
    rms = {}
    for name, ambient in (("500 lx", Ambient()), ("10 klx", Ambient(current_a=1580e-6, flicker_a=15.8e-6))):
        rows = []
        for seed in range(4):
            drive = Drive(ceiling(seed))
            drive.world.ambient = ambient
            drive.settle(20)
            rows += [drive.errors(*drive.block()) for _ in range(80)]
        rms[name] = 100.0 * np.sqrt(np.mean(np.square(rows), axis=0))
    first, eighth = rms["500 lx"][0], rms["500 lx"][7]
    return [
        bounded("amplitude rms error, strongest of 16 lamps", first, "%", "<= 0.1", COMMAND),
        bounded("amplitude rms error, eighth of 16 lamps", eighth, "%", "<= 0.3", COMMAND),
        Figure("amplitude rms error, sixteenth of 16 lamps", rms["500 lx"][15], "%", command=COMMAND),
        bounded("10 klx over 500 lx, strongest", rms["10 klx"][0] / first, "ratio", "<= 2", COMMAND),
    ]


def until(drive: Drive, done: Callable[[LightEpoch], bool], limit: int) -> float:
    """Seconds of signal until an epoch satisfies a condition; inf if it does not within `limit` blocks."""
    for k in range(limit):
        if done(drive.block()[1]):
            return 0.05 * (k + 1)
    return float("inf")


def acquisition() -> list[Figure]:
    """From cold to all lamps, with a stored and with an unknown sample clock, and to the lamps' own words."""
    stored, unknown, spoken = [], [], []
    for seed in range(16):
        drive = Drive(ceiling(100 + seed, scl_error=float(np.linspace(-2e-4, 2e-4, 16)[seed])))
        codes = {lamp.code for lamp in drive.world.lamps}
        stored.append(until(drive, lambda epoch: codes <= set(epoch.ids.tolist()), 30))  # noqa: B023  used at once
    for seed, error in enumerate((-0.01, -0.0041, 0.0077, 0.01)):
        drive = Drive(ceiling(200 + seed, scl_error=error), None)
        unknown.append(until(drive, lambda epoch: len(epoch.ids) >= 4, 120))
    drive = Drive(ceiling(300))
    spoken.append(until(drive, lambda epoch: sum(lamp is not None for lamp in epoch.lamps) >= 8, 120))
    return [
        bounded("all 16 lamps from cold, clock within 200 ppm, worst of 16", max(stored), "s", "<= 0.25", COMMAND),
        bounded("four lamps from cold, clock unknown within 1 %, worst of 4", max(unknown), "s", "<= 5", COMMAND),
        Figure("eight lamps have told position, height and power", max(spoken), "s", command=COMMAND),
    ]


def false_ids(epochs: int) -> list[Figure]:
    """Blocks with lamps that go off and on, near and far, one of them twice in view, now and then none; all codes.

    False is a code that no lamp has, and a link called bright whose lamp is off or, of two with one code, one is off.
    """
    rng, counts, seen = np.random.default_rng(7), Counter[str](), 0
    while seen < epochs:
        world = ceiling(int(rng.integers(1 << 30)))
        everything = [dimmed(lamp, rng) if rng.random() < 0.3 else lamp for lamp in world.lamps]
        twin = everything[int(rng.integers(4))]
        everything.append(
            replace(twin, phase_chips=twin.phase_chips + float(rng.uniform(3.0, 120.0)), ppm=twin.ppm + 3)
        )
        drive, codes = Drive(world), {lamp.code for lamp in everything}
        for _ in range(25):
            world.lamps = [lamp for lamp in everything if rng.random() < 0.6] if rng.random() < 0.8 else []
            lit = Counter(lamp.code for lamp in world.lamps)
            for _ in range(8):
                epoch = drive.block()[1]
                bright = Counter(epoch.ids[epoch.flags & LinkFlag.FAINT == 0].tolist())
                counts["links"] += bright.total()
                counts["wrong"] += len(set(epoch.ids.tolist()) - codes)
                counts["dark"] += sum(max(count - lit[code], 0) for code, count in bright.items() if code in codes)
            seen += 8
    return [
        bounded(f"false IDs in {seen} blocks, {counts['links']} links", counts["wrong"], "", "<= 0", COMMAND),
        bounded("lamps that are off and called bright in these", counts["dark"], "", "<= 0", COMMAND),
    ]


def dimmed(lamp: Lamp, rng: np.random.Generator) -> Lamp:
    """The same lamp up to 30 times weaker."""
    return replace(lamp, current_a=lamp.current_a * float(10.0 ** rng.uniform(-1.5, 0.0)))


def crowd() -> list[Figure]:
    """64 lamps 1.2 m apart."""
    row = 1.2 * (np.arange(8) - 3.5)
    r2 = (row[:, None] ** 2 + row**2).ravel()
    drive = Drive(ceiling(1))
    drive.world.lamps = lamps(np.random.default_rng(2), NADIR_A * (2.6**2 / (r2 + 2.6**2)) ** 1.823)
    epoch = drive.settle(40)
    errors = np.array([drive.errors(*drive.block()) for _ in range(20)])
    return [
        bounded("lamps decoded of 64 in view", len(epoch.ids), "", ">= 64", COMMAND),
        Figure("amplitude rms error, strongest of 64", 100 * float(np.sqrt(np.mean(errors[:, 0] ** 2))), "%"),
    ]


def stalls(blocks: int) -> list[Figure]:
    """Pauses of 20 to 500 us anywhere in a block: worst error of a lamp above 80 nA in blocks that are not flagged."""
    rng, errors, flags, after = np.random.default_rng(3), [0.0], list[BlockFlag](), list[BlockFlag]()
    while len(flags) < blocks:
        drive = Drive(ceiling(400 + len(flags)))
        drive.settle(25)
        for _ in range(50):
            pause = (int(rng.integers(1, SAMPLES)), float(rng.uniform(20e-6, 500e-6)))
            block, epoch = drive.block((pause,))
            flags.append(epoch.block)
            if not epoch.block & (BlockFlag.STALLED | BlockFlag.NOISY):
                strong = int(np.count_nonzero(block.truth_a > 80e-9))
                errors.append(float(np.nanmax(np.abs(drive.errors(block, epoch)[:strong]))))
            after += [drive.block()[1].block for _ in range(2)]
    mended = np.mean([bool(flag & BlockFlag.MENDED) for flag in flags])
    name = f"worst amplitude error in {len(flags)} stalled blocks, where not flagged"
    return [
        bounded(name, 100 * max(errors), "%", "<= 1", COMMAND),
        Figure("stalled blocks mended", 100 * float(mended), "%", command=COMMAND),
        bounded(f"of {len(after)} clean blocks after them, flagged", sum(map(bool, after)), "", "<= 0", COMMAND),
    ]


def cost() -> list[Figure]:
    """Computing time with 16 lamps tracked. The machine is shared: the lowest decile is what the work itself costs."""
    drive = Drive(ceiling(9))
    drive.settle(260)
    decoding, slices = 1e3 * np.array(drive.decode_s[60:]), 1e3 * np.array(drive.search_s[120:])
    busy = slices[slices > 0.1]
    return [
        bounded(
            "decode a 50 ms block, 16 lamps, undisturbed", float(np.percentile(decoding, 10)), "ms", "<= 2", COMMAND
        ),
        Figure("decode a 50 ms block, 16 lamps, median", float(np.median(decoding)), "ms", command=COMMAND),
        bounded(
            "search slice of 150 codes' effort, undisturbed", float(np.percentile(busy, 10)), "ms", "<= 1", COMMAND
        ),
        Figure("search slice of 150 codes' effort, median", float(np.median(busy)), "ms", command=COMMAND),
    ]


def flicker() -> list[Figure]:
    """The strongest spectral line of any code over the no-effect level of IEEE 1789; with data it is weaker."""
    figures = []
    for name, profile in sorted(PROFILES.items()):
        numbers = range(0, 2**profile.degree + 1, 1 if profile.degree < 9 else 8)
        still = [Lamp(code, 1.0, depth=profile.depth, data=False) for code in numbers]
        worst = max(worst_line(lamp, profile.chip_rate, profile.degree) for lamp in still)
        what = f"profile {name}: worst line over IEEE 1789 no-effect level, any code without data"
        target = "<= 2.5" if name == "B" else "<= 1"  # low risk begins at 2.5 times no effect
        figures.append(bounded(what, worst, "ratio", target, COMMAND))
    return figures


def other_profiles() -> list[Figure]:
    """Profiles B with 8 lamps and D with 16, in the same room."""
    figures = []
    for name, count in (("B", 8), ("D", 16)):
        profile, rows = PROFILES[name], []
        front = profile.front_end
        for seed in range(2):
            world = ceiling(seed)
            codes = np.random.default_rng(seed).choice(2**profile.degree + 1, count, replace=False)
            world.lamps = [
                replace(lamp, code=int(code), depth=profile.depth)
                for lamp, code in zip(world.lamps[:count], codes, strict=True)
            ]
            world.receiver = Receiver(lpf_hz=front.lpf_hz, hpf_hz=front.hpf_hz)
            world.bus = Bus(scl_hz=18 * profile.sample_rate)
            world.chip_rate, world.degree = profile.chip_rate, profile.degree
            drive = Drive(world, profile=profile)
            drive.settle(40)
            rows += [drive.errors(*drive.block()) for _ in range(40)]
        rms = 100.0 * np.sqrt(np.nanmean(np.square(rows), axis=0))
        found = float(np.mean(np.isfinite(rows)))
        figures += [
            bounded(f"profile {name}: links reported of {count} lamps", 100 * found, "%", ">= 99", COMMAND),
            Figure(f"profile {name}: amplitude rms error, strongest", float(rms[0]), "%", command=COMMAND),
            Figure(f"profile {name}: amplitude rms error, eighth", float(rms[7]), "%", command=COMMAND),
        ]
    return figures


def run(epochs: int = 2000, stalled: int = 200) -> list[Figure]:
    """All figures."""
    return [
        *accuracy(), *acquisition(), *false_ids(epochs), *crowd(), *stalls(stalled), *cost(), *other_profiles(),
        *flicker(),
    ]  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--epochs", type=int, default=2000, help="blocks to count false IDs over")
    parser.add_argument("--stalled", type=int, default=200, help="blocks to stall")
    options = parser.parse_args()
    print(table(run(options.epochs, options.stalled)))
