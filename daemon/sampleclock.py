"""The converter's sample clock, kept from one start to the next.

No bus runs at its nominal rate. The decoder finds by how much it is off, which takes seconds at the first start ever;
what it has found is kept in a small file, so that the next start sees lamps within a quarter of a second. The file is
a convenience: where it is missing, damaged or cannot be written, the clock is found anew.
"""

from __future__ import annotations

import json
import logging
import math
from pathlib import Path
from typing import Final

from daemon.config import PhotodiodeConfig
from daemon.folders import state_folder
from daemon.photodiode import profile_of

log = logging.getLogger(__name__)

FILE: Final = "sample-clock.json"
MOVED_PPM: Final = 20.0
"""A change that is worth writing: the decoder is content with 200 ppm."""


class SampleClock:
    """The stored sample clock of one converter.

    Attributes:
        ppm: error of the sample clock as stored, None while it is not known.
    """

    def __init__(self, config: PhotodiodeConfig, folder: Path | None = None) -> None:
        """Read what is stored for this converter on this bus; whatever is wrong with the file is said and passed over.

        Args:
            config: of the photodiode.
            folder: where it is kept; None: :func:`state_folder`.
        """
        self._path = (folder or state_folder()) / FILE
        self._key = f"{config.bus} {config.converter} {config.profile}"
        self._reach = profile_of(config).clock_ppm
        self._refused = False
        self.ppm = self._read().get(self._key)

    def learn(self, ppm: float | None) -> None:
        """Take in what the decoder has found; it is written if it is news. Never raises for what a disk can do."""
        if ppm is None or not self._possible(ppm) or (self.ppm is not None and abs(ppm - self.ppm) < MOVED_PPM):
            return
        self.ppm = ppm
        known = {**self._read(), self._key: round(ppm, 1)}
        beside = self._path.with_suffix(".part")
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            beside.write_text(json.dumps(known, indent=2) + "\n")
            beside.replace(self._path)
        except OSError as error:
            if not self._refused:
                log.warning("the sample clock cannot be kept in %s: %s; it is found anew", self._path, error.strerror)
            self._refused = True

    def _read(self) -> dict[str, float]:
        try:
            stored = json.loads(self._path.read_bytes())
            return {str(key): float(ppm) for key, ppm in stored.items() if self._possible(float(ppm))}
        except FileNotFoundError:
            return {}
        except OSError as error:
            log.warning("%s cannot be read: %s; the sample clock is found anew", self._path, error.strerror)
        except (ValueError, AttributeError, TypeError):
            log.warning("%s is damaged and passed over; the sample clock is found anew", self._path)
        return {}

    def _possible(self, ppm: float) -> bool:
        return math.isfinite(ppm) and abs(ppm) <= self._reach
