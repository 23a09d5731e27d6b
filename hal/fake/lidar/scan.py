"""The contract of a scan source for the fake lidar: used by simulators, log converters and tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True, eq=False)
class FakeScan:
    """One revolution of the sensor. Arrays have one element per step, **steps 0 to AMAX** (AMAX + 1 elements).

    Elements below AMIN are ignored.

    Attributes:
        ranges_mm: int32, millimetres as the sensor would report them: values below DMIN are error codes, above DMAX
            no return. Sent bit for bit in MD; MS saturates at 4095.
        intensity: int32 or None (sent as 0).
        echoes_mm: int32 of shape (AMAX + 1, m), m <= 2: second and third echoes, 0 where there is none; or None.
        echo_intensity: like ``echoes_mm``; or None (sent as 0).
    """

    ranges_mm: npt.NDArray[np.int32]
    intensity: npt.NDArray[np.int32] | None = None
    echoes_mm: npt.NDArray[np.int32] | None = None
    echo_intensity: npt.NDArray[np.int32] | None = None


ScanSource = Callable[[float], FakeScan | None]
"""Called with the ``t_mono`` at which the sensor passes step 0 of a revolution; the beam of step s is measured
``s * period / ARES`` later. Called once for each requested revolution, in order of time, when the revolution is
complete. None: no data for this revolution (a log ended)."""
