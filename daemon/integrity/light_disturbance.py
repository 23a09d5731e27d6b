"""Disturbances of the light that the decoder corrects: each is logged once when it has lasted, with what to do."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Final

from daemon.snapshot import DimmedLamp
from estimator import BlockFlag, LightsResult

log = logging.getLogger(__name__)

LASTS_S: Final = 3.0
"""Time in s for which a disturbance must last."""
OVER_S: Final = 60.0
"""Time in s without a disturbance after which it is over, and logged anew."""
SAME: Final = 0.02
"""Relative difference of frequencies within which a PWM lamp is the same."""

_BLOCKS: Final = {
    BlockFlag.OVERDRIVEN: (
        "the photodiode's first stage is saturated part of the time: shade the photodiode or lower its gain"
    ),
    BlockFlag.UNEVEN: (
        "the photodiode's bus pauses at the same samples of every block: use an adapter that reads whole blocks"
    ),
}


@dataclass(slots=True)
class _Disturbance:
    """One disturbance: first and latest occurrence, s; whether it was logged."""

    since: float
    latest: float
    logged: bool = False


@dataclass(slots=True)
class LightDisturbances:
    """Logs PWM lamps, slow lamps, saturation of the first stage, and regular pauses of the bus."""

    _seen: dict[tuple[str, float], _Disturbance] = field(default_factory=dict)

    def on_result(self, t_mono: float, lights: LightsResult) -> None:
        """Update with the result of one block."""
        if not (lights.pwm or lights.slow or lights.block or self._seen):
            return
        for lamp in lights.pwm:
            known = [key for key in self._seen if key[0] == "pwm" and abs(key[1] / lamp.hertz - 1.0) < SAME]
            name = DimmedLamp(lamp.hertz, lamp.swing_a, lamp.other_hertz)
            text = f"{name} is in view: its light is taken out of the blocks"
            self._note(known[0] if known else ("pwm", lamp.hertz), t_mono, text)
        for code in sorted(lights.slow):
            text = f"the lamp with code {code} rises too slowly: its RSS is corrected; check its driver"
            self._note(("slow", float(code)), t_mono, text)
        for flag, text in _BLOCKS.items():
            if flag in lights.block:
                self._note(("block", float(flag)), t_mono, text)
        self._seen = {key: seen for key, seen in self._seen.items() if t_mono - seen.latest < OVER_S}

    def _note(self, key: tuple[str, float], t_mono: float, text: str) -> None:
        """Count one occurrence; log the disturbance when it has lasted."""
        seen = self._seen.setdefault(key, _Disturbance(t_mono, t_mono))
        if t_mono - seen.latest > LASTS_S:
            seen.since = t_mono
        seen.latest = t_mono
        if not seen.logged and t_mono - seen.since >= LASTS_S:
            seen.logged = True
            log.warning("%s", text)
