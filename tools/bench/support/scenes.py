"""Plain rooms to match in: walls as segments, columns as circles, and the ranges a lidar would measure in them."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """``walls`` (k, 4): x0, y0, x1, y1; ``columns`` (c, 3): x, y, radius; ``low``, ``high``: where to stand."""

    walls: Array
    low: tuple[float, float]
    high: tuple[float, float]
    columns: Array = field(default_factory=lambda: np.empty((0, 3)))

    def ranges(self, T: Array, bearing: Array, longest: float = 30.0) -> Array:
        """True distance along each bearing from pose ``T`` (x, y, yaw); ``inf`` beyond ``longest``."""
        return self.surfaces(T, bearing, longest)[0]

    def surfaces(self, T: Array, bearing: Array, longest: float = 30.0) -> tuple[Array, Array]:
        """The same with the unit normals (n, 2) of what was met, either way round; NaN where nothing was."""
        d = np.column_stack((np.cos(bearing + T[2]), np.sin(bearing + T[2])))
        best, normal = np.full(len(bearing), np.inf), np.full((len(bearing), 2), np.nan)
        a, e = self.walls[:, :2] - T[:2], self.walls[:, 2:] - self.walls[:, :2]
        det = d[:, 0, None] * -e[:, 1] + d[:, 1, None] * e[:, 0]
        det = np.where(np.abs(det) < 1e-12, np.nan, det)
        r = (a[:, 0] * -e[:, 1] + a[:, 1] * e[:, 0]) / det
        u = (d[:, 0, None] * a[:, 1] - d[:, 1, None] * a[:, 0]) / det
        r = np.where((r > 0.0) & (u >= 0.0) & (u <= 1.0), r, np.inf)
        if r.shape[1]:
            wall = r.argmin(axis=1)
            best = np.minimum(best, r.min(axis=1))
            across = np.column_stack((-e[:, 1], e[:, 0])) / np.hypot(e[:, 0], e[:, 1])[:, None]
            normal = np.where(np.isfinite(best)[:, None], across[wall], normal)
        for x, y, radius in self.columns:
            cx, cy = x - T[0], y - T[1]
            along = d[:, 0] * cx + d[:, 1] * cy
            inside = radius**2 - (cx**2 + cy**2 - along**2)
            near = along - np.sqrt(np.maximum(inside, 0.0))
            first = (inside > 0.0) & (near > 0.0) & (near < best)
            best = np.where(first, near, best)
            normal = np.where(first[:, None], (near[:, None] * d - (cx, cy)) / radius, normal)
        return np.where(best > longest, np.inf, best), np.where((best > longest)[:, None], np.nan, normal)

    def clear(self, T: Array, margin: float = 0.35) -> bool:
        """Whether nothing stands within ``margin`` of the pose."""
        return bool(self.ranges(T, np.linspace(-np.pi, np.pi, 180)).min() > margin)

    def place(self, rng: np.random.Generator) -> Array:
        """A random pose with some room around it."""
        while True:
            T = np.array((*rng.uniform(self.low, self.high), rng.uniform(-np.pi, np.pi)))
            if self.clear(T):
                return T


def box(x0: float, y0: float, x1: float, y1: float) -> list[tuple[float, float, float, float]]:
    """Four walls."""
    return [(x0, y0, x1, y0), (x1, y0, x1, y1), (x1, y1, x0, y1), (x0, y1, x0, y0)]


def paper_room() -> Scene:
    """10 x 10 m with four columns, as in the paper's evaluation."""
    columns = np.array([(x, y, 0.25) for x in (-2.5, 2.5) for y in (-2.5, 2.5)])
    return Scene(np.array(box(-5, -5, 5, 5)), (-4.5, -4.5), (4.5, 4.5), columns)


def office(seed: int = 4) -> Scene:
    """16 x 12 m: a corridor between two rows of furnished rooms, doors open."""
    rng = np.random.default_rng(seed)
    walls = box(0, 0, 16, 12)
    for y in (5.0, 7.0):
        for x in range(0, 16, 4):
            walls += [(x, y, x + 1.4, y), (x + 2.3, y, x + 4, y)]
    for x in (4.0, 8.0, 12.0):
        walls += [(x, 0, x, 5), (x, 7, x, 12)]
    for x in range(0, 16, 4):
        for y in (0.0, 7.0):
            for _ in range(3):
                cx, cy = x + rng.uniform(0.5, 3.5), y + rng.uniform(0.5, 4.5)
                w, h = rng.uniform(0.15, 0.6, 2)
                walls += box(cx - w, cy - h, cx + w, cy + h)
    return Scene(np.array(walls, dtype=np.float64), (0.4, 0.4), (15.6, 11.6))


def corridor() -> Scene:
    """60 x 2 m, plain: the long axis is only known near its ends."""
    return Scene(np.array(box(-30, -1, 30, 1), dtype=np.float64), (-10, -0.5), (10, 0.5))


def round_room() -> Scene:
    """A cylinder of 4 m radius: heading cannot be known."""
    angle = np.linspace(-np.pi, np.pi, 721)
    xy = 4.0 * np.column_stack((np.cos(angle), np.sin(angle)))
    return Scene(np.column_stack((xy[:-1], xy[1:])), (-0.3, -0.3), (0.3, 0.3))


def bearings(beams: int, fov_deg: float) -> Array:
    """Evenly spaced, symmetric about the front."""
    return np.radians(np.linspace(-0.5 * fov_deg, 0.5 * fov_deg, beams))
