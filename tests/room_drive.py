"""A drive around the small room: frames of scans and noisy ranges, one tenth of a second each."""

from __future__ import annotations

import jax
import numpy as np
import small_room as room

from uwbslam_jax.measurements import StampedFrame
from uwbslam_jax.session.session import Session
from uwbslam_jax.settings import LidarSettings, MapSettings, Settings, UwbSettings

SETTINGS = Settings(
    uwb=UwbSettings(max_beacons=3, sigma_n=0.05),
    lidar=LidarSettings(max_beams=60),
    map=MapSettings(size_m=12.8, resolution=0.1, levels=2),
)
BEACONS = {10: np.array([-3.5, -2.5]), 20: np.array([4.0, -2.0]), 30: np.array([1.0, 3.0])}
SECOND = 10**9


def pose_at(t: float) -> np.ndarray:
    """Once around an ellipse in 20 s, heading along it; at rest before 0."""
    a = 2 * np.pi * max(t, 0.0) / 20.0
    dx, dy = -2.0 * np.sin(a), 1.6 * np.cos(a)
    return np.array([-1.0 + 2.0 * np.cos(a), 1.6 * np.sin(a), np.arctan2(dy, dx)])


class Drive:
    """Frames of a drive around the room, ten a second, with noise on the ranges."""

    def __init__(self, run: Session, seed: int = 0):
        self.time, self._config, self._rng = -0.5, run.config, np.random.default_rng(seed)
        self.slots = {0: 0}

    def frames(self, count: int, heard, dt: float = 0.1, moving: bool = True) -> list[StampedFrame]:
        made = []
        for _ in range(count):
            self.time += dt
            pose = pose_at(self.time if moving else 0.0)
            for node in heard:
                self.slots.setdefault(node, len(self.slots))
            places = {0: pose[:2], **{self.slots[n]: BEACONS[n] for n in heard}}
            pairs = [(i, j) for i in places for j in places if i < j]
            z = [np.hypot(*(places[i] - places[j])) + 0.05 * self._rng.normal() for i, j in pairs]
            ranges = room.ranges(pairs, z, self._config.max_ranges, age=-0.01)
            frame = room.frame(self._config, dt, room.scan(pose, self._config.max_beams), ranges)
            made.append(StampedFrame(round((self.time + 100) * SECOND), frame, dict(self.slots)))
        return made


def leaves(tree) -> list[np.ndarray]:
    return [np.array(leaf) for leaf in jax.tree.leaves(tree)]


def assert_same_bits(a, b) -> None:
    for x, y in zip(leaves(a), leaves(b), strict=True):
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(x, y)
