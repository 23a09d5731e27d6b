"""What a lidar can hit: wall segments and round columns with optical materials, kept in a cell index for ray casting.

The physics here is richer than any model in the estimator and shares no code with it; only the compiler decorator is
common. Units are metres and radians in the building's own frame (x east, y north).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int32]
Point = tuple[float, float]

SEGMENT: Final = 0.0
CIRCLE: Final = 1.0
CELL_M: Final = 0.75


@dataclass(frozen=True, slots=True)
class Material:
    """How a surface answers light of 905 nm.

    Attributes:
        albedo: diffuse (Lambertian) reflectance.
        mirror: specular reflectance at normal incidence; it grows to 1 at grazing incidence (Schlick's approximation
            of Fresnel's equations); 0 is a perfectly matt surface.
        clear: share of what is not mirrored that goes through.
    """

    albedo: float
    mirror: float = 0.0
    clear: float = 0.0


MATERIALS: Final[dict[str, Material]] = {
    "wall": Material(0.75),
    "wood": Material(0.50),
    "cardboard": Material(0.60),
    "cloth": Material(0.30),
    "black": Material(0.04),
    "steel": Material(0.20, mirror=0.35),
    "polished": Material(0.10, mirror=0.80),
    # a pane has two surfaces of 4 % each; what little scatters back off its normal is dust
    "glass": Material(0.0008, mirror=0.08, clear=1.0),
}
MATERIAL_ID: Final = {name: number for number, name in enumerate(MATERIALS)}


def material_table() -> Array:
    """Rows (albedo, mirror, clear) in the order of :data:`MATERIAL_ID`."""
    return np.array([(m.albedo, m.mirror, m.clear) for m in MATERIALS.values()])


@dataclass(frozen=True, slots=True, eq=False)
class SimWorld:
    """The standing part of a building.

    Attributes:
        shapes: (n, 6) rows ``kind, a, b, c, d, material``: a segment's two ends, or a circle's centre and radius.
        cell_start, cell_items: numbers of shapes by cell, compressed rows; cell ``iy * nx + ix``.
        frame: (x0, y0, cell size, nx, ny) of the cells; all rays must start inside.
        polished: (k, 4) rectangles ``x_min, y_min, x_max, y_max`` of polished floor; elsewhere the floor is matt.
        tops: (n,) height of each shape, inf: up to the ceiling. Light from above sees it, a lidar does not.
        shelves: (k, 6) boxes ``x_min, y_min, x_max, y_max, low, top`` above all lidars; only lamps see them.
    """

    shapes: Array
    cell_start: Index
    cell_items: Index
    frame: Array
    polished: Array
    tops: Array = field(default_factory=lambda: np.zeros(0))
    shelves: Array = field(default_factory=lambda: np.zeros((0, 6)))

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Extent ``x_min, y_min, x_max, y_max`` of what may be driven and seen."""
        x0, y0, cell, nx, ny = self.frame
        return float(x0), float(y0), float(x0 + cell * nx), float(y0 + cell * ny)

    def polished_at(self, points: Array) -> npt.NDArray[np.bool_]:
        """Whether the floor under each of (n, 2) points is polished."""
        inside = np.zeros(len(points), dtype=bool)
        for x_min, y_min, x_max, y_max in self.polished:
            inside |= (
                (points[:, 0] >= x_min) & (points[:, 0] <= x_max) & (points[:, 1] >= y_min) & (points[:, 1] <= y_max)
            )
        return inside

    def clearance(self, points: Array) -> Array:
        """Distance from each of (n, 2) points to the nearest surface."""
        best = np.full(len(points), np.inf)
        for kind, a, b, c, d, _ in self.shapes:
            if kind == CIRCLE:
                distance = np.abs(np.hypot(points[:, 0] - a, points[:, 1] - b) - c)
            else:
                distance = _segment_distance(points, (a, b, c, d))
            np.minimum(best, distance, out=best)
        return best


def _segment_distance(points: Array, ends: tuple[float, float, float, float]) -> Array:
    x1, y1, x2, y2 = ends
    dx, dy = x2 - x1, y2 - y1
    along = ((points[:, 0] - x1) * dx + (points[:, 1] - y1) * dy) / max(dx * dx + dy * dy, 1e-18)
    along = np.clip(along, 0.0, 1.0)
    return np.asarray(np.hypot(points[:, 0] - x1 - along * dx, points[:, 1] - y1 - along * dy))


@dataclass(slots=True)
class Plan:
    """A drawing board: collects shapes, then :meth:`build` makes the indexed :class:`SimWorld`."""

    rows: list[tuple[float, float, float, float, float, float]] = field(default_factory=list)
    floors: list[tuple[float, float, float, float]] = field(default_factory=list)
    tops: list[float] = field(default_factory=list)
    shelves: list[tuple[float, float, float, float, float, float]] = field(default_factory=list)

    def line(self, a: Point, b: Point, material: str = "wall", top: float = np.inf) -> None:
        """A surface from ``a`` to ``b``, seen from both sides; ``top`` is its height."""
        self.rows.append((SEGMENT, a[0], a[1], b[0], b[1], float(MATERIAL_ID[material])))
        self.tops.append(top)

    def circle(self, centre: Point, radius: float, material: str = "wall", top: float = np.inf) -> None:
        """A round column, leg or post."""
        self.rows.append((CIRCLE, centre[0], centre[1], radius, 0.0, float(MATERIAL_ID[material])))
        self.tops.append(top)

    def outline(self, points: list[Point], material: str = "wall", top: float = np.inf) -> None:
        """A closed polygon."""
        for a, b in zip(points, points[1:] + points[:1], strict=True):
            self.line(a, b, material, top)

    def box(self, centre: Point, size: Point, yaw: float = 0.0, material: str = "wood", top: float = np.inf) -> None:
        """A rectangle of ``size`` (length, width) turned by ``yaw``."""
        c, s = np.cos(yaw), np.sin(yaw)
        half = ((0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5))
        local = [(size[0] * u, size[1] * v) for u, v in half]
        self.outline([(centre[0] + c * x - s * y, centre[1] + s * x + c * y) for x, y in local], material, top)

    def shelf(self, x: Point, y: Point, z: Point) -> None:
        """Shelves with what is on them, above all lidars: extents along x, y and height."""
        self.shelves.append((x[0], y[0], x[1], y[1], z[0], z[1]))

    def wall(self, a: Point, b: Point, gaps: list[Point] | None = None, thickness: float = 0.12) -> None:
        """A thick wall along ``a``-``b`` with openings ``(from, to)`` in metres from ``a``, faces and reveals drawn."""
        length = float(np.hypot(b[0] - a[0], b[1] - a[1]))
        ux, uy = (b[0] - a[0]) / length, (b[1] - a[1]) / length
        edges = [0.0, *(edge for gap in sorted(gaps or []) for edge in gap), length]
        for begin, end in zip(edges[0::2], edges[1::2], strict=True):
            if end - begin > 1e-6:
                middle = 0.5 * (begin + end)
                centre = (a[0] + ux * middle, a[1] + uy * middle)
                self.box(centre, (end - begin, thickness), float(np.arctan2(uy, ux)), "wall")

    def polish(self, x_min: float, y_min: float, x_max: float, y_max: float) -> None:
        """Declare a rectangle of floor to be polished."""
        self.floors.append((x_min, y_min, x_max, y_max))

    def build(self, margin: float = 2.0) -> SimWorld:
        """Index everything drawn so far; raises ValueError for an empty plan."""
        if not self.rows:
            raise ValueError("an empty plan has nothing to see; draw at least one line or circle")
        shapes = np.array(self.rows, dtype=np.float64)
        x_min, y_min, x_max, y_max = _extent(shapes)
        x0, y0 = x_min - margin, y_min - margin
        nx = int(np.ceil((x_max + margin - x0) / CELL_M))
        ny = int(np.ceil((y_max + margin - y0) / CELL_M))
        frame = np.array([x0, y0, CELL_M, nx, ny])
        start, items = _fill_cells(shapes, frame)
        floors = np.array(self.floors, dtype=np.float64).reshape(-1, 4)
        shelves = np.array(self.shelves, dtype=np.float64).reshape(-1, 6)
        return SimWorld(shapes, start, items, frame, floors, np.array(self.tops), shelves)


def _extent(shapes: Array) -> tuple[float, float, float, float]:
    round_ = shapes[:, 0] == CIRCLE
    reach = np.where(round_, shapes[:, 3], 0.0)
    x_b = np.where(round_, shapes[:, 1], shapes[:, 3])
    y_b = np.where(round_, shapes[:, 2], shapes[:, 4])
    x = np.concatenate([shapes[:, 1] - reach, shapes[:, 1] + reach, x_b])
    y = np.concatenate([shapes[:, 2] - reach, shapes[:, 2] + reach, y_b])
    return float(x.min()), float(y.min()), float(x.max()), float(y.max())


def _fill_cells(shapes: Array, frame: Array) -> tuple[Index, Index]:
    """Which shapes touch which cell; a cell counts as touched a hair beyond its edge, so that none is missed."""
    x0, y0, cell = frame[:3]
    nx, ny = int(frame[3]), int(frame[4])
    touched: list[list[int]] = [[] for _ in range(nx * ny)]
    reach = cell * np.sqrt(0.5) + 1e-6
    for number, shape in enumerate(shapes):
        x_min, y_min, x_max, y_max = _extent(shape[None, :])
        ix = np.arange(int((x_min - x0 - 1e-6) / cell), int((x_max - x0 + 1e-6) / cell) + 1)
        iy = np.arange(int((y_min - y0 - 1e-6) / cell), int((y_max - y0 + 1e-6) / cell) + 1)
        gx, gy = (grid.ravel() for grid in np.meshgrid(ix, iy))
        centres = np.column_stack([x0 + (gx + 0.5) * cell, y0 + (gy + 0.5) * cell])
        if shape[0] == SEGMENT:
            near = _segment_distance(centres, tuple(shape[1:5])) <= reach
        else:
            near = np.abs(np.hypot(centres[:, 0] - shape[1], centres[:, 1] - shape[2]) - shape[3]) <= reach
        for flat in (gy * nx + gx)[near]:
            touched[flat].append(number)
    start = np.zeros(nx * ny + 1, dtype=np.int32)
    start[1:] = np.cumsum([len(items) for items in touched])
    return start, np.array([n for items in touched for n in items], dtype=np.int32)
