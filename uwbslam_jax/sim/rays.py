"""Exact ray casting against line segments, and their distance from points. Pure geometry of walls seen from above.

Segments are (S, 4) float64, x1, y1, x2, y2 [m].
"""

from __future__ import annotations

import numpy as np


def cast(segments: np.ndarray, origins: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Distance along each ray to the first segment that it meets, inf where there is none; see `strike`."""
    return strike(segments, origins, angles)[0]


def strike(segments: np.ndarray, origins: np.ndarray, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far along each ray the first segment is that it meets, and at what angle it meets it.

    A segment is tried only against the rays whose bearing falls into the arc under which it is seen, so the cost is
    that of the crossings and not rays times segments.

    Args:
      segments: (S, 4) [m].
      origins: (2,) or (B, 2) start of each ray [m]; they may differ by what a robot drives during one sweep.
      angles: (B,) bearing of each ray in the world [rad], increasing, of at most one turn in all.

    Returns:
      (B,) distance [m], inf where nothing is met; (B,) angle between ray and segment [rad] in [0, pi / 2], 0 for none.
    """
    origins = np.broadcast_to(np.asarray(origins, float), (angles.size, 2))
    ray, wall = _candidates(segments, origins, angles)
    start, along = segments[wall, :2], segments[wall, 2:] - segments[wall, :2]
    direction = np.stack([np.cos(angles), np.sin(angles)], -1)[ray]
    to_start = start - origins[ray]
    det = _cross(direction, along)
    with np.errstate(divide="ignore", invalid="ignore"):  # a ray parallel to a wall: 0/0 fails the test below
        distance = _cross(to_start, along) / det
        share = _cross(to_start, direction) / det
    # A hair more than [0, 1], else rounding lets a ray slip through the corner that two walls share.
    hit = (distance > 0.0) & (share >= -1e-12) & (share <= 1.0 + 1e-12)
    ray, distance = ray[hit], distance[hit]
    slope = np.abs(det[hit]) / np.hypot(*along[hit].T)
    last_is_nearest = np.argsort(-distance, kind="stable")  # where an index repeats, the last value stays
    reach, glance = np.full(angles.size, np.inf), np.zeros(angles.size)
    reach[ray[last_is_nearest]] = distance[last_is_nearest]
    glance[ray[last_is_nearest]] = np.arcsin(np.minimum(slope[last_is_nearest], 1.0))
    return reach, glance


def _candidates(segments: np.ndarray, origins: np.ndarray, angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices (ray, segment) of all pairs that may meet, both (n,)."""
    centre = 0.5 * (origins.min(0) + origins.max(0))
    spread = float(np.max(np.hypot(*(origins - centre).T)))
    first, second = segments[:, :2] - centre, segments[:, 2:] - centre
    bearing = np.arctan2(first[:, 1], first[:, 0])
    arc = np.arctan2(_cross(first, second), np.sum(first * second, -1))  # signed, seen from the centre
    near = point_segment_distance(np.zeros((1, 2)), np.hstack([first, second]))[0]
    # Seen from an origin `spread` beside the centre the arc widens by at most asin(spread / distance).
    pad = np.where(near > 2.0 * spread + 1e-6, np.arcsin(np.clip(spread / np.maximum(near, 1e-9), 0, 1)) + 1e-9, 4.0)
    low = bearing + np.minimum(arc, 0.0) - pad
    width = np.minimum(np.abs(arc) + 2.0 * pad, 2.0 * np.pi)
    low = angles[0] + np.mod(low - angles[0], 2.0 * np.pi)
    low = np.concatenate([low, low - 2.0 * np.pi])  # the arc may pass the first ray's bearing
    begin = np.searchsorted(angles, low, "left")
    count = np.searchsorted(angles, low + np.tile(width, 2), "right") - begin
    ends = np.cumsum(count)
    ray = np.arange(ends[-1]) + np.repeat(begin - (ends - count), count)
    return ray, np.repeat(np.tile(np.arange(len(segments)), 2), count)


def blocked(segments: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Whether a segment crosses the straight line from start to end, both (n, 2) [m]; (n,) bool."""
    a, along = segments[None, :, :2], segments[None, :, 2:] - segments[None, :, :2]
    line = (end - start)[:, None]
    to_a = a - start[:, None]
    det = _cross(line, along)
    with np.errstate(divide="ignore", invalid="ignore"):
        t, u = _cross(to_a, along) / det, _cross(to_a, line) / det
    return np.any((t > 0.0) & (t < 1.0) & (u >= 0.0) & (u <= 1.0), axis=1)


def point_segment_distance(points: np.ndarray, segments: np.ndarray) -> np.ndarray:
    """Distance of points (n, 2) from segments (S, 4), (n, S) [m]."""
    a, along = segments[:, :2], segments[:, 2:] - segments[:, :2]
    length2 = np.maximum(np.sum(along**2, -1), 1e-30)
    share = np.clip(np.sum((points[:, None] - a) * along, -1) / length2, 0.0, 1.0)
    return np.hypot(*np.moveaxis(points[:, None] - a - share[..., None] * along, -1, 0))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """z of the cross product of (..., 2) vectors."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
