"""The light decoder: ADC words in, lamp IDs and received strengths out.

Use::

    decoder = new_decoder(PROFILE_A, clock_ppm=stored)   # None: the sample clock is not known yet
    epoch = decode(decoder, block)                       # once per block
    search(decoder, codes=129)                           # once per cycle, as much as the cycle can afford

`decode` follows the lamps that are known; `search` looks for others in slices. Neither reads a clock.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Final

import numpy as np

from estimator.cdma.acquisition import BIN, Found, Job
from estimator.cdma.air_interface import Profile
from estimator.cdma.block_update import SPURIOUS, Decoder, follow
from estimator.cdma.epoch import UNUSABLE, BlockFlag, LightEpoch, LinkFlag, SampleBlock
from estimator.cdma.sample_block import Sampled
from estimator.numerics.arrays import Array

LONGEST: Final = 10
"""Code periods: no block may be longer."""

CLIP_SHARE: Final = 0.2
"""Of a block at the rails, beyond which what is left says nothing."""
RAIL: Final = 1.0 / 128.0
"""Share of the range beside either rail that counts as the rail: amplifiers stop up to 25 mV short of 3.3 V."""

RATE: Final = 0.05
"""Largest relative difference between a block's nominal rate and the profile's."""

NEW_CLOCK: Final = 4
"""Blocks from the past in a row until they are taken for the present."""

STORED_PPM: Final = 200.0
"""A stored sample clock is good to this."""

REFINING, PEELING, TAKING = 80, 45, 4
"""Codes that could be tried in the time in which a sample clock is refined, lamps are taken out of a block, one lamp
is made a candidate."""

AGAIN: Final = 2
"""Times that a block is searched again without what was found in it."""

FULL_ROUND: Final = 8
"""Sweeps without a confirmed lamp until all sample clocks are tried."""


def new_decoder(profile: Profile, clock_ppm: float | None = None, hung: Collection[int] = ()) -> Decoder:
    """A decoder that knows no lamps yet.

    Args:
        profile: air interface and front end.
        clock_ppm: stored error of the sample clock, good to 200 ppm; None: search the whole range of the profile.
        hung: codes of the lamps that hang in the building, as far as is known: where nothing speaks for further lamps,
            these are looked for more often than others. Empty: any may hang.

    Raises:
        ValueError: a stored clock outside the profile's range.
    """
    if clock_ppm is not None and not abs(clock_ppm) <= profile.clock_ppm + STORED_PPM:
        raise ValueError(f"clock_ppm = {clock_ppm} is outside +-{profile.clock_ppm:g}: delete the stored value")
    return Decoder(profile, clock_ppm, hung)


def decode(decoder: Decoder, block: SampleBlock) -> LightEpoch:
    """Follow all known lamps through one block and report them. Never raises, whatever is in the block.

    Blocks must come in order of time; one from the past is malformed, several in a row are a new clock.
    """
    sampled, flags = _prepare(decoder, block)
    if sampled is not None and not _onward(decoder, block):
        sampled, flags = None, BlockFlag.MALFORMED
    if sampled is not None:
        t_middle = 0.5 * (block.t_begin + block.t_end)
        decoder.clocks.predict(decoder.tracks.predict(t_middle))
        more, residual = follow(decoder, block, sampled)
        flags |= more
        if flags == BlockFlag.NONE:
            decoder.mains.learn(sampled.y)
        decoder.odd = decoder.odd + 1 if flags & (BlockFlag.STALLED | BlockFlag.NOISY) else 0
        if decoder.odd != 1:  # what one block has left over may be a stall; if the next has it too, it is a lamp
            _offer(decoder, residual, t_middle)
        _watch(decoder, flags)
    return _epoch(decoder, block, flags)


def _onward(decoder: Decoder, block: SampleBlock) -> bool:
    """Whether time goes on with this block; if it has gone back for good, the phases of all lamps are forgotten."""
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
    """Look for further lamps, with as much work as it takes to try ``codes`` codes (6 us each with profile A).

    What else there is to do counts as so many codes, or has a call of its own. While nothing speaks for further lamps,
    a small part of the effort is used: estimator/cdma/acquisition_budget.py.
    """
    decoder.shape.renew()
    allowed = decoder.watch.allow(codes)
    decoder.watch.spend(allowed - _search(decoder, allowed))


def _search(decoder: Decoder, codes: int) -> int:
    """Returns what is left of the effort; what was begun is brought to an end, so it may be less than nothing."""
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
    """Start to search the block last offered, if there is one."""
    clocks = _trial_clocks(decoder) if decoder.offered else []
    if decoder.offered is None:
        return False
    decoder.search.start(decoder.offered, clocks, slow=decoder.watch.calm and len(clocks) == 1)
    decoder.offered = None
    decoder.barren *= len(clocks) == 1
    return True


def _sweep(decoder: Decoder, codes: int) -> int:
    """Go on with the sweep; returns what is left of the effort."""
    left, done = decoder.search.step(codes)
    if done is not None:
        decoder.barren += 1
        decoder.watch.on_sweep(len(done[-1]))
        decoder.found = done if done[-1] else None
    return left


def _trial_clocks(decoder: Decoder) -> list[float]:
    """The known clock alone; all of the range while none is known, and again when the known one confirms no lamp."""
    tracks, clocks = decoder.tracks, decoder.clocks
    if (clocks.known or clocks.guess is not None or len(tracks.slots)) and decoder.barren < FULL_ROUND:
        return [clocks.clock]
    clocks.guess = None
    if len(tracks.slots):  # candidates that came to nothing: start from a block without them
        for slot in tracks.slots:
            tracks.drop(int(slot))
        decoder.offered = None
    reach = round(decoder.profile.clock_ppm * 1e-6 / BIN)
    return [k * BIN for k in range(-reach, reach + 1)]


def _take(decoder: Decoder, job: Job, clock: float, found: list[Found]) -> int:
    """Make candidates of what a sweep found; the first ever tell the sample clock only. Returns its cost in codes."""
    tracks, clocks, cost = decoder.tracks, decoder.clocks, TAKING * len(found)
    settled = clocks.known or clocks.guess is not None
    if not len(tracks.slots) and (clock != clocks.clock or not settled):
        clocks.suppose(decoder.search.refine(job, clock, found[0]))
        return REFINING  # a sweep over all clocks takes so long that the phases in its block are no longer true
    decoder.offered = None  # in a block from before, these lamps have not been taken out
    for candidate in found:
        tracks.add(candidate.code, candidate.phase - job.lag, job.t_middle, candidate.amplitude)
    if job.again < AGAIN:
        decoder.search.start(decoder.search.peeled(job, found), [clocks.clock])
        cost += PEELING
    return cost


def _prepare(decoder: Decoder, block: SampleBlock) -> tuple[Sampled | None, BlockFlag]:
    """Words to ADC steps about mid-scale, on the clock's time axis, with what must be left out."""
    profile = decoder.profile
    words = np.asarray(block.words, np.float64)
    n, top = len(words), 2.0**profile.front_end.bits - 1.0
    if not (np.isfinite(words).all() and -np.inf < block.t_begin < block.t_end < np.inf):
        return None, BlockFlag.MALFORMED
    if not abs(block.rate / profile.sample_rate - 1.0) <= RATE:
        return None, BlockFlag.MALFORMED
    if not 1.0 <= n / (block.rate * profile.period_s) <= LONGEST:
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
    y = (words - 0.5 * (top + 1.0)) * mask
    rows = decoder.mains.rows(y)
    if flags:
        rows = decoder.mains.masked(np.arange(n, dtype=float), mask)
    chips = profile.chip_rate / block.rate * (1.0 + decoder.clocks.clock)
    at: Array = np.arange(n, dtype=np.float64) - 0.5 * (n - 1)
    return Sampled(y, at * chips, mask, rows), flags


def _watch(decoder: Decoder, flags: BlockFlag) -> None:
    """Let the watch know what this block says for or against further lamps."""
    tracks = decoder.tracks
    lit = tracks.confirmed
    odd = flags not in (BlockFlag.NONE, BlockFlag.CLIPPED) or len(lit) < len(tracks.slots)
    ratio = decoder.noise / decoder.usual_noise if decoder.usual_noise else 0.0
    decoder.watch.on_block(int(np.count_nonzero(~tracks.faint(lit))), ratio, odd)


def _offer(decoder: Decoder, residual: Sampled, t_middle: float) -> None:
    """Leave the block, without the lamps that are seen, to be searched."""
    tracks, lag = decoder.tracks, float(decoder.clocks.state[0])
    slots = tracks.slots
    slots = slots[~tracks.faint(slots)]
    floor = SPURIOUS * float(np.max(tracks.amplitude[slots], initial=0.0))
    decoder.offered = Job(residual, t_middle, lag, tracks.code[slots], tracks.phase[slots] + lag, floor)


def _epoch(decoder: Decoder, block: SampleBlock, flags: BlockFlag) -> LightEpoch:
    """Report the confirmed lamps, none if the block is of no use."""
    tracks, lsb = decoder.tracks, decoder.profile.front_end.lsb_a
    links = tracks.confirmed if not flags & UNUSABLE else np.empty(0, np.int64)
    code, amplitude, variance = tracks.code[links], tracks.amplitude[links], tracks.amplitude_var[links]
    twin = (code[:, None] == code).sum(axis=1) > 1
    faint = tracks.faint(links)
    return LightEpoch(
        t_begin=block.t_begin,
        t_end=block.t_end,
        ids=code,
        amplitude=amplitude * lsb,
        variance=variance * lsb**2,
        flags=faint * int(LinkFlag.FAINT) + twin * int(LinkFlag.TWIN),
        lamps=tuple([tracks.frames[k] for k in links.tolist()]),
        block=flags,
        noise_a=decoder.noise * lsb,
        clock_ppm=decoder.clock_ppm,
    )


__all__ = ["Decoder", "decode", "new_decoder", "search"]
