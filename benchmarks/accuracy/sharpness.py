"""How sharp a map is: against true walls in simulation, against its own scans in a recording. Host arrays only."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from uwbslam_jax import MapImage, ScanMessage
from uwbslam_jax.evaluation import RigidMotion, rigid_fit
from uwbslam_jax.result import OCCUPIED_THRESHOLD

_FITTED = 2000
"""Cells that take part in a map's own fit, evenly."""
_ROUNDS = 8
STRAY_M = 0.15
"""An occupied cell farther than this from any wall is no blur but a second wall [m]."""


def occupied(image: MapImage, motion: RigidMotion) -> np.ndarray:
    """Centres (n, 2) of the occupied cells, moved from the map's frame into that of the walls [m]."""
    row, col = np.nonzero(image.log_odds > np.log(OCCUPIED_THRESHOLD / (1 - OCCUPIED_THRESHOLD)))
    return motion.points(image.origin + (np.column_stack([col, row]) + 0.5) * image.resolution)


def wall_distances(points: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Distance of points (n, 2) from the nearest of the walls (S, 4), (n,) [m]."""
    return np.linalg.norm(points - _nearest(points, segments), axis=1)


def own_fit(points: np.ndarray, segments: np.ndarray) -> RigidMotion:
    """The small motion that lays a map's occupied cells (n, 2) over the walls (S, 4): where the whole map is off, none
    of its walls is doubled. Iterated closest points, begun at no motion."""
    chosen = points[:: max(len(points) // _FITTED, 1)]
    motion = RigidMotion(np.eye(2), np.zeros(2))
    for _ in range(_ROUNDS if len(chosen) > 1 else 0):
        motion = rigid_fit(chosen, _nearest(motion.points(chosen), segments))
    return motion


def _nearest(points: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """The place on the walls (S, 4) that is nearest to each point (n, 2), (n, 2) [m]."""
    nearest = np.zeros_like(points)
    best = np.full(len(points), np.inf)
    for x1, y1, x2, y2 in segments:
        start, along = np.array([x1, y1]), np.array([x2 - x1, y2 - y1])
        share = np.clip((points - start) @ along / max(along @ along, 1e-30), 0.0, 1.0)
        place = start + share[:, None] * along
        distance = np.sum((points - place) ** 2, axis=1)
        closer = distance < best
        best[closer], nearest[closer] = distance[closer], place[closer]
    return nearest


def sharpness(distances: np.ndarray, resolution: float) -> float:
    """Share of the occupied cells within one cell of a true wall, NaN for an empty map."""
    return float(np.mean(distances <= resolution)) if len(distances) else float("nan")


def stray(distances: np.ndarray) -> float:
    """Share of the occupied cells that lie apart from every true wall, NaN for an empty map."""
    return float(np.mean(distances > STRAY_M)) if len(distances) else float("nan")


def scan_misfit(
    image: MapImage,
    stamps: np.ndarray,
    poses: np.ndarray,
    scans: Iterable[ScanMessage],
    lidar: tuple[float, float, float],
    limits: tuple[float, float],
) -> float:
    """Mean 1 - Gamma over all returns of all scans against the final map; 0 were a map without blur and error.

    Args:
      stamps, poses: (T,) [ns], (T, 3) the track that the scans were taken on [m, m, rad].
      lidar: its pose on the robot [m, m, rad].
      limits: shortest and longest reading that counts [m].
    """
    seconds = (stamps - stamps[0]) / 1e9
    columns = [poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2])]
    total, count = 0.0, 0
    for scan in scans:
        reach = np.asarray(scan.ranges, float)
        low, high = max(limits[0], scan.range_min), min(limits[1], scan.range_max)
        beam = np.flatnonzero(np.isfinite(reach) & (reach >= low) & (reach <= high))
        when = (scan.stamp - stamps[0]) / 1e9 + beam * scan.time_increment
        x, y, yaw = (np.interp(when, seconds, column) for column in columns)
        bearing = yaw + lidar[2] + scan.angle_min + beam * scan.angle_increment
        c, s = np.cos(yaw), np.sin(yaw)
        ends = np.column_stack([x + c * lidar[0] - s * lidar[1], y + s * lidar[0] + c * lidar[1]])
        ends += reach[beam, None] * np.stack([np.cos(bearing), np.sin(bearing)], -1)
        total += float(np.sum(1.0 - _gamma(image, ends)))
        count += len(beam)
    return total / count if count else float("nan")


def _gamma(image: MapImage, points: np.ndarray) -> np.ndarray:
    """Occupancy (n,) at points (n, 2) [m], bilinear between the centres of the cells; 0.5 outside."""
    at = (points - image.origin) / image.resolution - 0.5
    corner = np.floor(at).astype(int)
    rows, cols = image.log_odds.shape
    inside = (corner >= 0).all(axis=1) & (corner[:, 0] <= cols - 2) & (corner[:, 1] <= rows - 2)
    corner = np.where(inside[:, None], corner, 0)
    fx, fy = (at - corner).T
    value = np.zeros(len(points))
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        odds = image.log_odds[corner[:, 1] + down, corner[:, 0] + right] if inside.any() else np.zeros(len(points))
        value += (fy if down else 1.0 - fy) * (fx if right else 1.0 - fx) / (1.0 + np.exp(-odds.astype(float)))
    return np.where(inside, value, 0.5)
