"""One step as it is reported: node ids in place of slots, host arrays. Nothing is computed until it is read."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import numpy as np

from uwbslam_jax.estimator import Estimate
from uwbslam_jax.measurements import Scan, StampedFrame
from uwbslam_jax.numerics import turned
from uwbslam_jax.result import BeaconEstimate, BeaconStatus, RunStatus

Pair = tuple[int, int]
"""Ids of two nodes, the smaller first."""


class Update:
    """What a step has found, in the published frame once that is decided, before in the frame of the start.

    Attributes:
      stamp: of the frame [ns].
      status: of the run then.
      decided: whether the published frame is.
      frame, estimate: the step's own, by slots.
      ids: slot -> node id, as known then; slot 0 is the robot.
    """

    def __init__(
        self,
        frame: StampedFrame,
        estimate: Estimate,
        ids: Mapping[int, int],
        beacon_states: Mapping[int, BeaconStatus],
        status: RunStatus,
        decided: bool,
    ):
        self.stamp, self.status, self.decided = frame.stamp, status, decided
        self.frame, self.estimate, self.ids = frame, estimate, ids
        self._states = beacon_states

    @cached_property
    def pose(self) -> np.ndarray:
        """(3,) of the robot [m, m, rad]."""
        return np.asarray(self.estimate.pose, float)

    @property
    def cov(self) -> np.ndarray:
        """(3, 3) covariance of the pose [m, m, rad]."""
        return np.asarray(self.estimate.pose_cov, float)

    @property
    def velocity(self) -> np.ndarray:
        """(3,) of the robot in the frame of the pose [m/s, m/s, rad/s]."""
        return np.append(np.asarray(self.estimate.velocity, float), float(self.estimate.yaw_rate))

    @property
    def score(self) -> float | None:
        """How well the scan fits the map, 0 to 1; None without a scan."""
        return float(self.estimate.score) if bool(self.frame.frame.has_scan) else None

    @cached_property
    def beacons(self) -> dict[int, BeaconEstimate]:
        """Id -> estimate of every beacon heard; the place of one that is not in the state is NaN."""
        e, nowhere = self.estimate, (np.full(2, np.nan), np.full((2, 2), np.nan))
        found = {}
        for slot, node in sorted(self.ids.items(), key=lambda pair: pair[1]):
            if slot:
                known = bool(e.active[slot])
                place = (
                    (np.asarray(e.beacons[slot], float), np.asarray(e.beacon_covs[slot], float)) if known else nowhere
                )
                found[node] = BeaconEstimate(node, *place, self._states.get(slot, BeaconStatus.WAITING))
        return found

    @cached_property
    def links(self) -> dict[Pair, float | None]:
        """Pair -> measured less predicted range [m] of the nodes that ranged; None where the range was left out."""
        r, active = self.frame.frame.ranges, np.asarray(self.estimate.active)
        found: dict[Pair, float | None] = {}
        for k in np.flatnonzero(np.asarray(r.valid) & active[r.i] & active[r.j]).tolist():
            a, b = sorted((self.ids[int(r.i[k])], self.ids[int(r.j[k])]))
            found[a, b] = float(self.estimate.innovation[k]) if self.estimate.weight[k] > 0 else None
        return found

    def scan_points(self, lidar: tuple[float, float, float], every: int = 1) -> np.ndarray:
        """(n, 2) where the scan's beams end [m]. See the function `scan_points` for the arguments."""
        return scan_points(self.frame.frame.scan, lidar, self.pose, self.velocity, every)


def scan_points(
    scan: Scan, lidar: tuple[float, float, float], pose: np.ndarray, velocity: np.ndarray, every: int = 1
) -> np.ndarray:
    """(n, 2) where a scan's beams end, each at its own time [m].

    Args:
      lidar, pose, velocity: (3,) the LiDAR on the robot, the robot at the scan's stamp, and its motion.
      every: only each so many-th return.
    """
    beam = np.flatnonzero(scan.valid)[::every]
    bearing = float(scan.angle_min) + float(scan.angle_increment) * beam + lidar[2]
    reach, age = np.asarray(scan.ranges, float)[beam], float(scan.time_increment) * beam
    ends = np.array(lidar[:2]) + reach[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    return pose[:2] + turned(pose[2] + velocity[2] * age, ends) + age[:, None] * velocity[:2]
