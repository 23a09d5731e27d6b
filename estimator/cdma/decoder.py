"""CDMA decoder: ADC sample blocks to lamp IDs and RSS.

Use::

    decoder = new_decoder(PROFILE_A, clock_ppm=stored)   # None: the sample clock is not known yet
    epoch = decode(decoder, block)                       # once per block
    search(decoder, codes=129)                           # once per cycle, as much as the cycle can afford

`decode` tracks the lamps already acquired; `search` acquires others in slices. Neither reads a clock.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Final

import numpy as np

from estimator.cdma.acquisition import BIN, Found, Job
from estimator.cdma.air_interface import Profile
from estimator.cdma.anomalies.saturation import saturated
from estimator.cdma.block_update import SPURIOUS, Decoder, follow
from estimator.cdma.epoch import UNUSABLE, USUAL, BlockFlag, LightEpoch, LinkFlag, PwmLight, SampleBlock
from estimator.cdma.sample_block import Sampled
from estimator.numerics.arrays import Array

LONGEST: Final = 10
"""Longest block, in code periods."""

CLIP_SHARE: Final = 0.2
"""Share of clipped samples above which a block is unusable."""
STILL_SHARE: Final = 0.6
"""Share of masked samples, those of a saturated first stage included, above which a block is unusable."""
RAIL: Final = 1.0 / 128.0
"""Share of the range beside either rail that counts as the rail: amplifiers stop up to 25 mV short of 3.3 V."""

RATE: Final = 0.05
"""Largest relative difference between a block's nominal rate and the profile's."""

NEW_CLOCK: Final = 4
"""Blocks in a row with earlier times until they count as a new time base."""

STORED_PPM: Final = 200.0
"""Accuracy of a stored sample clock, ppm."""

REFINING, PEELING, TAKING = 80, 45, 4
"""Costs in codes that could be searched meanwhile: `REFINING` a sample clock, `PEELING` lamps off a block, and adding
one candidate.
"""

AGAIN: Final = 2
"""Repeated searches of a block after subtracting the lamps found in it."""

NAMED_A: Final = 0.3e-6
"""Swing of a PWM lamp (A) from which it is named: weaker lines may be harmonics of the mains."""

_DISTURBED, _ODD = ~int(BlockFlag.UNEVEN | BlockFlag.OVERDRIVEN), int(BlockFlag.STALLED | BlockFlag.NOISY)
_UNUSUAL, _UNUSABLE = ~int(USUAL), int(UNUSABLE)
_FAINT, _TWIN, _SLOW = int(LinkFlag.FAINT), int(LinkFlag.TWIN), int(LinkFlag.SLOW)
"""Flags as plain numbers: enum operations are slow."""

FULL_ROUND: Final = 8
"""Sweeps without a confirmed lamp until all sample clocks are tried."""


def new_decoder(profile: Profile, clock_ppm: float | None = None, hung: Collection[int] = ()) -> Decoder:
    """Decoder without any lamps yet.

    Args:
        profile: air interface and front end.
        clock_ppm: stored error of the sample clock, good to 200 ppm; None: search the whole range of the profile.
        hung: codes of the lamps in the building, as far as known; empty: any. When nothing indicates further lamps,
            these are searched more often than others.

    Raises:
        ValueError: a stored clock outside the profile's range.
    """
    if clock_ppm is not None and not abs(clock_ppm) <= profile.clock_ppm + STORED_PPM:
        raise ValueError(f"clock_ppm = {clock_ppm} is outside +-{profile.clock_ppm:g}: delete the stored value")
    return Decoder(profile, clock_ppm, hung)


def decode(decoder: Decoder, block: SampleBlock) -> LightEpoch:
    """Track all known lamps through one block and return their links. Never raises, whatever the block contains.

    Blocks must be in order of time. An earlier one is malformed; several in a row are a new time base.
    """
    sampled, flags = _prepare(decoder, block)
    if sampled is not None and not _onward(decoder, block):
        sampled, flags = None, BlockFlag.MALFORMED
    if sampled is not None:
        t_middle = 0.5 * (block.t_begin + block.t_end)
        decoder.clocks.predict(decoder.tracks.predict(t_middle))
        more, residual = follow(decoder, block, sampled)
        flags |= more
        found = int(flags)
        if not found & _DISTURBED:
            decoder.background.learn_mains(sampled.y, sampled.mask)
        decoder.odd = decoder.odd + 1 if found & _ODD else 0
        if decoder.odd != 1:  # the residual of one block may be a stall; if the next repeats it, it is a lamp
            _offer(decoder, residual, t_middle)
        _watch(decoder, found)
    return _epoch(decoder, block, flags)


def _onward(decoder: Decoder, block: SampleBlock) -> bool:
    """Whether the block is later than the last. After a permanent step back, all lamps are dropped."""
    tracks = decoder.tracks
    forward = 0.5 * (block.t_begin + block.t_end) > tracks.t
    decoder.past = 0 if forward else decoder.past + 1
    if decoder.past < NEW_CLOCK:
        return forward
    for slot in tracks.slots:
        tracks.drop(int(slot))
    tracks.t, decoder.past, decoder.offered, decoder.found = -np.inf, 0, None, None
    return True


def search(decoder: Decoder, codes: int) -> None:
    """Search for further lamps, with the effort of ``codes`` codes (6 us each with profile A).

    Other work counts as an equivalent number of codes, or has a call of its own. While nothing indicates further lamps,
    a small part of the effort is used: estimator/cdma/acquisition_budget.py.
    """
    later = decoder.shape.renew()
    if later is not None:
        decoder.tracks.phase += later * decoder.profile.chip_rate  # where the old pulse was found
    allowed = decoder.watch.allow(codes)
    decoder.watch.spend(allowed - _search(decoder, allowed))


def _search(decoder: Decoder, codes: int) -> int:
    """Spend the effort on searching; returns the rest, negative if the last step exceeded it."""
    while codes > 0:
        if decoder.found is not None:
            found, decoder.found = decoder.found, None
            codes -= _take(decoder, *found)
        elif decoder.search.idle and not _begin(decoder):
            break
        else:
            codes = _sweep(decoder, codes)
    return codes


def _begin(decoder: Decoder) -> bool:
    """Start to search the last offered block, if there is one."""
    clocks = _trial_clocks(decoder) if decoder.offered else []
    if decoder.offered is None:
        return False
    decoder.search.start(decoder.offered, clocks, slow=decoder.watch.calm and len(clocks) == 1)
    decoder.offered = None
    decoder.barren *= len(clocks) == 1
    return True


def _sweep(decoder: Decoder, codes: int) -> int:
    """Continue the sweep; returns the rest of the effort."""
    left, done = decoder.search.step(codes)
    if done is not None:
        decoder.barren += 1
        decoder.watch.on_sweep(len(done[-1]))
        decoder.found = done if done[-1] else None
    return left


def _trial_clocks(decoder: Decoder) -> list[float]:
    """Clocks to try: the known one alone, or the whole range.

    The range is used while none is known, and again when the known one confirms no lamp. It reaches beyond that of the
    profile if the time stamps show that the bus pauses.
    """
    tracks, clocks = decoder.tracks, decoder.clocks
    if (clocks.known or clocks.guess is not None or len(tracks.slots)) and decoder.barren < FULL_ROUND:
        return [clocks.clock]
    clocks.guess = None
    if len(tracks.slots):  # candidates that were not confirmed: start from a block without them
        for slot in tracks.slots:
            tracks.drop(int(slot))
        decoder.offered = None
    reach = round(decoder.profile.clock_ppm * 1e-6 / BIN)
    slowest = max(reach, math.ceil(clocks.stretch / BIN))
    return [k * BIN for k in range(-reach, slowest + 1)]


def _take(decoder: Decoder, job: Job, clock: float, found: list[Found]) -> int:
    """Add the candidates of a sweep to the tracks; the first ever only set the sample clock. Returns the cost.

    The cost is in codes.
    """
    tracks, clocks, cost = decoder.tracks, decoder.clocks, TAKING * len(found)
    settled = clocks.known or clocks.guess is not None
    if not len(tracks.slots) and (clock != clocks.clock or not settled):
        clocks.suppose(decoder.search.refine(job, clock, found[0]))
        return REFINING  # a sweep over all clocks takes so long that the phases of its block are out of date
    decoder.offered = None  # these lamps are not subtracted from an earlier block
    for candidate in found:
        tracks.add(candidate.code, candidate.phase - job.lag, job.t_middle, candidate.amplitude)
    if job.again < AGAIN:
        decoder.search.start(decoder.search.peeled(job, found), [clocks.clock])
        cost += PEELING
    return cost


def _prepare(decoder: Decoder, block: SampleBlock) -> tuple[Sampled | None, BlockFlag]:
    """Check a block and convert it to ADC steps about mid-scale, on the sample clock's time axis.

    Clipped samples are masked. Returns None for an unusable block, and its flags.
    """
    profile = decoder.profile
    words = np.asarray(block.words, np.float64)
    n, top = len(words), 2.0**profile.front_end.bits - 1.0
    if not (np.isfinite(words).all() and -np.inf < block.t_begin < block.t_end < np.inf):
        return None, BlockFlag.MALFORMED
    if not abs(block.rate / profile.sample_rate - 1.0) <= RATE:
        return None, BlockFlag.MALFORMED
    if not 1.0 <= n / (profile.sample_rate * profile.period_s) <= LONGEST:
        return None, BlockFlag.LENGTH
    low, high = float(words.min()), float(words.max())
    if low < 0.0 or high > top:
        return None, BlockFlag.MALFORMED
    if low == high:
        return None, BlockFlag.FLAT
    mask, flags = np.ones(n), BlockFlag.NONE
    if low <= RAIL * top or high >= (1.0 - RAIL) * top:
        mask[(words <= RAIL * top) | (words >= (1.0 - RAIL) * top)] = 0.0
        flags = BlockFlag.CLIPPED
    if n - mask.sum() > CLIP_SHARE * n:
        return None, BlockFlag.SATURATED
    still = saturated(words, mask)
    if still is not None:
        mask[still] = 0.0
        flags |= BlockFlag.OVERDRIVEN
        if n - mask.sum() > STILL_SHARE * n:
            return None, flags | BlockFlag.SATURATED
    y = (words - 0.5 * (top + 1.0)) * mask
    rows = decoder.background.rows(y, mask, still is not None)
    chips = profile.chip_rate / profile.sample_rate * (1.0 + decoder.clocks.clock)
    at: Array = np.arange(n, dtype=np.float64) - 0.5 * (n - 1)
    if decoder.time_base.uneven:
        flags |= BlockFlag.UNEVEN
    return Sampled(y, decoder.time_base.moved(at * chips), mask, rows), flags


def _watch(decoder: Decoder, flags: int) -> None:
    """Update the acquisition budget with this block."""
    tracks = decoder.tracks
    lit = tracks.confirmed
    odd = bool(flags & _UNUSUAL) or len(lit) < len(tracks.slots)
    ratio = decoder.noise / decoder.usual_noise if decoder.usual_noise else 0.0
    decoder.watch.on_block(int(np.count_nonzero(~tracks.faint(lit))), ratio, odd)


def _offer(decoder: Decoder, residual: Sampled, t_middle: float) -> None:
    """Offer the block, with the received lamps subtracted, to the search."""
    tracks, lag = decoder.tracks, float(decoder.clocks.state[0])
    slots = tracks.slots
    slots = slots[~tracks.faint(slots)]
    floor = SPURIOUS * float(np.max(tracks.amplitude[slots], initial=0.0))
    decoder.offered = Job(residual, t_middle, lag, tracks.code[slots], tracks.phase[slots] + lag, floor)


def _epoch(decoder: Decoder, block: SampleBlock, flags: BlockFlag) -> LightEpoch:
    """Links of the confirmed lamps; none if the block is unusable."""
    tracks, lsb = decoder.tracks, decoder.profile.front_end.lsb_a
    links = tracks.confirmed if not int(flags) & _UNUSABLE else np.empty(0, np.int64)
    code, amplitude, variance = tracks.code[links], tracks.amplitude[links], tracks.amplitude_var[links]
    twin = (code[:, None] == code).sum(axis=1) > 1
    faint, slow = tracks.faint(links), decoder.slow_lamps.slow(links)
    relative_var = tracks.relative_var[links] + decoder.time_base.doubt**2
    return LightEpoch(
        t_begin=block.t_begin,
        t_end=block.t_end,
        ids=code,
        amplitude=amplitude * lsb,
        variance=(variance + relative_var * amplitude**2) * lsb**2,
        flags=faint * _FAINT + twin * _TWIN + slow * _SLOW if slow.any() else faint * _FAINT + twin * _TWIN,
        lamps=tuple([tracks.frames[k] for k in links.tolist()]),
        block=flags,
        noise_a=decoder.noise * lsb,
        clock_ppm=decoder.clock_ppm,
        pwm=_pwm(decoder),
        relative_var=relative_var,
    )


def _pwm(decoder: Decoder) -> tuple[PwmLight, ...]:
    """PWM lamps in view, by the corrected sample clock."""
    if not len(decoder.background.pwm):
        return ()
    named = decoder.background.pwm.named
    scale, lsb = decoder.profile.sample_rate / (1.0 + decoder.clocks.clock), decoder.profile.front_end.lsb_a
    return tuple(
        [
            PwmLight(lamp.frequency * scale, lamp.swing * lsb, None if lamp.other is None else lamp.other * scale)
            for lamp in named
            if lamp.swing * lsb >= NAMED_A
        ]
    )


__all__ = ["Decoder", "decode", "new_decoder", "search"]
