"""The start of a run in numpy: keyframes along a track and ranges to beacons with noise, as start-up buffers them."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from uwbslam_jax.measurements import Frame, Odometry, Ranges, StampedFrame
from uwbslam_jax.session.frame_assembler import pad_scan
from uwbslam_jax.settings import RobotSettings, Settings, UwbSettings, make_host_params, make_params
from uwbslam_jax.startup.keyframe_buffer import Buffer, Keyframe, Sighting

BEACONS = {1: np.array([-2.0, 4.0]), 2: np.array([6.0, 5.0]), 3: np.array([5.0, -3.0])}
IDS = {0: 0, 1: 1, 2: 2, 3: 3}
SETTINGS = Settings(uwb=UwbSettings(max_beacons=3, sigma_n=0.1))
SIGMA_N = SETTINGS.uwb.sigma_n


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
    poses: np.ndarray,
    *,
    beacons=BEACONS,
    each: int = 3,
    pairs: bool = True,
    seed: int = 0,
    antenna=(0.1, 0.05),
    bias=None,
) -> Buffer:
    """What start-up has buffered: at every pose `each` noisy ranges to every beacon, and between beacons if `pairs`.

    bias: of each node by slot [m], the robot's is slot 0.
    """
    rng = np.random.default_rng(seed)
    bias = {0: 0.0, **dict.fromkeys(beacons, 0.0)} if bias is None else bias
    settings = replace(SETTINGS, robot=RobotSettings(antenna=(*antenna, 0.0)))
    kept = Buffer(make_host_params(settings, make_params(settings)))
    for k, pose in enumerate(poses):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        place = pose[:2] + np.array([c * antenna[0] - s * antenna[1], s * antenna[0] + c * antenna[1]])
        information = np.diag([1 / 0.01**2, 1 / 0.01**2, 1 / 0.002**2])
        stamp = int(k * 3e8)
        kept.keyframes.append(Keyframe(frame(stamp), pose, information, np.zeros(2), 0.0))
        for slot, beacon in beacons.items():
            d = np.linalg.norm(place - beacon) + bias[0] + bias[slot] + SIGMA_N * rng.normal(size=each)
            kept.sightings.setdefault(slot, deque()).extend(Sighting(stamp, pose, float(x)) for x in d)
    for i in beacons:
        for j in beacons:
            if i < j and pairs:
                noise = SIGMA_N * rng.normal(size=each * len(poses))
                d = np.linalg.norm(beacons[i] - beacons[j]) + bias[i] + bias[j] + noise
                kept.pairs[i, j] = deque(map(float, d))
    return kept


def forget(kept: Buffer, slot: int, since: int = 0, before: int = 10**9) -> None:
    """Take the ranges to a beacon out of a buffer, from one keyframe's number to another's."""
    own = range(since, min(before, len(kept.keyframes)))
    stamps = {kept.keyframes[k].frame.stamp for k in own}
    kept.sightings[slot] = deque(s for s in kept.sightings[slot] if s.stamp not in stamps)
