"""The ranges of some frames in flat arrays, with what the steps made of them: what the host looks at between steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from uwbslam_jax.estimator import Estimate
from uwbslam_jax.measurements import StampedFrame
from uwbslam_jax.numerics import turned
from uwbslam_jax.settings import HostParams


class Heard(NamedTuple):
    """R usable ranges in order of their frames.

    Attributes:
      stamp: (R,) of the frame, int64 [ns]. age: (R,) of the range relative to it [s].
      i, j: (R,) slots.
      flat: (R,) distance in the plane, biases and heights taken off [m].
      normalised: (R,) see Estimate.
      antenna: (R, 2) where the robot's antenna was [m].
      rests_i, rests_j: (R,) whether the node is in the state and not carried.
    """

    stamp: np.ndarray
    age: np.ndarray
    i: np.ndarray
    j: np.ndarray
    flat: np.ndarray
    normalised: np.ndarray
    antenna: np.ndarray
    rests_i: np.ndarray
    rests_j: np.ndarray


def heard(pending: Sequence[tuple[StampedFrame, Estimate]], host: HostParams) -> Heard:
    """The usable ranges of some frames and their estimates, all on the host."""
    f, k = np.nonzero(np.stack([host.usable(frame.frame.ranges) for frame, _ in pending]))

    def of_ranges(name: str) -> np.ndarray:
        return np.stack([getattr(frame.frame.ranges, name) for frame, _ in pending])[f, k]

    def of_estimates(name: str) -> np.ndarray:
        return np.stack([getattr(estimate, name) for _, estimate in pending])

    i, j, age = of_ranges("i"), of_ranges("j"), of_ranges("age").astype(float)
    pose, velocity, yaw_rate = (of_estimates(name).astype(float)[f] for name in ("pose", "velocity", "yaw_rate"))
    rests = of_estimates("active") & ~of_estimates("moving")
    return Heard(
        stamp=np.array([frame.stamp for frame, _ in pending], np.int64)[f],
        age=age,
        i=i,
        j=j,
        flat=host.flat(of_ranges("range").astype(float), i, j),
        normalised=of_estimates("normalised").astype(float)[f, k],
        antenna=pose[:, :2] + age[:, None] * velocity + turned(pose[:, 2] + yaw_rate * age, host.antenna),
        rests_i=rests[f, i],
        rests_j=rests[f, j],
    )
