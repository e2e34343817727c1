"""The start of a run in numpy: keyframes along a track and ranges to beacons with noise, as start-up buffers them."""

from __future__ import annotations

import numpy as np

from uwbslam_jax.config import Settings, UwbSettings
from uwbslam_jax.frames import pad_scan
from uwbslam_jax.measurements import Frame, Odometry, Ranges, StampedFrame
from uwbslam_jax.placement import Keyframe
from uwbslam_jax.startup import Buffer

BEACONS = {1: np.array([-2.0, 4.0]), 2: np.array([6.0, 5.0]), 3: np.array([5.0, -3.0])}
IDS = {0: 0, 1: 1, 2: 2, 3: 3}
SETTINGS = Settings(uwb=UwbSettings(max_beacons=3))
SIGMA_N = 0.1


def straight(length: float = 6.0) -> np.ndarray:
    """Poses every 0.25 m along +x."""
    x = np.arange(0.0, length, 0.25)
    return np.stack([x, 0 * x, 0 * x], axis=1)


def with_a_turn(length: float = 4.0) -> np.ndarray:
    """Along +x, then a left turn and along +y."""
    first = straight(length)
    angle = np.linspace(0.0, np.pi / 2, 5)[1:]
    arc = first[-1] + np.stack([0.5 * np.sin(angle), 0.5 * (1 - np.cos(angle)), angle], axis=1)
    y = np.arange(0.25, length / 2, 0.25)
    on = arc[-1] + np.stack([0 * y, y, 0 * y], axis=1)
    return np.concatenate([first, arc, on])


def frame(stamp: int = 0) -> StampedFrame:
    """A frame without any measurement."""
    zero = np.zeros(4, np.float32)
    index = np.zeros(4, np.int32)
    ranges = Ranges(index, index + 1, zero, zero, zero, np.zeros(4, bool))
    odometry = Odometry(np.zeros(3, np.float32), np.bool_(False))
    return StampedFrame(stamp, Frame(np.float32(0), np.bool_(False), pad_scan(None, SETTINGS), ranges, odometry))


def buffer(
    poses: np.ndarray, *, beacons=BEACONS, each: int = 3, pairs: bool = True, seed: int = 0, antenna=(0.1, 0.05)
) -> Buffer:
    """What start-up has buffered: at every pose `each` noisy ranges to every beacon, and between beacons if `pairs`."""
    rng = np.random.default_rng(seed)
    kept = Buffer(np.array(antenna), np.zeros(4), np.zeros(4), SIGMA_N)
    for k, pose in enumerate(poses):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        place = pose[:2] + np.array([c * antenna[0] - s * antenna[1], s * antenna[0] + c * antenna[1]])
        information = np.diag([1 / 0.01**2, 1 / 0.01**2, 1 / 0.002**2])
        key = Keyframe(frame(int(k * 3e8)), pose, information, np.zeros(2), 0.0)
        for slot, beacon in beacons.items():
            d = np.linalg.norm(place - beacon) + SIGMA_N * rng.normal(size=each)
            key.seen[slot] = [(np.array(antenna), float(x)) for x in d]
        kept.keyframes.append(key)
    for i in beacons:
        for j in beacons:
            if i < j and pairs:
                d = np.linalg.norm(beacons[i] - beacons[j]) + SIGMA_N * rng.normal(size=each * len(poses))
                kept.pairs[i, j] = list(map(float, d))
    return kept
