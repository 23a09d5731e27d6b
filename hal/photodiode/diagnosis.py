"""What it means when many blocks are bad: conditions of light, chip and adapter that one block does not prove."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from hal.adc import Clipping, Dark, Dazzled, NoSignal, RawSamples
from hal.errors import DataInvalid, DeviceFault, HalError
from hal.photodiode.block_check import Census
from hal.photodiode.chips import BlockChip

PERSISTS_S: Final = 1.0
"""A condition of the light is told when it has lasted this long."""
CLIPPED_SHARE: Final = 0.2
MISALIGNED_SHARE: Final = 0.02
GARBLED_BLOCKS: Final = 3
"""Blocks in a row that the chip cannot have sent, until the bus is opened anew and the chip looked at again."""
REFRESH_S: Final = 30.0
"""How often a converter that says one word only, for no known reason, is started afresh."""
DARK: Final = 0.005
DAZZLED: Final = 0.95
"""Of the DC channel's range between rest and saturation: 9 uA, some 60 lx, with the amplifier of docs/receiver.md."""

Level = Callable[[], float | None]
"""Mean light as a fraction of the amplifier's full scale; None where it is not known."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """On the latest block and those before it.

    Attributes:
        sound: the chip can have sent this block. error: what is wrong now. again: the chip has to be looked at again.
    """

    sound: bool
    error: HalError | None = None
    again: bool = False


@dataclass(slots=True)
class _Lasting:
    """For how long something has been so."""

    since: float | None = None

    def lasts(self, now: float, so: bool) -> bool:
        if not so:
            self.since = None
        elif self.since is None:
            self.since = now
        return self.since is not None and now - self.since >= PERSISTS_S


class Judge:
    """Watches the blocks of one converter, through all its streams.

    Args:
        device: the bus, for errors. chip, address: the converter. level: the DC channel.
    """

    def __init__(self, device: str, chip: BlockChip, address: int, level: Level) -> None:
        self._device, self._level = device, level
        self._where = f"{chip.name} at {address:#04x}"
        self._frozen, self._quiet, self._clipped = _Lasting(), _Lasting(), _Lasting()
        self._garbled = 0
        self._refreshed = float("-inf")

    def look(self, block: RawSamples, census: Census) -> Verdict:
        """Judge one more block."""
        if census.floated or census.misaligned > MISALIGNED_SHARE or block.words.size == 0:
            self._garbled += 1
            again = self._garbled >= GARBLED_BLOCKS
            return Verdict(sound=False, error=self._say_garbled(census) if again else None, again=again)
        self._garbled = 0
        frozen = self._frozen.lasts(block.t1, census.stuck or census.constant)
        quiet = self._quiet.lasts(block.t1, census.quiet)
        clipped = self._clipped.lasts(block.t1, census.clipped >= CLIPPED_SHARE)
        if frozen:
            return self._judge_frozen(block.t1, at_rail=census.clipped == 1.0)
        if quiet:
            return Verdict(sound=True, error=self._say_nothing(self._level(), frozen=False))
        return Verdict(sound=True, error=self._say_clipped() if clipped else None)

    def _judge_frozen(self, now: float, at_rail: bool) -> Verdict:
        level = self._level()
        explained = not at_rail and level is not None and (level >= DAZZLED or level <= DARK)
        again = not explained and now - self._refreshed >= REFRESH_S
        if again:
            self._refreshed = now
        error = self._say_at_rail() if at_rail else self._say_nothing(level, frozen=True)
        return Verdict(sound=True, error=error, again=again)

    def _say_garbled(self, census: Census) -> HalError:
        if census.floated:
            problem, remedy = "every bit reads 1: the bus floats", "check the converter's power, its ground, and SDA"
            return DeviceFault(self._device, f"{self._where}: {problem}", remedy)
        return DataInvalid(
            self._device,
            f"{self._where}: words with bits it keeps at zero",
            "another kind of chip, or bits lost on the bus: check chip, address, wiring and pull-ups",
        )

    def _say_clipped(self) -> HalError:
        return Clipping(
            self._device,
            f"{self._where}: more than {100 * CLIPPED_SHARE:.0f} % of the samples are at the rails",
            "too much modulated or flickering light: shade the photodiode or lower the gain",
        )

    def _say_at_rail(self) -> HalError:
        return NoSignal(
            self._device,
            f"{self._where}: every word is at the same rail",
            "check the wire from amplifier to converter, its supply, and that it is this kind of chip",
        )

    def _say_nothing(self, level: float | None, *, frozen: bool) -> HalError:
        """There is no signal: what that means depends on the mean light, and on whether the words move at all."""
        noun: type[NoSignal] = NoSignal
        if level is None:
            problem = "no signal: no light at all, or so much that the amplifier is saturated"
            problem += ", or a dead converter" if frozen else ""
            remedy = "look at photodiode and lamps; a DC channel (ADS1115) would tell which"
        elif level >= DAZZLED:
            noun = Dazzled
            problem, remedy = "dazzled: the amplifier is saturated", "shade the photodiode or lower the gain"
        elif level <= DARK:
            noun = Dark
            problem, remedy = "dark: no light reaches the photodiode", "look for a cover, a broken cable, lamps off"
        elif frozen:
            problem = "constant words, though there is light: the converter or its input is dead"
            remedy = "switch its power off and on; check the wire from amplifier to converter"
        else:
            problem = "there is light, but no lamp in it: nothing flickers"
            remedy = "look whether coded lamps are on and in view; check the coupling capacitor"
        return noun(self._device, f"{self._where}: {problem}", remedy)
