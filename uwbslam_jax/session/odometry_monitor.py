"""Whether odometry tells of the motion that the scans show; while it contradicts them for seconds it is left out."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from uwbslam_jax.estimator import Estimate
from uwbslam_jax.measurements import Odometry, StampedFrame
from uwbslam_jax.numerics import between, compose, wrapped

_APART, _SHARE = (0.08, 0.08), 0.35
"""The motion of a second by odometry and by scans may differ by so much [m, rad] and by such a share of it [ratio]:
wheels slip, and their scale errs."""
_MOVED = (0.15, 0.15)
"""A second with less motion by either tells nothing [m, rad]."""
_FINE_SCORE = 0.6
"""Scans that fit the map worse tell nothing."""
_AGAINST_S, _FOR_S = 3.0, 5.0
"""So long odometry has to contradict the scans to be left out, and to agree with them to be used again [s]: one
that is lifted or whose wheels slip does so for a moment."""
_WINDOW_S, _WINDOWS = 1.0, 2
"""Motion is compared over such a time [s], and at least so many times."""
_LIKE = 0.3
"""A ratio of motions within so much of a value is that value."""


class OdometryMonitor:
    """Compares increments of odometry with the motion from scan to scan.

    Attributes:
      trusted: whether odometry is used now.
    """

    def __init__(self) -> None:
        self.trusted = True
        self._wheels, self._scans, self._seconds = np.zeros(3), np.zeros(3), 0.0
        self._against_s = self._for_s = 0.0
        self._left_out: list[tuple[float, str]] = []
        self._start: int | None = None
        self._pairs: list[np.ndarray] = []  # (2, 3) by odometry and by scans, while they contradict

    def look(self, seen: Sequence[tuple[StampedFrame, Estimate]], measured: Sequence[Odometry]) -> None:
        """Takes in the frames since the last look, about a second, with their odometry as it was measured."""
        last: Estimate | None = None  # from one look to the next the map may have moved
        for (frame, estimate), odometry in zip(seen, measured, strict=True):
            self._start = frame.stamp if self._start is None else self._start
            fine = bool(frame.frame.has_scan) and not bool(estimate.poor) and float(estimate.score) > _FINE_SCORE
            if fine and bool(odometry.valid) and last is not None:
                step = between(*(np.asarray(e.matched_pose, float) for e in (last, estimate)))
                step[2] = wrapped(step[2])
                self._wheels = compose(self._wheels, np.asarray(odometry.increment, float))
                self._scans = compose(self._scans, step)
                self._seconds += float(frame.frame.dt)
            last = estimate if fine else None
        if self._seconds >= _WINDOW_S:
            self.judge(np.stack([self._wheels, self._scans]), self._seconds, seen[-1][0].stamp)
            self._wheels, self._scans, self._seconds = np.zeros(3), np.zeros(3), 0.0

    def judge(self, pair: np.ndarray, seconds: float, now: int) -> None:
        """Compares (2, 3) the motion by odometry and by scans over a time [m, m, rad; s] that ends at a stamp [ns]."""
        size = np.stack([np.hypot(pair[:, 0], pair[:, 1]), np.abs(pair[:, 2])])  # (2, 2) way and turn of each
        most = size.max(axis=1)
        if np.all(most < _MOVED):
            return
        apart = np.array([math.hypot(*(pair[0] - pair[1])[:2]), abs(pair[0, 2] - pair[1, 2])])
        if np.any(apart > np.array(_APART) + _SHARE * most):
            self._against_s, self._for_s = self._against_s + seconds, 0.0
            self._pairs.append(pair)
        else:
            self._for_s, self._against_s = self._for_s + seconds, 0.0
            self._pairs.clear()
        if self.trusted and self._against_s > _AGAINST_S and len(self._pairs) >= _WINDOWS:
            self.trusted = False
            self._left_out.append(((now - (self._start or now)) / 1e9, _cause(np.stack(self._pairs))))
        elif not self.trusted and self._for_s > _FOR_S:
            self.trusted = True

    def told(self) -> list[str]:
        """What a user should know, empty where odometry was never left out."""
        if not self._left_out:
            return []
        since, cause = self._left_out[0]
        again = "" if not self.trusted else ", and used again since"
        return [f"odometry contradicts the scans and is left out after {since:.1f} s{again}: {cause}"]


def _cause(pairs: np.ndarray) -> str:
    """The likely cause of a contradiction, of motions (n, 2, 3) by odometry and by scans."""
    wheels, scans = pairs[:, 0], pairs[:, 1]
    way, turn = (np.sum(scans[:, :2] ** 2), np.sum(scans[:, 2] ** 2))
    along = np.sum(wheels[:, :2] * scans[:, :2]) / max(way, 1e-9)
    across = np.sum(wheels[:, 1] * scans[:, 0] - wheels[:, 0] * scans[:, 1]) / max(way, 1e-9)
    turning = np.sum(wheels[:, 2] * scans[:, 2]) / max(turn, 1e-9)
    if np.abs(wheels).max() < 0.01:
        return "it never changes while the robot moves (frozen); see the base's driver"
    if abs(turning + 1.0) < _LIKE:
        return (
            "it turns the other way: the LiDAR is upside down (--robot.lidar-flip), or the base's driver has the sign "
            "of yaw wrong (--no-odom)"
        )
    if np.abs(wheels[:, 2]).max() < 0.01 and turn > _MOVED[1] ** 2:
        return "its heading never changes while the robot turns; see the base's driver (--no-odom)"
    angle = math.atan2(across, along)
    turns_alike = turn < _MOVED[1] ** 2 or abs(turning - 1.0) < _LIKE
    if turns_alike and abs(math.hypot(along, across) - 1.0) < _LIKE and abs(angle) > _LIKE:
        return (
            f"it drives another way: the LiDAR is turned on the robot (--robot.lidar 0 0 {angle:.2f}), or the base's "
            "driver has a sign wrong (--no-odom)"
        )
    return (
        f"its ways are {math.hypot(along, across):.2g} times, its turns {turning:.2g} times those of the scans: see "
        "units and wheels in the base's driver, or leave it out (--no-odom)"
    )
