"""Maps for tests of the store: any shape and content, made of numbers and of nothing that was ever driven."""

from dataclasses import dataclass

import numpy as np

from daemon.maps.image import meta_of, packed
from estimator.light_filter.survey import Lamp, Survey
from estimator.mapping.constraints import Constraints
from estimator.mapping.keyframe import Keyframe, Settled, Submap
from estimator.mapping.map_snapshot import Identity, MapImage, Piece
from estimator.measurements import Array
from estimator.numerics import se2
from estimator.result import Virtual

LAMPS = tuple(Lamp(k + 1, k % 5, 2.0 * k, 1.0, 2.8) for k in range(6))
SURVEY = Survey(LAMPS)


@dataclass(frozen=True)
class Shape:
    """How large a map is to be, and of what kind.

    Attributes:
        whole: ranges are whole millimetres. lit: light has told places. loose: submaps joined with nothing.
    """

    submaps: int = 4
    frames: int = 3
    beams: int = 31
    whole: bool = True
    lit: bool = False
    loose: int = 0
    map_id: int = 0x1234
    survey: str = ""
    lamps: tuple[Lamp, ...] = LAMPS


def image(shape: Shape, seed: int = 0) -> MapImage:
    """A map of that shape."""
    rng = np.random.default_rng(seed)
    fans = [np.linspace(-2.0, 2.0, shape.beams), np.linspace(-1.0, 1.0, max(1, shape.beams // 2))]
    pieces, frames = [], []
    for k in range(shape.submaps):
        key = 2 * k + 1
        submap = Submap(key, 10 * key, pose(rng), pose(rng), 3.0 * k)
        mine = [frame(rng, shape, 10 * key + n, submap, fans[n % 2]) for n in range(shape.frames)]
        seen = mine[-1] if mine else frame(rng, shape, 10 * key, submap, fans[0])
        elements = rng.normal(size=(int(rng.integers(1, 9)), 8)).astype(np.float32)
        submap.settled = Settled(elements, seen, 0.01)
        submap.light = told(rng) if shape.lit and k % 2 else None
        T_map, T_odom = submap.T_map_submap, submap.T_odom_submap
        pieces.append(Piece(key, submap.first, T_map, T_odom, submap.way_m, submap.settled, submap.light))
        frames += mine[: 1 + k]
    joined = [(2 * k + 1, 2 * k + 3) for k in range(shape.submaps - 1 - shape.loose)]
    n = len(joined)
    constraints = Constraints(
        np.array(joined, np.int64).reshape(-1, 2), rng.normal(size=(n, 3)), rng.normal(size=(n, 6)), rng.random(n) < 0.5
    )
    return MapImage(
        identity=Identity(shape.map_id, "second floor, Süd", shape.lit, shape.survey, 2),
        submaps=tuple(pieces),
        constraints=constraints,
        frames=tuple(frames),
        gains={lamp.lamp_id: (rng.normal(size=3), rng.random(3) + 0.01) for lamp in shape.lamps} if shape.lit else {},
        sensors=(rng.normal(size=9), rng.random(9)) if shape.lit else None,
        lamps=shape.lamps if shape.lit else (),
        T_map_base=pose(rng),
        P=np.diag(rng.random(3)),
    )


def frame(rng: np.random.Generator, shape: Shape, key: int, submap: Submap, fan: Array) -> Keyframe:
    ranges = rng.uniform(0.1, 30.0, len(fan))
    if shape.whole:
        ranges = np.round(ranges, 3)
    elif key % 3 == 0:
        ranges[0] = np.nan
    light = Virtual(*told(rng), frozenset(rng.integers(1, 99, 3).tolist())) if shape.lit and key % 2 else None
    beam = rng.integers(0, 3, len(fan)).astype(np.uint8)
    return Keyframe(key, submap, pose(rng), pose(rng), fan, float(rng.normal()), ranges.astype(np.float32), beam, light)


def pose(rng: np.random.Generator) -> Array:
    x, y, yaw = rng.normal(size=3) * (10.0, 10.0, 1.0)
    return np.array((x, y, se2.wrap(float(yaw))))


def told(rng: np.random.Generator) -> tuple[Array, Array]:
    return pose(rng), np.diag(rng.random(3))


def content(shape: Shape | None = None, seed: int = 0) -> bytes:
    """A map file."""
    made = image(shape or Shape(), seed)
    return packed(made, meta_of(made, 1.5e9, "robot", "0.1"))
