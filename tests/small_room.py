"""A small room in numpy: what a LiDAR and radios in it measure, without noise. Independent of the simulator."""

from __future__ import annotations

import numpy as np

from uwbslam_jax.measurements import Frame, Odometry, Ranges, Scan
from uwbslam_jax.settings import Config

CORNERS = np.array([[-4.0, -3.0], [4.5, -3.0], [4.5, 1.0], [2.0, 1.0], [2.0, 3.5], [-4.0, 3.5]]) + 0.05
"""An L-shaped room [m]: no rotation or reflection maps it to itself. Its walls run through middles of 0.1 m cells."""
WALLS = np.stack([CORNERS, np.roll(CORNERS, -1, axis=0)], axis=1)


def cast(origin: np.ndarray, bearings: np.ndarray, walls: np.ndarray = WALLS) -> np.ndarray:
    """Distance from a point to the nearest wall along each bearing [m], inf where there is none."""
    u = np.stack([np.cos(bearings), np.sin(bearings)], axis=-1)[:, None]  # (B, 1, 2)
    a, e = walls[:, 0] - origin, walls[:, 1] - walls[:, 0]  # (W, 2)
    det = u[..., 1] * e[:, 0] - u[..., 0] * e[:, 1]
    det = np.where(np.abs(det) < 1e-12, 1e-12, det)
    along = (a[:, 1] * e[:, 0] - a[:, 0] * e[:, 1]) / det
    part = (u[..., 0] * a[:, 1] - u[..., 1] * a[:, 0]) / det
    hits = (along > 0) & (part >= 0) & (part <= 1)
    return np.where(hits, along, np.inf).min(axis=1)


def scan(pose: np.ndarray, beams: int, walls: np.ndarray = WALLS, lidar=(0.0, 0.0, 0.0)) -> Scan:
    """A full turn of beams from a pose [m, m, rad], starting at -180 degrees, all taken at once."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    origin = pose[:2] + np.array([c * lidar[0] - s * lidar[1], s * lidar[0] + c * lidar[1]])
    increment = 2 * np.pi / beams
    reach = cast(origin, pose[2] + lidar[2] - np.pi + increment * np.arange(beams), walls)
    ok = np.isfinite(reach)
    return Scan(
        np.where(ok, reach, 0.0).astype(np.float32), ok, np.float32(-np.pi), np.float32(increment), np.float32(0.0)
    )


def no_scan(beams: int) -> Scan:
    """A frame's slots for a scan where there is none."""
    zero = np.float32(0)
    return Scan(np.zeros(beams, np.float32), np.zeros(beams, bool), zero, np.float32(1e-3), zero)


def ranges(pairs: list[tuple[int, int]], distances, size: int, age=0.0, gap=np.nan) -> Ranges:
    """Ranges of pairs of slots in a frame's slots."""
    n = len(pairs)
    i, j = np.zeros(size, np.int32), np.ones(size, np.int32)
    distance, ages, gaps = np.zeros(size, np.float32), np.zeros(size, np.float32), np.full(size, np.nan, np.float32)
    i[:n], j[:n] = [p[0] for p in pairs], [p[1] for p in pairs]
    distance[:n], ages[:n], gaps[:n] = distances, age, gap
    return Ranges(i, j, distance, ages, gaps, np.arange(size) < n)


def all_pairs(nodes: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(nodes) for j in range(i + 1, nodes)]


def distances(points: np.ndarray, pairs: list[tuple[int, int]]) -> np.ndarray:
    """Distance of each pair of points (K, 2) [m]."""
    return np.array([np.hypot(*(points[i] - points[j])) for i, j in pairs])


def no_odometry() -> Odometry:
    return Odometry(np.zeros(3, np.float32), np.bool_(False))


def frame(config: Config, dt: float, scan: Scan | None, ranges: Ranges, odometry: Odometry | None = None) -> Frame:
    """One frame of measurements."""
    return Frame(
        np.float32(dt),
        np.bool_(scan is not None),
        no_scan(config.max_beams) if scan is None else scan,
        ranges,
        no_odometry() if odometry is None else odometry,
    )
