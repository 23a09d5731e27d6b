"""Stored sample clock error of the converter: a small file per converter, for the next start.

No bus runs at its nominal rate. The decoder finds the rate error, which takes seconds at the very first start. With the
stored value, the next start receives lamps within a quarter of a second.
The file is a convenience: where it is missing, damaged or cannot be written, the error is found again.
"""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from functools import partial
from pathlib import Path
from typing import Final

from daemon.config.paths import state_folder
from daemon.config.schema import PhotodiodeConfig
from daemon.devices.photodiode import profile_of
from daemon.system.atomic_file import defect_in, reason_of, write_whole
from daemon.system.patience import within
from daemon.system.regular_file import read_regular

log = logging.getLogger(__name__)

FILE: Final = "sample-clock.json"
MOVED_PPM: Final = 20.0
"""Change in ppm that is written; the decoder tolerates 200 ppm."""
RETRY_S: Final = 60.0
CLOSE_S: Final = 1.0
READ_S: Final = 2.0
"""Longest wait for the file at the start, s."""
MOST_BYTES: Final = 1 << 20
"""Largest size of the file in bytes."""


class SampleClock:
    """Stored sample clock error of one converter.

    Attributes:
        ppm: latest error of the sample clock, None while it is not available.
    """

    def __init__(self, config: PhotodiodeConfig, folder: Path | None = None) -> None:
        """Read the stored value for this converter on this bus; a defective file is logged and ignored.

        Args:
            config: of the photodiode.
            folder: of the file; None: :func:`state_folder`.
        """
        self._path = (folder or state_folder()) / FILE
        self._key = f"{config.bus} {config.converter} {config.profile}"
        self._reach = profile_of(config).clock_ppm
        self._refused = False
        self.ppm = self._kept = self._read().get(self._key)
        self._retry_at = -math.inf
        self._thread: threading.Thread | None = None

    def learn(self, ppm: float | None) -> None:
        """Update the value from the decoder; a thread writes a sufficient change.

        Returns at once; call it at any rate.
        """
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
        """Wait at most one second for a write in progress; idempotent."""
        if self._thread is not None and self._thread.is_alive():
            self._thread.join(CLOSE_S)

    def _write(self, ppm: float) -> None:
        """Write in a thread: a disk that hangs costs the stored value and nothing else."""
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            known = {**self._read(), self._key: round(ppm, 1)}
            write_whole(self._path, f"{json.dumps(known, indent=2)}\n".encode())
        except Exception as error:  # noqa: BLE001  it is logged, and the decoder finds the clock error again
            self._refuse(error)
        else:
            self._kept, self._refused = ppm, False

    def _refuse(self, error: Exception) -> None:
        if not self._refused:
            line = "cannot store the rate of the sample clock in %s: %s; the daemon tries again"
            log.warning(line, self._path, reason_of(error), exc_info=defect_in(error))
        self._refused, self._retry_at = True, time.monotonic() + RETRY_S

    def _read(self) -> dict[str, float]:
        try:
            stored = json.loads(within(READ_S, partial(read_regular, self._path, MOST_BYTES)))
            return {str(key): float(ppm) for key, ppm in stored.items() if self._possible(float(ppm))}
        except FileNotFoundError:
            return {}
        except OSError as error:
            log.warning("%s cannot be read: %s; the daemon measures the sample clock again", self._path, error.strerror)
        except (ValueError, AttributeError, TypeError, OverflowError, RecursionError):
            log.warning("%s is damaged and ignored; the daemon measures the sample clock again", self._path)
        return {}

    def _possible(self, ppm: float) -> bool:
        return math.isfinite(ppm) and abs(ppm) <= self._reach
