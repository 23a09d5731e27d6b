"""The converter's sample clock, kept from one start to the next.

No bus runs at its nominal rate. The decoder finds by how much it is off, which takes seconds at the first start ever;
what it has found is kept in a small file, so that the next start sees lamps within a quarter of a second. The file is
a convenience: where it is missing, damaged or cannot be written, the clock is found anew.
"""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from pathlib import Path
from typing import Final

from daemon.config.paths import state_folder
from daemon.config.schema import PhotodiodeConfig
from daemon.devices.photodiode import profile_of
from daemon.system.atomic_file import defect_in, reason_of, write_whole

log = logging.getLogger(__name__)

FILE: Final = "sample-clock.json"
MOVED_PPM: Final = 20.0
"""A change that is worth writing: the decoder is content with 200 ppm."""
RETRY_S: Final = 60.0
CLOSE_S: Final = 1.0


class SampleClock:
    """The stored sample clock of one converter.

    Attributes:
        ppm: error of the sample clock as it was found last, None while it is not known.
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
        self.ppm = self._kept = self._read().get(self._key)
        self._retry_at = -math.inf
        self._thread: threading.Thread | None = None

    def learn(self, ppm: float | None) -> None:
        """Take in what the decoder has found, again and again; if it is news, a thread writes it. Returns at once."""
        if ppm is not None and self._possible(ppm) and (self.ppm is None or abs(ppm - self.ppm) >= MOVED_PPM):
            self.ppm = ppm
        busy = self._thread is not None and self._thread.is_alive()
        if self.ppm is None or self.ppm == self._kept or busy or time.monotonic() < self._retry_at:
            return
        self._thread = threading.Thread(target=self._write, args=(self.ppm,), name="lumiloop-clock", daemon=True)
        try:
            self._thread.start()
        except RuntimeError as error:
            self._refuse(error)

    def close(self) -> None:
        """Wait for what is being written, for a second at most; idempotent."""
        if self._thread is not None and self._thread.is_alive():
            self._thread.join(CLOSE_S)

    def _write(self, ppm: float) -> None:
        """In the thread: a disk that hangs costs the memory of the clock and nothing else."""
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            known = {**self._read(), self._key: round(ppm, 1)}
            write_whole(self._path, f"{json.dumps(known, indent=2)}\n".encode())
        except Exception as error:  # noqa: BLE001  it is told, and the decoder finds the clock anew
            self._refuse(error)
        else:
            self._kept, self._refused = ppm, False

    def _refuse(self, error: Exception) -> None:
        if not self._refused:
            line = "the sample clock cannot be kept in %s: %s; it is tried again"
            log.warning(line, self._path, reason_of(error), exc_info=defect_in(error))
        self._refused, self._retry_at = True, time.monotonic() + RETRY_S

    def _read(self) -> dict[str, float]:
        try:
            stored = json.loads(self._path.read_bytes())
            return {str(key): float(ppm) for key, ppm in stored.items() if self._possible(float(ppm))}
        except FileNotFoundError:
            return {}
        except OSError as error:
            log.warning("%s cannot be read: %s; the sample clock is found anew", self._path, error.strerror)
        except (ValueError, AttributeError, TypeError, OverflowError, RecursionError):
            log.warning("%s is damaged and passed over; the sample clock is found anew", self._path)
        return {}

    def _possible(self, ppm: float) -> bool:
        return math.isfinite(ppm) and abs(ppm) <= self._reach
