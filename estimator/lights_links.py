"""From an epoch to links: which lamp each one is, what it differs by, and whether it is used or paused."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from estimator import ekf, ekf_links
from estimator.cdma_epoch import LightEpoch, LinkFlag
from estimator.lamps import Lamp
from estimator.lights_state import Lights, Pause, Track, Watch
from estimator.optics import pack_receiver
from estimator.records import Array
from estimator.result import Link, LinkState

TWIN_SHARE = 0.1
"""A second lamp of the same code adds to a link when it would be received at this share of the first or more."""
DIFFUSE = 0.6
"""A strength below this share of what the lamp gives at the edge of view has not come straight."""
RELEARN_S, RELEARN_M = 15.0, 3.0
"""A link that contradicts so long and far, and always by the same factor, is a lamp of another power: learn it anew."""
STEADY = 0.12
"""Spread of its ln residual up to which a contradiction is called steady."""
STRIKES = 2
"""So often a lamp is learned anew; one that contradicts again stands somewhere else."""


@dataclass(slots=True, eq=False)
class Sight:
    """One link of an epoch as a hypothesis sees it."""

    link: Link
    lamp: Lamp | None = None
    variance: float = 0.0


def sights(lights: Lights, epoch: LightEpoch, x: float, y: float) -> list[Sight]:
    """The links of an epoch with the lamps they come from if the receiver is near a place, strongest first."""
    found = []
    for i in np.argsort(-epoch.amplitude):
        code, amplitude, variance = int(epoch.ids[i]), float(epoch.amplitude[i]), float(epoch.variance[i])
        sight = Sight(Link(code, None, LinkState.UNSURVEYED, amplitude), variance=variance)
        found.append(sight)
        if not (math.isfinite(amplitude) and variance >= 0.0):
            sight.link = replace(sight.link, state=LinkState.FAINT, amplitude=0.0)
            continue
        frame = epoch.lamps[i]
        twin = bool(epoch.flags[i] & LinkFlag.TWIN)
        if frame is not None:
            sight.lamp, contradicted = lights.catalogue.learn(frame, code)
            sight.link = replace(sight.link, contradicted=contradicted)
        else:
            sight.lamp, alone = nearest(lights, code, x, y)
            twin = twin or not alone
        if sight.lamp is None:
            continue
        state = LinkState.ACCEPTED
        if bool(epoch.flags[i] & LinkFlag.FAINT) or amplitude < lights.settings.faint * math.sqrt(variance):
            state = LinkState.FAINT
        elif twin and frame is None:
            state = LinkState.TWIN
        sight.link = replace(sight.link, lamp_id=None if state is LinkState.TWIN else sight.lamp.lamp_id, state=state)
    return found


def nearest(lights: Lights, code: int, x: float, y: float) -> tuple[Lamp | None, bool]:
    """The lamp of a code nearest to a place, and whether it alone can be what is received there."""
    lamps = lights.catalogue.candidates(code)
    if len(lamps) < 2:
        return (lamps[0], True) if lamps else (None, True)
    ranked = sorted(lamps, key=lambda lamp: -below(lights, lamp, x, y))
    first, second = (below(lights, lamp, x, y) for lamp in ranked[:2])
    return ranked[0], second < TWIN_SHARE * first


def below(lights: Lights, lamp: Lamp, x: float, y: float) -> float:
    """Roughly how strong a lamp is at a place, level and without field of view: enough to rank lamps by."""
    receiver = lights.survey.receiver
    h2 = max(lamp.z - receiver.z, 0.1) ** 2
    d2 = h2 + (lamp.x - x) ** 2 + (lamp.y - y) ** 2
    fall = math.pow(h2 / d2, 0.5 * (lamp.order + receiver.order))
    return lamp.power_w * fall / d2


def rim_amplitude(lights: Lights, lamp: Lamp) -> float:
    """What a lamp gives at the very edge of view of a level receiver, A."""
    rx, h = lights.survey.receiver, max(lamp.z - lights.survey.receiver.z, 0.1)
    nadir = (lamp.order + 1.0) * rx.area_m2 / (2.0 * math.pi * h * h) * rx.responsivity
    fall = math.pow(math.cos(min(rx.half_fov_rad, 1.5)), lamp.order + rx.order + 2.0)
    return lights.survey.depth * lamp.power_w * nadir * fall


def slot_of(lights: Lights, track: Track, lamp: Lamp, busy: set[int]) -> int | None:
    """The slot of a lamp in a hypothesis; the longest unseen lamp makes room for a new one; None if none can."""
    slot = track.slots.get(lamp.lamp_id)
    if slot is None:
        if track.used < ekf.SLOTS:
            slot = track.used
            track.used += 1
        else:
            free = [k for k in range(ekf.SLOTS) if k not in busy]
            if not free:
                return None
            slot = min(free, key=lambda k: float(track.seen[k]))
            vacate(lights, track, slot)
        occupy(lights, track, lamp, slot)
    track.lamps[slot] = lights.catalogue.rows[lamp.lamp_id]
    track.seen[slot] = lights.course.t_mono
    return slot


def vacate(lights: Lights, track: Track, slot: int) -> None:
    """Remember what is known of the lamp in a slot and take it out."""
    lamp_id = next(key for key, value in track.slots.items() if value == slot)
    at = ekf.FIRST + 2 * slot
    lights.gains[lamp_id] = (float(track.x[at]), float(track.P[at, at]))
    del track.slots[lamp_id]


def occupy(lights: Lights, track: Track, lamp: Lamp, slot: int) -> None:
    """Give a lamp a slot, with what is known of its gain from before."""
    at = ekf.FIRST + 2 * slot
    for j in (at, at + 1):
        ekf.cut(track.P, track.n, j)
    gain, variance = lights.gains.get(lamp.lamp_id, (0.0, lamp.sigma_ln**2))
    track.x[at], track.P[at, at] = gain, variance
    track.x[at + 1], track.P[at + 1, at + 1] = 0.0, 1.0
    track.slots[lamp.lamp_id] = slot


def table(lights: Lights, track: Track, seen: list[Sight]) -> tuple[list[Sight], Array]:
    """The sights that can be compared with a hypothesis, and their rows for the kernels."""
    rows, kept, busy = [], [], set[int]()
    for sight in seen:
        if sight.lamp is None or sight.link.state is not LinkState.ACCEPTED or sight.lamp.lamp_id in busy:
            continue
        slot = slot_of(lights, track, sight.lamp, {track.slots[k] for k in busy})
        if slot is None:
            continue
        busy.add(sight.lamp.lamp_id)
        amplitude = sight.link.amplitude
        rows.append((slot, math.log(amplitude), sight.variance / amplitude**2, 0.0, -1.0))
        kept.append(sight)
    links = np.array(rows, dtype=np.float64).reshape(len(rows), ekf_links.LINK_COLUMNS)
    if lights.corrections is not None and kept:
        ids = [sight.lamp.lamp_id for sight in kept if sight.lamp is not None]
        shift, sigma = lights.corrections.at(ids, float(track.x[ekf.X]), float(track.x[ekf.Y]))
        links[:, ekf_links.SHIFT], links[:, ekf_links.SIGMA] = np.where(sigma < 0.0, 0.0, shift), sigma
    return kept, links


def view_of(lights: Lights, back: Array) -> Array:
    """What the kernels need besides state and links."""
    model = lights.settings.model
    return np.concatenate(
        [pack_receiver(lights.survey.receiver), back, (model.ln, model.floor, model.lean, model.white)]
    )


def judge(lights: Lights, track: Track, kept: list[Sight], out: Array, level_drop: bool) -> None:
    """Decide on every link; what is not to be used gets an infinite noise, what may be an outlier a larger one.

    Gating waits until the place is known well; before, a deviation is held against the link only softly, because it
    may as well be the place or a gain that is wrong.
    """
    cos_rim = math.cos(max(lights.survey.receiver.half_fov_rad - lights.settings.rim_rad, 0.1))
    gating = settled(track)
    for i, sight in enumerate(kept):
        r = float(out[i, ekf_links.RESIDUAL])
        S = float(out[i, ekf_links.SPREAD] + out[i, ekf_links.WHITE])
        state = LinkState.ACCEPTED
        if out[i, ekf_links.COS_BETA] < cos_rim or out[i, ekf_links.DIRECT] < 0.5:
            strong = sight.link.amplitude > 2.0 * rim_of(lights, track, sight)
            state = LinkState.REJECTED if strong and gating else LinkState.RIM
        elif gating:
            state = gate(lights, track, sight, (r, S), level_drop)
        elif r * r > 4.0 * S:
            out[i, ekf_links.WHITE] += 0.25 * r * r - S
        if state is not LinkState.ACCEPTED:
            out[i, ekf_links.WHITE] = math.inf
        at = ekf.FIRST + 2 * int(track.slots[sight.link.lamp_id]) if sight.link.lamp_id is not None else ekf.FIRST
        spread = track.P[at, at] + track.P[ekf.COMMON, ekf.COMMON] + 2.0 * track.P[at, ekf.COMMON]
        gain, sigma_gain = float(track.x[at] + track.x[ekf.COMMON]), math.sqrt(max(float(spread), 0.0))
        sight.link = replace(sight.link, state=state, residual=r, sigma=math.sqrt(S), gain=gain, sigma_gain=sigma_gain)
    shorten(lights, kept, out)


def rim_of(lights: Lights, track: Track, sight: Sight) -> float:
    """What this link's lamp would give at the edge of view, with its gain as learned, A."""
    assert sight.lamp is not None
    at = ekf.FIRST + 2 * track.slots[sight.lamp.lamp_id]
    return rim_amplitude(lights, sight.lamp) * math.exp(float(track.x[ekf.COMMON] + track.x[at]))


def settled(track: Track) -> bool:
    """Whether the place is known well enough for a link that does not fit to be called wrong."""
    P = track.P
    return bool(P[0, 0] + P[1, 1] < 0.2**2 and P[2, 2] < 0.15**2)


def gate(lights: Lights, track: Track, sight: Sight, off: tuple[float, float], level_drop: bool) -> LinkState:
    """One link's NIS gate, narrower downwards: things in the way only ever take light away."""
    r, S = off
    settings, t, way = lights.settings, lights.course.t_mono, lights.course.way
    assert sight.lamp is not None
    watch = track.watches.setdefault(sight.lamp.lamp_id, Watch())
    weak = settings.weak * (0.67 if level_drop else 1.0)
    low, high = r < -weak * math.sqrt(S), r > settings.strong * math.sqrt(S)
    if low or high:
        watch.t_bad, watch.way_bad = t, way
        if math.isinf(watch.t_run):
            watch.t_run, watch.way_run, watch.count, watch.total, watch.square = t, way, 0, 0.0, 0.0
        watch.count += 1
        watch.total += r
        watch.square += r * r
        return LinkState.REJECTED if high else LinkState.OCCLUDED
    if t - watch.t_bad < settings.wait_s or way - watch.way_bad < settings.wait_m:
        return LinkState.OCCLUDED
    watch.t_run = math.inf
    return LinkState.ACCEPTED


def shorten(lights: Lights, kept: list[Sight], out: Array) -> None:
    """The paper's selection: only the Link_n strongest clear links are used; with its pause rule, those or none."""
    n = lights.settings.link_n
    if n <= 0:
        return
    clear = [i for i, sight in enumerate(kept) if sight.link.state is LinkState.ACCEPTED]
    drop = clear if lights.settings.pause is Pause.PAPER and len(clear) < n else clear[n:]
    out[drop, ekf_links.WHITE] = math.inf


def relearn(lights: Lights, track: Track) -> None:
    """A lamp whose light has long been off by a constant factor is learned anew, unless that was tried before."""
    for lamp_id, watch in track.watches.items():
        long = lights.course.t_mono - watch.t_run > RELEARN_S and lights.course.way - watch.way_run > RELEARN_M
        if not long or watch.strikes >= STRIKES or lamp_id not in track.slots:
            continue
        mean = watch.total / watch.count
        if watch.square / watch.count - mean * mean < STEADY**2:
            at = ekf.FIRST + 2 * track.slots[lamp_id]
            ekf.cut(track.P, track.n, at)
            track.x[at] += mean
            track.P[at, at] = 0.3**2
            watch.t_bad = watch.way_bad = -math.inf
        watch.strikes += 1
        watch.t_run = math.inf
