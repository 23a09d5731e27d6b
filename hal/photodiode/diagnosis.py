"""Diagnosis over many blocks: light, chip and adapter conditions that a single block cannot prove."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from hal.adc import Clipping, Dark, Dazzled, NoSignal, RawSamples
from hal.errors import DataInvalid, DeviceFault, HalError
from hal.photodiode.block_check import BlockDefects
from hal.photodiode.chips import BlockChip

PERSISTS_S: Final = 1.0
"""A light condition is reported after it has lasted this long."""
CLIPPED_SHARE: Final = 0.2
MISALIGNED_SHARE: Final = 0.02
GARBLED_BLOCKS: Final = 3
"""Consecutive impossible blocks after which the bus is reopened and the chip identified again."""
REFRESH_S: Final = 30.0
"""Interval of restarts of a converter that repeats one word for no known reason."""
DARK: Final = 0.005
DAZZLED: Final = 0.95
"""Shares of the DC channel's range; DARK is 9 uA, about 60 lx, with the amplifier of docs/receiver.md."""

Level = Callable[[], float | None]
"""Mean light as a fraction of the amplifier's full scale; None where unknown."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """The result for the latest block and those before it.

    Attributes:
        sound: the chip can have sent this block. error: the present condition. again: identify the chip again.
    """

    sound: bool
    error: HalError | None = None
    again: bool = False


@dataclass(slots=True)
class _Lasting:
    """Duration of a condition."""

    since: float | None = None

    def lasts(self, now: float, so: bool) -> bool:
        if not so:
            self.since = None
        elif self.since is None:
            self.since = now
        return self.since is not None and now - self.since >= PERSISTS_S


class BlockDiagnosis:
    """Diagnoses the blocks of one converter, across reconnects.

    Args:
        device: the bus, for errors. chip, address: the converter. level: returns the mean light of the DC channel.
    """

    def __init__(self, device: str, chip: BlockChip, address: int, level: Level) -> None:
        self._device, self._level = device, level
        self._where = f"{chip.name} at {address:#04x}"
        self._frozen, self._quiet, self._clipped = _Lasting(), _Lasting(), _Lasting()
        self._garbled = 0
        self._refreshed = float("-inf")

    def add(self, block: RawSamples, defects: BlockDefects) -> Verdict:
        """Add one block and return the diagnosis."""
        if defects.floated or defects.misaligned > MISALIGNED_SHARE or block.words.size == 0:
            self._garbled += 1
            again = self._garbled >= GARBLED_BLOCKS
            return Verdict(sound=False, error=self._garbled_error(defects) if again else None, again=again)
        self._garbled = 0
        frozen = self._frozen.lasts(block.t1, defects.stuck or defects.constant)
        quiet = self._quiet.lasts(block.t1, defects.quiet)
        clipped = self._clipped.lasts(block.t1, defects.clipped >= CLIPPED_SHARE)
        if frozen:
            return self._diagnose_frozen(block.t1, at_rail=defects.clipped == 1.0)
        if quiet:
            return Verdict(sound=True, error=self._nothing_error(self._level(), frozen=False))
        return Verdict(sound=True, error=self._clipped_error() if clipped else None)

    def _diagnose_frozen(self, now: float, at_rail: bool) -> Verdict:
        level = self._level()
        explained = not at_rail and level is not None and (level >= DAZZLED or level <= DARK)
        again = not explained and now - self._refreshed >= REFRESH_S
        if again:
            self._refreshed = now
        error = self._at_rail_error() if at_rail else self._nothing_error(level, frozen=True)
        return Verdict(sound=True, error=error, again=again)

    def _garbled_error(self, defects: BlockDefects) -> HalError:
        if defects.floated:
            problem, remedy = "every bit reads 1: the bus floats", "check the converter's power, its ground, and SDA"
            return DeviceFault(self._device, f"{self._where}: {problem}", remedy)
        what = (
            ("data words without their highest bits")
            if defects.lost_bits
            else "data words with bits that it keeps at zero"
        )
        return DataInvalid(
            self._device,
            f"{self._where}: {what}",
            "check converter type, address, wiring and pull-ups",
        )

    def _clipped_error(self) -> HalError:
        return Clipping(
            self._device,
            f"{self._where}: more than {100 * CLIPPED_SHARE:.0f} % of the samples are at the limits of the converter",
            "reduce modulated or flickering light: shade the photodiode or lower the gain",
        )

    def _at_rail_error(self) -> HalError:
        return NoSignal(
            self._device,
            f"{self._where}: every data word is at the same limit of the converter",
            "check the wire from amplifier to converter, its supply, and the converter type",
        )

    def _nothing_error(self, level: float | None, *, frozen: bool) -> HalError:
        """The error of a missing signal; its cause follows from the mean light, and from whether the words change."""
        kind: type[NoSignal] = NoSignal
        if level is None:
            problem = "no signal: no light, or so much that the amplifier is saturated"
            problem += ", or a defective converter" if frozen else ""
            remedy = "check photodiode and lamps; a DC channel (ADS1115) distinguishes the causes"
        elif level >= DAZZLED:
            kind = Dazzled
            problem, remedy = (
                ("saturated: there is too much light for the amplifier"),
                "shade the photodiode or lower the gain",
            )
        elif level <= DARK:
            kind = Dark
            problem, remedy = (
                "dark: no light reaches the photodiode",
                ("check for a cover, a broken cable, and lamps that are off"),
            )
        elif frozen:
            problem = "constant data words in spite of light: the converter or its input is defective"
            remedy = "switch its power off and on; check the wire from amplifier to converter"
        else:
            problem = "there is light, but no modulated light"
            remedy = "check that coded lamps are on and in view; check the coupling capacitor"
        return kind(self._device, f"{self._where}: {problem}", remedy)
