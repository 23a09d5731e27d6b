"""Tracks the confirmed and candidate lamps through one block: common delay, joint fit, bus stall, track update."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.cdma.acquisition import DOMINANCE, Job, Outcome, Search
from estimator.cdma.acquisition_budget import Watch
from estimator.cdma.air_interface import Profile
from estimator.cdma.bus_stall import judge, mend
from estimator.cdma.chip_pulse import Shape, pulse_energy
from estimator.cdma.code_tracking import CLEAR, Clocks, Life, Tracks
from estimator.cdma.data_bits import side_lobe
from estimator.cdma.epoch import BlockFlag, SampleBlock
from estimator.cdma.joint_fit import joint_fit
from estimator.cdma.mains_rejection import Mains
from estimator.cdma.sample_block import Fit, Prior, Sampled

Index = npt.NDArray[np.int64]

LEADERS: Final = 3
"""Number of strongest lamps that determine the common delay of a block's time base."""

LAG_VAR: Final = 0.05**2
"""Variance of that delay, chips^2."""

STAMP_MARGIN_S: Final = 120e-6
"""Margin of the delay search beyond the uncertainty of the block's two time stamps, s."""

PATIENCE: Final = 2
"""Noisy blocks in a row that are not learned from; a longer disturbance is permanent."""

CROSSED: Final = 0.1
"""Cross-correlation of partial code periods, rms."""

QUIET: Final = 1.2
"""Noise over its usual level up to which it is chance."""

SPURIOUS: Final = 0.01
"""Share of the strongest lamp's amplitude below which errors of the pulse shape can look like lamps."""


class Decoder:
    """State of the decoder of one photodiode; created by :func:`estimator.cdma.decoder.new_decoder`."""

    def __init__(self, profile: Profile, clock_ppm: float | None, hung: Collection[int] = ()) -> None:
        """``clock_ppm``: stored error of the sample clock, or None; ``hung``: codes of lamps in the building."""
        self.profile = profile
        self.shape = Shape(profile)
        self.mains = Mains(profile.sample_rate, profile.mains_harmonics)
        self.clocks = Clocks(profile, clock_ppm)
        self.tracks = Tracks(profile)
        self.search = Search(profile, hung)
        self.search.warm(round(profile.epoch_s * profile.sample_rate), self.clocks.clock)
        self.watch = Watch(self.search.codes)
        self.offered: Job | None = None
        self.found: Outcome | None = None
        self.barren = 0
        self.past = 0
        self.odd = 0
        self.noise = 0.0
        self.usual_noise = 0.0

    @property
    def clock_ppm(self) -> float | None:
        """Error of the sample clock, ppm, to be stored; None until a lamp has confirmed it."""
        return self.clocks.proven * 1e6 if self.clocks.known else None


@dataclass(eq=False)
class _Solved:
    """A block and its fit, with the prior and the delay (chips, predicted part included) that the fit started from."""

    block: Sampled
    prior: Prior
    lag: float
    fit: Fit


def follow(decoder: Decoder, block: SampleBlock, sampled: Sampled) -> tuple[BlockFlag, Sampled]:
    """Update all tracks with one block; returns its flags and the residual block.

    The tracks must already be predicted to the middle of the block.
    """
    tracks, clocks = decoder.tracks, decoder.clocks
    if not len(tracks.slots):
        clocks.rest()
        return BlockFlag.NONE, replace(sampled, y=sampled.clean)
    excess = max(block.t_end - block.t_begin - len(sampled.x) / block.rate * (1.0 + clocks.clock), 0.0)
    flags, solved = _solve(decoder, sampled, _find_lag(decoder, sampled, excess))
    noisy = bool(flags & BlockFlag.NOISY)
    if noisy and decoder.odd < PATIENCE:
        _weigh(decoder, solved.fit)
    elif not flags & BlockFlag.STALLED:
        _weigh(decoder, solved.fit)
        _read(decoder, solved)
        if solved.fit.clearest > CLEAR:  # otherwise no lamp is received, and the delay found is chance
            clocks.update(solved.lag + solved.fit.lag - float(clocks.state[0]), excess, solved.fit)
            tracks.learn_phases(tracks.slots, solved.fit)
        _live_and_die(decoder, solved, suspicious=noisy)
    if flags in (BlockFlag.NONE, BlockFlag.CLIPPED) and len(tracks.confirmed):
        decoder.shape.learn(solved.block, solved.prior, solved.fit)
    return flags, replace(solved.block, y=solved.fit.residual)


def _find_lag(decoder: Decoder, sampled: Sampled, excess: float) -> float:
    """Common delay of the block's time base, chips: the one with the best joint correlation of the strongest lamps."""
    tracks, clocks, profile = decoder.tracks, decoder.clocks, decoder.profile
    slots, predicted = tracks.slots, float(clocks.state[0])
    lit = slots[~tracks.faint(slots)]
    chosen = lit[np.argsort(-tracks.amplitude[lit])[:LEADERS]] if len(lit) else slots  # none received: all slots
    window = (STAMP_MARGIN_S + 0.5 * excess) * profile.chip_rate + 3.0 * float(np.sqrt(clocks.cov[0, 0]))
    lamps = (tracks.code[chosen], tracks.phase[chosen] + predicted, np.maximum(tracks.amplitude[chosen], 0.0))
    window = min(window, 0.4 * profile.length)
    return predicted + decoder.search.common_lag(sampled.clean, clocks.clock, lamps, window)


def _solve(decoder: Decoder, sampled: Sampled, lag: float) -> tuple[BlockFlag, _Solved]:
    """Joint fit of the block; if it does not explain the block, an attempt to correct a bus stall."""
    tracks, clocks, table = decoder.tracks, decoder.clocks, decoder.shape.table
    slots, span = tracks.slots, -float(sampled.x[0])

    def prior_at(more: float) -> Prior:
        """Prediction of the tracks at a common delay ``lag + more``, chips."""
        return tracks.prior(slots, lag + more, LAG_VAR, clocks.clock_var, span)

    prior = prior_at(0.0)
    fit = joint_fit(sampled, prior, table)
    solved = _Solved(sampled, prior, lag, fit)
    verdict = judge(sampled, fit, decoder.usual_noise)
    _listen(decoder, fit)
    if verdict.good or not len(tracks.confirmed):
        return BlockFlag.NONE, solved
    newcomers = bool(np.any(tracks.life[slots] == Life.TENTATIVE))
    if newcomers and not (verdict.bent or verdict.smooth):
        return BlockFlag.NOISY, solved  # the residual comes from the candidates
    mended = mend(sampled, fit, prior_at, table, decoder.mains, decoder.usual_noise)
    if isinstance(mended, bool):
        return BlockFlag.STALLED if mended else BlockFlag.NOISY, solved
    return BlockFlag.MENDED, _Solved(mended.block, mended.prior, lag + mended.lag, mended.fit)


def _listen(decoder: Decoder, fit: Fit) -> None:
    """Track the usual noise: a fall quickly, a rise slowly, so that single blocks do not count."""
    noise = float(np.sqrt(fit.noise_var))
    decoder.noise = noise
    if len(decoder.tracks.confirmed):
        usual = decoder.usual_noise or noise
        change = min(noise, 1.5 * usual) - usual
        decoder.usual_noise = usual + (0.1 if change > 0.0 else 0.5) * change


def _weigh(decoder: Decoder, fit: Fit) -> None:
    """Store the amplitudes. Excess residual adds to their variance: it may be a lamp, and codes are not orthogonal."""
    tracks, slots = decoder.tracks, decoder.tracks.slots
    excess = max(fit.noise_var - (QUIET * decoder.usual_noise) ** 2, 0.0) if decoder.usual_noise else 0.0
    crossed = CROSSED**2 * excess / pulse_energy(decoder.profile)
    tracks.weigh(slots, fit.amplitude, fit.amplitude_var + crossed)
    decoder.noise = float(np.sqrt(fit.noise_var))


def _read(decoder: Decoder, solved: _Solved) -> None:
    """Accumulate the data bits, and store data frames that are complete."""
    tracks, fit, slots = decoder.tracks, solved.fit, decoder.tracks.slots
    first = tracks.first_period(slots, solved.lag, -float(solved.block.x[0]))
    tracks.rings.add(slots, first, fit.soft, fit.soft_var)
    for slot, frame in tracks.rings.frames(slots, tracks.code[slots], first):
        tracks.frames[slot] = frame


def _live_and_die(decoder: Decoder, solved: _Solved, suspicious: bool) -> None:
    """Correct side-lobe tracking, confirm candidates, and drop lost lamps.

    Candidates are tested for side lobes; in suspicious blocks so are all lamps. A candidate must be stronger than the
    cross-correlation of a lamp that would explain the whole residual.
    """
    tracks, slots = decoder.tracks, decoder.tracks.slots
    doubtful = suspicious & (solved.fit.amplitude > CLEAR * np.sqrt(solved.fit.amplitude_var))  # only if received
    for k in np.flatnonzero((tracks.life[slots] == Life.TENTATIVE) | doubtful):
        beside = side_lobe(solved.block, solved.prior, solved.fit, int(k), decoder.shape.table)
        if beside:
            tracks.move(int(slots[k]), beside)
    hidden = DOMINANCE * float(np.sqrt(solved.fit.noise_var / pulse_energy(decoder.profile)))
    for slot in tracks.judge(slots, max(hidden, SPURIOUS * float(np.max(solved.fit.amplitude)))):
        tracks.life[slot] = Life.CONFIRMED
    if len(tracks.confirmed):
        decoder.clocks.prove()
        decoder.barren = 0
