"""The light half of a step: the decoder and the `lights` filter of one photodiode, loaded only where there is one."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from estimator import cdma
from estimator.cdma_epoch import UNUSABLE, LightEpoch, LinkFlag, SampleBlock
from estimator.cdma_profile import PROFILE_A, Profile
from estimator.lamps import Survey
from estimator.records import Record
from estimator.result import Fix, LightsResult, Link, LinkState

NOTHING = LightsResult(
    t_mono=-math.inf,
    fix=Fix.NONE,
    T_map_base=np.zeros(3),
    covariance=np.zeros((3, 3)),
    links=(),
    accepted=frozenset(),
    gained=np.zeros((3, 3)),
    gained_by=np.zeros(3),
)
"""Before the first epoch."""


@dataclass(frozen=True, slots=True)
class LightsSetup:
    """A photodiode and what it looks at.

    Attributes:
        survey: the lamps and the receiver; without lamps in it, they have to describe themselves.
        profile: air interface and front end.
        clock_ppm: stored error of the sample clock, good to 200 ppm; None: not known yet.
    """

    survey: Survey = field(default_factory=Survey)
    profile: Profile = PROFILE_A
    clock_ppm: float | None = None


class Light:
    """What is known from light, without the laser.

    Attributes:
        setup: as given. decoder: of the photodiode's blocks. result: after the latest epoch.
    """

    def __init__(self, setup: LightsSetup) -> None:
        """Nothing seen yet; raises ValueError for a stored sample clock outside the profile's range."""
        self.setup = setup
        self.decoder = cdma.new_decoder(setup.profile, setup.clock_ppm)
        self.result = NOTHING

    def predict(self, record: Record) -> None:
        """Move the `lights` filter with the robot; it never hears of the laser."""

    def take(self, record: SampleBlock | LightEpoch) -> LightsResult:
        """Decode a block, if it is one, and take the epoch into the filter."""
        epoch = cdma.decode(self.decoder, record) if isinstance(record, SampleBlock) else record
        rows = zip(epoch.ids.tolist(), epoch.amplitude.tolist(), epoch.flags.tolist(), strict=True)
        links = [Link(code, None, _state(flag), amplitude) for code, amplitude, flag in rows]
        self.result = replace(
            NOTHING,
            t_mono=self.result.t_mono if epoch.block & UNUSABLE else epoch.t_end,
            links=tuple(sorted(links, key=lambda link: -link.amplitude)),
            block=epoch.block,
            clock_ppm=epoch.clock_ppm,
        )
        return self.result

    def look_on(self, codes: int) -> None:
        """Go on looking for lamps that are not followed yet, as far as this cycle can afford."""
        cdma.search(self.decoder, codes)


def _state(flag: int) -> LinkState:
    if flag & LinkFlag.FAINT:
        return LinkState.FAINT
    return LinkState.TWIN if flag & LinkFlag.TWIN else LinkState.UNSURVEYED
