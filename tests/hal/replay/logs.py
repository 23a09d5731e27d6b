"""Small logs written for the tests of this room."""

import gzip
from pathlib import Path

Pose = tuple[float, float, float]
RANGES = (2.0, 2.5, 3.0, 3.25, 81.83)


def flaser(
    stamp: float,
    count: int = 180,
    robot: Pose = (0, 0, 0),
    laser: Pose | None = None,
    ranges: tuple[float, ...] = RANGES,
) -> str:
    """A FLASER line whose ranges repeat ``ranges``."""
    values = " ".join(f"{ranges[i % len(ranges)]:.2f}" for i in range(count))
    poses = " ".join(f"{value:.6f}" for value in (*(laser or robot), *robot))
    return f"FLASER {count} {values} {poses} {stamp:.6f} host {stamp:.6f}"


def drive(scans: int, count: int = 180) -> list[str]:
    """A robot that creeps along x at 10 Hz."""
    return [flaser(100.0 + 0.1 * i, count, robot=(0.01 * i, 0.0, 0.0)) for i in range(scans)]


def robotlaser(stamp: float, angles: tuple[float, float, float], ranges: list[float], maximum: float) -> str:
    """A ROBOTLASER1 line with (start, field of view, resolution) and a laser 0.2 m ahead, 0.1 m left of the robot."""
    values = " ".join(f"{value:.3f}" for value in ranges)
    setup = " ".join(f"{value:.6f}" for value in angles)
    head = f"ROBOTLASER1 4 {setup} {maximum:.3f} 0.01 0 {len(ranges)} {values} 0"
    return f"{head} {stamp + 0.2:.6f} 0.1 0.1 {stamp:.6f} 0.0 0.1 0.1 0 0.2 0.1 1e9 {stamp:.6f} host {stamp:.6f}"


def write(path: Path, lines: list[str], end: str = "\n") -> Path:
    """Write lines, gzipped if the name says so."""
    data = ("\n".join(lines) + end).encode()
    path.write_bytes(gzip.compress(data) if path.suffix == ".gz" else data)
    return path
