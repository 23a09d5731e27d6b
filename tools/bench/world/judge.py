"""What was read from the robot computer against the truth, and against what a scenario expects."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from tools.bench.report.plots import Plot, Series, histogram
from tools.bench.report.result import Figure, Seen
from tools.bench.world.scenario import GAP_S, Expectation, Scenario
from tools.clients.read_modbus import STATES
from tools.sim.robot.drive import Body
from tools.sim.robot.truth import in_map

Array = npt.NDArray[np.float64]
Pose = tuple[float, float, float]
TOLD: Final = 3
"""How many reads that fail are named."""
FAR: Final = 1.5
"""An error of so many times what is allowed is hardly one of the estimate."""
MOUNTED: Final = (
    f"; has the robot computer's configuration [lidar] mount = {{ x = {Body().lidar[0]:g} }}, where the simulated "
    "robot carries its lidar? (--write-config writes it)"
)


@dataclass(frozen=True, slots=True)
class Read:
    """One read over Modbus. Times in s since the robot set off.

    Attributes:
        t: when it was answered. t_pose: instant that the pose is true for; NaN where there is none.
        pose: in the robot's map. sigma_m: the larger of x and y. answered: False: nobody has answered.
        fresh: not read before.
        lamps: (lamp ID, photocurrent in A), strongest first, where they were asked for.
        jumps: how often the map pose has moved against the odom pose at once. loops: how many have been closed.
    """

    t: float
    state: str = ""
    fault: int = 0
    t_pose: float = math.nan
    pose: Pose | None = None
    sigma_m: float = 0.0
    answered: bool = True
    fresh: bool = False
    lamps: tuple[tuple[int, float], ...] = ()
    jumps: int = 0
    loops: int = 0


@dataclass(frozen=True, slots=True)
class Played:
    """All of a run.

    Attributes:
        reads: of the whole drive. truth: true poses (n, 3) of the robot in the room's frame, m and rad, at times (n,)
            in s since it set off.
        standing: poses read while it stood, before it set off, in its map, m and rad. lamps: IDs of those overhead;
            strongest: the truly strongest one's at a time, s, None: nothing is received.
    """

    scenario: Scenario
    reads: Sequence[Read]
    truth: Callable[[Array], Array]
    standing: Sequence[Pose]
    lamps: frozenset[int] = frozenset()
    strongest: Callable[[float], int | None] = lambda t: None
    facts: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Poses less the truth, both in the robot's map: (n,) times, (n, 3) errors in m and rad, (n, 3) poses, sigmas.

    ``t_site``: when its map began to lie where the lamps' survey does, inf: it never has.
    """

    t: Array
    off: Array
    pose: Array
    sigma: Array
    t_site: float = math.inf

    @property
    def metres(self) -> Array:
        """(n,)."""
        return np.asarray(np.hypot(self.off[:, 0], self.off[:, 1]))

    @property
    def truth(self) -> Array:
        """(n, 2) true places in the robot's map, m."""
        return np.asarray(self.pose[:, :2] - self.off[:, :2])


def errors_of(played: Played) -> Errors:
    """Of every read that has a pose; the map lies where the robot said it was while it stood.

    Under surveyed lamps it lies so until light has told where the survey lies, and there from then on: once, with a
    jump that is counted, to where the pose is nearer to the truth that way. A pose that is wrong without one is judged
    where the map was before.
    """
    kept = [one for one in played.reads if one.pose is not None and one.fresh]
    t = np.array([one.t_pose for one in kept])
    pose = np.array([one.pose for one in kept], dtype=np.float64).reshape(-1, 3)
    start = played.truth(np.zeros(1))[0]
    told = middle_of(np.array(played.standing, dtype=np.float64).reshape(-1, 3))
    site = played.truth(t) if len(t) else np.zeros((0, 3))
    truth = in_map(site, start, told)
    t_site = math.inf
    if played.lamps and len(t):
        nearer = np.hypot(*(pose - site)[:, :2].T) < np.hypot(*(pose - truth)[:, :2].T)
        jumped = np.diff([one.jumps for one in kept], prepend=0) != 0
        moved = np.logical_or.accumulate(nearer & jumped)
        truth = np.where(moved[:, None], site, truth)
        t_site = float(t[np.argmax(moved)]) if moved.any() else math.inf
    off = pose - truth
    off[:, 2] = np.remainder(off[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    return Errors(t, off, pose, np.array([one.sigma_m for one in kept]), t_site)


def middle_of(poses: Array) -> Array:
    """The median (3,) of poses (n, 3) that lie near each other; a heading of pi is near one of -pi."""
    first = np.array((0.0, 0.0, poses[0, 2]))
    turned = poses - first
    turned[:, 2] = np.remainder(turned[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    return np.asarray(np.median(turned, axis=0) + first)


def judged(expected: Expectation, played: Played) -> tuple[bool, Seen]:
    """Whether it is as expected, and what was seen."""
    until = _end(expected, played)
    window = [one for one in played.reads if expected.from_ <= one.t <= until]
    if not window:
        return False, Seen("nothing was read in that time")
    return JUDGES[expected.what](expected, played, window)


def _end(expected: Expectation, played: Played) -> float:
    """When its window ends, s."""
    until = expected.until or played.scenario.drive.seconds
    return min(until, expected.from_ + expected.within) if expected.what in ("state", "fault", "clear") else until


def spans_of(expected: Expectation, played: Played) -> Array:
    """(n,) s of the window for which each of all reads stands: the time since the one before, or since it set off.

    One that nobody answers takes fifty times as long as one that is answered: counted, an outage would nearly vanish.
    """
    t = np.array([one.t for one in played.reads])
    before = np.concatenate([[0.0], t[:-1]])
    return np.asarray(np.maximum(np.minimum(t, _end(expected, played)) - np.maximum(before, expected.from_), 0.0))


def _share_of(so: Callable[[Read], bool], expected: Expectation, played: Played) -> float:
    """For which share of the window it was so."""
    spans = spans_of(expected, played)
    held = sum(span for one, span in zip(played.reads, spans.tolist(), strict=True) if span and so(one))
    return held / float(spans.sum()) if spans.any() else 0.0


Verdict = tuple[bool, Seen]


def _unseen(expected: Expectation, played: Played, window: list[Read]) -> tuple[float, float]:
    """The longest time in the window without a new pose, and when it began, s."""
    new = [one.t for one in window if one.fresh and one.pose is not None]
    t = np.array([expected.from_, *new, _end(expected, played)])
    longest = int(np.argmax(np.diff(t)))
    return float(np.diff(t)[longest]), float(t[longest])


def _error(expected: Expectation, played: Played, window: list[Read]) -> Verdict:
    found = errors_of(played)
    within = (found.t >= window[0].t) & (found.t <= window[-1].t)
    if not within.any():
        return False, Seen("no pose was read in that time")
    if played.lamps and found.t_site == math.inf:
        return False, Seen("light has never told where the survey lies, so no pose is a place in it")
    metres, allowed = found.metres[within], expected.at_most + expected.sigmas * found.sigma[within]
    worst = int(np.argmax(metres - allowed))
    unseen, since = _unseen(expected, played, window)
    figures = (
        Figure("error, median", 1e3 * float(np.median(metres)), "mm", "more", 0.5, 5.0),
        Figure("error, largest", 1e3 * float(metres.max()), "mm", "more", 0.5, 10.0),
        Figure("heading, largest", float(np.degrees(np.abs(found.off[within, 2]).max())), "deg", "more", 0.5, 0.5),
        Figure("longest without a new pose", unseen, "s", "more", 0.5, 0.5),
    )
    said = f"{len(metres)} poses; {metres[worst]:.3f} m where {allowed[worst]:.3f} is allowed, "
    said += f"at {found.t[within][worst]:.1f} s"
    if metres[worst] > FAR * allowed[worst]:
        said += MOUNTED
    longest = expected.gap or GAP_S
    if unseen > longest:
        said += f"; no new pose for {unseen:.1f} s from {since:.1f} s on, where {longest:g} s are allowed (gap)"
    return bool((metres <= allowed).all()) and unseen <= longest, Seen(said, figures)


def _first(window: list[Read], so: Callable[[Read], bool], expected: Expectation, name: str) -> Verdict:
    """The first read that is so."""
    for one in window:
        if one.answered and so(one):
            after = one.t - expected.from_
            return True, Seen(f"after {after:.2f} s", (Figure(name, after, "s", "more", 0.5, 0.5),))
    seen = sorted({f"{one.state} fault {one.fault}" for one in window if one.answered}) or ["no answer"]
    return False, Seen(f"not within {expected.within:g} s; there was {', '.join(seen)}")


def _state(expected: Expectation, played: Played, window: list[Read]) -> Verdict:
    return _first(
        window, lambda one: one.state in expected.is_, expected, f"{' or '.join(map(str, expected.is_))} after"
    )


def _fault(expected: Expectation, played: Played, window: list[Read]) -> Verdict:
    return _first(window, lambda one: one.fault in expected.is_, expected, f"fault {expected.is_[0]} after")


def _clear(expected: Expectation, played: Played, window: list[Read]) -> Verdict:
    return _first(window, lambda one: one.fault == 0, expected, "no fault after")


def _never(expected: Expectation, played: Played, window: list[Read]) -> Verdict:
    heard = [one for one in window if one.answered]
    if not heard:
        return False, Seen("nobody answered in that time")
    wrong = [f"{one.state} at {one.t:.1f} s" for one in heard if one.state in expected.is_]
    return not wrong, Seen("; ".join(wrong[:TOLD]) or f"never in {len(heard)} reads")


def _share(expected: Expectation, played: Played, window: list[Read]) -> Verdict:
    share = _share_of(lambda one: one.state in expected.is_, expected, played)
    name = f"{' or '.join(map(str, expected.is_))}"
    return share >= expected.at_least, Seen("", (Figure(name, 100.0 * share, "%", "less", 0.05),))


def _age(expected: Expectation, played: Played, window: list[Read]) -> Verdict:
    ages = [one.t - one.t_pose for one in window if math.isfinite(one.t_pose)]
    if not ages:
        return False, Seen("no pose was read in that time")
    middle = float(np.median(ages))
    figures = (
        Figure("age, median", 1e3 * middle, "ms", "more", 0.25, 10.0),
        Figure("age, 99 %", 1e3 * float(np.quantile(ages, 0.99)), "ms", "more", 0.5, 50.0),
    )
    return middle <= expected.at_most, Seen("", figures)


def _answers(expected: Expectation, played: Played, window: list[Read]) -> Verdict:
    share = _share_of(lambda one: one.answered, expected, played)
    return share >= expected.at_least, Seen("", (Figure("answered", 100.0 * share, "%", "less", 0.01),))


def _lamps(expected: Expectation, played: Played, window: list[Read]) -> Verdict:
    heard = [one for one in window if one.lamps]
    if not heard:
        return False, Seen("no lamp was received")
    strange = {lamp for one in heard for lamp, _ in one.lamps} - played.lamps

    def right(one: Read) -> bool:
        at = one.t_pose if math.isfinite(one.t_pose) else one.t
        return bool(one.lamps) and one.lamps[0][0] == played.strongest(at)

    share = _share_of(right, expected, played)
    known = len({lamp for one in heard for lamp, _ in one.lamps} & played.lamps)
    figures = (
        Figure("strongest lamp right", 100.0 * share, "%", "less", 0.1),
        Figure("lamps received", known, f"of {len(played.lamps)}", "less", 0.1),
    )
    said = f"IDs that no lamp has: {sorted(strange)}" if strange else "no ID that no lamp has"
    return not strange and share >= expected.at_least, Seen(said, figures)


JUDGES: Final[dict[str, Callable[[Expectation, Played, list[Read]], Verdict]]] = {
    "error": _error, "state": _state, "never": _never, "share": _share, "fault": _fault, "clear": _clear,
    "age": _age, "answers": _answers, "lamps": _lamps,
}  # fmt: skip


def pictures(played: Played) -> tuple[Plot, ...]:
    """Way, error, states, ages; when faults began and ended."""
    found = errors_of(played)
    struck = [float(fault.get("when", 0.0)) for fault in played.scenario.faults]
    struck += [
        float(fault.get("when", 0.0)) + float(fault["for"]) for fault in played.scenario.faults if "for" in fault
    ]
    marks = (Series("faults", struck, struck, "marks"),) if struck else ()
    t = [one.t for one in played.reads]
    states = [float(STATES.index(one.state)) if one.state in STATES else math.nan for one in played.reads]
    ages = [1e3 * (one.t - one.t_pose) for one in played.reads]
    return (
        Plot(
            "trajectory", "x m", "y m",
            (_line("truth", *found.truth.T), _line("published", found.pose[:, 0], found.pose[:, 1])), square=True,
        ),
        Plot(
            "error", "s", "mm",
            (_line("error", found.t, 1e3 * found.metres), _line("three sigma", found.t, 3e3 * found.sigma), *marks),
        ),
        Plot(f"state: {', '.join(f'{k} {name}' for k, name in enumerate(STATES))}", "s", "",
             (Series("", t, states, "dots"), *marks)),
        histogram("age of poses that were read", "ms", ages),
    )  # fmt: skip


def _line(name: str, x: Array, y: Array) -> Series:
    return Series(name, x.tolist(), y.tolist())
