"""NIS gating of links against one hypothesis: accepted, occluded, rejected or paused; moved and aged lamps."""

from __future__ import annotations

import math

import numpy as np

from estimator.light_filter import measurement_update, state_vector
from estimator.light_filter.filter_state import Lights, Pause, Track, Watch
from estimator.light_filter.lambertian import pack_receiver
from estimator.light_filter.link_association import Sight
from estimator.light_filter.survey import Lamp
from estimator.numerics.arrays import Array
from estimator.result import STRONG, WEAK, LinkState

ACCEPTED, OCCLUDED = LinkState.ACCEPTED, LinkState.OCCLUDED
REJECTED, RIM = LinkState.REJECTED, LinkState.RIM

DIFFUSE = 0.6
"""Share of a lamp's RSS at the edge of view below which a link is not line of sight."""
RELEARN_S, RELEARN_M = 15.0, 3.0
"""The gain of a lamp is learned again if its links are off by a constant factor for long: `RELEARN_S` (s) and this path
length (m). Its power has then changed.
"""
HIDDEN = 1.4
"""A loss (ln) above which a lamp is hidden, not aged (three quarters of its light): its gain is not learned again."""
STEADY = 0.12
"""Spread of the ln residuals up to which the factor counts as constant."""
TOO_STRONG = 3.0
"""Factor over a lamp's RSS at the edge of view that no lamp near that edge reaches."""
MOVED_LEANS = 3.0
"""Largest plausible tilt of a lamp, in sigmas; a larger one indicates another position."""
FIRST_ERROR = 5.0
"""Initial variance of a model error; later, gain and tilt have absorbed its constant part."""
STRIKES = 2
"""Number of times a lamp's gain is learned again; if it is then inconsistent, the lamp is elsewhere."""
FADE_M = 100.0
"""Path length (m) with a fitting lamp after which one such time no longer counts: lamps do age."""
PAROLE_M, PAROLE = 5.0, 2.0
"""A moved lamp is used again after `PAROLE_M` (m) of links within this many sigmas. The path length doubles every
time.
"""
STRIDE_M = 0.2
"""Largest path length (m) counted between two epochs: driving out of a lamp's sight is no evidence about it."""
FORGET_S, DESCRIBED = 3600.0, 1024
"""A lamp outside the survey is removed if not received for `FORGET_S` (s), or as the oldest beyond this number."""


def slot_of(lights: Lights, track: Track, lamp: Lamp, busy: set[int]) -> int | None:
    """Slot of a lamp in a hypothesis; a new lamp replaces the longest unseen one. None if all slots are busy."""
    slot = track.slots.get(lamp.lamp_id)
    if slot is None:
        if track.used < state_vector.SLOTS:
            slot = track.used
            track.used += 1
        else:
            free = [k for k in range(state_vector.SLOTS) if k not in busy]
            if not free:
                return None
            slot = min(free, key=lambda k: float(track.seen[k]))
            vacate(lights, track, slot)
        occupy(lights, track, lamp, slot)
    track.lamps[slot] = lights.catalogue.rows[lamp.lamp_id]
    track.seen[slot] = lights.course.t_mono
    return slot


def vacate(lights: Lights, track: Track, slot: int) -> None:
    """Store gain and tilt of the lamp in a slot, and free the slot."""
    lamp_id = next(key for key, value in track.slots.items() if value == slot)
    at = state_vector.FIRST + state_vector.OWN * slot
    lights.gains[lamp_id] = track.x[at : at + 3].copy(), np.diag(track.P)[at : at + 3].copy()
    del track.slots[lamp_id]


def remembered(lights: Lights, lamp: Lamp) -> tuple[Array, Array]:
    """Means and variances of a lamp's (ln gain, tilt x, tilt y): stored ones, else of the survey."""
    lean = lights.settings.model.lean
    new = np.zeros(3), np.array((lamp.sigma_ln**2, lean**2, lean**2))
    return lights.gains.get(lamp.lamp_id, new)


def occupy(lights: Lights, track: Track, lamp: Lamp, slot: int) -> None:
    """Assign a slot to a lamp, with its stored gain."""
    at = state_vector.FIRST + state_vector.OWN * slot
    mean, variance = remembered(lights, lamp)
    for j in range(state_vector.OWN):
        state_vector.cut(track.P, track.n, at + j)
        track.x[at + j] = 0.0 if j == state_vector.ERROR else mean[j]
        track.P[at + j, at + j] = FIRST_ERROR if j == state_vector.ERROR else variance[j]
    track.slots[lamp.lamp_id] = slot


def table(lights: Lights, track: Track, seen: list[Sight]) -> tuple[list[Sight], Array]:
    """The sights with a slot in the hypothesis, and their rows for the kernels."""
    kept, busy = list[Sight](), set[int]()
    for sight in seen:
        if sight.lamp is None or sight.state is not ACCEPTED:
            continue
        slot = slot_of(lights, track, sight.lamp, busy)
        if slot is None or slot in busy:
            continue
        busy.add(slot)
        sight.slot = slot
        kept.append(sight)
    links = np.zeros((len(kept), measurement_update.LINK_COLUMNS))
    links[:, measurement_update.SLOT] = [sight.slot for sight in kept]
    links[:, measurement_update.LN] = [math.log(sight.amplitude) for sight in kept]
    links[:, measurement_update.NOISE] = [sight.variance / sight.amplitude**2 for sight in kept]
    links[:, measurement_update.SIGMA] = -1.0
    if lights.corrections is not None and kept:
        ids = [sight.lamp.lamp_id for sight in kept if sight.lamp is not None]
        links[:, measurement_update.SHIFT :] = lights.corrections.at(ids, track.x[:3])
    return kept, links


def view_of(lights: Lights, back: Array) -> Array:
    """Receiver, pose at the epoch and model sigmas for the kernels."""
    model, rx = lights.settings.model, pack_receiver(lights.survey.receiver)
    rx[7:9] += lights.lean
    return np.concatenate([rx, back, (model.ln, model.floor, model.white, model.edge)])


def judge(lights: Lights, track: Track, kept: list[Sight], out: Array, news: float) -> float:
    """Decide on every link; an unused link gets infinite noise, a possible outlier larger noise.

    Gating waits until the position is certain. Before, a deviation only raises the noise of the link: position or gain
    may be wrong instead. An occluded lamp is an exception, because it would pull the position twenty times a second. A
    robot at rest would drift to where the lamp fits. It therefore only lowers the likelihood of the hypothesis. Other
    deviations bring no new information while odometry reports rest: exchanged lamps would make the position diverge.

    Args:
        lights: state of the filter.
        track: the hypothesis.
        kept: its links.
        out: `measurement_update.linearise` of them, changed.
        news: share of new information in an epoch, by the path length since the last one, 0 to 1.

    Returns:
        ln of the likelihood of the links that are not used.
    """
    likelihood = 0.0
    half, rim = lights.survey.receiver.half_fov_rad, lights.settings.rim_rad
    cos_rim, cos_out = math.cos(max(half - rim, 0.1)), math.cos(half + rim)
    news = news if lights.course.wheels else 1.0  # see `weak`
    gating = settled(track) and len(lights.tracks) == 1  # hypotheses are compared by the same links
    for i, (sight, row) in enumerate(zip(kept, out[:, : measurement_update.SLOPES].tolist(), strict=True)):
        r, S = row[measurement_update.RESIDUAL], row[measurement_update.SPREAD] + row[measurement_update.WHITE]
        sight.residual, sight.sigma = r, math.sqrt(max(S, 0.0))
        if row[measurement_update.COS_BETA] < cos_rim or row[measurement_update.DIRECT] < 0.5:
            most = (1.0 if row[measurement_update.COS_BETA] < cos_out else TOO_STRONG) * rim_of(lights, track, sight)
            sight.state = REJECTED if gating and sight.amplitude > most else RIM
        elif gating:
            sight.state = gate(lights, track, sight)
        elif r * r > 4.0 * S:
            soft = 0.25 * r * r
            out[i, measurement_update.WHITE] += soft / news - S if news > 0.0 else math.inf
            if weak(lights, sight):
                likelihood -= 0.5 * (4.0 + math.log(soft) + measurement_update.LOG_2PI)
                sight.state = OCCLUDED
        if sight.state is not ACCEPTED:
            out[i, measurement_update.WHITE] = math.inf
    shorten(lights, kept, out)
    return likelihood


def weak(lights: Lights, sight: Sight) -> bool:
    """Whether a link is weaker than its lamp is anywhere in view, so that an obstacle must occlude it.

    Without odometry it is always False: only such links constrain a wrong hypothesis there, so they stay in use.
    """
    if sight.lamp is None or not lights.course.wheels:
        return False
    gain = math.exp(float(remembered(lights, sight.lamp)[0][0]))
    return sight.amplitude < DIFFUSE * gain * lights.catalogue.rims[sight.lamp.lamp_id]


def rim_of(lights: Lights, track: Track, sight: Sight) -> float:
    """RSS of this link's lamp at the edge of view, with its learned gain, A."""
    if sight.lamp is None:
        return math.inf
    gain = float(track.x[state_vector.COMMON] + track.x[state_vector.FIRST + state_vector.OWN * sight.slot])
    return lights.catalogue.rims[sight.lamp.lamp_id] * math.exp(gain)


def settled(track: Track) -> bool:
    """Whether the position is certain enough to reject a link that does not fit.

    RSS depends on the position and hardly on the heading, which without odometry is never certain.
    """
    return bool(track.P[0, 0] + track.P[1, 1] < 0.2**2)


def gate(lights: Lights, track: Track, sight: Sight) -> LinkState:
    """NIS gate of one link, narrower downwards: obstacles only ever reduce the light."""
    settings, t, way = lights.settings, lights.course.t_mono, lights.course.way
    if sight.lamp is None or sight.residual is None or sight.sigma is None:
        return RIM
    r, sigma = sight.residual, sight.sigma
    watch = track.watches.get(sight.lamp.lamp_id)
    if watch is None:
        watch = track.watches[sight.lamp.lamp_id] = Watch()
    step, watch.way_seen = min(way - watch.way_seen, STRIDE_M), way
    if watch.moved:
        parole(watch, abs(r) < PAROLE * sigma, step)
        return REJECTED
    low, high = r < -WEAK * sigma, r > STRONG * sigma
    if low or high:
        watch.t_bad, watch.way_bad = t, way
        if math.isinf(watch.t_run):
            watch.t_run, watch.way_run, watch.count, watch.total, watch.square = t, way, 0, 0.0, 0.0
        watch.count += 1
        watch.total += r
        watch.square += r * r
        return REJECTED if high else OCCLUDED
    if t - watch.t_bad < settings.wait_s or way - watch.way_bad < settings.wait_m:
        return OCCLUDED
    watch.t_run = math.inf
    watch.fitted += step
    if watch.fitted > FADE_M:
        watch.fitted, watch.strikes = 0.0, max(watch.strikes - 1, 0)
    return ACCEPTED


def parole(watch: Watch, fits: bool, step: float) -> None:
    """Revoke the moved state of a lamp that has fitted for long; no other evidence would revoke it."""
    watch.fitted = watch.fitted + step if fits else 0.0
    if watch.fitted > PAROLE_M * 2.0 ** min(watch.paroles, 10):
        watch.moved, watch.fitted, watch.t_run = False, 0.0, math.inf
        watch.paroles += 1


def shorten(lights: Lights, kept: list[Sight], out: Array) -> None:
    """The paper's selection: only the Link_n strongest clear links are used; with its pause rule, those or none."""
    n = lights.settings.link_n
    if n <= 0:
        return
    clear = [i for i, sight in enumerate(kept) if sight.state is ACCEPTED]
    drop = clear if lights.settings.pause is Pause.PAPER and len(clear) < n else clear[n:]
    for i in drop:
        kept[i].state = LinkState.PAUSED
        out[i, measurement_update.WHITE] = math.inf


def distrust(lights: Lights, track: Track) -> None:
    """Mark lamps as moved whose estimated tilt is implausible; they are not used again."""
    limit, n = MOVED_LEANS * lights.settings.model.lean, track.n
    x, variance = track.x[:n].tolist(), track.P.diagonal()[:n].tolist()
    for lamp_id, slot in track.slots.items():
        at = state_vector.FIRST + state_vector.OWN * slot + state_vector.TILT_X
        if math.hypot(x[at], x[at + 1]) < limit + 2.0 * math.sqrt(max(variance[at] + variance[at + 1], 0.0)):
            continue
        watch = track.watches.setdefault(lamp_id, Watch())
        watch.moved, watch.fitted = True, 0.0
        for j in (at, at + 1):
            state_vector.cut(track.P, track.n, j)
            track.x[j], track.P[j, j] = 0.0, lights.settings.model.lean**2


def relearn(lights: Lights, track: Track) -> None:
    """Learn the gain again of lamps whose RSS has long been off by a constant factor, up to `STRIKES` times."""
    for lamp_id, watch in track.watches.items():
        long = lights.course.t_mono - watch.t_run > RELEARN_S and lights.course.way - watch.way_run > RELEARN_M
        if not long or watch.strikes >= STRIKES or lamp_id not in track.slots:
            continue
        mean = watch.total / watch.count
        if mean < -HIDDEN:
            continue
        if watch.square / watch.count - mean * mean < STEADY**2:
            at = state_vector.FIRST + state_vector.OWN * track.slots[lamp_id]
            state_vector.cut(track.P, track.n, at)
            track.x[at] += mean
            track.P[at, at] = 0.3**2
            watch.t_bad = watch.way_bad = -math.inf
        watch.strikes += 1
        watch.t_run, watch.fitted = math.inf, 0.0


def forget(lights: Lights) -> None:
    """Remove lamps outside the survey that have not been received for long; those in a slot stay."""
    heard, now = lights.catalogue.heard, lights.course.t_mono
    oldest = next(iter(heard.values()), now)
    if now - oldest <= FORGET_S and len(heard) <= DESCRIBED:
        return
    slotted = set[int]().union(*(track.slots for track in lights.tracks))
    free = [lamp_id for lamp_id in heard if lamp_id not in slotted]
    beyond = len(heard) - DESCRIBED
    for k, lamp_id in enumerate(free):
        if k >= beyond and now - heard[lamp_id] <= FORGET_S:
            break
        lights.catalogue.drop(lamp_id)
        lights.gains.pop(lamp_id, None)
        lights.recalled.pop(lamp_id, None)
        lights.bent.lamps.pop(lamp_id, None)
        for track in lights.tracks:
            track.watches.pop(lamp_id, None)
