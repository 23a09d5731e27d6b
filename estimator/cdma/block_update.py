"""Tracks the confirmed and candidate lamps through one block: common delay, joint fit, bus stall, track update."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.cdma.acquisition import BIN, DOMINANCE, Job, Outcome, Search
from estimator.cdma.acquisition_budget import Watch
from estimator.cdma.air_interface import Profile
from estimator.cdma.anomalies.residual_colour import Colour
from estimator.cdma.anomalies.saturation import unsteadiness
from estimator.cdma.anomalies.slow_lamps import SlowLamps
from estimator.cdma.anomalies.time_base import TimeBase
from estimator.cdma.anomalies.twin import find_twin
from estimator.cdma.bus_stall import judge, mend
from estimator.cdma.chip_pulse import Shape, pulse_energy
from estimator.cdma.code_tracking import CAPACITY, CLEAR, Clocks, Life, Tracks
from estimator.cdma.data_bits import side_lobe
from estimator.cdma.epoch import USUAL, BlockFlag, SampleBlock
from estimator.cdma.interference.background import Background
from estimator.cdma.joint_fit import joint_fit
from estimator.cdma.sample_block import Fit, Prior, Sampled

Index = npt.NDArray[np.int64]

LEADERS: Final = 3
"""Number of strongest lamps that determine the common delay of a block's time base."""

LAG_VAR: Final = 0.05**2
"""Variance of that delay, chips^2."""

STAMP_MARGIN_S: Final = 120e-6
"""Margin of the delay search beyond the uncertainty of the block's two time stamps, s."""

TOO_LONG_S: Final = 2.0 * STAMP_MARGIN_S
"""Excess of the time between a block's stamps over that of its samples from which it contains pauses, s."""

BETTER_CLOCK: Final = 1.1
"""Correlation with another sample clock, over that with the present one, from which it is taken."""

PATIENCE: Final = 2
"""Noisy or stalled blocks in a row that are not learned from; a longer disturbance is permanent."""

CROSSED: Final = 0.1
"""Cross-correlation of partial code periods, rms."""

QUIET: Final = 1.2
"""Noise over its usual level up to which it is chance."""

SPURIOUS: Final = 0.01
"""Share of the strongest lamp's amplitude below which errors of the pulse shape can look like lamps."""

RESTED: Final = 3
"""Blocks after a twin was found until the next test: the twin is judged, and all lamps are tracked meanwhile."""

SOON, UNTESTED = 4, 32
"""Blocks without a candidate, after that, until the next test if the residual contains chips; the number doubles up to
the second one while no twin is found.
"""

ASTRAY: Final = 0.3
"""Share of its twin's amplitude below which a lamp has been followed at a wrong phase, and is dropped."""

UNKNOWN_PAUSES: Final = 0.5
"""Relative sigma of all amplitudes in blocks that take too long, while it is not known where the bus pauses."""

_TENTATIVE, _UNUSUAL, _STALLED = int(Life.TENTATIVE), ~int(USUAL), int(BlockFlag.STALLED)
_MENDED, _NOISY, _CLIPPED = int(BlockFlag.MENDED), int(BlockFlag.NOISY), int(BlockFlag.CLIPPED)
"""Flags as plain numbers: enum operations are slow."""


class Decoder:
    """State of the decoder of one photodiode; created by :func:`estimator.cdma.decoder.new_decoder`.

    Attributes:
        noise, usual_noise: residual of the last block, rms, and its usual level beside confirmed lamps; ADC steps.
        offered: block for the next sweep of the search. found: outcome of the last sweep, not yet taken.
        barren: sweeps since a lamp was last confirmed. past, stalled, odd: blocks in a row with an earlier time, with a
            stall, and noisy or stalled.
        untested, interval: blocks since the last test for twins, and without a candidate until the next one.
    """

    def __init__(self, profile: Profile, clock_ppm: float | None, hung: Collection[int] = ()) -> None:
        """``clock_ppm``: stored error of the sample clock, or None; ``hung``: codes of lamps in the building."""
        self.profile = profile
        self.shape = Shape(profile, CAPACITY)
        self.background = Background(profile)
        self.clocks = Clocks(profile, clock_ppm)
        self.tracks = Tracks(profile)
        self.search = Search(profile, hung)
        self.search.warm(round(profile.epoch_s * profile.sample_rate), self.clocks.clock)
        self.watch = Watch(self.search.codes)
        self.offered: Job | None = None
        self.found: Outcome | None = None
        self.barren = 0
        self.past = 0
        self.stalled = 0
        self.time_base = TimeBase()
        self.slow_lamps = SlowLamps(profile, CAPACITY)
        self.colour = Colour()
        self.untested, self.interval = RESTED, SOON
        self.odd = 0
        self.noise = 0.0
        self.usual_noise = 0.0

    @property
    def clock_ppm(self) -> float | None:
        """Error of the sample clock, ppm, to be stored; None until a lamp has confirmed it."""
        return self.clocks.proven * 1e6 if self.clocks.known else None


@dataclass(eq=False)
class _Solved:
    """A block and its fit, with the slots, the prior and the delay (chips, predicted part included) it started from."""

    block: Sampled
    slots: Index
    prior: Prior
    lag: float
    fit: Fit
    newcomers: bool


def follow(decoder: Decoder, block: SampleBlock, sampled: Sampled) -> tuple[BlockFlag, Sampled]:
    """Update all tracks with one block; returns its flags and the residual block.

    The tracks must already be predicted to the middle of the block.
    """
    tracks, clocks = decoder.tracks, decoder.clocks
    tracks.merge_twins()
    took, nominal = block.t_end - block.t_begin, len(sampled.x) / decoder.profile.sample_rate
    excess = max(took - nominal * (1.0 + clocks.clock), 0.0)
    clocks.measure(took / nominal - 1.0)
    unknown = 0.0 if clocks.known else decoder.profile.clock_ppm * 1e-6 * took
    decoder.time_base.on_stamps(excess - unknown > TOO_LONG_S)
    if not len(tracks.slots):
        clocks.rest()
        decoder.background.learn(sampled.y, sampled.clean)
        decoder.colour.learn(sampled.clean)
        return BlockFlag.NONE, replace(sampled, y=sampled.clean)
    if decoder.time_base.contradicted:
        sampled = _try_clocks(decoder, sampled, excess)
    lag, _ = _find_lag(decoder, sampled, excess, clocks.clock)
    flags, solved = _solve(decoder, sampled, lag)
    found = int(flags)
    noisy, stalled = bool(found & _NOISY), bool(found & _STALLED)
    decoder.stalled = decoder.stalled + 1 if stalled else 0
    unsteady = unsteadiness(solved.block.y, solved.fit)
    if unsteady:
        flags, found = flags | BlockFlag.OVERDRIVEN, found | int(BlockFlag.OVERDRIVEN)
    if decoder.time_base.unknown:
        unsteady = max(unsteady, UNKNOWN_PAUSES)
    if _add_twin(decoder, solved, found, unsteady):
        return flags, replace(solved.block, y=np.zeros_like(solved.fit.residual))
    if noisy and decoder.odd < PATIENCE:
        _weigh(decoder, solved, unsteady)
    elif not stalled or decoder.stalled > PATIENCE:
        _weigh(decoder, solved, unsteady)
        _read(decoder, solved)
        if solved.fit.clearest > CLEAR:  # otherwise no lamp is received, and the delay found is chance
            clocks.update(solved.lag + solved.fit.lag - float(clocks.state[0]), excess, solved.fit)
            tracks.learn_phases(solved.slots, solved.fit)
        _update_life_cycle(decoder, solved, suspicious=noisy)
    if not found & (_STALLED | _MENDED):
        decoder.background.learn_beyond(solved.fit)
        decoder.colour.learn(solved.fit.residual)
    lasting = (not noisy or decoder.odd >= PATIENCE) and not (tracks.shared and solved.newcomers)  # a twin on trial
    if lasting and not found & ~(_CLIPPED | _NOISY) and len(tracks.confirmed):
        codes = tracks.code[solved.slots]
        decoder.slow_lamps.learn(solved.block, solved.prior, solved.fit, decoder.shape, codes, solved.slots)
    return flags, replace(solved.block, y=solved.fit.residual)


def _add_twin(decoder: Decoder, solved: _Solved, flags: int, unsteady: float) -> bool:
    """Look for a twin of a lamp where there may be one, and add it; returns whether there was one.

    Candidates are dropped then: they may be cross-correlations of it.
    """
    tracks = decoder.tracks
    decoder.untested += 1
    if decoder.untested <= RESTED or flags & _MENDED:
        return False
    if not (flags & _UNUSUAL or solved.newcomers):
        if decoder.untested < RESTED + decoder.interval or not decoder.colour.coloured:
            return False
        decoder.interval = min(2 * decoder.interval, UNTESTED)
    slots = solved.slots
    trying = tracks.life[slots] == _TENTATIVE
    twin = find_twin(solved.block, solved.prior, solved.fit, decoder.shape, decoder.profile)
    if twin is None:
        decoder.untested = RESTED
        return False
    decoder.untested, decoder.interval = 0, SOON
    first = int(slots[twin.lamp])
    _weigh(decoder, solved, unsteady)
    for slot in slots[trying & (slots != first) & (tracks.code[slots] != tracks.code[first])].tolist():
        tracks.drop(slot)
    shift = float(solved.fit.phase[twin.lamp]) + solved.lag + solved.fit.lag - float(decoder.clocks.state[0])
    tracks.add_twin(first, twin.second + shift, twin.amplitude)
    if twin.first_amplitude < ASTRAY * twin.amplitude:  # the lamp has been followed at a wrong phase
        tracks.drop(first)
    else:
        tracks.shift(first, twin.first + shift)
    decoder.offered = None
    return True


def _try_clocks(decoder: Decoder, sampled: Sampled, excess: float) -> Sampled:
    """Change to a sample clock nearer to the time stamps if the strongest lamps correlate better with it.

    The lamps keep their phases in the middle of a block. Returns the block with the times of the clock chosen.
    """
    clocks, before = decoder.clocks, decoder.clocks.clock
    trials = before + BIN * np.arange(max(math.ceil((clocks.stretch - before) / BIN), 0) + 1)
    score = [_find_lag(decoder, sampled, excess, clock)[1] for clock in trials.tolist()]
    best = int(np.argmax(score))
    if score[best] < BETTER_CLOCK * score[0]:
        return sampled
    clocks.clock = float(trials[best])
    clocks.doubt()
    decoder.time_base.forget()
    return replace(sampled, x=sampled.x * (1.0 + clocks.clock) / (1.0 + before))


def _find_lag(decoder: Decoder, sampled: Sampled, excess: float, clock: float) -> tuple[float, float]:
    """Common delay of the block's time base, chips, by the best joint correlation of the strongest lamps, and that."""
    tracks, clocks, profile = decoder.tracks, decoder.clocks, decoder.profile
    slots, predicted = tracks.slots, float(clocks.state[0])
    lit = slots[~tracks.faint(slots)]
    window = (STAMP_MARGIN_S + 0.5 * excess) * profile.chip_rate + 3.0 * float(np.sqrt(clocks.cov[0, 0]))
    if tracks.shared:
        lit, window = tracks.unambiguous(lit, window)
    chosen = lit[np.argsort(-tracks.amplitude[lit])[:LEADERS]] if len(lit) else slots  # none received: all slots
    lamps = (tracks.code[chosen], tracks.phase[chosen] + predicted, np.maximum(tracks.amplitude[chosen], 0.0))
    window = min(window, 0.4 * profile.length)
    lag, correlation = decoder.search.common_lag(sampled.clean, clock, lamps, window)
    return predicted + lag, correlation


def _solve(decoder: Decoder, sampled: Sampled, lag: float) -> tuple[BlockFlag, _Solved]:
    """Joint fit of the block; if it does not explain the block, an attempt to correct a bus stall."""
    tracks, clocks, tables = decoder.tracks, decoder.clocks, decoder.shape.tables
    slots, span = tracks.slots, -float(sampled.x[0])
    pulse = decoder.slow_lamps.pulse(slots, tracks.code[slots], decoder.shape)

    def prior_at(more: float) -> Prior:
        """Prediction of the tracks at a common delay ``lag + more``, chips."""
        return tracks.prior(slots, lag + more, (LAG_VAR, clocks.clock_var), span, pulse)

    prior = prior_at(0.0)
    fit = joint_fit(sampled, prior, tables)
    if decoder.background.refine(fit.residual + fit.nuisance):
        rows = decoder.background.masked(np.arange(len(sampled.y), dtype=np.float64), sampled.mask)
        sampled = Sampled(sampled.y, sampled.x, sampled.mask, rows)
        fit = joint_fit(sampled, prior, tables)
    verdict = judge(sampled, fit, decoder.usual_noise)
    if verdict.skewed:
        clocks.doubt()
        prior = prior_at(0.0)
        fit = joint_fit(sampled, prior, tables)
        verdict = judge(sampled, fit, decoder.usual_noise)
    confirmed = len(tracks.confirmed)
    newcomers = confirmed < len(slots)
    solved = _Solved(sampled, slots, prior, lag, fit, newcomers)
    _track_noise(decoder, fit, confirmed > 0)
    if confirmed:
        decoder.time_base.learn(fit.mixed_slope, fit.residual, fit.noise_var)
    if verdict.good or not confirmed:
        return BlockFlag.NONE, solved
    if newcomers and not (verdict.bent or verdict.smooth):
        return BlockFlag.NOISY, solved  # the residual comes from the candidates
    mended = mend(sampled, fit, prior_at, tables, decoder.background, decoder.usual_noise)
    if isinstance(mended, bool) and verdict.slight:
        return BlockFlag.NONE, solved
    if isinstance(mended, bool):
        return BlockFlag.STALLED if mended else BlockFlag.NOISY, solved
    if mended.block.steps and (confirmed >= LEADERS or not newcomers):
        pause = mended.block.x - sampled.x
        decoder.time_base.on_pause(mended.block.steps[0], float(pause[-1] + mended.fit.steps[0]))
    return BlockFlag.MENDED, _Solved(mended.block, slots, mended.prior, lag + mended.lag, mended.fit, newcomers)


def _track_noise(decoder: Decoder, fit: Fit, confirmed: bool) -> None:
    """Track the usual noise beside confirmed lamps: a fall quickly, a rise slowly: single blocks do not count."""
    noise = float(np.sqrt(fit.noise_var))
    decoder.noise = noise
    if confirmed:
        usual = decoder.usual_noise or noise
        change = min(noise, 1.5 * usual) - usual
        decoder.usual_noise = usual + (0.1 if change > 0.0 else 0.5) * change


def _weigh(decoder: Decoder, solved: _Solved, unsteady: float) -> None:
    """Store the amplitudes. Excess residual adds to their variance: it may be a lamp, and codes are not orthogonal.

    ``unsteady``: relative change of all amplitudes within the block, rms; it adds likewise.
    """
    slots, fit = solved.slots, solved.fit
    excess = max(fit.noise_var - (QUIET * decoder.usual_noise) ** 2, 0.0) if decoder.usual_noise else 0.0
    crossed = CROSSED**2 * excess / pulse_energy(decoder.profile)
    relative_var = unsteady**2 + decoder.slow_lamps.spread(slots, decoder.shape)
    decoder.tracks.weigh(slots, fit.amplitude, fit.amplitude_var + crossed, relative_var)
    decoder.noise = float(np.sqrt(fit.noise_var))


def _read(decoder: Decoder, solved: _Solved) -> None:
    """Accumulate the data bits, and store data frames that are complete."""
    tracks, fit, slots = decoder.tracks, solved.fit, solved.slots
    first = tracks.first_period(slots, solved.lag, -float(solved.block.x[0]))
    tracks.rings.add(slots, first, fit.soft, fit.soft_var)
    for slot, frame in tracks.rings.frames(slots, tracks.code[slots], first):
        tracks.frames[slot] = frame


def _update_life_cycle(decoder: Decoder, solved: _Solved, suspicious: bool) -> None:
    """Correct side-lobe tracking, confirm candidates, and drop lost lamps.

    Candidates are tested for side lobes; in suspicious blocks so are all lamps. A candidate must be stronger than the
    cross-correlation of a lamp that would explain the whole residual.
    """
    tracks, slots = decoder.tracks, solved.slots
    doubtful = suspicious & (solved.fit.amplitude > CLEAR * np.sqrt(solved.fit.amplitude_var))  # only if received
    for k in np.flatnonzero((tracks.life[slots] == Life.TENTATIVE) | doubtful):
        beside = side_lobe(solved.block, solved.prior, solved.fit, int(k), decoder.shape.tables)
        if beside:
            tracks.move(int(slots[k]), beside)
    hidden = DOMINANCE * float(np.sqrt(solved.fit.noise_var / pulse_energy(decoder.profile)))
    for slot in tracks.judge(slots, max(hidden, SPURIOUS * float(np.max(solved.fit.amplitude)))):
        tracks.life[slot] = Life.CONFIRMED
    if len(tracks.confirmed):
        decoder.clocks.prove()
        decoder.barren = 0
