"""The light decoder of profile A beside PWM-dimmed lamps, and with two lamps of one code close in phase.

``python -m tools.bench.disturbed_light pwm`` (2 minutes) prints the lamps found beside each dimmed lamp.
``python -m tools.bench.disturbed_light twins`` (a quarter of an hour) counts blocks with codes that no lamp has, for
each distance and ratio.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import numpy as np

from estimator.cdma.epoch import BlockFlag, LightEpoch, LinkFlag, PwmLight
from tools.bench.cdma import NADIR_A, Drive, ceiling, lamps
from tools.sim.light.transmitter import PwmLamp
from tools.sim.light.waveform import Ceiling

HERTZ: Final = (200.0, 500.0, 1e3, 2e3, 5e3, 10e3, 25e3)
SWINGS_A: Final = (0.5e-6, 2e-6, 5e-6)
DUTIES: Final = (0.1, 0.3, 0.5, 0.9)
CODED: Final = 12
"""Coded lamps beside a dimmed one."""
SETTLE, COUNTED = 60, 30
"""Blocks before the count, and counted."""

DISTANCES: Final = tuple(np.round(np.linspace(0.3, 1.5, 12), 2).tolist())
RATIOS: Final = (1.0, 0.3, 0.1)
TWINS_A: Final = np.array([2.3e-6, 1e-6, 1e-6])

USED: Final = ~(BlockFlag.CLIPPED | BlockFlag.UNEVEN | BlockFlag.OVERDRIVEN)


def pwm() -> Iterator[str]:
    """A row for each dimmed lamp: fewest coded lamps, error of the eighth, honesty of the variances, name."""
    yield "| frequency | swing | duty | fewest of 12 lamps | eighth lamp, rms | rms error in sigmas | named |"
    yield "|---|---|---|---|---|---|---|"
    for hertz in HERTZ:
        for swing_a in SWINGS_A:
            for duty in DUTIES:
                yield _beside(hertz, swing_a, duty)


def _beside(hertz: float, swing_a: float, duty: float) -> str:
    """One row: coded lamps beside one dimmed lamp."""
    world = ceiling(int(hertz), (4.6, 5.3))
    world.lamps = world.lamps[:CODED]
    world.dimmed = [PwmLamp(hertz, swing_a, duty, 0.37)]
    drive = Drive(world)
    drive.settle(SETTLE)
    fewest, errors, z, false, flagged = CODED, [], [], 0, 0
    for _ in range(COUNTED):
        block, epoch = drive.block()
        row = drive.errors(block, epoch)
        fewest, false = min(fewest, int(np.isfinite(row).sum())), false + _strangers(world, epoch)
        flagged += bool(epoch.block & USED)
        if not epoch.block & USED:
            errors.append(row[7])
        z += _normalised(world, block.truth_a, epoch)
    eighth = 100.0 * float(np.sqrt(np.nanmean(np.square(errors)))) if errors else np.nan
    names = ", ".join(_name(lamp) for lamp in epoch.pwm) or "-"
    more = f"; {false} false codes" * (false > 0) + f"; {flagged} of {COUNTED} blocks flagged" * (flagged > 0)
    sigmas = float(np.sqrt(np.mean(np.square(z)))) if z else np.nan
    return (
        f"| {hertz:g} Hz | {swing_a * 1e6:g} uA | {duty:g} | {fewest} | {eighth:.2f} % | {sigmas:.2f} | {names}{more} |"
    )


def _name(lamp: PwmLight) -> str:
    """Frequencies and swing as they are reported."""
    other = "" if lamp.other_hertz is None else f" or {lamp.other_hertz:.1f} Hz"
    return f"{lamp.hertz:.1f} Hz{other}, {lamp.swing_a * 1e6:.2f} uA"


def _normalised(world: Ceiling, truth_a: np.ndarray, epoch: LightEpoch) -> list[float]:
    """Errors of the amplitudes in sigmas."""
    place = {lamp.code: k for k, lamp in enumerate(world.lamps)}
    rows = zip(epoch.ids.tolist(), epoch.amplitude, np.sqrt(epoch.variance), strict=True)
    return [float((amplitude - truth_a[place[code]]) / sigma) for code, amplitude, sigma in rows if code in place]


def _strangers(world: Ceiling, epoch: LightEpoch) -> int:
    """Links with codes that no lamp has."""
    return len(set(epoch.ids.tolist()) - {lamp.code for lamp in world.lamps})


def twins(blocks: int) -> Iterator[str]:
    """A row for each distance: blocks with false codes, and share of blocks in which both lamps are found, by ratio."""
    yield "| chips apart | " + " | ".join(f"ratio {ratio:g}: false, both" for ratio in RATIOS) + " |"
    yield "|---|" + "---|" * len(RATIOS)
    for apart in DISTANCES:
        cells = [_pair(apart, ratio, blocks) for ratio in RATIOS]
        yield f"| {apart:g} | " + " | ".join(f"{false}, {100.0 * both:.1f} %" for false, both in cells) + " |"


def _pair(apart: float, ratio: float, blocks: int) -> tuple[int, float]:
    """Blocks with false codes, and share of blocks with both lamps flagged as twins."""
    rng = np.random.default_rng(12)
    hung = lamps(rng, TWINS_A * NADIR_A / TWINS_A[0])
    first = hung[0]
    far = {"current_a": ratio * first.current_a, "phase_chips": first.phase_chips + apart, "ppm": first.ppm + 0.001}
    world = Ceiling([*hung, replace(first, lamp_id=7, **far)], seed=12)
    drive, false, both = Drive(world), 0, 0
    for _ in range(blocks):
        _, epoch = drive.block()
        false += _strangers(world, epoch) > 0
        both += np.count_nonzero((epoch.ids == first.code) & ((epoch.flags & LinkFlag.TWIN) != 0)) == 2
    return false, both / blocks


def main() -> None:
    """Print a table, row by row."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=("pwm", "twins"))
    parser.add_argument("--blocks", type=int, default=2000, help="of each pair of twins")
    args = parser.parse_args()
    for row in pwm() if args.table == "pwm" else twins(args.blocks):
        print(row, flush=True)


if __name__ == "__main__":
    main()
