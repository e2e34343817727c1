"""A robot with wheels and ranges alone, among four beacons: its messages and the truth."""

from __future__ import annotations

import numpy as np

from uwbslam_jax.measurements import Message, OdometryMessage, RangeMessage, TruthMessage

START = 1_700_000_000_000_000_000
BEACONS = {3: (-4.0, 9.0), 5: (16.0, 11.0), 8: (14.0, -6.0), 13: (-5.0, -4.0)}
SCALE = 0.07


def driven(seconds: float = 60.0, scale: float = SCALE) -> list[Message]:
    """Figures of eight among four beacons at 1 m/s: wheels that drift, one range at a time that is long by a share of
    the distance."""
    rng = np.random.default_rng(5)
    t = np.arange(0.0, seconds, 0.1)
    phase = 2 * np.pi * t / 30.0
    true = np.stack([5.0 + 6.0 * np.sin(phase), 2.0 + 3.0 * np.sin(2 * phase)], axis=-1)
    course = np.unwrap(np.arctan2(*np.gradient(true, axis=0).T[::-1]))
    length = np.hypot(*np.diff(true, axis=0).T) * 1.01 * (1 + 0.02 * rng.normal(size=len(t) - 1))
    yaw = np.concatenate([[0.0], np.cumsum(np.diff(course) + 0.002 * rng.normal(size=len(t) - 1))])
    middle = (yaw[1:] + yaw[:-1]) / 2
    steps = length[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=-1)
    wheels = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    messages: list[Message] = [TruthMessage(START, node, x, y) for node, (x, y) in BEACONS.items()]
    for k, second in enumerate(t):
        stamp = START + round(second * 1e9)
        messages.append(TruthMessage(stamp, None, *true[k].tolist(), float(course[k])))
        messages.append(OdometryMessage(stamp, *wheels[k].tolist(), float(yaw[k])))
        node = list(BEACONS)[k % len(BEACONS)]
        distance = np.hypot(*(true[k] - BEACONS[node])) * (1 + scale) + 0.1 * rng.normal()
        messages.append(RangeMessage(stamp, 0, node, float(distance)))
    return messages
